"""Fields of the page, and messages in their words."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic.fields import FieldInfo

from mauvecl.detection.requests import STATISTICS
from mauvecl.host.instrument import FORMER_NAMES, FORMERLY_MAUVE
from mauvecl.host.stars.library import ModelStar, embedded, named_star, near_names
from mauvecl.host.tables.text_tables import columns, text_table
from mauvecl.schema.errors import REMEDY, SUBJECT, InputError, shortened
from mauvecl.schema.fields import (
    Flag,
    LineFraction,
    Range,
    Unit,
    Widget,
    as_typed,
    first,
    metadata_of,
    range_of,
    with_unit,
)
from mauvecl.schema.section import check_different
from mauvecl.study.star import FILE_KEYS, FLARE_FILE_KEYS
from mauvecl.study.study import keys_of, study_keys

#: Texts of fields with an uploaded file: those that also accept a name or numbers, and all others.
UPLOADED, UPLOADED_UNKNOWN, UPLOADED_FILE = "uploaded star", "uploaded spectrum", "uploaded file"
#: Numbers of realisations that a visitor can request, without and with importance sampling of the tail.
REALISATIONS, SAMPLED = (10_000, 100_000, 1_000_000, 4_000_000), (100_000, 1_000_000)

#: Choices of what is unknown: the usual unknowns, and nothing but the noise.
REALISTIC, IDEAL = UNKNOWN = ("realistic", "ideal")
SKIES = ("brightness", "target and time", "none")
#: Values of fields in links of version 1, which have other names today, with these names.
FORMER_VALUES = {
    "unknown": {"nothing": IDEAL, "the usual": REALISTIC},
    "instrument": {"mauve": FORMERLY_MAUVE} | FORMER_NAMES,
}
#: Headings of fields by their key or by its section; other fields show at once.
HEADINGS = {
    "flare.spectrum": "Flare's spectrum", "flare.temperature_k": "Flare's spectrum", "sky": "Sky",
    "observation.signal": "Sky", "observation.temperature_c": "Detector", "run": "Detection",
    "limit.power": "Detection", "limit": "Limit", "search": "Search", "stare.pointing": "Pointing",
    "orbit": "Campaign", "plan": "Campaign", "measure": "Measurement", "star.distance_pc": "Measurement",
    "data": "Frames", "calibrate": "Standards", "change": "Change", "star.ebv": "Star",
    **dict.fromkeys(("star.neighbours", "star.neighbours_of", "star.neighbour_share"), "Neighbours"),
    **{f"star.{key}": "Own spectrum" for key in FILE_KEYS},
    **{f"flare.spectrum.{key}": "Own flare" for key in FLARE_FILE_KEYS},
    **{f"change.{key}": "Added spectrum" for key in ("band", "wavelength_unit", "flux_unit", "extend")},
}  # fmt: skip
MOST_CHARACTERS, MOST_TABLE = 200, 3000  # lengths of a field, and of a table of neighbours, which is a part of links
MOST_TARGETS = 30  # largest number of targets of a visitor
MOST_POINTS = 4000  # largest number of points of an unknown spectrum, which the study in every table contains
NO_KEYS: Mapping[str, str] = MappingProxyType({})
_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")  # a flag of the command line
#: A key within a message; words of prose contain no underscore.
_KEY = re.compile(r"(?<![\w.'])(?:[a-z]+\.)*[a-z0-9]+(?:_[a-z0-9]+)+(?![\w.]*')")


@dataclass(frozen=True)
class Number:
    """Number in a range, written with a decimal point, and with or without a unit."""

    range: Range
    whole: bool = False
    unit: str = ""
    scale: float = 1  # factor from the value in the unit to that of the page

    def __call__(self, text: str) -> float | int:
        """Parse the number; an error states what is accepted."""
        kind = "a whole number" if self.whole else "a number"
        accepted = self.range.words(self.unit, whole=self.whole)
        form = r"[+-]?\d+" if self.whole else r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?"
        if not text.strip():
            raise InputError(f"nothing is entered; {accepted} is needed")
        try:
            measure = None if self.whole else with_unit(text, self.unit)
        except ValueError:
            raise InputError(f"{shortened(text)} has another unit: enter {accepted}") from None
        text = text if measure is None else repr(self.scale * measure)
        if re.fullmatch(form, text.strip(), flags=re.ASCII) is None:
            point = ", with a point for decimals" if "," in text else ""
            raise InputError(f"{shortened(text)} is not {kind}: enter {accepted}{point}")
        value = int(text) if self.whole else float(text)
        if value not in self.range:
            raise InputError(f"{shortened(text.strip())} is out of range: enter {accepted}")
        return value


@dataclass(frozen=True)
class Choice:
    """One of several words."""

    options: tuple[str, ...]
    convert: Callable[[str], Any] = str

    def __call__(self, text: str) -> Any:
        """Parse the value; an error states what is accepted."""
        if text not in self.options:
            raise InputError(f"{shortened(text)} is not a choice: use one of {', '.join(self.options)}")
        return self.convert(text)


def read_points(text: str, name: str) -> tuple[tuple[float, float], ...]:
    """Read the spectrum of a nuisance parameter: lines of nm and DN of the exposure; `name` stands in messages."""
    points = columns(name, text, "nm and DN", "nm")
    if not 2 <= len(points) <= MOST_POINTS:
        raise InputError(f"{name} must have 2 to {MOST_POINTS} pairs of nm and DN, but has {len(points)}")
    if not np.isfinite(points).all() or (np.diff(points[:, 0]) <= 0).any():
        raise InputError(f"{name} must have pairs in ascending order of nm")
    return tuple((float(nm), float(dn)) for nm, dn in points)


def typed_points(text: str) -> tuple[tuple[float, float], ...]:
    """Parse a spectrum as pairs of nm and DN with commas between them; no points for an uploaded one."""
    typed = text.strip() and text != UPLOADED_UNKNOWN
    return read_points(text.replace(",", "\n"), shortened(text)) if typed else ()


def line_fluxes(text: str) -> tuple[tuple[str, float], ...]:
    """Parse emission lines such as "Mg II = 0.03, Balmer = 0.1"."""
    from mauvecl.host.stars.flare import EmissionLine

    pairs = [pair.partition("=") for pair in text.split(",") if text.strip()]
    share = Number(range_of(LineFraction))
    fractions = tuple((EmissionLine.named(name).name, float(share(value))) for name, _, value in pairs)
    if len(dict(fractions)) < len(fractions):
        raise InputError(f"{shortened(text)} contains a line twice, but each must be given once")
    return fractions


def parse_draws(text: str) -> tuple[int, str]:
    """Parse the number of realisations, and how the tail is found, such as "100000" or "100000 sampled"."""
    number, _, tails = text.partition(" ")
    return int(number), tails or "counted"


def star_name(text: str) -> str:
    """Return the name of a star as it is entered; raises InputError for unknown ones and those stored on the server."""
    if text == UPLOADED:
        return UPLOADED
    if not text.strip():
        raise InputError("no star is chosen: give a name of the library, or upload a spectrum")
    named_star(text, own=False)
    return text.strip()


def targets(text: str, *, check: bool = True) -> tuple[dict[str, Any], ...]:
    """Parse targets: a name or coordinates in each line, or a CSV table with a header of keys of `PlanTarget`.

    With a check their positions must be known, and all must differ.
    """
    from mauvecl.study.plan import PlanTarget, targets_in

    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        return ()
    if lines[0].partition(",")[0].strip().casefold() != "name":
        quoted = (line.replace('"', "") for line in lines)
        lines = ["name", *(f'"{line}"' for line in quoted)]
    if len(lines) - 1 > MOST_TARGETS:
        raise InputError(f"{len(lines) - 1} targets are too many: give at most {MOST_TARGETS}, or use the command line")
    rows = targets_in(text_table("\n".join(lines), "the table", commas=True), "the table")
    if not check:
        return tuple(rows)
    for number, row in enumerate(rows, 1):
        try:
            PlanTarget.model_validate(row).target(simbad=False)
        except InputError as error:
            like = ", ".join(near_names(row["name"], stars_only=True))
            raise InputError(
                f"the position of {shortened(row['name'])} (target {number}) is unknown: give a name such as {like}, "
                "or coordinates such as 53.23 -9.46"
            ) from error
    check_different([row["name"] for row in rows], "the target", "targets")
    return tuple(rows)


def neighbours(text: str) -> str | None:
    """Check that a text is a CSV table of neighbours without names of files, and return it; None for nothing."""
    from mauvecl.host.exposure.background import SPECTRUM_FILES

    if not text.strip():
        return None
    if text.startswith("# %ECSV"):
        raise InputError("the table of neighbours is ECSV, but must be CSV on this page; the command line reads both")
    names = {name.strip().lower() for name in text_table(text, "the table of neighbours", commas=True).colnames}
    if files := names & {*SPECTRUM_FILES}:
        raise InputError(
            f"the table of neighbours has a column {min(files)}, but must have spectral_type instead; the command line "
            "reads files of spectra"
        )
    return text


def star_words(name: str) -> str:
    """Describe a star of the library by its type and the star of its spectrum."""
    known = named_star(name, own=False)
    name, entry = known.nearest, embedded(known.nearest)
    if isinstance(known.light, ModelStar):
        return f"a {name.replace('body', 'body of').replace('law', 'law of index')}"
    star = name if entry is None else entry["star"]
    if star == name:
        return f"a star like {'the ' if name == 'Sun' else ''}{name}"
    article = "an" if name[0] in "AFM" else "a"
    return f"{article} {name} star" + ("" if star.startswith("Pickles ") else f" (spectrum of {star})")


@dataclass(frozen=True, kw_only=True)
class Field(Widget):
    """Field of the page: a widget of a key, or of keys that `FieldValues` sets."""

    first: str  # text of a new page
    unit: str = ""
    group: str = ""  # heading of its group; empty for a field that shows at once
    read: Callable[[str], Any]  # converts text to the value; raises InputError with what is accepted
    path: tuple[str, ...] = ()  # key of the study that takes the value; empty if `FieldValues` converts it
    own_keys: tuple[str, ...] = ()  # keys and sections of the study that it sets without a path
    characters: int = MOST_CHARACTERS  # largest number

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys and sections of the study that it sets."""
        return self.own_keys or (".".join(self.path),)


