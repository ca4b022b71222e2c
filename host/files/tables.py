"""Read small tables of users of any common format: text, FITS or VOTable."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from .parsing import as_text, parsing
from .size_limits import read_bytes, unpacked
from .text_table import text_table

if TYPE_CHECKING:
    from astropy.table import Table

FORMATS = "CSV, ECSV or FITS"


def read_table(path: str | Path, what: str, expected: str = FORMATS) -> Table:
    """Read the table in a text file, the first table of a FITS file, or that of a VOTable.

    Parameters
    ----------
    path : str or Path
        Packed by gzip, bzip2 or xz or not.
    what, expected : str
        What the file should be, for messages: "flare table", "CSV or FITS".
    """
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    content = unpacked(read_bytes(path, what), named)
    if content.startswith(b"SIMPLE  ="):
        return _fits_table(content, named, expected)
    if b"<VOTABLE" in content[:4096]:
        return _votable(content, named, expected)
    return text_table(as_text(content, named), named, path.suffix.lower() == ".csv", expected)


def _fits_table(content: bytes, named: str, expected: str) -> Table:
    """Read the first table of a FITS file; raises InputError if it claims to be larger than the file."""
    from astropy.io import fits
    from astropy.table import Table

    with parsing(named, expected), warnings.catch_warnings(), fits.open(io.BytesIO(content), memmap=False) as hdus:
        # Astropy warns of headers that it can read nevertheless.
        warnings.simplefilter("ignore")
        for hdu in hdus:
            claimed = hdu.size
            if claimed > len(content):
                raise InputError(
                    f"{named} says that it has {claimed} bytes of data", "at most the file's", key="file", value=claimed
                )
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU):
                return Table.read(hdu)
        raise InputError(f"{named} has no table", expected, key="file")


def _votable(content: bytes, named: str, expected: str) -> Table:
    """Read the first table of a VOTable; raises InputError if it defines entities."""
    from astropy.table import Table

    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise InputError(f"{named} defines entities", "a VOTable without them", key="file")
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read(io.BytesIO(content), format="votable", table_id=0, use_names_over_ids=True)
