"""Texts as headers and rows of cells, whatever divides these: CSV, tables with blanks, columns of numbers."""

from __future__ import annotations

import contextlib
import csv
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.tables.files import check_cells, parse_ecsv, parsing, read_text, reading
from mauvecl.host.tables.names import angle_unit, in_brackets, is_missing
from mauvecl.host.tables.table import REMARKS, Values, is_known, number_in, unit_in, unquoted
from mauvecl.host.tables.units import is_dated, is_stated, time_unit, unit_of
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    from astropy.table import Table

# IPAC's headings begin with |, as do rows of numbers in other tables; its keywords begin with a backslash.
_COMMENT = re.compile(r"\s*(#|%|!|;|//|\\|\|)")
_BARRED = re.compile(r"\s*\|\s*[-+]?\.?\d")
_NUMBER = re.compile(r"[+-]?(?:\d[\d_]*[.,]?\d*|[.,]\d+)(?:[eEdD][+-]?\d+)?(?![\w.])")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eEdD][+-]?\d+)?")
_DECIMAL_POINT = re.compile(r"[+-]?\d*\.\d+(?:[eEdD][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
#: A line without cells: a rule, as of reStructuredText, or Excel's statement of the mark between cells.
_RULE = re.compile(r"[\s,;|]*|\s*(?:={3,}(?:\s+|$))*|\s*(?=[-=:|]*\+)[-=+:|]+\s*|\"?sep=.\"?", re.IGNORECASE)
#: Dates and times of day in cells of their own.
_DAY, _CLOCK = re.compile(r"\d{4}-\d\d-\d\d"), re.compile(r"\d\d:\d\d(?::\d\d(?:\.\d*)?)?")
#: Comments that say that times are those of the start of frames.
_AT_START = re.compile(r"\b(?:dates?|times?|H?JD)\b[^.]*\bat (?:the )?start of (?:the )?exposure", re.IGNORECASE)
_QUOTED = re.compile(r'"[^"]*"')
#: Words that occur in prose but not in names of columns.
PROSE = re.compile(
    r"\b(?:and|at|is|are|the|for|with|vs|versus|from|by|on|was|were|this|that|has|have)\b", re.IGNORECASE
)
#: Marks between cells; of those that divide most lines alike, the first is used.
MARKS = ("\t", ";", "|", ",")
#: Number of lines that show how a text is divided.
SAMPLE = 50


def read_columns(kind: str, noun: str, path: Path, unit: str = "") -> Float:
    """Read times and values from a file, shape (n, 2); see `columns`. `kind` and `noun` name file and values."""
    return columns(f"{kind} {shortened(path.name)}", read_text(path, kind), f"times and {noun}", unit)


def columns(label: str, text: str, expected: str, unit: str = "") -> Float:
    """Parse rows of two numbers in any form of text, shape (n, 2).

    The first column of the result is in `unit`, as is that of the text unless its header states another one. `label`
    and `expected` name the text and its two columns in messages.
    """
    with parsing(label, f"give two columns of numbers: {expected}"):
        try:
            lines = NumberLines(text, expected)
            if odd := next((len(cells) for cells in lines.cells if len(cells) != 2), 0):
                raise InputError(f"it has {odd} column{'s' * (odd > 1)}, but needs two: {expected}", key="columns")
            first, second = (lines.column(k, str(k + 1)).numbers() for k in range(2))
            return np.column_stack([_in_unit(first, lines.comments, unit) if unit else first, second])
        except InputError as error:
            raise error.within(label) from error


#: A word that may be a unit, in the header of numbers: ``(nm)``, ``in Angstrom``, ``time_min``, ``unit: um``.
_UNIT_WORD = re.compile(r"[\[(]\s*([^\[\](),;\s]+)|(?:\bin\s+|_|\bunits?\s*[:=]\s*)([A-Za-zµÅ]+)(?!\w)")


def _in_unit(values: Float, header: str, unit: str) -> Float:
    """Return times or wavelengths in a unit; raise InputError if a header states several."""
    import astropy.units as u

    words = {}
    for word in (match[1] or match[2] for match in _UNIT_WORD.finditer(header)):
        with contextlib.suppress(ValueError, TypeError):
            parsed = unit_in(word) if unit == "s" else unit_of(word)
            if parsed.is_equivalent(u.Unit(unit), u.spectral() if unit == "nm" else []):
                words[parsed] = word
    if len(words) > 1:
        raise InputError(f"its header must state one unit, not {' and '.join(words.values())}", key="unit")
    return np.asarray((values * next(iter(words), u.Unit(unit))).to_value(unit, u.spectral()))


class NumberLines:
    """Header and rows of a text of numbers, which `expected` names in messages; columns are parsed when they are read.

    Unlike `rows_of_text`, it takes every line above the first row of numbers for a header, which may be prose, and
    columns that nobody reads may hold anything.
    """

    def __init__(self, text: str, expected: str) -> None:
        self.expected = expected
        #: Lines above the rows, and all comments without their marks; whether each is a comment.
        self.header: list[tuple[str, bool]] = []
        #: Number and text of the line of each row.
        self.lines: list[tuple[int, str]] = []
        #: Statements on how the rows are read.
        self.messages: list[str] = []
        numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if not _RULE.fullmatch(line)]
        comments = {number for number, line in numbered if _COMMENT.match(line) and not _BARRED.match(line)}
        start = _first_row([(number, line) for number, line in numbered if number not in comments])
        for number, line in numbered:
            # A heading between marks, as of IPAC, stands above the rows.
            if number in comments and not (line.lstrip()[0] == "|" and self.lines):
                self.header.append((_remark(line), True))
            elif number < start:
                self.header.append((line.split("#", 1)[0].rstrip(), False))
            else:
                self.lines.append((number, line.split("#", 1)[0].strip()))
        if not self.lines:
            raise InputError(f"it contains no numbers, but needs two columns: {expected}", key="columns")
        self.comments = "\n".join(line for line, _ in self.header)
        rows = [line for _, line in self.lines]
        mark = _mark(rows, commas=False)
        self.cells = _split(rows, mark)
        self.n = len(self.cells[0])
        if _has_decimal_commas(self.cells, "it"):
            self.cells = _replace_decimal_commas(self.cells)
            self.messages.append(DECIMAL_COMMAS)
        are_whole = all(len(row) > 1 and row[1].isdecimal() and "." not in "".join(row) for row in self.cells[:SAMPLE])
        if mark == "," and len(rows) > 1 and are_whole:
            fault = f"its line {shortened(rows[0], 60)} may hold decimal commas or columns; use decimal points"
            raise InputError(fault, key="columns")

    def column(self, place: int, name: str, unit: str = "") -> Values:
        """Return a column of numbers."""
        return Values(name, (len(self.cells),), partial(self._numbers, place), unit)

    def _numbers(self, place: int, piece: slice) -> Any:
        """Return the numbers of a column; an InputError names the line of the first cell without a number."""
        values: list[float] = []
        try:
            for cells in self.cells[piece]:
                values.append(number_in(cells[place]))
        except (IndexError, ValueError) as error:
            number, line = self.lines[piece.start + len(values)]
            n = "one column" if len(cells) == 1 else f"{len(cells)} columns"
            fault = "is not numeric" if len(cells) > place else f"has {n}"
            fault = f"line {number}: {shortened(line, 60)} {fault}, but must hold {self.expected}"
            raise InputError(fault, key="columns") from error
        return np.array(values, float)


