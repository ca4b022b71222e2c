"""The command line as a user meets it: simulations, reruns, interruption, what it loads, and failures in a sentence."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from commands import SMALL_SHARDS, ended, run, started
from processes import python
from refusals import refused
from scenes import study_of_g2v
from tables import DATA, toml

from mauvecl import Engine, Source, Study, simulate
from mauvecl.cli import app


@pytest.mark.parametrize(("magnitude", "seconds"), [(7.4, 50.0), (-0.3, 10.0), (7.4, 1500.0)])
def test_simulation_equals_the_realisation_of_the_engine(magnitude: float, seconds: float, engine: Engine) -> None:
    """Compare also where frames saturate, and for more frames than are drawn at once."""
    part = {"exposure_s": seconds, "changes": {"output_min_nm": 300.0, "output_max_nm": 360.0}}
    star = [{"library": "G2V", "magnitude": magnitude}]
    asked = study_of_g2v(star=star, observation=part, run={"seed": 4})
    for _, x, table in simulate(asked, realisation=123).observations:
        np.testing.assert_array_equal(table["raw"].value, engine.realise(x, start=123, count=1, seed=4)[0])
        names = ("source", "sky", "photon_noise", "dark", "bias", "read_noise", "digitisation")
        if magnitude > 0:
            np.testing.assert_allclose(sum(table[name].value for name in names), table["raw"].value, rtol=1e-12)
            assert np.abs(table["digitisation"].value).max() <= 0.51 * max(1, np.sqrt(seconds / 10))


def test_schema_describes_every_key(tmp_path: Path) -> None:
    sections = json.loads(run("schema", folder=tmp_path).stdout)["$defs"]
    keys = {(name, key): one for name, of in sections.items() for key, one in of.get("properties", {}).items()}
    assert len(keys) > 120
    undescribed = {name for (name, _), one in keys.items() if "description" not in one and "$ref" not in str(one)}
    assert undescribed <= {"Processes", "CosmicRays", "Unknowns"}, "which the registry of unknowns describes"


def test_spectrum_of_a_file_is_simulated_as_asked_and_written_in_two_formats(tmp_path: Path) -> None:
    flags = ("--wavelength-unit", "Angstrom", "--extend", "M3V", "--bin-nm", "2", "-m", "8", "-a", "0.24", "-t", "10")
    shutil.copy(DATA / "spectra" / "10lac_stis_001.txt", tmp_path / "étoile.txt")
    words = ("--star", "étoile.txt", *flags, "--no-pictures", "-o", "out")
    shown = " ".join(run("simulate", *words, folder=tmp_path).stdout.split())
    table = QTable.read(tmp_path / "out" / "observation-2.ecsv")
    assert table["raw"].unit == "adu"
    with fits.open(tmp_path / "out" / "observation-2.fits") as hdus:
        hdus.verify("exception")
        assert hdus[1].header["EXPTIME"] == 10.0
        assert hdus[1].header["OBJECT"].startswith(r"\xe9toile"), "headers are ASCII"
        assert hdus[1].columns["wavelength"].unit == "nm"
        np.testing.assert_array_equal(hdus[1].data["raw"], table["raw"].value)
    if shutil.which("fitsverify"):
        verified = ["fitsverify", tmp_path / "out" / "observation-2.fits"]
        reported = subprocess.run(verified, capture_output=True, text=True, check=True).stdout
        assert "0 warning(s) and 0 error(s)" in reported, reported
    assert "seed 1 étoile: ASSUMED: flux in erg" in shown, "the first message"
    assert "ASSUMED: flux in erg" in (tmp_path / "out" / "run.json").read_text()
    # The study that was written reads the same star again; another star has none of its keys.
    again = Study.read(tmp_path / "out" / "study.toml")
    keys = ("wavelength_unit", "extend", "bin_nm", "magnitude")
    assert [getattr(again.star[0], key) for key in keys] == ["Angstrom", "M3V", 2.0, 8.0]
    (other,) = again.at("star", "G2V").star
    assert [getattr(other, key) for key in ("library", "file", *keys[:2])] == ["G2V", None, None, None]


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}


def finished(folder: Path) -> dict[str, int]:
    """Return the parts that a run has finished, with the times at which they were written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("[!.]*.npz")}


