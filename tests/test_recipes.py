"""The recipe for conda-forge, the environment and the container name what `pyproject.toml` needs."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
#: Packages whose names on conda-forge differ from those on PyPI; these bring no more than what is imported.
ON_CONDA = {"astropy": "astropy-base", "matplotlib": "matplotlib-base"}
#: The driver, which on PyPI is an extra of pyopencl.
DRIVER = "pocl"


def loaded(path: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))
    return data


def bounds(requirements: list[str]) -> dict[str, str]:
    """Return names with their lower bounds."""
    found = [re.match(r"([\w-]+)(?:\[\w+\])?\s*(?:>=\s*([\d.]+))?", one) for one in requirements]
    return {one[1]: one[2] or "" for one in found if one}


def expected() -> dict[str, str]:
    """Return what mauvecl and its pictures need, by names of conda-forge."""
    needed = bounds([*PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"]["plot"]])
    return {ON_CONDA.get(name, name): bound for name, bound in needed.items()} | {DRIVER: ""}


def test_recipe_needs_what_the_package_needs() -> None:
    recipe = loaded("recipe/recipe.yaml")
    run = [one for one in recipe["requirements"]["run"] if not one.startswith("python ")]
    assert bounds(run) == expected()
    backend = bounds(PROJECT["build-system"]["requires"])
    assert backend.items() <= bounds(recipe["requirements"]["host"]).items()
    scripts = [f"{name} = {target}" for name, target in PROJECT["project"]["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts
    licences = {str(path.relative_to(ROOT)) for one in PROJECT["project"]["license-files"] for path in ROOT.glob(one)}
    assert set(recipe["about"]["license_file"]) == licences


def test_environment_needs_what_the_package_needs() -> None:
    listed = [one for one in loaded("environment.yml")["dependencies"] if isinstance(one, str)]
    versions = bounds(listed)
    assert versions.pop("python") == PROJECT["project"]["requires-python"].removeprefix(">=")
    assert versions.pop("pip") == ""
    assert versions == expected()


def test_container_ends_with_the_self_test() -> None:
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    assert lines[-2:] == ["RUN mauvecl selftest", 'ENTRYPOINT ["mauvecl"]']


@pytest.mark.parametrize("job", ["pythons", "wheel"])
def test_workflow_tests_every_python_that_is_declared(job: str) -> None:
    declared = {one.rsplit(" ", 1)[1] for one in PROJECT["project"]["classifiers"] if re.search(r":: 3\.\d+$", one)}
    jobs = loaded(".github/workflows/ci.yml")["jobs"]
    run = set(jobs[job]["strategy"]["matrix"]["python"])
    assert run | {jobs["all"]["steps"][1]["with"]["python-version"]} == declared


def test_workflow_runs_targets_that_exist() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    called = set(re.findall(r"run: (?:sudo )?make ([\w-]+)", text))
    assert called >= {"quick", "lowest", "coverage", "dist", "try-wheel", "docs"}
    assert called <= targets


def test_workflow_pins_actions_by_commit() -> None:
    """A tag can be moved to other code."""
    jobs = loaded(".github/workflows/ci.yml")["jobs"].values()
    used = [step["uses"] for job in jobs for step in job["steps"] if "uses" in step]
    assert len(used) > 15
    assert not [one for one in used if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", one)]
