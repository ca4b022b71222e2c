"""The command that draws one observation; the number of the realisation is an option."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session


@command_of("simulate")
def simulate(
    session: Session,
    given: dict[str, Any],
    realisation: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Which realisation to show.")] = 0,
) -> None:
    """Draw a realisation, with flares if a flag names their amplitude."""
    from mauvecl.answers.signal.simulate import simulate as compute

    session.answer(compute(session.study, realisation=realisation, flaring=bool(given["amplitude"])))