def stopped(command: list[str], kept: Path, stop: signal.Signals) -> None:
    """Stop a command as soon as it has finished another part; what it had finished is kept, and not written again."""
    before = finished(kept)
    process = subprocess.Popen(command, cwd=kept.parents[1], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while finished(kept).keys() <= before.keys():
        time.sleep(0.005)
        assert process.poll() is None, process.communicate()
    process.send_signal(stop)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == CODES[stop]
    assert "Traceback" not in errors
    if stop != signal.SIGKILL:
        assert "kept in 'out/checkpoint', and the same command with --resume continues from there" in errors
    assert before.items() < finished(kept).items()


#: Files of somebody else in the folder of a checkpoint.
FOREIGN = {"epoch-1.pt", "mine.npz", "deep/keep", ".unfinished-mine"}
#: Studies, by verb, of which it finishes several parts, and flags of a detection that does.
STUDIES = DATA / "studies" / "resumed"
LONG = ("--star", "G2V", "-m", "7.4", "--statistic", "chi2", "-n", "100000")


@pytest.mark.long
@pytest.mark.parametrize("verb", ["detect", "plan", "stare", "measure"])
def test_stopped_run_is_resumed_to_the_same_bits(verb: str, tmp_path: Path) -> None:
    """Resume after Ctrl-C, SIGTERM and SIGKILL; only files that a run wrote are removed, at a restart or the end."""
    asked = (verb, *(LONG if verb == "detect" else (STUDIES / f"{verb}.toml",)), "--no-pictures", "-o")
    command, shards = [*SMALL_SHARDS, *map(str, asked), "out", "--resume"], tmp_path / "out" / "checkpoint"
    (shards / "deep").mkdir(parents=True)
    for name in FOREIGN:
        (shards / name).write_text("keep me")

    def left() -> set[str]:
        return {str(path.relative_to(shards)) for path in shards.rglob("*") if path.is_file()}

    for stop in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL) if verb == "detect" else (signal.SIGKILL,) * 2:
        stopped(command, shards, stop)
    refusal = run(*asked, "out", folder=tmp_path, code=2).stderr
    assert "--resume" in refusal
    assert "--restart" in refusal
    parts = [*shards.glob("[!.]*-*-*-*.npz")]
    if verb == "detect":
        (shards / f".unfinished-{parts[0].name}").write_text("killed while it was written")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert left() == FOREIGN
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["verb"] == verb
    run(*asked, "whole", folder=tmp_path)
    tables = sorted((tmp_path / "whole").glob("*.ecsv"))
    assert len(tables) >= 2
    for path in tables:
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    if verb == "detect":
        assert record["shards"]["resumed"] == sum(int(path.stem.split("-")[-1]) for path in parts)
        run(*asked, "out", "--restart", folder=tmp_path)
        assert left() == FOREIGN


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
    "import mauvecl.cli.app as cli; sys.argv[1:] = ['--help']; cli.app(standalone_mode=False)":
        {"pyopencl", "synphot", "astropy", "scipy", "pydantic", "mauvecl.study"},
    "import mauvecl; mauvecl.detect(star='G2V', magnitude=7, amplitude=1, realisations=2000, fap=0.05).pictures":
        {"matplotlib", "astropy.coordinates", "mauvecl.observations", "mauvecl.search", "mauvecl.fits"},
}  # fmt: skip


@pytest.mark.parametrize("code", LIGHT)
def test_heavy_packages_are_loaded_only_where_they_are_needed(code: str) -> None:
    shown = python(f"import sys; {code}; print(sorted({LIGHT[code]} & sys.modules.keys()))").stdout
    assert shown.splitlines()[-1] == "[]"


