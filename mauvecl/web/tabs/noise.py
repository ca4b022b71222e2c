"""Noise by origin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.schema.tables import stacked
from mauvecl.study.labels import label, star_column
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms

#: Columns of the budget, with what each is called and its colour.
PARTS = {
    "source_photon": ("photons of the star", "star"),
    "zodiacal_photon": ("photons of the sky", "sky"),
    "dark": ("dark current", "dark"),
    "read": ("read noise", "read"),
    "total": ("all together", "total"),
}


class Budget(Picture):
    """Noise of a pixel by origin."""

    name, title = "budget", "Noise of a pixel by origin"
    logs = ("Y",)
    pins = "source_photon"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "DN rms in the exposure", logs, wavelength=True)
        for name, (called, colour) in PARTS.items():
            # The largest part stays visible behind the sum.
            how: dict[str, Any] = {"line_dash": "dashed"} if name == "total" else {}
            curve = canvas.line(name, called, colour, line_width=2, **how)
            lines = (("wavelength (nm)", "x"),) if name == "total" else ()
            canvas.tooltips(curve, *lines, (f"{called} (DN)", "y"))
        canvas.pinned()
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        x, table = closed.quiet, closed.quiet.noise_budget()
        values = {name: np.asarray(table[name].value) for name in PARTS}
        # Logarithms show nothing of zero.
        sources: dict[str, Any] = {
            name: {"x": x.wavelength_nm, "y": np.where(v > 0, v, np.nan)} for name, v in values.items()
        }
        power = {name: float(np.sum(v**2)) for name, v in values.items() if name != "total"}
        first = max(power, key=lambda name: power[name])
        share = 100 * power[first] / (sum(power.values()) or 1.0)
        text = f"Most of the noise's power comes from {PARTS[first][0]}: {share:.0f} % over all pixels."
        return PictureData(text, sources)


class Noise(Tab):
    """Noise by origin."""

    name, title = "noise", "Noise"
    about = "Where the noise comes from, pixel by pixel, without a flare; of pinned scenarios the photons of the star."
    pictures = (Budget(),)
    questions = ("snr",)
    files = {"noise-budget": None}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return the closed-form table of `mauvecl snr`."""
        study = closed.study
        parts = [({"star": label(study.star[0], closed.quiet)}, closed.quiet.noise_budget())]
        return stacked([star_column()], parts, realisations=study.run.realisations, study=study.text())
