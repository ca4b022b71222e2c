"""Tables of any format, recognised by content instead of name, and those larger than memory."""

from __future__ import annotations

import io
import itertools
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

import numpy as np

from mauvecl.host.tables import files
from mauvecl.host.tables.fits_tables import WHOLE, FitsTables, open_fits
from mauvecl.host.tables.names import match_name
from mauvecl.host.tables.table import REMARKS, MemoryTable, TableFile, Values
from mauvecl.host.tables.text_tables import Layout, rows_of_text, text_table
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import is_table

if TYPE_CHECKING:
    from astropy.table import Table

#: Size of a text from which it is read in pieces, and of a piece, bytes.
LARGE, PIECE = 16 * 2**20, 2**20
#: Longest text of a cell, such as a date.
MAX_CELL = 40


class LargeTable(TableFile):
    """Rows of a text table in a temporary file, which disappears with this object."""

    def __init__(self, pieces: Iterator[Any], label: str, file: IO[bytes]) -> None:
        first = MemoryTable(next(pieces), label)
        # One row has the names and units.
        self.table, self.n_rows, self.file = MemoryTable(first.table[:1], label), 0, file
        super().__init__(label, first.header, first.names, first.remarks)
        numeric = {name: _are_numbers(first.find(name)) for name in first.names}
        self.row = np.dtype([(name, "f8" if is_numeric else f"U{MAX_CELL}") for name, is_numeric in numeric.items()])
        tables = itertools.chain([first], (MemoryTable(piece, label) for piece in pieces))
        del first
        for table in tables:
            rows = np.zeros(len(table.table), self.row)
            for name in self.names:
                rows[name] = self._cells(table.find(name), self.row[name].kind == "f")
            rows.tofile(self.file)
            self.n_rows += len(rows)
        self.latest: tuple[slice | None, Any] = None, None

    def _cells(self, column: Values, are_numbers: bool) -> Any:
        """Return the next rows of a column as numbers or short texts."""
        if are_numbers:
            # Messages count rows from the start of the file.
            shifted = replace(column, read=lambda _: column.cells)
            return shifted.rows(slice(self.n_rows, self.n_rows + column.n_rows))
        texts = column.texts() or [str(number) for number in column.numbers().tolist()]
        if any(len(text) > MAX_CELL for text in texts):
            fault = f"{self.label}: {column.name!r} must hold numbers or dates"
            raise InputError(f"{fault}, but a cell has more than {MAX_CELL} characters", key=column.name)
        return texts

    def _rows(self, piece: slice) -> Any:
        # Columns are read one after the other, and each reads all columns of its rows.
        if piece != self.latest[0]:
            self.file.seek(piece.start * self.row.itemsize)
            self.latest = piece, np.fromfile(self.file, self.row, max(0, piece.stop - piece.start))
        return self.latest[1]

    def named(self, name: str) -> Values | None:
        """Return a column."""
        title = match_name(name, self.names, self.label)
        if title is None:
            return None
        first = self.table.find(name)
        # A copy, since a view of a column would keep all columns of the piece in memory.
        return Values(name, (self.n_rows,), lambda piece: self._rows(piece)[title].copy(),
                      first.unit, self.label, self.row.itemsize, keywords=first.keywords)  # fmt: skip


def _are_numbers(values: Values) -> bool:
    """Return whether values are numbers, or texts of numbers."""
    try:
        values.numbers()
    except InputError:
        return False
    return True


def _pieces(text: IO[str], label: str, commas: bool) -> Iterator[Any]:
    """Yield tables of consecutive rows, of which the first has the keywords of comments above them."""
    lines = files.lines_in(text, label)
    # Each piece of ECSV begins with the header and the names.
    head: list[str] = []
    waiting, size = [next(lines, "")], 0
    if waiting[0].startswith("# %ECSV"):
        head, waiting = waiting, []
        while head[-1].startswith("#") or (head[-1] and not head[-1].strip()):
            size += len(head[-1])
            _check_head(size, label)
            head.append(next(lines, ""))
        size = 0
    layout: Layout | None = None
    first = 0
    for line in itertools.chain(lines, [""]):
        waiting.append(line)
        size += len(line)
        if line and size < PIECE:
            continue
        if head:
            piece = text_table("".join(head + waiting), label, commas)
        else:
            piece, layout_of_piece = rows_of_text("".join(waiting), label, commas, layout, first)
            if not len(piece) and not first:
                _check_head(size, label)
                continue
            layout = layout_of_piece
        waiting, size = [], 0
        if len(piece):
            first += len(piece)
            yield piece
    if not first:
        raise InputError(f"{label} has no rows, but needs one for each frame", key="frames")


