"""The import contracts find every forbidden import, at module level, inside functions and for type checkers."""

import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

from mauvecl.runs import checkpoint

ROOT = Path(__file__).parent.parent
FORBIDDEN = tomllib.loads((ROOT / "tests" / "data" / "forbidden_imports.toml").read_text(encoding="utf-8"))


def test_forbidden_imports_fail_the_contracts(tmp_path: Path) -> None:
    """Add one forbidden import to each of six files in a copy of the package."""
    pytest.importorskip("importlinter")
    sources = [path for path in (ROOT / "mauvecl").glob("*") if path.name != "__pycache__"]
    (tmp_path / "mauvecl").mkdir()
    for path in sources:
        if path.is_dir():
            shutil.copytree(path, tmp_path / "mauvecl" / path.name, ignore=only_python)
        elif path.suffix == ".py":
            shutil.copy(path, tmp_path / "mauvecl")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for file, (text, _) in FORBIDDEN.items():
        with (tmp_path / "mauvecl" / file).open("a") as opened:
            opened.write(f"\n\n{text}\n")
    code = "from importlinter.cli import lint_imports; import sys; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    report = " ".join(done.stdout.split())
    for _, arrow in FORBIDDEN.values():
        assert arrow in report


def test_packages_form_layers_without_cycles() -> None:
    """Check every level of packages, including lazy imports and imports for types."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("mauvecl", cache_dir=None)
    layers = {package: layers_of(graph, package) for package in graph.modules if packages_in(graph, package)}
    assert len(layers["mauvecl"]) <= 20
    assert max(layers["mauvecl"].values()) <= 13


def test_modules_form_no_circle() -> None:
    """Check every import between modules, including those inside functions and those for types."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("mauvecl", cache_dir=None)
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


def test_digest_of_the_code_covers_what_counts() -> None:
    """Check that the digest of workers' code has every package that the engine imports.

    Expectations, which `host` computes, are part of a request, and `schema` only reads and names values.
    """
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("mauvecl", cache_dir=None)
    needed = {name.split(".")[1] for name in graph.find_upstream_modules("mauvecl.device.engine")}
    assert needed - {"host", "schema"} <= set(checkpoint.DRAWING_PACKAGES)
    assert all(list((ROOT / "mauvecl" / name).glob("*.*")) for name in checkpoint.DRAWING_PACKAGES)


def packages_in(graph: Any, package: str) -> set[str]:
    return {inner for inner in graph.find_children(package) if graph.find_children(inner)}


def layers_of(graph: Any, package: str) -> dict[str, int]:
    """Return the layer of each package inside this one; a cycle raises CycleError."""
    inside = {inner: {inner, *graph.find_descendants(inner)} for inner in packages_in(graph, package)}
    below = {
        inner: {other for other in inside if other != inner and inside[other] & imported}
        for inner, files in inside.items()
        for imported in [set().union(*map(graph.find_modules_directly_imported_by, files))]
    }
    layer: dict[str, int] = {}
    for inner in TopologicalSorter(below).static_order():
        layer[inner] = 1 + max((layer[other] for other in below[inner]), default=0)
    return layer


def only_python(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not (name.endswith(".py") or (Path(folder) / name).is_dir())]
