"""Flares that were found elsewhere: tables of AltaiPony, of lightkurve users, or one's own, as a study's amplitudes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    from astropy.table import QTable, Table

#: Columns that hold the relative rise above the quiescent flux; AltaiPony's first.
AMPLITUDES = ("ampl_rec", "amplitude", "ampl", "amp", "peak_amplitude", "relative_amplitude")
#: Where a flare begins and ends, days; AltaiPony's first.
STARTS, STOPS = ("tstart", "start", "t_start", "time_start"), ("tstop", "stop", "t_stop", "time_stop", "end")
#: More make a study that nobody reads.
MOST = 500


def read_flares(path: str | Path) -> QTable:
    """Amplitudes of a table of flares, with the times where it has them.

    Parameters
    ----------
    path : str or Path
        CSV, ECSV or FITS; a column named as in `AMPLITUDES`, in any case.

    Returns
    -------
    QTable
        ``amplitude``, and ``start`` and ``stop`` in days of the table's own clock.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no such column, none or too many flares, or an impossible amplitude.
    """
    from astropy.table import Table

    path = Path(path)
    if not path.is_file():
        raise InputError(f"flare table {str(path)!r} does not exist, expected CSV, ECSV or FITS")
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".fits": "fits"}
    try:
        table = Table.read(path, format=kinds.get(path.suffix.lower(), "ascii"))
    except Exception as error:  # astropy raises many kinds
        raise InputError(
            f"flare table {path.name} cannot be read ({str(error).splitlines()[0]}), expected CSV, ECSV or FITS"
        ) from error
    return flares_of(table, path.name)


def flares_of(table: Table | Any, name: str = "flare table") -> QTable:
    """The same of a table in memory: astropy's, or a DataFrame such as AltaiPony's ``flares``.

    Parameters
    ----------
    table : Table or DataFrame
    name : str
        For messages.

    Raises
    ------
    InputError
        As `read_flares`.
    """
    from astropy.table import QTable, Table

    if not isinstance(table, Table):
        table = Table.from_pandas(table)
    lower = {str(column).strip().lower(): column for column in table.colnames}

    def column(names: tuple[str, ...]) -> np.ndarray | None:
        found = next((lower[one] for one in names if one in lower), None)
        return None if found is None else np.ma.filled(np.ma.asarray(table[found], float), np.nan)

    amplitudes = column(AMPLITUDES)
    if amplitudes is None:
        raise InputError(f"{name} has the columns {', '.join(lower)}, expected one named {', '.join(AMPLITUDES)}")
    if not 0 < amplitudes.size <= MOST:
        raise InputError(f"{name} holds {amplitudes.size} flares, expected 1 to {MOST}")
    bad = ~(np.isfinite(amplitudes) & (amplitudes > 0))
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{name}: the amplitude of flare {row} is {amplitudes[row]:g}, expected a relative rise above 0"
        )
    found = QTable({"amplitude": amplitudes})
    for title, names in (("start", STARTS), ("stop", STOPS)):
        times = column(names)
        if times is not None:
            found[title] = times
            found[title].unit = "d"
    found["amplitude"].info.description = "relative rise above the quiescent flux, in the band of the light curve"
    return found
