"""Metadata of fields, such as unit, range, flag and help text, numbers with units, and physical quantities.

Flags, the page and the reference are generated from metadata. Plain numbers are checked without NumPy, so that wrong
ones are reported immediately.

`Annotated[float, Unit("s"), Range(0, 60)]` means the same in a section of a study, which pydantic validates, and in the
signature of a validated function. A field of a section states everything about its key in one place, with `setting`:

    exposure_s: Exposure = setting(50.0, "Exposure time", flag="--exposure -t")
"""

from __future__ import annotations

import datetime
import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema


def is_quantity(value: Any) -> bool:
    """Return whether a value is an astropy Quantity or TimeDelta, or a column of a table that has a unit."""
    has_unit = getattr(value, "unit", None) is not None or (hasattr(value, "to") and hasattr(value, "jd1"))
    return has_unit and (hasattr(value, "to_value") or hasattr(value, "quantity"))


def without_mask(value: Any) -> Any:
    """Return an array whose masked values are undefined (NaN); NumPy would take what lies below the mask."""
    return value.astype(float).filled(math.nan) if hasattr(value, "filled") else value


def as_quantity(value: Any) -> Any:
    """Return durations and columns with a unit as a Quantity, masked values as NaN; return other values unchanged."""
    if not is_quantity(value):
        return value
    import astropy.units as u

    return u.Quantity(without_mask(value.to(u.s) if hasattr(value, "jd1") else value), subok=True)


def without_unit(value: Any, unit: str) -> Any:
    """Return a Quantity, or a column that has a unit, as plain numbers: a float, or an array of its shape.

    Raises ValueError if its unit has no equivalent in `unit`. Wavelengths may be frequencies or energies, and
    temperatures may be on any scale.
    """
    import astropy.units as u

    # Detector counts are called DN here and adu elsewhere.
    equivalencies: Any = [(u.adu, u.DN)]
    target = u.Unit(unit)
    if target.is_equivalent(u.nm):
        equivalencies = u.spectral()
    elif target.is_equivalent(u.K) or target == u.deg_C:
        equivalencies = u.temperature()
    try:
        converted = as_quantity(value).to_value(target, equivalencies)
    except u.UnitsError as error:
        raise ValueError(str(error)) from error
    return converted if getattr(converted, "ndim", 0) else float(converted)


#: A number that is followed by a unit, which cannot begin like an exponent.
_MEASURE = re.compile(
    r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)(?![eE][+-]?\d)\s*([^\W\d_].{0,30}|[%°/].{0,9})", re.DOTALL
)
#: Units as people type them, which astropy does not know or takes for another.
SPELLED = {
    "sec": "s", "hrs": "h", "C": "deg_C", "degC": "deg_C", "°C": "deg_C", "Rsun": "solRad", "Msun": "solMass",
    "per cent": "%", "kelvin": "K", "ly": "lyr", "light years": "lyr",
}  # fmt: skip


def with_unit(text: str, unit: str) -> float | None:
    """Read a number with its unit, such as "10 min" or "24%", and convert it; return None for any other text.

    Raises ValueError if the unit is unknown or has no equivalent in `unit`.
    """
    match = _MEASURE.fullmatch(text)
    if match is None:
        return None
    import astropy.units as u

    word = re.sub(r"^(?:/|per (?!cent))", "1 / ", match[2].strip())
    word = (SPELLED | {written: name for name, written in WRITTEN.items()}).get(word, word)
    # Astropy has no plurals.
    for spelling in (word, word[:-1])[: 2 if len(word) > 2 and word.endswith("s") else 1]:
        try:
            return float(without_unit(u.Quantity(float(match[1]), spelling), unit))
        except (TypeError, ValueError, ArithmeticError):
            continue
    raise ValueError(text)


def date_text(value: Any) -> Any:
    """Return dates of Python, NumPy and pandas, and single times of astropy, as text in UTC; others unchanged."""
    if isinstance(value, datetime.datetime) and value.tzinfo is not None:
        value = value.astimezone(datetime.UTC).replace(tzinfo=None)
    if isinstance(value, datetime.date):
        return value.isoformat()
    if getattr(value, "ndim", 0) or not is_date(value):
        return value
    return str(value.utc.isot if hasattr(value, "isot") else value)


