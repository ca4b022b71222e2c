"""Signal to noise without a flare."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.figures import Canvas, strips
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms


class SignalToNoise(Picture):
    """S/N per pixel and element: the closed form, and the spread of realisations."""

    name, title = "snr", "Signal to noise without a flare"
    logs = ("y",)
    pins = "element"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "S/N", logs, wavelength=True)
        canvas.band("spread", "95 % of realisations, per element", "drawn", alpha=0.4)
        canvas.saturated()
        pixel = canvas.line("pixel", "per pixel", "sky")
        element = canvas.line("element", "per element of 10.5 nm", "star", line_width=2)
        canvas.pinned()
        canvas.tooltips(element, ("wavelength (nm)", "x"), ("S/N per element", "y"))
        canvas.tooltips(pixel, ("S/N per pixel", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        x = closed.quiet
        pixel, element = x.snr(), x.snr_per_element()
        sources: dict[str, Any] = {
            "pixel": {"x": x.wavelength_nm, "y": pixel},
            "element": {"x": x.element_wavelength_nm, "y": element},
            "spread": {"x": [], "low": [], "high": []},
            "saturated": strips(x.wavelength_nm, x.saturated),
        }
        if "snr" in answers:
            table = answers["snr"].element
            wavelength = table["wavelength"].to_value("nm")
            sources["spread"] = {"x": wavelength, "low": np.asarray(table["q2.5"]), "high": np.asarray(table["q97.5"])}
        best = int(np.argmax(element))
        text = (
            f"The S/N is at most {pixel.max():.3g} a pixel, and {element.max():.3g} an element of 10.5 nm, at "
            f"{x.element_wavelength_nm[best]:.0f} nm."
        )
        return PictureData(text, sources)


class Signal(Tab):
    """Signal to noise."""

    name, title = "snr", "S/N"
    about = "How well the star itself is measured, wavelength by wavelength."
    pictures = (SignalToNoise(),)
    simulations = {"detection": "Simulate"}  # noqa: RUF012
    questions = ("snr",)
    files = {"snr": "detection"}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        return answers["snr"].element