def _field(key: str, field: FieldInfo, widget: Widget) -> Field:
    """Return the field of a key from its metadata.

    Its name is that of the key, as in "exposure_s", or "change_band" if a flag is named so as well.
    """
    section, _, name = key.rpartition(".")
    with_section = f"{key.partition('.')[0]}_{name}"
    if any(with_section.startswith(flag.parameter) for flag in metadata_of(field, Flag)):
        name = with_section
    default, unit, flag = field.get_default(), first(field, Unit) or Unit(""), first(field, Flag) or Flag("")
    text = as_typed(default * widget.scale if isinstance(default, float) else default, truth=("no", "yes"))
    optional = text == "" if widget.first is None else not widget.first
    texts = {
        "name": widget.name or name,
        "label": widget.label or flag.label,
        "group": next((HEADINGS[place] for place in (key, section) if place in HEADINGS), ""),
        "first": text if widget.first is None else widget.first,
        "unit": unit.written if widget.unit is None else widget.unit,
        "read": _reader(field, widget, unit.name, optional=optional),
        "characters": MOST_TABLE if widget.kind == "table" else MOST_CHARACTERS,
    }
    return Field(**(vars(widget) | texts), path=tuple(key.split(".")))


#: Readers of fields by the kind of their widget.
READERS: dict[str, Callable[[str], Any]] = {
    "day": str.strip,
    "table": neighbours,
    "library": lambda text: named_star(text, own=False).nearest if text.strip() else None,
    **dict.fromkeys(("file", "upload"), Choice(("", UPLOADED_FILE), lambda text: text or None)),
}