def is_date(value: Any) -> bool:
    """Return whether a value holds times of astropy or dates of NumPy, one or many."""
    return hasattr(value, "isot") or getattr(getattr(value, "dtype", None), "kind", "") == "M"


def is_table(value: Any) -> bool:
    """Return whether a value is a table of astropy or a DataFrame."""
    # A row of a table has the columns of the table.
    return hasattr(value, "columns") and not is_row(value)


def is_row(value: Any) -> bool:
    """Return whether a value is a row of a table of astropy, which it names."""
    return hasattr(value, "columns") and hasattr(value, "table")


Metadata = TypeVar("Metadata")
Convert = Callable[[Any], Any]

#: Units as people write them, where they differ from astropy's notation.
WRITTEN = {
    "deg_C": "deg C",
    "mag / arcsec2": "mag/arcsec2",
    "solRad": "solar radii",
    "solMass": "solar masses",
    "1 / (cm2 s)": "cm^-2 s^-1",
    "1 / h": "per hour",
    "1 / d": "per day",
    "1 / K": "per kelvin",
    "DN / s": "DN/s",
    "nm / pix": "nm/pix",
    "uV / electron": "uV/electron",
}


def word_of(unit: str) -> str:
    """Return the words for a number in a unit in a message."""
    written = WRITTEN.get(unit, unit)
    return f"a number {written}" if written.startswith("per ") else f"a number in {written}" if unit else "a number"


def written_number(value: float) -> str:
    """Return a number for a message as people write and type it: 0.001, 200000, 1e-7, 1e6."""
    return str(value) if isinstance(value, int) else re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")


@dataclass(frozen=True)
class Unit:
    """Unit of a plain number or array, as astropy spells it; Quantities and text with a unit are converted to it."""

    name: str

    @property
    def written(self) -> str:
        """The unit as people write it."""
        return WRITTEN.get(self.name, self.name)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        inner = handler(source)
        # The range of a type such as `Positive`, to which an annotation adds the unit.
        inner_range: Range | None = (inner.get("metadata") or {}).get("range")
        words = word_of(self.name) if inner_range is None else inner_range.words(self.name)
        return or_error(inner, words, before=self.plain, unit=self.name)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return _or_text(handler(schema))

    def plain(self, value: Any) -> Any:
        """Convert Quantities and texts with a unit, also in a list, to plain numbers; return other values unchanged."""
        if type(value) in (float, int):
            return value
        # pydantic takes true and false for 1 and 0.
        if is_truth(value):
            raise ValueError(value)
        if isinstance(value, str):
            return value if (read := with_unit(value, self.name)) is None else read
        if isinstance(value, list | tuple):
            return [self.plain(item) for item in value]
        return without_unit(value, self.name) if is_quantity(value) else value


@dataclass(frozen=True)
class Range:
    """Closed range of a finite number; `open_low` and `open_high` exclude an end."""

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        inner = handler(source)
        unit = (inner.get("metadata") or {}).get("unit", "")
        words = self.words(unit, whole=int in (source, *get_args(source)))
        # A number without a unit may be written in per cent.
        before = None if unit else Unit("").plain
        return or_error(inner, words, before=before, after=self._check, unit=unit, range=self)

    def __contains__(self, value: Any) -> bool:
        if not math.isfinite(value) or not self.low <= value <= self.high:
            return False
        return not ((self.open_low and value == self.low) or (self.open_high and value == self.high))

    def _check(self, value: Any) -> Any:
        if value is not None and value not in self:
            raise ValueError(value)
        return value

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        ends = {
            "exclusiveMinimum" if self.open_low else "minimum": self.low,
            "exclusiveMaximum" if self.open_high else "maximum": self.high,
        }
        return _or_text(handler(schema)) | {name: end for name, end in ends.items() if math.isfinite(end)}

    def words(self, unit: str = "", *, whole: bool = False) -> str:
        """Describe the accepted values, for error messages."""
        noun = "a whole number" if whole else "a number"
        low, high = map(written_number, (self.low, self.high))
        has_low, has_high = math.isfinite(self.low), math.isfinite(self.high)
        after = f" {WRITTEN.get(unit, unit)}" if unit else ""
        if has_low and has_high and not (self.open_low or self.open_high):
            return f"{noun} from {low} to {high}" if whole else f"{noun} between {low} and {high}{after}"
        ends = [f"above {low}" if self.open_low else f"of at least {low}"] if has_low else []
        ends += [f"below {high}" if self.open_high else f"up to {high}"] if has_high else []
        if ends:
            return f"{noun} {' and '.join(ends)}{after}"
        return noun if whole else word_of(unit)


