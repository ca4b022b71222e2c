"""Flags of studies: how they are read, and the study that they make."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from mauvecl.cli.completion import OF_KEYS, complete_study
from mauvecl.schema.fields import Flag, Help, Unit, as_typed, first, is_measure
from mauvecl.schema.parsing import count, number, refusal, several

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from mauvecl.study.keywords import Keyword

#: What the argument of the study may be instead, by the flag of a command that takes it.
PLACES = {"targets": "a table of targets", "data": "a file of frames", "star": "a star as for --star"}


def study_argument(flags: Collection[str]) -> Any:
    """Return the annotation of the argument that is a study, or in its place what a flag takes."""
    other = next((f", or {what}" for flag, what in PLACES.items() if flag in flags), "")
    described = f"Study (TOML), the ECSV table of an answer{other}; flags override it."
    argument = typer.Argument(help=described, show_default=False, autocompletion=complete_study)
    return Annotated[Path | None, argument]


DeviceFlag = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="OpenCL device: number or part of its name [PoCL].", show_default=False),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no file names.")]
SetFlag = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="TEXT", help="Any key of the study, as in run.fap=0.01; may be repeated.", show_default=False
    ),
]


PaperFlag = Annotated[
    bool,
    typer.Option(
        "--paper", help="Ask with the conventions of the MauveSim paper: dark drawn in DN, all but the noise known."
    ),
]


def study_flags(*keys: str, defaults: Mapping[str, Any]) -> dict[str, Keyword]:
    """Return keywords whose types have the options of the command line, by the names of their parameters.

    Parameters
    ----------
    *keys : str
        Keys and sections such as ``"observation.exposure_s"`` or ``"flare"``.
    defaults : mapping
        Defaults of a verb that differ from the study's, by key.
    """
    # `mauvecl --help` shows no flags, and starts twice as fast without importing the study.
    from mauvecl.study.keywords import Keyword
    from mauvecl.study.study import keys_of

    flags: dict[str, Keyword] = {}
    for path, field, flag in keys_of(keys):
        keyword = Keyword.of(path, field, flag)
        option = typer.Option(
            *flag.names,
            help=_help(path, field, flag, keyword.kind, defaults),
            show_default=False,
            rich_help_panel=path.partition(".")[0].capitalize(),
            autocompletion=OF_KEYS.get(path),
            metavar={str: "TEXT", list[str]: "TEXT", Path: "FILE"}.get(keyword.kind),
        )
        flags[keyword.name] = keyword._replace(kind=Annotated[keyword.kind | None, option])
    return flags


def option_of(key: str) -> Any:
    """Return the option of a key's flag, for a verb without a study."""
    (flag,) = study_flags(key, defaults={}).values()
    return get_args(flag.kind)[1]


def _help(path: str, field: FieldInfo, flag: Flag, kind: Any, defaults: Mapping[str, Any]) -> str:
    """Return the help text: description, accepted words, unit, explanation and default."""
    help = flag.help or first(field, Help) or Help("")
    unit = None if flag.help else first(field, Unit)
    choices = help.choices or _words(field.annotation if flag.kind is None else None)
    text = help.text + (f": {choices}" if choices else "") + (f", {unit.written}" if unit else "")
    text += (f", {help.more}" if help.more else "") + ("; may be repeated" if get_origin(kind) is list else "")
    if path in defaults:
        default = (
            f"{defaults[path]:g}, or the study's"
            if isinstance(defaults[path], float)
            else (f"{defaults[path]}, or the study's")
        )
    else:
        default = help.default or (
            "" if flag.help or kind is bool else as_typed(field.get_default(call_default_factory=True))
        )
    return text + (f" [{default}]" if default else "") + "."


def _words(annotation: Any) -> str:
    """Return the accepted words of a field as text; empty if there are none."""
    if get_origin(annotation) is Literal:
        *others, last = get_args(annotation)
        return f"{', '.join(others)} or {last}"
    inner = [part for part in get_args(annotation) if part not in (NoneType, ...)]
    return _words(inner[0]) if len(inner) == 1 else ""


def output_flag(usual: str) -> Any:
    """Return the option of the output, with its default."""
    return Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help=f"Where to write [{usual}].", show_default=False),
    ]


def _option(*names: str, text: str, **how: Any) -> Any:
    return typer.Option(*names, help=text, show_default=False, **how)


