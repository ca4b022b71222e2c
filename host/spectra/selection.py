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

from mauvecl.schema.errors import InputError

from ..tables.table import Values
from .array_cells import holds_arrays, no_such, selected_rows
from .column_choice import as_typed, choose, listed, numbered, plain
from .column_roles import Role
from .spectrum_table import SpectrumTable

Float = NDArray[np.float64]

#: Values of at least this mark missing measurements (IRAF's INDEF is 1.6e38).
INDEFINITE = 1e38


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
        raise InputError(
            f"{len(held)} tables hold a spectrum: {listed(held)}",
            f"one: name it as in {as_typed(held[0], 'table', labels.index(held[0].strip().lower()), labels)}",
            key="table",
            value=held,
        )
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
        raise (no_such(rest[0], names) if rest else error) from error
    messages = []
    if len(choice.wavelength) == 2:
        edges = " and ".join(names[i] for i in choice.wavelength)
        if len({roles[i].unit for i in choice.wavelength}) > 1:
            raise InputError.of("wavelength_unit", edges, "one unit")
        messages.append(f"its wavelengths are the middles of bins, from {edges}")
    chosen = [table.columns[i] for i in (*choice.wavelength, choice.flux)]
    cells = [column.cells for column in chosen]
    if holds_arrays(cells[-1]):
        selected = selected_rows(table, choice, cells, rest)
        rows = selected.arrays
        messages += selected.messages
        if table.row_title and selected.identifier:
            table = replace(table, name=table.row_title.format(selected.identifier[:30]))
    elif rest:
        raise no_such(rest[0], names)
    else:
        rows = [cells]
    segments = []
    for row in rows:
        *axes, flux = (_numbers(cell, column.name.strip()) for cell, column in zip(row, chosen, strict=True))
        segments.append((sum(axes[1:], axes[0]) / len(axes), flux))
        for array, column in zip((axes[0], flux), (chosen[0], chosen[-1]), strict=True):
            if array.ndim != 1:
                raise InputError(
                    f"column {column.name.strip()} has the shape {array.shape}",
                    "one spectrum",
                    key=column.name.strip(),
                    value=array.shape,
                )
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
