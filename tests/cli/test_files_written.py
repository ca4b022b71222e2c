"""Files of a verb are complete or missing, whatever the disk does, and the answer is printed."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import pytest
from answers import small
from refusals import refused

from mauvecl.cli.app import app
from mauvecl.host.files.atomic import write_whole
from mauvecl.runs.checkpoint import Checkpoint
from mauvecl.runs.locks import locked
from mauvecl.schema.errors import InputError
from mauvecl.store.export import Selection, export

FEW = ("--star", "G2V", "-m", "7.4", "--exposure", "5", "--seed", "1")
DRAWN = (*FEW, "-n", "10000", "--statistic", "chi2")
VERBS = {
    "exposure": ("exposure", "--star", "G2V", "-m", "7.4", "--snr", "5", "--at", "300"),
    "simulate": ("simulate", *FEW),
    "snr": ("snr", *FEW, "-n", "2000"),
    "detect": ("detect", *DRAWN, "--fap", "0.01"),
    "limit": ("limit", *DRAWN, "--amplitude", "0.5", "--fap", "0.01", "--no-pictures"),
    "stare": ("stare", *FEW[:4], "--duration", "60", "--no-search", "--seed", "1"),
    "map": ("map", *DRAWN, "--fap", "0.01", "--x", "magnitude=6,7", "--y", "amplitude=0.1,0.5", "--no-pictures"),
}


def full_from(step: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a disk that is full after `step` files; return the names of the files that were tried."""
    tried: list[str] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        tried.append(Path(f"/proc/self/fd/{handle}").readlink().name)
        if len(tried) > step:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr("mauvecl.host.files.atomic.os.fsync", fsync)
    return tried


