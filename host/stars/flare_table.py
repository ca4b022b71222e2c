"""Reader of flare tables, such as AltaiPony's, whose amplitudes a study can use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened, shown

from ..files.parsing import LARGEST, SMALLEST
from ..files.tables import read_table

if TYPE_CHECKING:
    from astropy.table import QTable, Table

#: Names of the column of the relative rise above the quiescent flux; AltaiPony's first.
AMPLITUDES = ("ampl_rec", "amplitude", "ampl", "amp", "peak_amplitude", "relative_amplitude")
#: Names of the columns of start and stop, days; AltaiPony's first.
STARTS, STOPS = ("tstart", "start", "t_start", "time_start"), ("tstop", "stop", "t_stop", "time_stop", "end")
#: Largest number of flares; results for more would be too many to read.
MAX_FLARES = 500


def read_flares(path: str | Path) -> QTable:
    """Read amplitudes, and times if present, from a table of flares.

    Parameters
    ----------
    path : str or Path
        CSV, ECSV or FITS file with a column named as in `AMPLITUDES`, in any case.

    Returns
    -------
    QTable
        ``amplitude``, and ``start`` and ``stop`` in days of the table's own time system.
    """
    return flares_of(read_table(path, "flare table"), shortened(Path(path).name))


def flares_of(table: Table | Any, name: str = "flare table") -> QTable:
    """Extract amplitudes and times from a table in memory; see `read_flares`.

    Parameters
    ----------
    table : Table or DataFrame
        An astropy table, or a DataFrame such as AltaiPony's ``flares``.
    name : str
        Name of the table in error messages.
    """
    from astropy.table import QTable, Table

    if not isinstance(table, Table):
        table = Table.from_pandas(table)
    lower = {str(column).strip().lower(): column for column in table.colnames}

    def column(names: tuple[str, ...], unit: str) -> np.ndarray | None:
        title = next((lower[one] for one in names if one in lower), None)
        return None if title is None else _numbers(table[title], f"{name}: the column {title!r}", unit)

    amplitudes = column(AMPLITUDES, "")
    if amplitudes is None:
        raise InputError(
            f"{name} has the columns {shown(', '.join(lower), 300)}",
            f"one named {', '.join(AMPLITUDES)}",
            key="amplitude",
            value=lower,
        )
    if not 0 < amplitudes.size <= MAX_FLARES:
        raise InputError(
            f"{name} holds {amplitudes.size} flares", f"1 to {MAX_FLARES}", key="amplitude", value=amplitudes.size
        )
    bad = ~((amplitudes >= SMALLEST) & (amplitudes <= LARGEST))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError.of("amplitude", amplitudes[row], "a relative rise above 0", where=f"{name}, flare {row}")
    flares = QTable({"amplitude": amplitudes})
    for title, names in (("start", STARTS), ("stop", STOPS)):
        times = column(names, "d")
        if times is not None:
            flares[title] = times
            flares[title].unit = "d"
    flares["amplitude"].info.description = "relative rise above the quiescent flux, in the band of the light curve"
    return flares


def _numbers(column: Any, named: str, unit: str) -> np.ndarray:
    """Return a column's numbers in a unit, which is also assumed if the column has none; masked values become NaN."""
    import astropy.units as u

    kind = np.asarray(column).dtype.kind if hasattr(column, "dtype") else "O"
    if kind not in "iuf" or np.ndim(column) != 1:
        raise InputError(f"{named} holds no plain numbers", "one number in each row", key=column.name)
    values: np.ndarray = np.ma.filled(np.ma.asarray(getattr(column, "value", column), float), np.nan)
    if getattr(column, "unit", None) is None:
        return np.asarray(values, float)
    try:
        return np.asarray((values * u.Unit(column.unit)).to_value(unit), float)
    except (u.UnitConversionError, TypeError, ValueError) as error:
        raise InputError(
            f"{named} has the unit {str(column.unit)!r}",
            unit or "none, since amplitudes are relative",
            key=column.name,
            value=column.unit,
        ) from error
