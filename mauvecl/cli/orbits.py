"""The verbs that look from the orbit: when targets are seen, and what a campaign would find."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mauvecl.cli.flags import FLARE, OBSERVATION, Option, takes_study
from mauvecl.cli.injections import SEARCH

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer
    from mauvecl.answers.campaigns.visible import VisibleAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


def _range(text: str) -> Any:
    """Two declinations, -46.4:31.8, or none."""
    from mauvecl.host.errors import InputError
    from mauvecl.host.files.bounded import shortened

    if text.strip().lower() == "none":
        return "none"
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise InputError(f"--declination {shortened(text)}, expected low:high in degrees, or none") from error
    return (low, high)


def _flag(kind: Any, *names: str, text: str) -> Any:
    return Annotated[kind | None, typer.Option(*names, help=text, show_default=False)]


#: Where from, when, and what must hold.
ORBIT = {
    "start": Option(_flag(str, "--start", text="First day or time, UTC [2027-01-01]."), "orbit", "start"),
    "days": Option(_flag(float, "--days", text="How long, days [365]."), "orbit", "days"),
    "step": Option(_flag(float, "--step", text="Seconds between the times looked at [60]."), "orbit", "step_s"),
    "tle": Option(
        _flag(Path, "--tle", text="File of two-line elements, newer than the embedded ones."), "orbit", "tle"
    ),
    "orbit": Option(
        _flag(str, "--orbit", text="tle, mean, or auto: mean far from the elements' epoch [auto]."), "orbit", "kind"
    ),
    "simbad": Option(_flag(bool, "--simbad", text="Ask SIMBAD for other names (mauvecl[names])."), "orbit", "simbad"),
    "earth_limb": Option(
        _flag(str, "--earth-limb", text="Least angle from the Earth's limb, deg, or none [25]."),
        "orbit.limits", "earth_limb_deg",
    ),
    "sun": Option(
        _flag(str, "--sun", text="Least angle from the Sun, deg, or none [46]."), "orbit.limits", "sun_deg"
    ),
    "moon": Option(
        _flag(str, "--moon", text="Least angle from the Moon, deg, or none [25]."), "orbit.limits", "moon_deg"
    ),
    "declination": Option(
        _flag(str, "--declination", text="Field of regard, low:high in deg, or none [-46.4:31.8]."),
        "orbit.limits", "declination_deg", _range,
    ),
    "eclipse": Option(
        _flag(str, "--eclipse", text="any, only (in the Earth's shadow), or never [any]."), "orbit.limits", "eclipse"
    ),
    "protons": Option(
        _flag(str, "--protons", text="Largest flux of protons above 10 MeV, cm^-2 s^-1, or none [10]."),
        "orbit.limits", "proton_flux",
    ),
}  # fmt: skip
TARGETS = {
    "target": Option(
        _flag(list[str], "--look-at", text="Name, or coordinates '290.0 -11.2'; may be repeated."),
        "orbit", "targets",
    ),
}  # fmt: skip


def _targets_of(path: Path) -> Any:
    from mauvecl.study.orbits import read_targets

    return read_targets(path)


TABLE = {
    "targets": Option(
        _flag(Path, "--targets", text="Table of targets (CSV, ECSV): name, and what is known of each."),
        "plan", "targets", _targets_of,
    ),
}  # fmt: skip

PLAN = {
    "hours": Option(_flag(float, "--hours", text="Of exposure for each target, at most [all]."), "plan", "hours"),
    "false_alarms": SEARCH["false_alarms"],
    "completeness": Option(
        _flag(str, "--completeness", text="injections, or 'closed form' at once [injections]."), "plan", "completeness"
    ),
    "report": Option(_flag(str, "--report", text="pdf or html [pdf]."), "plan", "report"),
    "instrument": OBSERVATION["instrument"],
    "temperature": OBSERVATION["temperature"],
    "flare_temperature": FLARE["flare_temperature"],
    "flare_band": FLARE["flare_band"],
}


@takes_study(TARGETS, TABLE, observation=ORBIT, draws=False)
def visible(study: Study, session: Session) -> None:
    """When targets can be seen: windows, hours by day and month, the Sun's distance, zodiacal light, a calendar.

    Example: mauvecl visible --look-at "eps Eri" --look-at "AU Mic" --start 2027-01-01 --days 365
    """
    from mauvecl.answers.campaigns.visible import visible as compute

    found = compute(study)
    session.answer(found, lambda: _show_visible(found))


def _show_visible(found: VisibleAnswer) -> None:
    from mauvecl.cli.console import show_table

    table = found.table
    show_table(
        f"Seen in {found.moments.days:g} days from {found.moments.iso(0.0)} UTC",
        ("target", "RA", "dec", "hours", "share", "windows", "median", "longest gap", "least elongation", "best month"),
        [
            (str(row["target"]), f"{row['ra'].value:.3f}", f"{row['dec'].value:.3f}", f"{row['hours'].value:.0f}",
             f"{100 * row['share']:.1f} %", str(row["windows"]), f"{row['median_window'].value:.0f} min",
             f"{row['longest_gap'].value:.1f} d", f"{row['least_elongation'].value:.0f} deg", str(row["best_month"]))
            for row in table
        ],
    )  # fmt: skip
    months = found.months
    if len(found.targets) <= 12:
        show_table(
            "Hours of exposure by month",
            ("target", *(str(name) for name in months["month"])),
            [(one.name, *(f"{value.value:.0f}" for value in months[one.name])) for one in found.targets],
        )


@takes_study(TABLE, PLAN, observation=ORBIT, draws=False)
def plan(study: Study, session: Session) -> None:
    """A campaign: hours, energies from which flares are recovered, flares expected, false alarms; a report.

    The table has a column name, and what is known of each star: ra and dec, V, spectral_type, distance_pc, mass_msun
    and age_myr, or other rates of flares. Stars of the embedded list need their names only.

    Example: mauvecl plan targets.csv --hours 200 --start 2027-01-01
    """
    from mauvecl.answers.campaigns.plan import plan as compute
    from mauvecl.pictures.style import available

    if study.plan.report == "pdf" and not available():
        study = study.with_settings(["plan.report=html"])
        session.say(["The report is HTML: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
    with session.metered("targets") as meter:
        found = compute(study, progress=meter)
    session.answer(found, lambda: _show_plan(found))


def _show_plan(found: PlanAnswer) -> None:
    from mauvecl.answers.campaigns.plan_text import SUMMARY, heading, summary_rows
    from mauvecl.cli.console import show_table

    show_table(heading(found), SUMMARY, summary_rows(found))
