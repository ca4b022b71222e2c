"""Solar elongation of a target and the zodiacal light behind it over the year."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

from ..sky.helioecliptic import HelioEcliptic
from ..sky.zodiacal import zodiacal_brightness
from .earth import Vectors, unit
from .sun_and_moon import Bodies


def elongation_deg(sun: Vectors, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle between target and Sun, shape (n,), from unit vectors of shapes (3,) and (n, 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip(sun @ target, -1, 1))))


def zodiacal_light(bodies: Bodies, target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the zodiacal light behind a target, V mag arcsec^-2, shape (n,).

    The value is NaN near the Sun, where the table has none. One time per day samples a year well enough.
    """
    pole = bodies.ecliptic_pole
    latitude = float(np.degrees(np.arcsin(np.clip(target @ pole, -1, 1))))
    flat = unit(bodies.sun - (bodies.sun @ pole)[:, None] * pole)
    along = target - (target @ pole) * pole
    size = float(np.linalg.norm(along))
    # At the pole the longitude is arbitrary.
    difference = np.degrees(np.arccos(np.clip(flat @ along / size, -1, 1))) if size > 1e-9 else np.zeros(len(flat))
    positions = zip(difference, elongation_deg(bodies.sun, target), strict=True)
    return np.array([_brightness(HelioEcliptic(float(x), abs(latitude), float(away))) for x, away in positions])


def _brightness(place: HelioEcliptic) -> float:
    try:
        return zodiacal_brightness(place)
    except InputError:
        return float("nan")