def _remark(line: str) -> str:
    """Return a comment without the mark at its start."""
    return line.strip().lstrip("#%!;/\\| ")


def _first_row(lines: Sequence[tuple[int, str]]) -> float:
    """Return the number of the first line that starts with two numbers or, if there is none, with one."""
    starting = []
    for place, (number, line) in enumerate(lines):
        first = re.split(r"[\s;|]+|,\s|,(?=[^\d])", line.strip().strip("|").strip())[0]
        if not _begins_with_number(first.strip("\"'(")):
            continue
        starting.append(number)
        cells = re.split(r"[\s;|]+", line.strip())
        cells = line.split(",") if len(cells) == 1 else cells
        if all(map(str.isdecimal, cells)) and int(cells[0][:9]) == len(lines) - place - 1 > 0:
            # The numbers of rows and of other columns, as in POLARBASE's spectra.
            continue
        # A line of a preamble, such as "2 columns" or "912 s", has no second number.
        if sum(_begins_with_number(cell) or is_missing(cell) for cell in cells) > 1:
            return number
    return starting[0] if starting else float("inf")


def _begins_with_number(cell: str) -> bool:
    """Return whether a cell is a number, which brackets or marks may follow."""
    return _NUMBER.match(cell) is not None or cell.lower() in ("nan", "inf", "-inf")


