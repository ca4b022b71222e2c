"""Reader of flare tables, such as AltaiPony's, whose amplitudes a study can use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.schema.text import shortened, shown

from ..files.parsing import LARGEST, SMALLEST
from ..tables.opening import read_table
from ..tables.rows import Rows

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
        ``amplitude``, and ``start`` and ``stop`` in days of the table's own time system. Columns that are not used are
        named in ``meta["comments"]``.
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
    rows = Rows(table, name, "amplitude")
    amplitude, start, stop = map(rows.first, (AMPLITUDES, STARTS, STOPS))
    if amplitude is None:
        raise rows.error(
            f"has the columns {shown(', '.join(rows.names), 300)}", f"one named {', '.join(AMPLITUDES)}", "amplitude"
        )
    columns = {"amplitude": (amplitude, "1"), "start": (start, "d"), "stop": (stop, "d")}
    cells = [[rows.number(held, row, unit) for held, unit in columns.values()] for row in range(rows.n)]
    # AltaiPony's tables have an empty row for a star without flares.
    kept = [row for row, values in enumerate(cells) if any(value is not None for value in values)]
    if not 0 < len(kept) <= MAX_FLARES:
        raise rows.error(f"holds {len(kept)} flares", f"1 to {MAX_FLARES}", "amplitude", len(kept))
    for row in kept:
        value = cells[row][0]
        if value is None or not SMALLEST <= value <= LARGEST:
            shown_value = "no amplitude" if value is None else f"an amplitude of {value:g}"
            raise rows.error(f"row {row + 1} has {shown_value}", "a relative rise above 0", "amplitude", value)
    flares = QTable({"amplitude": [cells[row][0] for row in kept]})
    for place, (title, (held, unit)) in enumerate(columns.items()):
        if place and held is not None:
            flares[title] = np.array([cells[row][place] for row in kept], float)
            flares[title].unit = unit
    flares.meta["comments"] = list(rows.unused([name for name in rows.names if name not in (amplitude, start, stop)]))
    flares["amplitude"].info.description = "relative rise above the quiescent flux, in the band of the light curve"
    return flares
