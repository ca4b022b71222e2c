"""Tables of files, whole or in pieces, and their rows as quantities, positions and dates."""

from __future__ import annotations

import fnmatch
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.tables.names import ANGLES, angle, angle_unit, divided_unit, first_of, is_missing, key_of, matched
from mauvecl.host.tables.units import time_unit, unit_of
from mauvecl.schema.errors import InputError, printable, shortened

if TYPE_CHECKING:
    from astropy.table import Table


#: Key of the statements on how a file is read, in the metadata of its table.
REMARKS = "mauvecl remarks"
#: Size of the pieces in which files are read, bytes of double precision.
PIECE_BYTES = 4 * 2**20


def unquoted(cell: str) -> str:
    """Return a cell without quotes around it, of two kinds at most; one at its end alone is a unit, as in ``3.5'``."""
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


#: Values of at least the first, or equal to the second, mark missing measurements: IRAF's INDEF, NetCDF's 9.97e36.
INDEFINITE, MISSING = 9e36, 1e30


def without_indefinite(values: Float) -> Float:
    """Return values of which infinite ones, and those that mark missing ones by their size, are NaN."""
    size = np.abs(values)
    bad = ~(size < INDEFINITE) | (size == MISSING)
    return np.where(bad, np.nan, values) if bad.any() else values


def marks_in(values: Float, noun: str) -> tuple[list[float], list[str]]:
    """Return values that mark missing ones, such as -99 and 9999, and remarks on them.

    A mark has the digit nine only. It occurs once and is a thousand times larger than all other values, or it occurs
    more often and is three times larger, or three times as far below zero.
    """
    marks: list[float] = []
    remarks: list[str] = []
    finite = np.isfinite(values)
    for mark in {float(end(values, initial=0.0, where=finite)) for end in (np.min, np.max)}:
        if not re.fullmatch(r"-?9{2,}(?:\.9+)?", f"{mark:.7g}"):
            continue
        others = values[finite & (np.abs(values) != abs(mark))]
        n = np.count_nonzero(values == mark)
        beyond = np.max(-others if mark < 0 and n > 1 else np.abs(others), initial=0.0)
        if others.size and abs(mark) > (3 if n > 1 else 1000) * beyond:
            marks += [mark, -mark]
            remarks.append(f"{n} {noun} of {mark:.7g} mark missing values and are left undefined")
    return marks, remarks


@dataclass(frozen=True, eq=False)
class Values:
    """Values with a row for each frame, or one for each pixel."""

    name: str
    shape: tuple[int, ...]
    read: Callable[[int, int], Any]  # rows `start` to `stop - 1`, as the file has them
    unit: str = ""
    what: str = ""  # the file, for messages
    row_bytes: int = 0  # bytes that are read for a row, if more than those of its values
    ucd: str = ""  # unified content descriptor of the IVOA
    description: str = ""

    @classmethod
    def of(
        cls, name: str, values: Any, unit: object = None, what: str = "", ucd: str = "", description: str = ""
    ) -> Values:
        """Return values that are in memory."""
        text = "" if unit is None else str(unit).strip()
        return cls(name, np.shape(values), lambda start, stop: values[start:stop], text, what, 0, ucd, description)

    @property
    def cells(self) -> Any:
        """All rows, as the file has them."""
        return self.read(0, self.n_rows)

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.shape[0] if self.shape else 0

    @property
    def pieces(self) -> list[slice]:
        """Rows of each piece."""
        step = max(1, PIECE_BYTES // max(1, self.row_bytes, 8 * int(np.prod(self.shape[1:]))))
        return [slice(k, min(k + step, self.n_rows)) for k in range(0, self.n_rows, step)]

    def rows(self, start: int, stop: int, expected: str = "a number") -> Float:
        """Return rows as numbers; NaN where they are missing. `expected` says what a cell may be, for messages."""
        values: Any = np.ma.asarray(self.read(start, stop))
        if values.dtype.kind == "O":
            # Arrays of variable length.
            try:
                values = np.ma.asarray(np.stack([np.asarray(one) for one in values]))
            except ValueError as error:
                fault = f"{self.what}: the rows of {self.name!r} must have the same length"
                raise InputError(fault, key=self.name) from error
        if values.dtype.kind in "US":
            return self._parsed(values, start, expected)
        if values.dtype.kind not in "iufb":
            raise InputError(f"{self.what}: {self.name!r} must hold numbers", key=self.name)
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))

    def numbers(self, expected: str = "a number") -> Float:
        """Return all rows as numbers, read in pieces; see `rows`."""
        found = np.empty(self.shape)
        for part in self.pieces:
            found[part] = self.rows(part.start, part.stop, expected)
        return found

    def texts(self) -> list[str] | None:
        """Return the rows as texts, or None if they are numbers."""
        first: Any = np.ma.asarray(self.read(0, 1))
        if first.dtype.kind not in "OUS":
            return None if self.n_rows else []
        pieces = [self.read(part.start, part.stop) for part in self.pieces] or [first]
        values: Any = np.ma.concatenate(pieces)  # type: ignore[no-untyped-call]
        if values.dtype.kind == "O" and all(isinstance(one, str) for one in values):
            values = values.astype(str)
        if values.dtype.kind not in "US":
            return None
        filled = np.ma.filled(values, b"" if values.dtype.kind == "S" else "")
        return [_plain(one) for one in filled.tolist()]

    def mapped(self, function: Callable[[Float], Float], unit: str) -> Values:
        """Return the values after a function, in a unit."""
        return replace(self, read=lambda start, stop: function(self.rows(start, stop)), unit=unit)

    def _parsed(self, values: Any, start: int, expected: str) -> Float:
        """Return texts as numbers; raises InputError that names the first text that is not a number."""
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
            fault = f"{self.what}: {self.name!r} in row {row} must be {expected}, not {shortened(text, 40)}"
            raise InputError(fault, key=self.name) from error
        return np.array(parsed, float).reshape(values.shape)


