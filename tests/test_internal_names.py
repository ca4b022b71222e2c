"""Tests import few names from inside mauvecl, each for a reason; its modules form layers, whose contracts find faults.

`tests/data/internal_names.toml` lists the names, so that modules can be moved. `python tests/test_internal_names.py`
writes the list again: it keeps the reasons that are there, and leaves those of new names empty.
"""

import ast
import json
import pkgutil
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from scripts import ROOT

import mauvecl
from mauvecl import Engine
from mauvecl.runs import checkpoint

FORBIDDEN = tomllib.loads((ROOT / "tests" / "data" / "forbidden_imports.toml").read_text(encoding="utf-8"))


def test_forbidden_imports_fail_the_contracts(tmp_path: Path) -> None:
    """Add one forbidden import to each of six modules in a copy of the package."""
    pytest.importorskip("importlinter")
    shutil.copytree(ROOT / "mauvecl", tmp_path / "mauvecl", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    homes = {"limit": mauvecl.limit.__module__, "plan": mauvecl.plan.__module__}
    for module, (text, _) in FORBIDDEN.items():
        place = tmp_path.joinpath(*module.format(**homes).split("."))
        with (place / "__init__.py" if place.is_dir() else place.with_suffix(".py")).open("a") as opened:
            opened.write(f"\n\n{text.format(**homes)}\n")
    code = "from importlinter.cli import lint_imports; import sys; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    report = " ".join(done.stdout.split())
    for _, arrow in FORBIDDEN.values():
        assert arrow.format(**homes) in report


@pytest.fixture(scope="module")
def graph() -> Any:
    """Return all imports, those inside functions and for types as well."""
    return pytest.importorskip("grimp").build_graph("mauvecl", cache_dir=None)


def test_packages_form_layers_and_modules_no_circle(graph: Any) -> None:
    """A circle raises CycleError, also one of packages inside others."""
    for package in graph.modules:
        inside = [one for one in graph.find_children(package) if graph.find_children(one)]
        pairs = [pair for pair in permutations(inside, 2) if graph.direct_import_exists(
            importer=pair[0], imported=pair[1], as_packages=True)]  # fmt: skip
        TopologicalSorter({one: [other for importer, other in pairs if importer == one] for one in inside}).prepare()
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


def test_digest_of_the_code_covers_what_counts(graph: Any) -> None:
    """Check that the digest of workers' code has every package that the engine imports, but for its requests' own."""
    needed = {name.split(".")[1] for name in graph.find_upstream_modules(Engine.__module__)}
    # Expectations, which `host` computes, are part of a request, and `schema` only reads and names values.
    assert needed - {"host", "schema"} <= set(checkpoint.DRAWING_PACKAGES)
    assert all(list((ROOT / "mauvecl" / name).glob("*.*")) for name in checkpoint.DRAWING_PACKAGES)


#: The command line itself.
OF_FLAGS = "mauvecl/cli/"
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: Docstrings, help texts, comments, the names of flags of fields, whole commands, named as they are typed, and lists of
#: words, from which the page forms a command.
MEANT = re.compile(r'"""[\s\S]*?"""|#.*|Flag\([^)]*|flag="[^"]*"|`(?:mauvecl|wsl) [^`]*`|\["--[a-z-]+"')


def test_no_module_below_the_command_line_names_a_flag() -> None:
    files = [file for folder in ("mauvecl", "host") for file in (ROOT / folder).rglob("*.py")]
    below = {name: file for file in files if not (name := str(file.relative_to(ROOT))).startswith(OF_FLAGS)}
    assert len(below) > 120
    named = {name: FLAG.findall(MEANT.sub("", file.read_text(encoding="utf-8"))) for name, file in below.items()}
    assert {name: flags for name, flags in named.items() if flags} == {}


TESTS = Path(__file__).parent
FILE = TESTS / "data" / "internal_names.toml"
HEAD = """# Names inside mauvecl that tests import or replace, and why the public interface does not reach these.
# `python tests/test_internal_names.py` writes this list; reasons are written by hand.

"""


#: Imports and names in texts: names to replace, and code that tests run in other processes.
IN_TEXT = re.compile(r"\bfrom (mauvecl[\w.]*) import (\w+(?:, \w+)*)|\b(mauvecl(?:\.\w+){2,})")


def named(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the names that an import or a text has from mauvecl, each with the module that it needs."""
    if isinstance(node, ast.ImportFrom) and node.module is not None:
        yield from ((f"{node.module}.{one.name}", node.module) for one in node.names)
    elif isinstance(node, ast.Import):
        yield from ((one.name, one.name) for one in node.names)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        for home, names, name in IN_TEXT.findall(node.value):
            yield from ((f"{home}.{one}", home) for one in names.split(", ") if one)
            if name:
                yield name, name


def internal_names() -> set[str]:
    """Return every name from below the root of the package that a test, or code that it runs, imports or replaces."""
    found = set()
    for path in TESTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for name, module in named(node):
                package = module.split(".")[0]
                if package == "host" or (package == "mauvecl" and module != "mauvecl"):
                    found.add(name)
    return found


def listed() -> dict[str, str]:
    return tomllib.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def test_internal_names_are_those_of_the_list_and_exist() -> None:
    assert sorted(internal_names()) == sorted(listed())
    # A test that something is not loaded would pass for ever if that had moved.
    for name in listed():
        pkgutil.resolve_name(name)


if __name__ == "__main__":
    reasons = listed()
    lines = [f"{json.dumps(name)} = {json.dumps(reasons.get(name, ''))}\n" for name in sorted(internal_names())]
    FILE.write_text(HEAD + "".join(lines), encoding="utf-8")
