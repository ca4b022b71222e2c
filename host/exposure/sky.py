"""Light of the sky, which the fibre collects over its whole field of view: zodiacal light by position and time."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.stars.library import by_key, name_key, near_names
from mauvecl.host.tables.names import EXPECTED_POSITION
from mauvecl.host.tables.names import position as coordinates
from mauvecl.host.tables.units import offline
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import SkyBrightness, SolidAngle

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    from mauvecl.host.stars.source import Source

#: Calendar years in which errors of UTC and ephemeris are far smaller than a cell of the zodiacal table.
YEARS = (1990, 2100)


def helioecliptic(target: SkyCoord | str, time: Time | str) -> tuple[float, float, float]:
    """Return a target's position relative to the Sun in the true geocentric ecliptic of date, deg.

    It is the absolute difference of their longitudes, 0-180, the absolute latitude, and the angle between them. The
    arguments are those of `Sky.at`.
    """
    with offline():
        from astropy.coordinates import GeocentricTrueEcliptic, get_sun

        moment = parse_time(time)
        position = parse_position(target)
        frame = GeocentricTrueEcliptic(equinox=moment, obstime=moment)
        sun = get_sun(moment).transform_to(frame)
        try:
            star = position.transform_to(frame)
        except Exception:  # frames that cannot be transformed (AltAz without a location) raise many kinds
            fault = f"target in the frame {position.frame.name!r} cannot be turned to the ecliptic; use ICRS"
            raise InputError(fault, key="target") from None
        difference = float((star.lon - sun.lon).wrap_at("180d").deg)
        return abs(difference), abs(float(star.lat.deg)), float(star.separation(sun).deg)


def parse_time(time: Time | str, name: str = "time") -> Time:
    """Return a single finite time between 1990 and 2100; text is ISO 8601, UTC. Call inside `offline`.

    The time is called `name` in errors.
    """
    from astropy.time import Time

    expected = "a UTC time such as '2026-03-01T12:00:00'"
    moment = time
    if isinstance(moment, str):
        with contextlib.suppress(ValueError):
            moment = Time(moment.strip().removesuffix("Z"), scale="utc")
    if isinstance(moment, Time) and not moment.isscalar:
        raise InputError(f"{name} must be a single time, but holds {moment.size} times", key=name)
    if not isinstance(moment, Time) or np.ma.is_masked(moment.jd) or not np.isfinite(moment.jd):
        raise InputError.of(name, time, expected)
    year = float(moment.decimalyear)
    if not YEARS[0] <= year < YEARS[1]:
        raise InputError.of(name, moment.utc.isot, f"between {YEARS[0]} and {YEARS[1]}")
    return moment


def parse_position(target: SkyCoord | str) -> SkyCoord:
    """Return a single finite position; text is a name, or ICRS in degrees or sexagesimal hours and degrees."""
    from astropy.coordinates import SkyCoord
    from astropy.coordinates.baseframe import BaseCoordinateFrame

    expected = EXPECTED_POSITION
    if isinstance(target, str):
        star = by_key().get(name_key(target))
        if star is not None:
            return SkyCoord(star.ra_deg, star.dec_deg, unit="deg")
        try:
            return SkyCoord(*coordinates(target), unit="deg")
        except InputError as error:
            if not re.match(r"\s*[^\W\d]", target):
                raise
            expected = f"a name such as {', '.join(near_names(target, stars_only=True))}, or {expected}"
            raise InputError.of("target", target, expected) from error
    if not isinstance(target, SkyCoord | BaseCoordinateFrame):
        raise InputError.of("target", target, expected)
    position = SkyCoord(target)
    if not position.isscalar:
        raise InputError(f"target must be a single position, but holds {position.size} positions", key="target")
    angles = position.spherical
    if not np.isfinite([angles.lon.deg, angles.lat.deg]).all():
        raise InputError.of("target", target, expected)
    return position


Lookup = Literal["bilinear", "nearest"]


@validated
@dataclass(frozen=True)
class Sky:
    """Zodiacal light of uniform surface brightness.

    Examples
    --------
    >>> from mauvecl import Sky
    >>> round(Sky.at("290.68 +11.12", "2026-09-01T12:00").surface_brightness, 2)
    22.96
    """

    surface_brightness: SkyBrightness | None  #: V mag arcsec^-2 (Vega); None means no sky.
    description: str  #: Origin of the value, for reports.

    @classmethod
    def none(cls) -> Sky:
        """Return a sky without light."""
        return cls(None, "no sky")

    @classmethod
    def of_brightness(cls, brightness: SkyBrightness) -> Sky:
        """Return a sky of fixed surface brightness.

        Parameters
        ----------
        brightness : Quantity or float
            V mag arcsec^-2, 5 to 35.
        """
        return cls(brightness, f"fixed V = {brightness:.2f} mag/arcsec2")

    @classmethod
    def at(cls, target: SkyCoord | str, time: Time | str, lookup: Lookup = "bilinear") -> Sky:
        """Return the zodiacal light towards a target, from the table of the MauveSim paper (COS Instrument Handbook).

        The table has a cell every 15 deg. Magnitudes are interpolated bilinearly, or taken from the nearest cell as in
        the paper. Cells in the solar avoidance zone have no value: the other corners share their weight, which makes
        the sky next to the zone up to 0.4 mag too faint (0.1 DN/s per pixel). Raises InputError if the nearest cell is
        in the zone.

        Parameters
        ----------
        target : SkyCoord or str
            Single position; a string is a well-known star ("AU Mic"), or ICRS in degrees ("290.0 -11.2") or sexagesimal
            ("19h22m00s -11d12m00s").
        time : Time or str
            Single time in 1990-2100; a string is ISO 8601, UTC.
        lookup : {"bilinear", "nearest"}
        """
        longitude, latitude, separation = helioecliptic(target, time)
        brightness = zodiacal_brightness(longitude, latitude, separation, lookup)
        return cls(
            brightness,
            f"zodiacal light V = {brightness:.2f} mag/arcsec2 at helio-ecliptic longitude {longitude:.1f} deg, "
            f"latitude {latitude:.1f} deg, {separation:.1f} deg from the Sun ({lookup})",
        )

    def total_magnitude(self, field_of_view_arcsec2: SolidAngle) -> float | None:
        """Return the V magnitude of the whole field of view, or None without a sky."""
        if self.surface_brightness is None:
            return None
        return float(self.surface_brightness - 2.5 * np.log10(field_of_view_arcsec2))

    def spectrum(self, field_of_view_arcsec2: SolidAngle) -> Source | None:
        """Return the spectrum of the whole field of view, or None without a sky.

        Zodiacal light is scattered sunlight with little reddening, so the spectrum is that of the Sun (CALSPEC) at the
        total magnitude. The paper uses HD 87646, a G2V star.

        Parameters
        ----------
        field_of_view_arcsec2 : Quantity or float
            Solid angle, arcsec^2.
        """
        total = self.total_magnitude(field_of_view_arcsec2)
        return None if total is None else _sunlight(total)


@lru_cache(maxsize=16)
def _sunlight(magnitude: float) -> Source:
    # A sky without light does not need the library.
    from mauvecl.host.stars.source import Source

    return Source.from_library("Sun").at_magnitude(magnitude)


#: Steps of helio-ecliptic longitude and latitude in the table of the zodiacal light, deg.
STEP_DEG = 15.0


@lru_cache(maxsize=1)
def zodiacal_table() -> NDArray[np.float64]:
    """Return the table of the MauveSim paper, V mag arcsec^-2; NaN in the solar avoidance zone.

    Rows are longitudes from 0 to 180 deg, columns are latitudes from 0 to 90 deg.
    """
    from astropy.table import Table

    path = resources.files(__package__).joinpath("zodiacal.ecsv")
    table = Table.read(path.read_text(encoding="utf-8"), format="ascii.ecsv")
    names = [name for name in table.colnames if name.startswith("latitude_")]
    return np.stack([np.ma.filled(np.ma.asarray(table[name], np.float64), np.nan) for name in names], axis=1)


def zodiacal_brightness(
    longitude_deg: float, latitude_deg: float, separation_deg: float, lookup: Lookup = "bilinear"
) -> float:
    """Return the surface brightness of the zodiacal light at a position of `helioecliptic`, V mag arcsec^-2.

    Raises InputError if the nearest cell (of two equally near, the one farther from the Sun) is in the solar avoidance
    zone.
    """
    table = zodiacal_table()
    row, column = longitude_deg / STEP_DEG, latitude_deg / STEP_DEG
    nearest = float(table[int(np.floor(row + 0.5)), int(np.floor(column + 0.5))])
    if np.isnan(nearest):
        place = f"helio-ecliptic longitude {longitude_deg:.1f} deg, latitude {latitude_deg:.1f} deg"
        fault = f"the Sun is {separation_deg:.1f} deg from the target ({place})"
        needed = "which must be outside the zone of solar avoidance, some 50 deg"
        raise InputError(f"{fault}, {needed}", key="target")
    if lookup == "nearest":
        return nearest
    i, j = (min(int(at), size - 2) for at, size in zip((row, column), table.shape, strict=True))
    along, across = row - i, column - j
    weights = np.outer([1 - along, along], [1 - across, across])
    corners = table[i : i + 2, j : j + 2]
    weights[np.isnan(corners)] = 0.0
    return float(np.sum(weights * np.nan_to_num(corners)) / weights.sum())
