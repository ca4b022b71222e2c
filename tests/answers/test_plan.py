"""Plans and visibility: numbers of the report are in tables and follow from others; what is missing is reported."""

import html
import re
from itertools import product
from pathlib import Path
from typing import Any

import icalendar
import numpy as np
import pytest
from astropy.table import QTable, Table
from commands import run
from scenes import paper
from scipy import stats
from tables import toml

from mauvecl import Study, plan, stare, visible
from mauvecl.search import completeness

TARGETS = toml("studies/targets.toml")["targets"]
TARGET_NAMES = tuple(one["name"] for one in TARGETS)


# Injections take ten seconds a target.
ASKED = {"completeness": "closed form", "targets": TARGETS, "hours": 120.0, "report": "html"}
STUDY = Study().paper().with_changes({"plan": ASKED, "orbit": {"days": 60.0}}, None)


@pytest.fixture(scope="module")
def answer() -> Any:
    return plan(STUDY)


def test_plan_numbers_are_consistent_and_missing_ones_are_told(answer: Any) -> None:
    """Compute flares, their interval and false alarms from the tables of hours, rates and shares alone."""
    table, stars, energies = answer.table, answer.stars, answer.by_energy
    for k, name in enumerate(table["target"][:2]):
        mine = energies[energies["target"] == name]
        energy, share, above = (mine[one].value for one in ("energy", "recovered", "rate_above"))
        middle = np.interp(np.log10(np.sqrt(energy[1:] * energy[:-1])), np.log10(energy), share)
        per_day = np.sum((above[:-1] - above[1:]) * middle) + above[-1] * share[-1]
        assert stars["recovered_per_day"][k] == pytest.approx(per_day, rel=0.01)
        assert table["expected"][k] == pytest.approx(per_day * table["hours"][k].value / 24, rel=0.01)
        assert np.interp(np.log10(table["E50"][k].value), np.log10(energy), share) == pytest.approx(0.5, abs=1e-6)
        assert table["low"][k] < table["expected"][k] < table["high"][k]
        days = answer.days[(answer.days["target"] == name) & (answer.days["hours"].value > 0)]
        assert stars["sky"][k].value == pytest.approx(np.nanmedian(days["zodiacal_light"].value), abs=1e-9)
    assert table["false_alarms"].tolist() == pytest.approx((table["hours"].value / 24 / (365.25 / 12)).tolist())
    assert answer.seen.table["hours"].value == pytest.approx(table["seen"].value)
    reported = " ".join(answer.messages)
    assert "Flare rates of Denebola, of the type 'A3V', are unknown except for an exponent of 1.3" in reported
    assert "EK Dra is never seen" in reported
    assert "the hours of different targets may coincide" in reported
    assert answer.headline.endswith(", the most of 3 targets with known flare rates.")
    assert np.isnan(table["expected"][2])
    assert np.isfinite(table["E50"][2].value)
    assert table["expected"][3] == 0
    assert table["at_least_one"][3] == 0
    assert np.isinf(table["E50"][3].value)


#: Numbers in a text, but not those in names such as K5V or HD 209458.
NUMBER = re.compile(r"(?<![\w.^])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w])")


def printed(token: str, values: list[float]) -> bool:
    """Return whether one of the values equals a printed number to half of its last digit."""
    mantissa, _, exponent = token.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return bool(np.any(np.abs(np.array(values) - float(token)) <= 0.5001 * unit))


def held(table: Table, column: str, target: str) -> list[float]:
    """Return all numbers in a table's column, for one target if the table lists targets."""
    if "target" in table.colnames:
        table = table[table["target"] == target]
    values: list[float] = []
    for name in [column] if column else [one for one in table.colnames if one != "target"]:
        cells = np.ma.filled(np.ma.asarray(getattr(table[name], "value", table[name])))
        texts = cells.dtype.kind in "OUS"
        values += [float(n) for text in cells for n in NUMBER.findall(str(text))] if texts else cells.tolist()
    return values


