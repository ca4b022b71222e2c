"""The command line: one verb each, from a study file or flags."""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated

import typer

from mauvecl.answers.verbs import VERBS
from mauvecl.cli import verbs
from mauvecl.cli.boundary import EXIT_CODES, guarded
from mauvecl.cli.verb import COMMANDS, add_plain_commands
from mauvecl.cli.verbs.about import devices, schema, selftest
from mauvecl.cli.verbs.bulk import export, realise, verify
from mauvecl.cli.verbs.library import app as library
from mauvecl.cli.verbs.serve import serve
from mauvecl.host.version import VERSION

app = typer.Typer(
    name="mauvecl",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Would the Mauve satellite see this stellar flare, and how sure can one be?\n\n"
    "Start with `mauvecl detect`, which answers the question of the MauveSim paper. The throughput is nominal, not a "
    f"flight calibration. {EXIT_CODES}",
)


def _help(verb: Callable[..., None]) -> str:
    """Return what `--help` says, with each example on lines of its own that fit 80 columns and can be pasted."""
    text = re.sub(r"(?m)^(Examples?:) (?=mauvecl )", r"\1\n\n", inspect.getdoc(verb) or "")
    return re.sub(r"(?m)^mauvecl .*$", lambda found: "\b\n" + _broken(found[0]), text)


def _broken(command: str, most: int = 72) -> str:
    """Return a command on lines that end in a backslash before a flag, where it is long."""
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
# In the order of `--help`: the questions, bulk, mauvecl itself.
for name in VERBS:
    app.command(name, help=_help(COMMANDS[name]))(COMMANDS[name])
for verb in (realise, verify, export, serve, devices, selftest, schema):
    app.command(help=_help(verb))(verb)
for command in library.registered_commands:
    command.help = _help(command.callback) if command.callback else None
app.add_typer(library, name="library")


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
    # Threads of linear algebra wait for each other in a loop where kernels, or visitors of the page, have the cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Pictures are files: whatever a notebook's kernel wants figures to be shown by is not for this process, and
    # matplotlib fails at its import where it lacks that.
    os.environ.pop("MPLBACKEND", None)
    # Everything goes with the process: no look for cycles at its end.
    atexit.register(gc.freeze)
    sys.exit(guarded(app))
