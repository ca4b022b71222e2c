"""How often a search alarms without a flare: the largest values of simulated stares, counted; the common rule.

Rates are false alarms per star-day, 86 400 s of frames (gaps do not count). Alarms come in clumps, of which a search
reports the largest, so that the probability of none in t star-days is exp(-rate t). Where counting ends, `sampled` goes
on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

Float = NDArray[np.float64]

DAY_S = 86_400.0
#: Alarms that a counted threshold rests on at least.
FEWEST_ALARMS = 10


@dataclass(frozen=True, eq=False)
class Counted:
    """The largest values of stares without a flare.

    Attributes
    ----------
    maxima : ndarray, shape (n_stare,)
        Ascending.
    days : float
        Star-days of each stare.
    """

    maxima: Float
    days: float

    def rate(self, threshold: float) -> Interval:
        """False alarms per star-day at a threshold, with 95 %; infinite where every stare has one."""
        n = self.maxima.size
        above = n - int(np.searchsorted(self.maxima, threshold, side="left"))
        p = clopper_pearson(above, n)
        with np.errstate(divide="ignore"):
            values = [float(-np.log1p(-x) / self.days) for x in (p.value, p.low, p.high)]
        return Interval(*values)

    def threshold(self, rate: float) -> Interval:
        """The value with so many false alarms per star-day, with 95 %.

        Raises
        ------
        InputError
            If fewer than 10 of the stares would have one, or fewer than 10 none.
        """
        n = self.maxima.size
        alarmed = -np.expm1(-rate * self.days)
        if min(alarmed, 1 - alarmed) * n < FEWEST_ALARMS:
            raise InputError(
                f"{rate:g} false alarms per star-day are {alarmed * n:.3g} of {n} simulated stares, expected at least "
                f"{FEWEST_ALARMS} with one and as many without"
            )
        low, high = central_counts(n, 1 - alarmed)
        places = np.clip([round(n * (1 - alarmed)), low, high], 0, n - 1)
        return Interval(*(float(self.maxima[k]) for k in places))


def in_a_row(values: NDArray[Any], points: int, sigma: float) -> NDArray[np.bool_]:
    """Where the common rule alarms: frames that end a run of so many consecutive ones above so many sigma.

    Parameters
    ----------
    values : ndarray, shape (..., n_frame)
        In standard deviations; the first `points` of a longer run end in one alarm.
    points : int
    sigma : float
    """
    above = np.asarray(values > sigma)
    alarm = np.zeros(above.shape, np.bool_)
    if above.shape[-1] < points:
        return alarm
    windows = np.asarray(np.lib.stride_tricks.sliding_window_view(above, points, axis=-1).all(axis=-1))
    before = np.concatenate([np.zeros((*above.shape[:-1], 1), np.bool_), windows[..., :-1]], axis=-1)
    alarm[..., points - 1 :] = windows & ~before
    return alarm


def in_a_row_rate(points: int, sigma: float, frame_s: float) -> float:
    """False alarms per star-day of `in_a_row` in white noise: runs of at least so many points."""
    above = float(scipy.special.ndtr(-sigma))
    frames = DAY_S / frame_s
    # A run begins with the first frame, or after one that is not above.
    return above**points * (1 + (frames - points) * (1 - above))
