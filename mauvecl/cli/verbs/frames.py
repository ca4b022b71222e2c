"""The command that analyses observed frames: it has no device."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session


@command_of("analyse", draws=False)
def analyse(session: Session) -> None:
    """Find the flares in observed frames, with progress in frames."""
    from mauvecl.answers.observations.analyse import analyse as compute

    with session.metered("frames", "searching") as meter:
        answer = compute(session.study, progress=meter)
    session.answer(answer)
