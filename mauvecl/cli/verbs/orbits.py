"""The command that plans campaigns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session


@command_of("plan")
def plan(session: Session) -> None:
    """Plan a campaign; a report needs matplotlib for PDF, and a closed form needs no pool."""
    from mauvecl.answers.campaigns.plan import plan as compute
    from mauvecl.pictures.style import available

    if session.study.plan.report == "pdf" and not available():
        session.study = session.study.with_settings(["plan.report=html"])
        session.say(["The report is HTML: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
    if session.study.plan.completeness == "closed form":
        with session.metered("targets") as meter:
            answer = compute(session.study, progress=meter)
    else:
        answer = session.ask()
    session.answer(answer)
