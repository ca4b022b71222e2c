"""Studies: the sections of a TOML file, its text, and the keywords under which Python and flags give their keys."""

from __future__ import annotations

import contextlib
import hashlib
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, reduce
from itertools import chain
from operator import getitem
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, Field

from mauvecl.detection import DEFAULT_STATISTICS, countable, least_countable
from mauvecl.host.instrument import FORMER_NAMES, FORMERLY_MAUVE
from mauvecl.host.orbit import Limits
from mauvecl.host.stars.library import resolve
from mauvecl.host.tables import files
from mauvecl.noise.unknowns import NONE, NUISANCES, Processes
from mauvecl.schema.calls import checked, validated
from mauvecl.schema.errors import InputError, Message, shortened
from mauvecl.schema.fields import AnyUnit, Flag, Help, Unit, as_quantity, is_row, is_table, metadata_of
from mauvecl.schema.section import Section, built, fields_of, model_in, read_assignment, setting
from mauvecl.study import questions
from mauvecl.study.observation import NuisanceChoice, Observation, Run, SkyLight, Unknowns
from mauvecl.study.plan import OrbitQuestion, PlanQuestion, PlanTarget
from mauvecl.study.questions import QUANTITIES, Axis, Sweep
from mauvecl.study.star import FILE_KEYS, Flare, Star
from mauvecl.study.stare import EventChoice, InjectionQuestion, SearchChoice, StareQuestion

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo


def read_embedded_study(path: Path) -> str:
    """Return the text of the study in an answer's metadata."""
    study = files.read_ecsv(path, "study", "give an answer's ECSV table").meta.get("study")
    if not isinstance(study, str):
        raise InputError(f"{path.name} contains no study; give an answer's ECSV table", key="study")
    return study


