"""Reader of small user tables: CSV, ECSV, or columns separated by blanks."""

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

#: Separators of cells in CSV; the one that is most frequent in the first line counts.
SEPARATORS = (",", ";", "\t")
#: Largest number of characters of a table of known format, and of one for which astropy tries about twenty formats.
MOST_TEXT, MOST_GUESSED = 64 * 2**20, 4 * 2**20


def read_text_table(path: str | Path, what: str) -> Table:
    """Read a table from a text file.

    Parameters
    ----------
    path : str or Path
        ECSV if its first line says so, CSV by its extension, otherwise columns separated by blanks; may be compressed.
    what : str
        Expected kind of file, for messages.
    """
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return text_table(as_text(unpacked(read_bytes(path, what), named), named), named, path.suffix.lower() == ".csv")


def _without_comments(lines: list[str]) -> list[str]:
    """Return the lines of a CSV file without comments; names in the last comment above the numbers stay."""
    data = [line for line in lines if line.strip() and not line.startswith("#")]
    above = [line for line in lines[: lines.index(data[0])] if line.startswith("#")] if data else []
    separator = _separator(data)
    try:
        float(data[0].split(separator)[0]) if data else None
    except ValueError:
        return data
    alike = above and above[-1].count(separator) == data[0].count(separator) > 0
    return [above[-1].lstrip("# "), *data] if alike else data


def _separator(lines: list[str]) -> str:
    """Return the separator of cells that is most frequent in the first line."""
    return max(SEPARATORS, key=lambda one: lines[0].count(one) if lines else 0)


def _check_lengths(lines: list[str], named: str, first: int) -> None:
    """Raise InputError for the first row with another number of cells than the first line, as if cut short."""
    separator = _separator(lines)
    for number, line in enumerate(lines, first):
        n, wanted = (one.count(separator) + 1 for one in (line, lines[0]))
        if n != wanted and '"' not in line and '"' not in lines[0]:
            raise InputError(
                f"{named} has {n} cells in row {number}", f"{wanted} as in the first line", key="file", value=n
            )


def text_table(text: str, named: str, commas: bool, expected: str = "CSV or ECSV", first: int = 0) -> Table:
    """Parse a table from text; `first` rows precede it, which messages count."""
    # The import is slow and only needed here.
    from astropy.table import Table

    most = MOST_TEXT if commas or text.startswith("# %ECSV") else MOST_GUESSED
    if len(text) > most:
        raise InputError(f"{named} has {len(text)} characters", f"at most {most}", key="file", value=len(text))
    if text.startswith("# %ECSV"):
        return parse_ecsv(text, named)
    lines = _without_comments(text.splitlines()) if commas else text.splitlines()
    check_cells(lines, named)
    if commas:
        _check_lengths(lines, named, first)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if commas:
            return Table.read([*lines, ""], format="ascii.csv", delimiter=_separator(lines))
        return Table.read([*lines, ""], format="ascii")
