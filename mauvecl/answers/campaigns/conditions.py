"""What the detector meets while a target is seen: its temperature through sun and shadow, hits of particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.expectation import Expectation
from mauvecl.host.orbit.conditions import Particles, Thermal
from mauvecl.host.orbit.constraints import sunlight
from mauvecl.host.orbit.orbit import Track
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.study.sections import Rays

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Conditions:
    """Those of one target.

    Attributes
    ----------
    temperature_c : float
        Mean of the detector's while the target is seen.
    swing : tuple of (s, deg C)
        From the beginning of a stretch of median length on, for an orbit: the temperature less that mean.
    hits_per_cm2_s : float
        Mean of cosmic rays and trapped protons while the target is seen.
    """

    temperature_c: float
    swing: tuple[tuple[float, float], ...]
    hits_per_cm2_s: float

    def swings(self, orbits: int, orbit_s: float) -> tuple[tuple[float, float], ...]:
        """The same orbit so many times over."""
        kept = [point for point in self.swing if point[0] < orbit_s]
        return tuple((n * orbit_s + t, value) for n in range(orbits) for t, value in kept)

    def rays(self, study: Rays | None) -> Rays:
        """Hits as a study has them, at this rate."""
        return (study or Rays()).model_copy(update={"rate_per_cm2_s": self.hits_per_cm2_s})


@dataclass(frozen=True, eq=False)
class Met:
    """The same at every step of a plan.

    Attributes
    ----------
    temperature_c, hits_per_cm2_s : ndarray, shape (n,)
    """

    temperature_c: Float
    hits_per_cm2_s: Float

    @classmethod
    def along(cls, track: Track, thermal: Thermal | None = None, particles: Particles | None = None) -> Met:
        """As the orbit gives it; both are assumed unless given."""
        light = sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km)
        temperature = (thermal or Thermal()).temperature_c(light, track.times.step_s)
        return cls(temperature, (particles or Particles()).rate_per_cm2_s(track))

    def of(self, visibility: Visibility, k: int, orbit_s: float) -> Conditions | None:
        """Those of one target; None if it is never seen."""
        seen, windows = visibility.seen[:, k], visibility.windows(k)
        if not seen.any():
            return None
        mean = float(self.temperature_c[seen].mean())
        step = visibility.track.times.step_s
        # Of windows of one length the first.
        typical = int(np.argmin(np.abs(windows.length_s - np.median(windows.length_s))))
        first = round(float(windows.start_s[typical]) / step)
        orbit = self.temperature_c[first : first + int(np.ceil(orbit_s / step))] - mean
        swing = tuple((float((n + 0.5) * step), float(value)) for n, value in enumerate(orbit))
        return Conditions(mean, swing, float(self.hits_per_cm2_s[seen].mean()))


def hits_variance_dn2(rays: Rays, quiet: Expectation) -> Float:
    """What hits add to the variance of each pixel of a frame, DN^2, (n_pixel,): that of the charge that is drawn."""
    charge = rays.rays().charge(quiet.frame_s)
    electrons = np.arange(charge.size)
    variance = float(charge @ electrons**2 - (charge @ electrons) ** 2)
    return np.asarray(variance * quiet.gain_dn_per_electron**2)
