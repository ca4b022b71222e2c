"""Tables of files, whole or in pieces, and their rows as quantities, positions and dates."""

from __future__ import annotations

import fnmatch
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.tables.names import ANGLES, angle, angle_unit, divided_unit, first_of, is_missing, key_of, match_name
from mauvecl.host.tables.units import time_unit, unit_of
from mauvecl.schema.errors import InputError, printable, shortened

if TYPE_CHECKING:
    from astropy.table import Table


#: Key of the statements on how a file is read, in the metadata of its table.
REMARKS = "mauvecl remarks"
#: Size of the pieces in which files are read, bytes of double precision.
PIECE_BYTES = 4 * 2**20


def unquoted(cell: str) -> str:
    """Return a cell without the quotes around it; a quote at its end alone is a unit, as in ``3.5'``."""
    for mark in ('"', "'", '"'):
        if len(cell := cell.strip()) > 1 and cell[0] == cell[-1] == mark:
            cell = cell[1:-1]
    return cell.strip()


def number_in(cell: str) -> float:
    """Return the number in a cell, NaN for words such as "null"; raise ValueError for anything else."""
    # Python takes 1_000 for a number.
    if "_" in cell:
        raise ValueError(cell)
    try:
        return float(cell)
    except ValueError:
        cell = unquoted(cell).replace("−", "-")
    if is_missing(cell):
        return float("nan")
    # Exponents of Fortran's double precision, and of three digits, which it writes without a letter.
    return float(re.sub(r"([\d.])[dD](?=[+-]?\d)|^([+-]?\d*\.\d*)(?=[+-]\d{3}$)", r"\1\2e", cell))


#: Values are missing if they are at least INDEFINITE, as IRAF's INDEF and NetCDF's 9.97e36, or equal to MISSING.
INDEFINITE, MISSING = 9e36, 1e30


def without_indefinite(values: Float) -> Float:
    """Replace infinite values, and those whose size marks missing ones, by NaN."""
    size = np.abs(values)
    bad = ~(size < INDEFINITE) | (size == MISSING)
    return np.where(bad, np.nan, values) if bad.any() else values


