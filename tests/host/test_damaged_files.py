"""Files that are packed, cut, damaged, too large or no files at all."""

import bz2
import gzip
import lzma
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from corpus import CORPUS, cases, written
from refusals import refused

from mauvecl import InputError, Source

CASES = dict(cases(CORPUS / "spectrum_files.toml"))
PACKERS = pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])


@PACKERS
def test_packed_files_are_whole_or_refused(pack: Callable[[bytes], bytes], tmp_path: Path) -> None:
    # Text that compresses badly.
    flux = np.random.default_rng(7).uniform(1e-13, 2e-13, 4000)
    rows = zip(np.linspace(180.0, 1100.0, 4000), flux, strict=True)
    content, path, digests = "\n".join(f"{a:.9g} {b:.9e}" for a, b in rows).encode(), tmp_path / "star", set()
    for whole in (content, pack(content), pack(content[:9000]) + pack(content[9000:])):
        path.write_bytes(whole)
        digests.add(Source.read(path).digest)
    assert len(digests) == 1
    for size in (8, len(pack(content)) // 2, len(pack(content)) - 1):
        path.write_bytes(pack(content)[:size])
        with refused("file"):
            Source.read(path)


@pytest.mark.long
@PACKERS
def test_decompression_bomb_raises_early(
    pack: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bomb").write_bytes(pack(bytes(64 << 20)))
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "16")
    # Python reserves the memory of the largest file.
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    tracemalloc.start()
    with refused("MAUVECL_LARGEST_CONTENT_MIB", "16"):
        Source.read(tmp_path / "bomb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


def test_only_regular_files_of_limited_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fifo, large = tmp_path / "fifo", tmp_path / "large"
    os.mkfifo(fifo)
    names = ("/dev/zero", fifo, tmp_path, tmp_path / "none", "a\0b", "x\ny" * 5000, tmp_path / ("y" * 300), "\ud800")
    for path in names:
        with refused("file") as caught:
            Source.read(path)
        assert len(str(caught.value)) < 600
    with large.open("wb") as file:
        file.truncate((1 << 20) + 1)
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    with refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        Source.read(large)
    # A file that grows is not cut silently, nor is one whose size the system does not know.
    size, known = os.fstat, os.stat_result
    with monkeypatch.context() as patch, refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        patch.setattr(os, "fstat", lambda handle: known([*size(handle)[:6], 0, *size(handle)[7:]]))
        Source.read(large)
    os.truncate(large, 1 << 20)
    # It is read, and holds no text.
    with refused("file", "null bytes"):
        Source.read(large)
    for value in ("", "-1", "0", "1e3", "99999999", "٣"):
        monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", value)
        with refused("MAUVECL_LARGEST_FILE_MIB"):
            Source.read(large)


@pytest.mark.parametrize(
    "name", ["FITS table plain fits", "FITS image linear fits", "FITS table start and step fits",
             "content instead of a name text txt", "content instead of a name fits.gz"]
)  # fmt: skip
def test_damaged_files_raise_or_are_read(name: str, tmp_path: Path) -> None:
    """Change random bytes of whole files with a fixed seed; only InputError may be raised."""
    rng = np.random.default_rng(14)
    path = written(CASES[f"spectrum_files {name}"], tmp_path)
    content = np.fromfile(path, np.uint8)
    for _ in range(60):
        damaged = content.copy()
        # Headers stand at the front.
        damaged[rng.integers(0, min(content.size, 6000), 6)] = rng.integers(32, 127, 6)
        damaged.tofile(path)
        try:
            Source.read(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
