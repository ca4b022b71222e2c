"""Extraction of spectra from tables whose cells contain arrays, with a row per spectrum or per segment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mauvecl.schema.errors import InputError

from .column_choice import Choice, as_typed, listed, numbered, plain
from .spectrum_table import SpectrumTable

#: Columns whose presence shows that rows are parts of one spectrum: detector segments and echelle orders.
SEGMENTS = ("segment", "sporder", "order", "stripe")
#: Names of columns that qualify arrays: their step, their length, and the validity of points.
STEPS = ("deltaw", "delta_w", "delta_wavelength", "step", "dlam", "dlambda")
LENGTHS = ("npoints", "n_points", "nelem", "npts")
#: Zero for invalid points (COS Data Handbook 5.1, section 2.4.3).
WEIGHTS = ("dq_wgt",)


def holds_arrays(cells: Any) -> bool:
    """Return whether each cell of a column contains an array."""
    return np.ndim(cells) > 1 or (np.asarray(cells).dtype == object and len(cells) > 0 and np.ndim(cells[0]) > 0)


def no_such(word: str, names: Sequence[str]) -> InputError:
    """Return the error for a word that does not name anything in the file."""
    return InputError.of("columns", word, f"one of {listed(names)}")


@dataclass(frozen=True)
class Rows:
    """Rows of one spectrum."""

    #: Arrays of wavelength, or of both edges, and of flux, per row.
    arrays: list[list[Any]]
    #: Name of the only row; empty for several.
    identifier: str = ""
    messages: tuple[str, ...] = ()


def selected_rows(table: SpectrumTable, choice: Choice, cells: list[Any], asked: Sequence[str]) -> Rows:
    """Return the selected row, or all rows if they are segments of one spectrum.

    Parameters
    ----------
    choice : Choice
        Columns of wavelength and flux.
    cells : list
        Cells of these columns; wavelengths of shape (n,) apply to all rows of fluxes of shape (n_row, n).
    asked : sequence of str
        Words given by the user that may name a row.
    """
    n = len(cells[-1])
    if np.ndim(cells[-1]) == 2:
        shape = np.shape(cells[-1])
        cells = [np.broadcast_to(cell, shape) if np.shape(cell) == shape[1:] else cell for cell in cells]
    if len({len(cell) for cell in cells}) > 1:
        raise InputError(f"{len(cells[0])} rows of wavelengths for {n} of fluxes", "as many", key="flux", value=n)
    names = [plain(column.name) for column in table.columns]
    is_only = n == 1 and not asked and not table.row_title
    identifiers = [[""]] if is_only else _identifiers(table, {*choice.wavelength, choice.flux}, n)
    identifier = ""
    messages: tuple[str, ...] = ()
    if n > 1 and not asked and set(names) & set(SEGMENTS):
        rows = list(range(n))
        labels = [identifiers[row][0] if identifiers[row] else str(row + 1) for row in rows]
        messages = (f"its {n} segments ({listed(labels)}) are joined",)
    else:
        rows = [_row_asked(identifiers, asked, names)]
        identifier = (identifiers[rows[0]] or [""])[0]
    steps, lengths, weights = (_values_of(table, names, wanted) for wanted in (STEPS, LENGTHS, WEIGHTS))
    found = []
    for row in rows:
        arrays = _arrays([cell[row] for cell in cells], None if steps is None else steps[row])
        kept = np.ones(arrays[-1].size, bool)
        if lengths is not None and 1 < (count := int(np.ravel(lengths[row])[0])) < kept.size:
            kept[count:] = False
        if weights is not None and np.shape(weights[row]) == kept.shape:
            kept &= np.asarray(weights[row]) != 0
        if kept.any():
            found.append([array[kept] for array in arrays])
    if not found:
        raise InputError("its rows contain no valid point", "valid points", key="rows")
    return Rows(found, identifier, messages)


def _values_of(table: SpectrumTable, names: Sequence[str], wanted: Sequence[str]) -> Any:
    """Return the values of the column with one of several names, or None."""
    return next((c.cells for c, name in zip(table.columns, names, strict=True) if name in wanted), None)


def _arrays(cells: list[Any], step: Any) -> list[Any]:
    """Return a row's cells as arrays of equal length; a start and a step are expanded."""
    *axes, flux = (np.ma.asanyarray(cell).squeeze() for cell in cells)
    if flux.ndim != 1:
        raise InputError(f"its row: the flux has the shape {flux.shape}", "one spectrum", key="flux", value=flux.shape)
    if axes[0].size == 1 < flux.size:
        if step is None:
            raise InputError(
                f"its row: one wavelength for {flux.size} fluxes", "as many, or a step", key="flux", value=flux.size
            )
        axes = [float(axes[0]) + float(np.ravel(step)[0]) * np.arange(flux.size)]
    if any(axis.shape != flux.shape for axis in axes):
        raise InputError(
            f"its row: {axes[0].size} wavelengths for {flux.size} fluxes", "as many", key="flux", value=flux.size
        )
    return [*axes, flux]


def _identifiers(table: SpectrumTable, without: set[int], n: int) -> list[list[str]]:
    """Return the possible names of each row: its short texts and integers, the most specific first."""
    columns = [list(table.row_names)] if len(table.row_names) == n else []
    for place, column in enumerate(table.columns):
        if place in without:
            continue
        values = column.cells
        if np.shape(values) == (n,) and np.asarray(values).dtype.kind in "SUiuO" and np.ndim(values[0]) == 0:
            texts = (one.decode(errors="replace") if isinstance(one, bytes) else str(one) for one in values)
            columns.append([text.strip() for text in texts])
    columns.sort(key=lambda texts: len(set(texts)) < n)
    return [[texts[row] for texts in columns] for row in range(n)]


def _row_asked(identifiers: Sequence[Sequence[str]], asked: Sequence[str], names: Sequence[str]) -> int:
    """Return the selected row: the only one, the one with the requested identifier, or ``row 3``."""
    fitting = list(range(len(identifiers)))
    for word in asked:
        if (place := numbered("row", word)) is not None:
            if place >= len(identifiers):
                raise InputError.of("row", place + 1, f"1 to {len(identifiers)}")
            fits = [place]
        else:
            fits = [row for row in fitting if word.strip() in identifiers[row]]
        if not fits:
            raise no_such(word, names)
        fitting = [row for row in fitting if row in fits]
    if len(fitting) == 1:
        return fitting[0]
    labels = [identifiers[row][0] if identifiers[row] and identifiers[row][0] else f"row {row + 1}" for row in fitting]
    if len(set(labels)) < len(labels):
        labels = [f"row {row + 1}" for row in fitting]
    raise InputError(
        f"{len(fitting)} spectra are in it, one in each row ({listed(labels)})",
        f"one: name it as in {as_typed((labels or ['row 1'])[0], 'row', (fitting or [0])[0], labels)}",
        key="rows",
        value=labels,
    )