def _plain(text: Any) -> str:
    return (text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)).strip()


def converted(values: Values, given: str | None, unit: str, key: str) -> Values:
    """Return values in a unit; the one `given` by a mapping under `key` takes precedence over that of the file."""
    import astropy.units as u

    stated = given or values.unit or unit_in_name(values.name)
    if not stated:
        fault = f"{values.what}: the unit of {values.name!r} is not stated"
        raise InputError(f"{fault}; give a mapping with {key}, such as {unit}", key=key)
    equivalencies = {"nm": u.spectral(), "deg_C": u.temperature()}.get(unit, [])
    try:
        known = unit_in(stated)
        known.to(u.Unit(unit), 1.0, equivalencies)
    except (ValueError, TypeError, u.UnitsError) as error:
        raise InputError.of(key, stated, f"a unit such as {unit}", where=values.what) from error
    return values.mapped(lambda array: np.asarray((array * known).to_value(unit, equivalencies)), unit)


def unit_in(text: str) -> Any:
    """Return the unit in a text, as astropy and archives spell it."""
    import astropy.units as u

    said = time_unit(text)
    if said is not None and said.epoch_mjd is None:
        return u.Unit(said.unit)
    try:
        return u.Unit(_SPELT.get(text.strip().lower(), text))
    except ValueError:
        return unit_of(text)


def unit_in_name(name: str) -> str:
    """Return the unit in brackets at the end of a column's name; empty if there is none."""
    text = divided_unit(name)[1]
    return text if text and is_known(text) else ""


def is_known(text: str) -> bool:
    """Return whether a text is a unit."""
    try:
        return unit_in(text) is not None
    except (ValueError, TypeError):
        return False


