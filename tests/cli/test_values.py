"""Flags' values as people write them."""

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
    """Verb and flag of every option that takes a number."""
    found = []
    for name, verb in get_command(app).commands.items():  # type: ignore[attr-defined]
        for option in getattr(verb, "params", ()):
            metavar: Any = getattr(option, "metavar", None)
            if metavar and metavar.rstrip(",.") in ("NUMBER", "INTEGER"):
                found.append((name, max(option.opts, key=len)))
    return found


def test_every_numeric_flag_refuses_text(tmp_path: Path) -> None:
    """One sentence with the flag, the value and what was expected, whatever flag has no number behind it."""
    flags = numeric()
    assert len(flags) > 60
    for flag, verb in sorted({flag: verb for verb, flag in flags}.items()):
        code, out, told = ended(verb, flag, "many", folder=tmp_path)
        assert (code, out) == (2, ""), (verb, flag)
        assert told.startswith(f"mauvecl: {flag} 'many', expected a "), told
        assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["detect", "--geometry", "beside"], "--geometry 'beside', expected 'added' or 'replaces'"),
        (["detect", "--tails", "guessed"], "--tails 'guessed', expected 'counted' or 'sampled'"),
        (["limit", "--known", "light_loss,luck"], "unknowns.known names 'luck', expected some of "),
        (["snr", "--star", "G2V", "-m", "7", "--at", "30"], "wavelength = 30.0 nm, expected 200.1 to 699.8 nm"),
        (["stare", "--gap", "10"], "--gap '10', expected two times in s"),
        (["stare", "--energy", "1e33", "--amplitude", "0.1"], "--energy is given beside --amplitude"),
        (["detect", "--star", "G2V,M3V,", "-m", "7"], "library spectrum '' is unknown"),
        (["detect", "--star", "G2V,M33V", "-m", "7,8"], "library spectrum 'M33V' is unknown"),
        (["serve", "--port", "99999"], "--port '99999', expected 1 to 65535"),
        (["detect", "--output", __file__, "-n", "1e5"], "is a file, expected the name of a folder"),
        (["detect", "--instrument", "."], "instrument '.' is a folder, expected a name or a TOML file"),
        (
            ["detect", "--star", "G2V", "-m", "7", "--geometry", "replaces", "--photosphere-temperature", "2"],
            "--photosphere-temperature 2.0, expected 1000 to 200000 K",
        ),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, list) else "",
)
def test_bad_values_name_their_flag(words: list[str], sentence: str, tmp_path: Path) -> None:
    code, _, told = ended(*words, folder=tmp_path)
    assert (code, sentence in told) == (2, True), told