def _reader(field: FieldInfo, widget: Widget, unit: str, *, optional: bool) -> Callable[[str], Any]:
    """Return the function that reads the text of a field."""
    choices = widget.choices or (get_args(field.annotation) if get_origin(field.annotation) is Literal else ())
    if choices:
        return Choice(choices)
    if widget.kind in READERS:
        return READERS[widget.kind]
    if field.annotation is bool:
        return Choice(("no", "yes"), lambda text: text == "yes")
    flag = first(field, Flag)
    if flag is not None and flag.kind == list[str] and flag.read is not None:
        read = flag.read
        return lambda text: tuple(read([word for word in text.split(",") if word.strip()], widget.label))
    reach = first(field, Range)
    if reach is None:
        return (lambda text: text.strip() or None) if optional else str
    high = reach.high if widget.most is None else widget.most
    reach = replace(reach, low=widget.scale * reach.low, high=widget.scale * high)
    number = Number(reach, whole=field.annotation is int, unit=unit, scale=widget.scale)
    return (lambda text: number(text) if text.strip() else None) if optional else number


#: Fields that do not stand for one key of the study.
_OWN_FIELDS = {
    "star": Field(
        label="Star", first="G2V", read=star_name,
        hint="Whose spectrum: a spectral type of the library, one of its stars by any name (GJ 581, HD 40307), a "
        "blackbody (blackbody 9000 K), a power law of the wavelength (power law -2), or your own file.",
        place=-1, own_keys=("star.library",),
    ),
    "lines": Field(
        label="Emission lines", first="", read=line_fluxes,
        hint="Flux of lines as a fraction of the continuum's in 200-700 nm, such as Mg II=0.03, Ca II=0.02, "
        "Balmer=0.1, or 280=0.03 for one at 280 nm.", group="Flare's spectrum", place=1, own_keys=("flare.spectrum",),
    ),
    "sky": Field(
        label="Sky", first="brightness", read=Choice(SKIES), hint="Zodiacal light behind the star.", group="Sky",
        own_keys=("sky",),
    ),
    "statistic": Field(
        label="Detection statistic", first="matched", read=Choice(tuple(STATISTICS)),
        hint="; ".join(f"{name}: {statistic.definition}" for name, statistic in STATISTICS.items()) + ".",
        group="Detection", place=1, own_keys=("run.statistics",),
    ),
    "unknown": Field(
        label="Kind of answer", first=REALISTIC, read=Choice(UNKNOWN),
        hint="Realistic: detector temperature, light lost and sky differ from exposure to exposure and are unknown; "
        "they are drawn, and the statistic is made blind to them. Ideal: everything but the noise is known. The card "
        "shows both chances; this is for the pictures, tables and simulations.", place=3,
        own_keys=("nuisances.usual",),
    ),
    "own_unknown": Field(
        label="Own unknown spectrum", first="", read=typed_points,
        hint="Something else of known shape and unknown strength, such as stray light: pairs of nm and DN, as in "
        "200 1, 450 3, 700 1, or a file of two columns.", group="Unknown", place=1, own_keys=("nuisances.own",),
        placeholder="200 1, 450 3, 700 1",
    ),
    "targets": Field(
        label="Targets", first="", read=targets,
        hint="Stars by name, such as eps Eri or AU Mic, or coordinates such as 53.23 -9.46. What is known of a star "
        "need not be entered; paste a list of names, or a CSV table with columns such as name, ra, dec, V, "
        "spectral_type, distance_pc, mass_msun and age_myr.", group="Campaign", characters=MOST_TARGETS * 100,
        kind="targets", path=("plan", "targets"),
    ),
    "realisations": Field(
        label="Realisations", first="100000",
        read=Choice((*map(str, REALISATIONS), *(f"{count} sampled" for count in SAMPLED)), parse_draws),
        hint="How many noisy exposures a simulation draws. At least 100 must lie beyond the threshold; a sampled tail "
        "(importance sampling) needs fewer.", group="Detection", place=2, own_keys=("run.realisations", "run.tails"),
    ),
}  # fmt: skip
_KEYS = [_field(key, field, widget) for key, field in study_keys().items() for widget in metadata_of(field, Widget)]
#: Fields by name, as in links and in `FieldValues`; the default is a flare at the edge of detection.
FIELDS = _OWN_FIELDS | {field.name: field for field in _KEYS}
FIELDS = dict(sorted(FIELDS.items(), key=lambda item: item[1].place))


