"""The Earth under the satellite: its size, how it turns, where a place is, and which way frames of date lie."""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import NDArray

from .moments import DAY_S

#: Equatorial radius, km, and gravity, km^3 s^-2, of WGS 72, which SGP4 goes by (Hoots & Roehrich 1980).
RADIUS_KM, GRAVITY = 6378.135, 398_600.8
#: Oblateness, WGS 72.
J2 = 1.082616e-3
#: Equatorial radius of WGS 84, km: the sphere whose limb is looked at.
LIMB_KM = 6378.137

Vectors = NDArray[np.float64]


def unit(vectors: Vectors) -> Vectors:
    """Vectors of length 1, (..., 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def direction(longitude_deg: NDArray[np.float64] | float, latitude_deg: NDArray[np.float64] | float) -> Vectors:
    """Unit vectors of angles on a sphere, (..., 3): right ascension and declination, or longitude and latitude."""
    a, d = np.radians(longitude_deg), np.radians(latitude_deg)
    return np.stack(np.broadcast_arrays(np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)), axis=-1)


def sidereal_rad(midnight: NDArray[np.float64], days: NDArray[np.float64]) -> NDArray[np.float64]:
    """Greenwich mean sidereal time of 1982, rad: the angle from SGP4's frame to that of the turning Earth."""
    return np.asarray(erfa.gmst82(midnight, days))


def to_j2000(midnight: float, days: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices from SGP4's frame (true equator, mean equinox of date) to that of J2000, (n, 3, 3).

    Precession and nutation of 1976 and 1980 (Vallado et al. 2006, AIAA 2006-6753), once a day, and lines in between.
    """
    low, high = np.floor(days.min()), np.ceil(days.max()) + 1
    nodes = np.arange(low, high + 1)
    terrestrial = nodes + 69.2 / DAY_S
    of_date = erfa.pnm80(midnight, terrestrial)
    # From the mean to the true equinox of date.
    turn = -np.asarray(erfa.eqeq94(midnight, terrestrial))
    zero, one = np.zeros_like(turn), np.ones_like(turn)
    spin = np.array([[np.cos(turn), np.sin(turn), zero], [-np.sin(turn), np.cos(turn), zero], [zero, zero, one]])
    at_nodes = np.einsum("nji,jkn->nik", of_date, spin)
    place = np.clip((days - low).astype(int), 0, nodes.size - 2)
    part = (days - low - place)[:, None, None]
    return np.asarray((1 - part) * at_nodes[place] + part * at_nodes[place + 1])


def below(position_km: Vectors, midnight: NDArray[np.float64], days: NDArray[np.float64]) -> tuple[Vectors, Vectors]:
    """Where the satellite stands over the Earth.

    Parameters
    ----------
    position_km : ndarray, shape (n, 3)
        In SGP4's frame.
    midnight, days : ndarray, shape (n,)

    Returns
    -------
    longitude_deg, latitude_deg : ndarray, shape (n,)
        Geodetic, WGS 84; longitude from -180 to 180.
    """
    theta = sidereal_rad(midnight, days)
    x = np.cos(theta) * position_km[:, 0] + np.sin(theta) * position_km[:, 1]
    y = -np.sin(theta) * position_km[:, 0] + np.cos(theta) * position_km[:, 1]
    longitude, latitude, _ = erfa.gc2gd(1, np.stack([x, y, position_km[:, 2]], axis=1) * 1e3)
    return np.degrees(longitude), np.degrees(latitude)
