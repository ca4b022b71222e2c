"""Geometry of an orbit: the Earth, Sun and Moon, and times."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import erfa
import numpy as np
from numpy.typing import NDArray

from mauvecl.host.exposure.sky import parse_time
from mauvecl.host.tables.units import offline
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import DAY_S, Duration

if TYPE_CHECKING:
    from astropy.time import Time

#: Equatorial radius, km, and gravitational parameter, km^3 s^-2, of WGS 72, as SGP4 uses (Hoots & Roehrich 1980).
RADIUS_KM, GRAVITY = 6378.135, 398_600.8
#: Oblateness, WGS 72.
J2 = 1.082616e-3
#: Equatorial radius of WGS 84, km: radius of the sphere that defines the limb.
LIMB_KM = 6378.137

Vectors = NDArray[np.float64]


def unit(vectors: Vectors) -> Vectors:
    """Normalise vectors, shape (..., 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def direction(longitude_deg: NDArray[np.float64] | float, latitude_deg: NDArray[np.float64] | float) -> Vectors:
    """Return the unit vectors of longitudes and latitudes, or right ascensions and declinations, shape (..., 3)."""
    a, d = np.radians(longitude_deg), np.radians(latitude_deg)
    return np.stack(np.broadcast_arrays(np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)), axis=-1)


