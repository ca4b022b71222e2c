"""Plans and visibility: numbers follow from others, what is missing is reported; the light of a stare and its files."""

import html
import io
import re
import shutil
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import icalendar
import numpy as np
import pytest
from answers import expectations
from astropy.io import fits
from astropy.table import QTable, Table
from commands import run
from scenes import paper
from scipy import stats
from tables import toml

from mauvecl import Engine, Study, plan, stare, visible
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


def test_plan_takes_completeness_as_argument_whose_shares_are_those_by_hand() -> None:
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
    # Two half-widths; every flare of an energy has one half-width, in the middle of their logarithms.
    critical = np.array([[[1.0, 2.0, 3.0, 4.0]], [[10.0, 20.0, 0.0, 30.0]]])
    injected = completeness.InjectedCompleteness((10.0, 1000.0), np.ones(1), np.ones((2, 1)), critical)
    fixed = ["plan.at_erg=1", "plan.exponent=0", "plan.scatter_dex=0"]
    law, short = (paper(*fixed, f"plan.half_width_s={w}").plan.law() for w in (100, 1))
    found = injected.by_energy(np.array([0.5, 2.5, 15.0, 99.0]), law)
    # An alarm without a flare is none of it: three injections are left of the second half-width.
    assert found == pytest.approx([0.0, 0.25, (1 + 1 / 3) / 2, 1.0])
    assert injected.by_energy(np.array([2.5]), short) == pytest.approx([0.5])


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


#: A G2V star for five minutes with a gap and a flare.
SHORT = paper(
    'star=[{library="G2V", magnitude=7.4}]', "flare.amplitudes=[0.5]", "stare.duration_s=300",
    "stare.gaps=[[100, 150]]", "stare.half_width_s=20", "stare.search=false",
    "stare.thermal.amplitude=2.0", "stare.thermal.period_s=600",
)  # fmt: skip


def test_spectra_summed_over_frames_equal_exposures_of_the_engine(stares):
    # Frames of a stare have the addresses of an exposure's: the same draws, to the last DN.
    near = Path(__file__).parents[1] / "data" / "studies" / "near.csv"
    study = SHORT.with_settings(["stare.gaps=[]", "stare.duration_s=50", "flare.amplitudes=[0]", "run.seed=5",
                                 f"star.0.neighbours='{near}'", "star.0.neighbour_share=0.5"])  # fmt: skip
    study = study.model_copy(update={"stare": study.stare.model_copy(update={"thermal": None, "number": 3})})
    one = stare(study, stares).stares[0]
    exposure, *_ = expectations(study.with_settings(["observation.exposure_s=50"]))
    raw = Engine().realise(exposure, start=3, count=1, seed=study.run.seed, mode="frames")[0]
    net = raw - 10 * (exposure.bias_dn + exposure.dark_dn)
    elements = np.bincount(exposure.element, net)
    np.testing.assert_allclose(5.0 * one.light.spectrum.sum(axis=0), elements, atol=0.05)
    assert 5.0 * one.light.flux[:, 0].sum() == pytest.approx(net.sum(), abs=0.5)
    band = (exposure.wavelength_nm >= 300) & (exposure.wavelength_nm < 400)
    assert 5.0 * one.light.flux[:, 2].sum() == pytest.approx(net[band].sum(), abs=0.1)


def test_light_scatters_by_its_standard_deviation_in_bands_of_a_sweep_and_files(stares, tmp_path):
    """Files have the columns of lightkurve; a sweep goes over magnitude and temperature, in bands that overlap."""
    (tmp_path / "i.toml").write_text('version = 2\nextends = "mauvesim"\nname = "λ"\ntemperature_c = 20.0')
    asked = SHORT.with_settings([f"observation.instrument='{tmp_path / 'i.toml'}'"])
    found = stare(asked, stares)
    light = found.stares[0].light
    z = (light.flux - light.mean) / light.sd
    spectrum = (light.spectrum - light.spectrum_mean) / light.spectrum_sd
    # 50 frames x 4 bands (the first is their sum), and 50 x 48 elements: beyond these once in 1e6.
    assert abs(z[:, 1:].mean()) < 4.9 / np.sqrt(z[:, 1:].size)
    assert abs((spectrum**2).mean() - 1) < 4.9 * np.sqrt(2 / spectrum.size) + 0.01
    # The dark follows 2 deg C up and down, hundreds of standard deviations that are known and taken off.
    assert abs(spectrum.mean()) < 4.9 / np.sqrt(spectrum.size)
    with fits.open(io.BytesIO(found.documents["light-curve-1.fits"]())) as hdus:
        hdus.verify("exception")
        table, gti = hdus[1], hdus["GTI"]
        # `lightkurve.read` takes a file for a generic one only where CREATOR or ORIGIN is missing, and needs a time.
        assert "ORIGIN" not in hdus[0].header
        assert table.header["MJDREFI"] == 61041
        assert (table.header["TIMESYS"], table.header["TREFPOS"]) == ("UTC", "TOPOCENTER")
        np.testing.assert_allclose([86_400 * table.header[name] for name in ("EXPOSURE", "TSTOP")], [250, 300])
        assert hdus[0].header["TELESCOP"] == hdus[0].header["INSTRUME"] == r"\u03bb"
        # 2 deg C times the mean of the sine over 0-100 s and 150-300 s of 600 s; frames of 5 s give it to 1e-4.
        warmth = 2 * 600 / (2 * np.pi) * (1 - np.cos(np.pi / 3) + 1) / 250
        assert hdus[0].header["CCD-TEMP"] == pytest.approx(20 + warmth, rel=1e-4)
        assert table.columns.names[:6] == ["TIME", "CADENCENO", "QUALITY", "FLUX", "FLUX_ERR", "MEAN"]
        assert table.columns["TIME"].unit == "d"
        np.testing.assert_allclose(table.data["FLUX"], light.flux[:, 0], rtol=1e-6)
        np.testing.assert_allclose(table.data["FLUX_ERR_300_400"], light.sd[:, 2], rtol=1e-6)
        assert table.data["CADENCENO"].tolist() == [*range(20), *range(30, 60)]
        np.testing.assert_allclose(gti.data["START"] * 86_400, [0.0, 150.0])
        np.testing.assert_allclose(gti.data["STOP"] * 86_400, [100.0, 300.0])
        assert hdus[0].header["OBJECT"] == "G2V V = 7.4"
    bands = [[200, 300], [200, 300], [250, 450], *([300 + 10 * k, 400 + 10 * k] for k in range(9))]
    axes = '{quantity="magnitude", values=[7.4, 9]}, {quantity="flare_temperature", values=[10000, 20000]}'
    swept = stare(asked.with_settings([f"stare.bands_nm={bands}", f"sweep.axes=[{axes}]"]), stares)
    assert swept.table["magnitude"].value.tolist() == [7.4, 7.4, 9.0, 9.0]
    assert swept.table["frame_noise"][2] > 2 * swept.table["frame_noise"][0]
    assert [one.flares[0].event.hottest_k for one in swept.stares] == [10_000.0, 20_000.0] * 2
    flux = swept.stares[0].light.flux
    assert flux.shape == (50, 13)
    np.testing.assert_array_equal(flux[:, 1], flux[:, 2])
    np.testing.assert_allclose(flux[:, [1, 4]], light.flux[:, [1, 2]], atol=0.01)