def read_version(data: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the data of a study file as those of the current version, and warn of what differs in an older file.

    A file without a version is of version 1, in which by default everything but the noise was known and the instrument
    "mauve" had the conventions of the paper.
    """
    sections = ("observation", "nuisances", "run", "plan")
    if "version" in data or not all(isinstance(data.get(section, {}), dict) for section in sections):
        return data
    observation, nuisances, run, plan = ({**data.get(section, {})} for section in sections)
    instrument = observation.get("instrument", "mauve")
    if isinstance(instrument, str):
        observation["instrument"] = ({"mauve": FORMERLY_MAUVE} | FORMER_NAMES).get(instrument, instrument)
    nuisances.setdefault("usual", False)
    run.setdefault("statistics", [*DEFAULT_STATISTICS])
    if "plan" in data:
        plan.setdefault("completeness", "injections")
    unknowns = "the usual unknowns drawn" if nuisances["usual"] else "everything but the noise known"
    warnings.warn(
        f"{where} has no version and is read as in version 1, with the instrument now called "
        f"{observation['instrument']} and {unknowns}; `version = {VERSION}` asks with today's defaults.",
        stacklevel=2,
    )
    return data | {"version": VERSION} | dict(zip(sections, (observation, nuisances, run, plan), strict=True))


def with_paths(value: Any, change: Callable[[Path], Any]) -> Any:
    """Return a value, such as a study, in which `change` has replaced every path."""
    if isinstance(value, Path):
        return change(value)
    if isinstance(value, tuple):
        return tuple(with_paths(item, change) for item in value)
    if isinstance(value, dict):
        return {key: with_paths(item, change) for key, item in value.items()}
    if isinstance(value, BaseModel):
        changed = {key: with_paths(item, change) for key, item in value}
        return value.model_copy(update={key: item for key, item in changed.items() if item != getattr(value, key)})
    return value


def tables_in(data: Any) -> Iterator[dict[str, Any]]:
    """Yield the tables in nested data."""
    if isinstance(data, dict):
        yield data
        data = list(data.values())
    if isinstance(data, list | tuple):
        for value in data:
            yield from tables_in(value)


def locate_files(data: dict[str, Any], table: Path) -> None:
    """Locate the files that the study of an answer's table gives by name and digest, in place.

    Search the table's folder, its parent, the current folder, and the paths in a ``study.toml`` next to the table.
    """
    study = table.parent / "study.toml"
    for section in tables_in(data):
        for key, path in [*section.items()]:
            if f"{key}_sha256" not in section or not isinstance(path, str):
                continue
            name, digest = Path(path).name, section.pop(f"{key}_sha256")
            text = files.read_text(study, "study file") if study.is_file() else ""
            tables = tables_in(files.toml(text, "study file 'study.toml'"))
            values = (value for keys in tables for value in keys.values() if isinstance(value, str))
            named = (table.parent / value for value in values if Path(value).name == name)
            places = [table.parent / name, table.parent.parent / name, Path(name), *named]
            existing = (place for place in places if files.without_columns(place)[0].is_file())
            file = next((place for place in existing if _digest(place) == digest), None)
            if file is None:
                fault = f"its file {shortened(name)} with sha256 {shortened(str(digest))} is missing or has changed"
                raise InputError(f"{shortened(table.name)}: {fault}; it must lie next to the table", key=key)
            section[key] = str(file.resolve())


def _digest(path: Path) -> str:
    return hashlib.sha256(files.read_bytes(files.without_columns(path)[0], "spectrum file")).hexdigest()


def set_key(data: Any, path: list[str], value: Any, text: str) -> None:
    """Set a nested key in place; `text` is the setting, for messages."""
    *parents, last = path
    for key in parents:
        if isinstance(data, list | tuple):
            if key not in (numbers := [str(i) for i in range(len(data))]):
                fault = f"the entry must be 0 to {len(numbers) - 1}, not {shortened(key)}"
                raise InputError(f"setting = {shortened(text)}: {fault}", key="setting")
            data = data[int(key)]
        elif isinstance(data, dict):
            data = data.setdefault(key, {})
    if not isinstance(data, dict):
        fault = f"{shortened('.'.join(parents))} must be a section with keys, but is a value"
        raise InputError(f"setting = {shortened(text)}: {fault}", key="setting")
    data[last] = value


#: Version of study files.
VERSION: Literal[2] = 2
#: Sections that a study's text leaves out if they have their default values.
OMITTED = (
    "signal", "bulk", "nuisances", "stare", "events", "search", "injections", "orbit", "plan", "measure", "data",
    "calibrate", "change",
)  # fmt: skip
#: Largest number of realisations to which too few are raised.
MOST_RAISED = 1_000_000
#: The paper's two stars.
PAPER_STARS = (Star(library="K3V", magnitude=3.7), Star(library="G2V", magnitude=7.4))


@validated
class Study(Section):
    """Everything that an answer depends on; the default is the paper's question, asked with the usual unknowns.

    Examples
    --------
    >>> import tomllib
    >>> from mauvecl import Study
    >>> study = Study().with_settings(["run.fap=0.01", "star.0.magnitude=6"])
    >>> study.run.fap, study.star[0].library, study.star[0].magnitude
    (0.01, 'K3V', 6.0)
    >>> study == Study.build(tomllib.loads(study.toml()), "text")
    True
    """

    version: Literal[2] = setting(VERSION, Help("Version of the study's keys and defaults; none in files of version 1"))
    star: Annotated[tuple[Star, ...], Field(min_length=1)] = PAPER_STARS
    flare: Flare = Flare()
    observation: Observation = Observation()
    sky: SkyLight = SkyLight()
    processes: Processes = NONE
    nuisances: NuisanceChoice = NuisanceChoice()
    run: Run = Run()
    campaign: questions.CampaignQuestion = questions.CampaignQuestion()
    signal: questions.SignalQuestion = questions.SignalQuestion()
    limit: questions.LimitQuestion = questions.LimitQuestion()
    map: questions.MapQuestion = questions.MapQuestion()
    bulk: questions.BulkQuestion = questions.BulkQuestion()
    sweep: Sweep = Sweep()
    unknowns: Unknowns = Unknowns()
    stare: StareQuestion = StareQuestion()
    events: tuple[EventChoice, ...] = ()
    search: SearchChoice = SearchChoice()
    injections: InjectionQuestion = InjectionQuestion()
    orbit: OrbitQuestion = OrbitQuestion()
    plan: PlanQuestion = PlanQuestion()
    measure: questions.MeasureQuestion = questions.MeasureQuestion()
    data: questions.DataChoice = questions.DataChoice()
    calibrate: questions.CalibrateQuestion = questions.CalibrateQuestion()
    change: questions.ChangeQuestion = questions.ChangeQuestion()

    def _check_values(self) -> None:
        stars = [number for number, star in enumerate(self.star) if star.effective_temperature_k is not None]
        if stars and self.flare.geometry == "replaces" and self.flare.photosphere_temperature_k is not None:
            key = "flare.photosphere_temperature_k"
            raise InputError(f"only one of {key} and star.{stars[0]}.effective_temperature_k may be given", key=key)

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a study file, or the study in an answer's ECSV table."""
        path = Path(path)
        text = read_embedded_study(path) if path.suffix == ".ecsv" else files.read_text(path, "study file")
        data = files.toml(text, f"study file {shortened(path.name)}")
        if not _without_empty(data):
            fault = f"study file {shortened(path.name)} must set at least one key, such as magnitude in [[star]]"
            remedy = "a verb without a study file answers the paper's question"
            raise InputError(f"{fault}, but sets nothing; {remedy}", key="study_file")
        if path.suffix == ".ecsv":
            locate_files(data, path)
        study = cls.build(read_version(data, path.name), path.name)
        # Paths are relative to the study file.
        moved: Self = with_paths(study, lambda file: path.parent / file)
        return moved

    @classmethod
    def build(cls, data: dict[str, Any], where: str) -> Self:
        """Validate nested data; raises InputError for the first invalid value."""
        files.possible(data, where)
        return built(cls, data, where)

    @classmethod
    def of(cls, **keywords: Any) -> Self:
        """Build a study from keywords that are named as the flags of the command line.

        Examples
        --------
        >>> import astropy.units as u
        >>> from mauvecl import Study
        >>> Study.of(star="M4V", magnitude=11, amplitude=0.05, exposure=2 * u.min)
        <Study of M4V V = 11; flares of 5 %; 120 s on mauve>
        """
        count, where = Counter(keyword.name for keyword in keys_of()), "Study.of()"
        # A name that several keys share is ambiguous.
        accepted = {keyword.name: keyword for keyword in keys_of() if count[keyword.name] == 1}
        return with_keywords(cls(), values_of(keywords, accepted, where), accepted, where, is_default=True)

    def ideal(self) -> Self:
        """Return a copy without the usual unknowns."""
        return self.with_value(("nuisances", "usual"), False)

    def paper(self) -> Self:
        """Return a copy with the conventions of the MauveSim paper.

        The dark charge is drawn in DN, everything but the noise is known, and sums of squares are statistics as well
        unless the study states its statistics.
        """
        study = self.ideal().with_value(("observation", "instrument"), FORMERLY_MAUVE)
        if "statistics" in self.run.model_fields_set:
            return study
        return study.model_copy(update={"run": self.run.model_copy(update={"statistics": DEFAULT_STATISTICS})})

    def with_changes(
        self, changes: dict[str, dict[str, Any]], stars: list[dict[str, Any]] | None, where: str = "changes"
    ) -> Self:
        """Return a copy with other values, by sections such as "orbit.limits"; None leaves a value unchanged."""
        data = self.model_dump()
        for section, values in changes.items():
            changed = {key: value for key, value in values.items() if value is not None}
            if section == "sky" and changed:
                # A new sky replaces all keys of the old one.
                data[section] = {}
            reduce(getitem, section.split("."), data).update(changed)
        if stars is not None:
            data["star"] = stars
        return self.build(data, where)

    def with_settings(self, settings: Sequence[str], where: str = "settings") -> Self:
        """Return a copy with keys set from text, such as ``run.fap=0.01`` or ``star.0.magnitude=6``."""
        data = self.model_dump(exclude_none=True)
        for text in settings:
            path, equals, value = map(str.strip, text.partition("="))
            if not (path and equals):
                raise InputError.of("setting", text, "key=value, such as run.fap=0.01")
            label, parsed = f"value {shortened(value)}", dict[str, Any]()
            files.check_keys(value, label)
            # A bare word is text, and so are several lines, which would define several keys.
            with files.parsing(label, "give a TOML value"), contextlib.suppress(tomllib.TOMLDecodeError):
                parsed = tomllib.loads(f"value = {value}")
            set_key(data, path.split("."), parsed["value"] if len(parsed) == 1 else value, text)
        return self.build(data, where)

    def with_enough_tails(self, *, sampled: bool = True, raised: bool = False) -> tuple[Self, list[str]]:
        """Return a copy whose thresholds can be found, with a message if it differs.

        Importance sampling may find thresholds that cannot be counted if `sampled`; if `raised`, more realisations are
        drawn instead, up to `MOST_RAISED`.
        """
        run = self.run
        if not 0 < run.fap < 1 or countable(run.fap, run.realisations):
            return self, []
        least = least_countable(run.fap)
        thresholds = f"thresholds with a false-alarm probability of {run.fap:g}"
        few = f"{run.realisations} realisations are too few to count {thresholds}, so "
        if raised and least <= MOST_RAISED:
            return self.with_settings([f"run.realisations={least}"]), [f"{few}{least} are drawn."]
        if not sampled:
            return self, []
        message = Message(f"{few}importance sampling finds them (`tails='sampled'`).", "sampled")
        return self.with_settings(["run.tails=sampled"]), [message]

    def _text_data(self) -> dict[str, Any]:
        """Return the data of the study's text, without sections that have their default values."""
        data: dict[str, Any] = self.model_dump(exclude_none=True)
        unused = {"sweep": not self.sweep.axes, "unknowns": not self.unknowns.draws}
        fields = type(self).model_fields
        for name in [*data]:
            if unused.get(name) or (name in OMITTED and getattr(self, name) == fields[name].default):
                del data[name]
        if not self.sky.none:
            del data["sky"]["none"]
        if "orbit" in data and self.orbit.limits == Limits():
            del data["orbit"]["limits"]
        if self.flare.is_blackbody:
            del data["flare"]["spectrum"]
        for star in data["star"]:
            if "neighbours" not in star:
                del star["neighbour_share"]
        data = _without_empty(data)
        if "nuisances" in data:
            # Study files have this table even if it is empty.
            data["nuisances"].setdefault("own", {})
        return data

    def toml(self) -> str:
        """Return the study as TOML, without sections that have their default values."""
        import tomli_w

        return tomli_w.dumps(with_paths(self._text_data(), lambda file: str(file.resolve())))

    def __repr__(self) -> str:
        o, swept = self.observation, [axis.quantity for axis in self.sweep.axes]
        stars = [
            f"{star.library or star.file}" + ("" if star.magnitude is None else f" {star.band} = {star.magnitude:g}")
            for star in self.star
        ]
        over = f", over {', '.join(swept)}" if swept else ""
        flares = ", ".join(f"{100 * amplitude:g} %" for amplitude in self.flare.amplitudes)
        flares = "the observed brightness" if self.flare.spectrum.as_observed else flares
        return f"<Study of {', '.join(stars)}; flares of {flares}; {o.exposure_s:g} s on {o.instrument}{over}>"

    __str__ = __repr__

    def text(self) -> str:
        """Return the study as TOML for an answer's table, with files by name and digest instead of their paths."""
        import tomli_w

        data = self._text_data()
        for section in tables_in(data):
            for key, value in [*section.items()]:
                if isinstance(value, Path):
                    section[key] = value.name
                    # Keep the answer even if the file no longer exists.
                    with contextlib.suppress(InputError):
                        section[f"{key}_sha256"] = _digest(value)
        return tomli_w.dumps(data)

    def with_instrument(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with other values of the instrument; see `Instrument.with_`."""
        o = self.observation
        update: dict[str, Any] = {"changes": o.changes | dict(changes)}
        if "temperature_c" in changes:
            update["temperature_c"] = None
        return self.model_copy(update={"observation": o.model_copy(update=update)})

    def at(self, quantity: str, value: Annotated[float, AnyUnit()] | str) -> Self:
        """Return a copy with another value of one quantity, for all stars.

        Parameters
        ----------
        quantity : str
            A key of `QUANTITIES`.
        value : float, Quantity or str
            For "star", a name of the library.
        """
        if quantity not in QUANTITIES:
            raise InputError.of("quantity", quantity, f"one of {', '.join(QUANTITIES)}")
        swept = QUANTITIES[quantity]
        if swept.range is not None:
            kind = Annotated[float, Unit(swept.unit), swept.range]
            value = checked(kind, quantity.replace("_", " "), value)
        return self.with_value(swept.path, value)

    @property
    def has_neighbours(self) -> bool:
        """True if a star or a target of a plan has a table of neighbours."""
        stars: tuple[Star | PlanTarget, ...] = (*self.star, *self.plan.targets)
        return any(star.neighbours is not None for star in stars)


def _without_empty(data: Any) -> Any:
    """Return nested tables without those that are empty."""
    if not isinstance(data, dict):
        return data
    return {key: inner for key, value in data.items() if (inner := _without_empty(value)) != {}}


#: The paper's noise budgets (its section "Noise"): the Be star HD 37202 and both flare stars, 50 s and 600 s.
PAPER_BUDGETS = Study(
    star=(Star(library="B2IV", magnitude=3.03), *PAPER_STARS),
    run=Run(realisations=100_000),
    sweep=Sweep(axes=(Axis(quantity="exposure", values=(50.0, 600.0)),)),
)


@cache
def study_keys() -> Mapping[str, FieldInfo]:
    """Return the field of every key of a study, by its path, as in ``run.fap``."""
    return {".".join(path): field for path, field in fields_of(Study)}


@cache
def keys_of(sections: tuple[str, ...] = ("",)) -> tuple[Keyword, ...]:
    """Return the keywords of keys and whole sections in their order, by default of all."""
    return tuple(
        Keyword(key, field, flag)
        for section in sections
        for key, field in study_keys().items()
        if not section or f"{key}.".startswith(f"{section}.")
        for flag in metadata_of(field, Flag)
    )


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
    def kind(self) -> Any:
        """Type of the value on the command line."""
        return self.flag.kind or plain_kind(self.field.annotation)

    @property
    def many(self) -> bool:
        """True if it has several values."""
        return get_origin(self.kind) is list

    @property
    def item_kind(self) -> Any:
        """Type of one of its values on the command line."""
        return get_args(self.kind)[0] if self.many else self.kind

    def value(self, value: Any) -> Any:
        """Convert a value of the kind that the command line takes to that of the key; return others unchanged.

        A single record of a list, such as a target, is a list of one: keys of it, a row of a table, or a position.
        """
        records = get_origin(self.field.annotation) is tuple and model_in(self.field.annotation) is not None
        if records and is_row(value):
            value = value.table[value.index : value.index + 1]
        elif records and (isinstance(value, Mapping) or (hasattr(value, "icrs") and not getattr(value, "ndim", 0))):
            value = [value]
        kinds = {str: (str,), Path: (str, Path)}.get(self.item_kind, (str, int, float))
        is_read = all(isinstance(item, kinds) for item in (value if self.many else [value]))
        # Readers of files also take tables in memory.
        if self.flag.read is None or not (is_read or (self.item_kind is Path and is_table(value))):
            return value
        return self.flag.read(value, self.name)


def plain_kind(annotation: Any) -> Any:
    """Return the type of a keyword's value: a plain type, or a list for a field of several values."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return plain_kind(arguments[0])
    if origin is tuple:
        return list[plain_kind(arguments[0])]  # type: ignore[misc]
    if origin in (Union, UnionType):
        kinds = {plain_kind(kind) for kind in arguments if kind is not NoneType}
        # A field for a number or a word takes text.
        return kinds.pop() if len(kinds) == 1 else str
    return str if origin is Literal else annotation


def values_of(values: Mapping[str, Any], keywords: Mapping[str, Keyword], where: str) -> dict[str, Any]:
    """Return the value of each keyword, None where it is not given, and of ``paper``.

    Raises InputError for a keyword of another name; ``ideal`` is another form of ``with_unknowns``, and ``paper`` needs
    an instrument.
    """
    # Another form of a keyword, and one that needs a keyword.
    forms = {"paper": "instrument", "ideal": "with_unknowns"}
    accepted = [*keywords, *(name for name, needed in forms.items() if needed in keywords)]
    for name in values.keys() - accepted:
        same_key = [word for word, keyword in keywords.items() if keyword.path.rpartition(".")[2] == name]
        near = same_key or get_close_matches(name, accepted, n=3) or accepted
        raise InputError(f"{where} has no keyword {name!r}; use a flag of the command, such as {', '.join(near)}")
    by_name = {name: values.get(name) for name in keywords}
    for name, value in by_name.items():
        if keywords[name].many and (is_table(value) or is_row(value)):
            raise InputError.of(name, value, "a value or a list of values")
        if keywords[name].many and value is not None and not isinstance(value, Mapping):
            # Neither a sequence nor an array.
            is_single = isinstance(value, str | Path) or getattr(value, "ndim", 1) == 0 or not hasattr(value, "__len__")
            by_name[name] = [value] if is_single else list(as_quantity(value))
    if values.get("ideal"):
        by_name["with_unknowns"] = False
    return by_name | {"paper": values.get("paper")}


StudyOf = TypeVar("StudyOf", bound=Study)


def with_keywords(
    study: StudyOf, values: Mapping[str, Any], keywords: Mapping[str, Keyword], where: str, *, is_default: bool
) -> StudyOf:
    """Return a study changed by the values of keywords, as `values_of` returns them.

    If the study `is_default`, keywords that describe a star must come with one that names it.
    """
    if values.get("paper"):
        study = study.paper()
    changes: dict[str, dict[str, Any]] = {}
    names: dict[str, str] = {}
    for name, keyword in keywords.items():
        section, _, key = keyword.path.rpartition(".")
        if values[name] is None or section == "star" or name == "nuisance":
            continue
        first_name = names.setdefault(keyword.path, name)
        if first_name != name:
            raise InputError(f"give either `{first_name}` or `{name}`: both set {keyword.path}", key=first_name)
        changes.setdefault(section, {})[key] = keyword.value(values[name])
    if spreads := values.get("nuisance"):
        changes.setdefault("nuisances", {}).update(_nuisances(spreads, study.nuisances))
    stars = _stars(study.star, values, keywords, is_default=is_default) if "star" in keywords else None
    return study.with_changes(changes, stars, where)


def _nuisances(spreads: Any, nuisances: NuisanceChoice) -> dict[str, Any]:
    """Return the keys of nuisances that are set by texts such as dark=0.1 or, for a file, stray.txt=free."""
    expected = f"NAME=SD, with a name of {', '.join(NUISANCES)} or a file's, and a standard deviation or free"
    if not isinstance(spreads, Mapping):
        if not all(isinstance(text, str) for text in spreads):
            raise InputError.of("nuisance", spreads, expected)
        spreads = dict(read_assignment(text, "nuisance", expected) for text in spreads)
    of_files = {
        Path(name).stem: {"file": Path(name), "sd": sd} for name, sd in spreads.items() if name not in NUISANCES
    }
    own = {name: nuisance.model_dump(exclude_none=True) for name, nuisance in nuisances.own.items()} | of_files
    return {name: sd for name, sd in spreads.items() if name in NUISANCES} | ({"own": own} if own else {})


def _stars(
    stars: Sequence[Star], values: Mapping[str, Any], keywords: Mapping[str, Keyword], *, is_default: bool
) -> list[dict[str, Any]] | None:
    """Return the data of the stars that keywords name or change, or None without such keywords."""
    described = [
        name for name, keyword in keywords.items() if keyword.path.startswith("star.") and values[name] is not None
    ]
    names, magnitudes = values["star"], values["magnitude"]
    for name in ("star", "magnitude"):
        if isinstance(values[name], Mapping):
            expected = "a value or a list of values (`Study.build` takes stars with their keys)"
            raise InputError.of(name, values[name], expected)
    changes = {
        keywords[name].path.removeprefix("star."): values[name]
        for name in described
        if name not in ("star", "magnitude")
    }
    if not (names or magnitudes or changes):
        return None
    if is_default and not names:
        fault = f"`{described[0]}` needs a star, such as `star='M3V'`; `mauvecl library` lists them"
        raise InputError(fault, key="star")
    data = _named_stars(names) if names else [star.model_dump(exclude_none=True) for star in stars]
    if magnitudes:
        if len(magnitudes) not in (1, len(data)):
            count = "one star" if len(data) == 1 else f"{len(data)} stars"
            fault = f"there are {len(magnitudes)} magnitudes for {count}; give one for all or one each"
            raise InputError(fault, key="magnitude")
        for star, magnitude in zip(data, magnitudes * (len(data) if len(magnitudes) == 1 else 1), strict=True):
            star["magnitude"] = magnitude
    of_files = [key for key in changes if key in FILE_KEYS]
    if of_files and not any("file" in star for star in data):
        needing = " and ".join(f"`{key}`" for key in of_files)
        raise InputError(f"{needing} needs a spectrum file among the stars: `star='my-star.txt'`", key=of_files[0])
    of_library = {key: value for key, value in changes.items() if key not in FILE_KEYS}
    return [star | (changes if "file" in star else of_library) for star in data]


def _named_stars(texts: Sequence[str]) -> list[dict[str, Any]]:
    """Return the data of stars from names of the library with commas between them, and names of files."""
    for text in texts:
        if not isinstance(text, str | Path):
            raise InputError.of("star", text, "the name of a star or of a file")
    # A name of an existing file is a file; other names are searched for in the library.
    parts = ([text] if is_there(text) else map(str.strip, text.split(",")) for text in map(str, texts))
    names = [*chain.from_iterable(parts)]
    stars: list[dict[str, Any]] = []
    for name in names:
        # "K2.5V" and "power law -1.5" look like file names but are stars.
        suffix = Path(name).suffix[1:]
        is_file = is_there(name) or (bool(suffix) and not suffix.isupper() and resolve(name) is None)
        stars.append({"file" if is_file else "library": name})
    return stars


def is_there(name: str) -> bool:
    """Return whether a file has that name, which may contain commas."""
    try:
        return bool(name) and files.without_columns(name)[0].exists()
    except (OSError, ValueError):
        # Impossible file names raise an error.
        return True
