"""Confidence interval of a detection probability whose threshold was estimated from the same draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from mauvecl.statistics.intervals import CONFIDENCE, Interval

#: Number of detections or misses below which Clopper and Pearson's interval replaces Jeffreys's.
FEW = 10
#: Gauss-Legendre rule of the integral over correlations.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)


def detection_interval(above: Sequence[float], trials: int, fap: float, correlation: float = 0.0) -> Interval:
    """Return the fraction of flares above an estimated threshold, with an interval of the detection probability.

    The interval is for the probability above the true threshold, at the level `CONFIDENCE` of the threshold's interval.

    Parameters
    ----------
    above : sequence of three numbers
        Number of flares at or above the threshold, the upper end and the lower end of its interval.
    trials : int
        Number of flares.
    fap : float
        False-alarm probability of the threshold.
    correlation : float
        Correlation of null and flare statistic, 0 to 1, if the threshold was estimated from the flares' own draws. Use
        0 if it was not, or if the correlation is unknown; the interval is then too wide, by a few per cent if the
        probability is much larger than `fap`.

    Notes
    -----
    Let A and B be the fractions of null and flare realisations above the true threshold, and r the ratio of their
    densities there. To first order, the fraction of flares above the estimated threshold is B - r (A - fap) (Bahadur
    1966, doi 10.1214/aoms/1177699450). Its variance is that of B plus that of r A minus twice their covariance. The
    three are combined separately for each end on the scale of normal quantiles: B from Jeffreys's interval (Brown, Cai
    & DasGupta 2001, doi 10.1214/ss/1009213286), r A from the threshold's interval, and the covariance from two normals
    of the same correlation. With fewer than ten detections or misses, Clopper and Pearson's interval replaces
    Jeffreys's.
    """
    above_cut, few, many = above
    tail = (1.0 - CONFIDENCE) / 2.0
    middle, lower, upper = (_probit((k + 0.5) / (trials + 1.0)) for k in (above_cut, few, many))
    # For small counts Jeffreys's interval undercovers; Clopper and Pearson's never does.
    more = 0.5 if min(above_cut, trials - above_cut) >= FEW else 0.0
    low = _beta(above_cut + more, trials - above_cut + 1.0 - more, tail) if above_cut else -np.inf
    high = _beta(above_cut + 1.0 - more, trials - above_cut + more, 1.0 - tail) if above_cut < trials else np.inf
    shared = _exceedance_correlation(fap, float(special.ndtr(middle)), correlation)
    below = _combined(middle - low, middle - lower, shared) if above_cut else np.inf
    beyond = _combined(high - middle, upper - middle, shared) if above_cut < trials else np.inf
    ends = (float(special.ndtr(end)) for end in (middle - below, middle + beyond))
    value = above_cut / trials
    return Interval(value, min(next(ends), value), max(next(ends), value))


def _probit(p: float | np.float64) -> float:
    return float(special.ndtri(p))


def _beta(a: float, b: float, probability: float) -> float:
    """Return a quantile of a beta distribution on the scale of normal quantiles."""
    return _probit(float(special.betaincinv(a, b, probability)))


def _combined(one: float, other: float, shared: float) -> float:
    return float(np.sqrt(max(one**2 + other**2 - 2.0 * shared * one * other, 0.0)))


def _exceedance_correlation(fap: float, probability: float, correlation: float) -> float:
    """Return the correlation of threshold crossings without and with a flare, for two normals."""
    both = _orthant(_probit(1.0 - fap), _probit(1.0 - probability), min(max(correlation, 0.0), 1.0))
    spread = np.sqrt(fap * (1.0 - fap) * probability * (1.0 - probability))
    return float((both - fap * probability) / spread)


def _orthant(h: float, k: float, correlation: float) -> float:
    """Return the probability that two correlated standard normals exceed h and k."""
    if correlation > 1.0 - 1e-9:
        return float(special.ndtr(-max(h, k)))
    # Its derivative with respect to the correlation is their density (Plackett 1954, doi 10.1093/biomet/41.3-4.351).
    angle = 0.5 * float(np.arcsin(correlation))
    r = np.sin(angle * (NODES + 1.0))
    density = np.exp(-(h * h - 2.0 * r * h * k + k * k) / (2.0 * (1.0 - r * r))) / (2.0 * np.pi)
    return float(special.ndtr(-h) * special.ndtr(-k) + angle * np.sum(WEIGHTS * density))