@pytest.mark.long
def test_output_in_another_process_is_plain_json_alone_or_quiet(tmp_path: Path) -> None:
    """Run separate processes, because OpenCL drivers do not print through Python; errors go to standard error."""
    (tmp_path / "stérn.txt").write_text("170 1e-12\n400 1e-12\n1150 1e-12\n")
    words = ("detect", "--star", "stérn.txt", "-m", "8", "-a", "0.1", "-n", "10000", "--fap", "0.01", "--no-pictures")
    how = {"folder": tmp_path, "TERM": "xterm-256color", "PYTHONIOENCODING": "ascii"}
    loud, quiet, alone = (started(*words, *more, **how) for more in ((), ("--quiet",), ("--json",)))
    assert r"st\xe9rn" in loud.stdout, "names outside of the encoding are escaped"
    assert "detection.ecsv" in loud.stdout + loud.stderr
    assert "\x1b" not in loud.stdout + loud.stderr
    assert "detection.ecsv" not in quiet.stdout
    assert quiet.stderr == ""
    assert "matched" in quiet.stdout
    assert json.loads(alone.stdout)
    refused = started("detect", "--fap", "2", code=2, **how)
    assert (refused.stdout, "--fap" in refused.stderr, "\x1b" in refused.stderr) == ("", True, False)


#: Takes a twentieth of a second and more to load, and tells nobody that a value cannot be.
HEAVY = ("astropy", "erfa", "matplotlib", "numpy", "pyopencl", "scipy", "ssl", "synphot", "zarr")
MISTAKES = (DATA / "mistakes.txt").read_text(encoding="utf-8")
#: Runs command lines one after the other in one process, and tells after each what it has loaded.
TRIED = """
import atexit, gc, json, runpy, sys
atexit.register(lambda: print("frozen", gc.get_freeze_count() > 10_000, gc.get_stats()[0]["collections"] < 100))
for words in json.loads(sys.argv[1]):
    sys.argv = ["mauvecl", *words]
    try:
        runpy.run_module("mauvecl", run_name="__main__")
    except SystemExit as end:
        print(json.dumps([end.code, [name for name in HEAVY if name in sys.modules]]))
"""


def test_mistakes_load_no_heavy_package(tmp_path: Path) -> None:
    code = TRIED.replace("HEAVY", repr(HEAVY))
    asked = [["--version"], *map(shlex.split, MISTAKES.strip().splitlines())]
    lines = python(code, json.dumps(asked), folder=tmp_path).stdout.splitlines()
    reported = [json.loads(line) for line in lines if line.startswith("[")]
    # Nor is all of it looked through for circles at the end, or often before.
    assert lines[-1] == "frozen True True"
    assert list(zip(asked, reported, strict=True)) == [
        (words, [0 if words == ["--version"] else 2, []]) for words in asked
    ]


#: Code that interrupts a command while a module is imported, and code that wraps the interrupt in another error.
PLAIN = "Named().__set_name__(None, str())"
WRAPPED = (
    "type(str(), (), dict(name=Named()))",
    "real('pydantic_core').SchemaValidator(dict(type='literal', expected=[Named()]))",
)
DURING = [
    *((name, PLAIN) for name in ("importlib", "typing", "__future__", "mauvecl.host", "typer")),
    *((name, wrapped) for name in ("importlib", "typer") for wrapped in WRAPPED),
]


