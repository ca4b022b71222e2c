"""The command line: one verb each, from a study file or flags."""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from mauvecl.answers.verbs import VERBS
from mauvecl.cli import verbs
from mauvecl.cli.boundary import EXIT_CODES, guarded
from mauvecl.cli.naming import name_flags_of
from mauvecl.cli.verb import COMMANDS, add_plain_commands
from mauvecl.cli.verbs.about import devices, schema, selftest
from mauvecl.cli.verbs.bulk import export, verify
from mauvecl.cli.verbs.library import app as library
from mauvecl.cli.verbs.library import library as show_library
from mauvecl.cli.verbs.serve import serve
from mauvecl.host.version import VERSION


def _help(text: str | None) -> str:
    """Return a help text with examples on separate lines of at most 80 columns, which can be pasted."""
    text = re.sub(r"(?m)^(Examples?:) (?=mauvecl )", r"\1\n\n", inspect.cleandoc(text or ""))
    return re.sub(r"(?m)^mauvecl .*$", lambda found: "\b\n" + _broken(found[0]), text)


def _broken(command: str, most: int = 72) -> str:
    """Divide a long command into lines that end in a backslash before a flag."""
    lines = [""]
    for part in re.split(r" (?=-)", command):
        if lines[-1] and len(lines[-1]) + len(part) > most:
            lines[-1] += " \\"
            lines.append("   ")
        lines[-1] += f" {part}" if lines[-1] else part
    return "\n".join(lines)


for module in iter_modules(verbs.__path__, f"{verbs.__name__}."):
    import_module(module.name)
add_plain_commands()
#: Functions of the commands without a study.
OTHERS: dict[str, Callable[..., None]] = {
    function.__name__: function for function in (verify, export, serve, devices, selftest, schema)
}
#: Help text of every command, in the order of `--help`: verbs, raw spectra, mauvecl itself.
HELP = {
    **{name: _help(COMMANDS[name].help) for name in (*VERBS, "realise")},
    **{name: _help(function.__doc__) for name, function in OTHERS.items()},
    "library": _help(show_library.__doc__),
}


@cache
def _command(name: str) -> Any:
    """Build a command, with its flags."""
    if name == "library":
        one = library
        for inner in one.registered_commands:
            inner.help = _help(inner.callback and inner.callback.__doc__)
    else:
        one = typer.Typer(add_completion=False, rich_markup_mode=None)
        one.command(name, help=HELP[name])(COMMANDS[name].build() if name in COMMANDS else OTHERS[name])
    return get_command(one)


class _Commands(Mapping[str, Any]):
    """All commands by name; each is built when it is looked up."""

    def __iter__(self) -> Iterator[str]:
        return iter(HELP)

    def __len__(self) -> int:
        return len(HELP)

    def __getitem__(self, name: str) -> Any:
        return _command(name)


class _Group(TyperGroup):
    """Group that builds only the command that is called, so that `mauvecl --help` needs no flags of a study."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**how)
        self.commands = _Commands()  # type: ignore[assignment]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the names and the first sentences of the help texts."""
        TyperGroup(commands=[TyperCommand(name, help=text) for name, text in HELP.items()]).format_commands(
            ctx, formatter
        )


app = typer.Typer(
    name="mauvecl",
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Would the Mauve satellite see this stellar flare, and how sure can one be?\n\n"
    "Start with `mauvecl detect`, which answers the question of the MauveSim paper. The throughput is nominal, not a "
    f"flight calibration. {EXIT_CODES}",
)

name_flags_of(app)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"mauvecl {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; a failure is one sentence and an exit code, never a traceback."""
    # Threads of linear algebra would wait in busy loops while kernels or visitors of the page use the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Pictures are files. A notebook kernel's choice of backend does not apply to this process, and importing matplotlib
    # fails if that backend is not installed.
    os.environ.pop("MPLBACKEND", None)
    # No garbage collection at exit, since the process ends.
    atexit.register(gc.freeze)
    sys.exit(guarded(app))
