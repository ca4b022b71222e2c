"""The verb that injects flares into stares and searches for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.flags import SIZE
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study

#: Length of the stare unless a study or a flag gives one, s.
DAY_S = 86_400.0


@takes_study(
    "flare.temperature_k",
    "flare.band",
    "flare.geometry",
    "flare.photosphere_temperature_k",
    "flare.spectrum",
    "stare.duration_s",
    "stare.gaps",
    "stare.orbit_gap_s",
    "stare.thermal",
    "nuisances.usual",
    *SIZE,
    "search",
    "injections",
    "run.seed",
    "sweep",
    without="observation.exposure_s",
    defaults={"stare.duration_s": DAY_S},
)
def inject(study: Study, session: Session) -> None:
    """Find which flares a search detects: completeness, false alarms.

    Over energy (or amplitude) and half-width, with the errors of what is recovered.

    Flares are injected into drawn stares and searched for with a bank of filters. A stare of a day unless told.

    Examples: mauvecl inject --star G2V --magnitude 7.4 --distance 14.1 --false-alarms 1 --alarms-per month

    mauvecl inject --star M3V --magnitude 9 --orbit-gap 2100 --with-unknowns --sweep flare_temperature=7000,10000,15000
    """
    session.answer(session.ask(study))
