"""Every failure of the command line ends with one sentence and the exit code of its kind, without a traceback."""

import os
import re
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from commands import ended, run
from refusals import refused

from mauvecl import Source

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


@pytest.mark.long
def test_names_outside_of_the_encoding_are_escaped(tmp_path: Path) -> None:
    (tmp_path / "stérn.txt").write_text("170 1e-12\n400 1e-12\n800 1e-12\n")
    for encoding in ("ascii", "latin-1"):
        done = subprocess.run(
            [sys.executable, "-m", "mauvecl", *OBSERVE[:2], "--star", "stérn.txt", "-m", "6"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONIOENCODING": encoding, "MPLBACKEND": "agg"},
            capture_output=True,
        )
        assert done.returncode == 0, done.stderr
        assert b"st\\xe9rn" in done.stdout or "stérn".encode("latin-1") in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("path", [None, ""])
def test_linker_is_found_without_path(path: str | None, tmp_path: Path) -> None:
    """Compile kernels although PATH is unset, with which PoCL would end the process."""
    words = ("detect", "--star", "G2V", "-m", "7", "-n", "500", "--fap", "0.5", "--no-pictures", "--quiet")
    environment = {name: value for name, value in os.environ.items() if name != "PATH"}
    environment |= {"POCL_CACHE_DIR": str(tmp_path / "kernels")} | ({} if path is None else {"PATH": path})
    command = [sys.executable, "-m", "mauvecl", *words]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


NAMES = ("x" * 5000, "\udcff\udcfe", "y" * 300 + ".txt")
NUMBERS = ("1e-308", "5e-324", "1e-31", "1e31", "1e308", "9" * 5000, str(2**64), "0x" + "f" * 5000, "-" + "9" * 400)
#: Arrays, tables, a dotted key and a dotted table, which raised RecursionError or took 3.8 GB, and some arrays more
#: than any study has.
NESTED = ("a = " + "[" * 20_000 + "]" * 20_000, "a = " + "{b = " * 2000 + "1" + "}" * 2000,
          ".".join("a" * 50_000) + " = 1", "[" + ".".join("a" * 5000) + "]", "a = " + "[" * 40 + "]" * 40)  # fmt: skip
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
    *(((*ASK, f"{key}={value}"), "") for value in NUMBERS for key in KEYS),
    *(((*OBSERVE, "--instrument", "mine.toml"), f"extends = 'mauvesim'\nread_noise_dn = {one}\n") for one in NUMBERS),
    *((words, text) for text in NESTED for words in (
        ("simulate", "mine.toml"), ("simulate", "mine"), (*OBSERVE, "--instrument", "mine.toml"),
        (*OBSERVE, "--set", text.replace("a = ", "run.fap=")),
    )),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(IMPOSSIBLE)))
def test_impossible_words_and_files_are_refused(number: int, tmp_path: Path) -> None:
    """Refuse names that no file can have, extreme numbers, whole ones of 5000 digits, and nesting."""
    words, text = IMPOSSIBLE[number]
    (tmp_path / "deep").mkdir()
    for name in ("mine.toml", "mine", "deep/zarr.json"):
        (tmp_path / name).write_text(text)
    reported = run(*words, folder=tmp_path, code=2).stderr
    assert (reported[:9], reported.count("\n")) == ("mauvecl: ", 1)
    assert len(reported) < 1100


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
    # All turns are taken.
    with mock.patch.object(sandboxed_reader, "SECONDS", 0), ExitStack() as taken:
        for _ in range(sandboxed_reader.TOGETHER):
            taken.enter_context(sandboxed_reader._turns)
        with refused("upload", "too many"):
            sandboxed_reader.read_limited(Source, Source.read, star)
