"""The command line: its commands, and those about mauvecl itself, its library of stars and its page."""

from __future__ import annotations

import atexit
import gc
import inspect
import json
import os
import re
import sys
import textwrap
import time
from collections import UserDict
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from mauvecl.answers.verbs import COMMON, GROUPS, VERBS
from mauvecl.cli import flags
from mauvecl.cli.commands import COMMANDS, export, verify
from mauvecl.cli.console import EXIT_CODES, Meter, guarded, show, show_view
from mauvecl.host import VERSION
from mauvecl.schema.columns import View, records
from mauvecl.schema.errors import InputError, missing_package, shortened
from mauvecl.schema.fields import Range

if TYPE_CHECKING:
    from mauvecl.host.stars.library import OwnStar


def devices(
    rate: Annotated[bool, typer.Option("--rate/--no-rate", help="Measure each device for a second.")] = True,
    as_json: flags.JsonFlag = False,
) -> None:
    """List the OpenCL devices that can run the kernels, and rates.

    Promise: which numbers are the same as on every other device.
    Rate: pixel-realisations per second of the chi2 statistic, two scenarios.

    Example: mauvecl devices
    """
    from mauvecl.device.selftest import DEVICE_COLUMNS, list_devices

    drivers = list_devices(measure=rate)
    if as_json:
        print(json.dumps(drivers, indent=2))
        return
    numbered = [{"number": number} | driver for number, driver in enumerate(drivers)]
    show_view(View("OpenCL devices; choose with --device NUMBER or part of a name", DEVICE_COLUMNS, numbered))


def selftest(
    device: flags.DeviceFlag = None,
    output: Annotated[
        Path | None, flags.option("--output", "-o", metavar="PATH", text="Where to write [nowhere].")
    ] = None,
    as_json: flags.JsonFlag = False,
    quiet: flags.QuietFlag = False,
) -> None:
    """Check that your device computes what it should.

    Known answers, the NumPy reference, tests of chance and closed forms; takes about ten seconds.

    Exit code 1 if a check fails. Later run records on the same device carry the outcome.

    Example: mauvecl selftest
    """
    from dataclasses import asdict

    from mauvecl.answers.answer import make_folder, write_document
    from mauvecl.device import selftest
    from mauvecl.device.build import write_outcome
    from mauvecl.device.engine import Engine
    from mauvecl.host.tables.files import json_text

    started = time.perf_counter()
    folder = None if output is None else make_folder(output)
    with Meter(quiet=quiet or as_json) as meter:
        engine = Engine(device, progress=meter)
        checks = [asdict(check) for check in selftest.run(engine)]
    seconds = time.perf_counter() - started
    record = write_outcome(engine.device, checks, seconds)
    failed = sum(not check["passed"] for check in checks)
    if as_json:
        print(json.dumps(record, indent=2))
    else:
        title = f"Self-test of {engine.device_name}, driver {engine.driver}"
        show_view(View(title, selftest.CHECK_COLUMNS, checks))
        outcome = f"{failed} of {len(checks)} checks FAILED" if failed else f"All {len(checks)} checks passed"
        show([f"{outcome} in {seconds:.0f} s. Promise: {engine.device.promise}."])
    if folder is not None:
        write_document(f"{json_text(record)}\n".encode, folder / "selftest.json")
    if failed:
        raise typer.Exit(1)


def schema() -> None:
    """Print the JSON schema of study files, for editors of TOML.

    A study names it in its first line, as in #:schema study.schema.json.

    Example: mauvecl schema > study.schema.json
    """
    from mauvecl.study.study import Study

    print(json.dumps(Study.model_json_schema(), indent=2))


library_app = typer.Typer(invoke_without_command=True, rich_markup_mode=None, add_completion=False)


@library_app.callback()
def library(context: typer.Context, as_json: flags.JsonFlag = False) -> None:
    """List the embedded spectra and your own.

    `add`, `fetch` and `remove` change yours.

    Those of the library are kept at V = 0 and need --magnitude, but for the Sun and Vega.

    Examples: mauvecl library

    mauvecl library add my-star.txt

    mauvecl library fetch "ngsl:HD 37202"
    """
    if context.invoked_subcommand is not None:
        return
    from mauvecl.host.stars.library import COLUMNS, OWN_COLUMNS, library_table

    table = library_table()
    if as_json:
        print(json.dumps(records(table), indent=2))
        return
    title = "Embedded spectra (UV: mean flux over that at 540-560 nm); origin, citation: --json"
    show_view(View(title, COLUMNS, table[table["kept"] == "embedded"]))
    yours = table[table["kept"] == "yours"]
    if len(yours):
        show_view(View("Your own", OWN_COLUMNS, yours))


