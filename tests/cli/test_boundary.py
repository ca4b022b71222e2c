"""Every failure of the command line ends with one sentence and the exit code of its kind, without a traceback."""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from commands import ended, run
from refusals import refused as refused_by_key

from mauvecl import Instrument, detect, exposure
from mauvecl.cli import foresight
from mauvecl.schema.errors import InputError
from mauvecl.study.study import Study

OBSERVE = ("simulate", "--no-pictures", "--star", "G2V", "--magnitude", "7.4")
DETECT = ("detect", "--no-pictures", "--star", "G2V", "-m", "7.4", "-a", "0.2", "-n", "5000", "--fap", "0.05")


def write_star(path: Path) -> None:
    np.savetxt(path, np.transpose([np.linspace(170.0, 800.0, 200), np.full(200, 1e-12)]))


@pytest.mark.long
def test_unexpected_error_writes_a_traceback_file(tmp_path: Path) -> None:
    def fail(*_: object, **__: object) -> None:
        raise KeyError("what nobody foresaw")

    with mock.patch("mauvecl.answers.files.write_record", fail):
        code, _, reported = ended(*OBSERVE, "-o", "there", folder=tmp_path)
    assert code == 70
    (line,) = reported.splitlines()
    file = Path(re.search(r"its traceback is in '(.*?)'", line)[1])
    assert file.resolve().parent == tmp_path / "there", "in the output folder"
    text = (tmp_path / file).read_text()
    assert "Traceback" in text
    assert "what nobody foresaw" in text
    # What was written before is kept.
    assert (tmp_path / "there" / "observation-1.ecsv").exists()
    with mock.patch("mauvecl.host.stars.catalogue.library_table", fail):
        code, _, reported = ended("library", folder=tmp_path)
    assert code == 70
    file = Path(re.search(r"its traceback is in '(.*?)'", reported)[1])
    assert "Traceback" in file.read_text()
    file.unlink()


def test_help_and_documentation_name_every_exit_code() -> None:
    from mauvecl.cli import boundary

    documented = (Path(__file__).parents[2] / "docs" / "command-line.md").read_text()
    for code in (1, 2, 70, 74, 130, 141, 143):
        assert f" {code} " in boundary.EXIT_CODES
        assert f"| {code} |" in documented


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
    write_star(tmp_path / "stérn.txt")
    for encoding in ("ascii", "latin-1"):
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "mauvecl",
                "exposure",
                "--snr",
                "5",
                "--at",
                "300",
                "--star",
                "stérn.txt",
                "-m",
                "6",
            ],
            cwd=tmp_path,
            env=os.environ | {"PYTHONIOENCODING": encoding, "MPLBACKEND": "agg"},
            capture_output=True,
        )
        assert done.returncode == 0, done.stderr
        assert b"st\\xe9rn" in done.stdout or "stérn".encode("latin-1") in done.stdout


def test_names_are_not_parsed_as_markup(tmp_path: Path) -> None:
    """Brackets and colons of names stay in tables as they are."""
    name = "[bold]a:star:[red].txt"
    write_star(tmp_path / name)
    assert "[bold]a:star:[red]" in run(*OBSERVE[:2], "--star", name, "-m", "7", folder=tmp_path).stdout


