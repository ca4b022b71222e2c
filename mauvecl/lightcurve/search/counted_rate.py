"""Rate of false alarms, counted in simulated stares, and the conventional rule of consecutive points.

Rates are false alarms per star-day, 86 400 s of frames (gaps do not count). Alarms occur in clusters, of which a search
reports the largest value, so that the probability of no alarm in t star-days is exp(-rate t). `importance_sampling`
covers rates that are too small to count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

Float = NDArray[np.float64]

#: Smallest number of alarms for a counted threshold.
MIN_ALARMS = 10


@dataclass(frozen=True, eq=False)
class CountedRate:
    """False-alarm rate from the largest values of stares without a flare."""

    maxima: Float  # ascending, shape (n_stare,)
    days: float  # star-days of each stare

    def rate(self, threshold: float) -> Interval:
        """Return the false alarms per star-day at a threshold, with a 95 % interval; infinite if all stares alarm."""
        n = self.maxima.size
        above = n - int(np.searchsorted(self.maxima, threshold, side="left"))
        p = clopper_pearson(above, n)
        with np.errstate(divide="ignore"):
            values = [float(-np.log1p(-x) / self.days) for x in (p.value, p.low, p.high)]
        return Interval(*values)

    def threshold(self, rate: float) -> Interval:
        """Return the threshold for a number of false alarms per star-day, with a 95 % interval.

        Raises InputError if it is expected that fewer than 10 stares alarm, or fewer than 10 do not.
        """
        n = self.maxima.size
        alarmed = -np.expm1(-rate * self.days)
        if min(alarmed, 1 - alarmed) * n < MIN_ALARMS:
            raise InputError(
                f"{rate:g} false alarms per star-day occur in {alarmed * n:.3g} of {n} simulated stares",
                f"at least {MIN_ALARMS} with an alarm and as many without",
                key="false_alarms",
                value=rate,
            )
        low, high = central_counts(n, 1 - alarmed)
        ranks = np.clip([round(n * (1 - alarmed)), low, high], 0, n - 1)
        return Interval(*(float(self.maxima[k]) for k in ranks))


def consecutive_alarm_rate(points: int, sigma: float, frame_s: float) -> float:
    """Return the false alarms per star-day of the rule of consecutive points in white noise."""
    above = float(scipy.special.ndtr(-sigma))
    frames = DAY_S / frame_s
    # A run starts at the first frame or after a frame that is not above sigma.
    return above**points * (1 + (frames - points) * (1 - above))
