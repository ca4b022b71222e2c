"""Flags of studies and of commands: how they are declared, read, and completed in shells."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from glob import escape, glob
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Help, Unit, as_typed, first

if TYPE_CHECKING:
    from mauvecl.study.study import Keyword


def option(*names: str, text: str, **options: Any) -> Any:
    """Return an option without its default in the help text."""
    return typer.Option(*names, help=text, show_default=False, **options)


DeviceFlag = Annotated[str | None, option(metavar="TEXT", text="OpenCL device: number or part of its name [PoCL].")]
JsonFlag = Annotated[bool, option("--json", text="Print JSON and nothing else.")]
QuietFlag = Annotated[bool, option("--quiet", "-q", text="Print no progress and no file names.")]
SetFlag = Annotated[
    list[str] | None, option("--set", metavar="TEXT", text="Any key of the study, as in run.fap=0.01; may be repeated.")
]
PaperFlag = Annotated[
    bool,
    option(
        "--paper", text="Ask with the conventions of the MauveSim paper: dark drawn in DN, all but the noise known."
    ),
]
SHOWS_ALL = "mauvecl.help_all"  # key of a context that shows all flags


def _show_all(context: typer.Context, is_set: bool) -> None:
    if is_set:
        context.meta[SHOWS_ALL] = True
        print(context.get_help())
        raise typer.Exit


HELP_ALL = option("--help-all", callback=_show_all, is_eager=True, text="Show all flags and exit.")
ReplaceFlag = Annotated[bool, option("--replace", text="Replace an existing entry of that name.")]


@dataclass(eq=False, kw_only=True)
class Options:
    """Options of a call that are not keys of a study, each with its flag."""

    output: Path | None = None  # where everything is written; its flag states the default of the command
    as_json: JsonFlag = False
    quiet: QuietFlag = False
    wide: Annotated[bool, option("--wide", text="Show all columns of tables, however wide they are.")] = False
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")] = (
        True
    )
    device: Annotated[
        str | None,
        option("--device", text="OpenCL device: number or part of its name [PoCL; 0,1 for several together]."),
    ] = None
    cluster: Annotated[
        str | None,
        option(
            "--cluster",
            text="Draw on Dask workers: local:N, tcp://host:8786, or a scheduler file (needs mauvecl[cluster]).",
        ),
    ] = None
    resume: Annotated[bool, option("--resume", text="Continue the unfinished run in the output folder.")] = False
    restart: Annotated[bool, option("--restart", text="Discard the unfinished run in the output folder.")] = False
    insist: Annotated[
        bool,
        option("--insist", text="Run even if the estimated time exceeds a year, or the files the free disk space."),
    ] = False


#: Options of verbs that can be resumed and draw no realisations, and of those that draw.
RESUMING = ("resume", "restart")
WORKERS = ("device", "cluster", *RESUMING, "insist")


def study_option(keyword: Keyword, defaults: Mapping[str, Any]) -> Any:
    """Return the annotation of a flag of the study's key for typer: description, accepted words, unit and default.

    Typer leaves numbers as text, which the study converts, so that messages have one style. `defaults` holds defaults
    of a verb that differ from the study's, by key.
    """
    path, field, flag = keyword
    help = flag.help or first(field, Help) or Help("")
    unit = None if flag.help else first(field, Unit)
    choices = help.choices or _words(field.annotation if flag.kind is None else None)
    text = help.text + (f": {choices}" if choices else "") + (f", {unit.written}" if unit else "")
    text += (f", {help.more}" if help.more else "") + ("; may be repeated" if keyword.many else "")
    if path in defaults:
        default = f"{as_typed(defaults[path])}, or the study's"
    elif help.default or flag.help or keyword.kind is bool:
        default = help.default
    else:
        default = as_typed(field.get_default(call_default_factory=True))
    metavar = {str: "TEXT", Path: "FILE", float: "NUMBER", int: "INTEGER"}.get(keyword.item_kind)
    kind = keyword.kind
    if keyword.item_kind in (float, int):
        kind, metavar = (list[str], f"{metavar},...") if keyword.many else (str, metavar)
    annotation = option(
        *flag.names,
        text=text + (f" [{default}]" if default else "") + ".",
        rich_help_panel=path.partition(".")[0].capitalize(),
        autocompletion=COMPLETIONS.get(path),
        metavar=metavar,
    )
    return Annotated[kind | None, annotation]


def option_of(key: str) -> Any:
    """Return the option of a key's flag, for a verb without a study."""
    # `mauvecl --help` shows no flags, and starts twice as fast without importing the study.
    from mauvecl.study.study import keys_of

    (keyword,) = keys_of((key,))
    return get_args(study_option(keyword, {}))[1]