def _check_head(size: int, label: str) -> None:
    """Raise InputError for more than `MAX_HEADER` characters above the rows."""
    if size > files.MAX_HEADER:
        fault = f"{label} must have at most {files.MAX_HEADER} characters of comments and empty lines before its rows"
        raise InputError(fault, key="file")


#: Forms of files that are read, for messages.
FORMATS = "must be text such as CSV, ECSV, FITS or VOTable"
Form = Literal["FITS", "HDF5", "VOTable", "XML", "ECSV", "text"]


def form_of(start: bytes) -> Form:
    """Return the form of a file by its first bytes."""
    if start.startswith(b"SIMPLE  ="):
        return "FITS"
    if start.startswith(b"\x89HDF\r\n"):
        return "HDF5"
    text = start[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if text.startswith(b"<"):
        is_votable = re.match(rb"<(\?xml|!--|votable|vot:)", text, re.IGNORECASE) and b"VOTABLE" in text.upper()
        return "VOTable" if is_votable else "XML"
    return "ECSV" if re.match(rb"#\s*%ECSV", text) else "text"


@contextmanager
def open_content(path: Path, label: str, kind: str, *, large: bool = False) -> Iterator[tuple[Form, IO[bytes]]]:
    """Open a file within limits of size and unpack it, and recognise its form by its first bytes; see `open_table`."""
    if not large:
        files.check_size(path, kind)
    with files.open_regular(path, kind) as raw:
        start = raw.read(4096)
        raw.seek(0)
        form = form_of(start)
        if form in ("FITS", "HDF5") or (large and form in ("text", "ECSV") and not start.startswith((*files.PACKED,))):
            yield form, raw
            return
        content = files.unpacked(files.read_bytes(path, kind), label)
        yield form_of(content[:4096]), io.BytesIO(content)


@contextmanager
def open_table(
    path: Path,
    label: str,
    kind: str = "file",
    *,
    check: bool = True,
    large: bool = False,
    of_fits: Callable[[Any, str], TableFile] = FitsTables,
    of_hdf5: Callable[[IO[bytes], str], AbstractContextManager[TableFile]] | None = None,
) -> Iterator[TableFile]:
    """Open the table in a file: text, ECSV, FITS or VOTable, packed by gzip, bzip2 or xz or not.

    For messages, `label` and `kind` are the file and its kind. A FITS file that can be read whole has its checksums
    verified (`check`). A `large` file, which can be read in pieces, may exceed MAUVECL_LARGEST_FILE_MIB. Functions of
    the open file and of `label` make tables of FITS (`of_fits`, by default of the first table) and HDF5 (`of_hdf5`).
    """
    commas = bool({".csv", ".tsv"} & {suffix.lower() for suffix in path.suffixes[-2:]})
    with open_content(path, label, kind, large=large) as (form, content):
        size = content.seek(0, io.SEEK_END)
        content.seek(0)
        if form == "FITS":
            check &= size <= files.limit_bytes("MAUVECL_LARGEST_FILE_MIB")
            with open_fits(content, label, check=check) as hdus:
                with files.reading(label, WHOLE):
                    table = of_fits(hdus, label)
                yield _not_empty(table)
        elif form == "HDF5" and of_hdf5 is not None:
            with of_hdf5(content, label) as stored:
                yield stored
        elif form in ("text", "ECSV") and size > LARGE:
            with io.TextIOWrapper(content, "utf-8-sig") as text, tempfile.TemporaryFile() as rows:
                yield LargeTable(_pieces(text, label, commas), label, rows)
        elif form == "VOTable":
            if (first := next(votables(content.read(), label), None)) is None:
                raise InputError(f"{label} has no table, but needs one", key="file")
            yield _not_empty(first)
        else:
            yield _not_empty(MemoryTable(text_table(text_in(form, content.read(), label), label, commas), label))


#: Forms of files that are not read, by their first bytes.
FOREIGN = {
    b"PK\x03\x04": "a ZIP archive or a workbook", b"\xd0\xcf\x11\xe0": "a workbook", b"%PDF": "a PDF document",
    b"{\\rtf": "a document", b"%!PS": "a document", b"#ASDF": "ASDF", b"{": "JSON", b"[{": "JSON", b"[[": "JSON",
    b"\x93NUMPY": "an array of NumPy", b"\x80\x04\x95": "a pickle of Python", b"SR\x00\x04": "a session of IDL",
    b"PAR1": "Parquet", b"ARROW1": "Feather", b"SQLiteformat": "a database", b"MATLAB5": "of MATLAB",
    b"\x89HDF": "HDF5 or NetCDF", b"CDF\x01": "NetCDF", b"CDF\x02": "NetCDF", b"CDF\x05": "NetCDF",
    b"READSERR": "QDP", b"READTERR": "QDP", b"#Regionfileformat": "a list of regions",
    b"versionhttps://git-lfs": "a pointer of Git LFS to another file", b"\x1f\x9d": "compressed by `compress`",
    b"\\begin{": "LaTeX", b"\\documentclass": "LaTeX", b"\x28\xb5\x2f\xfd": "compressed by zstd",
    b"7z\xbc\xaf": "a 7-Zip archive",
}  # fmt: skip


def text_in(form: Form, content: bytes, label: str) -> str:
    """Return the text of a file; raise InputError for forms that are not read, such as JSON, or a page in its place."""
    tar = "a TAR archive" if content[257:262] == b"ustar" else ""
    marks = b"".join(content[:512].split())
    if foreign := tar or next((kind for mark, kind in FOREIGN.items() if marks.startswith(mark)), ""):
        raise InputError(f"{label} is {foreign}, but {FORMATS}", key="file")
    if form == "XML":
        start = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")[:20]
        fault = f"{label} is a page or XML that begins with {shortened(start.decode('ascii', 'replace'))}"
        raise InputError(f"{fault}, but {FORMATS}", key="file")
    text = files.as_text(content, label)
    if not text.strip():
        raise InputError(f"{label} is empty, but {FORMATS}", key="file")
    return text


def votables(content: bytes, label: str) -> Iterator[MemoryTable]:
    """Yield the tables of a VOTable; its parameters and systems (TIMESYS, COOSYS) become keywords as in FITS."""
    from astropy.io import votable

    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise InputError(f"{label} must be a VOTable without entities", key="file")
    with files.reading(label, "give a whole VOTable"):
        file = votable.parse(io.BytesIO(content), verify="ignore")
    infos = (info for resource in file.resources for info in resource.infos)
    status = {info.value: info.content for info in infos if info.name == "QUERY_STATUS"}
    if "ERROR" in status:
        reason = shortened(str(status["ERROR"] or "without a reason"))
        fault = f"{label} is the answer to a query that failed: {reason}"
        raise InputError(f"{fault}; give that of one that succeeds", key="file")
    shared = _parameters(parameter for resource in file.resources for parameter in resource.params)
    systems: dict[str, dict[str, Any]] = {}
    for resource in file.resources:
        for system in resource.time_systems:
            # A number of days, or the words JD-origin and MJD-origin.
            origin = {"JD-origin": 0.0, "MJD-origin": 2_400_000.5}.get(str(system.timeorigin), system.timeorigin)
            systems[system.ID] = {} if origin is None else {"JDREF": float(origin)}
            systems[system.ID] |= {"TIMESYS": str(system.timescale or ""), "TREFPOS": str(system.refposition or "")}
        systems |= {system.ID: {"COOSYS": str(system.system or "")} for system in resource.coordinate_systems}
    # A system applies to the fields that refer to it; the only one of its kind to all.
    for key in ("COOSYS", "TIMESYS"):
        alike = [system for system in systems.values() if key in system]
        shared |= alike[0] if alike and all(system == alike[0] for system in alike) else {}
    for table in file.iter_tables():
        with files.parsing(label, "give a whole VOTable"):
            for field in table.fields:
                field.name = field.name or field.ID
            read = table.to_table(use_names_over_ids=True)
            for field, column in zip(table.fields, read.itercols(), strict=True):
                column.meta |= systems.get(field.ref, {})
            if "OVERFLOW" in status:
                read.meta[REMARKS] = ("the query had more rows than the archive returns: the table is incomplete",)
            memory_table = MemoryTable(read, label)
        memory_table.header |= shared | _parameters(table.params)
        memory_table.table.meta |= memory_table.header
        yield memory_table


def _parameters(parameters: Iterable[Any]) -> dict[str, Any]:
    """Return the values of a VOTable's parameters by name."""
    return {str(parameter.name or parameter.ID): parameter.value for parameter in parameters}


def _not_empty(file: TableFile) -> TableFile:
    """Return a file; raise InputError if it has neither a column nor an image."""
    if not file.names:
        fault = f"{file.label} has no table and no image"
        raise InputError(f"{fault}; give a row for each frame, star or flare", key="file")
    return file


def read_table(path: str | Path | Table | Any, kind: str) -> Table:
    """Read a small table into memory, see `open_table`; one in memory, such as a DataFrame, is returned as a Table."""
    from astropy.table import MaskedColumn, Table

    if is_table(path):
        return path if isinstance(path, Table) else Table.from_pandas(path)
    path = Path(path)
    with open_table(path, f"{kind} {shortened(str(path))}", kind) as file:
        if isinstance(file, MemoryTable):
            return file.table
        columns = [file.find(name) for name in file.columns]
        # Undefined cells are masked.
        return Table([MaskedColumn(np.ma.array(column.cells, copy=True), name, unit=column.unit or None)
                      for name, column in zip(file.columns, columns, strict=True)], meta=file.header)  # fmt: skip
