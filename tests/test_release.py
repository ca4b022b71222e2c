"""What is around the package: version and date, licences, the paper, and recipes that name what the package needs."""

import re
import tomllib
from pathlib import Path
from typing import Any

import yaml
from astropy.table import Table
from commands import run
from scripts import ROOT, tool

from mauvecl import __version__


def text_of(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def loaded(path: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load(text_of(path))
    return data


#: Headings of the changelog, newest first.
HEADINGS = re.findall(r"^## (.+)$", text_of("CHANGELOG.md"), re.MULTILINE)
CITATION = loaded("CITATION.cff")
PYPROJECT: dict[str, Any] = tomllib.loads(text_of("pyproject.toml"))
PROJECT: dict[str, Any] = PYPROJECT["project"]


def test_version_date_and_authors_are_the_same_everywhere() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    assert CITATION["version"] == __version__
    assert run("--version", folder=Path()).stdout == f"mauvecl {__version__}\n"
    assert loaded("recipe/recipe.yaml")["context"]["version"] == __version__
    assert HEADINGS[:2] == ["Unreleased", f"{__version__} - {CITATION['date-released']}"]
    assert all(re.fullmatch(r"\d+\.\d+\.\d+ - \d{4}-\d{2}-\d{2}", one) for one in HEADINGS[1:])
    stable = "Development Status :: 5 - Production/Stable" in PROJECT["classifiers"]
    assert stable == (int(__version__.partition(".")[0]) >= 1)
    (author,) = PROJECT["authors"]
    (line,) = re.findall(r"^Copyright \(c\) \d{4},? (.+)$", text_of("LICENSE"), re.MULTILINE)
    assert author["name"].casefold() in line.casefold()
    assert [one["name"] for one in CITATION["authors"]] == [author["name"]]


#: What the licences of the embedded data ask to be kept with every copy.
NOTICES = {
    "pyphot": "Copyright \\(c\\) 2016 Morgan Fouesneau.* The above copyright notice and this permission notice",
    "speclite": "Copyright \\(c\\) 2015-2025, Speclite Developers.* Redistributions in binary form must reproduce",
    "EXOSIMS": "Copyright \\(c\\) 2015, Dmitry Savransky.* Redistributions in binary form must reproduce",
}


def test_all_data_have_a_licence() -> None:
    """What the data state of their licences is in `tests/host/test_names_of_stars.py`."""
    library = ROOT / "host" / "stars" / "library"
    for package, notice in NOTICES.items():
        assert re.search(notice, " ".join((library / "licenses" / f"{package}.txt").read_text().split()))
    for file in library.glob("*/*.ecsv"):
        origin = Table.read(file, format="ascii.ecsv").meta["origin"]
        assert any(package in origin for package in NOTICES), file


def test_paper_cites_its_references_and_has_the_form_that_the_journal_asks_for() -> None:
    """The form of 2026: https://joss.readthedocs.io/en/latest/paper.html."""
    entries, paper = text_of("paper/paper.bib").split("\n@")[1:], text_of("paper/paper.md")
    assert {re.match(r"\w+\{(\w+),", one)[1] for one in entries} == set(re.findall(r"@(\w+)", paper))  # type: ignore[index]
    assert all("doi = {" in one or "eprint = {" in one for one in entries)
    body = paper.split("---", 2)[2]
    assert 750 <= len(body.split()) <= 1750
    assert re.findall(r"^# (.+)$", body, re.MULTILINE) == [
        "Summary", "Statement of need", "State of the field", "Software design", "Research impact statement",
        "AI usage disclosure", "Acknowledgements", "References",
    ]  # fmt: skip


#: Packages whose names on conda-forge differ from those on PyPI; these bring no more than what is imported.
ON_CONDA = {"astropy": "astropy-base", "matplotlib": "matplotlib-base"}


def bounds(requirements: list[str]) -> dict[str, str]:
    """Return names, as conda-forge has them, with their lower bounds."""
    found = [re.match(r"([\w-]+)(?:\[\w+\])?\s*(?:>=\s*([\d.]+))?", one) for one in requirements]
    return {ON_CONDA.get(one[1], one[1]): one[2] or "" for one in found if one}


def test_page_recipe_environment_and_container_list_what_the_package_needs() -> None:
    listed = re.findall(r"^\| (?!package)([\w-]+) \|", text_of("docs/dependencies.md"), re.MULTILINE)
    assert [one.requirement.name for one in tool("audit_dependencies").dependencies()] == listed
    # With its pictures and the driver, which on PyPI is an extra of pyopencl.
    expected = bounds([*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["plot"], "pocl"])
    recipe = loaded("recipe/recipe.yaml")
    run = [one for one in recipe["requirements"]["run"] if not one.startswith("python ")]
    assert bounds(run) == expected
    backend = bounds(PYPROJECT["build-system"]["requires"])
    assert backend.items() <= bounds(recipe["requirements"]["host"]).items()
    scripts = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts
    licences = {str(path.relative_to(ROOT)) for one in PROJECT["license-files"] for path in ROOT.glob(one)}
    assert set(recipe["about"]["license_file"]) == licences
    versions = bounds([one for one in loaded("environment.yml")["dependencies"] if isinstance(one, str)])
    assert versions.pop("python") == PROJECT["requires-python"].removeprefix(">=")
    assert versions.pop("pip") == ""
    assert versions == expected
    lines = text_of("Dockerfile").splitlines()
    assert lines[-2:] == ["RUN mauvecl selftest", 'ENTRYPOINT ["mauvecl"]']


def test_workflow_tests_every_python_and_pins_what_it_runs() -> None:
    declared = {one.rsplit(" ", 1)[1] for one in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", one)}
    text, jobs = text_of(".github/workflows/ci.yml"), loaded(".github/workflows/ci.yml")["jobs"]
    for job in ("pythons", "wheel"):
        run = set(jobs[job]["strategy"]["matrix"]["python"])
        assert run | {jobs["all"]["steps"][1]["with"]["python-version"]} == declared
    targets = set(re.findall(r"^([\w-]+):", text_of("Makefile"), re.MULTILINE))
    (quick,) = re.findall(r"addprefix tests/,(.*)\)", text_of("Makefile"))
    assert not [name for name in quick.split() if not (ROOT / "tests" / name).exists()]
    called = set(re.findall(r"run: (?:sudo )?make ([\w-]+)", text))
    assert {"quick", "lowest", "coverage", "dist", "try-wheel", "docs"} <= called <= targets
    # A tag can be moved to other code; a commit cannot.
    used = [step["uses"] for job in jobs.values() for step in job["steps"] if "uses" in step]
    assert len(used) > 15
    assert not [one for one in used if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", one)]
