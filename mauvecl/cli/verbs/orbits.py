"""Verbs of the orbit: when targets are visible, and what a campaign would find."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


#: Keys of the orbit that both verbs take; targets are given in a way of their own.
ORBIT = (
    *(f"orbit.{key}" for key in ("start", "days", "step_s", "tle", "kind", "simbad")),
    "orbit.limits",
)


@takes_study("orbit.targets", "plan.targets", observation=ORBIT, draws=False)
def visible(study: Study, session: Session) -> None:
    """Find when targets can be seen from the orbit.

    Windows, hours by day and month, the Sun's distance, zodiacal light, a calendar.

    Example: mauvecl visible --look-at "eps Eri" --look-at "AU Mic" --start 2027-01-01 --days 365
    """
    session.answer(session.ask(study))


@takes_study(
    "plan",
    "search.false_alarms",
    "observation.instrument",
    "observation.temperature_c",
    "flare.temperature_k",
    "flare.band",
    "flare.spectrum",
    observation=ORBIT,
)
def plan(study: Study, session: Session) -> None:
    """Plan a campaign: hours, expected flares, false alarms; a report.

    The table has a column name, and what is known of each star: ra and dec, V, spectral_type, distance_pc, mass_msun
    and age_myr, or other rates of flares. Stars of the embedded list need their names only.

    Example: mauvecl plan targets.csv --hours 200 --start 2027-01-01
    """
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
