"""Campaign on a target: recovered and expected flares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms

#: Ends of the axes, erg, the same for all questions.
ENERGIES = (1e28, 1e37)


def _columns(answers: Answers) -> tuple[Any, Any, Any]:
    """Return energies, the recovered fraction at each, and the number of flares above it in the campaign."""
    table, (star,) = answers["plan"].by_energy, answers["plan"].planned
    columns = (table["energy"].to_value("erg"), table["recovered"], table["rate_above"].to_value("1 / h") * star.hours)
    energy, recovered, above = (np.asarray(column, float) for column in columns)
    return energy, recovered, above


def _energy(value: Any) -> str:
    """Format an energy for readers."""
    return f"{value.value:.2g} erg" if np.isfinite(value) else "no energy"


class Recovered(Picture):
    """Fraction of flares that the search recovers against their energy."""

    name, title = "recovered", "Share of flares that the search recovers"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        name = "bolometric energy of the flare (erg)"
        canvas = Canvas(ink, name, "share recovered", logs | {"x"}, x_range=ENERGIES, y_range=(-0.03, 1.05))
        curve = canvas.line("recovered", "share recovered", "flare", line_width=2)
        canvas.tooltips(curve, ("energy (erg)", "x"), ("recovered", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        if "plan" not in answers:
            text = "Nothing is planned yet: name a target under Advanced, such as eps Eri, and press Plan."
            return PictureData(text, {"recovered": {"x": [], "y": []}})
        (row,) = answers["plan"].table
        energy, recovered, _ = _columns(answers)
        half, most = (_energy(row[name]) for name in ("E50", "E90"))
        text = f"Of the flares of {row['target']} half are recovered at {half}, 90 % at {most}."
        return PictureData(text, {"recovered": {"x": energy, "y": recovered}})


class Expected(Picture):
    """Numbers of flares, and of recovered flares, above an energy."""

    name, title = "expected", "Flares of so much energy or more in the campaign"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        name = "bolometric energy of the flare (erg)"
        canvas = Canvas(ink, name, "flares", logs | {"x", "y"}, x_range=ENERGIES, y_range=(1e-3, 1e4))
        canvas.line("all", "all of them", "star", line_width=2)
        curve = canvas.line("found", "recovered", "flare", line_width=2)
        canvas.tooltips(curve, ("energy (erg)", "x"), ("recovered", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        if "plan" not in answers:
            return PictureData("Nothing is planned yet.", {name: {"x": [], "y": []} for name in ("all", "found")})
        (row,) = answers["plan"].table
        energy, recovered, above = _columns(answers)
        if not energy.size:
            text = f"{row['target']} is never seen within the limits on Earth, Sun, Moon and radiation."
            return PictureData(text, {name: {"x": [], "y": []} for name in ("all", "found")})
        # Each step of the rate is recovered as at its middle.
        parts = (above[:-1] - above[1:]) * (recovered[:-1] + recovered[1:]) / 2
        flares = np.append(np.cumsum(parts[::-1])[::-1], 0.0) + above[-1] * recovered[-1]
        text = f"{row['target']} is observed for {short(row['hours'].value)} h; "
        known = np.isfinite(row["expected"])
        text += f"{row['expected']:.3g} flares are expected to be recovered." if known else "no rates are known."
        columns = {"all": {"x": energy, "y": above}, "found": {"x": energy, "y": np.where(flares > 0, flares, np.nan)}}
        return PictureData(text, columns)


class Plan(Tab):
    """Tab of campaigns."""

    verb = "plan"
    about = (
        "What a campaign on the target of Visibility would find: hours, energies recovered, flares expected. Star and "
        "flare rates are the target's own; completeness is in closed form, and assumptions have a table."
    )
    pictures = (Recovered(), Expected())
    files = dict.fromkeys(("plan", "stars", "energies", "assumptions"), "plan")