@dataclass(eq=False, kw_only=True)
class Options:
    """Values of a call that are no keys of a study, each with its flag."""

    output: Path | None = None  # where everything is written; its flag states the default of the command
    as_json: JsonFlag = False
    quiet: QuietFlag = False
    wide: Annotated[bool, _option("--wide", text="Show all columns of tables, however wide they are.")] = False
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")] = (
        True
    )
    device: Annotated[
        str | None,
        _option("--device", text="OpenCL device: number or part of its name [PoCL; 0,1 for several together]."),
    ] = None
    cluster: Annotated[
        str | None,
        _option(
            "--cluster",
            text="Draw on Dask workers: local:N, tcp://host:8786, or a scheduler file (needs mauvecl[cluster]).",
        ),
    ] = None
    resume: Annotated[bool, _option("--resume", text="Continue the unfinished run in the output folder.")] = False
    restart: Annotated[bool, _option("--restart", text="Discard the unfinished run in the output folder.")] = False
    insist: Annotated[
        bool,
        _option("--insist", text="Run even if the estimated time exceeds a year, or the files the free disk space."),
    ] = False


#: Options of verbs that can be resumed and draw no realisations, and of those that draw.
RESUMING = ("resume", "restart")
WORKERS = ("device", "cluster", *RESUMING, "insist")


def is_star(given: Path) -> bool:
    """Return whether the argument of the study is a star: a name of the library or a spectrum file."""
    from mauvecl.host.stars.library import resolve
    from mauvecl.study.keywords import is_there

    text = str(given)
    if given.suffix.lower() == ".toml" or given.is_dir():
        return False
    if not is_there(text):
        # The first name decides; a wrong name among others has its own message.
        first = text.split(",")[0].strip()
        return bool(first) and resolve(first) is not None
    if given.suffix.lower() == ".ecsv":
        return not holds_study(given)
    return not given.is_file() or not _is_toml(given)


def _is_toml(file: Path) -> bool:
    """Return whether a file contains TOML, that is a study, regardless of its name."""
    import tomllib

    from mauvecl.host.tables.files import read_bytes

    try:
        tomllib.loads(read_bytes(file, "file")[:1_000_000].decode())
    except (ValueError, RecursionError):
        return False
    return True


def holds_study(file: Path) -> bool:
    """Return whether a file is not a plain table, such as CSV, or ECSV that no answer wrote."""
    suffix = file.suffix.lower()
    if suffix != ".ecsv" or not file.is_file():
        return suffix not in (".csv", ".vot", ".votable", ".xml", ".fits", ".fit")
    from mauvecl.host.tables.files import read_ecsv

    return "study" in read_ecsv(file, "table", "a table of targets, or of an answer").meta


def warn_of_percent(texts: Sequence[str]) -> None:
    """Warn of amplitudes that look like a percentage without its sign."""
    import warnings

    for text in (word.strip() for texts_of_flag in texts for word in texts_of_flag.split(",")):
        if not is_measure(text) and number(text, "--amplitude") >= 1:
            warnings.warn(
                f"--amplitude {text} is a rise of {100 * float(text):g} %; --amplitude {text}% is one of {text} %",
                stacklevel=2,
            )


def as_text(parameter: inspect.Parameter, unit: str = "") -> tuple[inspect.Parameter, Callable[[Any], Any] | None]:
    """Return an option of which numbers are taken as text, so that messages have one style, and its reader if any.

    Parameters
    ----------
    unit : str
        Unit to which numbers with another one are converted.
    """
    if get_origin(parameter.annotation) is not Annotated:
        return parameter, None
    wanted, option, *_ = get_args(parameter.annotation)
    (inner, *_) = [kind for kind in (get_args(wanted) or (wanted,)) if kind is not NoneType]
    many = get_origin(inner) is list or get_origin(wanted) is list
    each = get_args(inner)[0] if get_origin(inner) is list else inner
    if each not in (float, int):
        return parameter, None
    option, low, high = copy(option), option.min, option.max
    option.min = option.max = None
    option.metavar = ("NUMBER" if each is float else "INTEGER") + (",..." if many else "")
    named = (flag for flag in option.param_decls or () if flag.startswith("--"))
    flag = next(named, "--" + parameter.name.replace("_", "-"))
    read = partial(within, read=partial(number, unit=unit) if each is float else count, low=low, high=high)
    texts: Any = list[str] if many else str
    default = None if parameter.default is None else f"{parameter.default:g}"
    taken = parameter.replace(annotation=Annotated[texts | None, option], default=default)
    return taken, partial(several, name=flag, read=read) if many else partial(read, flag=flag)


def within(text: str, flag: str, *, read: Callable[[str, str], Any], low: float | None, high: float | None) -> Any:
    """Read a number between two ends, either of which may be missing."""
    value = read(text, flag)
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        reach = f"at least {low:g}" if high is None else f"{low:g} to {high:g}"
        raise refusal(flag, text, reach)
    return value