#: Message on numbers such as ``3,5``.
DECIMAL_COMMAS = "its decimal commas are read as points"


@dataclass(frozen=True)
class Layout:
    """Division of a text into cells, and the names and units of its columns."""

    mark: str  # between cells; empty for blanks
    decimal: bool  # whether numbers have decimal commas
    names: tuple[str, ...]
    units: tuple[str, ...]
    trailing: bool  # whether a mark ends the rows


def rows_of_text(
    text: str, label: str, commas: bool, layout: Layout | None = None, first: int = 0
) -> tuple[Table, Layout]:
    """Parse a text table whose cells stay texts, with the keywords of its comments, and return its layout as well.

    The first line names the columns, unless it has numbers and dates only; then the last comment above it may do so,
    and otherwise columns are called col1, col2 and so on. Lines above the names without a mark are a title. Units, and
    dashes, may stand below the names. If nothing else shows how, cells are divided at `commas`.

    A text that continues a table has rows only, with the `layout` of the `first` rows above it, which messages count.
    """
    from astropy.table import Table

    lines = [line for line in text.splitlines() if not _RULE.fullmatch(line)]
    n_marked = next((k for k, line in enumerate(lines) if not re.match(r"c(?:\s+[a-z]|\s*$)", line, re.I)), 0)
    if n_marked > 1:
        # Fortran's mark of comments, in the header of BRITE's light curves. Rows have numbers after a letter.
        lines[:n_marked] = [f"#{line[1:]}" for line in lines[:n_marked]]
    check_cells([line for line in lines if line[0] != "#"], label)
    mark = layout.mark if layout else _mark([line for line in lines if line.lstrip()[0] != "#"], commas)
    # SIMBAD calls its first column #, as wide as its number of stars.
    marked = re.compile(rf"\s*{re.escape(mark)}" if mark in (";", "|") else r"(?!)")
    is_comment = [bool(_COMMENT.match(line)) and not marked.match(line.removeprefix("#")) for line in lines]
    data = [line for line, comment in zip(lines, is_comment, strict=True) if not comment]
    comments = [line for line, comment in zip(lines, is_comment, strict=True) if comment]
    cells = _join_dates(_split(data, mark))
    if layout is None:
        n_above = next((k for k, comment in enumerate(is_comment) if not comment), len(lines))
        layout, cells = _find_columns(cells, [_remark(line) for line in lines[:n_above]], data, mark, label)
    elif layout.trailing:
        cells = [row[:-1] for row in cells]
    if layout.decimal:
        cells = _replace_decimal_commas(cells)
    n = len(layout.names)
    if odd := next(((number, len(row)) for number, row in enumerate(cells, first + 1) if len(row) != n), None):
        # The file may be cut short.
        fault = f"{label} has {odd[1]} cells in row {odd[0]}, but must have {n} as in the first line"
        raise InputError(fault, key="file")
    columns = zip(*cells, strict=True) if cells else ((),) * n
    table = Table({name: np.array(column, str) for name, column in zip(layout.names, columns, strict=True)})
    table.meta |= {"comments": comments} | keywords_of(comments)
    if any(map(_AT_START.search, comments)):
        table.meta.setdefault("TIMEPIXR", 0.0)
    if layout.decimal:
        table.meta[REMARKS] = (DECIMAL_COMMAS,)
    for name, unit in zip(layout.names, layout.units, strict=False):
        table[name].unit = unit or None
    return table, layout


