"""Reader of text files: columns of numbers, with or without a header of names and units."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..tables.medium import medium_of
from ..tables.missing import is_missing
from ..tables.table import Values
from ..tables.text_table import keywords_of, number_in
from .column_choice import AXES
from .column_roles import Role, role_of
from .header_units import stated_units
from .spectrum_table import SpectrumTable
from .text_header import Header, Split, names_of

#: Units of a text file without stated units (the paper's rule).
IMPLIED_UNITS = ("nm", "erg / (s cm2 Angstrom)")
#: Gaia DR3's sampled mean spectra: 343 fluxes at 336 + 2 i nm (documentation of gaiadr3.xp_sampled_mean_spectrum).
GAIA_NM, GAIA_FLUX = 336.0 + 2.0 * np.arange(343), "W m-2 nm-1"
_REMARK = re.compile(r"^\s*(#|%|!|;|//|\\|\|)")
_NUMBER = re.compile(r"[+-]?(?:\d[\d_]*[.,]?\d*|[.,]\d+)(?:[eEdD][+-]?\d+)?(?![\w.])")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eEdD][+-]?\d+)?")
_NOT_FINITE = {"nan", "inf", "-inf"}


def text_tables(
    text: str, name: str, origin: str, asked: Sequence[str], wavelength: bool, flux: bool
) -> list[SpectrumTable]:
    """Read the table of a text file.

    Parameters
    ----------
    asked : sequence of str
        Words given by the user; for columns without names, their numbers.
    wavelength, flux : bool
        Whether to search the header for the units of wavelength and flux.
    """
    header, lines = _divided(text.splitlines())
    if not lines:
        raise InputError("does not contain numbers", "two columns: wavelength and flux", key="columns")
    split, messages = _splitter([line for _, line in lines])
    rows = [(number, line, split(line)) for number, line in lines]
    n = len(rows[0][2])
    names, units = names_of(header, n, split)
    remarks = "\n".join(line for line, _ in header)
    if any(cell.strip()[:1] in ("(", "[") for cell in rows[0][2]):
        return [_table_of_arrays(names, units, rows, name, origin, header)]
    if names:
        columns = [_column(rows, k, names[k], units[k] if units else "") for k in range(n)]
        roles = [role_of(one.name, one.unit) for one in columns]
    else:
        columns = [_column(rows, k, str(k + 1)) for k in range(max(n, 2))]
        roles = _roles_by_number(n, asked, messages)
    roles = _with_units_of(remarks, roles, wavelength, flux, is_named=bool(names))
    keywords = keywords_of([f"# {line}" for line, _ in header])
    return [
        SpectrumTable(columns, name, origin, implied_units=IMPLIED_UNITS, remarks=remarks, messages=tuple(messages),
                  medium=partial(medium_of, keywords), known_roles=roles)
    ]  # fmt: skip


Row = tuple[int, str, list[str]]


def _column(rows: Sequence[Row], place: int, name: str, unit: str = "") -> Values:
    """Return a column, whose numbers are parsed when they are read."""
    return Values(
        name, (len(rows),), lambda start, stop: np.array([_value(row, place) for row in rows[start:stop]]), unit
    )


def _roles_by_number(n: int, asked: Sequence[str], messages: list[str]) -> list[Role]:
    """Return the roles of columns without names: the first two are the spectrum, or those selected by the user."""
    indices = [int(one) - 1 for one in asked if one.isascii() and one.isdigit() and 1 <= int(one[:6]) <= n]
    if len(indices) != len(asked) or len(indices) > 2:
        raise InputError.of("columns", asked, f"their numbers, 1 to {n}")
    if not asked and n > 2:
        messages.append(f"the first two of its {n} columns are used, which have no names")
    wave, value = (0, 1) if not indices else (0, indices[0]) if len(indices) == 1 else (indices[0], indices[1])
    roles = {wave: Role("wavelength", 1), value: Role("flux", 1)}
    return [roles.get(k, Role("unknown")) for k in range(max(n, 2))]


def _with_units_of(remarks: str, roles: Sequence[Role], wavelength: bool, flux: bool, is_named: bool) -> list[Role]:
    """Return roles with units from remarks if the names and headers of columns state none."""
    # A column with an unknown name may be the flux if none is recognised.
    fluxes = ("flux", "model") if any(role.kind in ("flux", "model") for role in roles) else ("unknown",)
    has_axis = any(role.kind in AXES and role.unit for role in roles)
    has_flux = any(role.kind in fluxes and role.unit for role in roles)
    axis_unit, flux_unit = stated_units(
        remarks, wavelength=wavelength and not has_axis, flux=flux and not has_flux, is_named=is_named
    )
    units = [axis_unit if role.kind in AXES else flux_unit if role.kind in fluxes else None for role in roles]
    return [role if role.unit else replace(role, unit=unit) for role, unit in zip(roles, units, strict=True)]


def _divided(lines: Sequence[str]) -> tuple[Header, list[tuple[int, str]]]:
    """Divide a text into its header, including all remarks, and its numbered lines of data."""
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    remarks = {number for number, line in numbered if _REMARK.match(line)}
    start = _first_of_data([(number, line) for number, line in numbered if number not in remarks])
    header: Header = []
    data: list[tuple[int, str]] = []
    for number, line in numbered:
        if number in remarks and not (line.lstrip()[0] == "|" and data):
            header.append((line.strip().lstrip("#%!;/\\| "), True))
            continue
        kept = line.split("#", 1)[0].rstrip()
        if number < start:
            header.append((kept, False))
        else:
            data.append((number, kept.strip()))
    return header, data


def _first_of_data(lines: Sequence[tuple[int, str]]) -> float:
    """Return the number of the first line of data, which starts with two numbers or, if there is none, with one."""
    starting = [(number, line) for number, line in lines if _starts_with_number(line)]
    for number, line in starting:
        cells = re.split(r"[\s;|]+", line.strip())
        cells = line.split(",") if len(cells) == 1 else cells
        # A line of a preamble, such as "2 columns" or "912 s", has no second number.
        if sum(bool(_NUMBER.match(cell)) or is_missing(cell) or cell.lower() in _NOT_FINITE for cell in cells) > 1:
            return number
    return starting[0][0] if starting else float("inf")


def _starts_with_number(line: str) -> bool:
    cell = re.split(r"[\s;|]+|,\s|,(?=[^\d])", line.strip().strip("|").strip())[0].strip("\"'(")
    return bool(_NUMBER.match(cell)) or cell.lower() in _NOT_FINITE


def _splitter(lines: list[str]) -> tuple[Split, list[str]]:
    """Return a function that divides lines into cells, and messages; decimal commas become points."""
    sample = lines[:50] + lines[-5:]
    messages: list[str] = []
    commas = any("," in line for line in sample)
    points = any("." in line for line in sample)
    for mark in (";", "\t", "|"):
        if all(mark in line for line in sample):
            decimal = commas and not points
            if decimal:
                messages.append("its decimal commas are read as points")
            return partial(_cells, mark=mark, decimal=decimal), messages
    if any('"' in line for line in sample):
        return (lambda line: next(csv.reader([line], skipinitialspace=True))), messages
    if not commas:
        return str.split, messages
    blanks = [line.split() for line in sample]
    if all(len(cells) > 1 for cells in blanks) and not any(c.endswith(",") for cells in blanks for c in cells[:-1]):
        if points or not all(_DECIMAL_COMMA.fullmatch(c) or "," not in c for cells in blanks for c in cells):
            raise InputError(
                f"line {shortened(sample[0], 60)} mixes commas, points and blanks",
                "decimal points and one kind of mark between columns",
                key="columns",
                value=sample[0],
            )
        messages.append("its decimal commas are read as points")
        return partial(_cells, mark=None, decimal=True), messages
    cells = [line.split(",") for line in sample]
    if not points and all(len(row) > 1 and re.fullmatch(r"\s*\d+\s*", row[1]) for row in cells) and len(cells) > 1:
        raise InputError(
            f"line {shortened(sample[0], 60)} may hold decimal commas or columns",
            "decimal points",
            key="columns",
            value=sample[0],
        )
    return (
        lambda line: line.replace(",", " , ").split(" , ") if ",," in line else re.split(r"\s*,\s*|\s+", line)
    ), messages


def _cells(line: str, mark: str | None, decimal: bool) -> list[str]:
    cells = (line.strip("|") if mark == "|" else line).split(mark)
    return [cell.strip().replace(",", ".") if decimal else cell.strip() for cell in cells]


def _value(row: Row, place: int) -> float:
    number, line, cells = row
    if len(cells) <= place:
        what = "one column" if len(cells) == 1 else f"{len(cells)} columns"
        raise InputError(
            f"line {number}: {shortened(line, 60)} has {what}", "wavelength and flux", key="columns", value=line
        )
    try:
        return number_in(cells[place])
    except ValueError as error:
        raise InputError(
            f"line {number}: {shortened(line, 60)} is not numeric", "wavelength and flux", key="columns", value=line
        ) from error


def _table_of_arrays(
    names: Sequence[str], units: Sequence[str], rows: Sequence[Row], name: str, origin: str, header: Header
) -> SpectrumTable:
    """Return a table whose cells contain arrays, with a spectrum per row, as in Gaia's files."""
    n = len(rows[0][2])
    if not names:
        # Gaia's files have no column of wavelengths.
        names = next((cells for line, _ in header if len(cells := line.split(",")) == n), [])
    if not names:
        raise InputError(
            "contains arrays in its cells and no names of columns", "names in its first line", key="columns"
        )
    columns = [
        Values(names[k].strip(), (len(rows),), _array_reader(rows, k), units[k] if units else "") for k in range(n)
    ]
    known = {column.name.lower(): column for column in columns}
    if "source_id" in known and "wavelength" not in known and "flux" in known:
        if np.shape(known["flux"].cells)[-1:] == GAIA_NM.shape:
            columns = [
                known["source_id"],
                Values.of("wavelength", GAIA_NM, "nm"),
                replace(known["flux"], unit=GAIA_FLUX),
            ]
        return SpectrumTable(
            columns,
            name,
            f"{origin}, Gaia DR3 sampled XP spectrum",
            row_title="Gaia DR3 {}",
            notes=("wavelengths 336 + 2 i nm, W m-2 nm-1: Gaia DR3's documentation",),
        )
    return SpectrumTable(
        columns, name, origin, implied_units=IMPLIED_UNITS, remarks="\n".join(line for line, _ in header)
    )


def _array_reader(rows: Sequence[Row], place: int) -> Callable[[int, int], Any]:
    def read(start: int, stop: int) -> Any:
        cells = [cells[place].strip() if place < len(cells) else "" for _, _, cells in rows[start:stop]]
        if not any(cell[:1] in ("(", "[") for cell in cells):
            return np.array(cells)
        arrays = [_array(cell) for cell in cells]
        if len({array.size for array in arrays}) == 1:
            return np.array(arrays)
        values = np.empty(len(arrays), object)
        values[:] = arrays
        return values

    return read


def _array(cell: str) -> Any:
    try:
        return np.array([number_in(one) for one in cell.strip().strip("()[]").split(",")])
    except ValueError as error:
        raise InputError.of("cell", cell, "an array of numbers") from error
