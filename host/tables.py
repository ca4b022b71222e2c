"""Tables whose columns carry units and descriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.table import QTable


def make_table(columns: Iterable[tuple[Any, ...]], **meta: object) -> QTable:
    """Make a table of columns given as (name, values), (name, values, description) or (..., description, unit)."""
    import astropy.units as u
    import numpy as np
    from astropy.table import QTable

    table, units = QTable(), cache(u.Unit)
    for name, values, *more in columns:
        text, unit = (*more, "", "")[:2]
        table[name] = np.asarray(values) * units(unit) if unit else values
        table[name].info.description = text or None
    table.meta |= meta
    return table


def set_descriptions(table: QTable, texts: Mapping[str, str]) -> QTable:
    """Set the descriptions of columns in place and return the table."""
    for name, text in texts.items():
        table[name].info.description = text
    return table


@dataclass(frozen=True)
class Column:
    """A column of a table, defined once for files, JSON and tables that people read.

    Attributes
    ----------
    name : str
        Name of the column in files and JSON.
    attribute : str
        Attribute of a row that holds the value; the column's name if empty.
    unit, description : str
    heading : str
        Heading of the column for people; without one, only files and JSON have the column.
    format : str or callable
        Format specification of a value, or a function that returns its text.
    """

    name: str
    attribute: str = ""
    unit: str = ""
    description: str = ""
    heading: str = ""
    format: str | Callable[[Any], str] = ""

    def value(self, row: object) -> Any:
        """Return the value of a row."""
        return getattr(row, self.attribute or self.name)

    def text(self, row: object) -> str:
        """Return the value of a row as people read it."""
        value = self.value(row)
        return self.format(value) if callable(self.format) else format(value, self.format)


def table_of(columns: Iterable[Column], rows: Sequence[object], **meta: object) -> QTable:
    """Return the table of rows for files and JSON, with units and descriptions."""
    return make_table(((c.name, [c.value(row) for row in rows], c.description, c.unit) for c in columns), **meta)


def texts_of(columns: Iterable[Column], rows: Sequence[object]) -> tuple[list[str], list[list[str]]]:
    """Return the headings and the cells of the table that people read."""
    read = [one for one in columns if one.heading]
    return [one.heading for one in read], [[one.text(row) for one in read] for row in rows]