def _find_columns(
    cells: list[list[str]], above: list[str], lines: list[str], mark: str, label: str
) -> tuple[Layout, list[list[str]]]:
    """Find the names and units of columns, and return them with the rows."""
    if not cells:
        return Layout(mark, False, (), (), False), []
    # The first line that has a cell for each column; a title has no mark.
    widths = [len(row) for row in cells]
    width = Counter(widths).most_common(1)[0][0]
    at = next((k for k, n in enumerate(widths) if (n > 1 if mark else n == width)), 0)
    head, rows = cells[at], cells[at + 1 :]
    # The last mark ends the lines, unless it is that of an empty column which has a name.
    trailing = bool(mark and rows) and not any(row[-1] for row in rows) and (not head[-1] or len(rows[0]) > len(head))
    if trailing:
        cells = [*cells[:at], head if head[-1] else head[:-1], *(row[:-1] for row in rows)]
    n = len(cells[at])
    is_row = all(map(_is_cell_of_row, cells[at]))
    is_headed = not is_row and not any(map(_is_number, cells[at])) and not _are_dashes(cells[at])
    names, units = ([], []) if is_headed else _names_above(n, [*above, *lines[:at]], mark)
    if is_row and not names:
        if at:
            fault = f"{label} has {n} cells in row 1, but must have {len(cells[at - 1])} as in the line above"
            raise InputError(fault, key="file")
        names = [f"col{k + 1}" for k in range(n)]
    elif not names:
        names, at = cells[at], at + 1
    units_below, n_lines = _units_below(cells[at:])
    units, at = units_below or units, at + n_lines
    if not mark and all(name.endswith(",") for name in names[:-1]):
        # Commas divide the names and blanks the rows.
        names = [name.rstrip(",") for name in names]
    if all(re.fullmatch(r"\d*[NSM]", unit) for unit in units):
        # Types of the columns of an RDB table.
        units = []
    plain = [in_brackets(unit.strip("\"'")) for unit in units]
    stated_units = tuple(unit if is_stated(unit) else "" for unit in plain)
    decimal = _has_decimal_commas(cells[at:], label)
    return Layout(mark, decimal, tuple(_distinct_names(names)), stated_units, trailing), cells[at:]


def _units_below(rows: list[list[str]]) -> tuple[list[str], int]:
    """Return the units in the first lines below the names, and the number of these lines that hold no values."""
    first, second = [*rows[:2], [], []][:2]
    if _are_dashes(second) and not any(map(_is_number, first)):
        # VizieR writes units and dashes.
        return first, 2
    if _are_dashes(first):
        return [], 1
    if any(_is_cell_of_row(cell) and not is_missing(cell) for cell in first):
        return [], 0
    has_units = any(_is_unit(cell) for cell, number in zip(first, second, strict=False) if _is_number(number))
    return (first, 1) if has_units else ([], 0)


def _names_above(n: int, above: list[str], mark: str) -> tuple[list[str], list[str]]:
    """Return the names in the last line above the rows, and the units in it or below it; empty without names."""
    numbered = names_by_number((line for line in above if line.lower().startswith("col")), n)
    if len(numbered) > 1:
        return [numbered.get(k, f"col{k + 1}") for k in range(n)], []
    last = ["", "", *above][-2:]
    names, units = ([] if keywords_of([f"#{line}"]) else divide_names(line, n, mark) for line in last)
    if names and units and all(_is_unit(cell) for cell in units if is_stated(cell)):
        return names, units
    return units, []


def text_table(text: str, label: str, commas: bool) -> Table:
    """Parse a table from text: ECSV, those of IPAC and CDS, and rows that marks or blanks divide into texts."""
    from astropy.table import Table

    if re.match(r"\s*# %ECSV", text):
        return parse_ecsv(text, label)
    lines = [line for line in text[:100_000].splitlines() if line.strip() and line[0] not in "\\#"]
    rows = [line for line in lines if not line.startswith("|")]
    if is_described(text):
        form = "ascii.mrt" if re.match(r"\s*Title:", text) else "ascii.cds"
    elif lines and lines[0][0] == "|" and rows and not any("|" in line for line in rows):
        # The headings of IPAC's tables have marks, their rows blanks.
        form = "ascii.ipac"
    else:
        return rows_of_text(text, label, commas)[0]
    check_cells(text.splitlines(), label)
    with reading(label, "give a whole table"):
        # astropy turns an empty line into a row without values.
        return Table.read([line for line in text.splitlines() if line.strip()], format=form)