def test_report_numbers_are_in_the_named_tables(answer: Any, tmp_path: Path) -> None:
    """Each number of the report (pages, summary, messages) equals the value in the column that it names."""
    answer.write(tmp_path)
    tables = {name: QTable.read(tmp_path / f"{name}.ecsv") for name in answer.tables}
    count = 0
    pages = (tmp_path / "plan.html").read_text(encoding="utf-8")
    for name in TARGET_NAMES:
        _, _, page = pages.partition(f"<h2>{html.escape(name)}</h2>")
        lines = re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td><td>(.*?)</td></tr>", page.partition("</table>")[0])
        assert lines
        for what, value, where in lines:
            places = [part.strip().partition(":") for part in where.split(";")]
            columns = [(tables[file], column.strip()) for file, _, named in places for column in named.split(",")]
            values = [number for table, column in columns for number in held(table, column, name)]
            for token in NUMBER.findall(html.unescape(value)):
                assert printed(token, values), (name, what, token)
                count += 1
    (view, *_) = answer.views
    shown = [column for column in view.columns if column.heading]
    for name, cells in zip(TARGET_NAMES, view.texts()[1], strict=True):
        for column, cell in zip(shown[1:], cells[1:], strict=True):
            values = [n for one in (column.name, *column.others) for n in held(tables["plan"], one, name)]
            for token in NUMBER.findall(cell):
                assert printed(token, values), (name, column.name, token)
                count += 1
    every = product(("plan", "stars", "assumptions"), [*TARGET_NAMES, ""])
    whole = [number for file, row in every for number in held(tables[file], "", row)]
    for message in answer.messages:
        for token in NUMBER.findall(message):
            assert printed(token, whole), message
            count += 1
    assert count > 100


@pytest.mark.long
def test_report_is_written(answer: Any) -> None:
    """The report has a page per target, a summary, and every assumption, and escapes markup in names."""
    made = plan(STUDY.with_settings(["plan.report=pdf"])).documents["plan.pdf"]
    content, page = made(), answer.documents["plan.html"]().decode()
    assert content == made()
    assert len(re.findall(rb"/Type /Page\b", content)) >= len(TARGETS) + 2
    assert "<script>" not in page
    assert all(html.escape(row["assumption"]) in page for row in answer.assumptions)
    assert page.count("data:image/png") == len(TARGETS)  # the overview; none of the star that is never seen
    # Hundreds of targets are to open quickly.
    assert max(len(picture) for picture in re.findall(r"data:image/png;base64,([^\"']+)", page)) < 45_000


def test_plan_takes_completeness_as_argument() -> None:
    def none_below(observed: Any) -> completeness.Completeness:
        assert observed.window_s > 600
        edge = np.array([1e30, 1e33 * (1 - 1e-12), 1e33, 1e40])
        return completeness.Completeness(edge, np.array([0.0, 0.0, 1.0, 1.0]), "bolometric", "a step")

    asked = [{"name": "eps Eri", "alpha": 2.0, "rate_per_day": 0.5, "at_erg": 1e33}]
    asked.append(asked[0] | {"name": "GJ 205", "rate_per_day": 1e-3})
    answer = plan(STUDY.with_changes({"plan": {"targets": asked}}, None), completeness=none_below)
    mean = answer.table["expected"].tolist()
    assert mean[0] == pytest.approx(0.5 * 5, rel=0.02)
    # The user's own rates have no scatter beyond Poisson noise.
    assert [answer.table["low"][0], answer.table["high"][0]] == stats.poisson.ppf([0.025, 0.975], mean[0]).tolist()
    bars, dots = answer.pictures["plan"]().axes[0].lines
    assert dots.get_xdata().tolist() == mean
    edge = bars.axes.get_xlim()[0]
    assert edge < mean[1]
    np.testing.assert_array_equal(bars.get_xdata()[:5], [edge, answer.table["high"][0], np.nan, np.nan, np.nan])