def _group(name: str) -> tuple[str, ...]:
    return tuple(key for key, field in FIELDS.items() if field.group == name)


#: Fields that show at once, and the others by their headings; the band stands next to the magnitude.
ASKED = ("star", *(name for name in _group("") if name != "star"))
ADVANCED = {
    name: _group(name)
    for name in ("Star", "Detection", "Flare's spectrum", "Measurement", "Detector", "Sky", "Unknown", "Change",
                 "Search", "Neighbours", "Pointing")
}  # fmt: skip
SOLVED = _group("Limit")  # fields of the card
#: Fields that apply only with the file of another field, below which they stand.
WITH_FILE = {"star": _group("Own spectrum"), "flare_file": _group("Own flare"), "change_file": _group("Added spectrum")}
#: Fields of forms of their own, which stand in the panels of the tabs that read them.
FORMS = {"campaign": _group("Campaign"), "frames": _group("Frames"), "standards": _group("Standards")}
#: Fields that apply only with one text of another field.
ASKED_UNDER = {
    "sky_brightness": ("sky", "brightness"),
    "target": ("sky", "target and time"),
    "time": ("sky", "target and time"),
    "amplitude_percent": ("as_observed", "no"),
}
#: Questions to begin with; the amplitudes of the first two are the paper's smallest, the others are examples (assumed).
PRESETS: dict[str, dict[str, str]] = {
    "Edge of detection": {"magnitude": "7.7"},
    "Paper: G2V, V = 7.4": {"magnitude": "7.4", "amplitude_percent": "0.76"},
    "Paper: K3V, V = 3.7": {"star": "K3V", "magnitude": "3.7", "amplitude_percent": "0.76"},
    "M dwarf": {"star": "GJ 581", "magnitude": "10.6", "amplitude_percent": "10"},
    "Active G star": {"star": "G8V", "magnitude": "6.5", "amplitude_percent": "0.5", "exposure_s": "100"},
}


