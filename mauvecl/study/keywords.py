"""Keywords of studies: the names under which Python and the command line give keys, and the values that they set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from mauvecl.host.stars.library import resolve
from mauvecl.host.tables.files import without_columns
from mauvecl.noise.unknowns import NUISANCES
from mauvecl.schema.errors import InputError
from mauvecl.schema.section import read_assignment
from mauvecl.study.star import FILE_KEYS

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from mauvecl.schema.fields import Flag
    from mauvecl.study.observation import NuisanceChoice
    from mauvecl.study.star import Star


class Keyword(NamedTuple):
    """Keyword of a verb's function, or flag of its command, with the key of the study that it sets."""

    path: str
    field: FieldInfo
    flag: Flag

    @property
    def name(self) -> str:
        """Name in Python, and of the parameter of a command."""
        return self.flag.parameter

    @property
    def section(self) -> str:
        """Section of the key."""
        return self.path.rpartition(".")[0]

    @property
    def key(self) -> str:
        """Key without its section."""
        return self.path.rpartition(".")[2]

    @property
    def kind(self) -> Any:
        """Type of the value on the command line."""
        return self.flag.kind or plain_kind(self.field.annotation)

    @property
    def many(self) -> bool:
        """True if it has several values."""
        return get_origin(self.kind) is list

    @property
    def each(self) -> Any:
        """Type of one of its values on the command line."""
        return get_args(self.kind)[0] if self.many else self.kind

    def value(self, given: Any) -> Any:
        """Convert a value to that of the key, unless it has parts of its own, as in Python."""
        parts = given if self.many else [given]
        if self.flag.read is None or not all(isinstance(part, str | int | float | Path) for part in parts):
            return given
        return self.flag.read(given, self.name)

    def listed(self, given: Any) -> Any:
        """Return a list for a single value of a keyword of several values."""
        if not self.many or given is None or isinstance(given, Mapping):
            return given
        # Neither a sequence nor an array.
        single = isinstance(given, str | Path) or getattr(given, "ndim", 1) == 0 or not hasattr(given, "__len__")
        return [given] if single else list(given)


def values_of(given: Mapping[str, Any], keywords: Mapping[str, Keyword], where: str) -> dict[str, Any]:
    """Return the value of each keyword, None where it is not given, and of ``paper``.

    Raises InputError for a keyword of another name; ``ideal`` is another form of ``with_unknowns``, and ``paper`` needs
    an instrument.
    """
    others = {"paper": "instrument", "ideal": "with_unknowns"}
    known = [*keywords, *(name for name, needed in others.items() if needed in keywords)]
    for name in given.keys() - known:
        keys = [keyword for keyword, of in keywords.items() if of.key == name]
        close = keys or get_close_matches(name, known, n=3) or known
        raise InputError(f"{where} has no keyword {name!r}; use a flag of the command, such as {', '.join(close)}")
    values = {name: keyword.listed(given.get(name)) for name, keyword in keywords.items()}
    if given.get("ideal"):
        values["with_unknowns"] = False
    return values | {"paper": given.get("paper")}


def plain_kind(annotation: Any) -> Any:
    """Return the type of a keyword's value: a plain type, or a list for a field of several values."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return plain_kind(parts[0])
    if origin is tuple:
        return list[plain_kind(parts[0])]  # type: ignore[misc]
    if origin in (Union, UnionType):
        kinds = {plain_kind(part) for part in parts if part is not NoneType}
        # A number or a word is text.
        return kinds.pop() if len(kinds) == 1 else str
    return str if origin is Literal else annotation


def changes_of(
    given: Mapping[str, Any], keywords: Mapping[str, Keyword], nuisances: NuisanceChoice
) -> dict[str, dict[str, Any]]:
    """Return the values that keywords set, by sections of the study; stars have their own function."""
    changes: dict[str, dict[str, Any]] = {}
    flags: dict[str, str] = {}
    for name, keyword in keywords.items():
        if given[name] is None or keyword.section == "star" or name == "nuisance":
            continue
        other = flags.setdefault(keyword.path, name)
        if other != name:
            raise InputError(f"give either `{other}` or `{name}`: both set {keyword.path}", key=other)
        changes.setdefault(keyword.section, {})[keyword.key] = keyword.value(given[name])
    if spreads := given.get("nuisance"):
        # Texts such as dark=0.1, or with the name of a file, stray.txt=free.
        expected = f"NAME=SD, with a name of {', '.join(NUISANCES)} or a file's, and a standard deviation or free"
        if not isinstance(spreads, Mapping):
            spreads = dict(read_assignment(text, "nuisance", expected) for text in spreads)
        files = {
            Path(name).stem: {"file": Path(name), "sd": sd} for name, sd in spreads.items() if name not in NUISANCES
        }
        own = {name: choice.model_dump(exclude_none=True) for name, choice in nuisances.own.items()} | files
        named = {name: sd for name, sd in spreads.items() if name in NUISANCES}
        changes.setdefault("nuisances", {}).update(named | ({"own": own} if own else {}))
    return changes


def stars_of(
    stars: Sequence[Star], given: Mapping[str, Any], keywords: Mapping[str, Keyword], *, own: bool
) -> list[dict[str, Any]] | None:
    """Return the data of the stars that keywords name or change, or None.

    Raises InputError for a magnitude or another value of no star; `own` states that the user's study has `stars`.
    """
    if "star" not in given:
        return None
    names, magnitudes = given["star"], given["magnitude"]
    described = [name for name, each in keywords.items() if each.section == "star" and given[name] is not None]
    changed = {keywords[name].key: given[name] for name in described if name not in ("star", "magnitude")}
    of_files = [key for key in changed if key in FILE_KEYS]
    if not (names or magnitudes or changed):
        return None
    if not (names or own):
        # Those of the default study are not meant.
        raise InputError(
            f"`{described[0]}` needs a star, such as `star='M3V'`; `mauvecl library` lists them", key="star"
        )
    if names:
        # A name of an existing file is a file; other names are searched for in the library.
        each = [star for name in names for star in ([name] if is_there(name) else map(str.strip, name.split(",")))]
        data: list[dict[str, Any]] = [{"file": name} if _is_file(name) else {"library": name} for name in each]
    else:
        data = [entry.model_dump(exclude_none=True) for entry in stars]
    if magnitudes:
        if len(magnitudes) not in (1, len(data)):
            of = "one star" if len(data) == 1 else f"{len(data)} stars"
            raise InputError(
                f"there are {len(magnitudes)} magnitudes for {of}; give one for all or one each", key="magnitude"
            )
        for entry, value in zip(data, magnitudes * (len(data) if len(magnitudes) == 1 else 1), strict=True):
            entry["magnitude"] = value
    if of_files and not any("file" in entry for entry in data):
        named = " and ".join(f"`{key}`" for key in of_files)
        raise InputError(f"{named} needs a spectrum file among the stars: `star='my-star.txt'`", key=of_files[0])
    same = {key: value for key, value in changed.items() if key not in FILE_KEYS}
    return [entry | (changed if "file" in entry else same) for entry in data]


def is_there(name: str) -> bool:
    """Return whether a file has that name, which may contain commas."""
    try:
        return bool(name) and without_columns(name)[0].exists()
    except (OSError, ValueError):
        # Impossible file names raise an error.
        return True


def _is_file(name: str) -> bool:
    if is_there(name):
        return True
    # "K2.5V" and "power law -1.5" look like file names but are stars.
    if resolve(name) is not None:
        return False
    suffix = Path(name).suffix
    return bool(suffix) and not suffix[1:].isupper()
