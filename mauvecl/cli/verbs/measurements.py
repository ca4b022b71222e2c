"""The verb that measures flares."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.flags import NUISANCES, SIZE, STARE
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("flare", "measure", *STARE, *NUISANCES, *SIZE, "run.fap", "run.seed", "sweep")
def measure(study: Study, session: Session) -> None:
    """Measure simulated spectra of flares, and how well that works.

    Temperature, area, energy, Balmer jump and lines: errors in advance, simulated fits with the coverage of their
    intervals, the same for flares that a search detects, and what a too simple model makes of the flare.

    Examples: mauvecl measure --star M3V -m 9 -a 0.5 --balmer-jump 2 --nuisance dark=free --nuisance light=free

    mauvecl measure --star M3V --magnitude 9 --amplitude 0.5 --sweep exposure=50,300 --distance 5 --radius 0.4

    mauvecl measure --star M3V --magnitude 9 --amplitude 2 --snr-per-bin 20 --duration 1800 --distance 5
    """
    session.answer(session.ask(study))
