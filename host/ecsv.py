"""Tables of the instrument's description as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table


def read_ecsv(path: str | Path, what: str) -> Table:
    """An ECSV table, or one sentence that begins with what the file is.

    Raises
    ------
    InputError
        If the file is missing or is not such a table.
    """
    # Heavy to import, and needed only where an instrument is read.
    from astropy.table import Table

    try:
        return Table.read(path, format="ascii.ecsv")
    except FileNotFoundError:
        raise InputError(f"{what} {path} does not exist, expected an ECSV table") from None
    except Exception as error:  # the reader raises many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{what} {path} cannot be read ({reason}), expected an ECSV table") from None
