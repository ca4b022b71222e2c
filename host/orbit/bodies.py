"""Sun and Moon over a plan, by astropy's built-in ephemeris: no download."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..sky.helioecliptic import offline
from .earth import Vectors, unit
from .moments import Moments, as_time

#: Days between the places that are computed; a cubic goes between them (to 0.1 arcsec for the Sun, 1 arcsec for the
#: Moon, tested).
SUN_STEP_D, MOON_STEP_D = 0.5, 1 / 12


@dataclass(frozen=True, eq=False)
class Bodies:
    """Sun and Moon as seen from the Earth's centre, in the frame of star catalogues.

    Attributes
    ----------
    sun : ndarray, shape (n, 3)
        Unit vectors. From the satellite the Sun is at most 10 arcsec elsewhere.
    sun_km : ndarray, shape (n,)
        Distance.
    moon_km : ndarray, shape (n, 3)
        From the satellite the Moon is up to a degree elsewhere: the satellite's place is to be taken off.
    ecliptic_pole : ndarray, shape (3,)
        North pole of the ecliptic at the middle of the plan.
    """

    sun: Vectors
    sun_km: NDArray[np.float64]
    moon_km: Vectors
    ecliptic_pole: NDArray[np.float64]

    @classmethod
    def at(cls, moments: Moments) -> Bodies:
        """At the times of a plan."""
        from scipy.interpolate import CubicSpline

        midnight, days = moments.first[0], moments.julian[1]
        with offline():
            from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord, get_body, get_sun

            def between(step_d: float, body: str) -> Vectors:
                low = days[0] - step_d
                # One step more at either end: a cubic is poorest there.
                nodes = low + step_d * np.arange(int(np.ceil((days[-1] - low) / step_d)) + 3)
                times = as_time(midnight, nodes)
                body_there = get_sun(times) if body == "sun" else get_body(body, times)
                return np.asarray(CubicSpline(nodes, body_there.cartesian.xyz.to_value("km").T)(days))

            sun, moon = between(SUN_STEP_D, "sun"), between(MOON_STEP_D, "moon")
            middle = as_time(midnight, days[[days.size // 2]])[0]
            pole = SkyCoord(lon=0, lat=90, unit="deg", frame=GeocentricTrueEcliptic(equinox=middle, obstime=middle))
            north = unit(pole.gcrs.cartesian.xyz.value)
        return cls(unit(sun), np.linalg.norm(sun, axis=1), moon, north)