def test_conditions_equal_those_of_stares_along_the_orbit() -> None:
    """Compare the temperature while a target is seen with frames of the same orbit; it and hits change the noise."""
    base = ["plan.targets=[{name='GJ 205'}]", "orbit.days=1", "orbit.start=2026-10-01"]
    study = paper(*base, "plan.completeness='closed form'")
    seen = plan(study).stars[0]
    along = ["stare.along_orbit=true", "stare.duration_s=86400", "stare.search=false", "orbit.targets=['GJ 205']"]
    frames = stare(paper(*base[1:], *along)).stares[0].staring.stare
    # The plan begins in balance, the stare with its past.
    assert seen["temperature"].value == pytest.approx(frames.temperature_c.mean(), abs=0.2)
    still = plan(study.with_settings(["plan.along_orbit=false", "observation.temperature_c=21"]))
    assert still.stars["temperature"][0].value == 21.0
    # The limit of protons leaves little more than the cosmic rays.
    assert still.stars["hits"][0].value == 0.0 < 1.0 < seen["hits"].value < 1.1
    hot = study.with_settings(["observation.temperature_c=21"])
    rays = hot.with_settings(["processes.cosmic_rays.electrons=[5000, 10000]"])
    planned = [plan(one) for one in (rays, hot)]
    signals = [float(one.stars["signal_per_frame"][0]) for one in planned]
    assert signals[0] < 0.9 * signals[1] < 0.9 * still.stars["signal_per_frame"][0] < 0.9 * seen["signal_per_frame"]
    assert "about the study's mean of 21 deg C" in " ".join(planned[1].assumptions["value"])


def test_target_near_the_sun_has_the_study_s_sky() -> None:
    """The table has no zodiacal light there; a message says so, and that the law of durations is the user's."""
    star = "{name='near', coordinates='0 0', magnitude=9, spectral_type='M3V', distance_pc=10}"
    base = ["orbit.start=2027-03-21", "orbit.days=1", "orbit.limits.sun_deg='none'", "plan.exponent=0.5"]
    answer = plan(paper(f"plan.targets=[{star}]", *base, "plan.completeness='closed form'"))
    assert "behind near is unknown so near the Sun: the study's sky is used" in " ".join(answer.messages)
    assert np.isnan(answer.stars["sky"][0].value)
    assert not any("Maehara" in source for source in answer.assumptions["source"])


def test_targets_and_rates_are_read_from_tables(tmp_path: Path) -> None:
    """Compare a plan of a table with that of its values; a file of rates lies next to the table."""
    (tmp_path / "ffd.csv").write_text("energy,rate\n1e31,2.0\n1e34,0.001\n")
    (tmp_path / "targets.csv").write_text(
        "name,ra,dec,V,spectral_type,distance_pc,mass_msun,age_myr,rates_file,rates_band\n"
        "eps Eri,,,,,,,,ffd.csv,TESS\nmy star,10.5,-3.0,8.0,K5V,10,0.7,300,,\n"
    )
    words = ("--hours", "2", "--completeness", "closed form", "--days", "2", "--no-pictures", "-o", "out")
    assert "2 targets, 2 days" in run("plan", "targets.csv", "--paper", *words, folder=tmp_path).stdout
    made = Study.read(tmp_path / "out" / "plan.ecsv")
    QTable({"name": ["eps Eri"]}).write(tmp_path / "targets.ecsv")
    run("visible", "targets.ecsv", "--days", "1", "--no-pictures", folder=tmp_path)
    assert Study.of(targets=str(tmp_path / "targets.csv")).plan.targets == made.plan.targets
    assert made.plan.targets[0].rates_file == tmp_path / "ffd.csv"
    same = STUDY.with_changes({"plan": {"targets": TARGETS[1:2]}, "orbit": {"days": 2.0}}, None)
    ours, theirs = QTable.read(tmp_path / "out" / "stars.ecsv"), plan(same).stars
    assert ours["rates"][0] == "ffd.csv"
    for name in ("ra", "dec", "V", "spectral_type", "distance", "recovered_per_day"):
        assert ours[name][1] == theirs[name][0], name


def test_shares_equal_those_computed_by_hand() -> None:
    """Two half-widths; every flare of an energy has one half-width, in the middle of their logarithms."""
    critical = np.array([[[1.0, 2.0, 3.0, 4.0]], [[10.0, 20.0, 0.0, 30.0]]])
    injected = completeness.InjectedCompleteness((10.0, 1000.0), np.ones(1), np.ones((2, 1)), critical)
    fixed = ["plan.at_erg=1", "plan.exponent=0", "plan.scatter_dex=0"]
    law, short = (paper(*fixed, f"plan.half_width_s={w}").plan.law() for w in (100, 1))
    found = injected.by_energy(np.array([0.5, 2.5, 15.0, 99.0]), law)
    # An alarm without a flare is none of it: three injections are left of the second half-width.
    assert found == pytest.approx([0.0, 0.25, (1 + 1 / 3) / 2, 1.0])
    assert injected.by_energy(np.array([2.5]), short) == pytest.approx([0.5])


