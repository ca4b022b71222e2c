"""The one way to open a table of a user: its form by its first bytes, within limits of size."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

from mauvecl.host.files.parsing import parsing
from mauvecl.host.files.size_limits import check_size, limit_bytes, open_regular, packed, read_bytes, unpacked
from mauvecl.host.tables.fits import open_fits, reading
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.large_tables import LARGE, open_large
from mauvecl.host.tables.names import STARS
from mauvecl.host.tables.table import MemoryTable, TableFile
from mauvecl.host.tables.text_table import is_csv, keywords_of, text_of, text_table
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

if TYPE_CHECKING:
    from astropy.io.votable.tree import VOTableFile
    from astropy.table import Table

FORMATS = "CSV, ECSV, FITS or VOTable"
Form = Literal["FITS", "HDF5", "VOTable", "XML", "ECSV", "text"]


def form_of(start: bytes) -> Form:
    """Return the form of a file by its first bytes."""
    if start.startswith(b"SIMPLE  ="):
        return "FITS"
    if start.startswith(b"\x89HDF\r\n"):
        return "HDF5"
    text = start[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if text.startswith(b"<"):
        known = re.match(rb"<(\?xml|!--|votable|vot:)", text, re.IGNORECASE) and b"VOTABLE" in text.upper()
        return "VOTable" if known else "XML"
    return "ECSV" if re.match(rb"#\s*%ECSV", text) else "text"


@contextmanager
def open_table(
    path: Path,
    what: str,
    kind: str = "file",
    *,
    expected: str = FORMATS,
    check: bool = True,
    large: bool = False,
    texts: Collection[str] = (),
    of_fits: Callable[[Any], TableFile] | None = None,
    of_hdf5: Callable[[IO[bytes]], AbstractContextManager[TableFile]] | None = None,
) -> Iterator[TableFile]:
    """Open the table in a file: text, ECSV, FITS or VOTable, packed by gzip, bzip2 or xz or not.

    Parameters
    ----------
    what, kind, expected : str
        The file, the kind of file, and what it should be, for messages.
    check : bool
        Whether to verify the checksums of a FITS file that can be read whole.
    large : bool
        Whether the file may exceed MAUVECL_LARGEST_FILE_MIB, if it can be read in pieces.
    texts : collection of str
        Names of columns whose cells stay text, such as "0012".
    of_fits, of_hdf5 : callable, optional
        Functions that make tables of an open FITS file, by default of its first table, and of an HDF5 file.
    """
    if not large:
        check_size(path, kind)
    with open_regular(path, kind) as raw:
        start = raw.read(4096)
        commas = bool({".csv", ".tsv"} & {suffix.lower() for suffix in path.suffixes[-2:]})
        size = raw.seek(0, io.SEEK_END)
        raw.seek(0)
        if (commas or form_of(start) == "ECSV") and not packed(start) and size > LARGE:
            with open_large(raw, what, commas, expected) as table:
                yield table
            return
        file: IO[bytes] = raw
        content = b""
        if form_of(start) not in ("FITS", "HDF5"):
            content = unpacked(read_bytes(path, kind), what)
            start, file = content[:4096], io.BytesIO(content)
        form = form_of(start)
        if form == "FITS":
            check &= file.seek(0, io.SEEK_END) <= limit_bytes("MAUVECL_LARGEST_FILE_MIB")
            with open_fits(file, what, check=check) as hdus:
                with reading(what):
                    found = FitsTables(hdus, what) if of_fits is None else of_fits(hdus)
                yield _filled(found)
        elif form == "HDF5" and of_hdf5 is not None:
            with of_hdf5(file) as stored:
                yield stored
        else:
            yield _filled(_in_memory(content, form, what, commas, expected, texts))


def _in_memory(
    content: bytes, form: Form, what: str, commas: bool, expected: str, texts: Collection[str]
) -> MemoryTable:
    if form == "VOTable":
        found = next(votables(content, what, expected), None)
        if found is None:
            raise InputError(f"{what} has no table", expected, key="file")
        return found
    check_no_page(content, form, what, expected)
    try:
        text = text_of(content)
    except InputError as error:
        raise error.within(what) from error
    if not text.strip():
        raise InputError(f"{what} is empty", expected, key="file")
    found = MemoryTable(text_table(text, what, commas or is_csv(text), expected, texts=texts), what)
    found.header |= keywords_of([line for line in text.splitlines() if line[:1] in "#%!;"])
    return found


def check_no_page(content: bytes, form: Form, what: str, expected: str) -> None:
    """Raise InputError for XML other than VOTable, such as a page of an archive that says that a file is missing."""
    if form == "XML":
        start = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")[:20]
        fault = f"{what} is a page or XML that begins with {shortened(start.decode('ascii', 'replace'))}"
        raise InputError(fault, expected, key="file", value=start)


def votables(content: bytes, what: str, expected: str) -> Iterator[MemoryTable]:
    """Yield the tables of a VOTable, whose parameters and systems of times and coordinates are keywords."""
    file = votable_in(content, what)
    shared = {str(one.name or one.ID): one.value for resource in file.resources for one in resource.params}
    shared |= _systems(file)
    for table in file.iter_tables():
        with parsing(what, expected):
            for field in table.fields:
                field.name = field.name or field.ID
            found = MemoryTable(table.to_table(use_names_over_ids=True), what)
        found.header |= shared | {str(one.name or one.ID): one.value for one in table.params}
        found.table.meta |= found.header
        yield found


def _systems(file: VOTableFile) -> dict[str, Any]:
    """Return what a VOTable says of its times and coordinates (TIMESYS and COOSYS), as keywords of FITS."""
    found: dict[str, Any] = {}
    for resource in file.resources:
        for one in resource.time_systems:
            # A number of days, or the words JD-origin and MJD-origin.
            origin = {"JD-origin": 0.0, "MJD-origin": 2_400_000.5}.get(str(one.timeorigin), one.timeorigin)
            found |= {} if origin is None else {"JDREF": float(origin)}
            found |= {"TIMESYS": str(one.timescale or ""), "TREFPOS": str(one.refposition or "")}
        for place in resource.coordinate_systems:
            found["COOSYS"] = str(place.system or "")
    return found


def _filled(file: TableFile) -> TableFile:
    """Return a file; raise InputError if it has nothing with rows."""
    if not file.names:
        raise InputError(f"{file.what} has no table and no image", "a row for each frame, star or flare", key="file")
    return file


def read_table(path: str | Path, what: str, expected: str = FORMATS, *, texts: Collection[str] = STARS) -> Table:
    """Read a small table into memory; see `open_table`."""
    path = Path(path)
    with open_table(path, f"{what} {shortened(str(path))}", what, expected=expected, texts=texts) as file:
        return file.table if isinstance(file, MemoryTable) else file.loaded()


def votable_in(content: bytes, what: str) -> VOTableFile:
    """Parse a VOTable; raise InputError if it is damaged or defines entities."""
    from astropy.io import votable

    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise InputError(f"{what} defines entities", "a VOTable without entities", key="file")
    with parsing(what, "a complete VOTable"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return votable.parse(io.BytesIO(content), verify="ignore")