class TableFile(ABC):
    """A file with frames: its named values, and the keywords of its header."""

    def __init__(
        self,
        what: str,
        header: dict[str, Any],
        names: list[str],
        remarks: tuple[str, ...] = (),
        columns: list[str] | None = None,
    ) -> None:
        self.what, self.header = what, header
        #: Names of everything that has values, and of the columns of its table.
        self.names = names
        self.columns = names if columns is None else columns
        #: Statements on how the file is read, for answers.
        self.remarks = remarks

    @abstractmethod
    def named(self, name: str) -> Values | None:
        """Return the values of a name, or None."""

    def find(self, name: str) -> Values:
        """Return the values of a name, or of the columns that a pattern such as ``flux_*`` fits, side by side."""
        found = self.named(name)
        if found is None and "*" in name:
            found = self._side_by_side(name)
        if found is None:
            raise InputError.of("column", name, f"one of {shortened(', '.join(self.names), 300)}", where=self.what)
        return found

    def matching(self, pattern: str) -> list[str]:
        """Return the names that a pattern fits, in the order of the file."""
        return [name for name in self.names if fnmatch.fnmatch(name.lower(), pattern.lower())]

    def _side_by_side(self, pattern: str) -> Values | None:
        parts = [self.find(name) for name in self.matching(pattern)]
        if not parts:
            return None
        units = {part.unit for part in parts}
        if len(units) > 1 or len({part.shape for part in parts}) > 1 or len(parts[0].shape) != 1:
            fault = f"{self.what}: the columns {pattern!r} must hold numbers in one unit, but differ in unit or shape"
            raise InputError(fault, key=pattern)
        return Values(pattern, (parts[0].n_rows, len(parts)),
                      lambda start, stop: np.column_stack([part.rows(start, stop) for part in parts]),
                      parts[0].unit, self.what)  # fmt: skip

    def wavelengths_in_names(self, pattern: str) -> Values:
        """Return the numbers in the names of the columns that a pattern fits."""
        names = self.matching(pattern)
        found = [re.findall(r"\d+(?:\.\d+)?", name) for name in names]
        odd = next((name for name, numbers in zip(names, found, strict=True) if len(numbers) != 1), None)
        if odd is not None or not names:
            fault = f"{self.what}: the column {odd or pattern!r} has no single number in its name"
            raise InputError(f"{fault}; use names such as flux_350.5", key="wavelength")
        return Values.of("the names of columns", np.array([float(one[0]) for one in found]), "", self.what)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the coordinates of an image along an axis, by the keywords of its header (FITS WCS)."""
        raise InputError(f"{self.what} has no coordinates of images; use a FITS image", key="wavelength")


class MemoryTable(TableFile):
    """A table in memory: CSV, ECSV, VOTable, text."""

    def __init__(self, table: Any, what: str) -> None:
        from astropy.time import Time

        meta = table.meta if isinstance(table.meta, dict) else {}
        header = {str(key): value for key, value in meta.items() if key != REMARKS}
        super().__init__(what, header, list(map(str, table.colnames)), meta.get(REMARKS, ()))
        self.table = table
        for name in table.colnames:
            if isinstance(table[name], Time):
                # A column of dates with their scale.
                self.header |= {"MJDREFI": 0, "MJDREFF": 0.0, "TIMESYS": table[name].scale.upper()}

    def named(self, name: str) -> Values | None:
        """Return a column."""
        from astropy.time import Time, TimeDelta

        title = matched(name, self.names, self.what)
        if title is None:
            return None
        column = self.table[title]
        if isinstance(column, Time | TimeDelta):
            days = column.mjd if isinstance(column, Time) else column.to_value("d")
            return Values.of(name, np.asarray(np.ma.filled(days, np.nan)), "d", self.what)
        ucd, description = str((column.info.meta or {}).get("ucd", "")), column.info.description or ""
        unit = getattr(column, "unit", None)
        return Values.of(name, getattr(column, "value", column), unit, self.what, ucd, description)


class Rows:
    """Cells of a small table; for messages, `named` is the table and `key` the key of errors, by default the column."""

    def __init__(self, table: Table, named: str, key: str | None = None) -> None:
        self.table, self.named, self.key, self.n = _with_coordinates(table), named, key, len(table)
        self._ignored: list[str] = []
        # Columns are read, and their units parsed, once.
        self.texts, self._angles, self._factor = cache(self._texts), cache(self._unit_of_angles), cache(self._ratio)

    @cached_property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [str(name) for name in self.table.colnames]

    def first(self, wanted: Sequence[str]) -> str | None:
        """Return the column that has the first of some names."""
        return first_of(wanted, self.names, self.named)

    def text(self, name: str | None, row: int) -> str:
        """Return the text of a cell; empty for a missing one."""
        return "" if name is None else self.texts(name)[row]

    def _texts(self, name: str) -> list[str]:
        """Return the texts of a column; numbers of single precision are those that the file holds, not the shortest."""
        cells = np.ma.asarray(getattr(self.table[name], "value", self.table[name])).tolist()
        texts = [
            (cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell)).strip()
            for cell in ("" if cell is None else cell for cell in cells)
        ]
        return ["" if is_missing(text) else text for text in texts]

    def unit(self, name: str) -> str:
        """Return the unit of a column as the table states it, or in its name, as in ``distance (pc)``; or nothing."""
        stated = getattr(self.table[name], "unit", None)
        return divided_unit(name)[1] if stated is None else str(stated).strip()

    def number(self, name: str | None, row: int, unit: str = "", *, above: float = -np.inf) -> float | None:
        """Return the number of a cell in a unit, None for a missing one; raise InputError for anything else.

        A column that states no unit is in this one. The number must lie above the exclusive lower bound `above`.
        """
        text = self.text(name, row)
        if name is None or not text:
            return None
        factor = self._factor(name, unit)
        try:
            value = number_in(text) * factor
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and above < value):
            wanted = "a number" if np.isinf(above) else f"a number above {above:g}"
            raise self.error(f"{name} in row {row + 1} must be {wanted}, not {shortened(text)}", name)
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
            wanted = "degrees, or sexagesimal text such as 10h30m00s or 10:30:00"
            raise self.error(f"{name} in row {row + 1} must be {wanted}, not {shortened(text)}", name) from error

    def _unit_of_angles(self, name: str) -> str:
        """Return the unit of a column of angles; raise InputError for another, or for coordinates in FK4."""
        meta, (base, bracket) = self.table.meta, divided_unit(name)
        # The system is stated by keywords, columns and comments, or in the name.
        told = [str(value) for key, value in meta.items() if key_of(str(key)) in SYSTEMS]
        told += [text for one in self.names if key_of(one) in SYSTEMS for text in {*self.texts(one)}]
        comments = f"{meta.get('comments', '')} {meta.get('COMMENT', '')}"
        if not re.search(r"J2000|ICRS|FK5", f"{name} {comments}", re.IGNORECASE):
            told += re.findall(r"FK4|B1950", comments, re.IGNORECASE)
        if old := next(filter(_OLD_SYSTEM.search, [*told, bracket]), None):
            raise self.error(f"its coordinates are in {old}; use those in ICRS or FK5 of J2000", name)
        if (stated := getattr(self.table[name], "unit", None)) is None:
            # A name may end in a unit, as in ``ra_hours`` and ``dec [rad]``.
            words = [bracket, *re.split(r"[\s_.]+", base)[1:][-1:]]
            return next((found for word in words if word and (found := angle_unit(word))), "")
        if (unit := angle_unit(str(stated))) is None:
            raise self.error(f"the unit of {name} must be one of angles, not {shortened(str(stated))}", name)
        return unit

    def unused(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the remarks on how the table is read, and on columns that are not used."""
        said = (*(f"{self.named}: {text}" for text in self.table.meta.get(REMARKS, ())), *self._ignored)
        words = f"column of {self.named} is" if len(names) == 1 else f"columns of {self.named} are"
        return (*said, f"{len(names)} {words} not used: {printable(', '.join(names), 200)}.") if names else said

    def error(self, sentence: str, name: str) -> InputError:
        """Return the error of a column or of a cell in it."""
        return InputError(f"{self.named}: {sentence}", key=self.key or name)

    def _ratio(self, name: str, unit: str) -> float:
        """Return the factor from the unit of a column to another."""
        import astropy.units as u

        stated = self.unit(name)
        if not stated or stated == unit or not unit:
            return 1.0
        try:
            angle = unit in ANGLES.values() and angle_unit(stated)
            return float((u.Unit(angle) if angle else unit_in(stated)).to(unit))
        except (ValueError, TypeError, u.UnitsError) as error:
            like = re.search(r"\d|[/^%]|mag", stated, re.IGNORECASE) or is_known(stated)
            if getattr(self.table[name], "unit", None) is None and not like:
                # As in ``mass (this work)``.
                self._ignored.append(
                    f"{stated!r} in the name of the column {name!r} of {self.named} is read as no unit."
                )
                return 1.0
            usual = "%" if unit == "1" else unit
            raise self.error(f"{name} must have a unit such as {usual}, not {shortened(stated)}", name) from error


