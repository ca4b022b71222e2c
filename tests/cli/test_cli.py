"""The command line as a user meets it: answers, files, reruns, refusals, interruption."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from commands import run, started

from mauvecl import __version__
from mauvecl.answers.detection.detect import detect
from mauvecl.answers.signal.simulate import simulate
from mauvecl.device.engine import Engine
from mauvecl.noise.processes import CosmicRays, Normal, Processes, Uniform
from mauvecl.schema.errors import InputError
from mauvecl.statistics.registry import STATISTICS
from mauvecl.study.cases import Case
from mauvecl.study.sections import Star
from mauvecl.study.study import Study


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Answer the default question with fewer realisations; return the folder and the output."""
    folder = tmp_path_factory.mktemp("detect")
    return folder, started("detect", "-n", "100000", folder=folder).stdout


@pytest.mark.long
def test_detect_answers_the_question_of_the_paper(answered: tuple[Path, str]) -> None:
    folder, text = answered
    lines = text.splitlines()
    assert "not a flight calibration" in lines[0]
    assert lines[1] == "Magnitudes in V are as in catalogues: Vega has 0.03."
    assert "false-alarm probability of 0.001 per test, 50 s (10 frames), 100,000 realisations" in lines[4]
    # The payload, that everything is taken as known, and the chance if it is not.
    assert lines[3].startswith("Assumed: instrument mauve, ")
    assert "; everything known but the noise; " in lines[3]
    assert lines[2].startswith(
        "Everything but the noise is taken as known: G2V V = 7.4, flare of 0.76 % is then detected"
    )
    assert (
        "a chance of 57.0 %, with the usual unknowns of 2.7 % (closed forms; --with-unknowns draws them)." in lines[2]
    )
    # The same line says what the usual unknowns are, and no other one speaks of them.
    assert lines[2].endswith("These are the dark level (free), the light level (free) and the sky level (+-10 %).")
    assert sum("unknowns" in line for line in lines) == 1
    assert "\x1b" not in text
    table = QTable.read(folder / "mauvecl-detect" / "detection.ecsv")
    assert len(table) == 2 * 4 * 3
    assert set(table["star"]) == {"K3V V = 3.7", "G2V V = 7.4"}
    assert set(table["amplitude"]) == {0.0076, 0.02, 0.081, 0.24}
    assert set(table["statistic"]) == {"chi2", "chi2_element", "matched"}
    assert np.all((table["low"] <= table["probability"]) & (table["probability"] <= table["high"]))
    np.testing.assert_allclose(table["mean"], table["expected"], rtol=0.01)
    # The calibrated answer: the 24 % flare is certain on both, the smallest is lost in the pixels' noise of the G2V.
    row = {(r["star"][:3], r["amplitude"], r["statistic"]): r["probability"] for r in table}
    assert row["G2V", 0.24, "chi2"] == row["K3V", 0.0076, "chi2"] == 1.0
    assert row["G2V", 0.0076, "chi2"] < 0.01 < 0.4 < row["G2V", 0.0076, "matched"]


@pytest.mark.long
def test_detect_compares_with_the_values_of_the_paper(answered: tuple[Path, str]) -> None:
    """Both of the paper's values are reconstructed within 30 %, and the text says why a calibrated answer differs."""
    _, text = answered
    for amplitude, reduced in (("8.1 %", 0.66), ("24 %", 3.75)):
        line = next(x for x in text.splitlines() if x.startswith(f"G2V, {amplitude} flare"))
        assert f"reduced {reduced:g}" in line
        ours = float(line.split("reconstructed here ")[1].split()[0])
        assert ours == pytest.approx(reduced, rel=0.3)
    assert "no calibrated chi-squared" in text


