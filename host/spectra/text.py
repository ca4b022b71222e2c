"""Reader of spectra in text: names and units of columns from a header that mixes them with prose.

A line names columns if it has as many cells as the data have columns, and names a wavelength and another known column;
"vacuum wavelengths" over two columns is prose.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mauvecl.host.spectra.column_choice import AXES, listed
from mauvecl.host.spectra.column_roles import Role, divided, is_unit, role_of, words_of
from mauvecl.host.spectra.header_units import stated_units
from mauvecl.host.spectra.spectrum_table import SpectrumTable
from mauvecl.host.tables.medium import medium_of
from mauvecl.host.tables.table import Values
from mauvecl.host.tables.text_lines import NumberLines
from mauvecl.host.tables.text_table import keywords_of
from mauvecl.host.tables.units import is_stated
from mauvecl.schema.errors import InputError

#: Units of a text file without stated units (the paper's rule).
IMPLIED_UNITS = ("nm", "erg / (s cm2 Angstrom)")
#: Gaia DR3's sampled mean spectra: 343 fluxes at 336 + 2 i nm (documentation of gaiadr3.xp_sampled_mean_spectrum).
GAIA_NM, GAIA_FLUX = 336.0 + 2.0 * np.arange(343), "W m-2 nm-1"

#: Words that occur in prose but not in names of columns.
_PROSE = re.compile(
    r"\b(?:and|at|is|are|the|for|with|vs|versus|from|by|on|was|were|this|that|has|have)\b", re.IGNORECASE
)
_NUMBERED = re.compile(r"(?:col(?:umn)?s?\.?\s*)?[(\[]?(\d{1,3})[)\]]?\s*[:=.)\-]?\s+(.+)", re.IGNORECASE)


def table_of_text(
    text: str, name: str, origin: str, asked: Sequence[str], wavelength: bool, flux: bool
) -> SpectrumTable:
    """Read the table of a text file.

    Parameters
    ----------
    asked : sequence of str
        Words given by the user; for columns without names, their numbers.
    wavelength, flux : bool
        Whether to search the header for the units of wavelength and flux.
    """
    lines = NumberLines(text, "wavelength and flux")
    names, units = _names(lines)
    if lines.holds_arrays:
        return _table_of_arrays(lines, names, units, name, origin)
    columns = [
        lines.column(k, names[k] if names else str(k + 1), units[k] if units else "")
        for k in range(lines.n if names else max(lines.n, 2))
    ]
    if names:
        roles = [role_of(one.name, one.unit) for one in columns]
    else:
        roles = _roles_by_number(lines.n, asked, lines.messages)
    roles = _with_units_of(lines.comments, roles, wavelength, flux, is_named=bool(names))
    keywords = keywords_of([f"# {line}" for line, _ in lines.header])
    return SpectrumTable(
        columns, name, origin, implied_units=IMPLIED_UNITS, remarks=lines.comments, messages=tuple(lines.messages),
        medium=partial(medium_of, keywords), known_roles=roles,
    )  # fmt: skip


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


def _table_of_arrays(
    lines: NumberLines, names: Sequence[str], units: Sequence[str], name: str, origin: str
) -> SpectrumTable:
    """Return a table whose cells contain arrays, with a spectrum per row, as in Gaia's files."""
    if not names:
        # Gaia's files have no column of wavelengths.
        names = next((cells for line, _ in lines.header if len(cells := line.split(",")) == lines.n), [])
    if not names:
        raise InputError(
            "contains arrays in its cells and no names of columns", "names in its first line", key="columns"
        )
    columns = [lines.column(k, names[k].strip(), units[k] if units else "") for k in range(lines.n)]
    known = {column.name.lower(): column for column in columns}
    if "source_id" not in known or "wavelength" in known or "flux" not in known:
        return SpectrumTable(columns, name, origin, implied_units=IMPLIED_UNITS, remarks=lines.comments)
    if np.shape(known["flux"].cells)[-1:] == GAIA_NM.shape:
        flux = replace(known["flux"], unit=GAIA_FLUX)
        columns = [known["source_id"], Values.of("wavelength", GAIA_NM, "nm"), flux]
    return SpectrumTable(
        columns, name, f"{origin}, Gaia DR3 sampled XP spectrum", row_title="Gaia DR3 {}",
        notes=("wavelengths 336 + 2 i nm, W m-2 nm-1: Gaia DR3's documentation",),
    )  # fmt: skip


def _names(lines: NumberLines) -> tuple[list[str], list[str]]:
    """Return the names of columns and the units below them; empty if there are none."""
    if numbered := _numbered(lines):
        return numbered, []
    rows = {k: cells for k, (line, _) in enumerate(lines.header) if (cells := _cells(line, lines))}
    # The last of the lines that name most columns.
    score, k = max(((_recognised(cells), k) for k, cells in rows.items()), default=(0, 0))
    if score > 0:
        return rows[k], _units(lines, k)
    unmarked = [k for k, (line, is_comment) in enumerate(lines.header) if not is_comment and line]
    if len(unmarked) == 1 and _may_name(lines.header[unmarked[0]][0], cells := rows.get(unmarked[0], [])):
        return cells, _units(lines, unmarked[0])
    return _of_another_length(lines), []


