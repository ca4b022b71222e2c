"""Recorded spectra: star and flare in DN, one drawn exposure, and the light at the telescope."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas, strips
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms


class Recorded(Picture):
    """One exposure with the flare and its components, without pedestals."""

    name, title = "recorded", "One exposure, less bias and dark"
    logs = ("y",)
    pins = "flare"
    shows = {"pedestals": "Bias and dark"}  # noqa: RUF012

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "DN in the exposure", logs, wavelength=True)
        canvas.band("spread", "95 % of draws with the flare", "flare")
        canvas.saturated()
        canvas.line("drawn", "drawn exposure", "drawn", line_width=1)
        canvas.line("sky", "sky", "sky")
        canvas.line("dark", "dark", "dark", show="pedestals")
        canvas.line("bias", "bias", "bias", show="pedestals")
        curve = canvas.line("star", "star", "star", line_width=2)
        flare = canvas.line("flare", "star with flare", "flare", line_width=2)
        canvas.pinned()
        canvas.tooltips(curve, ("wavelength (nm)", "x"), ("star (DN)", "y"))
        canvas.tooltips(flare, ("with flare (DN)", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        x, y = closed.quiet, closed.flare
        w, gain = x.wavelength_nm, x.n_frames * x.gain_dn_per_electron
        sky, spread = gain * x.sky_electrons, 1.96 * np.sqrt(y.variance_dn2)
        behind = sky + gain * x.neighbour_electrons
        star, flare = gain * x.source_electrons + behind, gain * y.source_electrons + behind
        pedestal = x.n_frames * (x.dark_dn + x.bias_dn)
        recorded = y.recorded_dn - pedestal
        sources: dict[str, Any] = {
            "star": {"x": w, "y": star},
            "flare": {"x": w, "y": flare},
            "sky": {"x": w, "y": sky},
            "dark": {"x": w, "y": x.n_frames * x.dark_dn},
            "bias": {"x": w, "y": x.n_frames * x.bias_dn},
            "spread": {"x": w, "low": recorded - spread, "high": recorded + spread},
            "drawn": {"x": w, "y": answers["draw"] - pedestal} if "draw" in answers else {"x": [], "y": []},
            "saturated": strips(w, x.saturated | y.saturated),
        }
        peak = int(np.argmax(flare))
        text = (
            f"Star and sky give up to {short(star.max())} DN in the exposure, with the flare {short(flare.max())} DN "
            f"at {w[peak]:.0f} nm; 95 % of draws lie within ±{short(spread[peak])} DN there."
        )
        return PictureData(text, sources)


class Telescope(Picture):
    """The star's spectrum at the telescope, without and with the flare."""

    name, title = "telescope", "Spectrum at the telescope"
    logs = ("Y",)
    pins = "flare"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "flux (erg / s / cm² / Å)", logs, wavelength=True)
        flare = canvas.line("flare", "star with flare", "flare")
        star = canvas.line("star", "star", "star")
        canvas.pinned()
        canvas.tooltips(star, ("wavelength (nm)", "x"), ("star", "y"))
        canvas.tooltips(flare, ("with flare", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        star, flare = closed.light
        # A jump or line of the flare adds wavelengths.
        nm = flare.wavelength_nm[(flare.wavelength_nm >= 190) & (flare.wavelength_nm <= 710)]
        light = [np.interp(nm, source.wavelength_nm, source.flux_flam) for source in (star, flare)]
        # Logarithms show nothing of zero.
        one, two = (np.where(flux > 0, flux, np.nan) for flux in light)
        rise = np.nanmax(two / one)
        text = f"The flare multiplies the star's light by up to {short(rise)} between 190 and 710 nm."
        return PictureData(text, {"star": {"x": nm, "y": one}, "flare": {"x": nm, "y": two}})


class Spectrum(Tab):
    """Tab of spectra."""

    name, title = "spectrum", "Spectrum"
    about = "What the detector records, and the light that comes to the telescope."
    pictures = (Recorded(), Telescope())
    questions = ("simulate",)
    files = {"observation": None}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return one observation with the flare and its components."""
        from mauvecl.answers.signal.simulate import simulate

        return simulate(closed.study, flaring=True).observations[1][2]
