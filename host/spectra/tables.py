"""Spectra in tables that state their units: ECSV, VOTable, and what is common to them and FITS."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.bounded import shortened
from ..files.ecsv import parse_ecsv
from .columns import Columns, chosen, listed, numbers, plain, row_of, step_among
from .text import row_asked

#: Remarks of our own that a table may carry, and their length, at most.
MOST_NOTES, MOST_NOTE = 20, 400


def read_ecsv(text: str, name: str, origin: str, asked: Sequence[str]) -> Columns:
    """Two columns of an ECSV table; errors as `columns_of`, or if it is no such table."""
    table = parse_ecsv(text, "it")
    meta = table.meta if isinstance(table.meta, dict) else {}
    own = meta.get("name")
    told = meta.get("told")
    remarks = meta.get("comments")
    return columns_of(
        table.colnames,
        [table[one].unit for one in table.colnames],
        lambda i: table[table.colnames[i]].data,
        own.strip()[:80] if isinstance(own, str) and own.strip() else name,
        origin,
        asked,
        words="\n".join(_texts(remarks)),
        told=_texts(told),
    )


def _texts(given: Any) -> tuple[str, ...]:
    """Lines of a list of text; anything else is none."""
    if not isinstance(given, list):
        return ()
    return tuple(one for one in given[:MOST_NOTES] if isinstance(one, str) and len(one) <= MOST_NOTE)


def read_votable(content: bytes, name: str, origin: str, asked: Sequence[str]) -> Columns:
    """Two columns of a VOTable; errors as `columns_of`, or if it is no such table."""
    from astropy.io import votable

    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise InputError("defines entities, expected a VOTable without them")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tables = list(votable.parse(io.BytesIO(content), verify="ignore").iter_tables())
    except Exception as error:  # the parser raises many kinds
        raise InputError(f"cannot be read as a VOTable ({shortened(str(error))}), expected a whole one") from error
    return first_fitting(
        [
            (
                str(table.name or table.ID or i + 1),
                lambda rest, table=table: columns_of(
                    [field.name for field in table.fields],
                    [None if field.unit is None else field.unit.to_string() for field in table.fields],
                    lambda k: table.array[table.fields[k].ID],
                    name,
                    origin,
                    rest,
                    words="\n".join(f"{f.ucd or ''} {f.description or ''}" for f in table.fields)[:5000],
                ),
            )
            for i, table in enumerate(tables)
        ],
        asked,
    )


def first_fitting(tables: Sequence[tuple[str, Any]], asked: Sequence[str]) -> Columns:
    """The one of several tables that holds a spectrum; one may be asked for by its name.

    Raises
    ------
    InputError
        If none does, with the first one's reason, or several do.
    """
    labels = [label for label, _ in tables]
    named = [i for i, label in enumerate(labels) if label.strip().lower() in {one.lower() for one in asked}]
    rest = [one for one in asked if one.lower() not in {labels[i].strip().lower() for i in named}]
    fitting, errors = [], []
    for i, (label, read) in enumerate(tables):
        if named and i not in named:
            continue
        try:
            fitting.append((label, read(rest)))
        except InputError as error:
            errors.append(error)
    if len(fitting) > 1:
        raise InputError(
            f"{len(fitting)} tables hold a spectrum: {listed([label for label, _ in fitting])}, expected one: name it "
            f"as in FILE[{fitting[0][0].strip()}]"
        )
    if fitting:
        chosen_one: Columns = fitting[0][1]
        return chosen_one
    if errors:
        # Of several reasons the one that speaks of a choice helps most.
        raise next((error for error in errors if "FILE[" in str(error)), errors[0])
    raise InputError("has no table, expected one with a wavelength and a flux")


def columns_of(
    names: Sequence[str],
    units: Sequence[Any],
    values: Any,
    name: str,
    origin: str,
    asked: Sequence[str],
    *,
    usual: tuple[str, str] | None = None,
    words: str = "",
    notes: tuple[str, ...] = (),
    told: tuple[str, ...] = (),
    none: Any = None,
) -> Columns:
    """Two columns of a table, or of the arrays in one of its rows.

    Parameters
    ----------
    names, units : sequence
    values : callable
        A column's values by its place; no other column is touched.
    none : callable, optional
        The value by which a column marks what is missing, by its place.

    Raises
    ------
    InputError
        If there are no two such columns, or they hold no spectrum.
    """
    known = {plain(one) for one in names}
    # A word that is no column's may be a row's.
    rest = [one for one in asked if plain(one) not in known]
    try:
        wave, flux = chosen(names, [one for one in asked if one not in rest], units)
    except InputError as error:
        if not rest:
            raise
        raise InputError(f"no column is named {shortened(rest[0])}, expected one of {listed(names)}") from error
    cells = values(wave), values(flux)
    if _is_arrays(cells[1]):
        cells = _one_row(names, values, wave, flux, cells, rest)
    elif rest:
        raise InputError(f"no column is named {shortened(rest[0])}, expected one of {listed(names)}")
    missing = [None, None] if none is None else [none(wave), none(flux)]
    picked = [
        numbers(cell, names[place].strip(), gap) for cell, place, gap in zip(cells, (wave, flux), missing, strict=True)
    ]
    for array, place in zip(picked, (wave, flux), strict=True):
        if array.ndim != 1:
            raise InputError(f"column {names[place].strip()} has the shape {array.shape}, expected one spectrum")
    if picked[0].size != picked[1].size:
        raise InputError(f"{picked[0].size} wavelengths for {picked[1].size} fluxes, expected as many")
    return Columns(
        picked[0],
        picked[1],
        name,
        origin,
        units[wave],
        units[flux],
        usual,
        names[wave],
        names[flux],
        words,
        notes,
        told,
    )


def _is_arrays(cells: Any) -> bool:
    return np.ndim(cells) > 1 or (np.asarray(cells).dtype == object and len(cells) > 0 and np.ndim(cells[0]) > 0)


def _one_row(
    names: Sequence[str], values: Any, wave: int, flux: int, cells: tuple[Any, Any], asked: Sequence[str]
) -> tuple[Any, Any]:
    """The arrays in the one row that is meant."""
    if len({len(cell) for cell in cells}) > 1:
        raise InputError(f"{len(cells[0])} rows of wavelengths for {len(cells[1])} of fluxes, expected as many")
    row = 0
    if len(cells[1]) != 1 or asked:
        labels = []
        for i in range(len(names)):
            # What a row may be called by: its text and whole numbers.
            column = values(i) if i not in (wave, flux) else None
            if column is not None and np.ndim(column) == 1 and np.asarray(column).dtype.kind in "SUiuO":
                labels.append([c.decode(errors="replace") if isinstance(c, bytes) else str(c) for c in column])
        rows = [(*(label[k].strip() for label in labels if np.ndim(label[k]) == 0), k) for k in range(len(cells[1]))]
        kept, left = row_asked([r[:-1] for r in rows], asked)
        if left:
            raise InputError(f"no column or row named {shortened(left[0])}, expected one of {listed(names)}")
        row = next(k for k, r in enumerate(rows) if r[:-1] == kept[0])
    step = step_among(names)
    points = next(
        (i for i, one in enumerate(names) if re.fullmatch(r"n_?points|nelem|npts", one.strip().lower())), None
    )
    columns = row_of(cells[0][row], cells[1][row], None if step is None else values(step)[row], "its row")
    if points is not None and 1 < (count := int(np.ravel(values(points)[row])[0])) < columns[1].size:
        return columns[0][:count], columns[1][:count]
    return columns
