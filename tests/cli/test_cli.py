"""The command line as a user meets it: the paper's question, studies, reruns and interruption."""

import json
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from commands import SMALL_SHARDS, ended, run, started
from processes import python
from scenes import paper, study_of_g2v

from mauvecl import Engine, Study, detect, simulate

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Answer the question of the paper with fewer realisations; return the folder and the output."""
    folder = tmp_path_factory.mktemp("detect")
    return folder, started("detect", "--paper", "-n", "100000", "--no-pictures", folder=folder).stdout


@pytest.mark.long
def test_detect_answers_the_question_of_the_paper(answered: tuple[Path, str]) -> None:
    folder, text = answered
    lines = text.splitlines()
    assert lines[0].startswith("Mauve would see a flare of 0.76 % on G2V V = 7.4 in 50 s with a chance of 5")
    assert lines[0].endswith(", the least certain of 8 flares.")
    assert "false-alarm probability of 0.001 per test, 50 s (10 frames), 100,000 realisations" in lines[1]
    notes = lines[lines.index("  seed 1") + 1 :]
    assert "not a flight calibration" in notes[0]
    assert notes[1] == "Magnitudes in V are as in catalogues: Vega has 0.03."
    # One note says that everything is taken as known, the chance if it is not, and what the usual unknowns are.
    assert notes[2].startswith(
        "Everything but the noise is taken as known: G2V V = 7.4, flare of 0.76 % is then detected"
    )
    chance = "a chance of 57.0 %, with the usual unknowns of 2.7 % (closed forms; --with-unknowns draws them)."
    assert chance in notes[2]
    assert notes[2].endswith("These are the dark level (free), the light level (free) and the sky level (+-10 %).")
    assert sum("unknowns" in line for line in lines) == 1
    # Both of the paper's values are reconstructed within 30 %, and the text says why a calibrated answer differs.
    for amplitude, reduced in (("8.1 %", 0.66), ("24 %", 3.75)):
        line = next(x for x in lines if x.startswith(f"G2V, {amplitude} flare"))
        assert f"reduced {reduced:g}" in line
        assert float(line.split("reconstructed here ")[1].split()[0]) == pytest.approx(reduced, rel=0.3)
    assert "no calibrated chi-squared" in text
    record = json.loads((folder / "mauvecl-detect" / "run.json").read_text())
    assert (record["seed"], record["study"]["run"]["realisations"], len(record["inputs"])) == (1, 100_000, 10)


def test_study_defines_weights(tmp_path: Path, engine: Engine) -> None:
    """The closed form and the simulation of a band around 280 nm agree."""
    (tmp_path / "band.txt").write_text("# nm, per DN\n270 1\n290 1\n")
    (tmp_path / "study.toml").write_text(
        "[[star]]\nlibrary = 'G2V'\nmagnitude = 7.4\n[flare]\namplitudes = [0.03]\n"
        "[run]\nrealisations = 20000\nfap = 0.01\n[run.weights]\nband = 'band.txt'\n"
    )
    table = detect(Study.read(tmp_path / "study.toml"), engine).table
    (row,) = table[table["statistic"] == "band"]
    assert row["mean"] == pytest.approx(row["expected"], rel=0.02)
    assert abs(row["probability"] - row["closed_form_probability"]) < 0.03


def test_flags_override_the_study_file(tmp_path: Path) -> None:
    wavelength = np.arange(170.0, 1100.0, 2.0)
    np.savetxt(tmp_path / "mine.txt", np.column_stack([wavelength, 1e-11 * np.ones_like(wavelength)]))
    (tmp_path / "study.toml").write_text(
        '[[star]]\nfile = "mine.txt"\nmagnitude = 6\n[flare]\namplitudes = [0.1]\n'
        '[observation]\nexposure_s = 12\n[sky]\ntarget = "290.68 +11.12"\ntime = "2026-09-01T12:00"\n'
        '[run]\nrealisations = 2000\nfap = 0.05\nstatistics = ["matched"]\n'
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run("detect", "../study.toml", "--seed", "7", "--sky", "none", "--json", folder=elsewhere)
    answer = json.loads(done.stdout)
    assert [row["star"] for row in answer["rows"]] == ["mine V = 6"]
    assert any("15 s" in message for message in answer["messages"])
    text = (elsewhere / "mauvecl-detect" / "study.toml").read_text()
    assert "none = true" in text
    assert "290.68" not in text
    assert "seed = 7" in text
    settings = ("star.0.magnitude=5", "observation.exposure_s = 10", "sky={surface_brightness=21}")
    sets = [word for setting in settings for word in ("--set", setting)]
    run("simulate", "study.toml", *sets, "--no-pictures", "--quiet", folder=tmp_path)
    study = Study.read(tmp_path / "mauvecl-simulate" / "study.toml")
    assert (study.star[0].magnitude, study.observation.exposure_s, study.sky.surface_brightness) == (5, 10, 21)


def part_of(seconds: float, magnitude: float) -> Study:
    part = {"output_min_nm": 300.0, "output_max_nm": 360.0}
    star = [{"library": "G2V", "magnitude": magnitude}]
    return study_of_g2v(star=star, observation={"exposure_s": seconds, "changes": part}, run={"seed": 4})


@pytest.mark.parametrize(("magnitude", "seconds"), [(7.4, 50.0), (-0.3, 10.0), (7.4, 1500.0)])
def test_simulation_equals_the_realisation_of_the_engine(magnitude: float, seconds: float, engine: Engine) -> None:
    """Compare also where frames saturate, and for more frames than are drawn at once."""
    for _, x, table in simulate(part_of(seconds, magnitude), realisation=123).observations:
        np.testing.assert_array_equal(table["raw"].value, engine.realise(x, start=123, count=1, seed=4)[0])
        names = ("source", "sky", "photon_noise", "dark", "bias", "read_noise", "digitisation")
        if magnitude > 0:
            np.testing.assert_allclose(sum(table[name].value for name in names), table["raw"].value, rtol=1e-12)
            assert np.abs(table["digitisation"].value).max() <= 0.51 * max(1, np.sqrt(seconds / 10))


def test_fits_of_a_simulation_equals_its_table(tmp_path: Path) -> None:
    words = ("--star", "G2V", "-m", "7.4", "-a", "0.24", "-t", "10", "--no-pictures", "-o", "out")
    run("simulate", *words, folder=tmp_path)
    table = QTable.read(tmp_path / "out" / "observation-2.ecsv")
    assert table["raw"].unit == "adu"
    with fits.open(tmp_path / "out" / "observation-2.fits") as hdus:
        hdus.verify("exception")
        assert hdus[1].header["EXPTIME"] == 10.0
        assert hdus[1].columns["wavelength"].unit == "nm"
        np.testing.assert_array_equal(hdus[1].data["raw"], table["raw"].value)
    if shutil.which("fitsverify"):
        verified = ["fitsverify", tmp_path / "out" / "observation-2.fits"]
        reported = subprocess.run(verified, capture_output=True, text=True, check=True).stdout
        assert "0 warning(s) and 0 error(s)" in reported, reported


def test_wrong_template_loses_snr(engine: Engine) -> None:
    """A search for a flare of 5000 K detects one of 10000 K less often; a message states the S/N that remains."""
    settings = [
        "star=[{library='G2V', magnitude=7.4}]",
        "flare.amplitudes=[0.01]",
        "run={realisations=50000, fap=0.01, statistics=['matched'], template_temperatures_k=[5000, 10000]}",
    ]
    answer = detect(paper(*settings), engine)
    kept = [float(line.split(" keeps ")[1].split()[0]) for line in answer.messages if " keeps " in line]
    assert 50 < kept[0] < 95
    assert kept[1] == 100.0
    p = dict(zip(answer.table["statistic"], answer.table["probability"], strict=True))
    assert p["matched 5000 K"] < p["matched"] == p["matched 10000 K"]


def test_schema_describes_every_key(tmp_path: Path) -> None:
    schema = json.loads(run("schema", folder=tmp_path).stdout)
    assert set(schema["properties"]) == set(Study.model_fields)
    # The registry of unknowns describes the keys of processes and unknowns.
    sections = {
        name: one for name, one in schema["$defs"].items() if name not in ("Processes", "CosmicRays", "Unknowns")
    }
    keys = [
        (name, key, one) for name, section in sections.items() for key, one in section.get("properties", {}).items()
    ]
    missing = {f"{name}.{key}" for name, key, one in keys if "description" not in one and "$ref" not in str(one)}
    assert missing == set()
    assert len(keys) > 120


def test_saturation_is_in_the_headline_and_the_first_message(tmp_path: Path) -> None:
    done = run("simulate", "--star", "B2IV", "-m", "0.5", "-t", "5", "--no-pictures", folder=tmp_path)
    headline, *others = done.stdout.splitlines()
    assert re.search(r"; [1-9]\d* of 1643 pixels saturate\.$", headline)
    # What was assumed is indented, and precedes the messages.
    first = next(line for line in others[others.index("Assumed:") + 1 :] if not line.startswith("  "))
    assert first.startswith("SATURATED: ")
    assert " nm reach " in first
    assert "the longest safe frame is " in first


def test_numbers_of_tables_below_a_million_have_no_power_of_ten(tmp_path: Path) -> None:
    words = ("exposure", "--star", "G2V", "-m", "7.4", "--snr", "700", "--at", "300", "--no-pictures")
    (row,) = json.loads(run(*words, "--json", folder=tmp_path).stdout)["rows"]
    assert 1e4 < row["exposure"] < 1e6
    shown = run(*words, folder=tmp_path).stdout
    assert re.search(rf"\s{row['exposure']:.0f}\s", shown), shown
    assert not re.search(r"\de\+0[0-5]|nan", shown)


def test_assumptions_about_a_spectrum_are_the_first_message(tmp_path: Path) -> None:
    words = ("--wavelength-unit", "Angstrom", "-m", "8", "--exposure", "5", "--no-pictures", "-o", "out")
    done = run("simulate", "--star", DATA / "spectra" / "10lac_stis_001.txt", *words, folder=tmp_path).stdout
    shown = " ".join(done.split())
    assert "seed 1 10lac_stis_001: ASSUMED: flux in erg" in shown
    assert "ASSUMED: flux in erg" in (tmp_path / "out" / "run.json").read_text()
    # The study that was written reads the same star again; another star has none of its keys.
    again = Study.read(tmp_path / "out" / "study.toml")
    assert (again.star[0].wavelength_unit, again.star[0].magnitude) == ("Angstrom", 8.0)
    (other,) = again.at("star", "G2V").star
    assert (other.library, other.file, other.wavelength_unit) == ("G2V", None, None)


@pytest.mark.long
def test_star_is_extended_and_binned(tmp_path: Path) -> None:
    more = ("--exposure", "5", "--no-pictures")
    flags = ("--star", DATA / "spectra" / "vb8_stiswfcnic_004.fits", "--extend", "M3V", "--bin-nm", "2", "-m", "9")
    shown = " ".join(run("simulate", *flags, *more, folder=tmp_path).stdout.split())
    assert "continued by M3V" in shown
    assert "113 of its 1349 points" in shown
    column = f"{DATA / 'spectra' / 'ckp00_5750.fits'}[g45]"
    assert "ckp00_5750" in run("simulate", "--star", column, "-m", "8", *more, folder=tmp_path).stdout


def test_plan_is_read_back_from_its_table_and_targets_are_not_an_answer(tmp_path: Path) -> None:
    """Accept both in place of a study file; only the table of an answer holds a study."""
    (tmp_path / "targets.csv").write_text("name,mass_msun,age_myr\neps Eri,0.82,500\nkappa1 Cet,,\n")
    words = ("--days", "10", "--hours", "50", "--completeness", "closed form", "--report", "html", "--no-pictures")
    assert "2 targets, 10 days" in run("plan", "targets.csv", *words, folder=tmp_path).stdout
    folder = tmp_path / "mauvecl-plan"
    assert (folder / "plan.html").exists()
    rows = json.loads(run("plan", folder / "plan.ecsv", "--json", "--no-pictures", folder=tmp_path).stdout)["rows"]
    assert [row["hours"] for row in rows] == [50.0, 50.0]
    assert rows[0]["expected"] > 0
    QTable({"name": ["eps Eri"]}).write(tmp_path / "targets.ecsv")
    run("visible", "targets.ecsv", "--days", "1", "--no-pictures", folder=tmp_path)


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}


def finished(folder: Path) -> dict[str, int]:
    """Return the parts that a run has finished, with the times at which they were written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("[!.]*.npz")}