def is_described(text: str) -> bool:
    """Return whether a text is a machine-readable table of the journals, or a table of CDS with its description."""
    return re.search(r"(?m)^\s*Byte-by-byte Description", text[:100_000]) is not None


def _mark(lines: Sequence[str], commas: bool) -> str:
    """Return the mark that divides lines into cells; empty for blanks."""
    sample = [_QUOTED.sub('""', line) for line in lines[:SAMPLE]]
    scores = {}
    for mark in MARKS:
        counts = Counter(n for line in sample if (n := line.count(mark)))
        scores[mark] = counts.most_common(1)[0][1] if counts else 0
    best = max(MARKS, key=scores.__getitem__)
    words = [line.split() for line in sample[-5:]]
    blanks = all(len(row) > 1 and all(map(_is_number, row)) for row in words) and bool(words)
    if commas and not (blanks and best == ","):
        return best if scores[best] else "," if not blanks else ""
    # Commas may stand in prose, and decimal commas between columns that blanks divide.
    in_words = best == "," and any(
        re.search(r"\d\s+[-+.\d]", cell)
        for line in sample[1:]
        for cell in map(str.strip, line.split(","))
        if not is_dated(cell)
    )
    # Other marks are rare in prose, so that several lines of a title may stand above the first line with one.
    is_usual = best != "," and scores[best] > 1
    start = next((k for k, line in enumerate(sample) if best in line), 0) if is_usual else 1
    return best if scores[best] and all(best in line for line in sample[start:]) and not in_words else ""


def _split(lines: Sequence[str], mark: str) -> list[list[str]]:
    """Divide lines into cells, whose quotes and blanks are removed."""
    if mark == "|":
        # Marks around a line enclose it; one at its end alone may follow an empty cell.
        lines = [re.sub(r"^\s*\|(.*)\|\s*$", r"\1", line) for line in lines]
    is_quoted = any('"' in line for line in lines)
    plain = unquoted if is_quoted or any("'" in line for line in lines) else str.strip
    rows: Iterable[list[str]]
    if mark or is_quoted:
        rows = csv.reader((line.strip(" ") for line in lines), delimiter=mark or " ", skipinitialspace=True)
    else:
        rows = ((re.sub(r"\s#.*", "", line) if "#" in line else line).split() for line in lines)
    with parsing("it", "give text"):
        return [list(map(plain, row)) for row in rows]


def _join_dates(cells: list[list[str]]) -> list[list[str]]:
    """Join dates with the times of day next to them, under the names of the dates."""
    last = cells[-1] if cells else []
    for at in range(len(last) - 1):
        if _DAY.fullmatch(last[at]) and _CLOCK.fullmatch(last[at + 1]):
            return [
                [*row[:at], "T".join(row[at : at + 2]) if _DAY.fullmatch(row[at]) else row[at], *row[at + 2 :]]
                if len(row) == len(last) else row for row in cells
            ]  # fmt: skip
    return cells


def _has_decimal_commas(rows: list[list[str]], label: str) -> bool:
    """Return whether numbers have decimal commas; raise InputError if these may divide thousands."""
    sample = [cell for row in rows[:SAMPLE] for cell in row]
    commas = [cell for cell in sample if _DECIMAL_COMMA.fullmatch(cell)]
    if not commas or any(_DECIMAL_POINT.fullmatch(cell) for cell in sample):
        return False
    if all(_THOUSANDS.fullmatch(cell) for cell in commas):
        fault = f"{label} has numbers such as {commas[0]}, whose comma may be decimal or divide thousands"
        raise InputError(f"{fault}; use decimal points", key="file")
    return True


