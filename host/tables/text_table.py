"""Reader of small user tables: CSV, ECSV, or columns separated by blanks."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from mauvecl.host.files.parsing import parsing
from mauvecl.host.tables.ecsv import check_cells, parse_ecsv
from mauvecl.host.tables.missing import SPELT, is_missing
from mauvecl.host.tables.times import is_dated, time_unit
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table

#: Separators of cells in CSV; the one that is most frequent in the first line counts.
SEPARATORS = (",", ";", "\t")
_ZERO = re.compile(r"0\d+")
_LEADING_ZERO = re.compile(r"(?m)(?:^|[,;\t\s])\"?0\d+\"?\s*(?:$|[,;\t\s])")
#: Largest number of characters of a table of known format, and of one for which astropy tries about twenty formats.
MOST_TEXT, MOST_GUESSED = 64 * 2**20, 4 * 2**20


def text_of(content: bytes) -> str:
    """Decode text in UTF-8 or, with a byte-order mark, UTF-16."""
    # Editors on Windows start a file with a byte-order mark.
    code = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(code)
    except UnicodeDecodeError as error:
        if b"\0" in content[:4096]:
            raise InputError("is not text (it holds null bytes)", "text", key="file") from error
        line, odd = content[: error.start].count(b"\n") + 1, content[error.start]
        fault = f"is not text in UTF-8 (byte 0x{odd:02x} in line {line})"
        raise InputError(fault, "UTF-8: save it so", key="file", value=odd) from error
    if "\0" in text:
        raise InputError("is not text (it holds null bytes)", "text", key="file")
    return text


def number_in(cell: str) -> float:
    """Return the number in a cell, NaN for words such as "null"; raise ValueError for anything else."""
    cell = cell.strip().strip("\"'")
    if "_" in cell:
        raise ValueError(cell)
    try:
        return float(cell)
    except ValueError:
        if is_missing(cell):
            return float("nan")
        # Exponents of Fortran's double precision.
        return float(re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", cell))


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
    separator, units = "", []
    if commas:
        lines, separator = _of_csv(lines, named, first)
        if len(lines) > 2 and all(re.fullmatch(r"-+", cell) for cell in cells_of(lines[2], separator)):
            # VizieR writes units and dashes below the names.
            units, lines = cells_of(lines[1], separator), [lines[0], *lines[3:]]
        elif len(lines) > 2 and _are_units(cells_of(lines[1], separator), cells_of(lines[2], separator)):
            units, lines = cells_of(lines[1], separator), [lines[0], *lines[2:]]
    check_cells(lines, named)
    how: dict[str, Any] = {"delimiter": separator, "format": "ascii.csv"} if commas else {"format": "ascii"}
    zeros = _LEADING_ZERO.search(text) is not None
    if texts or zeros:
        names = cells_of(lines[0], separator)
        columns = zip(*(cells_of(line, separator) for line in lines[1:]), strict=False) if zeros else ()
        numbered = {name for name, cells in zip(names, columns, strict=False) if any(map(_ZERO.fullmatch, cells))}
        kept = [name for name in names if name.casefold() in texts or name in numbered]
        how["converters"] = dict.fromkeys(kept, str)
    with parsing(named, expected), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = Table.read([*lines, ""], fill_values=[(word, "0") for word in SPELT], **how)
        for name, unit in zip(table.colnames, units, strict=False):
            table[name].unit = unit.strip('"') or None
        return table


def is_csv(text: str) -> bool:
    """Return whether the rows of a text are divided by commas or semicolons, whatever the file is called."""
    rows = [line for line in text[:20_000].splitlines() if line.strip() and line[0] not in "#%!;"][1:50]
    separator = next((one for one in SEPARATORS[:2] if rows and all(one in row for row in rows)), "")
    # Decimal commas stand between columns that blanks divide.
    return bool(separator) and not any(re.search(r"\d\s+[-+.\d]", cell) for cell in cells_of(rows[0], separator)
                                       if not is_dated(cell))  # fmt: skip


def _of_csv(lines: list[str], named: str, first: int) -> tuple[list[str], str]:
    """Return the line of names and the rows of a CSV file, without comments, and the separator of cells.

    Names may be the last comment above the rows; without any, columns are called col1, col2 and so on. Raises
    InputError for the first row with another number of cells than the first line.
    """
    data = [line for line in lines if line.strip() and not line.startswith("#")]
    separator = max(SEPARATORS, key=lambda one: data[0].count(one) if data else 0)
    above = [line for line in lines[: lines.index(data[0])] if line.startswith("#")] if data else []
    if data and all(is_number(cell) for cell in cells_of(data[0], separator)):
        n = data[0].count(separator)
        alike = above and above[-1].count(separator) == n > 0
        names = above[-1].lstrip("# ") if alike else separator.join(f"col{k + 1}" for k in range(n + 1))
        data = [names, *data]
    rows = [row.rstrip(" ") for row in data[1:]] if len(data) > 1 and data[1].rstrip(" ").endswith(separator) else []
    if rows and all(row.endswith(separator) for row in rows):
        # The last separator ends the lines, unless it is that of an empty column which has a name.
        ends = data[0].rstrip(" ").endswith(separator)
        if ends or rows[0].count(separator) > data[0].count(separator):
            data = [data[0].rstrip(" ").removesuffix(separator), *(row.removesuffix(separator) for row in rows)]
    for number, line in enumerate(data, first):
        n, wanted = (one.count(separator) + 1 for one in (line, data[0]))
        if n != wanted and '"' not in line and '"' not in data[0]:
            # The file may be cut short.
            fault = f"{named} has {n} cells in row {number}"
            raise InputError(fault, f"{wanted} as in the first line", key="file", value=n)
    return data, separator


def _are_units(cells: list[str], below: list[str]) -> bool:
    """Return whether the cells below the names of columns are units of the numbers below them."""
    pairs = zip(cells, below, strict=False)
    return any(cells) and all(
        not cell or (is_number(number) and not is_number(cell) and _is_unit(cell)) for cell, number in pairs
    )


def _is_unit(text: str) -> bool:
    import astropy.units as u

    try:
        return time_unit(text) is not None or u.Unit(text) is not None
    except (ValueError, TypeError):
        return False


def cells_of(line: str, separator: str) -> list[str]:
    """Divide a line at a separator, by default at blanks, and remove the quotes of cells."""
    cells = (line.strip("|") if separator == "|" else line).split(separator or None)
    return [cell.strip().strip("\"'").strip() for cell in cells]


def is_number(cell: str) -> bool:
    """Return whether a cell is a number or a missing one."""
    try:
        number_in(cell)
    except ValueError:
        return False
    return True


def keywords_of(lines: Sequence[str]) -> dict[str, str]:
    """Return the keywords in the comments of a text file, as in ``# DATE-OBS = 2026-03-01T12:00:00``."""
    found = {}
    for line in lines:
        match = re.match(r"\s*[#%!;]+\s*([A-Za-z][\w .-]{0,40}?)\s*[=:]\s*(.*?)\s*(?:\s/\s.*)?$", line)
        if match:
            found[match[1]] = match[2].strip("\"'")
    return found
