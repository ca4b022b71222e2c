"""The command that plans campaigns: its report and its closed form have needs of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import command_of

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@command_of("plan")
def plan(study: Study, session: Session) -> None:
    """Plan a campaign; a report needs matplotlib for PDF, and a closed form needs no pool."""
    from mauvecl.answers.campaigns.plan import plan as compute
    from mauvecl.pictures.style import available

    if study.plan.report == "pdf" and not available():
        study = study.with_settings(["plan.report=html"])
        session.say(["The report is HTML: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
    if study.plan.completeness == "closed form":
        with session.metered("targets") as meter:
            answer = compute(study, progress=meter)
    else:
        answer = session.ask(study)
    session.answer(answer)