@pytest.mark.long
@pytest.mark.parametrize("verb", VERBS)
def test_answer_is_printed_if_the_disk_is_full(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that no file is incomplete and that an earlier table is unchanged."""
    out = tmp_path / "out"
    out.mkdir()
    (out / f"{verb}.ecsv").write_text("of an earlier run")
    tried = full_from(0, monkeypatch)
    with refused("file", "No space left on device", "more files"):
        app([*VERBS[verb], "--output", str(out), "--json"], standalone_mode=False)
    assert len(tried) > 1
    assert json.loads(capsys.readouterr().out)
    assert [(p.name, p.read_text()) for p in out.iterdir()] == [(f"{verb}.ecsv", "of an earlier run")]


@pytest.mark.long
def test_each_file_is_whole_or_missing_if_the_disk_fills(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that earlier files are complete and later ones unchanged."""
    words = [*VERBS["simulate"], "--no-pictures", "--output"]
    app([*words, str(tmp_path / "whole")], standalone_mode=False)
    plain = capsys.readouterr().out
    whole = {p.name: p.read_bytes() for p in (tmp_path / "whole").iterdir()}
    assert len(whole) >= 4
    for step in range(len(whole)):
        out = tmp_path / str(step)
        with monkeypatch.context() as patch:
            tried = full_from(step, patch)
            with refused("file", "No space left on device"):
                app([*words, str(out)], standalone_mode=False)
        there = {p.name: p.read_bytes() for p in out.iterdir()}
        assert len(tried) == len(whole)
        assert len(there) == step
        # The run record holds the time.
        assert all(there[name] == whole[name] for name in there if name.endswith((".ecsv", ".toml")))
        assert capsys.readouterr().out.partition("Wrote")[0] == plain.partition("Wrote")[0]


@pytest.mark.long
def test_full_file_system_keeps_earlier_files(small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = small_disk / "out"
    words = [*VERBS["simulate"], "--no-pictures", "--output", str(out)]
    app(words, standalone_mode=False)
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    capsys.readouterr()
    (small_disk / "filler").write_bytes(bytes(os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_bsize))
    with refused("file", "observation-1.ecsv", "No space left on device"):
        app([*words, "--exposure", "10"], standalone_mode=False)
    assert "One observation each" in capsys.readouterr().out
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


@pytest.mark.parametrize("name", ["f.fits", "f.h5"])
def test_export_to_a_full_disk_keeps_the_earlier_file(name: str, small_disk: Path, tmp_path: Path) -> None:
    from stores import Painter, study

    from mauvecl.store import bulk

    painter: Any = Painter()
    store = bulk.realise(study(4000), tmp_path / "s.zarr", painter)
    (small_disk / name).write_text("of an earlier run")
    with refused("file"):
        export(Selection.of(store), small_disk / name, replace=True)
    assert [(p.name, p.read_text()) for p in small_disk.iterdir()] == [(name, "of an earlier run")]


def test_output_folder_is_locked_while_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Include verbs that draw nothing."""
    out = tmp_path / "out"
    out.mkdir()
    with locked(out, "output folder"), refused("lock"):
        app([*VERBS["exposure"], "--output", str(out)], standalone_mode=False)
    assert list(out.iterdir()) == []
    held: list[bool] = []

    def noted(path: Path, *parts: Any) -> None:
        try:
            with locked(out, "output folder"):
                held.append(False)
        except InputError:
            held.append(True)
        write_whole(path, *parts)

    monkeypatch.setattr("mauvecl.answers.files.write_whole", noted)
    app([*VERBS["detect"], "--no-pictures", "--output", str(out)], standalone_mode=False)
    assert held == [True] * 6
    with locked(out, "output folder"):
        pass


SHARD = f"{hashlib.md5(b'').hexdigest()}-0-0-4096.npz"


@pytest.mark.parametrize("how", [{"restart": True}, {"resume": True}, {}])
def test_only_files_of_a_checkpoint_are_removed(tmp_path: Path, how: dict[str, bool]) -> None:
    """Only files that a checkpoint writes are removed, at a restart and at the end."""
    theirs = tmp_path / "checkpoint"
    (theirs / "deep").mkdir(parents=True)
    for name in ("epoch-1.pt", "mine.npz", "deep/keep", ".unfinished-mine"):
        (theirs / name).write_text("keep me")
    with Checkpoint(tmp_path, "detect", small(), patience_s=0.0, **how) as checkpoint:
        checkpoint.put(SHARD.removesuffix(".npz"), {})
        assert checkpoint.kept == 1
    with refused("resume"), Checkpoint(tmp_path, "detect", small()):
        pass
    (theirs / f".unfinished-{SHARD}").write_text("killed while it was written")
    with Checkpoint(tmp_path, "detect", small(), resume=True) as checkpoint:
        checkpoint.forget()
    assert sorted(str(p.relative_to(theirs)) for p in theirs.rglob("*") if p.is_file()) == [
        ".unfinished-mine",
        "deep/keep",
        "epoch-1.pt",
        "mine.npz",
    ]


@pytest.mark.parametrize("how", [{"restart": True}, {"resume": True}, {}])
def test_foreign_manifest_is_kept(tmp_path: Path, how: dict[str, bool]) -> None:
    manifest = tmp_path / "checkpoint" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text('{"model": "mine"}')
    with (
        refused("folder", "manifest.json"),
        Checkpoint(tmp_path, "detect", small(), **how),
    ):
        pass
    assert manifest.read_text() == '{"model": "mine"}'


def test_restart_of_a_locked_folder_raises(tmp_path: Path) -> None:
    """A folder that another process has locked is neither read nor removed."""
    with Checkpoint(tmp_path, "detect", small(), patience_s=0.0) as checkpoint:
        checkpoint.put(SHARD.removesuffix(".npz"), {})
        for how in ({"restart": True}, {"resume": True}):
            with (
                refused("lock"),
                Checkpoint(tmp_path, "detect", small(), **how),
            ):
                pass
        assert checkpoint.kept == 1


def test_failed_write_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with refused("file"):
        write_whole(tmp_path / "a", b"content")
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    write_whole(tmp_path / "b", b"con", memoryview(b"tent"), shared=True)
    assert (tmp_path / "b").read_bytes() == b"content"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.long
def test_files_of_the_previous_run_are_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Remove pictures and tables of the previous run, but not the files of the user."""
    out = tmp_path / "out"
    app(["simulate", "--star", "G2V", "--star", "K3V", "-m", "7", "-t", "5", "-o", str(out)], standalone_mode=False)
    assert {"observation-2.ecsv", "observation-2.png", "observation-1.png"} <= names(out)
    (out / "notes.txt").write_text("mine")
    (out / "observation-2.fits").write_text("changed by hand")
    app([*VERBS["exposure"], "--no-pictures", "--output", str(out)], standalone_mode=False)
    assert names(out) == {"exposure.ecsv", "study.toml", "run.json", "notes.txt", "observation-2.fits"}


@pytest.mark.parametrize("record", ["", "[]", '{"files": 3}', '{"files": {"../mine": "x"}}', '{"files": {"a": 1}}'])
def test_foreign_record_removes_nothing(record: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text(record)
    (out / "a").write_text("mine")
    (tmp_path / "mine").write_text("mine")
    app([*VERBS["exposure"], "--no-pictures", "--output", str(out)], standalone_mode=False)
    assert (out / "a").read_text() == (tmp_path / "mine").read_text() == "mine"


def test_interruption_while_writing_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = write_whole

    def write(path: Path, *parts: Any) -> None:
        if path.suffix == ".fits":
            raise KeyboardInterrupt
        real(path, *parts)

    monkeypatch.setattr("mauvecl.answers.files.write_whole", write)
    with pytest.raises(SystemExit) as end:
        app([*VERBS["simulate"], "--no-pictures", "--output", str(tmp_path / "out")], standalone_mode=False)
    assert end.value.code == 130
    assert capsys.readouterr().err == (
        f"mauvecl: interrupted; observation-1.ecsv written to {str(tmp_path / 'out')!r}, each file whole, and the same "
        "command writes all of them\n"
    )
