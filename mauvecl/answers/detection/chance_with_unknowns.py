"""Chance of detection with the usual unknowns, next to answers that assume that everything but the noise is known."""

from __future__ import annotations

from collections.abc import Sequence

from mauvecl.answers.detection.unknown_cost import spoken
from mauvecl.detection.statistics import Matched
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.study.cases import Case
from mauvecl.study.nuisances import NuisanceChoice

#: Kind of the message.
BOTH_CHANCES = "chance with unknowns"
#: Largest number of flares of which the most uncertain is looked for.
MAX_FLARES = 100


def chance_with_unknowns(prepared: Sequence[Case]) -> list[str]:
    """Return a sentence on the chance with and without the usual unknowns, or none if the study has unknowns.

    The flare is the one whose chance is nearest to one half; others are detected, or missed, either way.
    """
    study = prepared[0].study
    if study.nuisances != NuisanceChoice() or study.run.comparison().estimated:
        return []
    flares = [(case, flare) for case in prepared for flare in range(len(case.amplitudes))][:MAX_FLARES]
    known = {item: chance for item in flares if (chance := _chance(*item)) is not None}
    if not known:
        return []
    case, flare = min(known, key=lambda item: abs(known[item] - 0.5))
    of = f"{case.label}, flare of {100 * case.amplitudes[flare]:g} %"
    try:
        unknown = _chance(case.with_sections(nuisances=NuisanceChoice(usual=True)), flare)
    except InputError as error:
        # Too few pixels are left.
        return [Message(f"The usual unknowns cannot be taken into account for {of}: {error}.", BOTH_CHANCES)]
    if unknown is None:
        return []
    text = (
        f"Everything but the noise is taken as known: {of} is then detected by the matched statistic with a chance of "
        f"{100 * known[case, flare]:.1f} %, with the usual unknowns of {100 * unknown:.1f} % (closed forms; "
        f"`nuisances.usual` draws them). These are {spoken(NuisanceChoice(usual=True))}."
    )
    return [Message(text, BOTH_CHANCES)]


def _chance(case: Case, flare: int) -> float | None:
    """Return the closed-form chance of a flare by the matched statistic, or None if everything saturates."""
    peak = case.flares[flare]
    setting = case.setting(case.quiet, peak)
    if not setting.used.any() or peak.saturated[setting.used].all():
        return None
    return Matched().detection_forms(setting, peak, case.study.run.fap).probability