@pytest.mark.long
def test_one_sum_finds_flares_of_the_temperature_of_the_study(stares):
    """Find a flare within five standard errors; with a bank that is too narrow it is found and not measured."""
    asked = paper('star=[{library="M3V", magnitude=8, distance_pc=5}]', "stare.duration_s=2000", "search.sums=1",
                  "flare.temperature_k=14000", "events=[{peak_s=700, half_width_s=60, amplitude=0.2}]")  # fmt: skip
    answer, narrow = stare(asked, stares), stare(asked.with_settings(["search.half_widths_s=[5, 10, 20]"]), stares)
    (row,), put_in = answer.found, answer.events[0]
    assert np.isnan([row["temperature"].value, row["temperature_low"].value]).all()
    assert row["amplitude_error"] < 0.005
    for name in ("amplitude", "equivalent_duration"):
        assert abs(row[name] - put_in[name]) < 5 * row[f"{name}_error"]
    per_s = put_in["energy_bolometric"] / put_in["equivalent_duration"]
    for end in ("", "_low", "_high"):
        ratio = row[f"energy_bolometric{end}"] / row[f"equivalent_duration{end}"] / per_s
        assert float(ratio) == pytest.approx(1.0, rel=2e-3)
    assert narrow.headline.endswith(f"raises no false alarms; {len(narrow.found)} alarms are not measured.")
    assert {*narrow.found["event"]} == {-1}


@pytest.mark.long
def test_study_file_with_curves_shapes_and_events_is_read(tmp_path, stares):
    (tmp_path / "slow.txt").write_text("# s, relative\n0 0.0\n300 0.03\n")
    (tmp_path / "own.txt").write_text("-10 0\n0 4\n30 0\n")
    study = Study.read(shutil.copy(Path(__file__).parents[1] / "data" / "studies" / "events.toml", tmp_path))
    assert Study.build(tomllib.loads(study.toml()), "again").toml() == study.toml()
    found = stare(study, stares)
    staring = found.stares[0].staring.stare
    np.testing.assert_allclose(staring.star[[0, -1]], [1 + 0.03 * 2.5 / 300, 1 + 0.03 * 297.5 / 300])
    first, second = found.stares[0].flares
    assert first.bolometric_erg == pytest.approx(1e33, rel=1e-9)
    # Own shape: a triangle of 40 s with a peak of one.
    assert second.event.equivalent_duration_s == pytest.approx(2.0)
    assert second.event.peak == pytest.approx(0.1)
    assert staring.unknowns[0].name == "light drift"


@pytest.mark.long
def test_light_curves_state_the_light_lost_in_pointing_drifts(stares):
    study = SHORT.with_settings(["stare.pointing={rate_per_h=100.0, duration_s=60.0, depth=1.0}", "stare.number=4"])
    answer = stare(study, stares)
    (one,), curve = answer.stares, answer.light_curve()
    lost = one.staring.stare.pointing_losses(np.array([4], np.uint64), study.run.seed)[0]
    np.testing.assert_array_equal(curve["pointing_loss"], lost)
    assert lost.max() > 0.2
    with fits.open(io.BytesIO(answer.documents["light-curve-1.fits"]())) as hdus:
        np.testing.assert_allclose(hdus["LIGHTCURVE"].data["POINTING_LOSS"], lost, rtol=1e-6)
        assert hdus["LIGHTCURVE"].header["LOSTFRMS"] == np.count_nonzero(lost) == answer.table["drifting_frames"][0]
        # An observer does not know which frames these are.
        assert not hdus["LIGHTCURVE"].data["QUALITY"].any()
    # Drawn light is the mean without drifts times the share that is left, within its noise.
    excess = (one.light.flux[:, 0] - (1 - lost) * one.light.mean[:, 0]) / one.light.sd[:, 0]
    assert np.abs(excess).max() < 5.5
    assert any("lose light" in text and "assumed" in text for text in answer.messages)
    assert "pointing drifts (assumed)" in answer.assumed
