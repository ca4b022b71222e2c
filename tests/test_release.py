"""A release states one version and one date, wherever they are repeated."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml

from mauvecl import __version__

ROOT = Path(__file__).parent.parent


def text_of(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


#: Headings of the changelog, newest first.
HEADINGS = re.findall(r"^## (.+)$", text_of("CHANGELOG.md"), re.MULTILINE)
CITATION: dict[str, Any] = yaml.safe_load(text_of("CITATION.cff"))
PROJECT: dict[str, Any] = tomllib.loads(text_of("pyproject.toml"))["project"]


def test_version_is_semantic_and_the_same_everywhere() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    assert CITATION["version"] == __version__
    assert yaml.safe_load(text_of("recipe/recipe.yaml"))["context"]["version"] == __version__


def test_changelog_begins_with_what_is_unreleased_and_this_version() -> None:
    assert HEADINGS[0] == "Unreleased"
    assert HEADINGS[1] == f"{__version__} - {CITATION['date-released']}"
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ - \d{4}-\d{2}-\d{2}", one) for one in HEADINGS[1:])


def test_classifier_says_stable_from_the_first_major_version_on() -> None:
    stable = "Development Status :: 5 - Production/Stable" in PROJECT["classifiers"]
    assert stable == (int(__version__.partition(".")[0]) >= 1)


def test_authors_are_those_of_the_licence() -> None:
    (author,) = PROJECT["authors"]
    (line,) = re.findall(r"^Copyright \(c\) \d{4},? (.+)$", text_of("LICENSE"), re.MULTILINE)
    assert author["name"].casefold() in line.casefold()
    assert [one["name"] for one in CITATION["authors"]] == [author["name"]]
