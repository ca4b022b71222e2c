"""Folders that are no store, and commands with odd files; other files are in tests/data/corpus."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import run
from corpus import CORPUS, cases, mapping_of, written
from refusals import refused

from mauvecl import read_frames

CASES = dict(cases(CORPUS / "odd_frames.toml"))


def test_folders_without_a_store_raise(tmp_path: Path) -> None:
    with refused("mapping"):
        read_frames(tmp_path)
    for text in ("{", '{"zarr_format": 3, "node_type": "group", "attributes": {}}'):
        (tmp_path / "zarr.json").write_text(text)
        with refused("file"):
            read_frames(tmp_path)
    with refused("file"):
        read_frames(tmp_path / "none")


@pytest.mark.parametrize(
    "name", ["unusable column no flux", "rows that are no light curve one row", "unit that is none pc"]
)
def test_command_ends_with_a_message(name: str, tmp_path: Path) -> None:
    case = CASES[f"odd_frames {name} csv"]
    path, mapping = written(case, tmp_path), mapping_of(case, tmp_path)
    done = run("analyse", path, "--mapping", mapping, "--output", "out", folder=tmp_path, code=2)
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(("mauvecl: file 'a.csv'", "mauvecl: a:")), line
    assert not (tmp_path / "out").exists()


def test_empty_folders_raise(tmp_path: Path) -> None:
    case = dict(cases(CORPUS / "frames_of_spectra.toml"))["frames_of_spectra folder of texts plain csv"]
    (tmp_path / "empty").mkdir()
    with refused("files"):
        read_frames(tmp_path / "empty", mapping_of(case, tmp_path))
