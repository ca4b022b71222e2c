"""Confidence intervals of simulated fractions and quantiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A value with a confidence interval at the level `CONFIDENCE`."""

    value: float
    low: float
    high: float


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return a binomial fraction with its exact interval (Clopper & Pearson 1934, doi 10.1093/biomet/26.4.404).

    The coverage is at least `confidence` for every true fraction.
    """
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(scipy.special.betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(scipy.special.betainccinv(successes + 1, trials - successes, tail))
    return Interval(successes / trials, low, high)


def central_counts(trials: int, probability: float, confidence: float = CONFIDENCE) -> tuple[int, int]:
    """Return the quantiles of a binomial variable at probabilities 1/2 -+ confidence/2.

    Order statistics at these ranks enclose a quantile of the sample's distribution with that confidence.
    """
    bounds = []
    for p in ((1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0):
        count = int(np.ceil(scipy.special.bdtrik(p, trials, probability)))
        # The inverse is continuous, so the next lower count may suffice.
        bounds.append(count - 1 if count > 0 and scipy.special.bdtr(count - 1, trials, probability) >= p else count)
    return bounds[0], bounds[1]