def is_truth(value: Any) -> bool:
    """Return whether a value is true or false; NumPy's own type counts too and need not be loaded."""
    return type(value).__name__ in ("bool", "bool_")


def whole_number(value: Any) -> int:
    """Return a whole number as an int, from a number such as 1e5 or a Quantity without unit, or raise ValueError."""
    if is_quantity(value):
        value = without_unit(value, "")
    if is_truth(value) or getattr(value, "ndim", False):
        raise ValueError(value)
    try:
        # Whole numbers beyond 2**53 are no floats.
        return operator.index(value)
    except TypeError:
        is_float = isinstance(value, float) or getattr(getattr(value, "dtype", None), "kind", "") == "f"
        if not (is_float and float(value).is_integer()):
            raise ValueError(value) from None
        return int(value)


class AnyUnit:
    """A number or an array that keeps its unit as a Quantity, since the function itself converts it."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        def keep(value: Any, validate: Any) -> Any:
            return as_quantity(value) if is_quantity(value) else validate(value)

        return core_schema.no_info_wrap_validator_function(keep, handler(source))


def OneOrMore(item: tuple[type, ...]) -> Any:  # noqa: N802
    """Return the metadata of a sequence that may be given as a single item, such as one name or one expectation."""
    from pydantic import BeforeValidator

    return BeforeValidator(lambda value: (value,) if isinstance(value, item) else value)


def says_none(value: Any) -> bool:
    """Return whether a value is the text ``none``."""
    return isinstance(value, str) and value.strip().lower() == "none"


class OptionalNumber:
    """Number that may be None, for which study files and flags write ``none``."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        inner = handler(source)
        expected = str(inner.get("custom_error_message", "")).removeprefix("Input should be ")
        words = f"{expected or 'a number'}, or none"
        return or_error(inner, words, before=lambda value: None if says_none(value) else value)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        inner = handler(schema)
        about = {"description": inner.pop("description")} if "description" in inner else {}
        return about | {"anyOf": [inner, {"const": "none"}]}