#: Keywords and columns of the system of coordinates, and words for those that are not right ascensions of J2000.
SYSTEMS = ("radesys", "radecsys", "equinox", "epoch", "coosys", "frame", "coord_system", "coordinate_system")
_OLD_SYSTEM = re.compile(r"FK4|(?<![\d.])B?1950(?:\.0*)?(?![\d.])|\bgal(?:actic)?\b|\becl(?:iptic)?\b", re.IGNORECASE)
#: Columns of sexagesimal coordinates in tables of CDS and of the journals: hours or degrees, minutes, seconds.
_PARTS = {"ra": ("RAh", "RAm", "RAs"), "dec": ("DEd", "DEm", "DEs")}


def _with_coordinates(table: Table) -> Table:
    """Return a table with ``ra`` and ``dec`` instead of columns of their parts, as in ``RAh`` and ``DE-``.

    A column of astropy's coordinates is that of both; in FITS it is two, as in ``coord.ra`` and ``coord.dec``.
    """
    names = table.colnames
    place = next((one for one in names if hasattr(table[one], "icrs")), None)
    pair = next(([one, dec] for one in names if one.endswith(".ra") and (dec := f"{one[:-2]}dec") in names), [])
    parts = [name for titles in _PARTS.values() for name in titles]
    if {*_PARTS} & {*names} or not (place or pair or {*parts} <= {*names}):
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
    table.remove_columns([name for name in (*parts, "DE-") if name in names])
    return table


#: Units of stars, of flares and of temperatures as catalogues spell them.
_SPELT = {"degc": "deg_C", "c": "deg_C", "celsius": "deg_C", "deg c": "deg_C", "°c": "deg_C",
          "percent": "%", "ppt": "1e-3", "ppm": "1e-6", "ppb": "1e-9", "solar mass": "solMass", "solar": "solMass",
          "solar masses": "solMass", "msun": "solMass", "m_sun": "solMass", "solmass": "solMass",
          "rsun": "solRad", "k": "K", "years": "yr", "magnitude": "mag", "magnitudes": "mag", "mags": "mag",
          "magnitude[v]": "mag",
          "ly": "lyr", "lyr": "lyr", "lightyears": "lyr", "light-years": "lyr", "light years": "lyr", "kpc": "kpc",
          "gyr": "Gyr", "myr": "Myr", "/d": "1/d", "1/day": "1/d", "d-1": "1/d", "per day": "1/d"}  # fmt: skip
