"""Small tables of one's own: CSV, ECSV, or columns with blanks between them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from .bounded import read_bytes, shortened, unpacked
from .ecsv import check_cells, parse_ecsv
from .parsed import as_text, parsing

if TYPE_CHECKING:
    from astropy.table import Table

#: Characters of a table that is text: astropy tries a score of forms on it.
MOST_TEXT = 4 * 2**20


def read_text_table(path: str | Path, what: str) -> Table:
    """A table in a file of text.

    Parameters
    ----------
    path : str or Path
        ECSV by its first line, CSV by its ending, else columns with blanks between them; packed or not.
    what : str
        What it should be, for messages.

    Raises
    ------
    InputError
        If it cannot be read, or is too large.
    """
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return text_table(as_text(unpacked(read_bytes(path, what), named), named), named, path.suffix.lower() == ".csv")


def text_table(text: str, named: str, commas: bool, expected: str = "CSV or ECSV") -> Table:
    """The table in a text; errors as `read_text_table`."""
    # Heavy to import, and needed only where a table is read.
    from astropy.table import Table

    if len(text) > MOST_TEXT:
        raise InputError(f"{named} has {len(text)} characters, expected at most {MOST_TEXT}")
    if text.startswith("# %ECSV"):
        return parse_ecsv(text, named)
    lines = text.splitlines()
    check_cells(lines, named)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read([*lines, ""], format="ascii.csv" if commas else "ascii")
