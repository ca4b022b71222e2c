"""What is around the package: one version and date, licences of what is embedded, and the paper."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from astropy.table import Table
from commands import run
from scripts import tool

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
    assert run("--version", folder=Path()).stdout == f"mauvecl {__version__}\n"
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


LIBRARY = ROOT / "host" / "stars" / "library"
#: What their licences ask to be kept with every copy.
NOTICES = {
    "pyphot": ("Copyright (c) 2016 Morgan Fouesneau", "The above copyright notice and this permission notice shall be"),
    "speclite": (
        "Copyright (c) 2015-2025, Speclite Developers",
        "Redistributions in binary form must reproduce the above",
    ),
    "EXOSIMS": ("Copyright (c) 2015, Dmitry Savransky", "Redistributions in binary form must reproduce the above"),
}


@pytest.mark.parametrize("package", NOTICES)
def test_every_source_of_data_has_its_licence(package: str) -> None:
    text = (LIBRARY / "licenses" / f"{package}.txt").read_text()
    assert all(notice in text for notice in NOTICES[package])


def test_all_data_have_a_licence() -> None:
    for file in LIBRARY.glob("*/*.ecsv"):
        meta = Table.read(file, format="ascii.ecsv").meta
        assert meta["licence"]
        packages = [name for name in NOTICES if name in meta["origin"]]
        assert packages, file
        assert all((LIBRARY / "licenses" / f"{name}.txt").exists() for name in packages)


def test_references_of_the_paper_are_cited_and_identified() -> None:
    paper = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
    entries = (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8").split("\n@")[1:]
    names = {re.match(r"\w+\{(\w+),", one)[1] for one in entries}  # type: ignore[index]
    assert names == set(re.findall(r"@(\w+)", paper))
    assert all("doi = {" in one or "eprint = {" in one for one in entries)


def test_paper_has_the_sections_and_the_length_that_the_journal_asks_for() -> None:
    """The form of 2026: https://joss.readthedocs.io/en/latest/paper.html."""
    body = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8").split("---", 2)[2]
    assert 750 <= len(body.split()) <= 1750
    assert re.findall(r"^# (.+)$", body, re.MULTILINE) == [
        "Summary",
        "Statement of need",
        "State of the field",
        "Software design",
        "Research impact statement",
        "AI usage disclosure",
        "Acknowledgements",
        "References",
    ]


def test_page_lists_every_dependency_and_its_purpose() -> None:
    listed = re.findall(r"^\| ([\w-]+) \|", text_of("docs/dependencies.md"), re.MULTILINE)
    assert [one.requirement.name for one in tool("audit_dependencies").dependencies()] == [
        name for name in listed if name != "package"
    ]