@library_app.command()
def add(
    files: Annotated[list[Path], typer.Argument(help="Text, ECSV, VOTable or FITS; FILE[COLUMN] names a column.")],
    name: Annotated[str | None, flags.option(metavar="TEXT", text="Name of the star, for a single file.")] = None,
    replace: flags.ReplaceFlag = False,
    wavelength_unit: Annotated[str | None, flags.option_of("star.wavelength_unit")] = None,
    flux_unit: Annotated[str | None, flags.option_of("star.flux_unit")] = None,
    extend: Annotated[str | None, flags.option_of("star.extend")] = None,
    quiet: flags.QuietFlag = False,
) -> None:
    """Keep spectra of your own under a name, for --star.

    Example: mauvecl library add my-star.txt --name "HD 1234"
    """
    from mauvecl.host.stars.additions import add

    if name is not None and len(files) > 1:
        raise InputError(f"--name {name!r} needs a single file, but {len(files)} are given", key="name")
    for file in files:
        star = add(file, name, replace=replace, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
        _show_kept(star, quiet)


@library_app.command()
def fetch(
    names: Annotated[
        list[str], typer.Argument(help="Stars, such as ngsl:HD 37202; in calspec, ngsl or lowlib, or in any of them.")
    ],
    base: Annotated[
        str | None, flags.option("--from", metavar="TEXT", text="Address of a mirror of the collection.")
    ] = None,
    replace: flags.ReplaceFlag = False,
    extend: Annotated[str | None, flags.option_of("star.extend")] = None,
    quiet: flags.QuietFlag = False,
) -> None:
    """Fetch stars of public collections of HST spectra and keep them.

    Example: mauvecl library fetch "calspec:18sco"
    """
    from mauvecl.host.stars.additions import fetch

    for name in names:
        shown = not quiet and sys.stderr.isatty()
        _show_kept(fetch(name, base=base, replace=replace, show_progress=shown, extend=extend), quiet)


@library_app.command()
def remove(
    names: Annotated[list[str], typer.Argument(help="Names of kept stars.")], quiet: flags.QuietFlag = False
) -> None:
    """Remove spectra of your own.

    Example: mauvecl library remove "HD 1234"
    """
    from mauvecl.host.stars.library import remove

    for name in names:
        remove(name)
        if not quiet:
            show([f"Removed {name}."])


def _show_kept(star: OwnStar, quiet: bool) -> None:
    """Print the name of a kept star and what its use needs, unless `quiet`."""
    if quiet:
        return
    name = json.dumps(star.name) if " " in star.name else star.name
    lines = [f"Kept {star.name}: --star {name}", *star.notes, *star.messages]
    if star.unscaled:
        lines.append(f"It needs --magnitude: {star.unscaled}.")
    if any("dereddened" in note for note in star.notes):
        lines.append("Without its dust it is too bright in the ultraviolet: --ebv reddens it again.")
    show(lines)


def serve(
    address: Annotated[
        str, typer.Option(metavar="TEXT", help="Address to listen on; 127.0.0.1 accepts this machine only.")
    ] = "127.0.0.1",
    port: Annotated[str, typer.Option(metavar="INTEGER", help="Port to listen on.")] = "5006",
    allow_origin: Annotated[
        list[str] | None,
        flags.option(
            metavar="TEXT",
            text="Public address of the page, such as https://mauve.example.org; required if --address "
            "accepts other machines. May be repeated.",
        ),
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Open a browser.")] = False,
) -> None:
    """Serve a page in your browser: questions, answers, downloads.

    Example: mauvecl serve --show
    """
    from mauvecl.schema.calls import checked
    from mauvecl.schema.section import number_or_text

    number = checked(Annotated[int, Range(1, 65535)], "--port", number_or_text(port))
    if find_spec("bokeh") is None or find_spec("tornado") is None:
        raise missing_package("bokeh", "the page", "web")
    from mauvecl.web.server import serve

    try:
        serve(address, number, show=show, allow_origin=allow_origin or ())
    except OSError as error:
        fault = f"port {port} of {shortened(address)} cannot be used ({error.strerror}); give another --port"
        raise InputError(fault, key="port") from error


class CommandWithHelp(TyperCommand):
    """Command whose `--help` shows its common flags, and `--help-all` all of them in groups."""

    common: frozenset[str] = frozenset()  # parameters of the common flags; empty for a command that shows all

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the flags under their headings."""
        shows_all = ctx.meta.get(flags.SHOWS_ALL, False)
        shown = self.common | {"help", "help_all"}
        groups: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if parameter.param_type_name == "argument":
                heading = "Arguments"
            elif shows_all:
                # Flags that set no key of a study have no panel.
                heading = getattr(parameter, "rich_help_panel", None) or "Output and devices"
            else:
                heading = "Common flags" if self.common else "Options"
            if record is not None and (heading != "Common flags" or parameter.name in shown):
                groups.setdefault(heading, []).append(record)
        for heading, lines in groups.items():
            with formatter.section(heading):
                formatter.write_dl(lines)


def text_of(text: str | None) -> str:
    """Return a help text with examples on separate lines of at most 80 columns, which can be pasted."""

    def broken(command: re.Match[str]) -> str:
        # Lines end in a backslash before a flag.
        joined = re.sub(r" (?!-)", "\0", command[0])
        lines = textwrap.wrap(joined, 73, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
        return "\b\n" + " \\\n".join(lines).replace("\0", " ")

    text = re.sub(r"(?m)^(Examples?:) (?=mauvecl )", r"\1\n\n", inspect.cleandoc(text or ""))
    return re.sub(r"(?m)^mauvecl .*$", broken, text)


#: Functions of the commands without a study.
OTHERS: dict[str, Callable[..., None]] = {
    function.__name__: function for function in (verify, export, serve, devices, selftest, schema)
}
#: Help text of every command, in the order of `--help`: verbs, raw spectra, mauvecl itself.
HELP = {
    **{name: text_of(COMMANDS[name].verb.help or COMMANDS[name].run.__doc__) for name in (*VERBS, "realise")},
    **{name: text_of(function.__doc__) for name, function in OTHERS.items()},
    "library": text_of(library.__doc__),
}


class _Commands(UserDict[str, Any]):
    """All commands by name; each is built, with its flags, when it is first looked up."""

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is not None:
            return self.data[name]
        if name == "library":
            application = library_app
            for inner in application.registered_commands:
                inner.help = text_of(inner.callback and inner.callback.__doc__)
        else:
            application = typer.Typer(add_completion=False, rich_markup_mode=None)
            function = COMMANDS[name].build() if name in COMMANDS else OTHERS[name]
            application.command(name, help=HELP[name], cls=CommandWithHelp)(function)
        command: Any = get_command(application)
        if name in COMMANDS:
            command.common = frozenset((*COMMON, *COMMANDS[name].verb.common))
        self.data[name] = command
        return command


class _Group(TyperGroup):
    """Group that builds only the command that is called, so that `mauvecl --help` needs no flags of a study."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = _Commands(dict.fromkeys(HELP))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the commands in groups, and then the flags."""
        groups = {name: COMMANDS[name].verb.group if name in COMMANDS else "tools" for name in HELP}
        width = max(map(len, HELP))
        for group, heading in GROUPS.items():
            names = [name for name in HELP if groups[name] == group]
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), HELP[name].partition("\n")[0]) for name in names])
        with formatter.section("Options"):
            records = (parameter.get_help_record(ctx) for parameter in self.get_params(ctx))
            formatter.write_dl(list(filter(None, records)))


app = typer.Typer(
    name="mauvecl",
    cls=_Group,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Would the Mauve satellite see this stellar flare, and how sure can one be?\n\n"
    "mauvecl plans and simulates observations of stars and their flares, and analyses observed frames. The throughput "
    "is nominal, not a flight calibration.\n\n"
    "Start with the first of these; the second explains a command:\n\n"
    "\b\nmauvecl detect --star M3V --magnitude 9\nmauvecl detect --help",
    epilog=EXIT_CODES,
)


def _version(is_set: bool) -> None:
    if is_set:
        print(f"mauvecl {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


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