@dataclass(frozen=True, eq=False)
class Values:
    """Column or image of a file, which is read when it is used: a row for each frame, or a value for each pixel."""

    name: str
    shape: tuple[int, ...]
    read: Callable[[slice], Any]  # reads some rows, as the file has them
    unit: str = ""
    label: str = ""  # the file, for messages
    row_bytes: int = 0  # bytes that are read for a row, if more than those of its values
    ucd: str = ""  # unified content descriptor of the IVOA
    description: str = ""
    keywords: Mapping[str, Any] = field(default_factory=dict)  # on its times, which override those of the header

    @classmethod
    def of(
        cls, name: str, values: Any, unit: object = None, label: str = "", ucd: str = "", description: str = ""
    ) -> Values:
        """Return values that are in memory."""
        text = "" if unit is None else str(unit).strip()
        return cls(name, np.shape(values), lambda rows: values[rows], text, label, 0, ucd, description)

    @property
    def cells(self) -> Any:
        """All rows, as the file has them."""
        return self.read(slice(0, self.n_rows))

    @property
    def stated_unit(self) -> str:
        """Unit that the file states, or the known one in brackets at the end of the name; empty if there is none."""
        in_name = "" if self.unit else divided_unit(self.name)[1]
        return in_name if in_name and is_known(in_name) else self.unit

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.shape[0] if self.shape else 0

    @property
    def pieces(self) -> list[slice]:
        """Rows of each piece."""
        step = max(1, PIECE_BYTES // max(1, self.row_bytes, 8 * int(np.prod(self.shape[1:]))))
        return [slice(k, min(k + step, self.n_rows)) for k in range(0, self.n_rows, step)]

    def rows(self, piece: slice, expected: str = "a number") -> Float:
        """Return rows as numbers; NaN where they are missing. `expected` says what a cell may be, for messages."""
        values: Any = np.ma.asarray(self.read(piece))
        if values.dtype.kind == "O":
            # Arrays of variable length, or texts.
            try:
                values = np.ma.asarray(np.stack([np.asarray(row) for row in values]))
            except ValueError as error:
                fault = f"{self.label}: the rows of {self.name!r} must have the same length"
                raise InputError(fault, key=self.name) from error
        if values.dtype.kind in "US":
            return self._parsed(values, piece.start, expected)
        if values.dtype.kind not in "iufb":
            raise InputError(f"{self.label}: {self.name!r} must hold numbers", key=self.name)
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))

    def numbers(self, expected: str = "a number") -> Float:
        """Return all rows as numbers, read in pieces; see `rows`."""
        numbers = np.empty(self.shape)
        for piece in self.pieces:
            numbers[piece] = self.rows(piece, expected)
        return numbers

    def texts(self) -> list[str] | None:
        """Return the rows as texts, or None if they are numbers."""
        first: Any = np.ma.asarray(self.read(slice(0, 1)))
        if first.dtype.kind not in "OUS":
            return None if self.n_rows else []
        values: Any = np.ma.concatenate([*map(self.read, self.pieces)] or [first])  # type: ignore[no-untyped-call]
        if values.dtype.kind == "O" and all(isinstance(cell, str) for cell in values):
            values = values.astype(str)
        if values.dtype.kind not in "US":
            return None
        filled = np.ma.filled(values, b"" if values.dtype.kind == "S" else "")
        return [_plain(cell) for cell in filled.tolist()]

    def mapped(self, function: Callable[[Float], Float], unit: str) -> Values:
        """Return the values after a function, in a unit."""
        return replace(self, read=lambda piece: function(self.rows(piece)), unit=unit)

    def _parsed(self, values: Any, start: int, expected: str) -> Float:
        """Return texts as numbers; raise InputError that names the first text that is not a number."""
        texts = np.ma.filled(values, "").ravel().tolist()
        if values.dtype.kind == "S":
            texts = list(map(_plain, texts))
        parsed: list[float] = []
        try:
            parsed.extend(map(number_in, texts))
        except ValueError as error:
            # The texts before the first that is not a number are parsed.
            text = texts[len(parsed)]
            row = start + len(parsed) // max(1, int(np.prod(values.shape[1:]))) + 1
            fault = f"{self.label}: {self.name!r} in row {row} must be {expected}, not {shortened(text, 40)}"
            raise InputError(fault, key=self.name) from error
        return np.array(parsed, float).reshape(values.shape)


#: Keywords of the times of a column.
TIMES = ("JDREF", "TIMESYS", "TREFPOS")


def dates_in(scale: str) -> dict[str, Any]:
    """Return the keywords of modified Julian dates in a scale."""
    return {"MJDREFI": 0, "MJDREFF": 0.0, "TIMESYS": scale.upper()}


def as_one_array(cells: Any) -> Any:
    """Return arrays of variable length as one array if all have the same length; other cells are unchanged."""
    is_even = getattr(cells, "dtype", np.dtype(float)).kind == "O" and len({np.shape(cell) for cell in cells}) == 1
    return np.ma.stack(list(cells)) if is_even and np.ndim(cells[0]) else cells


def _plain(text: Any) -> str:
    """Return a text or bytes of UTF-8 without blanks at its ends."""
    return (text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)).strip()


def convert(values: Values, mapped_unit: str | None, unit: str, key: str) -> Values:
    """Return values in a unit; that of a mapping, under `key`, takes precedence over that of the file."""
    import astropy.units as u

    text = mapped_unit or values.stated_unit
    if not text:
        fault = f"{values.label}: the unit of {values.name!r} is not stated"
        raise InputError(f"{fault}; give a mapping with {key}, such as {unit}", key=key)
    equivalencies = {"nm": u.spectral(), "deg_C": u.temperature()}.get(unit, [])
    try:
        parsed = unit_in(text)
        parsed.to(u.Unit(unit), 1.0, equivalencies)
    except (ValueError, TypeError, u.UnitsError) as error:
        raise InputError.of(key, text, f"a unit such as {unit}", where=values.label) from error
    return values.mapped(lambda array: np.asarray((array * parsed).to_value(unit, equivalencies)), unit)


