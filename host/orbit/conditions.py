"""What the detector meets along the orbit: its temperature through sunlight and shadow, and hits of particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .orbit import Track
from .radiation import proton_map


@dataclass(frozen=True)
class Thermal:
    """A detector that nears one temperature in sunlight and another in shadow: an assumption, to be replaced.

    First-order: dT/dt = (T_end - T) / tau. With the defaults it swings by some 3 deg C in every orbit, inside the 13 to
    21 deg C that the payload's documents name.

    Attributes
    ----------
    sunlit_c, shadow_c : float
        Where it would end, deg C.
    time_constant_s : float
    """

    sunlit_c: float = 21.0
    shadow_c: float = 13.0
    time_constant_s: float = 3000.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.time_constant_s) and self.time_constant_s > 0):
            raise InputError(f"time_constant_s = {self.time_constant_s}, expected > 0")
        for name in ("sunlit_c", "shadow_c"):
            if not -100 <= getattr(self, name) <= 60:
                raise InputError(f"{name} = {getattr(self, name)}, expected -100 to 60 deg C")

    def temperature_c(
        self, sunlight: NDArray[np.float64], step_s: float, start_c: float | None = None
    ) -> NDArray[np.float64]:
        """Temperature at the ends of steps, (n,).

        Parameters
        ----------
        sunlight : ndarray, shape (n,)
            Share of the Sun's disk that is seen in each step, 0 to 1.
        step_s : float
            Within a step the sunlight is taken as constant, which makes the steps exact.
        start_c : float, optional
            Temperature before the first step; in balance with the mean of the sunlight unless given.
        """
        from scipy.signal import lfilter

        end = self.shadow_c + (self.sunlit_c - self.shadow_c) * sunlight
        keep = float(np.exp(-step_s / self.time_constant_s))
        start = float(end.mean()) if start_c is None else start_c
        temperature, _ = lfilter([1 - keep], [1, -keep], end, zi=[keep * start])
        return np.asarray(temperature)


@dataclass(frozen=True)
class Particles:
    """Hits on the detector: cosmic rays everywhere, and trapped protons that get through the walls (assumption).

    Attributes
    ----------
    cosmic_per_cm2_s : float
        Cosmic rays outside the South Atlantic Anomaly.
    share : float
        Of the trapped protons above 30 MeV, counted from all directions, that reach the detector: a quarter of an
        omnidirectional flux crosses one face of a thin plate, twice that both.
    """

    cosmic_per_cm2_s: float = 1.0
    share: float = 0.5

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cosmic_per_cm2_s) and self.cosmic_per_cm2_s >= 0):
            raise InputError(f"cosmic_per_cm2_s = {self.cosmic_per_cm2_s}, expected >= 0")
        if not 0 <= self.share <= 1:
            raise InputError(f"share = {self.share}, expected 0 to 1")

    def rate_per_cm2_s(self, track: Track) -> NDArray[np.float64]:
        """Hits along a track, cm^-2 s^-1, (n,)."""
        return np.asarray(self.cosmic_per_cm2_s + self.share * proton_map().at(*track.below_deg, above_mev=30))


#: Where the defaults are from.
THERMAL_SOURCE = "assumption: first-order heating and cooling between 13 and 21 deg C, the ends that are documented"
PARTICLES_SOURCE = (
    "assumption: 1 cm^-2 s^-1 of cosmic rays, and half of AP8's omnidirectional protons above 30 MeV, which some 4 mm "
    "of aluminium let through"
)
