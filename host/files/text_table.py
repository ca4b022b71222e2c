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

#: Most characters of a table whose format is known, and of one on which astropy tries some twenty formats.
MOST_TEXT, MOST_GUESSED = 64 * 2**20, 4 * 2**20


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


def _without_comments(lines: list[str]) -> list[str]:
    """Return the lines of a CSV file without comments; names in the last comment above the numbers stay."""
    data = [line for line in lines if line.strip() and not line.startswith("#")]
    above = [line for line in lines[: lines.index(data[0])] if line.startswith("#")] if data else []
    try:
        float(data[0].split(",")[0]) if data else None
    except ValueError:
        return data
    return [above[-1].lstrip("# "), *data] if above and above[-1].count(",") == data[0].count(",") > 0 else data


def text_table(text: str, named: str, commas: bool, expected: str = "CSV or ECSV") -> Table:
    """Return the table in a text."""
    # Slow to import, and needed only here.
    from astropy.table import Table

    most = MOST_TEXT if commas or text.startswith("# %ECSV") else MOST_GUESSED
    if len(text) > most:
        raise InputError(f"{named} has {len(text)} characters", f"at most {most}", key="file", value=len(text))
    if text.startswith("# %ECSV"):
        return parse_ecsv(text, named)
    lines = _without_comments(text.splitlines()) if commas else text.splitlines()
    check_cells(lines, named)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read([*lines, ""], format="ascii.csv" if commas else "ascii")
