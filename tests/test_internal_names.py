"""Tests import or replace few names from inside mauvecl, each for a reason, so that its modules can be moved.

`tests/data/internal_names.toml` lists them. `python tests/test_internal_names.py` writes the list again: it keeps the
reasons that are there, and leaves those of new names empty.
"""

import ast
import json
import pkgutil
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

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


def test_internal_names_are_those_of_the_list() -> None:
    assert sorted(internal_names()) == sorted(listed())


def test_internal_names_exist() -> None:
    """Resolve every name: a test that something is not loaded would pass for ever if that had moved."""
    for name in listed():
        pkgutil.resolve_name(name)


if __name__ == "__main__":
    reasons = listed()
    lines = [f"{json.dumps(name)} = {json.dumps(reasons.get(name, ''))}\n" for name in sorted(internal_names())]
    FILE.write_text(HEAD + "".join(lines), encoding="utf-8")
