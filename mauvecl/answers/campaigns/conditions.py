"""Detector temperature and particle hits while a target is visible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.orbit.geometry import sunlight
from mauvecl.host.orbit.orbit import Track
from mauvecl.host.orbit.visibility import Particles, Thermal, Visibility

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Conditions:
    """Conditions of one target."""

    temperature_c: float  # mean of the detector while the target is visible
    # Time (s) and deviation from the mean (deg C), for one orbit from the start of a window of median length.
    swing: tuple[tuple[float, float], ...]
    hits_per_cm2_s: float  # mean of cosmic rays and trapped protons while the target is visible

    def swings(self, orbits: int, orbit_s: float) -> tuple[tuple[float, float], ...]:
        """Return the swing of N orbits."""
        kept = [point for point in self.swing if point[0] < orbit_s]
        return tuple((n * orbit_s + t, value) for n in range(orbits) for t, value in kept)


@dataclass(frozen=True, eq=False)
class OrbitConditions:
    """Conditions at every time step of a plan."""

    temperature_c: Float  # shape (n_time,)
    hits_per_cm2_s: Float  # shape (n_time,)

    @classmethod
    def along(cls, track: Track) -> OrbitConditions:
        """Compute the conditions along an orbit with the assumed models."""
        light = sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km)
        temperature = Thermal().temperature_c(light, track.times.step_s)
        return cls(temperature, Particles().rate_per_cm2_s(track))

    def of(self, visibility: Visibility, k: int, orbit_s: float) -> Conditions | None:
        """Return the conditions of target `k`, or None if it is never visible."""
        seen, windows = visibility.seen[:, k], visibility.windows(k)
        if not seen.any():
            return None
        mean = float(self.temperature_c[seen].mean())
        step = visibility.track.times.step_s
        # The first window if several have the median length.
        typical = int(np.argmin(np.abs(windows.length_s - np.median(windows.length_s))))
        first = round(float(windows.start_s[typical]) / step)
        orbit = self.temperature_c[first : first + int(np.ceil(orbit_s / step))] - mean
        swing = tuple((float((n + 0.5) * step), float(value)) for n, value in enumerate(orbit))
        return Conditions(mean, swing, float(self.hits_per_cm2_s[seen].mean()))
