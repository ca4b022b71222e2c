"""ECSV tables from outside: the header and the cells are looked at before astropy and YAML meet them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from .bounded import limit_bytes, read_bytes, shortened, unpacked
from .parsed import as_text, parsing

if TYPE_CHECKING:
    from astropy.table import Table

#: Values that a header may hold once its aliases are written out: a few KiB of them can stand for 1e9.
MOST_VALUES = 100_000
#: Bytes of a header: YAML in plain Python reads a megabyte in half a minute.
MOST_HEADER = 256 * 2**10


def read_ecsv(path: str | Path, what: str, expected: str = "an ECSV table") -> Table:
    """An ECSV table, or one sentence that begins with what the file is.

    Raises
    ------
    InputError
        If the file is missing, is not such a table, or is one that would unpack to more than it shows.
    """
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return parse_ecsv(as_text(unpacked(read_bytes(path, what), named), named), named, expected)


def parse_ecsv(text: str, what: str, expected: str = "an ECSV table") -> Table:
    """The table in a text.

    Parameters
    ----------
    text : str
    what : str
        What holds it, with its name, for messages.
    expected : str

    Raises
    ------
    InputError
        As `read_ecsv`.
    """
    # Heavy to import, and needed only where a table is read.
    from astropy.table import Table

    lines = text.splitlines()
    check_header(lines, what)
    check_cells([line for line in lines if not line.startswith("#")], what)
    with parsing(what, expected), warnings.catch_warnings():
        # What astropy reads all the same.
        warnings.simplefilter("ignore")
        # Lines, since a text of one line would be taken for a file's name.
        return Table.read([*lines, ""], format="ascii.ecsv")


def check_header(lines: list[str], what: str) -> None:
    """Refuse a header that is long, or whose aliases stand for more values than a header has.

    Raises
    ------
    InputError
        If it is longer than `MOST_HEADER`, or unfolds to more than `MOST_VALUES`.
    """
    import yaml  # comes with astropy

    header = [line[2:] for line in lines if line.startswith("# ")]
    size = sum(map(len, header))
    if size > MOST_HEADER:
        raise InputError(f"{what} has a header of {size} characters, expected at most {MOST_HEADER}")
    if not any("*" in line for line in header):
        return
    sizes: dict[int, int] = {}

    def values(node: Any) -> int:
        # Nodes that an alias repeats are one object, counted once and multiplied.
        if id(node) not in sizes:
            # A node inside itself has no end.
            sizes[id(node)] = MOST_VALUES
            inner = node.value if isinstance(node.value, list) else []
            flat = [one for pair in inner for one in (pair if isinstance(pair, tuple) else (pair,))]
            sizes[id(node)] = min(1 + sum(map(values, flat)), MOST_VALUES)
        return sizes[id(node)]

    with parsing(what, "an ECSV table"):
        root = yaml.compose("\n".join(header[1:]), Loader=yaml.SafeLoader)
        unfolded = 0 if root is None else values(root)
    if unfolded >= MOST_VALUES:
        raise InputError(f"{what} has a header that unfolds to more than {MOST_VALUES} values, expected fewer")


def check_cells(lines: list[str], what: str) -> None:
    """Refuse rows that would take far more room as a table than as text: each cell is as wide as the widest.

    Raises
    ------
    InputError
        If the widest line times the number of lines is beyond the limit of unpacked content, or a cell goes on over
        several lines.
    """
    most = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    widest = max(map(len, lines), default=0)
    if widest * len(lines) > most:
        raise InputError(
            f"{what} has a line of {widest} characters among {len(lines)}, expected less than {most >> 20} MiB "
            "together if each were as long; MAUVECL_LARGEST_CONTENT_MIB sets the limit"
        )
    if widest > 2**17:
        raise InputError(f"{what} has a line of {widest} characters, expected at most {2**17}")
    odd = next((number for number, line in enumerate(lines, 1) if line.count('"') % 2), None)
    if odd is not None:
        raise InputError(f"{what} has a cell that goes on beyond row {odd}, expected each row on a line of its own")