@pytest.mark.long
@pytest.mark.parametrize(
    "started", [["-m", "mauvecl"], ["-c", "import sys; sys.argv[0] = 'mauvecl'; import mauvecl.cli.app"]]
)
@pytest.mark.parametrize(("module", "within"), DURING)
def test_interrupt_during_imports_prints_one_line(started: list[str], module: str, within: str, tmp_path: Path) -> None:
    """Interrupt a command while a module is imported, also where Python or pydantic wraps the interrupt."""
    (tmp_path / "sitecustomize.py").write_text(
        "import builtins, os, signal\n"
        "real = builtins.__import__\n"
        "class Named:\n"
        "    def __set_name__(self, owner, name):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    __repr__ = lambda self: self.__set_name__(None, str())\n"
        "def imported(name, within=None, *given, **how):\n"
        f"    if name == {module!r} and (within or {{}}).get('__name__', '').startswith('mauvecl'):\n"
        "        builtins.__import__ = real\n"
        f"        {within}\n"
        "    return real(name, within, *given, **how)\n"
        "builtins.__import__ = imported\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, *started, "schema"], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.stderr == "mauvecl: interrupted\n"
    assert done.returncode in ((-2, 130, 1) if within in WRAPPED else (-2, 130))


#: Work done of a total every ten seconds, and what is shown of it: in a file and, of the last, on a terminal.
PROGRESS = toml("progress.toml")


@pytest.mark.parametrize("name", PROGRESS)
def test_progress_states_rate_and_time_left(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=1e6)
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: name == "terminal")
    with app.Meter() as meter:
        for done, total in PROGRESS[name]["steps"]:
            meter(done, total)
            clock.now += 10.0
    assert capsys.readouterr().err.rstrip("\n").split("\n") == PROGRESS[name]["lines"]


OBSERVE = ("simulate", "--no-pictures", "--star", "G2V", "--magnitude", "7.4")
DETECT = ("detect", "--no-pictures", "--star", "G2V", "-m", "7.4", "-a", "0.2", "-n", "5000", "--fap", "0.05")


def test_unexpected_error_writes_a_traceback_file(tmp_path: Path) -> None:
    def fails_at_the_record(handle: int) -> None:
        if "run.json" in Path(f"/proc/self/fd/{handle}").readlink().name:
            raise KeyError("what nobody foresaw")

    with mock.patch.object(os, "fsync", fails_at_the_record):
        code, _, reported = ended(*OBSERVE, "-o", "there", folder=tmp_path)
    assert code == 70
    (line,) = reported.splitlines()
    file = tmp_path / re.search(r"its traceback is in '(.*?)'", line)[1]
    assert file.parent == tmp_path / "there", "in the output folder"
    assert "Traceback" in file.read_text()
    assert "what nobody foresaw" in file.read_text()
    # What was written before is kept.
    assert (tmp_path / "there" / "observation-1.ecsv").exists()


@pytest.mark.long
@pytest.mark.parametrize("words", [("--help",), ("library", "--json")])
def test_unwritable_standard_output_is_reported(words: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "mauvecl", *words]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 74
    assert len(done.stderr.splitlines()) == 1
    assert "standard output cannot be written" in done.stderr
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as gone:
        done = subprocess.run(command, stdout=gone, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (141, "")


NAMES = ("x" * 5000, "\udcff\udcfe", "y" * 300 + ".txt")
NUMBERS = ("1e-308", "5e-324", "1e-31", "1e31", "1e308", "9" * 5000, str(2**64), "0x" + "f" * 5000, "-" + "9" * 400)
#: Arrays, tables, a dotted key and a dotted table, which raised RecursionError or took 3.8 GB, and some arrays more
#: than any study has.
NESTED = ("a = " + "[" * 20_000 + "]" * 20_000, "a = " + "{b = " * 2000 + "1" + "}" * 2000,
          ".".join("a" * 50_000) + " = 1", "[" + ".".join("a" * 5000) + "]", "a = " + "[" * 40 + "]" * 40)  # fmt: skip
#: Manifests of checkpoints that mauvecl has not written.
MANIFESTS = ("[" * 100_000, "null", "[]", '{"attributes": []}', '{"attributes": {"study": "a = 1e999"}}',
             '{"model": "mine"}')  # fmt: skip
ASK = ("exposure", "--snr", "5", "--at", "300", "--no-pictures", "--set")
KEYS = ("run.fap", "star.0.magnitude", "run.seed", "flare.temperature_k", "signal.snr")
#: Commands that tables of refusals cannot hold, with the text of the files that they name.
IMPOSSIBLE = [
    *(((*words.split(), name), "") for name in NAMES for words in (
        "simulate --star", "simulate", "simulate --instrument", "detect --flares", "verify", "library add",
        "detect --star G2V -n 5000 --fap .05 --cluster",
    )),
    ((*DETECT, "--cluster", "tcp://\udcff:1"), ""), ((*DETECT, "--cluster", "local:" + "9" * 5000), ""),
    (("library", "fetch", "ngsl:HD 1", "--from", "http://\udcff/"), ""), (("verify", "deep"), "[" * 100_000),
    *(((*DETECT, "-o", "deep", *how), text) for text in MANIFESTS for how in ((), ("--resume",), ("--restart",))),
    *(((*ASK, f"{key}={value}"), "") for value in NUMBERS for key in KEYS),
    *(((*OBSERVE, "--instrument", "mine.toml"), f"extends = 'mauvesim'\nread_noise_dn = {one}\n") for one in NUMBERS),
    *((words, text) for text in NESTED for words in (
        ("simulate", "mine.toml"), ("simulate", "mine"), (*OBSERVE, "--instrument", "mine.toml"),
        (*OBSERVE, "--set", text.replace("a = ", "run.fap=")),
    )),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(IMPOSSIBLE)))
