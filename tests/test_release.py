"""What is around the package: version, licences, paper, recipes, wheel and sdist, benches and the list of mutations."""

import importlib
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.table import Table
from commands import run
from scripts import ROOT, tool

import mauvecl
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


#: What a checkout has, or an unpacked sdist; a working copy has much more beside it.
FOLDERS = (".ci", ".github", "bench", "docs", "host", "kernels", "mauvecl", "paper", "recipe", "tests", "tools")
FILES = (
    ".dockerignore", ".gitignore", "CHANGELOG.md", "CITATION.cff", "CODE_OF_CONDUCT.md", "CONTRIBUTING.md",
    "Dockerfile", "LICENSE", "Makefile", "README.md", "RELEASING.md", "SECURITY.md", "SUPPORT.md", "environment.yml",
    "pyproject.toml",
)  # fmt: skip
MADE = ("__pycache__", "_build", "_generated", "commands", "jupyter_execute", ".ipynb_checkpoints", "*_cache",
        ".hypothesis", "node_modules")  # fmt: skip
VERSION = mauvecl.__version__
WHEEL = f"mauvecl-{VERSION}-py3-none-any.whl"
SDIST = f"mauvecl-{VERSION}.tar.gz"
BUILD = """import sys
from hatchling.build import build_sdist, build_wheel
build_sdist(sys.argv[1])
build_wheel(sys.argv[1])
"""


def copied(tree: Path) -> Path:
    """Copy the sources, links as links."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns(*MADE))
    for name in FILES:
        shutil.copyfile(ROOT / name, tree / name)
    return tree


def built(tree: Path, out: Path) -> tuple[bytes, bytes]:
    """Build wheel and sdist without a network: the backend is installed with the tests."""
    unset = {key: value for key, value in os.environ.items() if key != "SOURCE_DATE_EPOCH"}
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=tree, env=unset, check=True)
    return (out / WHEEL).read_bytes(), (out / SDIST).read_bytes()


def files_below(tree: Path) -> set[str]:
    """Return the files of a tree, those behind links as well."""
    return {
        str((Path(folder) / name).relative_to(tree))
        for folder, _, names in os.walk(tree, followlinks=True)
        for name in names
    }


@pytest.mark.long
def test_packages_are_the_same_for_the_same_files_complete_and_licensed(tmp_path: Path) -> None:
    tree = copied(tmp_path / "checkout")
    packages = wheel, sdist = built(tree, tmp_path / "built")
    with tarfile.open(fileobj=io.BytesIO(sdist)) as archive:
        archive.extractall(tmp_path, filter="data")
    unpacked = tmp_path / f"mauvecl-{VERSION}"
    assert files_below(unpacked) - {"PKG-INFO"} == files_below(tree)
    assert not [path for path in unpacked.rglob("*") if path.is_symlink()]
    assert built(unpacked, tmp_path)[0] == wheel
    # The wheel holds nothing else; the sdist, from which the same wheel is built, has the licences as well.
    held = zipfile.ZipFile(io.BytesIO(wheel))
    package = {f"mauvecl/{name}" for name in files_below(tree / "mauvecl")}
    assert {name for name in held.namelist() if ".dist-info/" not in name} == package
    texts = [ROOT / "LICENSE", *(ROOT / "host" / "stars" / "library" / "licenses").iterdir()]
    assert len(texts) == 4
    for text in texts:
        assert held.read(f"mauvecl-{VERSION}.dist-info/licenses/{text.relative_to(ROOT)}") == text.read_bytes()
    # In another folder, with other times and permissions of the files.
    elsewhere = copied(tmp_path / "elsewhere")
    for number, path in enumerate(sorted(elsewhere.rglob("*"))):
        if not path.is_symlink():
            os.utime(path, (1_000_000_000 + number, 1_000_000_000 + number))
            path.chmod(path.stat().st_mode & 0o750)
    assert built(elsewhere, tmp_path / "again") == packages


check = tool("mutation_check")


def dies_at_start(model: Any) -> Any:
    """End as a peer does that the system kills while it compiles."""
    os.kill(os.getpid(), signal.SIGKILL)


def dies_in_a_run(model: Any) -> Any:
    """Return a peer that dies when its time is taken, after the check of its mean."""
    from peers import Peer

    return Peer("mortal", "1", 10, lambda n: dies_at_start(model) if n == 10 else np.full(n, 10.0))


@pytest.mark.long
@pytest.mark.parametrize("make", [dies_at_start, dies_in_a_run])
def test_death_of_a_peer_raises(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its child processes import the module, too.
    monkeypatch.syspath_prepend(ROOT / "bench")
    peers = importlib.import_module("peers")
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits for a process that has ended"))
    signal.alarm(60)
    try:
        with pytest.raises(ChildProcessError, match="ended with exit code -9"):
            peers.Child(make, peers.Model(*[np.ones(10, np.float32)] * 5)).seconds()
    finally:
        signal.alarm(0)


def test_every_mutation_has_its_texts_and_its_test() -> None:
    sources, tests = check.files_of(ROOT, *check.SOURCES), check.files_of(ROOT, "tests")
    assert len(check.MUTATIONS) >= 70
    for name, (test, *edits) in check.MUTATIONS.items():
        assert edits, name
        for text, changed in edits:
            assert text != changed, name
            place = check.place_of(text, sources)
            if place.suffix == ".py":
                # A mutant that cannot be imported proves nothing.
                compile(sources[place].replace(text, changed), name, "exec")
        check.node_of(test, tests)
    # Texts and tests that are missing or occur twice are refused.
    files = {Path("a.py"): "def test_a(\nx = 1\n", Path("b.py"): "def test_b(\ny = 1\nx = 1\n\ndef test_a(\n"}
    assert check.node_of("test_b[0.1]", files) == "b.py::test_b[0.1]"
    for find, one, words in (
        (check.place_of, "z = 1", "occurs 0 times"), (check.place_of, "x = 1", r"occurs 2 times \(a.py, b.py\)"),
        (check.node_of, "test_c", "in 0 files"), (check.node_of, "test_a", "in 2 files"),
    ):  # fmt: skip
        with pytest.raises(SystemExit, match=words):
            find(one, files)
