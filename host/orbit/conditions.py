"""Detector temperature and particle hits along the orbit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.physical import DetectorTemperature, Duration, NotNegative, Share

from .orbit import Track
from .radiation import proton_map


@validated
@dataclass(frozen=True)
class Thermal:
    """First-order thermal model of the detector: dT/dt = (T_end - T) / tau.

    The model is an assumption. With the defaults the temperature varies by 3 deg C in every orbit, within the 13 to
    21 deg C of the payload's documents.

    Attributes
    ----------
    sunlit_c, shadow_c : float
        Equilibrium temperatures in sunlight and in shadow, deg C.
    time_constant_s : float
    """

    sunlit_c: DetectorTemperature = 21.0
    shadow_c: DetectorTemperature = 13.0
    time_constant_s: Duration = 3000.0

    def temperature_c(
        self, sunlight: NDArray[np.float64], step_s: float, start_c: float | None = None
    ) -> NDArray[np.float64]:
        """Return the temperature at the end of each step, deg C, shape (n,).

        Parameters
        ----------
        sunlight : ndarray, shape (n,)
            Visible fraction of the Sun's disk in each step, 0 to 1.
        step_s : float
            Length of a step. Sunlight is constant within a step, for which the solution is exact.
        start_c : float, optional
            Temperature before the first step. The default is the equilibrium for the mean sunlight.
        """
        from scipy.signal import lfilter

        end = self.shadow_c + (self.sunlit_c - self.shadow_c) * sunlight
        keep = float(np.exp(-step_s / self.time_constant_s))
        start = float(end.mean()) if start_c is None else start_c
        temperature, _ = lfilter([1 - keep], [1, -keep], end, zi=[keep * start])
        return np.asarray(temperature)


@validated
@dataclass(frozen=True)
class Particles:
    """Particles that hit the detector: cosmic rays, and trapped protons that penetrate the shielding (assumption).

    Attributes
    ----------
    cosmic_per_cm2_s : float
        Rate of cosmic rays outside the South Atlantic Anomaly.
    share : float
        Fraction of the omnidirectional flux of trapped protons above 30 MeV that reaches the detector: a quarter of it
        crosses either face of a thin plate.
    """

    cosmic_per_cm2_s: NotNegative = 1.0
    share: Share = 0.5

    def rate_per_cm2_s(self, track: Track) -> NDArray[np.float64]:
        """Return the rate of hits along a track, cm^-2 s^-1, shape (n,)."""
        return np.asarray(self.cosmic_per_cm2_s + self.share * proton_map().at(*track.subsatellite_deg, above_mev=30))


#: Sources of the default values.
THERMAL_SOURCE = "assumption: first-order heating and cooling between 13 and 21 deg C, the ends that are documented"
PARTICLES_SOURCE = (
    "assumption: 1 cm^-2 s^-1 of cosmic rays, and half of AP8's omnidirectional protons above 30 MeV, which some 4 mm "
    "of aluminium let through"
)
