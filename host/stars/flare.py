"""Flares that are added to a star or replace part of its photosphere, and tables of flares."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.stars.bands import photons
from mauvecl.host.stars.flare_spectra import FlareSpectrum, blackbody
from mauvecl.host.tables.files import LARGEST, SMALLEST
from mauvecl.schema.errors import InputError, shortened, shown
from mauvecl.schema.fields import checked
from mauvecl.schema.physical import Amplitude, Temperature

if TYPE_CHECKING:
    from astropy.table import QTable, Table

Geometry = Literal["added", "replaces"]
Float = NDArray[np.float64]


def with_flare(
    nm: Float,
    flux_flam: Float,
    amplitude: float,
    spectrum: FlareSpectrum,
    band: str,
    geometry: Geometry,
    photosphere_k: float | None,
) -> tuple[Float, Float]:
    """Return wavelengths and flux of a flaring star, each of shape (n,); the spectrum may need more wavelengths.

    The flux is F + k B, as in the paper, if the light B of the flare is ``added`` to the star's, F. If it ``replaces``
    photosphere in a region of filling factor f = A / (R - 1), it is F (1 - f) + f R (N_F / N_B) B, where A is the
    amplitude, N are photons in the band and R is the ratio of the surface fluxes of flare and photosphere there.
    """
    checked(Amplitude, "flare amplitude", amplitude)
    light = added_light(nm, flux_flam, spectrum, band, geometry, photosphere_k)
    star, hot, ratio = light.star, light.flare, light.ratio
    grid, quiescent = _on_grid(nm, flux_flam, spectrum)
    body = spectrum.flux(grid)
    if spectrum.fixed_lines:
        lines = spectrum.flux_at_telescope(grid)
        rise = photons(grid, lines, band) / star
        if rise > amplitude:
            fault = f"flare amplitude must be at least {rise:g}, the rise by its lines in {band}, not {amplitude:g}"
            raise InputError(fault, key="flare_amplitude")
        return grid, quiescent + lines + (amplitude - rise) * star / hot * body
    if ratio is None:
        return grid, quiescent + amplitude * star / hot * body
    filling = amplitude / (ratio - 1.0)
    if filling > 1.0:
        fault = f"flare amplitude must be at most {ratio - 1.0:.3g} at {spectrum.describe()}, not {amplitude:g}"
        raise InputError(f"{fault}, which needs {filling:.2f} of the star's disc", key="flare_amplitude")
    return grid, quiescent * (1.0 - filling) + filling * ratio * star / hot * body


def _on_grid(nm: Float, flux_flam: Float, spectrum: FlareSpectrum) -> tuple[Float, Float]:
    """Return wavelengths that resolve both star and flare, and the star's flux there."""
    grid = spectrum.grid(nm)
    return grid, flux_flam if grid is nm else np.interp(grid, nm, flux_flam)


@dataclass(frozen=True)
class AddedLight:
    """Light that a flare of amplitude 1 adds to a star: `hot` times its spectrum less `lost` of the star."""

    star: float  # photons of the star in the band in which the amplitude is measured
    flare: float  # photons of the flare's spectrum there
    ratio: float | None = None  # surface flux of the flare there over that of the photosphere that it replaces

    @property
    def hot(self) -> float:
        """Multiple of the flare spectrum's flux."""
        return (1.0 if self.ratio is None else self.ratio / (self.ratio - 1.0)) * self.star / self.flare

    @property
    def lost(self) -> float:
        """Share of the star's own light."""
        return 0.0 if self.ratio is None else 1.0 / (self.ratio - 1.0)


def check_scales(spectrum: FlareSpectrum) -> None:
    """Raise InputError if some lines of a flare do not scale with its amplitude."""
    if spectrum.fixed_lines:
        needed = "must be given as a fraction of its continuum to scale with its amplitude"
        raise InputError(f"the lines of a flare of {spectrum.describe()} {needed}", key="lines")


def added_light(
    nm: Float, flux_flam: Float, spectrum: FlareSpectrum, band: str, geometry: Geometry, photosphere_k: float | None
) -> AddedLight:
    """Return the light of a flare of amplitude 1, without lines of a fixed flux; see `with_flare`.

    `with_flare` adds it times the amplitude, whose largest value it checks.
    """
    grid, quiescent = _on_grid(nm, flux_flam, spectrum)
    star = photons(grid, quiescent, band)
    if not star > 0.0:
        raise InputError(f"the star must have light in the band {band}, but has none", key="band")
    hot = photons(grid, spectrum.flux(grid), band)
    if not hot > 0.0:
        raise InputError(f"the flare, {spectrum.describe()}, needs light in the band {band} to be scaled", key="band")
    if geometry == "added":
        return AddedLight(star, hot)
    if photosphere_k is None:
        fault = "flare geometry 'replaces' needs a photosphere temperature, in K"
        raise InputError(fault, key="photosphere_temperature")
    if not spectrum.surface or spectrum.fixed_lines:
        fault = f"flare geometry must be 'added' with {spectrum.describe()}, since its surface flux is unknown"
        raise InputError(fault, key="flare_geometry")
    checked(Temperature, "photosphere temperature", photosphere_k)
    ratio = hot / photons(nm, blackbody(nm, photosphere_k), band)
    if ratio <= 1.0:
        photosphere = f"the {photosphere_k:g} K of the photosphere that it replaces"
        fault = f"flare temperature must be above {photosphere}, not {spectrum.describe()}"
        raise InputError(fault, key="flare_temperature")
    return AddedLight(star, hot, ratio)


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
    from mauvecl.host.tables.opening import read_table

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

    from mauvecl.host.tables.table import Rows

    if not isinstance(table, Table):
        table = Table.from_pandas(table)
    rows = Rows(table, name, "amplitude")
    amplitude, start, stop = map(rows.first, (AMPLITUDES, STARTS, STOPS))
    if amplitude is None:
        names = shown(", ".join(rows.names), 300)
        raise rows.error(f"it has the columns {names}, but needs one named {', '.join(AMPLITUDES)}", "amplitude")
    columns = {"amplitude": (amplitude, "1"), "start": (start, "d"), "stop": (stop, "d")}
    cells = [[rows.number(held, row, unit) for held, unit in columns.values()] for row in range(rows.n)]
    # AltaiPony's tables have an empty row for a star without flares.
    filled = [(row, *values) for row, values in enumerate(cells, 1) if any(value is not None for value in values)]
    if not 0 < len(filled) <= MAX_FLARES:
        raise rows.error(f"it must have 1 to {MAX_FLARES} flares, not {len(filled)}", "amplitude")
    for row, value, begin, end in filled:
        if value is None or not SMALLEST <= value <= LARGEST:
            given = "an empty cell" if value is None else f"{value:g}"
            raise rows.error(f"the amplitude in row {row} must be a rise above 0, not {given}", "amplitude")
        if begin is not None and end is not None and end < begin:
            raise rows.error(f"row {row} ends at {end:.10g} d, but must end after {begin:.10g} d", "stop")
    flares = QTable({"amplitude": [value for _, value, *_ in filled]})
    for place, (title, (held, unit)) in enumerate(columns.items(), 1):
        if title != "amplitude" and held is not None:
            flares[title] = np.array([values[place] for values in filled], float)
            flares[title].unit = unit
    flares.meta["comments"] = list(rows.unused([name for name in rows.names if name not in (amplitude, start, stop)]))
    flares["amplitude"].info.description = "relative rise above the quiescent flux, in the band of the light curve"
    return flares
