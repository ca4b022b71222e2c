"""The verb of observed frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study("data", "search.false_alarms", "search.per", "run.seed", observation=(), draws=False)
def analyse(study: Study, session: Session) -> None:
    """Flares in observed frames, with their false alarms.

    Reads light curves of mauvecl, TESS and Kepler as they are, and other tables through a mapping (TOML). Nothing is
    deleted in silence: the table of frames states why a frame is not searched.

    Example: mauvecl analyse light-curve-1.fits --false-alarms 1 --alarms-per month
    """
    session.answer(session.ask(study))
