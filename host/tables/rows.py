"""Cells of small tables of users, with a row for each star or flare."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.tables.coordinates import angle, angle_unit, unit_in_name
from mauvecl.host.tables.missing import is_missing
from mauvecl.host.tables.names import divided_unit, first_of
from mauvecl.host.tables.times import time_unit
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import printable, shortened

if TYPE_CHECKING:
    from astropy.table import Table


class Rows:
    """Cells of a small table by the names of its columns, in any case.

    Parameters
    ----------
    table : Table
    named : str
        The table, for messages.
    key : str
        Key of errors; by default that of the column.
    """

    def __init__(self, table: Table, named: str, key: str | None = None) -> None:
        self.table, self.named, self.key, self.n = table, named, key, len(table)
        self._texts: dict[str, list[str]] = {}
        self._values: dict[str, list[float] | None] = {}
        self._units: dict[str, str] = {}
        self._factors: dict[tuple[str, str], float] = {}

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

    def texts(self, name: str) -> list[str]:
        """Return the texts of a column."""
        if name not in self._texts:
            values = np.ma.asarray(getattr(self.table[name], "value", self.table[name]))
            cells = [
                "" if cell is None or cell is np.ma.masked else
                (cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell)).strip()
                for cell in (values.tolist() if values.dtype.kind in "SUO" else values)
            ]  # fmt: skip
            self._texts[name] = ["" if is_missing(text) else text for text in cells]
        return self._texts[name]

    def _numbers(self, name: str) -> list[float] | None:
        """Return the numbers of a column as the table holds them, or None if it holds texts."""
        if name not in self._values:
            values = np.ma.asarray(getattr(self.table[name], "value", self.table[name]))
            numeric = values.dtype.kind in "iuf" and values.ndim == 1
            self._values[name] = np.ma.filled(values.astype(np.float64), np.nan).tolist() if numeric else None
        return self._values[name]

    def unit(self, name: str) -> str:
        """Return the unit of a column as the table states it, or in its name, as in ``distance (pc)``; or nothing."""
        stated = getattr(self.table[name], "unit", None)
        return divided_unit(name)[1] if stated is None else str(stated).strip()

    def number(self, name: str | None, row: int, unit: str = "", *, above: float = -np.inf) -> float | None:
        """Return the number of a cell in a unit, None for a missing one; raise InputError for anything else.

        Parameters
        ----------
        unit : str
            Unit of the result, which the column is in if it states none.
        above : float
            Exclusive lower bound.
        """
        text = self.text(name, row)
        if name is None or not text:
            return None
        numbers = self._numbers(name)
        try:
            # Numbers of single precision are those that the file holds, not their shortest text.
            value = (float(text) if numbers is None else numbers[row]) * self._factor(name, unit)
        except InputError:
            raise
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and above < value):
            expected = "a number" if np.isinf(above) else f"a number above {above:g}"
            raise self.error(f"row {row + 1} has {name} = {shortened(text)}", expected, name, text)
        return value

    def degrees(self, name: str, row: int, *, right_ascension: bool) -> float | None:
        """Return an angle in degrees, None for a missing one: numbers, or sexagesimal text."""
        text = self.text(name, row)
        if not text:
            return None
        unit = self._angles(name)
        try:
            return angle(text, unit, right_ascension=right_ascension)
        except ValueError as error:
            expected = getattr(error, "expected", None) or "degrees, or sexagesimal text such as 10h30m00s or 10:30:00"
            raise self.error(f"row {row + 1} has {name} = {shortened(text)}", expected, name, text) from error

    def _angles(self, name: str) -> str:
        """Return the unit of a column of angles; raise InputError for another, or for coordinates in FK4."""
        if name not in self._units:
            system = " ".join(str(self.table.meta.get(key, "")) for key in ("RADESYS", "RADECSYS", "EQUINOX", "COOSYS"))
            if re.search(r"FK4|1950", system):
                expected = "right ascension and declination in ICRS or FK5 of J2000"
                raise self.error(f"its coordinates are in {' '.join(system.split())}", expected, name, system)
            stated = getattr(self.table[name], "unit", None)
            unit = unit_in_name(name) if stated is None else angle_unit(str(stated))
            if unit is None:
                raise self.error(f"{name} has the unit {shortened(str(stated))}", "an angle", name, str(stated))
            self._units[name] = unit
        return self._units[name]

    def unused(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the remark on columns that are not used; none if there are none."""
        words = f"column of {self.named} is" if len(names) == 1 else f"columns of {self.named} are"
        return (f"{len(names)} {words} not used: {printable(', '.join(names), 200)}.",) if names else ()

    def error(self, fault: str, expected: str, name: str, value: Any = None) -> InputError:
        """Return the error of a column or cell."""
        return InputError(f"{self.named}: {fault}", expected, key=self.key or name, value=value)

    def _factor(self, name: str, unit: str) -> float:
        """Return the factor from the unit of a column to another."""
        if (name, unit) not in self._factors:
            self._factors[name, unit] = self._ratio(name, unit)
        return self._factors[name, unit]

    def _ratio(self, name: str, unit: str) -> float:
        import astropy.units as u

        stated = self.unit(name)
        if not stated or stated == unit or not unit:
            return 1.0
        try:
            days = time_unit(stated)
            return float(u.Unit(days.unit if days else _SPELT.get(stated.lower(), stated)).to(unit))
        except (ValueError, TypeError, u.UnitsError) as error:
            if getattr(self.table[name], "unit", None) is None:
                # Words in brackets that are no unit, as in ``mass (this work)``.
                return 1.0
            raise self.error(
                f"{name} has the unit {shortened(stated)}", f"a unit such as {unit}", name, stated
            ) from error


#: Units of stars as catalogues spell them.
_SPELT = {"msun": "solMass", "m_sun": "solMass", "solmass": "solMass", "rsun": "solRad", "k": "K", "years": "yr",
          "gyr": "Gyr", "myr": "Myr", "/d": "1/d", "1/day": "1/d", "d-1": "1/d", "per day": "1/d"}  # fmt: skip
