"""Positions of Sun and Moon during a plan, from astropy's built-in ephemeris."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..tables.times import offline
from .earth import Vectors, unit
from .time_grid import TimeGrid, as_time

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
