"""Command that searches for limits, with an option that varies the assumptions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session


@command_of("limit")
def limit(
    session: Session,
    assumptions: Annotated[
        bool, typer.Option("--assumptions", help="Also: how far what is assumed of the instrument moves it.")
    ] = False,
) -> None:
    """Search for limits, and vary the assumptions about the instrument if `assumptions` is set."""
    answer = session.ask()
    if assumptions:
        from mauvecl.answers.limits.assumptions import what_matters

        answer.assumptions = what_matters(session.study)
    session.answer(answer)
