"""Places, rows, arrays and files that a store cannot use raise an InputError that names the key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run
from refusals import refused
from stores import Painter, study

from mauvecl import bulk, read_frames

PAINTER = Painter()
#: Rows of the store.
ROWS = 20


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a store and a file of the user's."""
    bulk.realise(study(ROWS), tmp_path / "s.zarr", PAINTER)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("keep me")
    return tmp_path


def exported(folder: Path, *words: str) -> str:
    """Return the refusal of an export."""
    return run("export", "s.zarr", *words, folder=folder, code=2).stderr


#: Calls with the folder, the key of the error, and what its sentence names.
CALLS: dict[str, tuple[Callable[[Path], object], str, *tuple[str, ...]]] = {
    "a folder of other files": (lambda at: bulk.realise(study(), at / "notes", PAINTER), "store", "'mine.txt'"),
    "removal of other files": (lambda at: bulk.forget(at / "notes"), "store"),
    "a store in a file": (lambda at: bulk.realise(study(), at / "notes" / "mine.txt" / "s", PAINTER), "store"),
    "no store": (lambda at: bulk.read(at / "nowhere"), "store"),
    "no such array": (lambda at: bulk.read(at / "s.zarr", "star-9/quiescent"), "scenes", "'star-9/quiescent'"),
    "a frame beyond the exposure": (
        lambda at: bulk.realise(study(ROWS, bulk={"frames": [7]}), at / "t.zarr", PAINTER), "bulk.frames"),
    "frames of an unnamed array": (lambda at: read_frames(at / "s.zarr"), "hdu", "star-1/quiescent",
                                   "FILE[star-1/flare-1]"),
    "frames of an unknown array": (lambda at: read_frames(f"{at / 's.zarr'}[star-2]"), "hdu", "star-2"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_bad_input_raises(name: str, folder: Path) -> None:
    call, key, *facts = CALLS[name]
    with refused(key, *facts):
        call(folder)
    assert (folder / "notes" / "mine.txt").read_text() == "keep me"


def test_bad_exports_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert f"0:{ROWS}" in exported(folder, "s.fits", "--rows", "10:60")
    assert "hdf5" in exported(folder, "s.txt")
    with monkeypatch.context() as patch:
        patch.setattr("mauvecl.store.export.MAX_BYTES", 1000)
        assert "rows" in exported(folder, "s.fits")
    (folder / "s.zarr" / "star-1/quiescent/c/0/0").unlink()
    assert "star-1/quiescent/c/0/0" in exported(folder, "s.fits")
    assert not (folder / "s.fits").exists()
