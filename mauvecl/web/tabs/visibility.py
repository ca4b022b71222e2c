"""Visibility of a target from the orbit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms


class Hours(Picture):
    """Daily hours of visibility, and the target's distance from the Sun."""

    name, title = "hours", "Hours in which the target is seen, day by day"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "", "hours in the day", logs, x_axis_type="datetime", y_range=(-0.5, 24.5))
        canvas.band("area", "hours seen", "star", alpha=0.3)
        canvas.legend.pop()
        curve = canvas.line("hours", "hours seen, day by day", "star", line_width=1.2)
        canvas.tooltips(curve, ("hours", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        orbit = closed.study.orbit
        sources: dict[str, Any] = {"area": {"x": [], "low": [], "high": []}, "hours": {"x": [], "y": []}}
        if "visible" not in answers:
            named = ", ".join(orbit.targets)
            if named:
                return PictureData(f"When {named} is seen is not looked up yet: press Find when.", sources)
            text = "No target is named yet. Name one under Advanced, such as eps Eri, and press Find when."
            return PictureData(text, sources)
        table = answers["seen"]["by_day"]
        hours = np.asarray(table["hours"].to_value("h"))
        # Milliseconds, as browsers count time.
        day = (np.datetime64(orbit.start, "ms") + np.arange(hours.size) * np.timedelta64(1, "D")).astype(float)
        sources = {
            "area": {"x": day, "low": np.zeros(hours.size), "high": hours},
            "hours": {"x": day, "y": hours},
        }
        seen = np.count_nonzero(hours > 0)
        text = (
            f"From {orbit.start} on, {', '.join(orbit.targets)} is seen on {seen} of {hours.size} days, for "
            f"{short(float(hours.sum()))} hours in all and {hours.max():.3g} on its best day."
        )
        return PictureData(text, sources)


class Visibility(Tab):
    """Tab of the visibility."""

    verb, name, title = "visible", "visibility", "Visibility"
    about = (
        "When the satellite can look at a target: clear of Earth, Sun, Moon and radiation, for a year from 2027-01-01."
    )
    pictures = (Hours(),)
    simulations = {"visible": "Find when"}  # noqa: RUF012
    view = 1
    files = {"visible": "visible", "months": "visible", "days": "visible"}  # noqa: RUF012

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        return answers["seen"][{"visible": "table", "months": "months", "days": "by_day"}[name]]
