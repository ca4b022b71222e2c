"""Verbs: one name and signature in Python and on the command line, keywords for flags, one definition of columns."""

import io
import json
import re
import shlex
from datetime import datetime, timedelta, timezone
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from answers import FEW, QUICK
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time
from commands import run
from marks import long_but
from scenes import paper
from tables import toml

import mauvecl
from mauvecl import Engine, FlareModel, Frames, Instrument, Sky, Source, Study, expect, fit

SLOW = {
    "measure": ["measure.fits=20"],
    "stare": ["stare.duration_s=2000", "stare.search=true"],
    "inject": ["stare.duration_s=3000", "injections.sizes=3", "injections.widths=2", "injections.count=20",
               "injections.positions=2", "search.nulls=0", "injections.fitted=0"],
}  # fmt: skip


@pytest.mark.parametrize("name", long_but(QUICK, *(QUICK.keys() - {"change", "simulate"})))
def test_progress_ends_at_its_total(name: str, engine: Engine) -> None:
    """Pass all arguments by position, since all verbs have the same."""
    seen: list[tuple[int, int]] = []
    drawing = None if name == "plan" else engine
    getattr(mauvecl, name)(paper(*FEW + QUICK[name]), drawing, lambda *reported: seen.append(reported))
    done, total = zip(*seen, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] == total[-1] > 0
    assert len(set(total)) == 1


# Observed frames take too long for this test.
@pytest.mark.parametrize("name", long_but(QUICK | SLOW, "exposure", "detect"))
def test_files_json_and_terminal_agree(name: str, tmp_path: Path) -> None:
    answer = getattr(mauvecl, name)(paper(*FEW, *(QUICK | SLOW)[name]))
    answer.write(tmp_path / "files")
    for file, table in answer.tables.items():
        path = tmp_path / "files" / f"{file}.ecsv"
        read, exact = QTable.read(path), io.StringIO()
        assert read.colnames == table.colnames
        for one in read.colnames:
            assert read[one].unit == table[one].unit
            assert read[one].info.description == table[one].info.description
        # Files are written without astropy's writer, to the last byte as by it.
        table.write(exact, format="ascii.ecsv")
        assert path.read_text(encoding="utf-8") == exact.getvalue()
    (tmp_path / "study.toml").write_text(answer.study.toml())
    words = (name, "study.toml", "--no-pictures", "-o")
    found = json.loads(run(*words, "json", "--json", folder=tmp_path).stdout)
    assert answer.json_tables.keys() <= found.keys()
    for key, table in answer.json_tables.items():
        assert list(found[key][0]) == table.colnames
        for column, *cells in zip(table.colnames, *(row.values() for row in found[key]), strict=True):
            values = np.ma.asarray(getattr(table[column], "value", table[column]))
            if values.dtype.kind == "f":
                # JSON has neither NaN nor infinities.
                values = np.ma.masked_invalid(values)
            assert cells == values.tolist(), (key, column)
    shown = run(*words, "shown", "--wide", folder=tmp_path).stdout
    for view in answer.views:
        assert view.title in shown
        if view.table is not None:
            headings, cells = view.texts()
            assert headings
            assert all(text in shown for row in cells for text in row)


def test_odd_words_in_tables_are_written_as_by_astropy(tmp_path: Path) -> None:
    stars, exact = [], io.StringIO()
    for number, name in enumerate(['said "so"', "a,b", "#", "two  spaces", "\u03bb", "0.1"]):
        (tmp_path / name).write_text("100 1e-13\n500 1e-13\n1100 1e-13\n")
        stars.append({"file": str(tmp_path / name), "magnitude": 7.0 + number})
    answer = mauvecl.exposure(Study.build({"star": stars, "signal": {"snr": 5.0, "wavelength_nm": 400.0}}, "test"))
    answer.write(tmp_path)
    answer.table.write(exact, format="ascii.ecsv")
    assert (tmp_path / "exposure.ecsv").read_text(encoding="utf-8") == exact.getvalue()
    assert len(answer.table) == len(stars)


