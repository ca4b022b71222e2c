"""The verbs of detection: would these flares be seen, and how far is the usual formula to be trusted."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from mauvecl.cli.console import short
from mauvecl.cli.flags import CAMPAIGN, COUNTED, DETECTION, DRAWS, FLARE, NUISANCES, SWEEP, TEMPLATE
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.answers.detection.gaussian import GaussianReport
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study(FLARE, DRAWS, DETECTION, CAMPAIGN, NUISANCES, TEMPLATE, SWEEP)
def detect(
    study: Study,
    session: Session,
) -> None:
    """Whether these flares would be seen: thresholds, probabilities.

    Without arguments: the paper's K3V star of V = 3.7 and G2V star of V = 7.4 with flares of 0.76, 2, 8.1 and 24 %,
    50 s, one million realisations.

    Example: mauvecl detect --star K5V --magnitude 6 --amplitude 0.05 --amplitude 0.1 --exposure 30
    """
    session.answer(session.ask(study))


@takes_study(DRAWS, DETECTION, COUNTED, SWEEP, fewer=True)
def gaussian(
    study: Study,
    session: Session,
) -> None:
    """Where the usual root-of-N formula is wrong.

    Its S/N, its intervals and its false alarms, beside those of realisations.

    Without a sweep: magnitudes from 4 to 12, exposures of 5, 50 and 600 s.

    Example: mauvecl gaussian --star G2V --sweep magnitude=6,10 --sweep exposure=5,50
    """
    answer = session.ask(study)
    session.answer(answer, lambda: _show_promises(answer))


def _show_promises(answer: GaussianReport) -> None:
    from mauvecl.cli.console import show_table

    study = answer.study
    swept = [axis.quantity for axis in answer.study.sweep.axes]
    show_table(
        f"The root-of-N formula beside {study.run.realisations:,} realisations; promised: no difference in S/N, "
        f"68.3 % of 1-sigma intervals, as many 5-sigma pixels and false alarms ({study.run.fap:g}) as normal noise has",
        ("star", *swept, "best S/N", "S/N off by", "at nm", "1-sigma intervals", "5 sigma above, below", "false alarms",
         "statistic", "why", "detection off by"),
        [
            (row["star"], *(short(row[name]) for name in swept), f"{row['best_snr']:.2f}",
             f"{row['snr_off_by']:+.3f}", "" if math.isnan(row["at_nm"]) else f"{row['at_nm']:.0f}",
             f"{100 * row['coverage_low']:.2f}-{100 * row['coverage_high']:.2f} %",
             f"{row['five_sigma_above']:.2f}, {row['five_sigma_below']:.2f}",
             f"{row['fap_ratio']:.3f}",
             row["statistic"], row["why"], f"{row['probability_off_by']:+.4f}")
            for row in answer.cells
        ],
    )  # fmt: skip
