"""Names and units of columns in the header of a text file.

A header mixes prose with names. A line names columns if it has as many cells as the data have columns, and names a
wavelength and another known column; "vacuum wavelengths" over two columns is prose.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from mauvecl.schema.errors import InputError

from ..tables.units import is_stated
from .column_choice import AXES, listed
from .column_roles import divided, is_unit, role_of, words_of

#: Lines of a header, and whether each is a remark.
Header = list[tuple[str, bool]]
Split = Callable[[str], list[str]]

#: Words that occur in prose but not in names of columns.
_PROSE = re.compile(
    r"\b(?:and|at|is|are|the|for|with|vs|versus|from|by|on|was|were|this|that|has|have)\b", re.IGNORECASE
)
_NUMBERED = re.compile(r"(?:col(?:umn)?s?\.?\s*)?[(\[]?(\d{1,3})[)\]]?\s*[:=.)\-]?\s+(.+)", re.IGNORECASE)


def names_of(header: Header, n: int, split: Split) -> tuple[list[str], list[str]]:
    """Return the names of `n` columns and the units below them; empty if there are none."""
    if numbered := _numbered(header, n):
        return numbered, []
    rows = [(k, cells) for k, (line, _) in enumerate(header) if (cells := _cells(line, n, split))]
    scored = [(_recognised(cells), k, cells) for k, cells in rows]
    naming = [one for one in scored if one[0] > 0]
    if naming:
        most = max(score for score, _, _ in naming)
        _, k, cells = next(one for one in reversed(naming) if one[0] == most)
        return cells, _units(header, k, n, split)
    unmarked = [k for k, (line, is_remark) in enumerate(header) if not is_remark and line]
    if len(unmarked) == 1 and _may_name(header[unmarked[0]][0], cells := dict(rows).get(unmarked[0], [])):
        return cells, _units(header, unmarked[0], n, split)
    return _of_another_length(header, n), []


def _may_name(line: str, cells: Sequence[str]) -> bool:
    """Return whether the only line that is not a remark names columns, some of them unknown."""
    is_marked = bool(re.search(r"[,;|\t]", line.strip()))
    kinds = {role_of(cell).kind for cell in cells}
    if len(cells) == 2:
        return is_marked and bool(kinds & set(AXES))
    return is_marked or (kinds > {"unknown"} and all(re.match(r"[^\W\d]", cell) for cell in cells))


def _cells(line: str, n: int, split: Split) -> list[str]:
    """Divide a line of a header into `n` cells; return an empty list if it has another number."""
    if n < 2 or _PROSE.search(line):
        return []
    line = re.sub(r"^\s*(?:units?(?:\s*[:=]|\s)|(?:columns?|names?)\s*[:=])\s*", "", line, flags=re.IGNORECASE)
    divisions = [line.strip("|").split(mark) for mark in ",;|\t" if mark in line]
    divisions += [how(line) for how in (split, _bracketed, str.split, _wide)]
    for division in divisions:
        cells = [cell.strip().strip("\"'").strip() for cell in division]
        if len(cells) == n and any(cells):
            # The index of a data frame has no name.
            return [cell or str(k + 1) for k, cell in enumerate(cells)]
    return []


def _bracketed(line: str) -> list[str]:
    """Divide at blanks and commas, but keep a unit in brackets with the preceding name."""
    brackets = r"[\[(](?:[^\[\]()]|\([^()]*\))*[\])]"
    return re.findall(rf"[^\s\[(,]+(?:\s+in\s+[^\s,]+|(?:\s*{brackets})+[^\s,]*)?|{brackets}", line)


def _wide(line: str) -> list[str]:
    """Divide at two or more blanks."""
    return re.split(r"\s{2,}", line.strip())


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


def _units(header: Header, names_at: int, n: int, split: Split) -> list[str]:
    """Return the cells of the line of units below the names, if any; IPAC tables have types in between."""
    for k, (line, _) in enumerate(header[names_at + 1 : names_at + 3]):
        cells = _cells(line, n, split)
        is_all = any(is_unit(cell) for cell in cells) and all(is_unit(c) or not is_stated(c) for c in cells)
        # "A star" is not a unit, and "nm banana" contains an unknown unit.
        is_some = any(len(cell) > 1 and is_unit(cell) for cell in cells) and not any(c.endswith(":") for c in cells)
        if is_all or (k == 0 and is_some):
            return cells
    return []


def _numbered(header: Header, n: int) -> list[str]:
    """Return names from lines such as "column 2: flux"; columns without such a line are named by number."""
    found: dict[int, str] = {}
    for line, _ in header:
        if (match := _NUMBERED.fullmatch(line.strip())) and 1 <= int(match[1]) <= n:
            found.setdefault(int(match[1]), re.split(r"[,;:]|\s-\s", match[2])[0].strip()[:60])
    names = [found.get(k + 1, str(k + 1)) for k in range(n)]
    return names if len(found) > 1 and _recognised(names) else []


def _of_another_length(header: Header, n: int) -> list[str]:
    """Return the names of a line with fewer cells than the rows, for the columns from the left.

    Raises InputError if a line that is not a remark has another number of names than columns.
    """
    for line, is_remark in reversed(header):
        cells = [cell.strip("\"' ") for cell in re.split(r"[,;\t|]", line)]
        cells = cells if len(cells) > 1 else _bracketed(line)
        if not all(cells) or _PROSE.search(line) or not 1 < len(cells) <= n + 8:
            continue
        kinds = [role_of(cell).kind if words_of(divided(cell)[0]) else "unknown" for cell in cells]
        if "flux" not in kinds or not any(kind in AXES for kind in kinds):
            continue
        is_plain = set(kinds) <= {"wavelength", "flux", "unknown"} and not any(role_of(c).logarithm for c in cells)
        in_order = is_plain and kinds.index("flux") > kinds.index("wavelength")
        if is_remark and len(cells) < n:
            return [*cells, *(str(k + 1) for k in range(len(cells), n))]
        if not is_remark or not in_order:
            raise InputError(
                f"its line of names has {len(cells)} ({listed(cells)}) for {n} columns",
                "one for each",
                key="columns",
                value=cells,
            )
    return []
