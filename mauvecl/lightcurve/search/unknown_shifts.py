"""Effect of unknown light, sky and temperature on the false alarms of a search.

If the star is brighter or the detector warmer than assumed, the scatter of a template's value increases by a factor r,
and it exceeds u as often as u / r is exceeded otherwise. If the baseline has trends that the search neither subtracts
nor marginalises over, values are shifted, and exceed u as often as u less the shift is exceeded otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable

Float = NDArray[np.float64]

#: Relative change of the scatter that is neglected.
NEGLIGIBLE = 1e-6


@dataclass(frozen=True, eq=False)
class UnknownShifts:
    """Scatter and shift of templates' values for drawn conditions."""

    scales: Float  # standard deviations of values at some times and all temperatures, nominally 1, shape (n_draw, n)
    weights: Float  # of the draws, sum 1, shape (n_draw,)
    shifts: Float  # means of values, ascending, shape (n_shift,)
    shares: Float  # shares of templates with each mean, shape (n_draw, n_shift)

    @property
    def is_nominal(self) -> bool:
        """True if scatter and shift are as the search assumes."""
        return bool(np.abs(self.scales - 1).max() < NEGLIGIBLE and not self.shifts.any())

    def alarm_probability(self, threshold: float, days: float, rate: Callable[[Float], Float]) -> Float:
        """Return the probability of an alarm in each draw, shape (n_draw,).

        Parameters
        ----------
        days : float
            Star-days of the stare.
        rate : callable
            False alarms per star-day at a threshold for the noise that the search assumes.
        """
        rates = np.zeros(self.weights.size)
        largest = np.zeros(self.weights.size)
        for shift, share in zip(self.shifts, self.shares.T, strict=True):
            rates += share * rate((threshold - shift) / self.scales).mean(axis=1)
            largest = np.where(share > 0, shift, largest)
        if not self.shifts.any():
            return np.asarray(-np.expm1(-days * rates))
        # A few templates with a large mean suffice for an alarm.
        return np.asarray(1 - np.exp(-days * rates) * scipy.special.ndtr(threshold - largest))
