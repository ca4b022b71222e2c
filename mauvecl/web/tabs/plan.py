"""Campaign on targets: recovered and expected flares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.plan import COLUMNS
from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas, curves, target_names
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab, target_words

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question

#: Ends of the axes, erg, the same for all questions.
ENERGIES = (1e28, 1e37)


#: Columns of energies, with the recovered fraction at each and the number of flares above it in the campaign.
Columns = tuple[Any, Any, Any]


def _columns(answers: Answers) -> list[Columns]:
    """Return the columns of each visible target."""
    answer, found = answers["plan"], []
    table = answer.by_energy
    for star in answer.planned:
        # Beyond the pictures' ends there is nothing to see.
        rows = table[(np.asarray(table["target"]) == star.name) & (table["energy"].to_value("erg") <= ENERGIES[1])]
        above = rows["rate_above"].to_value("1 / h") * star.hours
        found.append((rows["energy"].to_value("erg"), np.asarray(rows["recovered"], float), np.asarray(above, float)))
    return found


def _energy(value: Any) -> str:
    """Format an energy for readers."""
    return f"{value.value:.2g} erg" if np.isfinite(value) else "no energy"


def _names(answers: Answers) -> list[str]:
    return [star.name for star in answers["plan"].planned]


class Recovered(Picture):
    """Fraction of flares that the search recovers against their energy."""

    name, title = "recovered", "Share of flares that the search recovers"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        name = "bolometric energy of the flare (erg)"
        canvas = Canvas(ink, name, "share recovered", logs | {"x"}, x_range=ENERGIES, y_range=(-0.03, 1.05))
        canvas.targets("recovered", "share recovered")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        if "plan" not in answers:
            return PictureData(
                "The share of flares that are found on each target, against their energy.", curves("recovered", [])
            )
        parts = [
            f"{row['target']}: half of the flares at {_energy(row['E50'])}, 90 % at {_energy(row['E90'])}"
            if row["seen"] > 0
            else f"{row['target']} is never seen"
            for row in answers["plan"].table
        ]
        found = [(energy, recovered) for energy, recovered, _ in _columns(answers)]
        text = f"Recovered: {'; '.join(parts)}."
        return PictureData(text, curves("recovered", found), names=target_names(_names(answers)))


class Expected(Picture):
    """Numbers of recovered flares above an energy."""

    name, title = "expected", "Recovered flares above an energy, in the whole campaign"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        name = "bolometric energy of the flare (erg)"
        canvas = Canvas(ink, name, "flares", logs | {"x", "y"}, x_range=ENERGIES, y_range=(1e-3, 1e4))
        canvas.targets("found", "recovered flares")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        if "plan" not in answers:
            return PictureData("The number of flares expected to be found on each target.", curves("found", []))
        found, parts = [], []
        for row, (energy, recovered, above) in zip(answers["plan"].table, _columns(answers), strict=True):
            # Each step of the rate is recovered as at its middle.
            steps = (above[:-1] - above[1:]) * (recovered[:-1] + recovered[1:]) / 2
            flares = np.append(np.cumsum(steps[::-1])[::-1], 0.0) + (above[-1] * recovered[-1] if above.size else 0.0)
            found.append((energy, np.where(flares > 0, flares, np.nan)[: energy.size]))
            known = np.isfinite(row["expected"])
            number = f"{row['expected']:.3g} flares" if known else "no rates are known"
            seen = row["seen"] > 0
            parts.append(
                f"{row['target']} in {short(row['hours'].value)} h: {number}"
                if seen
                else f"{row['target']} is never seen"
            )
        text = f"Expected to be recovered: {'; '.join(parts)}."
        return PictureData(text, curves("found", found), names=target_names(_names(answers)))


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
    pictures = (Recovered(), Expected())
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
