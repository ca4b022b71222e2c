"""Selection of one spectrum from the tables of a file.

The selection is of a table, of its columns, and of a row if cells contain whole spectra. Users select with
``FILE[word, ...]``: a table's label, a column's name or a row's identifier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.spectra.column_choice import Choice, as_typed, choose, listed, numbered, plain
from mauvecl.host.spectra.column_roles import Role
from mauvecl.host.spectra.spectrum_table import SpectrumTable
from mauvecl.host.tables.table import Values
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]

#: Values of at least this mark missing measurements (IRAF's INDEF is 1.6e38).
INDEFINITE = 1e38
#: Columns whose presence shows that rows are parts of one spectrum: detector segments and echelle orders.
SEGMENTS = ("segment", "sporder", "order", "stripe")
#: Names of columns that qualify arrays: their step, their length, and the validity of points.
STEPS = ("deltaw", "delta_w", "delta_wavelength", "step", "dlam", "dlambda")
LENGTHS = ("npoints", "n_points", "nelem", "npts")
#: Zero for invalid points (COS Data Handbook 5.1, section 2.4.3).
WEIGHTS = ("dq_wgt",)


@dataclass(frozen=True, eq=False)
class RawSpectrum:
    """Spectrum in the units of its file."""

    #: Wavelengths and fluxes of each segment, shape (n,) each.
    segments: list[tuple[Float, Float]]
    table: SpectrumTable
    wavelength_name: str
    flux_name: str
    wavelength_role: Role
    flux_role: Role
    messages: tuple[str, ...] = ()


def spectrum_in(tables: Sequence[SpectrumTable], asked: Sequence[str]) -> RawSpectrum:
    """Return the spectrum of a file, or the selected one of several."""
    if not tables:
        raise InputError("has no table", "one with a wavelength and a flux", key="table")
    labels = [table.label.strip().lower() for table in tables]
    words = {word.lower() for word in asked}
    named = [i for i, label in enumerate(labels) if label and label in words]
    by_number = {word: place for word in asked if (place := numbered("table", word)) is not None}
    if any(place >= len(tables) for place in by_number.values()):
        raise InputError.of("table", max(by_number.values()) + 1, f"1 to {len(tables)}")
    named += by_number.values()
    rest = [word for word in asked if word.lower() not in {labels[i] for i in named} and word not in by_number]
    found: list[RawSpectrum] = []
    errors: list[InputError] = []
    for table in [tables[i] for i in named] or tables:
        try:
            found.append(_spectrum_of(table, rest))
        except InputError as error:
            errors.append(error)
    if errors and any(one.table.group for one in found):
        # A missing part would go unnoticed.
        raise errors[0]
    if not found:
        # The message that offers a choice is the most helpful.
        raise next((error for error in errors if "FILE[" in str(error)), errors[0])
    if len(found) > 1 and not named:
        # SDSS: the sum of all exposures, next to each of them.
        found = [one for one in found if one.table.label.strip().lower() == "coadd"] or found
    if len(found) > 1 and found[0].table.group is not None and len({one.table.group for one in found}) == 1:
        parts = listed([one.table.label for one in found])
        segments = [segment for one in found for segment in one.segments]
        return replace(found[0], segments=segments, messages=(*found[0].messages, f"its parts {parts} are joined"))
    if len(found) > 1:
        held = [one.table.label for one in found]
        fault = f"{len(held)} tables hold a spectrum: {listed(held)}"
        first = as_typed(held[0], "table", labels.index(held[0].strip().lower()), labels)
        raise InputError(fault, f"one: name it as in {first}", key="table", value=held)
    return found[0]


def _spectrum_of(table: SpectrumTable, asked: Sequence[str]) -> RawSpectrum:
    names = [column.name for column in table.columns]
    roles = table.roles
    known = {plain(name) for name in names} | {plain(f"column {place + 1}") for place in range(len(names))}
    # Words that do not name a column may name a row.
    rest = [word for word in asked if plain(word) not in known]
    try:
        choice = choose(names, roles, [word for word in asked if plain(word) in known])
    except InputError as error:
        raise (_no_such(rest[0], names) if rest else error) from error
    messages = []
    if len(choice.wavelength) == 2:
        edges = " and ".join(names[i] for i in choice.wavelength)
        if len({roles[i].unit for i in choice.wavelength}) > 1:
            raise InputError.of("wavelength_unit", edges, "one unit")
        messages.append(f"its wavelengths are the middles of bins, from {edges}")
    chosen = [table.columns[i] for i in (*choice.wavelength, choice.flux)]
    cells = [column.cells for column in chosen]
    if _holds_arrays(cells[-1]):
        selected = _selected_rows(table, choice, cells, rest)
        rows = selected.arrays
        messages += selected.messages
        if table.row_title and selected.identifier:
            table = replace(table, name=table.row_title.format(selected.identifier[:30]))
    elif rest:
        raise _no_such(rest[0], names)
    else:
        rows = [cells]
    segments = []
    for row in rows:
        *axes, flux = (_numbers(cell, column.name.strip()) for cell, column in zip(row, chosen, strict=True))
        segments.append((sum(axes[1:], axes[0]) / len(axes), flux))
        for array, column in zip((axes[0], flux), (chosen[0], chosen[-1]), strict=True):
            if array.ndim != 1:
                fault = f"column {column.name.strip()} has the shape {array.shape}"
                raise InputError(fault, "one spectrum", key=column.name.strip(), value=array.shape)
        if axes[0].size != flux.size:
            raise InputError(
                f"{axes[0].size} wavelengths for {flux.size} fluxes", "as many", key="flux", value=flux.size
            )
    if sum(flux.size for _, flux in segments) < 2:
        raise InputError("has fewer than two points", "a spectrum", key="flux", value=flux.size)
    axis, flux_role = roles[choice.wavelength[0]], roles[choice.flux]
    return RawSpectrum(
        segments, table, chosen[0].name, chosen[-1].name, axis, flux_role, (*table.messages, *messages),
    )  # fmt: skip


def _numbers(cells: Any, name: str) -> Float:
    """Return cells as numbers; NaN for missing measurements."""
    if np.asanyarray(cells).dtype.kind == "b":
        raise InputError(f"{name} holds true and false", "real numbers", key=name, value="true and false")
    found = Values.of(name, cells, what="its table").numbers()
    found[~(np.abs(found) < INDEFINITE)] = np.nan
    return found


def _holds_arrays(cells: Any) -> bool:
    """Return whether each cell of a column contains an array."""
    return np.ndim(cells) > 1 or (np.asarray(cells).dtype == object and len(cells) > 0 and np.ndim(cells[0]) > 0)


def _no_such(word: str, names: Sequence[str]) -> InputError:
    """Return the error for a word that does not name anything in the file."""
    return InputError.of("columns", word, f"one of {listed(names)}")


@dataclass(frozen=True)
class _Rows:
    """Rows of one spectrum."""

    #: Arrays of wavelength, or of both edges, and of flux, per row.
    arrays: list[list[Any]]
    #: Name of the only row; empty for several.
    identifier: str = ""
    messages: tuple[str, ...] = ()


def _selected_rows(table: SpectrumTable, choice: Choice, cells: list[Any], asked: Sequence[str]) -> _Rows:
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
    return _Rows(found, identifier, messages)


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
            raise _no_such(word, names)
        fitting = [row for row in fitting if row in fits]
    if len(fitting) == 1:
        return fitting[0]
    labels = [identifiers[row][0] if identifiers[row] and identifiers[row][0] else f"row {row + 1}" for row in fitting]
    if len(set(labels)) < len(labels):
        labels = [f"row {row + 1}" for row in fitting]
    fault = f"{len(fitting)} spectra are in it, one in each row ({listed(labels)})"
    first = as_typed((labels or ["row 1"])[0], "row", (fitting or [0])[0], labels)
    raise InputError(fault, f"one: name it as in {first}", key="rows", value=labels)