@pytest.mark.parametrize("path", [None, ""])
def test_linker_is_found_without_path(path: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the linker although PATH is unset, since PoCL would end the process."""
    from mauvecl.device.program import load_opencl

    monkeypatch.setenv("PATH", "x")
    if path is None:
        monkeypatch.delenv("PATH")
    else:
        monkeypatch.setenv("PATH", path)
    load_opencl()
    assert shutil.which("ld", path=os.environ["PATH"]) is not None


# Kinds of input, each with what the old code did.

LONG, NOT_TEXT, CONTROL = "x" * 5000, "\udcff\udcfe", "y" * 300 + ".txt"
NAMES = [LONG, NOT_TEXT, CONTROL]


def refused(*words: str, folder: Path) -> str:
    """Run the command, check that it fails with one sentence, and return the sentence."""
    code, _, reported = ended(*words, folder=folder)
    assert code == 2, reported
    (line,) = reported.splitlines()
    assert line.startswith("mauvecl: ")
    assert len(line) < 1100
    return line


@pytest.mark.parametrize("name", NAMES, ids=["long", "undecodable", "a long part"])
@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "--star"),
        ("simulate",),
        ("simulate", "--instrument"),
        ("detect", "--flares"),
        ("verify",),
        ("library", "add"),
        ("detect", "--star", "G2V", "-n", "5000", "--fap", ".05", "--cluster"),
    ],
    ids=lambda words: words[-1],
)
def test_invalid_file_names_exit_with_code_2(words: tuple[str, ...], name: str, tmp_path: Path) -> None:
    """Refuse over-long names, which raised OSError 36."""
    refused(*words, name, folder=tmp_path)


NUMBERS = ["1e-308", "5e-324", "1e-31", "1e31", "1e308", "9" * 5000, str(2**64), "0x" + "f" * 5000, "-" + "9" * 400]


@pytest.mark.parametrize("value", NUMBERS, ids=lambda value: value[:8])
@pytest.mark.parametrize("key", ["run.fap", "star.0.magnitude", "run.seed", "flare.temperature_k", "signal.snr"])
def test_extreme_numbers_in_settings_raise(key: str, value: str) -> None:
    """Values such as fap = 1e-308 and whole numbers of 5000 digits end in one short sentence."""
    with pytest.raises(InputError) as error:
        exposure(Study().with_settings(["signal={snr=5, wavelength_nm=300}", f"{key}={value}"]))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1100


def test_long_number_is_shortened_in_the_message(tmp_path: Path) -> None:
    refused("exposure", "--snr", "5", "--at", "300", "--set", f"run.seed={'9' * 5000}", folder=tmp_path)


def test_extreme_numbers_in_instruments_raise(tmp_path: Path) -> None:
    for value in NUMBERS:
        (tmp_path / "mine.toml").write_text(f"extends = 'mauve'\nread_noise_dn = {value}\n")
        with pytest.raises(InputError) as error:
            Instrument.load(tmp_path / "mine.toml")
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 1100
    refused(*OBSERVE, "--instrument", "mine.toml", folder=tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 20_000 + "]" * 20_000,
        "a = " + "{b = " * 2000 + "1" + "}" * 2000,
        ".".join("a" * 50_000) + " = 1",
        "[" + ".".join("a" * 5000) + "]",
        "a = " + "[" * 40 + "]" * 40,
    ],
    ids=["arrays", "tables", "a dotted key", "a dotted table", "a few more than any study"],
)
def test_deep_nesting_is_refused(text: str, tmp_path: Path) -> None:
    """Refuse keys of 50 000 parts, which raised RecursionError or took 3.8 GB."""
    (tmp_path / "deep.toml").write_text(text)
    refused("simulate", "deep.toml", folder=tmp_path)
    refused(*OBSERVE, "--instrument", "deep.toml", folder=tmp_path)
    refused(*OBSERVE, "--set", text.replace("a = ", "run.fap="), folder=tmp_path)


def test_too_many_frames_are_refused(tmp_path: Path) -> None:
    """Refuse frames of a nanosecond, whose number overflowed the kernels' 32 bits."""
    assert "frames" in refused(*OBSERVE, "--set", "observation.changes.frame_s=1e-9", folder=tmp_path)


@pytest.mark.long
def test_long_chains_of_instruments_are_refused(tmp_path: Path) -> None:
    for i in range(100):
        (tmp_path / f"{i}.toml").write_text(f"extends = '{i + 1}.toml'\n")
    (tmp_path / "100.toml").write_text("extends = 'mauve'\n")
    assert "chain" in refused(*OBSERVE, "--instrument", "0.toml", folder=tmp_path)
    run(*OBSERVE, "--instrument", "90.toml", folder=tmp_path)


@pytest.mark.parametrize(
    "content", ["[" * 100_000, "null", "[]", '{"attributes": []}', '{"attributes": {"study": "a = 1e999"}}']
)
def test_invalid_manifests_are_refused(content: str, tmp_path: Path) -> None:
    """Refuse nested JSON. A manifest without shards is foreign; one next to shards is a damaged one of mauvecl."""
    for folder, name in (("store", "zarr.json"), ("run/checkpoint", "manifest.json")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / name).write_text(content)
    assert "not a store" in refused("verify", "store", folder=tmp_path)
    from mauvecl.runs.checkpoint import Checkpoint

    with (
        refused_by_key("folder"),
        Checkpoint(tmp_path / "run", "detect", Study(), resume=True),
    ):
        pass
    assert (tmp_path / "run" / "checkpoint" / "manifest.json").read_text() == content
    (tmp_path / "run" / "checkpoint" / f"{'0' * 32}-0-0-10.npz").write_bytes(b"")
    with Checkpoint(tmp_path / "run", "detect", Study(), resume=True) as checkpoint:
        assert "damaged" in checkpoint.messages[0]


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    """Refuse /dev/zero, which took all memory, and pipes, which were waited for without end."""
    os.mkfifo(tmp_path / "pipe")
    for kind in ("toml", "ecsv", "csv", "txt"):
        (tmp_path / f"zero.{kind}").symlink_to("/dev/zero")
        (tmp_path / f"pipe.{kind}").symlink_to("pipe")
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "zarr.json").symlink_to("/dev/zero")
    (tmp_path / "data" / "stars").mkdir(parents=True)
    (tmp_path / "data" / "stars" / "mine.ecsv").symlink_to("/dev/zero")
    for name in ("zero", "pipe"):
        (tmp_path / f"{name}-curve.toml").write_text(f"extends = 'mauve'\nfibre_efficiency = '{name}.ecsv'\n")
        (tmp_path / f"{name}-map.toml").write_text(f"extends = 'mauve'\npixel_map = '{name}.ecsv'\n")
        for words in (
            ("simulate", f"{name}.toml"),
            ("simulate", f"{name}.ecsv"),
            (*OBSERVE, "--instrument", f"{name}.toml"),
            (*OBSERVE, "--instrument", f"{name}-curve.toml"),
            (*OBSERVE, "--instrument", f"{name}-map.toml"),
            ("detect", "--flares", f"{name}.csv"),
            (*DETECT, "--set", f"run.weights.mine='{name}.txt'"),
        ):
            assert "regular file" in refused(*words, folder=tmp_path), words
    refused("verify", "store", folder=tmp_path)
    with mock.patch.dict(os.environ, {"MAUVECL_DATA_DIR": str(tmp_path / "data")}):
        assert "regular file" in refused("library", folder=tmp_path)


