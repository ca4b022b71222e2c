"""The public interface, line by line: what `docs/stability.md` promises for a major version.

`tests/data/public_interface.txt` is derived from the registry of verbs, the schema of studies and instruments, the
columns of tables and `mauvecl.__all__`. To accept additions: python tests/test_public_interface.py. A line that is
gone breaks somebody's study, script or table; only a major version may delete it from the file, by hand.
"""

import inspect
import pkgutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

from answers import VERBS
from study_keys import fields, metadata
from typer.main import get_command

import mauvecl
from mauvecl import Instrument, Study
from mauvecl.cli import app

FILE = Path(__file__).parent / "data" / "public_interface.txt"
#: Classes that functions make, or that files fill: their constructors are not public.
MADE = {"Detection", "Expectation", "Frames", "Instrument", "Source", "Study"}


def commands(command: Any, path: str = "mauvecl") -> Iterator[str]:
    yield f"command {path}"
    for one in command.params:
        if one.param_type_name == "argument":
            yield f"command {path} {one.name.upper()}"
        elif one.name != "help":
            yield from (f"command {path} {flag}" for flag in (*one.opts, *one.secondary_opts))
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{path} {name}")


def keys(section: Any, kind: str) -> Iterator[str]:
    for path, field in fields(section):
        unit = metadata(field, "Unit")
        yield f"{kind} {'.'.join(path)}" + (f" [{unit.name}]" if unit and unit.name else "")


def columns() -> Iterator[str]:
    """Yield each column that a table can have: of those that answers declare with the file, all others by name."""

    def lines(where: str, declared: Any) -> Iterator[str]:
        if isinstance(declared, tuple) and declared and all(type(one).__name__ == "Column" for one in declared):
            yield from (f"column {where}{one.name}" + (f" [{one.unit}]" if one.unit else "") for one in declared)

    for verb in VERBS:
        function = getattr(mauvecl, verb)
        answer = vars(import_module(function.__module__))[function.__annotations__["return"]]
        for _, table in inspect.getmembers_static(answer):
            if type(table).__name__ == "TableOf" and table.file:
                yield from lines(f"{verb} {table.file}: ", table.columns)
    # Tables of some answers have columns that depend on the study, or on a result.
    for package in ("answers", "detection", "flares", "fits", "search", "noise", "runs"):
        home = import_module(f"mauvecl.{package}")
        for found in pkgutil.walk_packages(home.__path__, f"{home.__name__}."):
            for declared in vars(import_module(found.name)).values():
                yield from lines("", declared)


def call(name: str, function: Any) -> Iterator[str]:
    """Yield a function with each of its parameters: by place, by name, and if one must be given."""
    yield f"python {name}()"
    parameters = [one for one in inspect.signature(function).parameters.values() if one.name not in ("self", "cls")]
    for place, one in enumerate(parameters, 1):
        where = "" if one.kind in (one.KEYWORD_ONLY, one.VAR_KEYWORD) else f"{place} "
        star = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
        needed = ", required" if one.default is one.empty and not star else ""
        yield f"python {name}({where}{star}{one.name}{needed})"


def python() -> Iterator[str]:
    """Yield the names of `mauvecl`, parameters of functions, and what classes have of their own."""
    for name in mauvecl.__all__:
        value = getattr(mauvecl, name)
        if isinstance(value, ModuleType):
            for inner, member in inspect.getmembers(value, inspect.isfunction):
                if member.__module__ == value.__name__ and not inner.startswith("_"):
                    yield from call(f"{name}.{inner}", member)
        elif inspect.isclass(value):
            if not issubclass(value, Exception):
                yield from call(name, value) if name not in MADE else (f"python {name}",)
            for inner, member in inspect.getmembers_static(value):
                module = getattr(getattr(member, "fget", None) or getattr(member, "__func__", member), "__module__", "")
                if inner.startswith("_") or not str(module or "").startswith("mauvecl"):
                    continue
                if isinstance(member, property):
                    yield f"python {name}.{inner}"
                elif callable(getattr(value, inner)):
                    yield from call(f"{name}.{inner}", getattr(value, inner))
        elif callable(value):
            yield from call(name, value)
        else:
            yield f"python {name}"


def public_interface() -> list[str]:
    lines = {*commands(get_command(app.app)), *keys(Study, "study"), *keys(Instrument, "instrument")}
    mapping, *_ = get_args(get_type_hints(mauvecl.read_frames)["mapping"])
    lines |= {*keys(mapping, "mapping"), *columns(), *python()}
    return sorted(lines)


def test_nothing_public_is_gone_additions_are_listed_and_dir_shows_no_more() -> None:
    promised, lines = FILE.read_text(encoding="utf-8").splitlines(), public_interface()
    gone = {*promised} - {*lines, *(f"{line[:-1]}, required)" for line in lines)}
    assert gone == set(), "public names are gone or have changed: deprecate them instead (docs/stability.md)"
    assert {*lines} - {*promised} == set(), "public names are new: `python tests/test_public_interface.py` lists them"
    assert sorted(name for name in dir(mauvecl) if not name.startswith("__")) == sorted(mauvecl.__all__)
    assert all(getattr(mauvecl, name) is not None for name in mauvecl.__all__)


if __name__ == "__main__":
    # Keep lines that are gone, but those of parameters that became optional.
    found = {*public_interface()}
    promised = FILE.read_text(encoding="utf-8").splitlines()
    kept = {line for line in promised if line.replace(", required", "") not in found}
    FILE.write_text("\n".join(sorted(kept | found)) + "\n", encoding="utf-8")