def to_j2000(midnight: float, days: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices from SGP4's frame (true equator, mean equinox of date) to J2000, shape (n, 3, 3).

    Precession and nutation of 1976 and 1980 (Vallado et al. 2006, AIAA 2006-6753) are computed once a day and
    interpolated linearly.
    """
    low, high = np.floor(days.min()), np.ceil(days.max()) + 1
    nodes = np.arange(low, high + 1)
    terrestrial = nodes + 69.2 / DAY_S
    of_date = erfa.pnm80(midnight, terrestrial)
    # Equation of the equinoxes: from the mean to the true equinox of date.
    turn = -np.asarray(erfa.eqeq94(midnight, terrestrial))
    zero, one = np.zeros_like(turn), np.ones_like(turn)
    spin = np.array([[np.cos(turn), np.sin(turn), zero], [-np.sin(turn), np.cos(turn), zero], [zero, zero, one]])
    at_nodes = np.einsum("nji,jkn->nik", of_date, spin)
    place = np.clip((days - low).astype(int), 0, nodes.size - 2)
    part = (days - low - place)[:, None, None]
    return np.asarray((1 - part) * at_nodes[place] + part * at_nodes[place + 1])


def subsatellite_point(
    position_km: Vectors, midnight: NDArray[np.float64], days: NDArray[np.float64]
) -> tuple[Vectors, Vectors]:
    """Return the geodetic longitude (-180 to 180) and latitude of the sub-satellite point, deg, shape (n,) each.

    Positions are in SGP4's frame, shape (n, 3), and `midnight` and `days` are parts of the Julian dates, UTC.
    """
    # The angle from SGP4's frame to the Earth-fixed frame.
    theta = erfa.gmst82(midnight, days)
    x = np.cos(theta) * position_km[:, 0] + np.sin(theta) * position_km[:, 1]
    y = -np.sin(theta) * position_km[:, 0] + np.cos(theta) * position_km[:, 1]
    longitude, latitude, _ = erfa.gc2gd(1, np.stack([x, y, position_km[:, 2]], axis=1) * 1e3)
    return np.degrees(longitude), np.degrees(latitude)


#: Radius of the Sun, km (IAU 2015 resolution B3).
SUN_KM = 695_700.0

Flags = NDArray[np.bool_]


def limb_angle_rad(position_km: Vectors) -> NDArray[np.float64]:
    """Return the angular radius of the Earth, a sphere of its equatorial radius, at the satellite, shape (n,)."""
    return np.asarray(np.arcsin(LIMB_KM / np.linalg.norm(position_km, axis=-1)))


def sunlight(position_km: Vectors, sun: Vectors, sun_km: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the fraction of the Sun's disk that the Earth does not hide, 0 to 1, shape (n,).

    The fraction is linear in angle between the two contacts of the penumbra, which are eight seconds apart.
    """
    distance = np.linalg.norm(position_km, axis=1)
    separation = np.arccos(np.clip(-np.einsum("ni,ni->n", position_km, sun) / distance, -1, 1))
    earth, disk = limb_angle_rad(position_km), np.arcsin(SUN_KM / sun_km)
    return np.asarray(np.clip((separation - earth + disk) / (2 * disk), 0, 1))


def in_polygon(longitude_deg: NDArray[np.float64], latitude_deg: NDArray[np.float64], corners: Vectors) -> Flags:
    """Return whether positions lie inside a polygon in the plane of longitude and latitude, deg, shape (n,).

    Longitudes may exceed 180 deg, and the polygon, of shape (m, 2) with its corners in order, may cross longitude 180.
    """
    # Longitudes are relative to the first corner.
    x = (longitude_deg - corners[0, 0] + 180) % 360 - 180
    around = np.concatenate([[0.0], np.cumsum((np.diff(corners[:, 0]) + 180) % 360 - 180)])
    inside = np.zeros(np.shape(x), bool)
    for turn in (-360.0, 0.0, 360.0):
        xs, ys = around + turn, corners[:, 1]
        for x1, y1, x2, y2 in zip(xs, ys, np.roll(xs, -1), np.roll(ys, -1), strict=True):
            if y1 == y2:
                continue
            crosses = (y1 > latitude_deg) != (y2 > latitude_deg)
            inside ^= crosses & (x < x1 + (latitude_deg - y1) / (y2 - y1) * (x2 - x1))
    return inside


#: Largest number of steps of a plan: eight years of minutes.
MAX_STEPS = 4_300_000


@validated
@dataclass(frozen=True)
class TimeGrid:
    """Evenly spaced times in UTC, which stands in for UT1 (they differ by less than a second).

    Raises InputError if the start is outside 1990-2100 or the number of steps is outside 1 to `MAX_STEPS`.
    """

    start: str  # ISO 8601, UTC
    days: Annotated[float, Unit("d"), Range(0, open_low=True)]  # length of the plan
    step_s: Duration = 60.0  # length of a step; conditions are evaluated at its middle

    def __post_init__(self) -> None:
        if not 1 <= self.n <= MAX_STEPS:
            raise InputError(
                f"{self.days:g} days in steps of {self.step_s:g} s must be 1 to {MAX_STEPS} steps, not "
                f"{self.days * DAY_S / self.step_s:.3g}",
                key="step_s",
            )
        _ = self.first  # raises InputError for an invalid start

    @property
    def n(self) -> int:
        """Number of steps; the last may be shorter than the others."""
        return int(np.ceil(self.days * DAY_S / self.step_s - 1e-9))

    @cached_property
    def first(self) -> tuple[float, float]:
        """Julian date of the start, UTC: the preceding midnight and the fraction of the day."""
        with offline():
            time = parse_time(self.start, "start")
            day, rest = float(time.utc.jd1), float(time.utc.jd2)
        midnight = np.floor(day - 0.5) + 0.5
        fraction = (day - midnight) + rest
        # Astropy's second part lies within half a day on either side.
        midnight += np.floor(fraction)
        return float(midnight), float(fraction - np.floor(fraction))

    @cached_property
    def seconds(self) -> NDArray[np.float64]:
        """Middles of the steps, s since the start, shape (n,)."""
        middles = np.asarray((np.arange(self.n, dtype=np.float64) + 0.5) * float(self.step_s))
        middles.setflags(write=False)
        return middles

    @property
    def julian(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Julian dates, UTC: the midnight before the start and the days since, shape (n,) each."""
        midnight, fraction = self.first
        return np.full(self.n, midnight, np.float64), np.asarray(fraction + self.seconds / DAY_S)

    def iso(self, seconds: float, digits: int = 0) -> str:
        """Return a time since the start in ISO 8601, UTC."""
        return utc_text(sum(self.first) + seconds / DAY_S, digits)


def as_time(midnight: float, days: NDArray[np.float64]) -> Time:
    """Return the times as astropy's; call inside `offline`."""
    from astropy.time import Time

    return Time(np.full(days.shape, midnight), days, format="jd", scale="utc")


def utc_text(julian: float, digits: int = 0) -> str:
    """Return a Julian date in ISO 8601, UTC, accurate to a tenth of a millisecond."""
    # Neither numpy's calendar nor these Julian dates count leap seconds.
    micro = round((julian - 2_440_587.5) * DAY_S * 10**digits) * 10 ** (6 - digits)
    text = str(np.datetime64(micro, "us"))
    return text[:19] if digits == 0 else text[: 20 + digits]


#: Days between computed positions. Cubic splines interpolate to 0.1 arcsec for the Sun and 1 arcsec for the Moon
#: (tested).
SUN_STEP_D, MOON_STEP_D = 0.5, 1 / 12


@dataclass(frozen=True, eq=False)
class Bodies:
    """Geocentric positions of Sun and Moon in the frame of star catalogues (J2000)."""

    # Unit vectors, shape (n, 3); the parallax at the satellite is below 10 arcsec.
    sun: Vectors
    sun_km: NDArray[np.float64]  # distance, shape (n,)
    # Shape (n, 3). The parallax reaches a degree: subtract the satellite's position to get its view.
    moon_km: Vectors
    ecliptic_pole: NDArray[np.float64]  # north pole at the middle of the plan, shape (3,)

    @classmethod
    def at(cls, times: TimeGrid) -> Bodies:
        """Compute the positions at the times of a plan."""
        from scipy.interpolate import CubicSpline

        midnight, days = times.first[0], times.julian[1]
        with offline():
            from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord, get_body, get_sun

            def between(step_d: float, body: str) -> Vectors:
                low = days[0] - step_d
                # One more node at either end, where a cubic spline is least accurate.
                nodes = low + step_d * np.arange(int(np.ceil((days[-1] - low) / step_d)) + 3)
                times = as_time(midnight, nodes)
                body_there = get_sun(times) if body == "sun" else get_body(body, times)
                return np.asarray(CubicSpline(nodes, body_there.cartesian.xyz.to_value("km").T)(days))

            sun, moon = between(SUN_STEP_D, "sun"), between(MOON_STEP_D, "moon")
            middle = as_time(midnight, days[[days.size // 2]])[0]
            pole = SkyCoord(lon=0, lat=90, unit="deg", frame=GeocentricTrueEcliptic(equinox=middle, obstime=middle))
            north = unit(pole.gcrs.cartesian.xyz.value)
        return cls(unit(sun), np.linalg.norm(sun, axis=1), moon, north)
