"""The sky behind a target: zodiacal light, which the fibre collects over its whole field of view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Literal

import astropy.units as u
import numpy as np
from numpy.typing import NDArray

from ..arguments import public
from ..errors import InputError
from ..quantities import number
from .helioecliptic import HelioEcliptic, helioecliptic

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    from ..stars.source import Source

Lookup = Literal["bilinear", "nearest"]
#: Faintest and brightest sky that a user may set, V mag arcsec^-2: any sky from orbit lies well within.
RANGE_MAG_ARCSEC2 = (5.0, 35.0)


@public
@dataclass(frozen=True)
class Sky:
    """Zodiacal light of one brightness over the field of view.

    Attributes
    ----------
    surface_brightness : float or None
        V mag arcsec^-2 (Vega); None is no sky at all.
    description : str
        One line for reports.

    Examples
    --------
    >>> from mauvecl import Sky
    >>> round(Sky.at("290.68 +11.12", "2026-09-01T12:00").surface_brightness, 2)
    22.96
    """

    surface_brightness: float | None
    description: str

    @classmethod
    def none(cls) -> Sky:
        """No sky."""
        return cls(None, "no sky")

    @classmethod
    def of_brightness(cls, brightness: u.Quantity | float) -> Sky:
        """A fixed surface brightness.

        Parameters
        ----------
        brightness : Quantity or float
            V mag arcsec^-2.

        Raises
        ------
        InputError
            If it is not a finite number of mag arcsec^-2 between 5 and 35.
        """
        low, high = RANGE_MAG_ARCSEC2
        expected = f"a finite number of mag/arcsec2, {low:g} to {high:g}"
        value = number("sky brightness", brightness, "mag / arcsec2", low=low, high=high, expected=expected)
        return cls(value, f"fixed V = {value:.2f} mag/arcsec2")

    @classmethod
    def at(cls, target: SkyCoord | str, time: Time | str, lookup: Lookup = "bilinear") -> Sky:
        """Zodiacal light towards a target at a time, from the table of the MauveSim paper (COS Instrument Handbook).

        Between the cells of the table, which stand every 15 deg, magnitudes are interpolated bilinearly, or the nearest
        cell is read off as in the paper. Solar avoidance is the nearest cell's in both: the table gives no brightness
        for avoided cells, so where one borders on the point, the others share its weight. The sky there is up to some
        0.4 mag too faint; at the edge of the avoidance zone that is 0.1 DN/s per pixel.

        Parameters
        ----------
        target : SkyCoord or str
            One position; a string is ICRS, in degrees ("290.0 -11.2") or sexagesimal ("19h22m00s -11d12m00s").
        time : Time or str
            One time in 1990-2100; a string is ISO 8601, UTC.
        lookup : {"bilinear", "nearest"}

        Raises
        ------
        InputError
            If target or time cannot be used, or the target is in the solar avoidance zone; says how far the Sun is.
        """
        if lookup not in ("bilinear", "nearest"):
            raise InputError(f"lookup = {lookup!r}, expected 'bilinear' or 'nearest'")
        place = helioecliptic(target, time)
        brightness = zodiacal_brightness(place, lookup)
        return cls(
            brightness,
            f"zodiacal light V = {brightness:.2f} mag/arcsec2 at helio-ecliptic longitude "
            f"{place.longitude_deg:.1f} deg, latitude {place.latitude_deg:.1f} deg, "
            f"{place.separation_deg:.1f} deg from the Sun ({lookup})",
        )

    def total_magnitude(self, field_of_view_arcsec2: u.Quantity | float) -> float | None:
        """V of the whole field of view: V_zodi - 2.5 log10(area), or None without a sky."""
        area = number("field of view", field_of_view_arcsec2, "arcsec2", low=1e-6, high=1e12)
        if self.surface_brightness is None:
            return None
        return float(self.surface_brightness - 2.5 * np.log10(area))

    def spectrum(self, field_of_view_arcsec2: u.Quantity | float) -> Source | None:
        """Light of the whole field of view: the CALSPEC Sun at the total V, or None without a sky.

        The paper scales HD 87646, a G2V star; zodiacal light is scattered sunlight with little reddening.

        Parameters
        ----------
        field_of_view_arcsec2 : Quantity or float
            Solid angle, arcsec^2.
        """
        total = self.total_magnitude(field_of_view_arcsec2)
        return None if total is None else _sunlight(total)


@lru_cache(maxsize=16)
def _sunlight(magnitude: float) -> Source:
    # The library is read only when there is a sky.
    from ..stars.source import Source

    return Source.from_library("Sun").at_magnitude(magnitude)


@dataclass(frozen=True)
class ZodiacalTable:
    """The zodiacal table.

    Attributes
    ----------
    longitude_deg : ndarray, shape (13,)
        0 to 180 in equal steps.
    latitude_deg : ndarray, shape (7,)
        0 to 90 in the same steps.
    brightness : ndarray, shape (13, 7)
        V mag arcsec^-2; NaN is solar avoidance.
    """

    longitude_deg: NDArray[np.float64]
    latitude_deg: NDArray[np.float64]
    brightness: NDArray[np.float64]


@lru_cache(maxsize=1)
def zodiacal_table() -> ZodiacalTable:
    """The table of the MauveSim paper, from the file beside this module."""
    from astropy.table import Table

    path = resources.files(__package__).joinpath("zodiacal.ecsv")
    table = Table.read(path.read_text(encoding="utf-8"), format="ascii.ecsv")
    names = [name for name in table.colnames if name.startswith("latitude_")]
    cells = np.stack([np.ma.filled(np.ma.asarray(table[name]), np.nan) for name in names], axis=1)
    latitude = np.array([float(name.removeprefix("latitude_")) for name in names])
    return ZodiacalTable(np.asarray(table["longitude"], np.float64), latitude, cells.astype(np.float64))


def zodiacal_brightness(place: HelioEcliptic, lookup: Lookup = "bilinear") -> float:
    """V mag arcsec^-2 of the zodiacal light at a place; see `Sky.at`.

    Raises
    ------
    InputError
        If the nearest cell (of two as near, the one farther from the Sun) is one of solar avoidance.
    """
    table = zodiacal_table()
    step = table.longitude_deg[1] - table.longitude_deg[0]
    row, column = place.longitude_deg / step, place.latitude_deg / step
    nearest = float(table.brightness[int(np.floor(row + 0.5)), int(np.floor(column + 0.5))])
    if np.isnan(nearest):
        raise InputError(
            f"the Sun is {place.separation_deg:.1f} deg from the target (helio-ecliptic longitude "
            f"{place.longitude_deg:.1f} deg, latitude {place.latitude_deg:.1f} deg), expected it outside the zone of "
            "solar avoidance, some 50 deg"
        )
    if lookup == "nearest":
        return nearest
    i = min(int(row), table.longitude_deg.size - 2)
    j = min(int(column), table.latitude_deg.size - 2)
    along, across = row - i, column - j
    weights = np.outer([1 - along, along], [1 - across, across])
    corners = table.brightness[i : i + 2, j : j + 2]
    weights[np.isnan(corners)] = 0.0
    return float(np.sum(weights * np.nan_to_num(corners)) / weights.sum())
