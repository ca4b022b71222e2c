"""Where a target stands against the Sun: helio-ecliptic coordinates, without a download."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

#: Calendar years in which UTC and the ephemeris are good to far better than a cell of the zodiacal table.
YEARS = (1990, 2100)

#: Two plain numbers, such as "290.0 -11.2": degrees.
_DEGREES = re.compile(r"\s*([+-]?\d+(?:\.\d*)?)\s*[,\s]\s*[+-]?\d+(?:\.\d*)?\s*")


@dataclass(frozen=True)
class HelioEcliptic:
    """Position against the Sun, degrees.

    Attributes
    ----------
    longitude_deg : float
        Ecliptic longitude of the target minus that of the Sun, folded to 0-180.
    latitude_deg : float
        Absolute ecliptic latitude, 0-90.
    separation_deg : float
        Angle between target and Sun.
    """

    longitude_deg: float
    latitude_deg: float
    separation_deg: float


def helioecliptic(target: SkyCoord | str, time: Time | str) -> HelioEcliptic:
    """Helio-ecliptic coordinates of a target at a time.

    The true geocentric ecliptic of date, by astropy with its built-in ephemeris and leap seconds.

    Parameters
    ----------
    target : SkyCoord or str
        One position; a string is ICRS, two numbers in degrees ("290.0 -11.2") or sexagesimal hours and degrees.
    time : Time or str
        One time; a string is ISO 8601, UTC.

    Raises
    ------
    InputError
        If either cannot be understood, is not finite, is more than one, or lies outside 1990-2100.
    """
    with offline():
        from astropy.coordinates import GeocentricTrueEcliptic, get_sun

        moment = moment_of(time)
        position = position_of(target)
        frame = GeocentricTrueEcliptic(equinox=moment, obstime=moment)
        sun = get_sun(moment).transform_to(frame)
        try:
            star = position.transform_to(frame)
        except Exception:  # frames without a way to the ecliptic (AltAz without a place) raise many kinds
            raise InputError(
                f"target in the frame {position.frame.name!r} cannot be turned to the ecliptic, expected ICRS"
            ) from None
        difference = float((star.lon - sun.lon).wrap_at("180d").deg)
        longitude, latitude = abs(difference), float(star.lat.deg)
        sun_latitude = float(sun.lat.rad)
    cosine = np.sin(np.radians(latitude)) * np.sin(sun_latitude) + np.cos(np.radians(latitude)) * np.cos(
        sun_latitude
    ) * np.cos(np.radians(longitude))
    return HelioEcliptic(longitude, abs(latitude), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))


@contextmanager
def offline() -> Iterator[None]:
    """Astropy without the network and, for far years, without warnings; everything as before afterwards."""
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        # These imports look for leap seconds, so they come after the line above.
        from astropy.coordinates import solar_system_ephemeris

        # The ephemeris's own context manager is module-wide too, and restores what was set.
        with solar_system_ephemeris.set("builtin"), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*dubious year.*")
            warnings.filterwarnings("ignore", message=".*leap-second file is expired.*")
            yield


def moment_of(time: Time | str) -> Time:
    """One time between 1990 and 2100; text is ISO 8601, UTC. To be called inside `offline`.

    Raises
    ------
    InputError
        If it cannot be understood, is not finite, is more than one, or lies outside these years.
    """
    from astropy.time import Time

    expected = "expected a UTC time such as '2026-03-01T12:00:00'"
    if isinstance(time, str):
        try:
            moment = Time(time.strip().removesuffix("Z"), scale="utc")
        except ValueError:
            raise InputError(f"time = {time!r}, {expected}") from None
    elif isinstance(time, Time):
        moment = time
    else:
        raise InputError(f"time = {_line(time)}, {expected}")
    if not moment.isscalar:
        raise InputError(f"time holds {moment.size} times, expected one")
    if np.ma.is_masked(moment.jd) or not np.isfinite(moment.jd):
        raise InputError(f"time = {_line(time)} is not finite, {expected}")
    year = float(moment.decimalyear)
    if not YEARS[0] <= year < YEARS[1]:
        raise InputError(f"time = {moment.utc.isot}, expected between {YEARS[0]} and {YEARS[1]}")
    return moment


def position_of(target: SkyCoord | str) -> SkyCoord:
    """One position; text is ICRS, two numbers in degrees or sexagesimal hours and degrees.

    Raises
    ------
    InputError
        If it cannot be understood, is not finite, or is more than one.
    """
    import astropy.units as u
    from astropy.coordinates import SkyCoord
    from astropy.coordinates.baseframe import BaseCoordinateFrame

    expected = "expected right ascension and declination such as '290.0 -11.2' (degrees) or '19h22m00s -11d12m00s'"
    if isinstance(target, str):
        unit = u.deg if _in_degrees(target) else (u.hourangle, u.deg)
        try:
            position = SkyCoord(target.replace(",", " "), unit=unit)
        except (ValueError, TypeError, IndexError):
            raise InputError(f"target = {target!r}, {expected}") from None
    elif isinstance(target, SkyCoord | BaseCoordinateFrame):
        position = SkyCoord(target)
    else:
        raise InputError(f"target = {_line(target)}, {expected}")
    if not position.isscalar:
        raise InputError(f"target holds {position.size} positions, expected one")
    angles = position.spherical
    if not np.isfinite([angles.lon.deg, angles.lat.deg]).all():
        raise InputError(f"target = {_line(target)} is not finite, {expected}")
    return position


def _in_degrees(target: str) -> bool:
    """Whether a string is two plain numbers, degrees; astropy would wrap a right ascension of 700."""
    degrees = _DEGREES.fullmatch(target)
    if degrees and not 0 <= float(degrees[1]) <= 360:
        raise InputError(f"target = {target!r} has a right ascension of {degrees[1]}, expected 0 to 360 degrees")
    return degrees is not None


def _line(value: object) -> str:
    """An object as one line of a message."""
    return " ".join(repr(value).split())
