"""The interval of a detection probability whose threshold was itself simulated, on the same draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from mauvecl.statistics.intervals import CONFIDENCE, Interval

#: Fewer are few.
FEW = 10
#: Of an integral over correlations.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)


def detection_interval(
    above: Sequence[float], trials: int, fap: float, correlation: float = 0.0, confidence: float = CONFIDENCE
) -> Interval:
    """The fraction of flares above an estimated threshold, with an interval for the probability above the true one.

    Parameters
    ----------
    above : sequence of three numbers
        Flares at or above the threshold, above the upper and above the lower end of its interval (few, then many).
    trials : int
        Flares in all.
    fap : float
        False-alarm probability of the threshold.
    correlation : float
        Of null and flare statistic, 0 to 1, where the threshold was found on the flares' own draws; 0 elsewhere, and
        where it is not known: the interval is then too wide, by a few per cent where the probability is much larger
        than `fap`.
    confidence : float
        Of the threshold's interval, and of what is returned.

    Notes
    -----
    With the null's fraction A and the flares' B above the true threshold, and r the ratio of their densities there, the
    flares' fraction above the estimated threshold is, to first order, B - r (A - fap) (Bahadur 1966, doi
    10.1214/aoms/1177699450). Its error has the variance of B, that of r A, and less twice their covariance. All three
    are combined end by end on the scale of normal quantiles: that of B from Jeffreys's interval (Brown, Cai & DasGupta
    2001, doi 10.1214/ss/1009213286), that of r A from the threshold's interval, the covariance from two normals of the
    same correlation. Where fewer than ten flares are found or missed, Clopper and Pearson's interval takes the place of
    Jeffreys's.
    """
    above_cut, few, many = above
    tail = (1.0 - confidence) / 2.0
    middle, lower, upper = (_probit((k + 0.5) / (trials + 1.0)) for k in (above_cut, few, many))
    # Jeffreys's interval falls short of its confidence where few are counted, Clopper and Pearson's nowhere.
    more = 0.5 if min(above_cut, trials - above_cut) >= FEW else 0.0
    low = _beta(above_cut + more, trials - above_cut + 1.0 - more, tail) if above_cut else -np.inf
    high = _beta(above_cut + 1.0 - more, trials - above_cut + more, 1.0 - tail) if above_cut < trials else np.inf
    shared = _shared(fap, float(special.ndtr(middle)), correlation)
    below = _together(middle - low, middle - lower, shared) if above_cut else np.inf
    beyond = _together(high - middle, upper - middle, shared) if above_cut < trials else np.inf
    ends = (float(special.ndtr(end)) for end in (middle - below, middle + beyond))
    value = above_cut / trials
    return Interval(value, min(next(ends), value), max(next(ends), value))


def _probit(p: float | np.float64) -> float:
    return float(special.ndtri(p))


def _beta(a: float, b: float, probability: float) -> float:
    """A beta distribution's quantile, on the scale of normal quantiles."""
    return _probit(float(special.betaincinv(a, b, probability)))


def _together(one: float, other: float, shared: float) -> float:
    return float(np.sqrt(max(one**2 + other**2 - 2.0 * shared * one * other, 0.0)))


def _shared(fap: float, probability: float, correlation: float) -> float:
    """The correlation of exceeding the threshold without and with a flare, of two normals."""
    both = _orthant(_probit(1.0 - fap), _probit(1.0 - probability), min(max(correlation, 0.0), 1.0))
    spread = np.sqrt(fap * (1.0 - fap) * probability * (1.0 - probability))
    return float((both - fap * probability) / spread)


def _orthant(h: float, k: float, correlation: float) -> float:
    """Probability that two correlated standard normals exceed h and k."""
    if correlation > 1.0 - 1e-9:
        return float(special.ndtr(-max(h, k)))
    # Its derivative by the correlation is their density (Plackett 1954, doi 10.1093/biomet/41.3-4.351).
    angle = 0.5 * float(np.arcsin(correlation))
    r = np.sin(angle * (NODES + 1.0))
    density = np.exp(-(h * h - 2.0 * r * h * k + k * k) / (2.0 * (1.0 - r * r))) / (2.0 * np.pi)
    return float(special.ndtr(-h) * special.ndtr(-k) + angle * np.sum(WEIGHTS * density))
