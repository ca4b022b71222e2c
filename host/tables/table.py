"""Values of files with a row for each frame: numbers, texts and units, read whole or in pieces."""

from __future__ import annotations

import fnmatch
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.tables.names import divided_unit, matched
from mauvecl.host.tables.text_table import number_in
from mauvecl.host.tables.times import time_unit
from mauvecl.host.tables.units import unit_of
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]

#: Size of the pieces in which files are read, bytes of double precision.
PIECE_BYTES = 4 * 2**20


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
        unit = text_of_unit(unit)
        return cls(name, np.shape(values), lambda start, stop: values[start:stop], unit, what, 0, ucd, description)

    @property
    def cells(self) -> Any:
        """All rows, as the file has them."""
        return self.read(0, self.n_rows)

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.shape[0] if self.shape else 0

    @property
    def piece_rows(self) -> int:
        """Number of rows of a piece."""
        return max(1, PIECE_BYTES // max(1, self.row_bytes, 8 * int(np.prod(self.shape[1:]))))

    @property
    def pieces(self) -> list[slice]:
        """Rows of each piece."""
        step = self.piece_rows
        return [slice(k, min(k + step, self.n_rows)) for k in range(0, self.n_rows, step)]

    def rows(self, start: int, stop: int, expected: str = "a number") -> Float:
        """Return rows as numbers; NaN where they are missing. `expected` says what a cell may be, for messages."""
        values: Any = np.ma.asarray(self.read(start, stop))
        if values.dtype.kind == "O":
            values = self._stacked(values)
        if values.dtype.kind in "US":
            return self._parsed(values, start, expected)
        if values.dtype.kind not in "iufb":
            raise InputError(f"{self.what}: {self.name!r} holds no numbers", "numbers", key=self.name)
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))

    def numbers(self, expected: str = "a number") -> Float:
        """Return all rows as numbers, read in pieces; see `rows`."""
        found = np.empty(self.shape)
        for part in self.pieces:
            found[part] = self.rows(part.start, part.stop, expected)
        return found

    def texts(self) -> list[str] | None:
        """Return the rows as texts, or None if they are numbers."""
        if self.n_rows and np.ma.asarray(self.read(0, 1)).dtype.kind not in "OUS":
            return None
        if not self.n_rows:
            return []
        pieces = [np.ma.asarray(self.read(part.start, part.stop)) for part in self.pieces]
        values: Any = pieces[0] if len(pieces) == 1 else np.ma.concatenate(pieces)  # type: ignore[no-untyped-call]
        if values.dtype.kind == "O" and all(isinstance(one, str) for one in values):
            values = values.astype(str)
        if values.dtype.kind not in "US":
            return None
        filled = np.ma.filled(values, b"" if values.dtype.kind == "S" else "")
        return [_plain(one) for one in filled.tolist()]

    def mapped(self, function: Callable[[Float], Float], unit: str) -> Values:
        """Return the values after a function, in a unit."""
        return replace(self, read=lambda start, stop: function(self.rows(start, stop)), unit=unit)

    def _stacked(self, values: Any) -> Any:
        """Return arrays of variable length as rows, if all have the same length."""
        try:
            lengths = {np.shape(one) for one in values}
        except ValueError:
            lengths = set()
        if len(lengths) != 1:
            raise InputError(f"{self.what}: the rows of {self.name!r} differ in length", "one length", key=self.name)
        return np.ma.asarray(np.stack([np.asarray(one) for one in values]) if len(values) else values.astype(float))

    def _parsed(self, values: Any, start: int, expected: str) -> Float:
        """Return texts as numbers; raises InputError that names the first text that is not a number."""
        texts = [_plain(one) for one in np.ma.filled(values, "").ravel().tolist()]
        parsed = np.empty(len(texts))
        for place, text in enumerate(texts):
            try:
                parsed[place] = number_in(text)
            except ValueError as error:
                row = start + place // max(1, int(np.prod(values.shape[1:]))) + 1
                raise InputError(
                    f"{self.what}: {self.name!r} = {shortened(text, 40)} in row {row}", expected, key=self.name,
                    value=text
                ) from error  # fmt: skip
        return parsed.reshape(values.shape)


def _plain(text: Any) -> str:
    return (text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)).strip()


def text_of_unit(unit: object) -> str:
    """Return a unit as text; empty for none."""
    return "" if unit is None else str(unit).strip()