def unit_in(text: str) -> Any:
    """Return the unit in a text, as astropy and archives spell it."""
    import astropy.units as u

    time = time_unit(text)
    if time is not None and time.epoch_mjd is None:
        return u.Unit(time.unit)
    try:
        return u.Unit(_SPELT.get(text.strip().lower(), text))
    except ValueError:
        return unit_of(text)


def is_known(text: str) -> bool:
    """Return whether a text is a unit."""
    try:
        return unit_in(text) is not None
    except (ValueError, TypeError):
        return False


def ends_of(values: Float) -> tuple[float, float]:
    """Return the lowest and the highest of finite values and zero."""
    finite = np.isfinite(values)
    return float(np.min(values, initial=0.0, where=finite)), float(np.max(values, initial=0.0, where=finite))


def marks_in(light: Values, ends: tuple[float, float], singular: str, plural: str) -> tuple[list[float], list[str]]:
    """Return values that mark missing ones, such as -99 and 9999, and remarks that call the values by a noun.

    A mark consists of nines. Either it occurs once and is a thousand times larger than all other values, or it occurs
    more often and is three times larger, or three times as far below zero. Light, whose ends `ends_of` returns,
    is read only if one of these may be a mark.
    """
    marks: list[float] = []
    remarks: list[str] = []
    for mark in {*ends}:
        if not re.fullmatch(r"-?9{2,}(?:\.9+)?", f"{mark:.7g}"):
            continue
        n, n_unmarked, low, high = 0, 0, 0.0, 0.0
        for values in map(light.rows, light.pieces):
            unmarked = values[np.isfinite(values) & (np.abs(values) != abs(mark))]
            n, n_unmarked = n + int(np.count_nonzero(values == mark)), n_unmarked + unmarked.size
            low, high = float(unmarked.min(initial=low)), float(unmarked.max(initial=high))
        beyond = -low if mark < 0 and n > 1 else max(-low, high)
        if n_unmarked and abs(mark) > (3 if n > 1 else 1000) * beyond:
            marks += [mark, -mark]
            words = "marks a missing value and is" if n == 1 else "mark missing values and are"
            remarks.append(f"{n} {singular if n == 1 else plural} of {mark:.7g} {words} left undefined")
    return marks, remarks