#: Keywords, and the flags that ask the same.
ASKED = toml("keywords.toml")


@pytest.mark.parametrize("name", ASKED)
def test_keywords_ask_what_flags_ask(name: str, tmp_path: Path) -> None:
    asked = ASKED[name]
    run(asked["verb"], *shlex.split(asked["flags"]), "--no-pictures", "-o", "answer", folder=tmp_path)
    # Keywords with units are an expression.
    keywords = asked.get("keywords") or eval(asked["call"], {"np": np, "u": u})
    answer = getattr(mauvecl, asked["verb"])(**keywords)
    assert answer.study.toml() == (tmp_path / "answer" / "study.toml").read_text()
    assert answer.tables.keys() <= {path.stem for path in (tmp_path / "answer").glob("*.ecsv")}


def test_studies_are_built_from_and_changed_by_the_same_keywords() -> None:
    study = Study().with_settings(["star=[{library='G2V', magnitude=7}, {library='K3V', magnitude=4}]"])
    changed = mauvecl.simulate(study, exposure=600, magnitude=6).study
    settings = ["observation.exposure_s=600", "star.0.magnitude=6", "star.1.magnitude=6"]
    assert changed.toml() == study.ideal().with_settings(settings).toml()
    assert mauvecl.simulate(study).study == study.ideal()
    asked = {"star": "G2V", "magnitude": 7, "exposure": 60, "distance": 5, "duration": 3600, "look_at": "eps Eri"}
    settings = [
        "star=[{library='G2V', magnitude=7, distance_pc=5}]", "observation.exposure_s=60", "stare.duration_s=3600",
        "orbit.targets=['eps Eri']",
    ]  # fmt: skip
    assert Study.of(**asked, paper=True, ideal=True).toml() == paper(*settings).toml()
    by_name = Study.of(targets=["AU Mic", {"name": "eps Eri", "age_myr": 400, "mass_msun": 0.8}]).plan.targets
    assert [target.name for target in by_name] == ["AU Mic", "eps Eri"]
    places = SkyCoord([10.5, 20], [-20, 5], unit="deg")
    table = QTable({"name": ["AU Mic", "X"], "place": places, "amplitude": [0.1, 0.2]})
    of_table = Study.of(targets=table, flares=table["name", "amplitude"])
    assert [target.coordinates for target in of_table.plan.targets] == ["10.5 -20.0", "20.0 5.0"]
    single = {"10.500000 -20.000000": places[0], "X": table[1], "EK Dra": {"name": "EK Dra"}}
    assert [Study.of(targets=one).plan.targets[0].name for one in single.values()] == [*single]
    assert of_table.flare.amplitudes == (0.1, 0.2)
    assert Study.of(look_at=[places[0], "AU Mic"]).orbit.targets == ("10.500000 -20.000000", "AU Mic")
    assert Study.of(look_at=places).orbit.targets == ("10.500000 -20.000000", "20.000000 5.000000")
    pairs = Study.of(gap="10 min:0.5 h", skip=["322:3680 Angstrom"], declination="-30 deg:1800 arcmin")
    assert pairs.stare.gaps == ((600.0, 1800.0),)
    assert pairs.measure.skipped_nm == ((322.0, 368.0),)
    assert pairs.orbit.limits.declination_deg == (-30.0, 30.0)


def test_times_may_be_dates_of_python_numpy_and_astropy() -> None:
    noon = datetime(2027, 3, 1, 12)
    zoned = datetime(2027, 3, 1, 14, tzinfo=timezone(timedelta(hours=2)))
    grid = type(Study().orbit.times())
    for time in (noon, zoned, np.datetime64(noon), Time(noon), noon.isoformat()):
        assert Study.of(start=time).orbit.start.startswith("2027-03-01T12:00:00"), time
        assert grid(time, 1.0).first == grid("2027-03-01T12:00", 1.0).first
        assert Sky.at("10 40", time) == Sky.at("10 40", Time(noon))
        if not isinstance(time, str):
            assert Frames.of(np.arange(20), np.ones(20), reference_mjd=time).reference_mjd == 61_465.5
    # Steps end with the days.
    assert [Study.of(days=0.05, step=step).orbit.times().step_s for step in (60, 3600)] == [60.0, 2160.0]
    assert Study.of(start=noon.date()).orbit.start == str(np.datetime64(noon, "D"))


