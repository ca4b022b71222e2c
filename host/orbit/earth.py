"""Figure and rotation of the Earth, and transformations between its reference frames."""

from __future__ import annotations

import erfa
import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.physical import DAY_S

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


def sidereal_rad(midnight: NDArray[np.float64], days: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Greenwich mean sidereal time (1982), rad: the angle from SGP4's frame to the Earth-fixed frame."""
    return np.asarray(erfa.gmst82(midnight, days))


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

    Parameters
    ----------
    position_km : ndarray, shape (n, 3)
        Position in SGP4's frame.
    midnight, days : ndarray, shape (n,)
        Parts of the Julian date, UTC.
    """
    theta = sidereal_rad(midnight, days)
    x = np.cos(theta) * position_km[:, 0] + np.sin(theta) * position_km[:, 1]
    y = -np.sin(theta) * position_km[:, 0] + np.cos(theta) * position_km[:, 1]
    longitude, latitude, _ = erfa.gc2gd(1, np.stack([x, y, position_km[:, 2]], axis=1) * 1e3)
    return np.degrees(longitude), np.degrees(latitude)
