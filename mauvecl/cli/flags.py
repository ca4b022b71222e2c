"""Flags of the command line: flags of a study, from the metadata of its fields, and those of no key."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import typer

from mauvecl.schema.fields import Flag, Help, Unit, first

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

StudyFile = Annotated[
    Path | None,
    typer.Argument(
        help="Study (TOML), the ECSV table of an answer, or a star as for --star; flags override it.",
        show_default=False,
    ),
]
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


class StudyFlag(NamedTuple):
    """Flag of the command line, and the key of the study that it sets."""

    name: str  # name of the parameter
    kind: Any
    section: str
    key: str
    read: Callable[[Any, str], Any] | None

    def value(self, given: Any) -> Any:
        """Convert the value of the flag to that of the key."""
        return self.read(given, "--" + self.name.replace("_", "-")) if self.read else given


def study_flags(*keys: str, defaults: Mapping[str, Any]) -> dict[str, StudyFlag]:
    """Return the flags of keys and of whole sections, by the names of their parameters.

    Parameters
    ----------
    *keys : str
        Keys and sections such as ``"observation.exposure_s"`` or ``"flare"``.
    defaults : mapping
        Defaults of a verb that differ from the study's, by key.
    """
    # `mauvecl --help` shows no flags, and starts twice as fast without importing the study.
    from mauvecl.study.keys import keys_with_flags

    flags: dict[str, StudyFlag] = {}
    for wanted in keys:
        of_key = [one for one in keys_with_flags() if one[0] == wanted or one[0].startswith(f"{wanted}.")]
        assert of_key, wanted
        for path, field, flag in of_key:
            section, _, key = path.rpartition(".")
            kind = flag.kind or _kind(field.annotation)
            option = typer.Option(
                *flag.names,
                help=_help(path, field, flag, kind, defaults),
                show_default=False,
                metavar={str: "TEXT", list[str]: "TEXT", Path: "FILE"}.get(kind),
            )
            flags[flag.parameter] = StudyFlag(flag.parameter, Annotated[kind | None, option], section, key, flag.read)
    return flags


def option_of(key: str) -> Any:
    """Return the option of a key's flag, for a verb without a study."""
    (flag,) = study_flags(key, defaults={}).values()
    return get_args(flag.kind)[1]


def _kind(annotation: Any) -> Any:
    """Return the type of a flag's value: a plain type, or a list for a field of several values."""
    kinds = list(_plain(annotation))
    if len(kinds) > 1 and str in kinds:
        # A number or a word.
        return str
    return kinds[0]


def _plain(annotation: Any) -> Iterator[Any]:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _plain(parts[0])
    elif origin in (Union, UnionType):
        for part in parts:
            yield from _plain(part)
    elif origin is Literal:
        yield str
    elif origin is tuple:
        yield list[_kind(parts[0])]  # type: ignore[misc]
    elif annotation is not NoneType:
        yield annotation


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
            "" if flag.help or kind is bool else _text(field.get_default(call_default_factory=True))
        )
    return text + (f" [{default}]" if default else "") + "."


def _words(annotation: Any) -> str:
    """Return the accepted words of a field as text; empty if there are none."""
    if get_origin(annotation) is Literal:
        *others, last = get_args(annotation)
        return f"{', '.join(others)} or {last}"
    inner = [part for part in get_args(annotation) if part not in (NoneType, ...)]
    return _words(inner[0]) if len(inner) == 1 else ""


def _text(default: Any) -> str:
    """Return a default as it is typed; empty without a default."""
    if isinstance(default, tuple):
        return ",".join(map(_text, default))
    if isinstance(default, bool) or not isinstance(default, str | int | float):
        return ""
    return f"{default:g}" if isinstance(default, float) else str(default)


def output_flag(usual: str) -> Any:
    """Return the option of the output, with its default."""
    return Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="PATH", help=f"Where to write [{usual}].", show_default=False),
    ]


#: Options of a verb's `Session`, with their defaults: output on the terminal.
TELLING = {"as_json": (JsonFlag, False), "quiet": (QuietFlag, False)}
PICTURES = {
    "pictures": (
        Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw pictures (needs mauvecl[plot]).")],
        True,
    )
}


def _worker(kind: Any, name: str, text: str, **how: Any) -> Any:
    return Annotated[kind, typer.Option(name, help=text, show_default=False, **how)]


WORKERS = {
    "device": (
        _worker(
            str | None,
            "--device",
            "OpenCL device: number or part of its name [PoCL; 0,1 for several together].",
        ),
        None,
    ),
    "cluster": (
        _worker(
            str | None,
            "--cluster",
            "Draw on Dask workers: local:N, tcp://host:8786, or a scheduler file (needs mauvecl[cluster]).",
        ),
        None,
    ),
    "resume": (_worker(bool, "--resume", "Go on with the unfinished run in the output folder."), False),
    "restart": (_worker(bool, "--restart", "Forget the unfinished run in the output folder."), False),
    "keep_after": (
        _worker(
            float | None,
            "--keep-after",
            "Seconds after which finished parts of the work are kept on the disk [20].",
            min=0.0,
        ),
        None,
    ),
    "insist": (
        _worker(bool, "--insist", "Begin even what would take more than a year, or more than the disk has room for."),
        False,
    ),
}
#: Options of verbs that can be resumed and draw no realisations.
RESUMING = {name: WORKERS[name] for name in ("resume", "restart", "keep_after")}
