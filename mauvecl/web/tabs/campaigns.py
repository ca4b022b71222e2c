"""Tabs of campaigns: visibility and plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.plan import COLUMNS
from mauvecl.charts.chart import Axis, Chart, ChartData, Targets
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.tabs.tab import Tab, target_words

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.answers.plan import PlanAnswer
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question

#: Ends of the axes, erg, the same for all questions.
ENERGIES = (1e28, 1e37)


def _energy(value: Any) -> str:
    """Format an energy for readers."""
    return f"{value.value:.2g} erg" if np.isfinite(value) else "no energy"


def _columns(answer: PlanAnswer) -> list[tuple[str, Any, Any, Any]]:
    """Return name, energies, recovered fraction at each, and flares above each in the campaign, of seen targets."""
    columns, table = [], answer.by_energy
    for star in answer.planned:
        # Beyond the pictures' ends there is nothing to see.
        rows = table[(np.asarray(table["target"]) == star.name) & (table["energy"].to_value("erg") <= ENERGIES[1])]
        above = np.asarray(rows["rate_above"].to_value("1 / h") * star.hours, float)
        columns.append((star.name, rows["energy"].to_value("erg"), np.asarray(rows["recovered"], float), above))
    return columns


ENERGY = Axis("bolometric energy of the flare (erg)", log=True, limits=ENERGIES)


@Chart(
    "recovered", "Share of flares that the search recovers", ENERGY, Axis("share recovered", limits=(-0.03, 1.05)),
    (Targets("recovered", tips=("share recovered",)),),
).data("plan", "The share of flares that are found on each target, against their energy.")  # fmt: skip
def recovered(closed: ClosedForms, answer: PlanAnswer) -> ChartData:
    """Return the fraction of flares that the search recovers against their energy."""
    parts = [
        f"{row['target']}: half of the flares at {_energy(row['E50'])}, 90 % at {_energy(row['E90'])}"
        if row["seen"] > 0
        else f"{row['target']} is never seen"
        for row in answer.table
    ]
    return ChartData(f"Recovered: {'; '.join(parts)}.", {"recovered": [columns[:3] for columns in _columns(answer)]})


@Chart(
    "expected", "Recovered flares above an energy, in the whole campaign", ENERGY,
    Axis("flares", log=True, limits=(1e-3, 1e4)), (Targets("found", tips=("recovered flares",)),),
).data("plan", "The number of flares expected to be found on each target.")  # fmt: skip
def expected(closed: ClosedForms, answer: PlanAnswer) -> ChartData:
    """Return the numbers of recovered flares above an energy."""
    lines, parts = [], []
    for row, (name, energy, recovered, above) in zip(answer.table, _columns(answer), strict=True):
        # Each step of the rate is recovered as at its middle.
        steps = (above[:-1] - above[1:]) * (recovered[:-1] + recovered[1:]) / 2
        flares = np.append(np.cumsum(steps[::-1])[::-1], 0.0) + (above[-1] * recovered[-1] if above.size else 0.0)
        lines.append((name, energy, np.where(flares > 0, flares, np.nan)[: energy.size]))
        number = f"{row['expected']:.3g} flares" if np.isfinite(row["expected"]) else "no rates are known"
        seen = f"{row['target']} in {short(row['hours'].value)} h: {number}"
        parts.append(seen if row["seen"] > 0 else f"{row['target']} is never seen")
    return ChartData(f"Expected to be recovered: {'; '.join(parts)}.", {"found": lines})


class Plan(Tab):
    """Tab of campaigns."""

    verb = "plan"
    about = (
        "What a campaign would find: hours, energies recovered, flares expected. Spectrum and flare rates are those of "
        "each target's type; completeness is in closed form, and assumptions have a table."
    )
    headline = False
    # The page has no star-time of a campaign's false alarms: one a month. Flares of all sizes are expected.
    never = ("false_alarms", "as_observed")
    pictures = (recovered, expected)
    files = dict.fromkeys(("plan", "stars", "energies", "assumptions"), "plan")

    def words(self, question: Question) -> str:
        """Return the targets, hours and days."""
        return f"{target_words(question)}, {question.hours:g} h each at most"

    def rows(self, closed: ClosedForms, answers: Answers) -> list[list[str]]:
        """Return the table of targets; before a plan, which columns it will have."""
        if "plan" in answers:
            return super().rows(closed, answers)
        names = [target["name"] for target in closed.question.targets] or ["each target"]
        headings = [column.heading for column in COLUMNS if column.heading]
        return [headings, *([name, *("·" for _ in headings[1:])] for name in names)]


@Chart(
    "hours", "Hours in which targets are seen, day by day", Axis(kind="dates"),
    Axis("hours in the day", limits=(-0.5, 24.5)), (Targets("hours", tips=("hours",)),),
).data()  # fmt: skip
def hours(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the daily hours of visibility."""
    question = closed.question
    names = [target["name"] for target in question.targets]
    if "visible" not in answers:
        text = "For each target, how many hours of each day it is seen."
        return ChartData(text, {"hours": [(name, [], []) for name in names]})
    table = answers["seen"]["by_day"]
    lines, parts = [], []
    for name in names:
        hours = np.asarray(table[np.asarray(table["target"]) == name]["hours"].to_value("h"))
        # Milliseconds, as browsers count time.
        days = (np.datetime64(question.start, "ms") + np.arange(hours.size) * np.timedelta64(1, "D")).astype(float)
        lines.append((name, days, hours))
        parts.append(
            f"{name} on {np.count_nonzero(hours)} of {hours.size} days, {short(float(hours.sum()))} h in all and "
            f"{hours.max():.3g} h on its best day"
        )
    return ChartData(f"From {question.start} on are seen: {'; '.join(parts)}.", {"hours": lines})


class Visibility(Tab):
    """Tab of the visibility."""

    verb, name, title = "visible", "visibility", "Visibility"
    about = "When the satellite can look at targets: clear of Earth, Sun, Moon and radiation."
    headline = False
    pictures = (hours,)
    answer = "visible"
    simulations = {"visible": "Find when"}  # noqa: RUF012
    view = 1
    files = {"visible": "visible", "months": "visible", "days": "visible"}  # noqa: RUF012

    def words(self, question: Question) -> str:
        """Return the targets and days."""
        return target_words(question)

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        return answers["seen"][{"visible": "table", "months": "months", "days": "by_day"}[name]]
