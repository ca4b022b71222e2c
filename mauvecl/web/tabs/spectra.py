"""Tabs of spectra: expected spectra, S/N, and noise by origin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts.chart import SATURATED, WAVELENGTH, Axis, Band, Chart, ChartData, Line
from mauvecl.charts.limits import BUDGET, budget_series
from mauvecl.schema.columns import stacked
from mauvecl.study.cases import label, star_column
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.figures import strips
from mauvecl.web.tabs.tab import Tab

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms


@BUDGET.data()
def budget(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the noise of a pixel by origin."""
    series = budget_series(closed.quiet)
    power = {part: float(np.nansum(series[part.key][1] ** 2)) for part in BUDGET.series[:-1] if part.key in series}
    most = max(power, key=lambda name: power[name])
    share = 100 * power[most] / (sum(power.values()) or 1.0)
    return ChartData(f"Most of the noise's power comes from {most.called}: {share:.0f} % over all pixels.", series)


class Noise(Tab):
    """Noise by origin."""

    name, title = "noise", "Noise"
    about = "Where the noise comes from, pixel by pixel, without a flare; of pinned scenarios the photons of the star."
    pictures = (budget,)
    questions = ("snr",)
    files = {"noise-budget": None}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return the closed-form table of `mauvecl snr`."""
        study = closed.study
        parts = [({"star": label(study.star[0], closed.quiet)}, closed.quiet.noise_budget())]
        return stacked([star_column()], parts, realisations=study.run.realisations, study=study.text())


@Chart(
    "snr", "Signal to noise without a flare", WAVELENGTH, Axis("S/N"),
    (
        Band("95 % of realisations, per element", name="spread", alpha=0.4),
        SATURATED,
        Line("per pixel", "sky", "pixel", tips=("S/N per pixel",)),
        Line("per element of 10.5 nm", "star", "element", width=2, tips=("wavelength (nm)", "S/N per element")),
    ),
    logs=("y",), pins="element",
).data()  # fmt: skip
def signal_to_noise(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the closed form of the S/N per pixel and element, and the spread of realisations."""
    x = closed.quiet
    pixel, element = x.snr(), x.snr_per_element()
    series: dict[str, Any] = {
        "pixel": (x.wavelength_nm, pixel),
        "element": (x.element_wavelength_nm, element),
        "saturated": strips(x.wavelength_nm, x.saturated),
    }
    if "snr" in answers:
        table = answers["snr"].element
        series["spread"] = table["wavelength"].to_value("nm"), np.asarray(table["q2.5"]), np.asarray(table["q97.5"])
    best = int(np.argmax(element))
    text = (
        f"The S/N is at most {pixel.max():.3g} a pixel, and {element.max():.3g} an element of 10.5 nm, at "
        f"{x.element_wavelength_nm[best]:.0f} nm."
    )
    return ChartData(text, series)


class Signal(Tab):
    """Signal to noise."""

    name, title = "snr", "S/N"
    about = "How well the star itself is measured, wavelength by wavelength."
    pictures = (signal_to_noise,)
    simulations = {"detection": "Simulate"}  # noqa: RUF012
    questions = ("snr",)
    files = {"snr": "detection"}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        return answers["snr"].element


@Chart(
    "recorded", "One exposure, less bias and dark", WAVELENGTH, Axis("DN in the exposure"),
    (
        Band("95 % of draws with the flare", "flare", "spread"),
        SATURATED,
        Line("drawn exposure", name="drawn", width=1),
        Line("sky", "sky"),
        Line("dark", "dark", show="pedestals"),
        Line("bias", "bias", show="pedestals"),
        Line("star", "star", width=2, tips=("wavelength (nm)", "star (DN)")),
        Line("star with flare", "flare", "flare", width=2, tips=("with flare (DN)",)),
    ),
    logs=("y",), pins="flare", shows={"pedestals": "Bias and dark"},
).data()  # fmt: skip
def recorded(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return one exposure with the flare and its components, without pedestals."""
    x, y = closed.quiet, closed.flare
    w, gain = x.wavelength_nm, x.n_frames * x.gain_dn_per_electron
    sky, spread = gain * x.sky_electrons, 1.96 * np.sqrt(y.variance_dn2)
    behind = sky + gain * x.neighbour_electrons
    star, flare = gain * x.source_electrons + behind, gain * y.source_electrons + behind
    pedestal = x.n_frames * (x.dark_dn + x.bias_dn)
    mean = y.recorded_dn - pedestal
    series: dict[str, Any] = {
        "star": (w, star),
        "flare": (w, flare),
        "sky": (w, sky),
        "dark": (w, x.n_frames * x.dark_dn),
        "bias": (w, x.n_frames * x.bias_dn),
        "spread": (w, mean - spread, mean + spread),
        "saturated": strips(w, x.saturated | y.saturated),
    }
    if "draw" in answers:
        series["drawn"] = w, answers["draw"] - pedestal
    peak = int(np.argmax(flare))
    text = (
        f"Star and sky give up to {short(star.max())} DN in the exposure, with the flare {short(flare.max())} DN "
        f"at {w[peak]:.0f} nm; 95 % of draws lie within ±{short(spread[peak])} DN there."
    )
    return ChartData(text, series)


@Chart(
    "telescope", "Spectrum at the telescope", WAVELENGTH, Axis("flux (erg / s / cm² / Å)"),
    (
        Line("star with flare", "flare", "flare", tips=("with flare",)),
        Line("star", "star", tips=("wavelength (nm)", "star")),
    ),
    logs=("Y",), pins="flare",
).data()  # fmt: skip
def telescope(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the star's spectrum at the telescope, without and with the flare."""
    star, flare = closed.light
    # A jump or line of the flare adds wavelengths.
    nm = flare.wavelength_nm[(flare.wavelength_nm >= 190) & (flare.wavelength_nm <= 710)]
    light = [np.interp(nm, source.wavelength_nm, source.flux_flam) for source in (star, flare)]
    # Logarithms show nothing of zero.
    quiet, flaring = (np.where(flux > 0, flux, np.nan) for flux in light)
    rise = np.nanmax(flaring / quiet)
    text = f"The flare multiplies the star's light by up to {short(rise)} between 190 and 710 nm."
    return ChartData(text, {"star": (nm, quiet), "flare": (nm, flaring)})


class Spectrum(Tab):
    """Tab of spectra."""

    name, title = "spectrum", "Spectrum"
    about = "What the detector records, and the light that comes to the telescope."
    pictures = (recorded, telescope)
    questions = ("simulate",)
    files = {"observation": None}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return one observation with the flare and its components."""
        from mauvecl.answers.signal import simulate

        return simulate(closed.study, flaring=True).observations[1][2]
