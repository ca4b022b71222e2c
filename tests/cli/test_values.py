"""Values of flags in common spellings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from commands import ended
from refusals import refused
from typer.main import get_command

from mauvecl.cli.app import app
from mauvecl.schema.parsing import count, several
from mauvecl.schema.parsing import number as number_of


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e6", 10**6), ("2.5e3", 2500), (" 7 ", 7), ("18446744073709551615", 2**64 - 1), ("-1", -1), ("1E2", 100)],
)
def test_counts_are_read(text: str, value: int) -> None:
    assert count(text, "--n") == value


@pytest.mark.parametrize("text", ["1.5", "x", "", "1e400", "nan", "inf", "1e-3", "1,000", "0x10", "1e999999999"])
def test_invalid_counts_raise(text: str) -> None:
    with refused("n", value=text):
        count(text, "--n")


def test_lists_are_read() -> None:
    assert several(["7,8", "9"], "--m", number_of) == [7.0, 8.0, 9.0]
    with refused("m", value=""):
        several(["7,,8"], "--m", number_of)


def numeric() -> list[tuple[str, str]]:
    """Return verb and flag of every option that takes a number."""
    found = []
    for name, verb in get_command(app).commands.items():  # type: ignore[attr-defined]
        for option in getattr(verb, "params", ()):
            metavar: Any = getattr(option, "metavar", None)
            if metavar and metavar.rstrip(",.") in ("NUMBER", "INTEGER"):
                found.append((name, max(option.opts, key=len)))
    return found


def test_every_numeric_flag_refuses_text(tmp_path: Path) -> None:
    """Check that the message has flag, value and expectation for every numeric flag."""
    flags = numeric()
    assert len(flags) > 60
    for flag, verb in sorted({flag: verb for verb, flag in flags}.items()):
        code, out, reported = ended(verb, flag, "many", folder=tmp_path)
        assert (code, out) == (2, ""), (verb, flag)
        assert reported.startswith(f"mauvecl: {flag} 'many', expected a "), reported
        assert reported.count("\n") == 1
