"""Simulated fractions and quantiles with their confidence intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A fraction or value with a confidence interval of `CONFIDENCE`."""

    value: float
    low: float
    high: float


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """A binomial fraction with its exact interval (Clopper & Pearson 1934, doi 10.1093/biomet/26.4.404).

    Parameters
    ----------
    successes, trials : int
    confidence : float
        Coverage, at least reached whatever the true fraction.
    """
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(scipy.special.betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(scipy.special.betainccinv(successes + 1, trials - successes, tail))
    return Interval(successes / trials, low, high)


def central_counts(trials: int, probability: float, confidence: float = CONFIDENCE) -> tuple[int, int]:
    """The smallest counts that a binomial variable stays at or below with probability 1/2 -+ confidence/2.

    Order statistics at these ranks enclose a quantile with that confidence.
    """
    bounds = []
    for p in ((1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0):
        count = int(np.ceil(scipy.special.bdtrik(p, trials, probability)))
        # The inverse is continuous; the count below may do as well.
        bounds.append(count - 1 if count > 0 and scipy.special.bdtr(count - 1, trials, probability) >= p else count)
    return bounds[0], bounds[1]
