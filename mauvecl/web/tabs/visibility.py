"""Visibility of targets from the orbit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas, curves, target_names
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab, target_words

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question


class Hours(Picture):
    """Daily hours of visibility."""

    name, title = "hours", "Hours in which targets are seen, day by day"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "", "hours in the day", logs, x_axis_type="datetime", y_range=(-0.5, 24.5))
        canvas.targets("hours", "hours")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        question = closed.question
        names = [target["name"] for target in question.targets]
        if "visible" not in answers:
            text = "For each target, how many hours of each day it is seen."
            return PictureData(text, curves("hours", []), names=target_names(names))
        table = answers["seen"]["by_day"]
        found, parts = [], []
        for name in names:
            hours = np.asarray(table[np.asarray(table["target"]) == name]["hours"].to_value("h"))
            # Milliseconds, as browsers count time.
            days = (np.datetime64(question.start, "ms") + np.arange(hours.size) * np.timedelta64(1, "D")).astype(float)
            found.append((days, hours))
            parts.append(
                f"{name} on {np.count_nonzero(hours)} of {hours.size} days, {short(float(hours.sum()))} h in all and "
                f"{hours.max():.3g} h on its best day"
            )
        text = f"From {question.start} on are seen: {'; '.join(parts)}."
        return PictureData(text, curves("hours", found), names=target_names(names))


class Visibility(Tab):
    """Tab of the visibility."""

    verb, name, title = "visible", "visibility", "Visibility"
    about = "When the satellite can look at targets: clear of Earth, Sun, Moon and radiation."
    headline = False
    pictures = (Hours(),)
    answer = "visible"
    simulations = {"visible": "Find when"}  # noqa: RUF012
    view = 1
    files = {"visible": "visible", "months": "visible", "days": "visible"}  # noqa: RUF012

    def words(self, question: Question) -> str:
        """Return the targets and days."""
        return target_words(question)

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        return answers["seen"][{"visible": "table", "months": "months", "days": "by_day"}[name]]
