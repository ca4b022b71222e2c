"""A target over the year: how far from the Sun it stands, and how bright the zodiacal light behind it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..sky.helioecliptic import HelioEcliptic
from ..sky.zodiacal import zodiacal_brightness
from .bodies import Bodies
from .earth import Vectors, unit


def elongation_deg(sun: Vectors, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between target and Sun, (n,); `sun` are unit vectors, (n, 3), `target` one, (3,)."""
    return np.asarray(np.degrees(np.arccos(np.clip(sun @ target, -1, 1))))


def zodiacal_light(bodies: Bodies, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """V mag arcsec^-2 behind a target, (n,); NaN where the table has no value, near the Sun.

    Parameters
    ----------
    bodies : Bodies
        At some n times; one a day does for a year.
    target : ndarray, shape (3,)
        Unit vector.
    """
    pole = bodies.ecliptic_pole
    latitude = float(np.degrees(np.arcsin(np.clip(target @ pole, -1, 1))))
    flat = unit(bodies.sun - (bodies.sun @ pole)[:, None] * pole)
    along = target - (target @ pole) * pole
    size = float(np.linalg.norm(along))
    # At the pole any longitude is as good.
    difference = np.degrees(np.arccos(np.clip(flat @ along / size, -1, 1))) if size > 1e-9 else np.zeros(len(flat))
    places = zip(difference, elongation_deg(bodies.sun, target), strict=True)
    return np.array([_brightness(HelioEcliptic(float(x), abs(latitude), float(away))) for x, away in places])


def _brightness(place: HelioEcliptic) -> float:
    try:
        return zodiacal_brightness(place)
    except InputError:
        return float("nan")
