"""Reader of small user tables: CSV, ECSV, or columns separated by blanks."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import as_text, parsing
from ..files.size_limits import read_bytes, unpacked
from .ecsv import check_cells, parse_ecsv

if TYPE_CHECKING:
    from astropy.table import Table

#: Separators of cells in CSV; the one that is most frequent in the first line counts.
SEPARATORS = (",", ";", "\t")
#: Cells without a value, as archives and programs write them; an empty cell has none in any case.
MISSING = tuple(
    spelt for word in ("", "null", "none", "n/a", "na", "--", "-", "...", "masked", "indef", "<na>")
    for spelt in dict.fromkeys((word, word.upper(), word.capitalize()))
)  # fmt: skip
_ZERO = re.compile(r"0\d+")
_LEADING_ZERO = re.compile(r"(?m)(?:^|[,;\t\s])\"?0\d+\"?\s*(?:$|[,;\t\s])")
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


def text_table(
    text: str, named: str, commas: bool, expected: str = "CSV or ECSV", first: int = 0, texts: Collection[str] = ()
) -> Table:
    """Parse a table from text.

    Parameters
    ----------
    commas : bool
        Whether it is CSV; otherwise columns are separated by blanks.
    first : int
        Rows that precede it, which messages count.
    texts : collection of str
        Names of columns, in lower case, whose cells stay text, such as "0012"; others do so only with leading zeros.
    """
    # The import is slow and only needed here.
    from astropy.table import Table

    most = MOST_TEXT if commas or text.startswith("# %ECSV") else MOST_GUESSED
    if len(text) > most:
        raise InputError(f"{named} has {len(text)} characters", f"at most {most}", key="file", value=len(text))
    if text.startswith("# %ECSV"):
        return parse_ecsv(text, named)
    lines = text.splitlines()
    separator = ""
    if commas:
        lines, separator = _of_csv(lines, named, first)
    check_cells(lines, named)
    how: dict[str, Any] = {"delimiter": separator, "format": "ascii.csv"} if commas else {"format": "ascii"}
    zeros = _LEADING_ZERO.search("\n".join(lines[1:])) is not None
    if texts or zeros:
        names = [cell.strip().strip("\"'") for cell in (lines[0].split(separator) if separator else lines[0].split())]
        columns = zip(*(_cells(line, separator) for line in lines[1:]), strict=False) if zeros else ()
        numbered = {name for name, cells in zip(names, columns, strict=False) if any(map(_ZERO.fullmatch, cells))}
        kept = [name for name in names if name.casefold() in texts or name in numbered]
        how["converters"] = dict.fromkeys(kept, str)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Table.read([*lines, ""], fill_values=[(word, "0") for word in MISSING], **how)


def _of_csv(lines: list[str], named: str, first: int) -> tuple[list[str], str]:
    """Return the line of names and the rows of a CSV file, without comments, and the separator of cells.

    Names may be the last comment above the rows; without any, columns are called col1, col2 and so on.
    """
    data = [line for line in lines if line.strip() and not line.startswith("#")]
    separator = max(SEPARATORS, key=lambda one: data[0].count(one) if data else 0)
    above = [line for line in lines[: lines.index(data[0])] if line.startswith("#")] if data else []
    if data and all(is_number(cell) for cell in _cells(data[0], separator)):
        n = data[0].count(separator)
        alike = above and above[-1].count(separator) == n > 0
        names = above[-1].lstrip("# ") if alike else separator.join(f"col{k + 1}" for k in range(n + 1))
        data = [names, *data]
    _check_lengths(data, separator, named, first)
    return [line.rstrip().removesuffix(separator) for line in data] if _ends(data[1:], separator) else data, separator


def _ends(rows: list[str], separator: str) -> bool:
    """Return whether each row ends with a separator, so that its last cell is none."""
    return bool(rows) and all(row.rstrip(" ").endswith(separator) for row in rows)


def _cells(line: str, separator: str) -> list[str]:
    cells = line.split(separator) if separator else line.split()
    return [cell.strip().strip("\"'") for cell in cells]


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or a missing one."""
    if cell in MISSING or cell.lower() in ("nan", "inf", "-inf"):
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _check_lengths(lines: list[str], separator: str, named: str, first: int) -> None:
    """Raise InputError for the first row with another number of cells than the first line, as if cut short."""
    # Rows may all end with a separator, with or without one at the end of the names.
    more = int(_ends(lines[1:], separator) and not _ends(lines[:1], separator))
    for number, line in enumerate(lines, first):
        wanted = lines[0].count(separator) + 1 + (more if line is not lines[0] else 0)
        n = line.count(separator) + 1
        if n != wanted and '"' not in line and '"' not in lines[0]:
            raise InputError(
                f"{named} has {n} cells in row {number}", f"{wanted} as in the first line", key="file", value=n
            )


def keywords_of(lines: Sequence[str]) -> dict[str, str]:
    """Return the keywords in the comments of a text file, as in ``# DATE-OBS = 2026-03-01T12:00:00``."""
    found = {}
    for line in lines:
        match = re.match(r"\s*[#%!;]+\s*([A-Za-z][\w .-]{0,40}?)\s*[=:]\s*(.*?)\s*(?:\s/\s.*)?$", line)
        if match:
            found[match[1]] = match[2].strip("\"'")
    return found