@pytest.mark.long
def test_injections_agree_with_the_closed_form() -> None:
    """Flares put into drawn stares and searched for, and the closed form, recover flares of nearly the same energies.

    A bank of several temperatures has a higher threshold than one sum; 200 injections leave some per cent.
    """
    # Five half-widths and one sum of each frame in place of nine and three: as good a search, in less time.
    study = paper("plan.targets=[{name='GJ 205'}]", "orbit.days=20", "plan.injections=200", "search.sums=1",
                  "search.half_widths_s=[25, 50, 100, 200, 400]")  # fmt: skip
    drawn, form = (plan(study.with_settings([f"plan.completeness='{how}'"])) for how in ("injections", "closed form"))
    assert drawn.table["E50"][0].value == pytest.approx(form.table["E50"][0].value, rel=0.15)
    assert drawn.table["expected"][0] == pytest.approx(form.table["expected"][0], rel=0.15)
    assert drawn.table["false_alarms"][0] == form.table["false_alarms"][0]


def test_calendar_beyond_the_elements() -> None:
    names = ["eps Eri", "AU Mic", "EK Dra"]
    found = visible(paper(f"orbit.targets={names}", "orbit.start=2027-02-10T06:00", "orbit.days=40"))
    assert {"earth_limb_deg", "sun_deg", "moon_deg", "proton_flux"} <= set(found.assumptions["limit"])
    assert all("assumption" in source for source in found.assumptions["source"])
    events = icalendar.Calendar.from_ical(found.documents["visible.ics"]()).walk("VEVENT")
    assert {str(event["SUMMARY"]) for event in events} == {"eps Eri", "AU Mic"}
    for name in names:
        days_of = found.by_day[found.by_day["target"] == name]
        # Half an hour and more is shown as a day.
        seen = (days_of["hours"].value >= 0.5).sum()
        days = sum((e["DTEND"].dt - e["DTSTART"].dt).days for e in events if str(e["SUMMARY"]) == name)
        assert days == seen


def test_calendar_near_the_epoch_has_windows() -> None:
    """Half of each window is exposed; the tables state which limits are the user's, and which are in force."""
    limits = ["orbit.limits.duty_cycle=0.5", "orbit.limits.anomaly=[[0, 0], [1, 0], [1, 1]]"]
    answer = visible(paper("orbit.targets=['eps Eri']", "orbit.start=2026-09-20", "orbit.days=2", *limits))
    events = icalendar.Calendar.from_ical(answer.documents["visible.ics"]()).walk("VEVENT")
    assert len(events) == answer.table["windows"][0] > 20
    first, windows = events[0], answer.windows[0]
    assert (first["DTEND"].dt - first["DTSTART"].dt).total_seconds() == windows.length_s[0]
    assert str(first["DESCRIPTION"]) == f"{windows.length_s[0] / 120:.0f} min of exposure"
    hours = windows.length_s.sum() / 3600
    assert all(text in answer.headline for text in (f"seen for {hours:.0f} h (", f"exposed for {hours / 2:.0f} h"))
    assert answer.table["per_orbit"][0].value == pytest.approx(hours / 2 * 60 / (2 * 1440 / 94.635), rel=1e-4)
    sources = dict(answer.assumptions["limit", "source"].iterrows())
    assert sources["duty_cycle"].startswith("set by the user; default 1: assumption: the whole")
    assert ("proton_flux" in sources, sources["sun_deg"][:10]) == (False, "assumption")
    assert answer.messages == answer.messages[-1:]  # nothing of the orbit: its elements are a week old
    # Dates of TOML are read as texts are.
    starts = {"2027-01-01": "01T00", "2027-01-01T06:00:00": "01T06", "2027-01-01T06:00:00+02:00": "01T04"}
    for text, found in starts.items():
        times = paper(f"orbit.start={text}").orbit.times()
        assert (times.iso(0.0), times.iso(0.5, 1)) == (f"2027-01-{found}:00:00", f"2027-01-{found}:00:00.5")
    # Its days begin on the day of the start, even if that is less than half a second before midnight.
    late = visible(paper("orbit.targets=['eps Eri']", "orbit.start=2026-12-31T23:59:59.7", "orbit.days=1"))
    assert (late.days, late.months["month"].tolist()) == (["2026-12-31", "2027-01-01"], ["2027-01"])
