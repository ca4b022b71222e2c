"""Files from outside are read within limits."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
from pathlib import Path

import pytest
from refusals import refused

from mauvecl.host.files.size_limits import read_bytes, unpacked
from mauvecl.schema.text import shortened

PACKERS = pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])


@pytest.mark.long
@PACKERS
def test_compressed_files_of_several_streams_are_unpacked(pack) -> None:
    content = half_noise(3_000_000)
    assert unpacked(pack(content), "f") == content
    assert unpacked(pack(content) + pack(content), "f") == 2 * content


@PACKERS
def test_truncated_files_raise(pack) -> None:
    packed = pack(half_noise(100_000))
    for size in (8, len(packed) // 2, len(packed) - 1):
        with refused("file"):
            unpacked(packed[:size], "f")


@pytest.mark.long
@PACKERS
def test_decompression_bomb_raises_early(pack, monkeypatch) -> None:
    import tracemalloc

    bomb = pack(bytes(200 << 20))
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "16")
    tracemalloc.start()
    with refused("MAUVECL_LARGEST_CONTENT_MIB", "16"):
        unpacked(bomb, "f")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


def test_only_regular_files_of_limited_size_are_read(tmp_path: Path, monkeypatch) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in ("/dev/zero", fifo, tmp_path, tmp_path / "none", "a\0b", "x" * 5000, tmp_path / ("y" * 300), "\ud800"):
        with refused("file"):
            read_bytes(Path(path), "spectrum file")
    large = tmp_path / "large"
    with large.open("wb") as file:
        file.truncate((1 << 20) + 1)
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    with refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        read_bytes(large, "study")
    os.truncate(large, 1 << 20)
    assert len(read_bytes(large, "study")) == 1 << 20


@pytest.mark.parametrize("value", ["", "-1", "0", "1e3", "99999999", "٣"])
def test_invalid_limit_raises(value: str, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "f").write_bytes(b"x")
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", value)
    with refused("MAUVECL_LARGEST_FILE_MIB"):
        read_bytes(tmp_path / "f", "study")


def test_shown_text_is_short_and_on_one_line() -> None:
    assert len(shortened("\n" * 10_000)) < 200
    assert "\n" not in shortened("a\nb")


def half_noise(size: int) -> bytes:
    """Return bytes of which a part compresses badly."""
    import random

    return random.Random(7).randbytes(size // 2) + bytes(size - size // 2)
