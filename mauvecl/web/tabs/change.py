"""Smallest changes of the star between visits that are detected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms

#: Relative changes that are shown, with their colours.
SHOWN = {"balmer jump": "flare", "200-320": "star", "320-700": "sky"}


class AgainstMagnitude(Picture):
    """Smallest relative changes against the magnitude of the star."""

    name, title = "changes", "Smallest change between visits, for brighter and fainter stars"
    sets = "magnitude=x"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "magnitude", "smallest change (%)", logs | {"y"}, y_range=(0.01, 1e4))
        for name, colour in SHOWN.items():
            curve = canvas.line(name, name, colour, line_width=2)
            canvas.tooltips(curve, ("magnitude", "x"), (f"{name} (%)", "y"))
        canvas.own_point("this star, 320-700")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in (*SHOWN, "own")}
        if "change" not in answers:
            return PictureData("Change computes which differences between visits are detected.", sources)
        answer = answers["change"]
        for name in SHOWN:
            own = [(at, 100 * row.smallest.one) for at, row in answer.along if row.change.name == name]
            kept = [(at, size) for at, size in own if np.isfinite(size)]
            sources[name] = {"x": [at for at, _ in kept], "y": [size for _, size in kept]}
        here = next(row for row in answer.changes if row.change.name == "320-700")
        magnitude, size = closed.study.star[0].magnitude, 100 * here.smallest.one
        if magnitude is None or not np.isfinite(size):
            return PictureData("What is unknown hides the change of this star.", sources)
        sources["own"] = {"x": [magnitude], "y": [size]}
        text = f"Between {answer.study.change.visits} visits, a change of {size:.3g} % in 320-700 nm is detected."
        return PictureData(text, sources)


class Change(Tab):
    """Changes between visits."""

    verb = "change"
    about = "How small a difference between visits is seen: of lines, bands, the Balmer jump and the colour."
    pictures = (AgainstMagnitude(),)
    headline = False
    # Visits are evenly spaced, without an orbit.
    never = ("start", "days")
    files = {"change": "change", "indices": "change"}  # noqa: RUF012
