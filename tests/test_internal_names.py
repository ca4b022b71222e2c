"""Tests import or replace few names from inside mauvecl, each for a reason, so that its modules can be moved.

`tests/data/internal_names.toml` lists them. `python tests/test_internal_names.py` writes the list again: it keeps the
reasons that are there, and leaves those of new names empty.
"""

import ast
import json
import re
import tomllib
from pathlib import Path

TESTS = Path(__file__).parent
FILE = TESTS / "data" / "internal_names.toml"
HEAD = """# Names inside mauvecl that tests import or replace, and why the public interface does not reach these.
# `python tests/test_internal_names.py` writes this list; reasons are written by hand.

"""


def internal_names() -> set[str]:
    """Return every name that a test imports from below the root of the package, or writes as text to replace it."""
    found = set()
    for path in TESTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                modules = [(f"{node.module}.{one.name}", node.module) for one in node.names]
            elif isinstance(node, ast.Import):
                modules = [(one.name, one.name) for one in node.names]
            elif isinstance(node, ast.Constant) and re.fullmatch(r"mauvecl(\.\w+){2,}", str(node.value)):
                modules = [(node.value, node.value)]
            else:
                continue
            for name, module in modules:
                package = module.split(".")[0]
                if package == "host" or (package == "mauvecl" and module != "mauvecl"):
                    found.add(name)
    return found


def listed() -> dict[str, str]:
    return tomllib.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def test_internal_names_are_those_of_the_list() -> None:
    assert sorted(internal_names()) == sorted(listed())


if __name__ == "__main__":
    reasons = listed()
    lines = [f"{json.dumps(name)} = {json.dumps(reasons.get(name, ''))}\n" for name in sorted(internal_names())]
    FILE.write_text(HEAD + "".join(lines), encoding="utf-8")
