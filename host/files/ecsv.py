"""ECSV tables from outside: the header and the cells are looked at before astropy and YAML meet them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from .bounded import limit_bytes, read_bytes, shortened, unpacked
from .parsed import as_text, parsing

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table
    from numpy.typing import NDArray

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


@dataclass(frozen=True, eq=False)
class Numbers:
    """A table of numbers and nothing else.

    Attributes
    ----------
    columns : dict of str to ndarray of float64, shape (n,)
    units : dict of str to str
        Of the columns; empty for one without.
    meta : dict
    """

    columns: dict[str, NDArray[np.float64]]
    units: dict[str, str]
    meta: dict[str, Any]

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.columns[name]


def read_numbers(path: str | Path, what: str) -> Numbers:
    """An ECSV table whose columns are numbers, each there; errors as `read_ecsv`, and for any other column."""
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return parse_numbers(as_text(unpacked(read_bytes(path, what), named), named), named)


def parse_numbers(text: str, what: str) -> Numbers:
    """The numbers in a text, as `read_numbers`."""
    import numpy as np

    lines = text.splitlines()
    check_header(lines, what)
    numbers = _plain_numbers(lines)
    if numbers is not None:
        return numbers
    table = parse_ecsv(text, what)
    for name in table.colnames:
        if table[name].dtype.kind not in "iuf" or np.ma.is_masked(table[name]) or table[name].ndim != 1:
            raise InputError(f"{what}: {name} has missing or non-numeric values, expected numbers")
    columns = {name: np.asarray(table[name], np.float64) for name in table.colnames}
    return Numbers(columns, {name: str(table[name].unit or "") for name in table.colnames}, dict(table.meta))


def _plain_numbers(lines: list[str]) -> Numbers | None:
    """Numbers with spaces between them, without the time that astropy's tables take to load; None for anything else."""
    import numpy as np
    import yaml  # comes with astropy

    header, rows = [line[2:] for line in lines if line[:1] == "#"], [line for line in lines if line[:1] != "#"]
    try:
        said = yaml.load("\n".join(header[1:]), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        names = [one["name"] for one in said["datatype"]]
        numeric = all(one["datatype"][:3] in ("flo", "int", "uin") and "subtype" not in one for one in said["datatype"])
        if not numeric or "delimiter" in said or rows[0].split(" ") != names:
            return None
        values = np.array([row.split(" ") for row in rows[1:] if row], np.float64).reshape(-1, len(names))
        units = {one["name"]: str(one.get("unit", "")) for one in said["datatype"]}
        return Numbers(dict(zip(names, values.T.copy(), strict=True)), units, dict(said.get("meta") or {}))
    except (yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError):
        return None


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
        root = yaml.compose("\n".join(header[1:]), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
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
