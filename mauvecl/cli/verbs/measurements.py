"""The verb that measures flares."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.flags import NUISANCES, SIZE, STARE
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.answers.measurements.measure import MeasureAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("flare", "measure", *STARE, *NUISANCES, *SIZE, "run.fap", "run.seed", "sweep")
def measure(study: Study, session: Session) -> None:
    """What would be measured of a flare's spectrum, and how well.

    Temperature, area, energy, Balmer jump and lines: errors in advance, simulated fits with the coverage of their
    intervals, the same for flares that a search detects, and what a too simple model makes of the flare.

    Examples: mauvecl measure --star M3V -m 9 -a 0.5 --balmer-jump 2 --nuisance dark=free --nuisance light=free

    mauvecl measure --star M3V --magnitude 9 --amplitude 0.5 --sweep exposure=50,300 --distance 5 --radius 0.4

    mauvecl measure --star M3V --magnitude 9 --amplitude 2 --snr-per-bin 20 --hours 0.5 --distance 5
    """
    answer = session.ask(study)
    session.answer(answer, lambda: _show(answer))


def _show(answer: MeasureAnswer) -> None:
    from mauvecl.cli.console import short, show_table, show_view

    cells = []
    shown = ("truth", "error_known", "error", "perfect", "bias", "scatter")
    for one in answer.flares:
        for row in one.rows():
            if row["unit"] == "erg / s":
                continue
            cells.append(
                (one.label, *map(short, one.at.values()), f"{100 * one.amplitude:g} %", one.model, row["quantity"],
                 row["unit"], *(f"{row[name]:.4g}" for name in shown),
                 f"{100 * row['coverage_95']:.1f} %", f"{100 * row['coverage_95_selected']:.1f} %",
                 f"{100 * row['one_sided']:.0f} %")
            )  # fmt: skip
    swept = tuple(axis.quantity for axis in answer.study.sweep.axes)
    show_table(
        f"Measured in one exposure; {answer.study.measure.fits} simulated fits of each flare",
        ("star", *swept, "flare", "model", "quantity", "unit", "truth", "error, all known", "error",
         "fit without noise", "bias", "scatter", "95 % covers", "if detected", "one-sided"),
        cells,
    )  # fmt: skip
    for view in answer.views:
        show_view(view)
    show_table(
        "Goodness of fit",
        ("star", *swept, "flare", "model", "S/N, all known", "S/N", "chi-squared", "of", "p < 0.01", "detected"),
        [
            (one.label, *map(short, one.at.values()), f"{100 * one.amplitude:g} %", one.model, f"{row['snr']:.2f}",
             f"{row['snr_marginal']:.2f}", f"{row['chi2']:.1f}", str(row["dof"]), f"{100 * row['rejected']:.1f} %",
             f"{100 * row['detected']:.1f} %")
            for one in answer.flares for row in one.quality()
        ],
    )  # fmt: skip
