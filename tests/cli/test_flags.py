"""The flags of every verb: names, help texts and defaults are those of a file, so that a change is seen in its diff."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.main import get_command

from mauvecl.cli.app import app

FILE = Path(__file__).parent.parent / "data" / "flags.json"


def flags_of(command: Any) -> dict[str, dict[str, Any]]:
    """Return the options of a command by their first name."""
    return {
        one.opts[0]: {
            "names": [*one.opts, *one.secondary_opts],
            "metavar": one.metavar,
            "repeated": one.multiple,
            "switch": one.is_flag,
            "help": one.help,
        }
        for one in command.params
        if one.param_type_name == "option" and one.name not in ("help", "install_completion", "show_completion")
    }


def all_flags() -> dict[str, dict[str, Any]]:
    commands = {}
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        commands[name] = flags_of(command)
        for inner, one in getattr(command, "commands", {}).items():
            commands[f"{name} {inner}"] = flags_of(one)
    return commands


def test_flags_equal_those_of_the_file() -> None:
    """Compare with the file; `python tests/cli/test_flags.py` accepts a change."""
    assert all_flags() == json.loads(FILE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    FILE.write_text(json.dumps(all_flags(), indent=1) + "\n", encoding="utf-8")