@pytest.mark.parametrize(
    "weights",
    [
        "200 0\n700 0",
        "200 1e300\n700 1",
        "200 1e-320\n700 1",
        "200 nan\n700 1",
        "800 1\n900 1",
        "",
        "a b",
        "200 1 2",
        "200",
    ],
)
def test_unusable_weights_raise(weights: str, tmp_path: Path) -> None:
    (tmp_path / "weights.txt").write_text(weights)
    with pytest.raises(InputError) as error:
        detect(Study().with_settings([f"run.weights.mine='{tmp_path / 'weights.txt'}'"]))
    assert "\n" not in str(error.value)


@pytest.mark.long
def test_output_that_is_a_folder_is_refused(tmp_path: Path) -> None:
    """Refuse a folder in place of a file, which raised IsADirectoryError."""
    for name in ("study.toml", "observation-1.fits", "observation-1.ecsv", "run.json"):
        (tmp_path / name / name).mkdir(parents=True)
        refused(*OBSERVE, "-o", name, folder=tmp_path)
    (tmp_path / "file").write_text("")
    refused(*OBSERVE, "-o", "file", folder=tmp_path)
    refused(*OBSERVE, "-o", "file/below", folder=tmp_path)


@pytest.mark.parametrize(
    "address",
    ["tcp://", "tcp://[::1", "://", "tcp://host", "tcp://host:99999", "foo://x:1", "tcp://x y:1", "tcp://\udcff:1",
     "local:", "local:0", "local:²", "local:" + "9" * 5000, "", "file"],
)  # fmt: skip
def test_invalid_cluster_addresses_are_refused(address: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("{}")
    refused(*DETECT, "--cluster", address, folder=tmp_path)


@pytest.mark.parametrize(
    "address",
    ["word", "http://", "http://[::1", "http://x y/", "file:///dev/zero", "http://h:99999/", "http://\udcff/",
     "data:,x", "http://" + "a" * 70 + ".com/"],
)  # fmt: skip
def test_invalid_collection_addresses_are_refused(address: str, tmp_path: Path) -> None:
    refused("library", "fetch", "ngsl:HD 1", "--from", address, folder=tmp_path)


def test_two_flags_for_one_key_are_refused(tmp_path: Path) -> None:
    """Refuse --flares with -a, of which one was silently ignored."""
    (tmp_path / "flares.csv").write_text("amplitude\n0.1\n")
    assert "--flares and --amplitude" in refused(*DETECT, "--flares", "flares.csv", folder=tmp_path)


# Questions without end.


@pytest.mark.parametrize(
    "words",
    [
        (*DETECT, "-n", str(10**16)),
        ("limit", "--star", "G2V", "-a", "0.2", "-n", str(10**16)),
        ("snr", "--star", "G2V", "-m", "5", "-n", str(10**17)),
        ("realise", "--star", "G2V", "-m", "5", "-n", str(10**16)),
    ],
    ids=lambda words: words[0],
)
def test_runs_above_one_year_need_insist(words: tuple[str, ...], tmp_path: Path) -> None:
    reported = refused(*words, folder=tmp_path)
    assert "years" in reported
    assert "--insist" in reported
    assert not list(tmp_path.iterdir()), "nothing has begun"


def test_duration_is_estimated_for_local_runs_only() -> None:
    study = Study()
    drawn = len(study.star) * (1 + len(study.flare.amplitudes)) * study.observation.load_instrument().pixels
    year = int(foresight.YEAR_S * foresight.CORE_RATE * (os.cpu_count() or 1) / drawn)
    here = {"device": None, "cluster": None}
    foresight.question_time(study.with_settings([f"run.realisations={int(year * 0.99)}"]), **here, insist=False)
    longer = study.with_settings([f"run.realisations={int(year * 1.01)}"])
    with refused_by_key("realisations", expected="less than a year"):
        foresight.question_time(longer, **here, insist=False)
    foresight.question_time(longer, **here, insist=True)
    foresight.question_time(longer, device="0", cluster=None, insist=False)
    foresight.question_time(longer, device=None, cluster="tcp://host:1", insist=False)
    swept = longer.with_settings(["run.realisations=1", "sweep.axes=[{quantity='magnitude', values=[4, 5]}]"])
    assert swept.sweep.size == 2
    beyond = study.with_settings([f"run.realisations={2**63}"])
    with refused_by_key("realisations", expected="63 bits"):
        foresight.question_time(beyond, **here, insist=True)


def test_stores_larger_than_the_disk_need_insist(tmp_path: Path) -> None:
    """Refuse `realise -n 1e12`, which needs petabytes."""
    words = ("realise", "--star", "G2V", "-m", "7", "-a", "0.1", "-t", "5")
    usage = mock.Mock(free=10 << 20)
    with mock.patch.object(foresight.shutil, "disk_usage", return_value=usage):
        reported = refused(*words, "-n", "100000", "-o", "s.zarr", folder=tmp_path)
        most = int(re.search(r"expected at most (\d+) of them", reported)[1])
        assert "10 MiB" in reported
        assert not (tmp_path / "s.zarr").exists()
        from mauvecl.store.layout import Store

        study = Study().with_settings(
            ["star=[{library='G2V',magnitude=7}]", "flare.amplitudes=[0.1]", "observation.exposure_s=5"]
        )
        fits = Store(tmp_path / "s.zarr", study.with_settings([f"run.realisations={most}"]))
        foresight.question_room(fits, insist=False)
        more = Store(tmp_path / "s.zarr", study.with_settings([f"run.realisations={most + 1}"]))
        with refused_by_key("realisations", value=most + 1):
            foresight.question_room(more, insist=False)
        foresight.question_room(more, insist=True)


# Uploads.


@pytest.mark.long
def test_uploads_are_read_in_a_limited_process(tmp_path: Path) -> None:
    from mauvecl.host.stars.source import Source
    from mauvecl.web import sandboxed_reader

    write_star(tmp_path / "star.txt")
    content = (tmp_path / "star.txt").read_bytes()
    assert sandboxed_reader.read_limited(content, Source).digest == Source.read(tmp_path / "star.txt").digest
    with pytest.raises(InputError):
        sandboxed_reader.read_limited(b"200 a\n300 b\n", Source)
    # Limits hold in the other process, whatever is read there.
    with (
        mock.patch.object(sandboxed_reader, "MEMORY_MIB", 64),
        refused_by_key("upload"),
    ):
        sandboxed_reader.read_limited(b"".join(b"%f 1e-12\n" % nm for nm in np.linspace(170.0, 800.0, 150_000)), Source)
    started = time.monotonic()
    with mock.patch.object(sandboxed_reader, "SECONDS", 0.05), refused_by_key("upload", "0.05 s"):
        # Python itself takes longer to start.
        sandboxed_reader.read_limited(content, Source)
    with refused_by_key("upload", "64 MiB"):
        sandboxed_reader.read_limited(gzip.compress(bytes(70 << 20)), Source)
    assert time.monotonic() - started < 10.0
    with mock.patch.object(sandboxed_reader, "SECONDS", 0):
        turns = [sandboxed_reader._turns.acquire() for _ in range(sandboxed_reader.TOGETHER)]
        try:
            with refused_by_key("upload"):
                sandboxed_reader.read_limited(content, Source)
        finally:
            for _ in turns:
                sandboxed_reader._turns.release()


def test_json_of_bad_input_is_empty(tmp_path: Path) -> None:
    code, out, _ = ended(*OBSERVE, "--json", "--set", "run.fap=2", folder=tmp_path)
    assert (code, out) == (2, "")
    assert json.loads(run(*OBSERVE, "--json", folder=tmp_path).stdout)
