"""Read small tables of users: CSV, ECSV, or columns separated by blanks."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from .ecsv import check_cells, parse_ecsv
from .parsing import as_text, parsing
from .size_limits import read_bytes, unpacked

if TYPE_CHECKING:
    from astropy.table import Table

#: Most characters of a table: astropy tries some twenty formats on it.
MOST_TEXT = 4 * 2**20


def read_text_table(path: str | Path, what: str) -> Table:
    """Return the table in a text file.

    Parameters
    ----------
    path : str or Path
        ECSV by its first line, CSV by its ending, else columns separated by blanks; packed or not.
    what : str
        What it should be, for messages.
    """
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return text_table(as_text(unpacked(read_bytes(path, what), named), named), named, path.suffix.lower() == ".csv")


def text_table(text: str, named: str, commas: bool, expected: str = "CSV or ECSV") -> Table:
    """Return the table in a text."""
    # Slow to import, and needed only here.
    from astropy.table import Table

    if len(text) > MOST_TEXT:
        raise InputError(f"{named} has {len(text)} characters", f"at most {MOST_TEXT}", key="file", value=len(text))
    if text.startswith("# %ECSV"):
        return parse_ecsv(text, named)
    lines = text.splitlines()
    check_cells(lines, named)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read([*lines, ""], format="ascii.csv" if commas else "ascii")
