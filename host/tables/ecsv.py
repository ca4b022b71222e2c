"""Reader of ECSV tables, which checks header and cells before astropy and YAML parse them."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.host.tables.files import LONGEST_LINE, as_text, limit_bytes, parsing, read_bytes, unpacked
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table
    from numpy.typing import NDArray

#: Largest number of values of a header with expanded aliases; a few KiB of aliases can expand to 1e9 values.
MOST_VALUES = 100_000
#: Largest number of characters of a header; YAML in pure Python takes half a minute for a megabyte.
MOST_HEADER = 256 * 2**10
#: A cell in quotes, and a quote that begins one; others are units, as in ``-3°00'00"``.
_QUOTED, _OPEN = re.compile(r'(?:^|(?<=[,;|\t ]))"(?:[^"]|"")*"(?=[,;|\t ]|$)'), re.compile(r'(?:^|[,;|\t ])"')


def read_ecsv(path: str | Path, what: str, expected: str = "an ECSV table") -> Table:
    """Read an ECSV file.

    Raises InputError if the file is missing, is not an ECSV table, or would expand far beyond its size.
    """
    return parse_ecsv(*_text_and_name(path, what), expected)


def parse_ecsv(text: str, what: str, expected: str = "an ECSV table") -> Table:
    """Parse ECSV text; `what` says where it is from and `expected` what it should be, for messages."""
    # These imports are slow and only needed here.
    from astropy.table import Table

    from mauvecl.host.tables.units import with_mission_formats

    lines = text.splitlines()
    check_header(lines, what)
    check_cells([line for line in lines if not line.startswith("#")], what)
    # Those of lightkurve have times in the days of the missions.
    with_mission_formats()
    with parsing(what, expected), warnings.catch_warnings():
        # astropy warns of many headers that it can read.
        warnings.simplefilter("ignore")
        # Passed as lines, because astropy takes a text of one line for a file name.
        return Table.read([*lines, ""], format="ascii.ecsv")


@dataclass(frozen=True, eq=False)
class Numbers:
    """Table of numbers."""

    columns: dict[str, NDArray[np.float64]]  # shape (n,) each
    #: Units of the columns; empty for a column without one.
    units: dict[str, str]
    meta: dict[str, Any]

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.columns[name]


def read_numbers(path: str | Path, what: str) -> Numbers:
    """Read an ECSV table of numbers; raise InputError if values are missing or not numeric, or as `read_ecsv`."""
    return parse_numbers(*_text_and_name(path, what))


def _text_and_name(path: str | Path, what: str) -> tuple[str, str]:
    """Read the text of a file, and return it with the file's name for messages."""
    path = Path(path)
    named = f"{what} {shortened(str(path))}"
    return as_text(unpacked(read_bytes(path, what), named), named), named


def parse_numbers(text: str, what: str) -> Numbers:
    """Parse a table of numbers from text, as `read_numbers`."""
    import numpy as np

    lines = text.splitlines()
    check_header(lines, what)
    numbers = _plain_numbers(lines)
    if numbers is not None:
        return numbers
    table = parse_ecsv(text, what)
    for name in table.colnames:
        if table[name].dtype.kind not in "iuf" or np.ma.is_masked(table[name]) or table[name].ndim != 1:
            raise InputError(f"{what}: {name} has missing or non-numeric values", "numbers", key=name)
    columns = {name: np.asarray(table[name], np.float64) for name in table.colnames}
    return Numbers(columns, {name: str(table[name].unit or "") for name in table.colnames}, dict(table.meta))


def _plain_numbers(lines: list[str]) -> Numbers | None:
    """Parse numbers separated by single blanks without importing astropy's tables; return None for anything else."""
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
    """Raise InputError if a header is longer than `MOST_HEADER` or its aliases expand to more than `MOST_VALUES`."""
    import yaml  # comes with astropy

    header = [line[2:] for line in lines if line.startswith("# ")]
    size = sum(map(len, header))
    if size > MOST_HEADER:
        raise InputError(f"{what} has a header of {size} characters", f"at most {MOST_HEADER}", key="file")
    if not any("*" in line for line in header):
        return
    sizes: dict[int, int] = {}

    def values(node: Any) -> int:
        # An alias repeats an object, which is counted once and multiplied.
        if id(node) not in sizes:
            # A node that contains itself would never end.
            sizes[id(node)] = MOST_VALUES
            inner = node.value if isinstance(node.value, list) else []
            flat = [one for pair in inner for one in (pair if isinstance(pair, tuple) else (pair,))]
            sizes[id(node)] = min(1 + sum(map(values, flat)), MOST_VALUES)
        return sizes[id(node)]

    with parsing(what, "an ECSV table"):
        root = yaml.compose("\n".join(header[1:]), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        unfolded = 0 if root is None else values(root)
    if unfolded >= MOST_VALUES:
        raise InputError(
            f"{what} has a header that expands to more than {MOST_VALUES} values", "fewer values", key="file"
        )


def check_cells(lines: list[str], what: str) -> None:
    """Raise InputError for rows that would need far more memory as a table than as text.

    All cells of a column have the width of the widest, so one long line among many raises InputError, as do cells that
    extend over several lines.
    """
    most = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    widest = max(map(len, lines), default=0)
    if widest * len(lines) > most:
        fault = f"{what} has a line of {widest} characters among {len(lines)}"
        limit = "MAUVECL_LARGEST_CONTENT_MIB"
        expected = f"less than {most >> 20} MiB together if each were as long; {limit} sets the limit"
        raise InputError(fault, expected, key=limit)
    if widest > LONGEST_LINE:
        fault = f"{what} has a line of {widest} characters"
        raise InputError(fault, f"at most {LONGEST_LINE}", key="file")
    odd = next((n for n, line in enumerate(lines, 1) if '"' in line and _OPEN.search(_QUOTED.sub("", line))), None)
    if odd is not None:
        raise InputError(f"{what} has a cell that extends beyond row {odd}", "one line per row", key="file")
