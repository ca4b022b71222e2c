"""Distributions of detection statistics for Gaussian noise, tail probabilities, and confidence intervals.

Tail probabilities of weighted sums of squared normals are contour integrals, to full precision. The probability is the
Bromwich integral of exp(K(s) - s x) / s with the cumulant generating function K. The contour passes through the saddle
point, where the integrand is largest (Daniels 1954, doi 10.1214/aoms/1177728652), and bends around the branch cut in
the direction of steepest descent, so that exp(-s x) decays even for a few terms (as in Talbot 1979, doi
10.1093/imamat/23.1.97). The trapezoidal rule on this contour converges exponentially.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.arrays import Float


def smallest_integer(reached: Callable[[int], bool], low: int, high: int) -> int:
    """Return the smallest whole number for which a monotone predicate holds: not for `low`, but for `high`."""
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


CONFIDENCE = 0.95
#: Half-width of the interval of a normal value, in standard deviations.
CONFIDENCE_SD = float(special.ndtri(0.5 + CONFIDENCE / 2))


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
    return Interval(*(float(end[0]) for end in clopper_pearson_ends(np.array([successes]), trials)))


def clopper_pearson_ends(successes: NDArray[np.int64], trials: int) -> tuple[Float, Float, Float]:
    """Return fractions and the lower and upper ends of their intervals; see `clopper_pearson`."""
    tail = (1.0 - CONFIDENCE) / 2.0
    with np.errstate(all="ignore"):
        low = np.where(successes == 0, 0.0, special.betaincinv(successes, trials - successes + 1, tail))
        high = np.where(successes == trials, 1.0, special.betainccinv(successes + 1, trials - successes, tail))
    return successes / trials, low, high


def central_counts(trials: int, probability: float) -> tuple[int, int]:
    """Return the quantiles of a binomial variable at probabilities (1 -+ CONFIDENCE) / 2.

    Order statistics at these ranks enclose a quantile of the sample's distribution with that confidence.
    """
    bounds = []
    for p in ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0):
        count = int(np.ceil(special.bdtrik(p, trials, probability)))
        # The inverse is continuous, so the next lower count may suffice.
        bounds.append(count - 1 if count > 0 and special.bdtr(count - 1, trials, probability) >= p else count)
    return bounds[0], bounds[1]


#: Number of detections or misses below which Clopper and Pearson's interval replaces Jeffreys's.
FEW = 10
#: Gauss-Legendre rule of the integral over correlations.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)


def detection_interval(above: Sequence[float], trials: int, fap: float, correlation: float = 0.0) -> Interval:
    """Return the fraction of flares above an estimated threshold, with an interval of the detection probability.

    The interval is for the probability above the true threshold, at the level `CONFIDENCE` of the threshold's interval.
    `above` holds the numbers of flares at or above the threshold, the upper end and the lower end of its interval.
    `correlation` is that of null and flare statistic if the threshold was estimated from the flares' own draws, and 0
    if it was not or if it is unknown; the interval is then too wide, by a few per cent if the probability is much
    larger than `fap`.

    Let A and B be the fractions of null and flare realisations above the true threshold, and r the ratio of their
    densities there. To first order, the fraction of flares above the estimated threshold is B - r (A - fap) (Bahadur
    1966, doi 10.1214/aoms/1177699450). Its variance is that of B plus that of r A minus twice their covariance. The
    three are combined separately for each end on the scale of normal quantiles: B from Jeffreys's interval (Brown, Cai
    & DasGupta 2001, doi 10.1214/ss/1009213286), r A from the threshold's interval, and the covariance from two normals
    of the same correlation. With fewer than ten detections or misses, Clopper and Pearson's interval replaces
    Jeffreys's.
    """
    middle, lower, upper = special.ndtri([(k + 0.5) / (trials + 1.0) for k in above]).tolist()
    above_cut, missed, tail = above[0], trials - above[0], (1.0 - CONFIDENCE) / 2.0
    # For small counts Jeffreys's interval undercovers; Clopper and Pearson's never does.
    more = 0.5 if min(above_cut, missed) >= FEW else 0.0
    low = float(special.ndtri(special.betaincinv(above_cut + more, missed + 1.0 - more, tail)))
    high = float(special.ndtri(special.betaincinv(above_cut + 1.0 - more, missed + more, 1.0 - tail)))
    # Correlation of the crossings of the threshold without and with a flare.
    p, cut = float(special.ndtr(middle)), float(special.ndtri(1.0 - fap))
    both = _orthant(cut, float(special.ndtri(1.0 - p)), min(max(correlation, 0.0), 1.0))
    shared = float((both - fap * p) / np.sqrt(fap * (1.0 - fap) * p * (1.0 - p)))

    def combined(sd: float, other: float) -> float:
        return float(np.sqrt(max(sd**2 + other**2 - 2.0 * shared * sd * other, 0.0)))

    below = combined(middle - low, middle - lower) if above_cut else np.inf
    beyond = combined(high - middle, upper - middle) if missed else np.inf
    value, ends = above_cut / trials, special.ndtr([middle - below, middle + beyond]).tolist()
    return Interval(value, min(ends[0], value), max(ends[1], value))


def _orthant(h: float, k: float, correlation: float) -> float:
    """Return the probability that two correlated standard normals exceed h and k."""
    if correlation > 1.0 - 1e-9:
        return float(special.ndtr(-max(h, k)))
    # Its derivative with respect to the correlation is their density (Plackett 1954, doi 10.1093/biomet/41.3-4.351).
    angle = 0.5 * float(np.arcsin(correlation))
    r = np.sin(angle * (NODES + 1.0))
    density = np.exp(-(h * h - 2.0 * r * h * k + k * k) / (2.0 * (1.0 - r * r))) / (2.0 * np.pi)
    return float(special.ndtr(-h) * special.ndtr(-k) + angle * np.sum(WEIGHTS * density))


#: Relative change of the integral at which refinement stops.
TOLERANCE = 1e-11
#: First step and largest number of halvings; sinh(t) distributes the points over all scales of an uneven sum.
STEP, HALVINGS = 0.125, 8
#: Growth of the integrand's logarithm along the contour beyond which the contour is bent less.
GROWTH = 1.0
#: Decrease of the integrand's logarithm at which the sum ends.
NEGLIGIBLE = 40.0
#: Points computed at once, and the largest value of t.
BLOCK, MAX_T = 64, 80.0


def _falling_root(off: Callable[[float], float], start: float, step: float) -> float:
    """Return the root of a falling function to 1e-8 of a step, searched outwards from `start` in growing steps."""
    from scipy.optimize import brentq

    off = cache(off)
    low = high = start
    width = step
    while off(low) < 0:
        low, high, width = low - width, low, 2 * width
    width = step
    while off(high) > 0:
        low, high, width = high, high + width, 2 * width
    return float(brentq(off, low, high, xtol=1e-8 * step)) if low < high else low


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """Generalised chi-squared variable: sum_i weight_i (z_i + shift_i)^2 with independent standard normals z_i."""

    weight: Float  # positive, shape (n,)
    shift: Float  # means in standard deviations, shape (n,)

    @cached_property
    def mean(self) -> float:
        return float(np.sum(self.weight * (1.0 + self.shift**2)))

    @cached_property
    def std(self) -> float:
        return float(np.sqrt(np.sum(self.weight**2 * (2.0 + 4.0 * self.shift**2))))

    @cached_property
    def third(self) -> float:
        """Third central moment."""
        return 8.0 * float(np.sum(self.weight**3 * (1.0 + 3.0 * self.shift**2)))

    @cached_property
    def effective_terms(self) -> float:
        """Number of equal terms with the same relative scatter: (sum of weights)^2 / sum of squared weights."""
        return float(self.weight.sum() ** 2 / np.sum(self.weight**2))

    def sf(self, value: float) -> float:
        """Return the probability of exceeding `value`."""
        if value <= 0.0:
            return 1.0
        upper = value > self.mean
        tail = float(np.exp(self._log_tail(value / self._unit, upper=upper)))
        return tail if upper else 1.0 - tail

    def isf(self, probability: float) -> float:
        """Return the value that is exceeded with a probability in (0, 1)."""
        upper = probability <= 0.5
        tail = probability if upper else 1.0 - probability
        # Start from a gamma distribution of the same mean and variance.
        mean, variance = self.mean / self._unit, (self.std / self._unit) ** 2
        start = (special.gammainccinv if upper else special.gammaincinv)(mean**2 / variance, tail)
        at = float(np.log(max(start * variance / mean, 1e-300)))

        def off(log_value: float) -> float:
            above = self._log_tail(float(np.exp(log_value)), upper=upper) - float(np.log(tail))
            return above if upper else -above

        return self._unit * float(np.exp(_falling_root(off, at, 1e-2)))

    @cached_property
    def _unit(self) -> float:
        """Largest weight, the unit of the distinct weights and of arguments of the contour integral."""
        return float(self.weight.max())

    @cached_property
    def _distinct(self) -> tuple[Float, Float, Float]:
        """Distinct weights, the largest of which is 1, the number of squares of each, and the sum of their shifts^2."""
        values, member = np.unique(self.weight / self._unit, return_inverse=True)
        count, push = (np.bincount(member, of, values.size).astype(np.float64) for of in (None, self.shift**2))
        return values, count, push

    def _log_tail(self, value: float, *, upper: bool) -> float:
        """Return the natural logarithm of the probability above or below a positive value.

        The result has full precision in the tail that does not contain the mean.
        """
        gap = self._saddle(value, upper)
        left = self._factors(np.array(gap))
        bend = self._derivative(left, 3) / (6.0 * self._derivative(left, 2))
        scale = 1.0 / np.sqrt(self._derivative(left, 2) + 1.0 / (0.5 - gap) ** 2)
        top = float(self._exponent(np.array([gap + 0j]), value, upper)[0].real)
        while np.isnan(mass := self._integral(value, upper, (gap, bend, scale), top)):
            bend = bend / 4 if bend * scale > 1e-6 else 0.0
        return top + float(np.log(mass / np.pi))

    def _integral(self, value: float, upper: bool, path: tuple[float, float, float], top: float) -> float:
        """Integrate the probability divided by exp(top); NaN if the integrand grows on the contour."""
        gap, bend, scale = path

        def summed(first: float, step: float) -> float:
            """Sum the integrand over points first, first + step, ... until it is negligible."""
            total = 0.0
            while True:
                t = first + step * np.arange(BLOCK)
                y = scale * np.sinh(t)
                exponent = self._exponent(gap - bend * y**2 - 1j * y, value, upper) - top
                if exponent.real.max() > GROWTH:
                    return np.nan
                size = (np.exp(exponent) * (1.0 - 2j * bend * y)).real * scale * np.cosh(t)
                size[t == 0.0] /= 2
                total += float(size.sum())
                if exponent[-1].real + 2 * t[-1] < -NEGLIGIBLE or t[-1] > MAX_T:
                    return total
                first = t[-1] + step

        step, total, before = STEP, summed(0.0, STEP), 0.0
        for _ in range(HALVINGS):
            mass = total * step
            if np.isnan(mass) or abs(mass - before) <= TOLERANCE * before:
                break
            before, total, step = mass, total + summed(step / 2, step), step / 2
        return step * total

    def _factors(self, gap: NDArray[Any]) -> NDArray[Any]:
        """Return 1 - 2 weight s for s = 1/2 - gap, without cancellation near the branch point."""
        weight = self._distinct[0]
        return np.asarray((1.0 - weight) + 2.0 * np.multiply.outer(gap, weight))

    def _exponent(self, gap: NDArray[np.complex128], value: float, upper: bool) -> NDArray[np.complex128]:
        """Return K(s) - s x - log(+-s)."""
        (_, count, push), left, s = self._distinct, self._factors(gap), 0.5 - gap
        # Real logarithms and angles are several times faster than complex ones.
        square = left.real**2 + left.imag**2
        log = 0.5 * (np.log(square) @ count) + 1j * (np.arctan2(left.imag, left.real) @ count)
        turn = (left.real / square) @ push - push.sum() - 1j * ((left.imag / square) @ push)
        return np.asarray(-0.5 * log + 0.5 * turn - s * value - np.log(s if upper else -s))

    def _derivative(self, left: Float, order: int) -> float:
        """Return a derivative of K of order 1 to 3."""
        weight, count, push = self._distinct
        return (0.0, 1.0, 2.0, 8.0)[order] * float(((weight / left) ** order * (count + order * push / left)).sum())

    def _saddle(self, value: float, upper: bool) -> float:
        """Return 1/2 - s at the minimum of K(s) - s x - log(+-s) on the real axis.

        The minimum lies between 0 and the branch point for the upper tail, and below 0 for the lower tail.
        """
        from scipy.optimize import brentq

        # The parameter v is logarithmic in the distance from 0 and in that from the branch point.
        def gap(v: float) -> float:
            return 0.5 * float(special.expit(-v)) if upper else 0.5 + float(np.exp(v))

        def slope(v: float) -> float:
            s = 0.5 * float(special.expit(v)) if upper else -float(np.exp(v))
            return self._derivative(self._factors(np.array(gap(v))), 1) - value - 1.0 / s

        sign = 1.0 if upper else -1.0
        low, high = -1.0, 1.0
        while sign * slope(low) > 0:
            low *= 2
        while sign * slope(high) < 0:
            high *= 2
        # The contour may pass near the minimum.
        return gap(float(brentq(slope, low, high, xtol=0.01)))


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution with the interface of `QuadraticForm`."""

    mean: float
    std: float
    third: ClassVar[float] = 0.0

    def sf(self, value: float) -> float:
        return float(special.ndtr((self.mean - value) / self.std))

    def isf(self, probability: float) -> float:
        return float(self.mean - self.std * special.ndtri(probability))


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of distributions with the interface of `QuadraticForm`, for noise that depends on drawn factors."""

    parts: tuple[QuadraticForm | Gaussian, ...]
    weights: Float  # probability of each part, shape (n,)

    @cached_property
    def _moments(self) -> Float:
        """Mean, standard deviation and third central moment of each part, shape (3, n)."""
        return np.array([(part.mean, part.std, part.third) for part in self.parts]).T

    @cached_property
    def mean(self) -> float:
        return float(self.weights @ self._moments[0])

    @cached_property
    def std(self) -> float:
        mean, std, _ = self._moments
        return float(np.sqrt(self.weights @ (std**2 + (mean - self.mean) ** 2)))

    @cached_property
    def third(self) -> float:
        mean, std, third = self._moments
        away = mean - self.mean
        return float(self.weights @ (third + 3.0 * away * std**2 + away**3))

    def sf(self, value: float) -> float:
        mean, std, third = self._moments
        # Normal parts, of which there may be thousands, have no skewness.
        above = [part.sf(value) for part in self.parts] if third.any() else special.ndtr((mean - value) / std)
        return min(float(self.weights @ above), 1.0)

    def isf(self, probability: float) -> float:
        def off(value: float) -> float:
            return float(np.log(max(self.sf(value), 1e-300) / probability))

        # From the quantile of a normal distribution with the same skewness (Cornish & Fisher 1938), outwards.
        z = -float(special.ndtri(probability))
        start = self.mean + self.std * z + (z**2 - 1.0) * self.third / (6.0 * self.std**2)
        return _falling_root(off, start, 0.02 * self.std)


#: Closed form of a statistic's distribution.
Form = QuadraticForm | Gaussian | Mixture
