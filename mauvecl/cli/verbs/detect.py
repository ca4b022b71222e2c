"""The verbs of detection: would these flares be seen, and how far is the usual formula to be trusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.flags import DETECTION, DRAWS, FEWER, NUISANCES, SIGNAL
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("flare", *DRAWS, *DETECTION, "campaign", *NUISANCES, "run.template_temperatures_k", "sweep")
def detect(
    study: Study,
    session: Session,
) -> None:
    """Tell whether flares would be seen: thresholds, probabilities.

    Without arguments: the paper's K3V star of V = 3.7 and G2V star of V = 7.4 with flares of 0.76, 2, 8.1 and 24 %,
    50 s, one million realisations.

    Example: mauvecl detect --star K5V --magnitude 6 --amplitude 0.05 --amplitude 0.1 --exposure 30
    """
    session.answer(session.ask(study))


@takes_study(*DRAWS, *DETECTION, *SIGNAL, "sweep", defaults=FEWER)
def gaussian(
    study: Study,
    session: Session,
) -> None:
    """Find where the usual root-of-N formula is wrong.

    Its S/N, its intervals and its false alarms, beside those of realisations.

    Without a sweep: magnitudes from 4 to 12, exposures of 5, 50 and 600 s.

    Example: mauvecl gaussian --star G2V --sweep magnitude=6,10 --sweep exposure=5,50
    """
    session.answer(session.ask(study))
