"""Messages name parameters in Python and flags on the command line."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import mauvecl

ROOT = Path(mauvecl.__file__).parent
#: The command line itself, and the command that the page offers.
OF_FLAGS = ("cli/", "web/commands.py")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: Whole commands are named as they are typed.
COMMAND = re.compile(r"`(?:mauvecl|wsl) [^`]*`")


def texts(file: Path) -> list[str]:
    """Return the text of every literal of a module except docstrings and the names of flags of fields."""
    source = file.read_text(encoding="utf-8")
    if "--" not in source:
        return []
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Flag"]
    docs |= {id(name) for call in calls for name in call.args}
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [node.value for node in nodes if id(node) not in docs]


def test_no_module_below_the_command_line_names_a_flag() -> None:
    files = [*ROOT.rglob("*.py"), *(ROOT / "host").rglob("*.py")]
    below = {file for file in files if not str(file.relative_to(ROOT)).startswith(OF_FLAGS)}
    assert len(below) > 200
    named = {
        (str(file.relative_to(ROOT)), text)
        for file in below
        for text in texts(file)
        # Help texts of verbs are the command line's own.
        if not re.search(r"Examples?:\s+mauvecl ", text) and FLAG.search(COMMAND.sub("", text))
    }
    assert not named


def test_dir_shows_public_names_only() -> None:
    shown = [name for name in dir(mauvecl) if not name.startswith("__")]
    assert sorted(shown) == sorted(mauvecl.__all__)
    assert all(getattr(mauvecl, name) is not None for name in shown)
