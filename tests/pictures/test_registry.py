"""Pictures register themselves: every answer has one, and nothing below the pictures refers to them by name."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from importlib import import_module
from inspect import isabstract
from pathlib import Path
from pkgutil import iter_modules, walk_packages
from types import ModuleType

import pytest
from refusals import refused

import mauvecl.answers
import mauvecl.pictures
from mauvecl import Source
from mauvecl.pictures import registry
from mauvecl.pictures.style import styled_picture
from mauvecl.schema.drawable import Drawable

ROOT = Path(__file__).parent.parent.parent
#: The packages that lie below the pictures.
BELOW = ("answers", "device", "host", "lightcurve", "noise", "results", "runs", "statistics", "store", "study")


def modules_of(package: ModuleType) -> list[ModuleType]:
    return [import_module(one.name) for one in walk_packages(package.__path__, f"{package.__name__}.")]


def subclasses(kind: type) -> Iterator[type]:
    for one in kind.__subclasses__():
        yield one
        yield from subclasses(one)


def classes() -> dict[str, type]:
    """Return every class of mauvecl that can be drawn, by its name."""
    modules_of(mauvecl.answers)
    return {one.__name__: one for one in subclasses(Drawable) if one.__module__.startswith("mauvecl.")}


def test_no_string_names_a_module_of_pictures() -> None:
    pictures = {one.name for one in iter_modules(mauvecl.pictures.__path__)}
    functions = {f"{name}.{key}" for name in pictures for key in vars(import_module(f"mauvecl.pictures.{name}"))}
    assert "plans.limits" in functions
    for room in BELOW:
        for path in (ROOT / "mauvecl" / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    assert node.value not in functions, (path, node.value)
                    assert "mauvecl.pictures" not in node.value, (path, node.value)


def test_every_answer_has_a_picture_and_every_picture_a_class() -> None:
    registry.load()
    known = classes()
    for name, kind in known.items():
        if not isabstract(kind):
            assert registry.PICTURES[name], name
    for name in [*registry.PICTURES, *registry.DOCUMENTS]:
        assert name in known, name
        names = [entry.name for entry in registry.PICTURES[name]]
        assert len(set(names)) == len(names)


def test_picture_is_added_in_one_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A function with the decorator is drawn, saved and put into axes like all others."""
    from matplotlib.figure import Figure

    registry.load()
    copied = defaultdict(list, {name: list(entries) for name, entries in registry.PICTURES.items()})
    monkeypatch.setattr(registry, "PICTURES", copied)

    @registry.picture_of("Source", "line", each=lambda star: [(star, 1), (star, 2)])
    @styled_picture
    def line(plt, star, power):
        figure, axis = plt.subplots()
        axis.plot(star.wavelength_nm, star.flux_flam**power)
        return figure

    star = Source.from_library("G2V")
    assert list(star.pictures) == ["source", "line-1", "line-2"]
    assert star.pictures["line-2"](tmp_path / "line.png") == tmp_path / "line.png"
    ax = Figure().subplots()
    assert star.pictures["line-1"](ax=ax) is ax
    assert len(ax.lines) == 1
    with refused("ax"):
        star.pictures["line-1"](ax="axes")


@pytest.mark.long
def test_matplotlib_is_loaded_when_a_picture_is_drawn() -> None:
    code = (
        "import sys; from mauvecl import Source; star = Source.from_library('G2V'); names = list(star.pictures); "
        "assert names == ['source'] and 'matplotlib' not in sys.modules; "
        "assert 'mauvecl.answers.answer' not in sys.modules; "
        "star.plot(); assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
