"""Help and headings of tables in a terminal of 80 columns."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from commands import ended
from typer.main import get_command

from mauvecl.cli.app import app
from mauvecl.cli.console import show_table


def commands() -> list[tuple[str, ...]]:
    """Return every verb, and every verb of `library`."""
    root: Any = get_command(app)
    own = [(name,) for name, one in root.commands.items() if not hasattr(one, "commands")]
    return [*own, *(("library", name) for name in root.commands["library"].commands)]


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_help_fits_80_columns(words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import typer.rich_utils

    monkeypatch.setattr(typer.rich_utils, "MAX_WIDTH", 80, raising=False)
    monkeypatch.setenv("TERMINAL_WIDTH", "80")
    code, reported, _ = ended(*words, "--help", folder=tmp_path)
    assert code == 0
    text = reported.replace("\\\n", " ")
    examples = re.findall(rf"^ +(mauvecl {' '.join(words)}.*)$", text, re.MULTILINE)
    assert examples
    lines = reported.splitlines()
    begun = [i for i, line in enumerate(lines) if line.strip().startswith("mauvecl ")]
    for i in begun:
        while lines[i].endswith("\\"):
            assert len(lines[i]) <= 80
            i += 1
        assert len(lines[i]) <= 80, lines[i]
    for example in examples:
        assert shlex.split(example)[0] == "mauvecl"


@pytest.mark.parametrize("labels", [1, 2, 3])
def test_parts_of_a_table_repeat_only_the_labels(
    labels: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Print a year in 80 columns: each month occurs once, and each part repeats the labels of its rows."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")
    months = [f"2027-{month:02d}" for month in range(1, 13)]
    names = [f"label {n}" for n in range(labels)]
    rows = [tuple(f"{r >> n & 1}abc" for n in reversed(range(labels))) for r in range(2**labels)]
    show_table("title", (*names, *months), [(*row, *("300" for _ in months)) for row in rows])
    reported = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert all(reported.count(month) == 1 for month in months)
    assert reported.count(names[0]) > 1
    assert all(reported.count(name) == reported.count(names[0]) for name in names)
    assert max(map(len, reported.splitlines())) <= 80
