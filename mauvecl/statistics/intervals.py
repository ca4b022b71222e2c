"""Confidence intervals of simulated fractions and quantiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A value with a confidence interval at the level `CONFIDENCE`."""

    value: float
    low: float
    high: float


def clopper_pearson(successes: int, trials: int) -> Interval:
    """Return a binomial fraction with its exact interval (Clopper & Pearson 1934, doi 10.1093/biomet/26.4.404).

    The coverage is at least `CONFIDENCE` for every true fraction.
    """
    value, low, high = clopper_pearson_ends(np.array([successes]), trials)
    return Interval(float(value[0]), float(low[0]), float(high[0]))


def clopper_pearson_ends(
    successes: NDArray[np.int64], trials: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return fractions and the lower and upper ends of their intervals; see `clopper_pearson`."""
    tail = (1.0 - CONFIDENCE) / 2.0
    with np.errstate(all="ignore"):
        low = np.where(successes == 0, 0.0, scipy.special.betaincinv(successes, trials - successes + 1, tail))
        high = np.where(successes == trials, 1.0, scipy.special.betainccinv(successes + 1, trials - successes, tail))
    return successes / trials, low, high


def central_counts(trials: int, probability: float) -> tuple[int, int]:
    """Return the quantiles of a binomial variable at probabilities (1 -+ CONFIDENCE) / 2.

    Order statistics at these ranks enclose a quantile of the sample's distribution with that confidence.
    """
    bounds = []
    for p in ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0):
        count = int(np.ceil(scipy.special.bdtrik(p, trials, probability)))
        # The inverse is continuous, so the next lower count may suffice.
        bounds.append(count - 1 if count > 0 and scipy.special.bdtr(count - 1, trials, probability) >= p else count)
    return bounds[0], bounds[1]
