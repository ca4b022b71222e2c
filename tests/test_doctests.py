"""The examples in docstrings give what they show."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import mauvecl

ROOT = Path(__file__).parent.parent
FILES = [p for room in ("mauvecl", "host") for p in (ROOT / room).rglob("*.py") if ">>> " in p.read_text("utf-8")]


def module(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == "mauvecl" else ("mauvecl", *parts))


@pytest.mark.parametrize("name", sorted({module(path) for path in FILES}))
def test_examples_of_docstrings_run(name: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(name))
    assert failed == 0 < attempted


def test_main_names_have_examples() -> None:
    """Check the main names of the package."""
    finder = doctest.DocTestFinder(recurse=False)
    for name in ("Source", "Sky", "Instrument", "expect", "Engine", "Study"):
        thing = getattr(mauvecl, name)
        assert any(test.examples for test in finder.find(thing, name)), name