def _may_name(line: str, cells: Sequence[str]) -> bool:
    """Return whether the only line that is no comment names columns, some of them unknown."""
    is_marked = bool(re.search(r"[,;|\t]", line.strip()))
    kinds = {role_of(cell).kind for cell in cells}
    if len(cells) == 2:
        return is_marked and bool(kinds & set(AXES))
    return is_marked or (kinds > {"unknown"} and all(re.match(r"[^\W\d]", cell) for cell in cells))


def _cells(line: str, lines: NumberLines) -> list[str]:
    """Divide a line of a header into a cell for each column; return an empty list if it has another number."""
    if lines.n < 2 or _PROSE.search(line):
        return []
    line = re.sub(r"^\s*(?:units?(?:\s*[:=]|\s)|(?:columns?|names?)\s*[:=])\s*", "", line, flags=re.IGNORECASE)
    divisions = [line.strip("|").split(mark) for mark in ",;|\t" if mark in line]
    divisions += [lines.split(line), _bracketed(line), line.split(), re.split(r"\s{2,}", line.strip())]
    for division in divisions:
        cells = [cell.strip().strip("\"'").strip() for cell in division]
        if len(cells) == lines.n and any(cells):
            # The index of a data frame has no name.
            return [cell or str(k + 1) for k, cell in enumerate(cells)]
    return []


def _bracketed(line: str) -> list[str]:
    """Divide at blanks and commas, but keep a unit in brackets with the preceding name."""
    brackets = r"[\[(](?:[^\[\]()]|\([^()]*\))*[\])]"
    return re.findall(rf"[^\s\[(,]+(?:\s+in\s+[^\s,]+|(?:\s*{brackets})+[^\s,]*)?|{brackets}", line)


def _recognised(cells: Sequence[str]) -> int:
    """Count the cells that name a spectrum's columns; 0 without a wavelength and another column."""
    kinds = [role_of(cell).kind for cell in cells]
    is_named = any(kind in AXES and not is_unit(cell) for cell, kind in zip(cells, kinds, strict=True))
    # "resolution 5 nm" does not name columns; "nm error flux" does.
    others = {*kinds} - {*AXES, "unknown"} if is_named else {*kinds} & {"flux", "model", "magnitude", "counts"}
    if not others or not {*kinds} & {*AXES}:
        return 0
    # Names have precedence over the units below them.
    return sum(1 if is_unit(cell) else 2 for cell, kind in zip(cells, kinds, strict=True) if kind != "unknown")


def _units(lines: NumberLines, names_at: int) -> list[str]:
    """Return the cells of the line of units below the names, if any; IPAC tables have types in between."""
    for k, (line, _) in enumerate(lines.header[names_at + 1 : names_at + 3]):
        cells = _cells(line, lines)
        is_all = any(is_unit(cell) for cell in cells) and all(is_unit(c) or not is_stated(c) for c in cells)
        # "A star" is not a unit, and "nm banana" contains an unknown unit.
        is_some = any(len(cell) > 1 and is_unit(cell) for cell in cells) and not any(c.endswith(":") for c in cells)
        if is_all or (k == 0 and is_some):
            return cells
    return []


def _numbered(lines: NumberLines) -> list[str]:
    """Return names from lines such as "column 2: flux"; columns without such a line are named by number."""
    found: dict[int, str] = {}
    for line, _ in lines.header:
        if (match := _NUMBERED.fullmatch(line.strip())) and 1 <= int(match[1]) <= lines.n:
            found.setdefault(int(match[1]), re.split(r"[,;:]|\s-\s", match[2])[0].strip()[:60])
    names = [found.get(k + 1, str(k + 1)) for k in range(lines.n)]
    return names if len(found) > 1 and _recognised(names) else []


def _of_another_length(lines: NumberLines) -> list[str]:
    """Return the names of a line with fewer cells than the rows, for the columns from the left.

    Raises InputError if a line that is no comment has another number of names than columns.
    """
    for line, is_comment in reversed(lines.header):
        cells = [cell.strip("\"' ") for cell in re.split(r"[,;\t|]", line)]
        cells = cells if len(cells) > 1 else _bracketed(line)
        if not all(cells) or _PROSE.search(line) or not 1 < len(cells) <= lines.n + 8:
            continue
        kinds = [role_of(cell).kind if words_of(divided(cell)[0]) else "unknown" for cell in cells]
        if "flux" not in kinds or not any(kind in AXES for kind in kinds):
            continue
        is_plain = set(kinds) <= {"wavelength", "flux", "unknown"} and not any(role_of(c).logarithm for c in cells)
        in_order = is_plain and kinds.index("flux") > kinds.index("wavelength")
        if is_comment and len(cells) < lines.n:
            return [*cells, *(str(k + 1) for k in range(len(cells), lines.n))]
        if not is_comment or not in_order:
            fault = f"its line of names has {len(cells)} ({listed(cells)}) for {lines.n} columns"
            raise InputError(fault, "one for each", key="columns", value=cells)
    return []
