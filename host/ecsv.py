"""Tables in ECSV: the instrument's description, kept stars, and spectra that users bring."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .bounded import read_bytes, shortened
from .errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table

#: Values that a header may hold once its aliases are written out: a few KiB of them can stand for 1e9.
MOST_VALUES = 100_000


def read_ecsv(path: str | Path, what: str) -> Table:
    """An ECSV table, or one sentence that begins with what the file is.

    Raises
    ------
    InputError
        If the file is missing or is not such a table.
    """
    path = Path(path)
    content = read_bytes(path, what)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{what} {path} cannot be read ({error.reason}), expected an ECSV table") from None
    return parse_ecsv(text, f"{what} {path}")


def parse_ecsv(text: str, what: str) -> Table:
    """An ECSV table from its text.

    Raises
    ------
    InputError
        If it is no such table, or its header unfolds to too much.
    """
    # Heavy to import, and needed only where a table is read.
    import warnings

    from astropy.table import Table

    try:
        _bounded_header(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return Table.read(text.splitlines(), format="ascii.ecsv")
    except InputError as error:
        raise InputError(f"{what} {error}") from None
    except Exception as error:  # the reader raises many kinds
        reason = shortened(str(error).splitlines()[0] if str(error) else type(error).__name__, 200)
        raise InputError(f"{what} cannot be read as ECSV ({reason}), expected an ECSV table") from None


def _bounded_header(text: str) -> None:
    """Refuse a header whose aliases stand for more values than a header has."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line[2:])
    if not any("*" in line for line in lines):
        return
    import yaml

    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        # Nodes that an alias repeats are one object, counted once and multiplied.
        if id(node) not in sizes:
            # A node inside itself has no end.
            sizes[id(node)] = MOST_VALUES
            inner = node.value if isinstance(node.value, list) else []
            flat = [one for pair in inner for one in (pair if isinstance(pair, tuple) else (pair,))]
            sizes[id(node)] = min(1 + sum(map(size, flat)), MOST_VALUES)
        return sizes[id(node)]

    root = yaml.compose("\n".join(lines[1:]), Loader=yaml.SafeLoader)
    if root is not None and size(root) >= MOST_VALUES:
        raise InputError(f"has a header that unfolds to more than {MOST_VALUES} values, expected fewer")
