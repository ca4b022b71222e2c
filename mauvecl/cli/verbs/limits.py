"""The verbs that search and sweep: limits and maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl.cli.console import short
from mauvecl.cli.flags import DETECTION, DRAWS, FLARE, LIMIT, MAP, NUISANCES, SWEEP, UNKNOWN
from mauvecl.cli.verb import takes_study
from mauvecl.schema.tables import INTERVAL
from mauvecl.study.parts import First

if TYPE_CHECKING:
    from mauvecl.answers.detection.maps import MapResult
    from mauvecl.answers.limits.limits import Limit, LimitResult
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study

#: Unknowns whose shares of a scatter are shown, at most.
MOST_SHARES = 3


@takes_study(LIMIT, FLARE, DRAWS, DETECTION, NUISANCES, UNKNOWN, SWEEP)
def limit(
    study: Study,
    session: Session,
    assumptions: Annotated[
        bool, typer.Option("--assumptions", help="Also: how far what is assumed of the instrument moves it.")
    ] = False,
) -> None:
    """Limiting magnitude, smallest amplitude or shortest exposure.

    Of a star or flare that is seen with a wanted probability.

    Starts from the closed form, settles it by simulation, and simulates the answer again with a fresh seed.

    Example: mauvecl limit --star G2V --amplitude 0.24 --exposure 50
    """
    answer = session.ask(study)
    if assumptions:
        from mauvecl.answers.limits.assumptions import what_matters

        answer.assumptions = what_matters(study)
    session.answer(answer, lambda: _show_limits(answer))


def _show_limits(answer: LimitResult) -> None:
    from mauvecl.cli.console import show_table

    study = answer.study
    asked, run = study.limit, study.run
    swept = [axis.quantity for axis in study.sweep.axes if axis.quantity != "amplitude"]
    cells = []
    digits = {"magnitude": ".3f", "amplitude": ".4g", "exposure": ".0f"}[asked.of]
    sought = "exposure (s)" if asked.of == "exposure" else asked.of
    for one in answer.limits:
        p, value = one.check.probability, one.value
        flare = "" if asked.of == "amplitude" else f"{100 * one.amplitude:g} %"
        at = [short(v) for k, v in one.at.items() if k != "amplitude"]
        cells.append(
            (one.star, *at, flare, one.statistic, f"{value.value:{digits}}",
             f"[{value.low:{digits}}, {value.high:{digits}}]", f"{one.closed_form:{digits}}",
             f"{p.value:.4f}", f"[{p.low:.4f}, {p.high:.4f}]", one.verdict)
        )  # fmt: skip
    show_table(
        f"Limit of {asked.of} at a detection probability of {asked.power:g}, false-alarm probability {run.fap:g} per "
        f"test, {run.realisations:,} realisations",
        (
            "star",
            *swept,
            "flare",
            "statistic",
            sought,
            INTERVAL,
            "closed form",
            "detected there, simulated again",
            INTERVAL,
            "verdict",
        ),
        cells,
    )
    if study.unknowns.draws:
        show_table(
            f"Averaged over {study.unknowns.draws} draws of what is unknown of the instrument: the limits of each, and "
            "what explains their scatter",
            ("star", *swept, "flare", "statistic", "95 % of limits", "matters most, share of the variance"),
            [(*row[: 3 + len(swept)], *_unknown(one, digits)) for row, one in zip(cells, answer.limits, strict=True)],
        )
    if answer.assumptions is not None:
        show_table(
            f"What is assumed, and how far it moves the closed-form limit of {asked.of}, the largest first",
            ("star", "flare", "statistic", "assumption", "from", "to", "limit from", "to", "moves by"),
            [
                (m["star"], f"{100 * m['amplitude']:g} %", m["statistic"], m["assumption"], m["low_end"], m["high_end"],
                 f"{m['at_low_end']:.3f}", f"{m['at_high_end']:.3f}", f"{m['span']:.3f}")
                for m in answer.assumptions
            ],
        )  # fmt: skip


def _unknown(one: Limit, digits: str) -> tuple[str, str]:
    """The range of the limits over what is unknown, and the three unknowns that explain most of it."""
    assert one.unknown is not None
    low, high = one.unknown.range
    return f"{low:{digits}} to {high:{digits}}", _largest(one.unknown.shares)


def _largest(shares: Mapping[str, float]) -> str:
    """Return the first of the shares in words, and how many there are."""
    first = First(shares.items(), MOST_SHARES, "unknowns")
    note = f" ({first.note})" if first.note else ""
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in first) + note


@takes_study(MAP, FLARE, DRAWS, DETECTION, NUISANCES, UNKNOWN, name="map", fewer=True)
def detection_map(
    study: Study,
    session: Session,
) -> None:
    """Detection probability over two quantities, for one star.

    Quantities: magnitude, amplitude, flare_temperature, exposure, detector_temperature, sky, star. All cells are drawn
    with the same random numbers.

    Example: mauvecl map --star G2V --x magnitude:4:10:16 --y amplitude:0.01:1:16:log
    """
    answer = session.ask(study)
    session.answer(answer, lambda: _show_map(answer))


def _show_map(answer: MapResult) -> None:
    """The map as tables of percentages, one per statistic."""
    from mauvecl.cli.console import show, show_table

    study = answer.study

    def text(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.3g}"

    for statistic, parts in answer.shares.items():
        draws = f"{study.unknowns.draws} draws of what is unknown"
        show([f"{statistic}, averaged over {draws}: its scatter is from {_largest(parts)}."])
    corner = f"{study.map.y.quantity}, {study.map.x.quantity}"
    for statistic, probability in zip(answer.statistics, answer.probability, strict=True):
        rows = [(text(y), *(f"{100 * p:.0f}" for p in row)) for y, row in zip(answer.y, probability, strict=True)]
        show_table(
            f"{answer.star}: detection probability in percent, {statistic}, fap {study.run.fap:g} per test",
            (corner, *(text(x) for x in answer.x)),
            rows,
        )
