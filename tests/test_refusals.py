"""Bad input is refused in one sentence: one table for all verbs and public functions, in data/refusals.

The README there says what an entry may hold. Errors themselves have a key, a value and what is expected."""

import pickle
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from commands import ended
from refusals import refused

import mauvecl
from mauvecl import InputError

TABLES = Path(__file__).parent / "data" / "refusals"
CONTENT = {path: tomllib.loads(path.read_text(encoding="utf-8")) for path in sorted(TABLES.glob("*.toml"))}
ROWS = [
    pytest.param(path, row, id=f"{path.stem}: {row.get('run') or row['call']}")
    for path, table in CONTENT.items()
    for row in table["refusal"]
]


@cache
def _names(path: Path) -> dict[str, Any]:
    """Return the public names, and what the table's setup makes of them."""
    names = {name: getattr(mauvecl, name) for name in mauvecl.__all__} | {"mauvecl": mauvecl, "np": np, "u": u}
    exec(CONTENT[path].get("setup", ""), names)
    return names


@pytest.mark.parametrize(("path", "row"), ROWS)
def test_bad_input_is_refused(path: Path, row: dict[str, Any], tmp_path: Path) -> None:
    for name, text in (CONTENT[path].get("files", {}) | row.get("files", {})).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    if "call" in row:
        with refused(row.get("key"), *row["says"]):
            eval(row["call"], _names(path) | {"folder": tmp_path})
        return
    code, out, reported = ended(*shlex.split(row["run"]), folder=tmp_path)
    assert code == 2, out + reported
    sentence = reported.removeprefix("mauvecl: ").strip()
    for fact in (row["key"], *row["says"]):
        assert fact in sentence, sentence
    # Notes on what was assumed may precede the sentence.
    assert not re.search(r"Traceback|internal error", reported), reported
    if path.stem in ("cli", "cli-limits"):
        # One sentence, in which parameters are named by their flags.
        assert (out, reported.count("\n"), reported[:9]) == ("", 1, "mauvecl: ")
        assert "`" not in re.sub(r"`mauvecl [^`]*`", "", reported), reported


def test_errors_of_values_have_a_key_a_place_and_a_unit() -> None:
    error = InputError.of("flare amplitude", -1.0, "at least 0", unit="s", where="a.toml")
    for one in (error.within("star.txt"), pickle.loads(pickle.dumps(error.within("star.txt")))):
        assert (str(one), one.key) == (
            "star.txt: a.toml: flare amplitude must be at least 0, not -1.0 s", "flare_amplitude"
        )  # fmt: skip

    # Values are shown on one short line.
    shown = {r"'a\nb'": "a\nb", "2.5": np.float64(2.5), "3.0 m": 3 * u.m, "[1, 2]": [1, 2],
             "'" + "x" * 56 + "..." + "x" * 19 + "'": "x" * 500}  # fmt: skip
    for text, value in shown.items():
        assert str(InputError.of("key", value, "another")) == f"key must be another, not {text}"
