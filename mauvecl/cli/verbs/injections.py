"""The verb that injects flares into stares and searches for them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import DRAWS, FLARE, SHAPES, SIZE, SPECTRUM, STARE, SWEEP, flag, group
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study

#: Length of the stare where nobody tells, s.
DAY_S = 86_400.0

SEARCH = group(
    flag(float, "--false-alarms", "Of the search, per star-day, -month or -year [1].", "search.false_alarms"),
    flag(str, "--alarms-per", "day, month or year, of frames [month].", "search.per"),
    flag(str, "--shape", SHAPES, "search.shape"),
)
INJECTIONS = group(
    flag(int, "--injections -n", "Of each size and half-width [2000].", "injections.count"),
    flag(
        str,
        "--size",
        "amplitude, duration, energy or band_energy [energy if the star's size is known, else amplitude].",
        "injections.of",
    ),
    flag(float, "--smallest", "Smallest size [0.3 of what is found].", "injections.low"),
    flag(float, "--largest", "Largest size [3 times what is found].", "injections.high"),
)
#: What it takes of a stare: not the flares in it.
LOOKED = {name: STARE[name] for name in ("gap", "orbit_gap", "thermal", "with_unknowns")} | group(
    flag(float, "--duration", f"Of the stare, s [{DAY_S:.0f}, a day; or the study's].", "stare.duration_s")
)


def _day(_: dict[str, Any]) -> Study:
    from mauvecl.study.stare_section import StareQuestion
    from mauvecl.study.study import Study

    return Study(stare=StareQuestion(duration_s=DAY_S))


@takes_study(
    {name: FLARE[name] for name in ("flare_temperature", "flare_band", "geometry", "photosphere_temperature")}
    | SPECTRUM,
    LOOKED,
    SIZE,
    SEARCH,
    INJECTIONS,
    {"seed": DRAWS["seed"]},
    SWEEP,
    without="exposure",
    default=_day,
)
def inject(study: Study, session: Session) -> None:
    """Which flares a search would find: completeness, false alarms.

    Over energy (or amplitude) and half-width, with the errors of what is recovered.

    Flares are injected into drawn stares and searched for with a bank of filters. A stare of a day unless told.

    Examples: mauvecl inject --star G2V --magnitude 7.4 --distance 14.1 --false-alarms 1 --alarms-per month

    mauvecl inject --star M3V --magnitude 9 --orbit-gap 2100 --with-unknowns --sweep flare_temperature=7000,10000,15000
    """
    session.answer(session.ask(study))