def _or_text(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON schema whose numbers, also in arrays and alternatives, may be text with a unit or in per cent."""
    if schema.get("type") == "number":
        return schema | {"type": ["number", "string"]}
    items = {"items": _or_text(schema["items"])} if isinstance(schema.get("items"), dict) else {}
    choices = {"anyOf": [_or_text(choice) for choice in schema["anyOf"]]} if "anyOf" in schema else {}
    return schema | items | choices


def or_error(
    schema: CoreSchema, words: str, *, before: Convert | None = None, after: Convert | None = None, **metadata: Any
) -> CoreSchema:
    """Replace every error of a schema, and of functions of the value before and after it, by the accepted values."""
    from pydantic_core import core_schema

    if after is not None:
        schema = core_schema.no_info_after_validator_function(after, schema)
    if before is not None:
        schema = core_schema.no_info_before_validator_function(before, schema)
    return core_schema.custom_error_schema(
        schema, "expected", custom_error_message=f"Input should be {words}", metadata=metadata
    )


@dataclass(frozen=True)
class Accepted:
    """Words for the accepted values of a field, in the messages of all of its errors."""

    words: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return or_error(handler(source), self.words)


class Date:
    """A time as text, ISO 8601 and UTC; dates of Python, NumPy and pandas, and times of astropy, are converted."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return or_error(handler(source), "a UTC time such as '2026-03-01T12:00:00'", before=date_text)


@dataclass(frozen=True)
class Help:
    """Description of a field, for ``--help``, tooltips of the page and the reference."""

    text: str  # noun phrase, without unit and default
    more: str = ""  # explanation, in lower case, which follows the unit
    default: str = ""  # words for the default, if the value does not tell
    choices: str = ""  # words for the accepted values, instead of the list of them

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        return handler(schema) | {"description": f"{self.text}; {self.more}" if self.more else self.text}


class Flag:
    """Flag of the command line that sets a field; the first of its names is its parameter.

    `kind` is the type of its value, by default that of the field; `read` converts the value to that of the field and
    also receives the flag's name, for messages. `help` describes the flag if it differs from the field.
    """

    def __init__(
        self, *names: str, kind: Any = None, read: Callable[[Any, str], Any] | None = None, help: Help | None = None
    ) -> None:
        self.names, self.kind, self.read, self.help = names, kind, read, help

    @property
    def parameter(self) -> str:
        """Name of the parameter that receives the flag's value."""
        return self.names[0].partition("/")[0].lstrip("-").replace("-", "_")

    @property
    def label(self) -> str:
        """Label of the page's field, as in "False alarms"."""
        return self.parameter.replace("_", " ").capitalize()


@dataclass(frozen=True)
class Quantity:
    """Quantity that sweeps, maps and limits can vary."""

    name: str
    description: str  # of a column of tables
    label: str  # of an axis, with the unit
    path: tuple[str, ...] = ()  # sections and key of the study
    unit: str = ""  # in astropy's notation; empty if dimensionless
    range: Range | None = None  # None for names instead of numbers

    @property
    def suffix(self) -> str:
        """Unit that follows a value in a title."""
        return f" {Unit(self.unit).written}" if self.unit else ""


@dataclass(frozen=True)
class Slider:
    """Range and step of a slider, additive or by factors."""

    low: float
    high: float
    step: float
    log: bool = False


@dataclass(frozen=True, kw_only=True)
class Widget:
    """Field of the page that sets a key."""

    label: str = ""  # words of the key's flag by default
    hint: str = ""  # explanation for visitors, in sentences
    place: int = 0  # order within the group; fields of the same place follow the order of the study
    name: str = ""  # name in links; by default that of the key, with its section before it if its flag has it there
    first: str | None = None  # text of a new page; the default of the key by default
    choices: tuple[str, ...] = ()  # accepted words; those of the key by default
    unit: str | None = None  # unit as the page shows it; that of the key by default
    most: float | None = None  # largest value that a server computes for a visitor; that of the key by default
    # "day" for a calendar, "library" for a name of the library, "table" for a text of several lines, "file" for a
    # spectrum, "upload" for a file as it is; by default a field of text, or a choice of words.
    kind: str = ""
    slider: Slider | None = None
    suggestions: tuple[str, ...] = ()  # texts that the page offers for a field of text
    placeholder: str = ""  # what an empty field stands for, or an example; a slider stands at the number it begins with

    @property
    def scale(self) -> float:
        """Factor from the value of the key to that of the page."""
        return 100.0 if self.unit == "%" else 1


def metadata_of(kind: Any, of: type[Metadata]) -> list[Metadata]:
    """Return all metadata of a class in an annotation or field, outermost first."""
    return [entry for entry in _metadata(kind) if isinstance(entry, of)]


def first(kind: Any, of: type[Metadata]) -> Metadata | None:
    """Return the outermost metadata of a class in an annotation or field, or None."""
    return next(iter(metadata_of(kind, of)), None)


def _metadata(kind: Any) -> Iterator[Any]:
    inner = get_args(kind)
    if hasattr(kind, "annotation") and hasattr(kind, "metadata"):
        # A pydantic field.
        yield from kind.metadata
        inner = (kind.annotation,)
    elif get_origin(kind) is Annotated:
        yield from inner[1:]
        inner = inner[:1]
    for annotation in inner:
        yield from _metadata(annotation)


def as_typed(value: Any, *, truth: tuple[str, str] = ("false", "true")) -> str:
    """Return a value as people type it, with commas in a tuple; empty for None and for tables."""
    if isinstance(value, tuple):
        return ",".join(as_typed(item, truth=truth) for item in value)
    if isinstance(value, bool):
        return truth[value]
    if not isinstance(value, str | int | float):
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


@cache
def range_of(kind: Any) -> Range:
    """Return the range of an annotation such as `Magnitude`."""
    return first(kind, Range) or Range()


#: Finite number, and finite whole number.
Number = Annotated[float, Range()]
WholeNumber = Annotated[int, Range()]

# Physical quantities, which study keys, flags, sweeps, page fields and Python arguments share.

#: Seconds in a day.
DAY_S = 86_400.0

#: From far brighter than the Sun (-26.76, Willmer 2018) to fainter than any detected star.
Magnitude = Annotated[float, Unit("mag"), Range(-30, 40)]
#: Relative rise in a band. The largest known flare, ASASSN-16ae, rose by 11 magnitudes: 2.5e4 (Schmidt et al. 2016).
Amplitude = Annotated[float, Range(0, 1e6)]
#: From cool starspots to the hottest white dwarfs; flares of 5000 to 50 000 K are published.
Temperature = Annotated[float, Unit("K"), Range(1_000, 200_000)]
#: One exposure lasts at most a day; longer ones are several that are added up.
Exposure = Annotated[float, Unit("s"), Range(0, DAY_S, open_low=True)]
#: Operating range in the datasheet of the detector, Hamamatsu S11639-01 (KMPD1163E, absolute maximum ratings).
DetectorTemperature = Annotated[float, Unit("deg_C"), Range(-40, 65)]
#: Surface brightness in V; any sky seen from orbit lies well within.
SkyBrightness = Annotated[float, Unit("mag / arcsec2"), Range(5, 35)]
#: Ratio of the flux just below the Balmer edge to that just above.
BalmerJump = Annotated[float, Range(1, 100)]
#: Ratio of two areas of a flare.
AreaRatio = Annotated[float, Range(0, 1e6)]
#: Flux of a line over that of the continuum in 200-700 nm.
LineFraction = Annotated[float, Range(0)]
#: Factor on the fluxes of lines.
LineScale = Annotated[float, Range(0, 1e6)]
#: Colour excess E(B-V).
Reddening = Annotated[float, Unit("mag"), Range(0, 10)]
#: Width of the bins of a spectrum.
BinWidth = Annotated[float, Unit("nm"), Range(0.01, 50)]
#: Probability that is neither 0 nor 1.
Probability = Annotated[float, Range(0, 1, open_low=True, open_high=True)]
#: From well within the Sun's distance (4.8e-6 pc) to nearby galaxies.
Distance = Annotated[float, Unit("pc"), Range(1e-7, 1e6)]
#: From far below white dwarfs (0.01) to above the largest supergiants (some 1500).
Radius = Annotated[float, Unit("solRad"), Range(1e-4, 1e4)]
#: Solid angle of a field of view.
SolidAngle = Annotated[float, Unit("arcsec2"), Range(1e-6, 1e12)]
#: Wavelength in vacuum; also a frequency or an energy of photons.
Wavelength = Annotated[float, Unit("nm"), Range(0, open_low=True)]
#: Date and time.
DateText = Annotated[str, Date()]
#: Moment, from the start of an observation, and length of time.
Moment = Annotated[float, Unit("s"), Range()]
Duration = Annotated[float, Unit("s"), Range(0, open_low=True)]
Days = Annotated[float, Unit("d"), Range(0, open_low=True)]
#: Energy of a flare.
Energy = Annotated[float, Unit("erg"), Range(0, open_low=True)]
#: Seed of a random generator with 64 bits.
Seed = Annotated[int, Range(0, 2**64 - 1)]
#: Seed where none is given.
DEFAULT_SEED = 1
#: Number of realisations, and that of the first of them.
Realisations = Annotated[int, Range(1, 2**63 - 1)]
FirstRealisation = Annotated[int, Range(0, 2**63 - 1)]
Positive = Annotated[float, Range(0, open_low=True)]
NotNegative = Annotated[float, Range(0)]
#: Share of a whole.
Share = Annotated[float, Range(0, 1)]
#: Exponent of a power law of flare energies, dN/dE ~ E^-alpha; the integral over large energies must be finite.
RateExponent = Annotated[float, Range(1, 10, open_low=True, open_high=True)]
#: Exponent with which half-widths of flares grow with energy; below 1, since amplitudes grow as well.
DurationExponent = Annotated[float, Range(0, 1, open_high=True)]
#: Standard deviation of the decadic logarithm of half-widths about that law.
DurationScatter = Annotated[float, Range(0, 2)]