def converted(values: Values, given: str | None, unit: str, key: str) -> Values:
    """Return values in a unit.

    Parameters
    ----------
    given : str or None
        Unit in the mapping, which takes precedence over the file.
    unit : str
        Unit of the result.
    key : str
        Key of the mapping that states it.

    Raises InputError if neither file nor mapping states a unit, or for one of another kind.
    """
    import astropy.units as u

    stated = given or values.unit or unit_in_name(values.name)
    if not stated:
        expected = f"a mapping with {key}, such as {unit}"
        raise InputError(f"{values.what}: the unit of {values.name!r} is not stated", expected, key=key)
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
    spelt = {"degc": "deg_C", "c": "deg_C", "celsius": "deg_C", "deg c": "deg_C", "°c": "deg_C"}
    try:
        return u.Unit(spelt.get(text.strip().lower(), text))
    except ValueError:
        return unit_of(text)


def unit_in_name(name: str) -> str:
    """Return the unit in brackets at the end of a column's name; empty if there is none."""
    text = divided_unit(name)[1]
    try:
        return text if text and unit_in(text) is not None else ""
    except (ValueError, TypeError):
        return ""


class TableFile(ABC):
    """A file with frames: its named values, and the keywords of its header."""

    def __init__(self, what: str, header: dict[str, Any]) -> None:
        self.what, self.header = what, header

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """Names of everything that has values."""

    @property
    def columns(self) -> list[str]:
        """Names of the columns of its table."""
        return self.names

    def loaded(self) -> Any:
        """Return the columns as a table of astropy, masked where they are undefined."""
        from astropy.table import MaskedColumn, Table

        columns = []
        for name in self.columns:
            values = self.find(name)
            cells = np.ma.array(values.read(0, values.n_rows), copy=True)
            columns.append(MaskedColumn(cells, name, unit=values.unit or None))
        return Table(columns, meta=self.header)

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
            raise InputError(f"{self.what}: the columns {pattern!r} differ in unit or shape",
                             "columns of numbers in one unit", key=pattern)  # fmt: skip
        return Values(pattern, (parts[0].n_rows, len(parts)),
                      lambda start, stop: np.column_stack([part.rows(start, stop) for part in parts]),
                      parts[0].unit, self.what)  # fmt: skip

    def wavelengths_in_names(self, pattern: str) -> Values:
        """Return the numbers in the names of the columns that a pattern fits."""
        names = self.matching(pattern)
        found = [re.findall(r"\d+(?:\.\d+)?", name) for name in names]
        odd = next((name for name, numbers in zip(names, found, strict=True) if len(numbers) != 1), None)
        if odd is not None or not names:
            raise InputError(f"{self.what}: the column {odd or pattern!r} has no single number in its name",
                             "names such as flux_350.5", key="wavelength", value=odd)  # fmt: skip
        return Values.of("the names of columns", np.array([float(one[0]) for one in found]), "", self.what)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the coordinates of an image along an axis, by the keywords of its header (FITS WCS)."""
        raise InputError(f"{self.what} has no coordinates of images", "a FITS image", key="wavelength", value="wcs")


class MemoryTable(TableFile):
    """A table in memory: CSV, ECSV, VOTable, text."""

    def __init__(self, table: Any, what: str) -> None:
        from astropy.time import Time

        meta = table.meta if isinstance(table.meta, dict) else {}
        super().__init__(what, {str(key): value for key, value in meta.items()})
        self.table = table
        for name in table.colnames:
            if isinstance(table[name], Time):
                # A column of dates with their scale.
                self.header |= {"MJDREFI": 0, "MJDREFF": 0.0, "TIMESYS": table[name].scale.upper()}

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [str(name) for name in self.table.colnames]

    def named(self, name: str) -> Values | None:
        """Return a column."""
        from astropy.time import Time

        title = matched(name, self.names, self.what)
        if title is None:
            return None
        column = self.table[title]
        if isinstance(column, Time):
            return Values.of(name, np.asarray(np.ma.filled(column.mjd, np.nan)), "d", self.what)
        ucd, description = str((column.info.meta or {}).get("ucd", "")), column.info.description or ""
        unit = getattr(column, "unit", None)
        return Values.of(name, getattr(column, "value", column), unit, self.what, ucd, description)