@cache
def _fields() -> dict[str, str]:
    """Return the field of each key of the study, with and without its section, of each field's name and each flag."""
    names = {".".join(field.path): name for name, field in FIELDS.items() if field.path}
    flags = {flag: names[key] for key, _, option in keys_of() if key in names for flag in option.names}
    names |= {FIELDS[name].path[-1]: name for name in names.values()}
    return names | {name: name for name in FIELDS} | flags | {"tails": "realisations"}


def field_of(key: str | None) -> str | None:
    """Return the name of the field that sets a key of the study or stands for a flag, or None."""
    return _fields().get(key or "")


def sentence(error: InputError, keys: Mapping[str, str] = NO_KEYS) -> str:
    """Return the message of an error as the page shows it; `keys` maps other names of its keys to fields."""
    text = SUBJECT.sub(lambda m: f"{m['place'] or ''}{_label(m['key'], keys)} {m['verb']}", str(error))
    return note(re.sub(", not ''$", ", but is empty", text).removeprefix("page: "), keys)


def note(text: str, keys: Mapping[str, str] = NO_KEYS) -> str:
    """Return a message with the labels of fields in place of keys and flags."""

    def remedy(match: re.Match[str]) -> str:
        label = _label(match["key"], keys)
        if label == match["key"]:
            return label
        return f"{label} {match['value']}" if match["value"] else f"“{label}”"

    text = _FLAG.sub(lambda match: f"“{FIELDS[name].label}”" if (name := field_of(match[0])) else match[0], text)
    return _KEY.sub(lambda match: _label(match[0], keys), REMEDY.sub(remedy, text))


def remedies(error: InputError, keys: Mapping[str, str] = NO_KEYS) -> list[tuple[str, str]]:
    """Return the values that a message proposes for fields, as pairs of field and text."""
    matches = REMEDY.finditer(str(error))
    pairs = ((field_of(keys.get(match["key"], match["key"])), match["value"]) for match in matches)
    return [(name, value) for name, value in pairs if name is not None and value]


def _label(key: str, keys: Mapping[str, str]) -> str:
    name = field_of(keys.get(key, key))
    return key if name is None else FIELDS[name].label