def _replace_decimal_commas(rows: list[list[str]]) -> list[list[str]]:
    """Return cells with points for decimal commas."""
    return [[cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row] for row in rows]


def divide_names(line: str, n: int, mark: str = "") -> list[str]:
    """Divide a line of a header into a name for each of `n` columns; return an empty list if it has another number."""
    if n < 2 or PROSE.search(line):
        return []
    line = re.sub(r"^\s*(?:units?(?:\s*[:=]|\s)|(?:columns?|names?)\s*[:=])\s*", "", line, flags=re.IGNORECASE)
    divisions = [line.strip("|").split(divider) for divider in ((mark,) if mark else ",;|\t") if divider in line]
    if not mark:
        divisions += [divide_outside_brackets(line), line.split(), re.split(r"\s{2,}", line.strip())]
    for division in divisions:
        cells = [cell.strip().strip("\"'").strip() for cell in division]
        if len(cells) == n and any(cells):
            # The index of a data frame has no name.
            return [cell or str(k + 1) for k, cell in enumerate(cells)]
    return []


def divide_outside_brackets(line: str) -> list[str]:
    """Divide at blanks and commas, but keep a unit in brackets with the preceding name."""
    brackets = r"[\[(](?:[^\[\]()]|\([^()]*\))*[\])]"
    return re.findall(rf"[^\s\[(,]+(?:\s+in\s+[^\s,]+|(?:\s*{brackets})+[^\s,]*)?|{brackets}", line)


def _distinct_names(names: list[str]) -> list[str]:
    """Name columns that have no name, and number names that occur twice."""
    names = [name or f"col{k + 1}" for k, name in enumerate(names)]
    while twice := [name for name, count in Counter(names).items() if count > 1]:
        names = [f"{name}_{names[: k + 1].count(name)}" if name in twice else name for k, name in enumerate(names)]
    return names


def _is_cell_of_row(cell: str) -> bool:
    """Return whether a cell is a number, a date or missing, and thus not a name."""
    return is_dated(cell) or is_missing(cell) or _is_number(cell)


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number that is not missing."""
    try:
        return not np.isnan(number_in(cell))
    except ValueError:
        return _DECIMAL_COMMA.fullmatch(cell) is not None


def _are_dashes(row: list[str]) -> bool:
    """Return whether the cells of a row are dashes."""
    return any(row) and all(re.fullmatch(r":?[-=]*:?", cell) for cell in row)


def _is_unit(text: str) -> bool:
    plain = in_brackets(text)
    return is_stated(plain) and (time_unit(plain) is not None or angle_unit(plain) is not None or is_known(plain))


#: A line on one column: ``column 2: flux``, ``(3) error``, ``column1 = HJD / Heliocentric Julian Date``.
_NUMBERED = re.compile(r"(?:col(?:umn)?s?\.?\s*)?[(\[]?(\d{1,3})[)\]]?\s*[:=.)\-]?\s+(.+)", re.IGNORECASE)


def names_by_number(lines: Iterable[str], n: int) -> dict[int, str]:
    """Return the names that lines such as "column 2: flux" give to some of `n` columns, by place."""
    names: dict[int, str] = {}
    for line in lines:
        if (match := _NUMBERED.fullmatch(line.strip())) and 1 <= int(match[1]) <= n:
            unit = re.search(r"\s/\s.*(\[[^\[\]]+\])$", match[2])
            name = re.split(r"[,;:]|\s-\s|\s/\s", match[2])[0].strip()[:60]
            names.setdefault(int(match[1]) - 1, f"{name} {unit[1]}" if unit else name)
    return names


def keywords_of(lines: Sequence[str]) -> dict[str, str]:
    """Return the keywords in the comments of a text file, as in ``# DATE-OBS = 2026-03-01T12:00:00``."""
    keywords = {}
    for line in lines:
        match = re.match(r"\s*[#%!;]+\s*([A-Za-z][\w .-]{0,40}?)\s*[=:]\s*(.*?)\s*(?:\s/\s.*)?$", line)
        if match:
            keywords[match[1]] = match[2].strip("\"'")
    return keywords
