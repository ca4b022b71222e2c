"""The two numbers of the card, with everything known and with the usual unknowns, and the limit with each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mauvecl.answers.detection.unknown_cost import unknown_cost
from mauvecl.answers.limits.search import LimitSearch
from mauvecl.schema.errors import InputError
from mauvecl.web.closed_forms import ClosedForms, between, percent, short
from mauvecl.web.fields import FIELDS, UNKNOWN, Choice
from mauvecl.web.simulations import OTHER

if TYPE_CHECKING:
    from mauvecl.answers.detection.detect import DetectAnswer
    from mauvecl.web.tabs.tab import Answers

#: Labels of the choices of the field "unknown".
TITLES = dict(zip(UNKNOWN, ("everything known", "usual unknowns"), strict=True))
#: Sensible relative uncertainty of the nominal throughput (assumed; see the documentation's page on what is nominal).
THROUGHPUT = 0.3


@dataclass(frozen=True, eq=False)
class Chance:
    """Chance of detection under one assumption of what is unknown."""

    unknown: str  # choice of the field
    value: float  # NaN if there is none
    how: str  # whether it is a closed form or simulated, and its interval; or the reason why there is none

    @property
    def shown(self) -> dict[str, Any]:
        """The number as the card shows it."""
        return {
            "unknown": self.unknown,
            "title": TITLES[self.unknown],
            "shown": percent(self.value),
            "value": None if self.value != self.value else self.value,
            "interval": self.how,
        }


def chances(closed: ClosedForms, answers: Answers) -> list[Chance]:
    """Return the chance for each choice of what is unknown, simulated if it is among the answers."""
    found = []
    for unknown in UNKNOWN:
        try:
            assumed = closed.assuming(unknown)
            simulated = _simulated(assumed, answers.get("detection" if assumed is closed else OTHER))
            one = simulated or Chance(unknown, assumed.chance, f"in closed form{_spread(assumed)}")
        except InputError as error:
            if unknown == closed.question.unknown:
                raise
            one = Chance(unknown, float("nan"), str(error).partition(", expected ")[0])
        found.append(one)
    return found


def _simulated(assumed: ClosedForms, answer: DetectAnswer | None) -> Chance | None:
    if answer is None:
        return None
    question = assumed.question
    (row,) = (row for row in answer.table if row["statistic"] == question.statistic)
    number = f"{question.realisations.number:,}"
    return Chance(
        question.unknown, float(row["probability"]), f"{between(row['low'], row['high'])}, of {number} simulated"
    )


def _spread(closed: ClosedForms) -> str:
    """Describe the effect of the throughput's uncertainty on a chance, where that is computed at once."""
    if closed.study.nuisances.usual or closed.slow or closed.chance != closed.chance:
        return ""
    ends = [odds.probability for much in (-1, 1) for odds in closed.at(1 + much * THROUGHPUT, np.ones(1), sky=True)]
    return f"; {between(min(ends), max(ends))} if the throughput is {100 * THROUGHPUT:g} % lower or higher"


class Wording(NamedTuple):
    """Words for a limit."""

    before: str  # text before its value
    value: Callable[[float], str]
    none: str  # for a limit that does not exist
    slow: str  # for a limit whose closed form is slow


#: Words for limits by their quantity.
LIMITS = {
    "amplitude": Wording(
        "of at least", lambda value: f"{short(100 * value)} %", "of no amplitude",
        "of an amplitude that takes a simulation",
    ),
    "magnitude": Wording(
        "to {band} =", lambda value: f"{value:.2f}", "at no magnitude", "to a magnitude that takes a simulation",
    ),
    "exposure": Wording(
        "in", lambda value: f"{short(value)} s", "in no exposure", "in an exposure that takes a simulation"
    ),
}  # fmt: skip


def solved(closed: ClosedForms) -> str:
    """Return a sentence on the limit of the quantity that the question solves for, with and without unknowns."""
    q, asked = closed.question, closed.study.limit
    words = LIMITS[asked.of]
    clauses, near = [], None
    for unknown in UNKNOWN:
        try:
            assumed = closed.assuming(unknown)
            near = None if assumed.slow else _limit(assumed, near)
            clauses.append(words.slow if near is None else f"{words.before.format(band=q.band)} {words.value(near)}")
        except InputError:
            clauses.append(words.none)
    flares = "flares" if asked.of == "amplitude" else f"flares of {q.amplitude_percent:g} %"
    at = "" if asked.of == "magnitude" else f" at {q.band} = {q.magnitude:g}"
    first, second = clauses
    # The size belongs to the flares, what is exposed to their detection.
    where = f" {first}{at} are detected" if asked.of == "amplitude" else f"{at} are detected {first}"
    return f"{100 * asked.power:g} % of {flares}{where} with everything known, and {second} with the usual unknowns."


def _limit(assumed: ClosedForms, known: float | None) -> float:
    """Return the limit in closed form, as `mauvecl limit` finds it; faster with the limit if everything is known."""
    search, near = LimitSearch(assumed.case, assumed.question.statistic), None
    if known is not None and search.of != "exposure":
        nuisances, compared = assumed.study.nuisances, assumed.study.run.comparison()
        cost = unknown_cost("", assumed.quiet, assumed.flare, nuisances, compared)
        # Where dark noise dominates, the S/N is proportional to the light.
        loss = cost.known / cost.marginal if cost.marginal else 1.0
        near = known * loss if search.of == "amplitude" else known - 2.5 * math.log10(loss)
    return search.root(near)


def other_payloads(closed: ClosedForms) -> str:
    """Return a sentence on the chances with other payloads than the question's."""
    clauses, payloads = [], FIELDS["instrument"].read
    assert isinstance(payloads, Choice)
    for name in payloads.options:
        if name != closed.question.instrument:
            shown = []
            for unknown in UNKNOWN:
                try:
                    shown.append(percent(closed.assuming(unknown, instrument=name).chance))
                except InputError:
                    shown.append("no number")
            clauses.append(f"Chances with {name}: {' and '.join(shown)}.")
    return " ".join(clauses)