class TableFile(ABC):
    """Open file: its columns and images by name, and the keywords of its header."""

    def __init__(
        self,
        label: str,
        header: dict[str, Any],
        names: list[str],
        remarks: tuple[str, ...] = (),
        columns: list[str] | None = None,
    ) -> None:
        self.label, self.header = label, header
        #: Names of everything that has values, and of the columns of its table.
        self.names = names
        self.columns = names if columns is None else columns
        #: Statements on how the file is read, for answers.
        self.remarks = remarks

    @abstractmethod
    def named(self, name: str) -> Values | None:
        """Return the values of a name, or None."""

    def check_choice(self) -> None:  # noqa: B027
        """Raise InputError if what is chosen of the file has no columns; files with a single table have no choice."""

    def find(self, name: str) -> Values:
        """Return the values of a name, or of the columns that a pattern such as ``flux_*`` fits, side by side."""
        values = self.named(name)
        values = self._side_by_side(name) if values is None and "*" in name else values
        if values is None:
            raise InputError.of("column", name, f"one of {shortened(', '.join(self.names), 300)}", where=self.label)
        return values

    def matching(self, pattern: str) -> list[str]:
        """Return the names that a pattern fits, in the order of the file."""
        return [name for name in self.names if fnmatch.fnmatch(name.lower(), pattern.lower())]

    def _side_by_side(self, pattern: str) -> Values | None:
        """Return the columns that a pattern fits as one image; None if it fits none."""
        columns = [self.find(name) for name in self.matching(pattern)]
        if not columns:
            return None
        units = {column.unit for column in columns}
        if len(units) > 1 or len({column.shape for column in columns}) > 1 or len(columns[0].shape) != 1:
            fault = f"{self.label}: the columns {pattern!r} must hold numbers in one unit, but differ in unit or shape"
            raise InputError(fault, key=pattern)
        return Values(pattern, (columns[0].n_rows, len(columns)),
                      lambda piece: np.column_stack([column.rows(piece) for column in columns]),
                      columns[0].unit, self.label)  # fmt: skip

    def wavelengths_in_names(self, pattern: str) -> Values:
        """Return the numbers in the names of the columns that a pattern fits."""
        names = self.matching(pattern)
        numbers_in_names = [re.findall(r"\d+(?:\.\d+)?", name) for name in names]
        odd = next((name for name, numbers in zip(names, numbers_in_names, strict=True) if len(numbers) != 1), None)
        if odd is not None or not names:
            fault = f"{self.label}: the column {odd or pattern!r} has no single number in its name"
            raise InputError(f"{fault}; use names such as flux_350.5", key="wavelength")
        return Values.of("the names of columns", np.array(numbers_in_names, float).ravel(), "", self.label)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the coordinates of an image along an axis, by the keywords of its header (FITS WCS)."""
        raise InputError(f"{self.label} has no coordinates of images; use a FITS image", key="wavelength")


class MemoryTable(TableFile):
    """A table in memory: CSV, ECSV, VOTable, text."""

    def __init__(self, table: Any, label: str) -> None:
        meta = table.meta if isinstance(table.meta, dict) else {}
        header = {str(key): value for key, value in meta.items() if key != REMARKS}
        super().__init__(label, header, list(map(str, table.colnames)), meta.get(REMARKS, ()))
        self.table = table

    def named(self, name: str) -> Values | None:
        """Return a column."""
        from astropy.time import Time, TimeDelta

        title = match_name(name, self.names, self.label)
        if title is None:
            return None
        column = self.table[title]
        if isinstance(column, Time | TimeDelta):
            days = column.mjd if isinstance(column, Time) else column.to_value("d")
            values = Values.of(name, np.asarray(np.ma.filled(days, np.nan)), "d", self.label)
            return values if isinstance(column, TimeDelta) else replace(values, keywords=dates_in(column.scale))
        meta, cells = column.info.meta or {}, as_one_array(getattr(column, "value", column))
        values = Values.of(name, cells, getattr(column, "unit", None), self.label, str(meta.get("ucd", "")),
                           column.info.description or "")  # fmt: skip
        return replace(values, keywords={key: meta[key] for key in TIMES if key in meta})


class Rows:
    """Cells of a small table; messages name it by its label, and errors have a `key`, by default the column."""

    def __init__(self, table: Table, label: str, key: str | None = None) -> None:
        self.table, self.label, self.key, self.n = _with_coordinates(table), label, key, len(table)
        self._ignored: list[str] = []
        # Columns are read, and their units parsed, once.
        self.texts, self._angles, self._factor = cache(self._texts), cache(self._unit_of_angles), cache(self._ratio)

    @cached_property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [str(name) for name in self.table.colnames]

    def first(self, candidates: Sequence[str]) -> str | None:
        """Return the column that has the first of some names."""
        return first_of(candidates, self.names, self.label)

    def text(self, name: str | None, row: int) -> str:
        """Return the text of a cell; empty for a missing one."""
        return "" if name is None else self.texts(name)[row]

    def _texts(self, name: str) -> list[str]:
        """Return the texts of a column; numbers of single precision are those that the file holds, not the shortest."""
        cells = np.ma.asarray(getattr(self.table[name], "value", self.table[name])).tolist()
        texts = ["" if cell is None else _plain(cell) for cell in cells]
        return ["" if is_missing(text) else text for text in texts]

    def unit(self, name: str) -> str:
        """Return the unit of a column as the table states it, or in its name, as in ``distance (pc)``; or nothing."""
        unit = getattr(self.table[name], "unit", None)
        return divided_unit(name)[1] if unit is None else str(unit).strip()

    def number(self, name: str | None, row: int, unit: str = "", *, above: float = -np.inf) -> float | None:
        """Return the number of a cell in a unit, or None; raise InputError for text, and for numbers up to `above`."""
        text = self.text(name, row)
        if name is None or not text:
            return None
        factor = self._factor(name, unit)
        try:
            value = number_in(text) * factor
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and above < value):
            expected = "a number" if np.isinf(above) else f"a number above {above:g}"
            raise self.error(f"{name} in row {row + 1} must be {expected}, not {shortened(text)}", name)
        return value

    def degrees(self, name: str, row: int, *, right_ascension: bool) -> float | None:
        """Return an angle in degrees, None for a missing one: numbers, or sexagesimal text."""
        text = self.text(name, row)
        if not text:
            return None
        unit = self._angles(name)
        try:
            return angle(text, unit, right_ascension=right_ascension)
        except InputError as error:
            raise self.error(f"{name} in row {row + 1}: {error}", name) from error
        except ValueError as error:
            expected = "degrees, or sexagesimal text such as 10h30m00s or 10:30:00"
            raise self.error(f"{name} in row {row + 1} must be {expected}, not {shortened(text)}", name) from error

    def _unit_of_angles(self, name: str) -> str:
        """Return the unit of a column of angles; raise InputError for another, or for coordinates in FK4."""
        meta, (base, bracket) = self.table.meta, divided_unit(name)
        # Keywords, columns, comments or the name state the system.
        systems = [str(value) for key, value in meta.items() if key_of(str(key)) in SYSTEMS]
        systems += [text for column in self.names if key_of(column) in SYSTEMS for text in {*self.texts(column)}]
        systems.append(str((self.table[name].info.meta or {}).get("COOSYS", "")))
        comments = f"{meta.get('comments', '')} {meta.get('COMMENT', '')}"
        if not re.search(r"J2000|ICRS|FK5", f"{name} {comments}", re.IGNORECASE):
            systems += re.findall(r"FK4|B1950", comments, re.IGNORECASE)
        if old := next(filter(_OLD_SYSTEM.search, [*systems, bracket]), None):
            raise self.error(f"its coordinates are in {old}; use those in ICRS or FK5 of J2000", name)
        if (column_unit := getattr(self.table[name], "unit", None)) is None:
            # A name may end in a unit, as in ``ra_hours`` and ``dec [rad]``.
            words = [bracket, *re.split(r"[\s_.]+", base)[1:][-1:]]
            return next((unit_of_word for word in words if word and (unit_of_word := angle_unit(word))), "")
        if (unit := angle_unit(str(column_unit))) is None:
            raise self.error(f"the unit of {name} must be one of angles, not {shortened(str(column_unit))}", name)
        return unit

    def unused(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the remarks on how the table is read, and on columns that are not used."""
        remarks = (*(f"{self.label}: {text}" for text in self.table.meta.get(REMARKS, ())), *self._ignored)
        words = f"column of {self.label} is" if len(names) == 1 else f"columns of {self.label} are"
        return (*remarks, f"{len(names)} {words} not used: {printable(', '.join(names), 200)}.") if names else remarks

    def error(self, sentence: str, name: str) -> InputError:
        """Return the error of a column or of a cell in it."""
        return InputError(f"{self.label}: {sentence}", key=self.key or name)

    def _ratio(self, name: str, unit: str) -> float:
        """Return the factor from the unit of a column to another."""
        import astropy.units as u

        column_unit = self.unit(name)
        if not column_unit or column_unit == unit or not unit:
            return 1.0
        try:
            angle = unit in ANGLES.values() and angle_unit(column_unit)
            return float((u.Unit(angle) if angle else unit_in(column_unit)).to(unit))
        except (ValueError, TypeError, u.UnitsError) as error:
            like = re.search(r"\d|[/^%]|mag", column_unit, re.IGNORECASE) or is_known(column_unit)
            if getattr(self.table[name], "unit", None) is None and not like:
                # As in ``mass (this work)``.
                words = f"{column_unit!r} in the name of the column {name!r} of {self.label}"
                self._ignored.append(f"{words} is read as no unit.")
                return 1.0
            expected = f"a unit such as {'%' if unit == '1' else unit}"
            raise self.error(f"{name} must have {expected}, not {shortened(column_unit)}", name) from error


