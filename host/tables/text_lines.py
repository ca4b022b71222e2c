"""Lines of a text: comments and headings, and below them rows of numbers, whatever divides their cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.parsing import parsing, read_text
from mauvecl.host.tables.missing import is_missing
from mauvecl.host.tables.table import Values
from mauvecl.host.tables.text_table import cells_of, number_in
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

#: Lines above the rows without their marks, and whether each is a comment.
Header = list[tuple[str, bool]]
#: Number of a line, the line and its cells.
Row = tuple[int, str, list[str]]
Split = Callable[[str], list[str]]

# IPAC's headings begin with |, its keywords with a backslash.
_COMMENT = re.compile(r"\s*(#|%|!|;|//|\\|\|)")
_NUMBER = re.compile(r"[+-]?(?:\d[\d_]*[.,]?\d*|[.,]\d+)(?:[eEdD][+-]?\d+)?(?![\w.])")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eEdD][+-]?\d+)?")


def read_columns(what: str, kind: str, path: Path) -> NDArray[np.float64]:
    """Read times and values from a file, shape (n, 2); # starts a comment.

    `what` names the content and `kind` the values in messages.
    """
    named = f"{what} {shortened(path.name)}"
    pairs = columns(named, read_text(path, what))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(f"{named} has no two columns", f"times and {kind}", key=what)
    return pairs


def columns(what: str, text: str) -> NDArray[np.float64]:
    """Parse rows of numbers, shape (n, 2) if each row has two."""
    with parsing(what, "two columns"):
        rows = [line.split("#", 1)[0].split() for line in text.splitlines()]
        return np.array([[float(word) for word in row] for row in rows if row])


class NumberLines:
    """Header and rows of a text; the columns of the rows are parsed when they are read.

    Parameters
    ----------
    expected : str
        What a row should have, for messages.
    """

    def __init__(self, text: str, expected: str) -> None:
        self.expected = expected
        #: Lines above the rows, and all comments.
        self.header: Header = []
        numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
        comments = {number for number, line in numbered if _COMMENT.match(line)}
        start = _first_row([(number, line) for number, line in numbered if number not in comments])
        found: list[tuple[int, str]] = []
        for number, line in numbered:
            if number in comments and not (line.lstrip()[0] == "|" and found):
                self.header.append((line.strip().lstrip("#%!;/\\| "), True))
            elif number < start:
                self.header.append((line.split("#", 1)[0].rstrip(), False))
            else:
                found.append((number, line.split("#", 1)[0].strip()))
        if not found:
            raise InputError("does not contain numbers", f"two columns: {expected}", key="columns")
        #: Function that divides a line into cells, and the messages on decimal commas.
        self.split, self.messages = _splitter([line for _, line in found])
        self.rows: list[Row] = [(number, line, self.split(line)) for number, line in found]
        #: Number of columns, and whether their cells contain arrays.
        self.n = len(self.rows[0][2])
        self.holds_arrays = any(map(_is_array, self.rows[0][2]))

    @property
    def comments(self) -> str:
        """Text of the header."""
        return "\n".join(line for line, _ in self.header)

    def column(self, place: int, name: str, unit: str = "") -> Values:
        """Return a column of numbers; of arrays or texts if there are arrays in the first row."""
        read = self._texts_or_arrays if self.holds_arrays else self._numbers
        return Values(name, (len(self.rows),), partial(read, place), unit)

    def _numbers(self, place: int, start: int, stop: int) -> Any:
        values = []
        for number, line, cells in self.rows[start:stop]:
            try:
                values.append(number_in(cells[place]))
            except (IndexError, ValueError) as error:
                n = "one column" if len(cells) == 1 else f"{len(cells)} columns"
                fault = f"line {number}: {shortened(line, 60)} {'is not numeric' if len(cells) > place else f'has {n}'}"
                raise InputError(fault, self.expected, key="columns", value=line) from error
        return np.array(values)

    def _texts_or_arrays(self, place: int, start: int, stop: int) -> Any:
        cells = [cells[place].strip() if place < len(cells) else "" for _, _, cells in self.rows[start:stop]]
        if not any(map(_is_array, cells)):
            return np.array(cells)
        arrays = [_array(cell) for cell in cells]
        if len({array.size for array in arrays}) == 1:
            return np.array(arrays)
        values = np.empty(len(arrays), object)
        values[:] = arrays
        return values


def _is_array(cell: str) -> bool:
    return cell.strip()[:1] in ("(", "[")


def _array(cell: str) -> NDArray[np.float64]:
    try:
        return np.array([number_in(one) for one in cell.strip("()[]").split(",")])
    except ValueError as error:
        raise InputError.of("cell", cell, "an array of numbers") from error


def _first_row(lines: Sequence[tuple[int, str]]) -> float:
    """Return the number of the first line that starts with two numbers or, if there is none, with one."""
    starting = []
    for number, line in lines:
        first = re.split(r"[\s;|]+|,\s|,(?=[^\d])", line.strip().strip("|").strip())[0]
        if not _is_numeric(first.strip("\"'(")):
            continue
        starting.append(number)
        cells = re.split(r"[\s;|]+", line.strip())
        cells = line.split(",") if len(cells) == 1 else cells
        # A line of a preamble, such as "2 columns" or "912 s", has no second number.
        if sum(_is_numeric(cell) or is_missing(cell) for cell in cells) > 1:
            return number
    return starting[0] if starting else float("inf")


def _is_numeric(cell: str) -> bool:
    return _NUMBER.match(cell) is not None or cell.lower() in ("nan", "inf", "-inf")


def _splitter(lines: list[str]) -> tuple[Split, list[str]]:
    """Return a function that divides lines into cells, and messages; decimal commas become points."""
    sample = lines[:50] + lines[-5:]
    commas, points = (any(mark in line for line in sample) for mark in ",.")

    def divided_at(mark: str, decimal: bool) -> tuple[Split, list[str]]:
        if decimal:
            return lambda line: cells_of(line.replace(",", "."), mark), ["its decimal commas are read as points"]
        return lambda line: cells_of(line, mark), []

    for mark in (";", "\t", "|"):
        if all(mark in line for line in sample):
            return divided_at(mark, commas and not points)
    if any('"' in line for line in sample):
        return (lambda line: next(csv.reader([line], skipinitialspace=True))), []
    if not commas:
        return str.split, []

    def ambiguous(fault: str, expected: str) -> InputError:
        return InputError(f"line {shortened(sample[0], 60)} {fault}", expected, key="columns", value=sample[0])

    blanks = [line.split() for line in sample]
    if all(len(cells) > 1 for cells in blanks) and not any(c.endswith(",") for cells in blanks for c in cells[:-1]):
        if points or not all(_DECIMAL_COMMA.fullmatch(c) or "," not in c for cells in blanks for c in cells):
            raise ambiguous("mixes commas, points and blanks", "decimal points and one kind of mark between columns")
        return divided_at("", decimal=True)
    cells = [line.split(",") for line in sample]
    if not points and all(len(row) > 1 and re.fullmatch(r"\s*\d+\s*", row[1]) for row in cells) and len(cells) > 1:
        raise ambiguous("may hold decimal commas or columns", "decimal points")
    return (lambda line: line.replace(",", " , ").split(" , ") if ",," in line else re.split(r"\s*,\s*|\s+", line)), []
