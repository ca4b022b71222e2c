"""Columns of tables, their views and JSON, notes on tables that are shown in part, and objects with pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from importlib import import_module
from itertools import islice
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pathlib import Path

    from astropy.table import QTable, Table


#: Heading of an interval, which stays next to the column before it.
INTERVAL = "95 % interval"


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str  # name in files and JSON; empty for a column that only people read
    # Attribute or key of a row that holds the value, or a function of the row; the column's name if empty. Arrays are
    # broadcast together, and each of their elements then has a row of the table. None is a missing value.
    get: str | Callable[[Any], Any] = ""
    unit: str = ""
    description: str = ""
    heading: str = ""  # heading for people; without one, only files and JSON have the column
    format: str | Callable[..., str] = ""  # format specification of a value, or a function that returns its text
    others: tuple[str, ...] = ()  # further columns whose values `format` takes after the column's own
    # Type of the values, where it does not follow from them: in a table without rows, or with missing values.
    kind: type | None = None
    detail: bool = False  # whether people see the column only on request where the table is too wide
    when: Callable[[Any], object] | None = None  # whether an answer has the column; without it, every answer does

    def value(self, row: object) -> Any:
        """Return the value or values of a row."""
        return self.get(row) if callable(self.get) else _part(row, self.get or self.name)

    def of_part(self, name: str) -> Column:
        """Return the column for rows whose part of a name, an attribute or a key, has the value."""
        return replace(self, get=lambda row: self.value(_part(row, name)))

    def text(self, record: Mapping[str, Any]) -> str:
        """Return a cell as people read it, from the values of its row by column."""
        values = [record[name] for name in (self.name, *self.others) if name]
        return self.format(*values) if callable(self.format) else formatted(values[0], self.format)


def _part(row: object, name: str) -> Any:
    """Return the value of a key of a row, or an attribute by its path."""
    return row[name] if isinstance(row, Mapping) else attrgetter(name)(row)


def interval_columns(
    name: str,
    get: str | Callable[[Any], Any] = "",
    unit: str = "",
    of: str = "its 95 % interval",
    heading: str = "",
    format: str | Callable[[Any, Any], str] = "",
    *,
    kind: type | None = None,
    detail: bool = False,
) -> tuple[Column, Column]:
    """Return the columns of the lower and the upper end of an interval, whose `format` takes both.

    In `name` and in the path `get`, {} stands for "low" and "high"; a function `get` returns both ends.
    """
    low, high = name.format("low"), name.format("high")

    def end(k: int) -> str | Callable[[Any], Any]:
        return get.format(("low", "high")[k]) if isinstance(get, str) else lambda row: get(row)[k]

    others = (high,) if heading else ()
    return (Column(low, end(0), unit, f"lower end of {of}", heading, format, others, kind, detail),
            Column(high, end(1), unit, f"upper end of {of}", kind=kind))  # fmt: skip


@dataclass(frozen=True)
class View:
    """Table as people read it, with a title and some of its columns, or a sentence alone."""

    title: str  # the sentence if there is no table
    columns: Sequence[Column] = ()
    table: Table | Sequence[Mapping[str, Any]] | None = None  # a table, or its rows: values by the columns' names

    def texts(self, hidden: Collection[str] = (), *, empty: bool = True) -> tuple[list[str], list[list[str]]]:
        """Return headings and cells, without `hidden` columns and, unless `empty`, those whose cells are all empty."""
        columns = [column for column in self.columns if column.heading and column.name not in hidden]
        table = [] if self.table is None else self.table
        rows = table if isinstance(table, Sequence) else records(table)
        cells = [[column.text(record) for column in columns] for record in rows]
        shown = [k for k in range(len(columns)) if empty or not cells or any(row[k] for row in cells)]
        return [columns[k].heading for k in shown], [[row[k] for k in shown] for row in cells]

    @property
    def details(self) -> set[str]:
        """Names of printed columns that narrow tables leave out."""
        return {column.name for column in self.columns if column.detail and column.heading}

    def _repr_html_(self) -> str:
        title = f"<p>{escape(self.title)}</p>"
        if self.table is None:
            return title
        headings, cells = self.texts(self.details, empty=False)
        rows = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in cells]
        head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
        return f"{title}<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"

    def __str__(self) -> str:
        if self.table is None:
            return self.title
        headings, cells = self.texts(self.details, empty=False)
        widths = [max(map(len, column)) for column in zip(headings, *cells, strict=True)]
        rows = [headings, ["-" * width for width in widths], *cells]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([self.title, *(f"  {line}" for line in lines)])


def table_of(columns: Iterable[Column], rows: Iterable[object], **meta: object) -> QTable:
    """Return the table of rows for files and JSON, with units, descriptions and `meta` as metadata.

    Values of None are missing: NaN in columns with a unit, and masked in others.
    """
    import astropy.units as u
    import numpy as np
    from astropy.table import QTable

    table, unit_of = QTable(), cache(u.Unit)
    named = [column for column in columns if column.name]
    blocks = [np.broadcast_arrays(*(np.atleast_1d(column.value(row)) for column in named)) for row in rows]
    for k, column in enumerate(named):
        values = np.concatenate([block[k].ravel() for block in blocks] or [np.array([], column.kind or float)])
        if values.dtype == object:
            missing = np.array([value is None for value in values])
            if column.unit:
                # A quantity has no mask.
                values = np.where(missing, np.nan, values).astype(float)
            else:
                values = np.ma.MaskedArray(np.where(missing, 0, values).astype(column.kind or float), missing)
        elif column.kind is not None:
            values = values.astype(column.kind)
        table[column.name] = values * unit_of(column.unit) if column.unit else values
        table[column.name].info.description = column.description or None
    table.meta |= meta
    return table


def stacked(first: Sequence[Column], parts: Iterable[tuple[object, Table]], **meta: object) -> QTable:
    """Return tables as one, each after the `first` columns of its row; keep metadata that all share, and add `meta`.

    A first column has one value for its table, or one for each of the table's rows. Columns that a table lacks are
    masked, or NaN if they have a unit.
    """
    import numpy as np

    rows, tables = zip(*parts, strict=True)
    shared = {k: v for k, v in tables[0].meta.items() if all(k in t.meta and t.meta[k] == v for t in tables)}
    # The row of a table is kept under the empty name, which no column of a table has.
    blocks: list[dict[str, Any]] = [{"": row} for row in rows]
    columns = [column.of_part("") for column in first]
    for name in dict.fromkeys(name for table in tables for name in table.colnames):
        present = [table[name] if name in table.colnames else None for table in tables]
        values = [column for column in present if column is not None]
        (unit,) = {str(column.unit or "") for column in values}
        kind = np.result_type(*(column.dtype for column in values)).type
        columns.append(Column(name, "", unit, values[0].info.description or "", kind=kind))
        for block, column in zip(blocks, present, strict=True):
            cells: Any = getattr(column, "value", column)
            block[name] = np.array(cells.tolist(), object) if np.any(getattr(cells, "mask", False)) else cells
    return table_of(columns, blocks, **shared | meta)


def records(table: Table) -> list[dict[str, Any]]:
    """Return the rows of a table as Python values by column, without units; None where a value is missing."""
    columns = [getattr(table[name], "value", table[name]).tolist() for name in table.colnames]
    return [dict(zip(table.colnames, values, strict=True)) for values in zip(*columns, strict=True)]


def formatted(value: Any, spec: str) -> str:
    """Format a value; numbers below a million that `spec` writes with a power of ten, as 1e+04, are written out."""
    text = format(value, spec)
    return f"{float(text):.0f}" if spec.endswith("g") and re.search(r"e\+0[0-5]$", text) else text


def number(spec: str, undefined: str = "") -> Callable[[float], str]:
    """Return a function that formats a number, and returns `undefined` for NaN."""
    return lambda value: formatted(value, spec) if value == value else undefined


def percent(spec: str) -> Callable[[float], str]:
    """Return a function that formats a fraction as a percentage; empty for NaN."""
    return lambda value: f"{100 * value:{spec}} %" if value == value else ""


def interval(spec: str, factor: float = 1.0) -> Callable[[float, float], str]:
    """Return a function that formats the ends of an interval, times a factor; empty for NaN."""
    return lambda low, high: (
        f"[{formatted(factor * low, spec)}, {formatted(factor * high, spec)}]" if low == low else ""
    )


def chance_text(value: float) -> str:
    """Format a probability, with bounds instead of 0 and 100 %."""
    if value != value:
        return "no number"
    if value > 0.9999:
        return "> 99.99 %"
    if value < 0.0001:
        return "< 0.01 %"
    shown = 100 * value
    return f"{shown:.2f} %" if shown < 1 or shown > 99 else f"{shown:.1f} %"


def chance_range(low: float, high: float) -> str:
    """Format an interval of probabilities."""
    return " to ".join(dict.fromkeys([chance_text(low), chance_text(high)]))


def with_error(value: float, error: float) -> str:
    """Format a value to its error's two leading digits: 9979 ± 120, not 1e+02."""
    if value != value:
        return ""
    if not (math.isfinite(error) and error > 0):
        return f"{value:.3g}"
    digits = max(1 - math.floor(math.log10(error)), 0)
    # The sum makes -0 a 0.
    return f"{round(value, digits) + 0.0:.{digits}f} ± {error:.{digits}f}"