#: Keywords and columns of the system of coordinates, and words for those that are not right ascensions of J2000.
SYSTEMS = ("radesys", "radecsys", "equinox", "epoch", "coosys", "frame", "coord_system", "coordinate_system")
_OLD_SYSTEM = re.compile(r"FK4|(?<![\d.])B?1950(?:\.0*)?(?![\d.])|\bgal(?:actic)?\b|\becl(?:iptic)?\b", re.IGNORECASE)
#: Columns of sexagesimal coordinates in tables of CDS and of the journals: hours or degrees, minutes, seconds.
_PARTS = {"ra": ("RAh", "RAm", "RAs"), "dec": ("DEd", "DEm", "DEs")}


def _with_coordinates(table: Table) -> Table:
    """Return a table with ``ra`` and ``dec`` instead of columns of their parts, as in ``RAh`` and ``DE-``."""
    names = table.colnames
    # A column of astropy's coordinates has both; in FITS it is two, coord.ra and coord.dec.
    place = next((name for name in names if hasattr(table[name], "icrs")), None)
    pair = next(([name, dec] for name in names if name.endswith(".ra") and (dec := f"{name[:-2]}dec") in names), [])
    columns_of_parts = [name for titles in _PARTS.values() for name in titles]
    if {*_PARTS} & {*names} or not (place or pair or {*columns_of_parts} <= {*names}):
        return table
    table = table.copy()
    if pair:
        table.rename_columns(pair, [*_PARTS])
        return table
    if place:
        table["ra"], table["dec"] = table[place].icrs.ra.deg, table[place].icrs.dec.deg
        table.remove_column(place)
        return table
    for title, titles in _PARTS.items():
        rows = list(zip(*(table[name] for name in titles), strict=True))
        signs = map(str, table["DE-"]) if title == "dec" and "DE-" in names else [""] * len(rows)
        table[title] = ["" if np.ma.masked in row else ("-" if sign.strip() == "-" else "") + " ".join(map(str, row))
                        for sign, row in zip(signs, rows, strict=True)]  # fmt: skip
    table.remove_columns([name for name in (*columns_of_parts, "DE-") if name in names])
    return table


#: Units of stars, of flares and of temperatures as catalogues spell them.
_SPELT = {"degc": "deg_C", "c": "deg_C", "celsius": "deg_C", "deg c": "deg_C", "°c": "deg_C",
          "percent": "%", "ppt": "1e-3", "ppm": "1e-6", "ppb": "1e-9", "solar mass": "solMass", "solar": "solMass",
          "solar masses": "solMass", "msun": "solMass", "m_sun": "solMass", "solmass": "solMass",
          "rsun": "solRad", "k": "K", "years": "yr", "magnitude": "mag", "magnitudes": "mag", "mags": "mag",
          "magnitude[v]": "mag",
          "ly": "lyr", "lyr": "lyr", "lightyears": "lyr", "light-years": "lyr", "light years": "lyr", "kpc": "kpc",
          "gyr": "Gyr", "myr": "Myr", "/d": "1/d", "1/day": "1/d", "d-1": "1/d", "per day": "1/d"}  # fmt: skip