@pytest.mark.long
def test_detect_writes_files_and_record(answered: tuple[Path, str]) -> None:
    folder, text = answered
    out = folder / "mauvecl-detect"
    tables = {"detection.ecsv", "departures.ecsv", "roc.ecsv", "tails.ecsv"}
    names = tables | {"detection.png", "spectra.png", "study.toml", "run.json"}
    assert {path.name for path in out.iterdir()} == names
    assert all(name in text.splitlines()[-1] for name in names)
    record = json.loads((out / "run.json").read_text())
    assert record["seed"] == 1
    assert record["study"]["run"]["realisations"] == 100_000
    assert len(record["inputs"]) == 10
    assert all(len(entry["source digest"]) == 64 for entry in record["inputs"])
    assert {"devices", "kernels", "wall_time_s", "mauvecl", "messages"} <= set(record)
    for picture in ("detection.png", "spectra.png"):
        assert (out / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.long
def test_detect_takes_all_statistics(tmp_path: Path) -> None:
    """Ask for six statistics with noisy references and estimated variances, and read the written study."""
    words = ("detect", "--star", "G2V", "-m", "7.4", "-a", "0.1", "-n", "20000", "--fap", "0.01", "--no-pictures")
    shown = run(*words, "--statistic", "all", "--reference", "stack:3", "--variances", "estimated", folder=tmp_path)
    for statistic in STATISTICS:
        assert f" {statistic} " in shown.stdout
    asked = Study.read(tmp_path / "mauvecl-detect" / "study.toml").run
    assert (asked.reference, asked.variances, asked.statistics) == ("stack:3", "estimated", tuple(STATISTICS))


@pytest.mark.long
def test_written_study_gives_the_same_bits(answered: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = answered
    first = folder / "mauvecl-detect"
    run("detect", first / "study.toml", "--no-pictures", "-o", "again", folder=tmp_path)
    assert (tmp_path / "again" / "detection.ecsv").read_text() == (first / "detection.ecsv").read_text()
    assert (tmp_path / "again" / "study.toml").read_text() == (first / "study.toml").read_text()


@pytest.mark.long
def test_study_is_read_from_a_table(answered: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = answered
    table = folder / "mauvecl-detect" / "detection.ecsv"
    assert Study.read(table) == Study.read(folder / "mauvecl-detect" / "study.toml")
    (tmp_path / "no.ecsv").write_text("a b\n1 2\n")
    assert "table 'no.ecsv' cannot be read" in run("detect", "no.ecsv", folder=tmp_path, code=2).stderr


def test_study_defines_weights(tmp_path: Path, engine: Engine) -> None:
    """The closed form and the simulation of a band around 280 nm agree, and bad files raise."""
    (tmp_path / "band.txt").write_text("# nm, per DN\n270 1\n290 1\n")
    (tmp_path / "study.toml").write_text(
        "[[star]]\nlibrary = 'G2V'\nmagnitude = 7.4\n[flare]\namplitudes = [0.03]\n"
        "[run]\nrealisations = 20000\nfap = 0.01\n[run.weights]\nband = 'band.txt'\n"
    )
    table = detect(Study.read(tmp_path / "study.toml"), engine).table
    (row,) = table[table["statistic"] == "band"]
    assert row["mean"] == pytest.approx(row["expected"], rel=0.02)
    assert abs(row["probability"] - row["closed_form_probability"]) < 0.03
    for text in ("270\n290\n", "a b\n", "290 1\n270 1\n"):
        (tmp_path / "band.txt").write_text(text)
        with pytest.raises(InputError) as error:
            detect(Study.read(tmp_path / "study.toml"), engine)
        assert error.value.expected


def test_flags_override_the_study_file(tmp_path: Path) -> None:
    """Combine a study with the user's own spectrum and flags; with --json, standard output holds nothing else."""
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
    assert len(answer["rows"]) == 1
    assert answer["rows"][0]["star"] == "mine V = 6"
    assert any("15 s" in message for message in answer["messages"])
    text = (elsewhere / "mauvecl-detect" / "study.toml").read_text()
    assert "none = true" in text
    assert "target" not in text
    assert "seed = 7" in text


def test_study_reddens_its_star() -> None:
    plain, behind = (Star(library="G2V", magnitude=7.4, ebv=e).source() for e in (None, 0.3))
    assert behind.magnitude("V") == pytest.approx(plain.magnitude("V"), abs=1e-9)
    assert behind.magnitude("GALEX NUV") > plain.magnitude("GALEX NUV") + 1


PROCESSES = """
[[star]]
library = "G2V"
magnitude = 6
[flare]
amplitudes = [0.1]
[observation]
exposure_s = 10
recipe = "joint"
[processes]
jitter = { uniform = [0.0, 0.05] }
detector_temperature = { normal = [21, 2], between = [13, 25] }
[processes.cosmic_rays]
rate_per_cm2_s = 500
[run]
realisations = 2000
fap = 0.1
"""


@pytest.mark.long
def test_study_has_processes(tmp_path: Path, engine: Engine) -> None:
    """Compare with the engine's processes in Python, and with the study that is written back."""
    (tmp_path / "study.toml").write_text(PROCESSES)
    study = Study.read(tmp_path / "study.toml")
    processes = Processes(
        cosmic_rays=CosmicRays(rate_per_cm2_s=500),
        jitter=Uniform(0.0, 0.05),
        detector_temperature=Normal(21, 2, 13, 25),
    )
    assert Case(study).draw_options == {"mode": "auto", "recipe": "joint", "processes": processes}
    (tmp_path / "again.toml").write_text(study.toml())
    assert Study.read(tmp_path / "again.toml") == study
    found = detect(study, engine).stars[0].detection
    quiet, *flares = Case(study).expectations
    wanted = engine.detect(quiet, flares, realisations=2000, seed=1, processes=processes)
    np.testing.assert_array_equal(found.distribution("chi2", 0).counts, wanted.distribution("chi2", 0).counts)
    plain = engine.detect(quiet, flares, realisations=2000, seed=1)
    assert (found.distribution("chi2", 0).counts != plain.distribution("chi2", 0).counts).any()
    assert "cosmic_rays" in simulate(study).observations[0][2].colnames


@pytest.mark.long
def test_simulate_writes_components(tmp_path: Path) -> None:
    run("simulate", "--star", "G2V", "-m", "7.4", "-a", "0.24", "-t", "10", "-o", "out", folder=tmp_path)
    table = QTable.read(tmp_path / "out" / "observation-2.ecsv")
    parts = ("source", "sky", "photon_noise", "dark", "bias", "read_noise", "digitisation")
    np.testing.assert_allclose(sum(table[name] for name in parts).value, table["raw"].value, rtol=1e-12)
    assert np.abs(table["digitisation"].value).max() <= 0.51
    assert table["raw"].unit == "adu"
    with fits.open(tmp_path / "out" / "observation-2.fits") as hdus:
        hdus.verify("exception")
        assert hdus[1].header["EXPTIME"] == 10.0
        np.testing.assert_array_equal(hdus[1].data["raw"], table["raw"].value)
    assert (tmp_path / "out" / "observation-2.png").exists()


@pytest.mark.parametrize("at_once", [1, 256])
def test_simulation_equals_the_realisation_of_the_engine(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from scenes import instrument, star

    from mauvecl.device.engine import Engine
    from mauvecl.noise.components import components

    monkeypatch.setattr("mauvecl.noise.components.FRAMES_AT_ONCE", at_once)
    for options in ({"exposure": 50.0}, {"exposure": 10.0, "magnitude": -0.3}):
        (x,) = star(payload=instrument(part=True), **options)
        table = components(x, realisation=123, seed=4)
        np.testing.assert_array_equal(table["raw"].value, Engine().realise(x, start=123, count=1, seed=4)[0])


@pytest.mark.long
def test_components_of_a_simulation_have_their_variances() -> None:
    """Compare photon and read noise separately: 197 pixels x 30 realisations, within 5 standard errors."""
    from scenes import instrument, star

    from mauvecl.noise.components import components

    (x,) = star(magnitude=4.0, payload=instrument(part=True))
    tables = [components(x, realisation=i, seed=4) for i in range(30)]
    gain, n = x.gain_dn_per_electron, 30 * x.wavelength_nm.size
    photon = np.array([t["photon_noise"].value for t in tables]) / np.sqrt(gain * x.recorded_light_dn)
    read = np.array([t["read_noise"].value for t in tables]) / np.sqrt(x.n_frames * 144 + (x.n_frames - 1) / 12)
    for z in (photon, read):
        assert abs((z**2).sum() - n) < 5 * np.sqrt(2 * n)
    assert abs((photon * read).sum()) < 5 * np.sqrt(n)


@pytest.mark.long
def test_snr_writes_its_tables(tmp_path: Path) -> None:
    done = run("snr", "--star", "B2IV", "-m", "3.03", "-t", "5", "-n", "5000", "-o", "out", folder=tmp_path)
    assert "S/N per 10.5 nm element" in done.stdout
    table = QTable.read(tmp_path / "out" / "snr-element.ecsv")
    np.testing.assert_allclose(table["mean"], table["expected"], rtol=1e-3)
    assert np.all(table["q2.5"] < table["q97.5"])
    names = {"snr-pixel.ecsv", "noise-budget.ecsv", "noise-budget.png", "snr.png"}
    assert names <= {p.name for p in (tmp_path / "out").iterdir()}


@pytest.mark.long
def test_snr_answers_the_budgets_of_the_paper_and_sweeps(tmp_path: Path) -> None:
    """Check the paper's three stars without arguments, and all combinations and lists of a sweep."""
    shown = run("snr", "-n", "500", folder=tmp_path).stdout
    for name in ("B2IV V = 3.03", "K3V V = 3.7", "G2V V = 7.4"):
        assert len([line for line in shown.splitlines() if name in line and " 600 " in line]) == 8
    assert {"noise-budget.png", "snr-sweep.png"} <= {p.name for p in (tmp_path / "mauvecl-snr").iterdir()}
    words = ("snr", "--star", "G2V", "--sweep", "magnitude=5,7", "--sweep", "exposure=5,50", "--as-list", "-n", "500")
    run(*words, "--no-pictures", "-o", "swept", folder=tmp_path)
    table = QTable.read(tmp_path / "swept" / "snr-element.ecsv")
    assert {(m.value, t.value) for m, t in zip(table["magnitude"], table["exposure"], strict=True)} == {(5, 5), (7, 50)}
    # Read back from a table, the study gives it again.
    run("snr", tmp_path / "swept" / "snr-element.ecsv", "--no-pictures", "-o", "again", folder=tmp_path)
    for name in ("snr-element.ecsv", "snr-pixel.ecsv"):
        assert (tmp_path / "again" / name).read_text() == (tmp_path / "swept" / name).read_text()


@pytest.mark.long
def test_gaussian_writes_its_tables(tmp_path: Path) -> None:
    words = ("--star", "G2V", "-n", "10000", "--fap", "0.01", "--sweep", "magnitude=6,9", "--statistic", "matched")
    shown = run("gaussian", *words, folder=tmp_path).stdout
    assert "The root-of-N formula and 10,000 realisations" in shown
    names = {"gaussian.ecsv", "elements.ecsv", "thresholds.ecsv", "gaussian.png", "study.toml", "run.json"}
    assert {p.name for p in (tmp_path / "mauvecl-gaussian").iterdir()} == names


def test_wrong_template_loses_snr(engine: Engine) -> None:
    """A search for a flare of 5000 K detects one of 10000 K less often; a message states the S/N that remains."""
    run = [
        "run.realisations=50000",
        "run.fap=0.01",
        "run.statistics=['matched']",
        "run.template_temperatures_k=[5000, 10000]",
    ]
    study = Study().with_settings(["star=[{library='G2V', magnitude=7.4}]", "flare.amplitudes=[0.01]", *run])
    answer = detect(study, engine)
    kept = [float(line.split(" keeps ")[1].split()[0]) for line in answer.messages if " keeps " in line]
    assert 50 < kept[0] < 95
    assert kept[1] == 100.0
    table = answer.table
    p = dict(zip(table["statistic"], table["probability"], strict=True))
    assert p["matched 5000 K"] < p["matched"] == p["matched 10000 K"]


def test_limit_writes_its_table(tmp_path: Path) -> None:
    """Check the table, its files, and that the written study gives the same bits."""
    words = ("--star", "G2V", "-a", "0.24", "-n", "20000", "--fap", "0.01", "--statistic", "matched")
    shown = run("limit", *words, folder=tmp_path).stdout
    assert "Limit of magnitude" in shown
    assert "confirms it" in shown
    assert "not a flight calibration" in shown
    first = tmp_path / "mauvecl-limit"
    assert {p.name for p in first.iterdir()} == {"limit.ecsv", "limit.png", "study.toml", "run.json"}
    run("limit", first / "study.toml", "-o", "again", "--no-pictures", folder=tmp_path)
    assert (tmp_path / "again" / "limit.ecsv").read_text() == (first / "limit.ecsv").read_text()
    answer = json.loads(run("limit", *words, "--of", "exposure", "-m", "9", "--json", folder=tmp_path).stdout)
    assert answer["rows"][0]["exposure"] % 5 == 0


def test_exposure_prints_its_row(tmp_path: Path) -> None:
    words = ("exposure", "--snr", "10", "--at", "300", "--star", "G2V", "-m", "7.4")
    assert "S/N of 10 per element at 300 nm" in run(*words, folder=tmp_path).stdout
    row = json.loads(run(*words, "--json", folder=tmp_path).stdout)["rows"][0]
    assert row["snr_one_frame_less"] < 10 <= row["snr"]


@pytest.mark.long
def test_map_writes_its_table(tmp_path: Path) -> None:
    words = ("--star", "G2V", "--x", "magnitude:6:9:3", "--y", "amplitude=0.05,0.2", "-n", "20000", "--fap", "0.01")
    shown = run("map", *words, "--statistic", "matched", folder=tmp_path).stdout
    assert "detection probability in percent, matched" in shown
    first = tmp_path / "mauvecl-map"
    assert {p.name for p in first.iterdir()} == {"map.ecsv", "map.fits", "map.png", "study.toml", "run.json"}
    run("map", first / "study.toml", "-o", "again", "--no-pictures", folder=tmp_path)
    averaged = run(
        "map", *words, "--statistic", "matched", "--unknown", "2", "-o", "u", "--no-pictures", folder=tmp_path
    )
    assert "averaged over 2 draws of what is unknown" in averaged.stdout
    assert (tmp_path / "again" / "map.ecsv").read_text() == (first / "map.ecsv").read_text()


def test_any_key_can_be_set(tmp_path: Path) -> None:
    words = ("snr", "--star", "G2V", "-m", "6", "-n", "1000", "--no-pictures", "--quiet")
    settings = (
        "--set",
        "star.0.magnitude=5",
        "--set",
        "observation.exposure_s = 10",
        "--set",
        "sky.surface_brightness=21",
    )
    run(*words, *settings, folder=tmp_path)
    study = Study.read(tmp_path / "mauvecl-snr" / "study.toml")
    assert (study.star[0].magnitude, study.observation.exposure_s, study.sky.surface_brightness) == (5, 10, 21)


def test_schema_describes_every_key(tmp_path: Path) -> None:
    schema = json.loads(run("schema", folder=tmp_path).stdout)
    assert set(schema["properties"]) == set(Study.model_fields)


def test_library_and_devices_are_listed(tmp_path: Path) -> None:
    assert "HD 40307" in run("library", folder=tmp_path).stdout
    assert len(json.loads(run("library", "--json", folder=tmp_path).stdout)) >= 25
    assert json.loads(run("devices", "--no-rate", "--json", folder=tmp_path).stdout)[0]["default"]
    assert run("--version", folder=tmp_path).stdout == f"mauvecl {__version__}\n"


def test_saturation_is_the_first_message(tmp_path: Path) -> None:
    done = run("simulate", "--star", "B2IV", "-m", "0.5", "-t", "5", "--no-pictures", folder=tmp_path)
    first = done.stdout.splitlines()[0]
    assert first.startswith("SATURATED: ")
    assert " nm reach " in first
    assert "the longest safe frame is " in first


#: The command line with small shards, so that a run of a second has several; shards change no answer.
SMALL_SHARDS = [
    sys.executable,
    "-c",
    "import mauvecl.runs.shards as s; s.SHARD_WORK = 2**27; from mauvecl.cli.app import main; main()",
]
LONG = (
    "detect",
    "--star",
    "G2V",
    "-m",
    "7.4",
    "--statistic",
    "chi2",
    "-n",
    "100000",
    "--no-pictures",
    "--output",
    "out",
)


@pytest.mark.long
def test_interrupted_run_is_resumed_to_the_same_bits(tmp_path: Path) -> None:
    """Resume after Ctrl-C, SIGTERM and SIGKILL; the last run writes the tables of an undisturbed one."""
    command, shards, kept = [*SMALL_SHARDS, *LONG, "--resume", "--keep-after", "0"], tmp_path / "out" / "checkpoint", 0

    def counted() -> int:
        return sum(int(path.stem.split("-")[-1]) for path in shards.glob("[!.]*.npz"))

    for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while counted() == kept:
            time.sleep(0.005)
            assert process.poll() is None
        process.send_signal(stop)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[stop]
        assert "Traceback" not in errors
        if stop != signal.SIGKILL:
            assert "kept in 'out/checkpoint', and the same command with --resume continues from there" in errors
        assert counted() > kept
        kept = counted()
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "run.json").read_text())["shards"]["resumed"] == kept
    assert not shards.exists()
    alone = tmp_path / "alone"
    alone.mkdir()
    run(*LONG, folder=alone)
    for name in ("detection.ecsv", "tails.ecsv", "roc.ecsv", "departures.ecsv"):
        assert (tmp_path / "out" / name).read_bytes() == (alone / "out" / name).read_bytes()


def test_import_loads_no_heavy_package() -> None:
    """Importing the package, or asking for help, loads neither OpenCL nor synphot nor astropy."""
    heavy = "('pyopencl', 'synphot', 'astropy', 'scipy')"
    code = f"import sys, mauvecl, mauvecl.cli.app; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_help_imports_no_study() -> None:
    """Check that `mauvecl --help` does not build the models of a study, which would take most of its time."""
    code = "import sys; sys.argv[1:] = ['--help']; from mauvecl.cli.app import app; app(standalone_mode=False)"
    code += "; print('pydantic' in sys.modules, 'mauvecl.study.study' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.endswith("False False\n")
