"""The verbs that search and sweep: limits and maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl.cli.flags import DETECTION, DRAWS, FEWER, NUISANCES, UNKNOWN
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("limit", "flare", *DRAWS, *DETECTION, *NUISANCES, *UNKNOWN, "sweep")
def limit(
    study: Study,
    session: Session,
    assumptions: Annotated[
        bool, typer.Option("--assumptions", help="Also: how far what is assumed of the instrument moves it.")
    ] = False,
) -> None:
    """Find the limiting magnitude, smallest amplitude or exposure.

    Of a star or flare that is seen with a wanted probability.

    Starts from the closed form, settles it by simulation, and simulates the answer again with a fresh seed.

    Example: mauvecl limit --star G2V --amplitude 0.24 --exposure 50
    """
    answer = session.ask(study)
    if assumptions:
        from mauvecl.answers.limits.assumptions import what_matters

        answer.assumptions = what_matters(study)
    session.answer(answer)


@takes_study("map", "flare", *DRAWS, *DETECTION, *NUISANCES, *UNKNOWN, name="map", defaults=FEWER)
def detection_map(
    study: Study,
    session: Session,
) -> None:
    """Map the detection probability over two quantities, for one star.

    Quantities: magnitude, amplitude, flare_temperature, exposure, detector_temperature, sky, star. All cells are drawn
    with the same random numbers.

    Example: mauvecl map --star G2V --x magnitude:4:10:16 --y amplitude:0.01:1:16:log
    """
    session.answer(session.ask(study))