def test_impossible_words_and_files_are_refused(number: int, tmp_path: Path) -> None:
    """Refuse names that no file can have, extreme numbers, whole ones of 5000 digits, nesting, and foreign runs."""
    words, text = IMPOSSIBLE[number]
    files = [tmp_path / name for name in ("mine.toml", "mine", "deep/zarr.json", "deep/checkpoint/manifest.json")]
    files[-1].parent.mkdir(parents=True)
    for file in files:
        file.write_text(text)
    reported = run(*words, folder=tmp_path, code=2).stderr
    assert (reported[:9], reported.count("\n")) == ("mauvecl: ", 1)
    assert len(reported) < 1100
    assert "-o" not in words or "manifest.json" in reported
    assert {file.read_text() for file in files} == {text}, "nobody's file is changed"


def test_stores_larger_than_the_disk_need_insist(tmp_path: Path) -> None:
    """Refuse `realise -n 1e12`, which needs petabytes."""
    words = ("realise", "--star", "G2V", "-m", "7", "-a", "0.1", "-t", "5")
    # Kernels have their folder before the disk is full.
    run(*words, "-n", "1", "-o", "one.zarr", folder=tmp_path)
    full = shutil.disk_usage(tmp_path)._replace(free=10 << 20)
    with mock.patch.object(shutil, "disk_usage", return_value=full):
        reported = run(*words, "-n", "100000", "-o", "s.zarr", folder=tmp_path, code=2).stderr
        most = int(re.search(r"give at most (\d+) or", reported)[1])
        assert "10 MiB" in reported
        assert str(most + 1) in run(*words, "-n", str(most + 1), "-o", "s.zarr", folder=tmp_path, code=2).stderr
        assert not (tmp_path / "s.zarr").exists()
        run(*words, "-n", str(most), "-o", "s.zarr", folder=tmp_path)
        run(*words, "-n", str(most + 1), "-o", "more.zarr", "--insist", folder=tmp_path)


@pytest.mark.long
def test_uploads_are_read_with_limited_memory_in_limited_time_and_number() -> None:
    from mauvecl.web import sandboxed_reader

    star = {"upload": b"".join(b"%f 1e-12\n" % nm for nm in np.linspace(170.0, 800.0, 150_000))}
    # Python itself takes longer to start than this time.
    for name, most, said in (("MEMORY_MIB", 64, "64 MiB"), ("SECONDS", 0.05, "0.05 s")):
        with mock.patch.object(sandboxed_reader, name, most), refused("upload", said):
            sandboxed_reader.read_limited(Source, Source.read, star)
    with mock.patch.object(sandboxed_reader, "SECONDS", 0), ExitStack() as taken:
        for _ in range(sandboxed_reader.TOGETHER):
            taken.enter_context(sandboxed_reader._turns)
        with refused("upload", "too many"):
            sandboxed_reader.read_limited(Source, Source.read, star)