def stopped(
    command: list[str], kept: Path, stop: signal.Signals, meanwhile: Callable[[], object] = lambda: None
) -> None:
    """Stop a command as soon as it has finished another part; what it had finished is kept, and not written again."""
    before = finished(kept)
    process = subprocess.Popen(command, cwd=kept.parents[1], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while finished(kept).keys() <= before.keys():
        time.sleep(0.005)
        assert process.poll() is None, process.communicate()
    meanwhile()
    process.send_signal(stop)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == CODES[stop]
    assert "Traceback" not in errors
    if stop != signal.SIGKILL:
        assert "kept in 'out/checkpoint', and the same command with --resume continues from there" in errors
    assert before.items() < finished(kept).items()


LONG = ("detect", "--star", "G2V", "-m", "7.4", "--statistic", "chi2", "-n", "100000", "--no-pictures", "-o", "out")
#: Files of somebody else in the folder of a checkpoint.
FOREIGN = ("epoch-1.pt", "mine.npz", "deep/keep", ".unfinished-mine")


@pytest.mark.long
def test_interrupted_run_is_resumed_to_the_same_bits(tmp_path: Path) -> None:
    """Resume after Ctrl-C, SIGTERM and SIGKILL; only files that a run wrote are removed, at a restart or the end."""
    command, shards = [*SMALL_SHARDS, *LONG, "--resume"], tmp_path / "out" / "checkpoint"
    (shards / "deep").mkdir(parents=True)
    for name in FOREIGN:
        (shards / name).write_text("keep me")

    def is_locked() -> None:
        for how in ("--restart", "--resume"):
            code, _, reported = ended(*LONG, how, folder=tmp_path)
            assert (code, "another" in reported) == (2, True), reported

    for stop, meanwhile in ((signal.SIGINT, is_locked), (signal.SIGTERM, bool), (signal.SIGKILL, bool)):
        stopped(command, shards, stop, meanwhile)
    kept = sum(int(path.stem.split("-")[-1]) for path in shards.glob("[!.]*-*-*-*.npz"))
    assert "--resume" in run(*LONG, folder=tmp_path, code=2).stderr
    (shards / f".unfinished-{next(shards.glob('*-*-*-*.npz')).name}").write_text("killed while it was written")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "run.json").read_text())["shards"]["resumed"] == kept
    assert {str(p.relative_to(shards)) for p in shards.rglob("*") if p.is_file()} == set(FOREIGN)
    run(*LONG[:-1], "alone", folder=tmp_path)
    for name in ("detection.ecsv", "tails.ecsv", "roc.ecsv", "departures.ecsv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    run(*LONG, "--restart", folder=tmp_path)
    assert {str(p.relative_to(shards)) for p in shards.rglob("*") if p.is_file()} == set(FOREIGN)


#: Studies, by verb, of which it finishes several parts.
STUDIES = DATA / "studies" / "resumed"


@pytest.mark.long
@pytest.mark.parametrize("verb", ["plan", "stare", "measure"])
def test_killed_run_is_resumed_to_the_same_bits(verb: str, tmp_path: Path) -> None:
    """Kill a run twice; the tables are those of an undisturbed run."""
    words = [verb, STUDIES / f"{verb}.toml", "--no-pictures", "--quiet"]
    again, kept = [*SMALL_SHARDS, *words, "--output", "out", "--resume"], tmp_path / "out" / "checkpoint"
    for _ in range(2):
        stopped(again, kept, signal.SIGKILL)
    refusal = run(*words, "--output", "out", folder=tmp_path, code=2).stderr
    assert "--resume" in refusal
    assert "--restart" in refusal
    done = subprocess.run(again, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not kept.exists()
    run(*words, "--output", "whole", folder=tmp_path)
    tables = sorted((tmp_path / "whole").glob("*.ecsv"))
    assert len(tables) >= 2
    for path in tables:
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["verb"] == verb


INVALID = ["[" * 100_000, "null", "[]", '{"attributes": []}', '{"attributes": {"study": "a = 1e999"}}']


@pytest.mark.parametrize("content", [*INVALID, '{"model": "mine"}'])
def test_foreign_manifest_is_kept_and_a_damaged_one_is_reported(content: str, tmp_path: Path) -> None:
    """A manifest without shards is foreign; one next to shards is a damaged one of mauvecl."""
    manifest = tmp_path / "out" / "checkpoint" / "manifest.json"
    manifest.parent.mkdir(parents=True)
    manifest.write_text(content)
    words = ("detect", "--star", "G2V", "-m", "7", "-n", "2000", "--fap", "0.1", "--no-pictures", "-o", "out")
    for how in ([], ["--resume"], ["--restart"]):
        assert "manifest.json" in run(*words, *how, folder=tmp_path, code=2).stderr
        assert manifest.read_text() == content
    (manifest.parent / f"{'0' * 32}-0-0-10.npz").write_bytes(b"")
    done = run(*words, "--resume", folder=tmp_path)
    assert "damaged" in done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.parametrize("name", ["f.fits", "f.h5"])
def test_export_to_a_full_disk_keeps_the_earlier_file(name: str, small_disk: Path, tmp_path: Path) -> None:
    run("realise", "--star", "G2V", "-m", "7.4", "-t", "5", "-n", "1500", "-o", "s.zarr", folder=tmp_path)
    (small_disk / name).write_text("of an earlier run")
    reported = run("export", "s.zarr", small_disk / name, "--replace", folder=tmp_path, code=2).stderr
    assert "cannot be written" in reported
    assert [(p.name, p.read_text()) for p in small_disk.iterdir()] == [(name, "of an earlier run")]


#: What is run, and packages that take a twentieth of a second and more to load, without which it can be done.
LIGHT: dict[str, set[str]] = {
    "import mauvecl, mauvecl.cli.app": {"pyopencl", "synphot", "astropy", "scipy"},
    "import mauvecl; mauvecl.expect, mauvecl.Source":
        {"synphot", "matplotlib", "pyopencl", "specutils", "astropy.table", "astropy.coordinates",
         "mauvecl.host.tables.opening"},
    "from mauvecl.cli.app import app; sys.argv[1:] = ['--help']; app(standalone_mode=False)":
        {"pyopencl", "synphot", "astropy", "scipy", "pydantic", "mauvecl.study"},
    "from mauvecl.schema.section import read_ranges; read_ranges(['5:6'], '--gap', expected='', unit='s')": {"astropy"},
}  # fmt: skip


@pytest.mark.parametrize("code", LIGHT)
def test_heavy_packages_are_loaded_only_where_they_are_needed(code: str) -> None:
    shown = python(f"import sys; {code}; print(sorted({LIGHT[code]} & sys.modules.keys()))").stdout
    assert shown.splitlines()[-1] == "[]"