def _words(annotation: Any) -> str:
    """Return the accepted words of a field as text; empty if there are none."""
    inner = [argument for argument in get_args(annotation) if argument not in (NoneType, ...)]
    if get_origin(annotation) is Literal:
        return f"{', '.join(inner[:-1])} or {inner[-1]}"
    return _words(inner[0]) if len(inner) == 1 else ""


def is_star(argument: Path) -> bool:
    """Return whether the argument of the study is a star: a name of the library or a spectrum file."""
    from mauvecl.host.stars.library import resolve
    from mauvecl.host.tables.files import as_text, read_bytes, toml
    from mauvecl.study.study import is_there

    text = str(argument)
    if argument.suffix.lower() == ".toml" or argument.is_dir():
        return False
    if not is_there(text):
        # The first name decides; a wrong name among others has its own message.
        first = text.split(",")[0].strip()
        return bool(first) and resolve(first) is not None
    if argument.suffix.lower() == ".ecsv":
        return not holds_study(argument)
    if not argument.is_file():
        return True
    try:
        # TOML is a study, whatever the name of its file.
        toml(as_text(read_bytes(argument, "file")[:1_000_000], "file"), "file")
    except InputError as error:
        # The study itself reports keys with impossible values.
        return error.key in ("file", None)
    return False


def holds_study(file: Path) -> bool:
    """Return whether a file may hold a study: plain tables, such as CSV and ECSV that no answer wrote, do not."""
    suffix = file.suffix.lower()
    if suffix != ".ecsv" or not file.is_file():
        return suffix not in (".csv", ".vot", ".votable", ".xml", ".fits", ".fit")
    from mauvecl.host.tables.files import read_ecsv

    return "study" in read_ecsv(file, "table", "give a table of targets, or of an answer").meta


#: What the argument of the study may be instead, by the flag of a command that takes it: for help, in the plural for
#: messages, and the function that tells it from a study.
PLACES: dict[str, tuple[str, str, Callable[[Path], bool]]] = {
    "targets": ("a table of targets", "tables of targets", lambda path: not holds_study(path)),
    "data": ("a file of frames", "observed frames", lambda path: path.suffix.lower() != ".toml"),
    "star": ("a star as for --star", "stars", is_star),
    "look_at": ("", "targets", is_star),
}


def numbers_of(keyword: Keyword, value: Any) -> Any:
    """Convert the texts of a flag of numbers, which may hold several with commas between them."""
    from mauvecl.schema.section import number_or_text

    if value is None or keyword.item_kind not in (float, int):
        return value
    if not keyword.many:
        return number_or_text(value)
    return [number_or_text(word.strip()) for text in value for word in text.split(",")]


def complete_star(incomplete: str) -> list[str]:
    """Return names of stars, and files, that continue the last of the stars with commas between them."""
    from mauvecl.host.stars.library import EXAMPLES, all_names, user_stars

    before, comma, last = incomplete.rpartition(",")
    # Shells take a blank for the end of a word; names are known without blanks.
    names = [name.replace(" ", "") for name in all_names() if name not in EXAMPLES]
    names += [star.name for star in user_stars() if " " not in star.name]
    return [f"{before}{comma}{word}" for word in _continued(last, names)]


def complete_study(incomplete: str) -> list[str]:
    """Return files, and once something is typed names of stars, which may stand in place of a study."""
    return complete_star(incomplete) if incomplete else _continued("", ())


def complete_instrument(incomplete: str) -> list[str]:
    """Return names of instruments, and TOML files."""
    from mauvecl.host.instrument import shipped_names

    return _continued(incomplete, shipped_names(), ".toml")


#: Functions that complete values, by the keys of flags. Shells complete files by themselves where nothing else is
#: offered, so only names bring their files along.
COMPLETIONS = {
    "star.library": complete_star, "star.extend": complete_star, "change.extend": complete_star,
    "observation.instrument": complete_instrument,
}  # fmt: skip


def _continued(typed: str, names: Iterable[str], ending: str = "") -> list[str]:
    """Return names that begin with a text in any case, as it was typed, and folders and files with this ending."""
    words = [typed + name[len(typed) :] for name in names if name.casefold().startswith(typed.casefold())]
    paths = sorted(glob(escape(typed) + "*"))
    folders = [f"{path}/" for path in paths if Path(path).is_dir()]
    return [*words, *folders, *(path for path in paths if not Path(path).is_dir() and path.endswith(ending))]
