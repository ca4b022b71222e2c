"""Geometric constraints on the visibility of targets, one function each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .earth import LIMB_KM, Vectors, unit

#: Radius of the Sun, km (IAU 2015 resolution B3).
SUN_KM = 695_700.0

Flags = NDArray[np.bool_]


def limb_angle_rad(position_km: Vectors) -> NDArray[np.float64]:
    """Return the angular radius of the Earth, a sphere of its equatorial radius, at the satellite, shape (n,)."""
    return np.asarray(np.arcsin(LIMB_KM / np.linalg.norm(position_km, axis=-1)))


def clear_of_earth(position_km: Vectors, target: Vectors, margin_deg: float) -> Flags:
    """Return whether targets are at least `margin_deg` above the Earth's limb, shape (n, k).

    `position_km` is geocentric, shape (n, 3); `target` holds unit vectors, shape (k, 3), here and below.
    """
    least = limb_angle_rad(position_km) + np.radians(margin_deg)
    towards_earth = (-unit(position_km)).astype(np.float32) @ target.T.astype(np.float32)
    return np.asarray(towards_earth <= np.cos(least).astype(np.float32)[:, None])


def clear_of_sun(sun: Vectors, target: Vectors, least_deg: float) -> Flags:
    """Return whether targets are at least `least_deg` from the Sun's centre, shape (n, k).

    `sun` holds unit vectors, shape (n, 3).
    """
    return np.asarray(sun.astype(np.float32) @ target.T.astype(np.float32) <= np.float32(np.cos(np.radians(least_deg))))


def clear_of_moon(moon_km: Vectors, position_km: Vectors, target: Vectors, least_deg: float) -> Flags:
    """Return whether targets are at least `least_deg` from the Moon's centre at the satellite, shape (n, k)."""
    return clear_of_sun(unit(moon_km - position_km), target, least_deg)


def in_declinations(target: Vectors, low_deg: float, high_deg: float) -> Flags:
    """Return whether targets lie between two declinations, shape (k,)."""
    declination = np.degrees(np.arcsin(np.clip(target[:, 2], -1, 1)))
    return np.asarray((declination >= low_deg) & (declination <= high_deg))


def in_cone(axis: Vectors, target: Vectors, half_angle_deg: float) -> Flags:
    """Return whether targets lie within an angle of an axis such as the orbit's normal, shape (n, k).

    `axis` holds unit vectors, shape (n, 3).
    """
    return np.asarray(
        axis.astype(np.float32) @ target.T.astype(np.float32) >= np.float32(np.cos(np.radians(half_angle_deg)))
    )


def sunlight(position_km: Vectors, sun: Vectors, sun_km: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the fraction of the Sun's disk that the Earth does not hide, 0 to 1, shape (n,).

    The fraction is linear in angle between the two contacts of the penumbra, which are eight seconds apart.
    """
    distance = np.linalg.norm(position_km, axis=1)
    separation = np.arccos(np.clip(-np.einsum("ni,ni->n", position_km, sun) / distance, -1, 1))
    earth, disk = np.arcsin(LIMB_KM / distance), np.arcsin(SUN_KM / sun_km)
    return np.asarray(np.clip((separation - earth + disk) / (2 * disk), 0, 1))


def in_polygon(longitude_deg: NDArray[np.float64], latitude_deg: NDArray[np.float64], corners: Vectors) -> Flags:
    """Return whether positions lie inside a polygon in the plane of longitude and latitude, shape (n,).

    Parameters
    ----------
    longitude_deg, latitude_deg : ndarray, shape (n,)
        Longitudes may exceed 180 deg on either side.
    corners : ndarray, shape (m, 2)
        Longitude and latitude of the corners in order, deg. The polygon may cross longitude 180.
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
