"""Text tables larger than memory: rows are parsed in pieces and kept in a temporary file of numbers."""

from __future__ import annotations

import io
import itertools
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np

from mauvecl.host.files.size_limits import lines_in
from mauvecl.host.tables.ecsv import MOST_HEADER
from mauvecl.host.tables.names import matched
from mauvecl.host.tables.table import MemoryTable, TableFile, Values
from mauvecl.host.tables.text_table import keywords_of, text_table
from mauvecl.schema.errors import InputError

#: Size of a text from which it is read in pieces, and of a piece, bytes.
LARGE, PIECE = 16 * 2**20, 2**20
#: Longest text of a cell, such as a date.
CELL = 40


class LargeTable(TableFile):
    """Rows of a text table in a temporary file, which disappears with this object."""

    def __init__(self, pieces: Iterator[Any], what: str) -> None:
        first = MemoryTable(next(pieces), what)
        # One row has the names and units.
        self.table, self.n_rows = MemoryTable(first.table[:1], what), 0
        super().__init__(what, first.header)
        self.row = np.dtype([(name, "f8" if _numbers(first.find(name)) else f"U{CELL}") for name in first.names])
        self.file = tempfile.TemporaryFile()  # noqa: SIM115
        self._keep(first)
        del first
        for piece in pieces:
            self._keep(MemoryTable(piece, what))

    def _keep(self, piece: MemoryTable) -> None:
        n, first = len(piece.table), self.n_rows
        rows = np.zeros(n, self.row)
        for name in self.names:
            column = piece.find(name)
            # Messages count rows from the start of the file.
            read = lambda start, stop, column=column: column.read(start - first, stop - first)  # noqa: E731
            values = Values(name, (n,), read, what=self.what)
            if self.row[name].kind == "f":
                rows[name] = values.rows(first, first + n)
                continue
            texts = column.texts() or [str(one) for one in column.numbers().tolist()]
            if any(len(text) > CELL for text in texts):
                fault = f"{self.what}: a cell of {name!r} is longer than {CELL} characters"
                raise InputError(fault, "numbers or dates", key=name)
            rows[name] = texts
        rows.tofile(self.file)
        self.n_rows += n

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return self.table.names

    def _rows(self, start: int, stop: int) -> Any:
        self.file.seek(start * self.row.itemsize)
        return np.fromfile(self.file, self.row, max(0, stop - start))

    def named(self, name: str) -> Values | None:
        """Return a column."""
        found = matched(name, self.names, self.what)
        if found is None:
            return None
        return Values(name, (self.n_rows,), lambda start, stop: self._rows(start, stop)[found],
                      self.table.find(name).unit, self.what, self.row.itemsize)  # fmt: skip

    def _side_by_side(self, pattern: str) -> Values | None:
        names = self.matching(pattern)
        if not names or any(self.row[name].kind != "f" for name in names):
            return super()._side_by_side(pattern)
        units = {self.table.find(name).unit for name in names}
        if len(units) > 1:
            return super()._side_by_side(pattern)

        def read(start: int, stop: int) -> Any:
            rows = self._rows(start, stop)
            return np.column_stack([rows[name] for name in names])

        return Values(pattern, (self.n_rows, len(names)), read, units.pop(), self.what, self.row.itemsize)


def _numbers(values: Values) -> bool:
    """Return whether values are numbers, also as texts."""
    try:
        values.numbers()
    except InputError:
        return False
    return True


@contextmanager
def open_large(file: IO[bytes], what: str, commas: bool, expected: str) -> Iterator[LargeTable]:
    """Open a text table of any size; its text is UTF-8."""
    text = io.TextIOWrapper(file, encoding="utf-8-sig")
    try:
        pieces = _pieces(text, what, commas, expected)
        table = LargeTable(pieces, what)
    except UnicodeDecodeError as error:
        raise InputError(f"{what} is not text in UTF-8", expected, key="file") from error
    with table.file:
        yield table
    text.detach()


def _pieces(text: IO[str], what: str, commas: bool, expected: str) -> Iterator[Any]:
    """Yield tables of consecutive rows, of which the first has the header's comments as keywords."""
    lines = lines_in(text, what)
    head: list[str] = []
    size = 0
    line = next(lines, "")
    while line and (line.startswith("#") or not line.strip()):
        head.append(line)
        size += len(line)
        if size > MOST_HEADER:
            fault = f"{what} has more than {MOST_HEADER} characters of comments and empty lines before its rows"
            raise InputError(fault, "fewer", key="file", value=size)
        line = next(lines, "")
    # A comment may hold the names; then this line is one of the rows.
    if len(text_table("".join([*head, line]), what, commas, expected)) == 0:
        head.append(line)
        line = ""
    first, header = 0, keywords_of([one.rstrip("\n") for one in head])
    rows = [line] if line else []
    size = 0
    for line in itertools.chain(lines, [""]):
        rows += [line] if line else []
        size += len(line)
        if not rows or (line and size < PIECE):
            continue
        piece = text_table("".join([*head, *rows]), what, commas, expected, first)
        rows, size = [], 0
        piece.meta |= {key: value for key, value in header.items() if key not in piece.meta}
        first += len(piece)
        yield piece
    if not first:
        raise InputError(f"{what} has no rows", "a row for each frame", key="frames", value=0)
