"""Helio-ecliptic coordinates of a target, without downloads."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.schema.errors import InputError

from ..stars.star_names import near_names
from ..stars.well_known import by_key, name_key
from ..tables.coordinates import EXPECTED
from ..tables.coordinates import position as coordinates
from ..tables.times import offline

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

#: Calendar years in which errors of UTC and ephemeris are far smaller than a cell of the zodiacal table.
YEARS = (1990, 2100)


@dataclass(frozen=True)
class HelioEcliptic:
    """Ecliptic position relative to the Sun."""

    longitude_deg: float  # absolute difference of the target's and the Sun's ecliptic longitudes, 0-180
    latitude_deg: float  # absolute ecliptic latitude, 0-90
    separation_deg: float  # angle between target and Sun


def helioecliptic(target: SkyCoord | str, time: Time | str) -> HelioEcliptic:
    """Return the helio-ecliptic coordinates of a target, in the true geocentric ecliptic of date.

    Parameters
    ----------
    target : SkyCoord or str
        Single position; a string is a well-known star, or ICRS in degrees ("290.0 -11.2") or sexagesimal hours and
        degrees.
    time : Time or str
        Single time within 1990-2100; a string is ISO 8601, UTC.
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
            raise InputError(
                f"target in the frame {position.frame.name!r} cannot be turned to the ecliptic",
                "ICRS",
                key="target",
                value=position.frame.name,
            ) from None
        difference = float((star.lon - sun.lon).wrap_at("180d").deg)
        longitude, latitude = abs(difference), float(star.lat.deg)
        sun_latitude = float(sun.lat.rad)
    cosine = np.sin(np.radians(latitude)) * np.sin(sun_latitude) + np.cos(np.radians(latitude)) * np.cos(
        sun_latitude
    ) * np.cos(np.radians(longitude))
    return HelioEcliptic(longitude, abs(latitude), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def parse_time(time: Time | str) -> Time:
    """Return a single finite time between 1990 and 2100; text is ISO 8601, UTC. Call inside `offline`."""
    from astropy.time import Time

    expected = "a UTC time such as '2026-03-01T12:00:00'"
    if isinstance(time, str):
        try:
            moment = Time(time.strip().removesuffix("Z"), scale="utc")
        except ValueError:
            raise InputError.of("time", time, expected) from None
    elif isinstance(time, Time):
        moment = time
    else:
        raise InputError.of("time", time, expected)
    if not moment.isscalar:
        raise InputError(f"time holds {moment.size} times", "one", key="time", value=time)
    if np.ma.is_masked(moment.jd) or not np.isfinite(moment.jd):
        raise InputError.of("time", time, expected)
    year = float(moment.decimalyear)
    if not YEARS[0] <= year < YEARS[1]:
        raise InputError.of("time", moment.utc.isot, f"between {YEARS[0]} and {YEARS[1]}")
    return moment


def parse_position(target: SkyCoord | str) -> SkyCoord:
    """Return a single finite position; text is a name, or ICRS in degrees or sexagesimal hours and degrees."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord
    from astropy.coordinates.baseframe import BaseCoordinateFrame

    expected = EXPECTED
    if isinstance(target, str):
        star = by_key().get(name_key(target))
        if star is not None:
            return SkyCoord(star.ra_deg, star.dec_deg, unit=u.deg)
        try:
            return SkyCoord(*coordinates(target), unit=u.deg)
        except InputError as error:
            if not re.match(r"\s*[^\W\d]", target):
                raise
            expected = f"a name such as {', '.join(near_names(target, stars_only=True))}, or {expected}"
            raise InputError.of("target", target, expected) from error
    if isinstance(target, SkyCoord | BaseCoordinateFrame):
        position = SkyCoord(target)
    else:
        raise InputError.of("target", target, expected)
    if not position.isscalar:
        raise InputError(f"target holds {position.size} positions", "one", key="target", value=target)
    angles = position.spherical
    if not np.isfinite([angles.lon.deg, angles.lat.deg]).all():
        raise InputError.of("target", target, expected)
    return position
