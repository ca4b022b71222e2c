"""The verbs that look from the orbit: when targets are seen, and what a campaign would find."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer
    from mauvecl.answers.campaigns.visible import VisibleAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


#: Keys of the orbit that both verbs take; targets are given in a way of their own.
ORBIT = (
    *(f"orbit.{key}" for key in ("start", "days", "step_s", "tle", "kind", "simbad")),
    "orbit.limits",
)


@takes_study("orbit.targets", "plan.targets", observation=ORBIT, draws=False)
def visible(study: Study, session: Session) -> None:
    """When targets can be seen from the orbit.

    Windows, hours by day and month, the Sun's distance, zodiacal light, a calendar.

    Example: mauvecl visible --look-at "eps Eri" --look-at "AU Mic" --start 2027-01-01 --days 365
    """
    answer = session.ask(study)
    session.answer(answer, lambda: _show_visible(answer))


def _show_visible(answer: VisibleAnswer) -> None:
    from mauvecl.cli.console import show_table

    table = answer.table
    show_table(
        f"Seen in {answer.times.days:g} days from {answer.times.iso(0.0)} UTC",
        ("target", "RA", "dec", "hours", "share", "windows", "median", "longest gap", "least elongation", "best month"),
        [
            (str(row["target"]), f"{row['ra'].value:.3f}", f"{row['dec'].value:.3f}", f"{row['hours'].value:.0f}",
             f"{100 * row['share']:.1f} %", str(row["windows"]), f"{row['median_window'].value:.0f} min",
             f"{row['longest_gap'].value:.1f} d", f"{row['least_elongation'].value:.0f} deg", str(row["best_month"]))
            for row in table
        ],
    )  # fmt: skip
    months = answer.months
    if len(answer.targets) <= 12:
        show_table(
            "Hours of exposure by month",
            ("target", *(str(name) for name in months["month"])),
            [(one.name, *(f"{value.value:.0f}" for value in months[one.name])) for one in answer.targets],
        )


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
    """A campaign: hours, flares expected, false alarms; a report.

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
    session.answer(answer, lambda: _show_plan(answer))


def _show_plan(answer: PlanAnswer) -> None:
    from mauvecl.answers.campaigns.plan_text import SUMMARY, heading, summary_rows
    from mauvecl.cli.console import show_table

    show_table(heading(answer), SUMMARY, summary_rows(answer))
