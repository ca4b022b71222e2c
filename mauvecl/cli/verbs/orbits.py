"""The verbs that look from the orbit: when targets are seen, and what a campaign would find."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import FLARE, OBSERVATION, SPECTRUM, flag, group
from mauvecl.cli.verb import takes_study
from mauvecl.cli.verbs.injections import SEARCH

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer
    from mauvecl.answers.campaigns.visible import VisibleAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


def _range(text: str) -> Any:
    """Two declinations, -46.4:31.8, or none."""
    from mauvecl.schema.errors import InputError
    from mauvecl.schema.text import shortened

    if text.strip().lower() == "none":
        return "none"
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise InputError(f"--declination {shortened(text)}, expected low:high in degrees, or none") from error
    return (low, high)


def _targets_of(path: Path) -> Any:
    from mauvecl.study.orbits import read_targets

    return read_targets(path)


#: Where from, when, and what must hold.
ORBIT = group(
    flag(str, "--start", "First day or time, UTC [2027-01-01].", "orbit.start"),
    flag(float, "--days", "How long, days [365].", "orbit.days"),
    flag(float, "--step", "Seconds between the times looked at [60].", "orbit.step_s"),
    flag(Path, "--tle", "File of two-line elements, newer than the embedded ones.", "orbit.tle"),
    flag(str, "--orbit", "tle, mean, or auto: mean far from the elements' epoch [auto].", "orbit.kind"),
    flag(bool, "--simbad", "Ask SIMBAD for other names (needs mauvecl[names]).", "orbit.simbad"),
    flag(str, "--earth-limb", "Least angle from the Earth's limb, deg, or none [25].", "orbit.limits.earth_limb_deg"),
    flag(str, "--sun", "Least angle from the Sun, deg, or none [46].", "orbit.limits.sun_deg"),
    flag(str, "--moon", "Least angle from the Moon, deg, or none [25].", "orbit.limits.moon_deg"),
    flag(
        str,
        "--declination",
        "Field of regard, low:high in deg, or none [-46.4:31.8].",
        "orbit.limits.declination_deg",
        _range,
    ),
    flag(str, "--eclipse", "any, only (in the Earth's shadow), or never [any].", "orbit.limits.eclipse"),
    flag(
        str,
        "--protons",
        "Largest flux of protons above 10 MeV, cm^-2 s^-1, or none [10].",
        "orbit.limits.proton_flux",
    ),
)
LOOKED_AT = group(flag(list[str], "--look-at", "Name, or coordinates '290.0 -11.2'; may be repeated.", "orbit.targets"))
TABLE = group(
    flag(
        Path,
        "--targets",
        "Table of targets (CSV, ECSV): name, and what is known of each.",
        "plan.targets",
        _targets_of,
    )
)
PLAN = group(
    flag(float, "--hours", "Of exposure for each target, at most [all].", "plan.hours"),
    SEARCH["false_alarms"],
    flag(str, "--completeness", "injections, or 'closed form' at once [injections].", "plan.completeness"),
    flag(str, "--report", "pdf or html [pdf].", "plan.report"),
    OBSERVATION["instrument"],
    OBSERVATION["temperature"],
    FLARE["flare_temperature"],
    FLARE["flare_band"],
    *SPECTRUM.values(),
)


@takes_study(LOOKED_AT, TABLE, observation=ORBIT, draws=False)
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


@takes_study(TABLE, PLAN, observation=ORBIT)
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
