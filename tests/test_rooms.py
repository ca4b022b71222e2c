"""The rule of the rooms is held: imports that it forbids are found, wherever and however they are written."""

from __future__ import annotations

import shutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
#: Who must not import whom: up, up for types alone, up inside a room, and OpenCL outside the device's room.
FORBIDDEN = {
    "noise/layout.py": ("import mauvecl.study.study", "mauvecl.noise.layout -> mauvecl.study.study"),
    "results/detection/roc.py": (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mauvecl.cli.app import main",
        "mauvecl.results.detection.roc -> mauvecl.cli.app",
    ),
    "host/files/bounded.py": (
        "from mauvecl.host.stars.source import Source",
        "mauvecl.host.files.bounded -> mauvecl.host.stars.source",
    ),
    "results/counts/tally.py": (
        "from mauvecl.results.detection import roc",
        "mauvecl.results.counts.tally -> mauvecl.results.detection.roc",
    ),
    "answers/signal/snr.py": (
        "def late():\n    from mauvecl.answers.limits.limits import solve",
        "mauvecl.answers.signal.snr -> mauvecl.answers.limits.limits",
    ),
    "study/study.py": ("def late():\n    import pyopencl", "mauvecl.study.study -> pyopencl"),
}


def test_forbidden_imports_are_found(tmp_path: Path) -> None:
    """In a copy of the package with one more import in each of six files."""
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
    told = " ".join(done.stdout.split())
    for _, arrow in FORBIDDEN.values():
        assert arrow in told


def test_the_drawing_by_imports() -> None:
    """Room by room no circle, at any depth, lazy imports and those for types among them; few rooms on few floors."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("mauvecl", cache_dir=None)
    drawn = {room: floors(graph, room) for room in graph.modules if rooms_in(graph, room)}
    assert len(drawn["mauvecl"]) <= 20
    assert max(drawn["mauvecl"].values()) <= 11


def rooms_in(graph: Any, room: str) -> set[str]:
    return {inner for inner in graph.find_children(room) if graph.find_children(inner)}


def floors(graph: Any, room: str) -> dict[str, int]:
    """Of each room in this one; a circle raises CycleError."""
    inside = {inner: {inner, *graph.find_descendants(inner)} for inner in rooms_in(graph, room)}
    below = {
        inner: {other for other in inside if other != inner and inside[other] & imported}
        for inner, files in inside.items()
        for imported in [set().union(*map(graph.find_modules_directly_imported_by, files))]
    }
    floor: dict[str, int] = {}
    for inner in TopologicalSorter(below).static_order():
        floor[inner] = 1 + max((floor[other] for other in below[inner]), default=0)
    return floor


def only_python(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not (name.endswith(".py") or (Path(folder) / name).is_dir())]
