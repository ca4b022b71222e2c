"""Help texts: the list of commands in groups, and the flags of a command, of which `--help` shows the common ones."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperCommand

from mauvecl.answers.verbs import GROUPS

#: Heading of the flags that set no key of a study.
OTHERS = "Output and devices"
#: Key of a context that shows all flags.
_ALL = "mauvecl.help_all"


def _show_all(context: typer.Context, wanted: bool) -> None:
    if wanted:
        context.meta[_ALL] = True
        print(context.get_help())
        raise typer.Exit


HELP_ALL = typer.Option("--help-all", callback=_show_all, is_eager=True, help="Show all flags and exit.")


class CommandWithHelp(TyperCommand):
    """Command whose `--help` shows its common flags, and `--help-all` all of them in groups."""

    common: frozenset[str] = frozenset()  # parameters of the common flags; empty for a command that shows all

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the flags under their headings."""
        shows_all = ctx.meta.get(_ALL, False)
        shown = self.common | {"help", "help_all"}
        groups: dict[str, list[tuple[str, str]]] = {}
        for one in self.get_params(ctx):
            record = one.get_help_record(ctx)
            if one.param_type_name == "argument":
                heading = "Arguments"
            elif shows_all:
                heading = getattr(one, "rich_help_panel", None) or OTHERS
            elif self.common:
                heading = "Common flags"
            else:
                heading = "Options"
            if record is not None and (heading != "Common flags" or one.name in shown):
                groups.setdefault(heading, []).append(record)
        for heading, records in groups.items():
            with formatter.section(heading):
                formatter.write_dl(records)


def write_commands(formatter: Any, texts: Mapping[str, str], groups: Mapping[str, str]) -> None:
    """Write the names and the first sentences of all commands, under the headings of their groups."""
    for group, heading in GROUPS.items():
        with formatter.section(heading):
            formatter.write_dl(
                [
                    (name.ljust(max(map(len, texts))), text.partition("\n")[0])
                    for name, text in texts.items()
                    if groups[name] == group
                ]
            )


def text_of(text: str | None) -> str:
    """Return a help text with examples on separate lines of at most 80 columns, which can be pasted."""
    text = re.sub(r"(?m)^(Examples?:) (?=mauvecl )", r"\1\n\n", inspect.cleandoc(text or ""))
    return re.sub(r"(?m)^mauvecl .*$", lambda match: "\b\n" + _broken(match[0]), text)


def _broken(command: str) -> str:
    """Divide a command longer than 72 characters into lines that end in a backslash before a flag."""
    lines = [""]
    for part in re.split(r" (?=-)", command):
        if lines[-1] and len(lines[-1]) + len(part) > 72:
            lines[-1] += " \\"
            lines.append("   ")
        lines[-1] += f" {part}" if lines[-1] else part
    return "\n".join(lines)
