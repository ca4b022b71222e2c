"""Stores under attack: wrong studies, other people's files, two processes, absurd sizes."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from commands import run
from refusals import refused
from stores import CHUNK, PAINTER, flip, killed_at, locked, study, tree

from mauvecl import bulk
from mauvecl.runs import store as stored


@pytest.fixture
def made(tmp_path: Path) -> Path:
    bulk.realise(study(), tmp_path / "frames.zarr", PAINTER)
    return tmp_path / "frames.zarr"


@pytest.fixture
def other(tmp_path: Path) -> Path:
    bulk.realise(study(run={"seed": 31}), tmp_path / "other.zarr", PAINTER)
    return tmp_path / "other.zarr"


def relabelled(place: Path, change: Callable[[str], str]) -> None:
    content = json.loads(place.read_text())
    content["attributes"]["study"] = change(content["attributes"]["study"])
    place.write_text(json.dumps(content, indent=2))


#: Functions of a store that need it alone.
WRITES: tuple[Callable[[Path], object], ...] = (
    lambda path: bulk.realise(study(), path, PAINTER),
    lambda path: bulk.realise(study(), path, PAINTER, restart=True),
    bulk.verify,
    bulk.forget,
)
COPIES = ["zarr.json", "star-1/quiescent/zarr.json", "star-1/flare-1/zarr.json"]


@pytest.mark.parametrize("copy", COPIES)
def test_changed_byte_of_a_study_is_found(made: Path, copy: str) -> None:
    """Change any byte: the store keeps its study, and repair restores the file."""
    before = tree(made)
    text = study().toml()
    # A sample of the bytes, and the seed's.
    for place in [*range(3, len(text), len(text) // 6), text.index("seed = 11") + 7]:
        other = "3" if text[place] != "3" else "4"
        relabelled(made / copy, lambda text, place=place, other=other: text[:place] + other + text[place + 1 :])
        assert [fault.key for fault in bulk.verify(made)] == [copy]
        (made / copy).write_bytes(before[copy])
    relabelled(made / copy, lambda text: text.replace("seed = 11", "seed = 31"))
    assert [(f.key, f.mended) for f in bulk.verify(made, PAINTER, repair=True)] == [(copy, True)]
    assert tree(made) == before


@pytest.mark.parametrize("copy", COPIES)
def test_contradicting_studies_raise(made: Path, other: Path, copy: str) -> None:
    """Give two studies with valid digests; nothing is read or written, since either could be the drawn one."""
    shutil.copy(other / copy, made / copy)
    before = tree(made)
    for ask in (*WRITES, bulk.read, partial(bulk.verify, engine=PAINTER, repair=True, redraw=True)):
        with refused("store", "'zarr.json'"):
            ask(made)
    assert tree(made) == before


def test_repair_needs_the_study_that_was_drawn(made: Path, other: Path) -> None:
    """Replace every copy of the study by one without its digest, and by one whose chunks have other digests."""
    before = tree(made)
    for copy in COPIES:
        relabelled(made / copy, lambda text: text.replace("seed = 11", "seed = 31"))
    with refused("store"):
        bulk.verify(made, PAINTER, repair=True)
    for copy in COPIES:
        shutil.copy(other / copy, made / copy)
    flip(made / CHUNK)
    with refused("redraw"):
        bulk.verify(made, PAINTER, repair=True)
    flip(made / CHUNK)
    chunks, now = ({name: one for name, one in found.items() if "json" not in name} for found in (before, tree(made)))
    assert now == chunks


def test_locked_store_is_neither_read_nor_removed(made: Path) -> None:
    (made.parent / "study.toml").write_text(study().toml())
    before = tree(made)
    with locked(made):
        done = run("realise", "study.toml", "--restart", "--output", made, folder=made.parent, code=2)
        assert f"{str(made)!r} is being written by another process" in done.stderr
        for ask in WRITES:
            with refused("lock", str(made)):
                ask(made)
    assert tree(made) == before


@pytest.mark.long
@pytest.mark.parametrize("place", ["mine.txt", "star-1/mine.txt", "star-1/quiescent/c/mine", "star-1/quiescent/c/99/0"])
@pytest.mark.parametrize("kind", ["file", "link"])
def test_foreign_files_are_not_removed(made: Path, place: str, kind: str) -> None:
    elsewhere = made.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "keep").write_text("me")
    (made / place).parent.mkdir(exist_ok=True)
    (made / place).write_text("keep me") if kind == "file" else (made / place).symlink_to(elsewhere)
    before = tree(made)
    for remove in (lambda: bulk.realise(study(), made, PAINTER, restart=True), lambda: bulk.forget(made)):
        with refused("store", str(place)):
            remove()
    assert tree(made) == before
    assert (elsewhere / "keep").read_text() == "me"


def test_restart_draws_the_new_study(made: Path, other: Path) -> None:
    bulk.realise(study(run={"seed": 31}), made, PAINTER, restart=True)
    assert tree(made) == tree(other)
    bulk.forget(made)
    assert not made.exists()


@pytest.mark.long
def test_kill_during_removal_is_recovered(made: Path, other: Path, tmp_path: Path) -> None:
    """Kill at any file; the rest is a store, and a second restart completes."""
    for step in (0, 3, 9, 14):
        path = tmp_path / f"{step}.zarr"
        shutil.copytree(made, path)
        again = partial(bulk.realise, study(run={"seed": 31}), path, PAINTER)
        assert killed_at(step, partial(again, restart=True), (Path, "unlink"))
        with refused("store", "run.seed"):
            again()
        again(restart=True)
        assert tree(path) == tree(other)


def test_store_larger_than_any_disk_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim 6e15 rows with one chunk; each question is answered in about a second."""
    path, asked = tmp_path / "vast.zarr", study(6 * 10**15)
    with refused("run.realisations"):
        bulk.realise(asked, path, PAINTER)
    # Written by hand, as an attacker would.
    vast = stored.Store(path, asked)
    for name, content in vast.description().items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    first = next(vast.chunks())
    vast.write(first, bulk.draw(asked, first.scene, PAINTER, 0, first.stop))
    for repair in (False, True):
        with refused("rows", "100000"):
            bulk.verify(path, PAINTER, repair=repair)
    with refused("rows", "100000"):
        bulk.verify(path, rows=(0, 10**12))
    assert [f.key for f in bulk.verify(path, rows=(0, first.stop))] == ["star-1/flare-1/c/0/0"]
    run("export", path, "few.h5", "--array", "star-1/quiescent", "--rows", "3:5", folder=tmp_path)
    assert "one file may hold 4 GiB" in run("export", path, "all.h5", folder=tmp_path, code=2).stderr
    with refused("run.realisations"):
        bulk.realise(asked, path, PAINTER)
    bulk.forget(path)
    assert not path.exists()


@pytest.mark.parametrize("name", ["f.fits", "f.h5"])
def test_existing_file_is_not_overwritten(name: str, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(study(20).toml())
    (tmp_path / name).write_text("mine")
    words = ("realise", "study.toml", "--output", name)
    for more in ([], ["--resume"]):
        assert "--restart" in run(*words, *more, folder=tmp_path, code=2).stderr
    assert (tmp_path / name).read_text() == "mine"
    run(*words, "--restart", folder=tmp_path)
    assert (tmp_path / name).stat().st_size > 2 * 2 * 20 * 197
    assert sorted(p.name for p in tmp_path.iterdir()) == [name, "study.toml"]