def test_too_few_realisations_are_warned_of() -> None:
    """Detections sample the tail; maps and limits draw more."""
    with pytest.warns(UserWarning, match="2000 realisations are too few"):
        answer = mauvecl.detect(star="G2V", magnitude=7, amplitude=0.1, realisations=2000, ideal=True)
    assert answer.study.run.tails == "sampled"
    axes = {"x": "magnitude=6,8", "y": {"quantity": "amplitude", "values": [0.1, 1]}}
    for verb, asked in ((mauvecl.map, axes), (mauvecl.limit, {"amplitude": 0.1})):
        with pytest.warns(UserWarning, match="10 realisations are too few .* so 1000 are drawn"):
            answer = verb(star="G2V", **asked, realisations=10, fap=0.1, ideal=True)
        assert answer.study.run.realisations == 1000


def test_printed_answers_hold_the_sentence_and_the_table(engine: Engine) -> None:
    answer = mauvecl.detect(engine=engine, star="M4V", magnitude=11, amplitude=0.05, fap=0.1, realisations=5000)
    assert answer.headline.startswith("Mauve would see a flare of 5 % on M4V V = 11 in 50 s with a chance of ")
    assert repr(answer) == f"<DetectAnswer {answer.headline!r}>"
    first, *others = str(answer).splitlines()
    assert first == answer.headline
    assert max(map(len, others[:4])) <= 100
    (row,) = (line.split() for line in others if line.startswith("  M4V"))
    assert row[:6] == ["M4V", "V", "=", "11", "5", "%"]
    assert f"{answer.table['probability'][0]:.4f}" in row
    assert others[others.index("Assumed:") + 1] == "  instrument mauve, detector at 21 deg C"
    assert list(answer.messages) == others[-len(answer.messages) :]
    html = answer._repr_html_()
    assert html.startswith("<p>Mauve would see a flare of 5 % on M4V V = 11")
    assert f"<td>{answer.table['probability'][0]:.4f}</td>" in html
    # A table of one detection shows its probability where astropy prints the first and last columns.
    assert "probability" in str(answer.stars[0].detection.table(fap=0.1)).splitlines()[0]


def test_classes_have_short_reprs_and_the_defaults_of_the_command_line(engine: Engine) -> None:
    assert repr(engine) == f"<Engine on {engine.device_name}>"
    assert repr(mauvecl.Stares(engine.open_device)) == f"<Stares on {engine.device_name}>"
    star, quiet = Source.from_library("AU Mic").at_magnitude(8.81), expect("AU Mic", exposure=50)
    assert quiet == expect("AU Mic", "mauve", exposure=50)
    drawn = engine.realise(quiet, count=2)
    np.testing.assert_array_equal(drawn, engine.realise(quiet, count=2, seed=Study().run.seed))
    model = FlareModel.of(star, Instrument.load("mauve"), quiet)
    measured = fit(engine.realise(expect(star.flaring(1.0), exposure=50), count=3), quiet, model)
    ahead = mauvecl.forecast(quiet, model, 10_000, [1.0])
    for made, name, values, errors in (
        (ahead, "Forecast", ahead.values, ahead.errors),
        (measured, "Measurement", measured.estimates[0], measured.errors[0]),
    ):
        written = re.match(rf"<{name}: temperature = (\d+) \+- (\d+) K, amplitude = ", repr(made))
        assert written is not None
        np.testing.assert_allclose([float(number) for number in written.groups()], [values[0], errors[0]], rtol=0.05)
    assert repr(measured).endswith("; the first of 3 frames>")