T = TypeVar("T")


def first_items(items: Collection[T], most: int, name: str) -> tuple[list[T], str]:
    """Return the first items of a collection, with a note such as "6 of 9 stars shown", empty if these are all."""
    first = list(islice(items, most))
    return first, part_note(len(first), len(items), name)


def part_note(shown: int, total: int, name: str) -> str:
    """Return the note on a part of a collection, as in "6 of 9 stars shown", or nothing for all of it."""
    return f"{shown} of {total} {name} shown" if shown < total else ""


class Drawable:
    """An object with pictures; neither matplotlib nor the functions that draw are imported before they are used."""

    @property
    def pictures(self) -> dict[str, Callable[..., Any]]:
        """Every picture by the name of its file; each is called with a `path`, with axes `ax`, or with neither."""
        pictures: dict[str, Callable[..., Any]] = import_module("mauvecl.charts.matplotlib").pictures_of(self)
        return pictures

    def plot(self, path: str | Path | None = None, *, ax: Any = None) -> Any:
        """Draw the first picture and return the figure, the path of the saved file, or `ax`; needs matplotlib."""
        return self._draw(path, ax)

    def _draw(self, path: str | Path | None, ax: Any, **options: Any) -> Any:
        return next(iter(self.pictures.values()))(path, ax=ax, **options)
