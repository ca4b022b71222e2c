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
MIN_JEFFREYS = 10
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
    half = 0.5 if min(above_cut, missed) >= MIN_JEFFREYS else 0.0
    low = float(special.ndtri(special.betaincinv(above_cut + half, missed + 1.0 - half, tail)))
    high = float(special.ndtri(special.betaincinv(above_cut + 1.0 - half, missed + half, 1.0 - tail)))
    # Correlation of the crossings of the threshold without and with a flare.
    p, cut = float(special.ndtr(middle)), float(special.ndtri(1.0 - fap))
    joint = _orthant(cut, float(special.ndtri(1.0 - p)), min(max(correlation, 0.0), 1.0))
    shared = float((joint - fap * p) / np.sqrt(fap * (1.0 - fap) * p * (1.0 - p)))

    def combined(sd: float, sd_of_threshold: float) -> float:
        covariance = shared * sd * sd_of_threshold
        return float(np.sqrt(max(sd**2 + sd_of_threshold**2 - 2.0 * covariance, 0.0)))

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
#: Bisections towards a contour's saddle point, near which it may pass.
BISECTIONS = 18
#: Distributions of a mixture that are integrated at once.
TOGETHER = 16


def _falling_root(function: Callable[[float], float], start: float, step: float) -> float:
    """Return the root of a falling function to 1e-8 of a step, searched outwards from `start` in growing steps."""
    from scipy.optimize import brentq

    function = cache(function)
    low = high = start
    width = step
    while function(low) < 0:
        low, high, width = low - width, low, 2 * width
    width = step
    while function(high) > 0:
        low, high, width = high, high + width, 2 * width
    return float(brentq(function, low, high, xtol=1e-8 * step)) if low < high else low


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
        return float(self._tails.above(value)[0])

    def isf(self, probability: float) -> float:
        """Return the value that is exceeded with a probability in (0, 1)."""
        upper = np.array([probability <= 0.5])
        tail = probability if upper[0] else 1.0 - probability
        # Start from a gamma distribution of the same mean and variance.
        shape, scale = (self.mean / self.std) ** 2, self.std**2 / self.mean
        start = (special.gammainccinv if upper[0] else special.gammaincinv)(shape, tail)

        def excess(log_value: float) -> float:
            log_ratio = float(self._tails.logarithms(float(np.exp(log_value)), upper)[0] - np.log(tail))
            return log_ratio if upper[0] else -log_ratio

        return float(np.exp(_falling_root(excess, float(np.log(max(start * scale, 1e-300))), 1e-2)))

    @cached_property
    def _tails(self) -> _Tails:
        return _Tails((self,))


class _Tails:
    """Tails of several quadratic forms, by a contour integral of each.

    Weights, which are in units of the largest of a form, are distinct, and have a number of squares and the sum of
    their shifts^2, the noncentrality; the shape of each array is (n_form, n_weight). Padding has a weight of zero.
    """

    def __init__(self, forms: Sequence[QuadraticForm]) -> None:
        self.mean, self.unit = np.array([(form.mean, form.weight.max()) for form in forms]).T
        distinct = []
        for form, unit in zip(forms, self.unit, strict=True):
            values, member = np.unique(form.weight / unit, return_inverse=True)
            distinct.append((values, np.bincount(member), np.bincount(member, form.shift**2)))
        size = max(values.size for values, *_ in distinct)
        padded = np.zeros((3, len(distinct), size))
        for row, arrays in enumerate(distinct):
            padded[:, row, : arrays[0].size] = arrays
        self.weight, self.count, self.noncentrality = padded

    def above(self, value: float) -> Float:
        """Return the probabilities of exceeding a value, shape (n_form,)."""
        if value <= 0.0:
            return np.ones(self.mean.size)
        upper = value > self.mean
        tail = np.exp(self.logarithms(value, upper))
        return np.where(upper, tail, 1.0 - tail)

    def logarithms(self, value: float, upper: NDArray[np.bool_]) -> Float:
        """Return the natural logarithms of the probabilities above or below a positive value, shape (n_form,).

        They have full precision in the tail that does not contain the mean.
        """
        x = value / self.unit
        with np.errstate(all="ignore"):
            gap = self._saddles(x, upper)
            second, third = (self._derivative(gap, order) for order in (2, 3))
            bend, scale = third / (6.0 * second), 1.0 / np.sqrt(second + 1.0 / (0.5 - gap) ** 2)
            top = self._exponent(gap[:, None] + 0j, x, upper)[:, 0].real
            while True:
                mass = self._integrals(x, upper, (gap, bend, scale), top)
                grown = np.isnan(mass) & (bend > 0)
                if not grown.any():
                    return np.asarray(top + np.log(mass / np.pi))
                bend = np.where(grown, np.where(bend * scale > 1e-6, bend / 4, 0.0), bend)

    def _integrals(self, x: Float, upper: NDArray[np.bool_], path: tuple[Float, Float, Float], top: Float) -> Float:
        """Integrate the probabilities divided by exp(top); NaN if the integrand grows on the contour."""
        gap, bend, scale = (values[:, None] for values in path)

        def summed(first: float, step: float) -> Float:
            """Sum the integrands over points first, first + step, ... until they are negligible."""
            total, grown = np.zeros(x.size), np.zeros(x.size, bool)
            while True:
                t = first + step * np.arange(BLOCK)
                y = scale * np.sinh(t)
                exponent = self._exponent(gap - bend * y**2 - 1j * y, x, upper) - top[:, None]
                size = (np.exp(exponent) * (1.0 - 2j * bend * y)).real * scale * np.cosh(t)
                size[:, t == 0.0] /= 2
                total += size.sum(axis=1)
                grown |= exponent.real.max(axis=1) > GROWTH
                negligible = exponent[:, -1].real + 2 * t[-1] < -NEGLIGIBLE
                if (negligible | grown).all() or t[-1] > MAX_T:
                    return np.where(grown, np.nan, total)
                first = t[-1] + step

        step, total, before = STEP, summed(0.0, STEP), np.zeros(x.size)
        for _ in range(HALVINGS):
            mass = total * step
            if (np.isnan(mass) | (np.abs(mass - before) <= TOLERANCE * before)).all():
                break
            before, total, step = mass, total + summed(step / 2, step), step / 2
        return step * total

    def _factors(self, gap: NDArray[Any]) -> NDArray[Any]:
        """Return 1 - 2 weight s for s = 1/2 - gap, of shape (n_form, n), without cancellation at the branch point."""
        weight = self.weight[:, None]
        return np.asarray((1.0 - weight) + 2.0 * gap[..., None] * weight)

    def _exponent(self, gap: NDArray[Any], x: Float, upper: NDArray[np.bool_]) -> NDArray[np.complex128]:
        """Return K(s) - s x - log(+-s), shape of the gap."""
        factors, s = self._factors(gap), 0.5 - gap
        count, noncentrality = self.count[..., None], self.noncentrality[..., None]
        # Real logarithms and angles are several times faster than complex ones.
        square = factors.real**2 + factors.imag**2
        log = 0.5 * (np.log(square) @ count) + 1j * (np.arctan2(factors.imag, factors.real) @ count)
        real, imaginary = ((part / square) @ noncentrality for part in (factors.real, factors.imag))
        shifted = real - noncentrality.sum(axis=1, keepdims=True) - 1j * imaginary
        sign = np.where(upper, 1.0, -1.0)[:, None]
        return np.asarray((0.5 * (shifted - log))[..., 0] - s * x[:, None] - np.log(sign * s))

    def _derivative(self, gap: Float, order: int) -> Float:
        """Return a derivative of K of order 1 to 3, shape (n_form,)."""
        factors = self._factors(gap[:, None])[:, 0]
        terms = (self.weight / factors) ** order * (self.count + order * self.noncentrality / factors)
        return np.asarray((0.0, 1.0, 2.0, 8.0)[order] * terms.sum(axis=1))

    def _saddles(self, x: Float, upper: NDArray[np.bool_]) -> Float:
        """Return 1/2 - s near the minimum of K(s) - s x - log(+-s) on the real axis, shape (n_form,).

        The minimum lies between 0 and the branch point for the upper tail, and below 0 for the lower tail.
        """
        # The parameter is logarithmic in the distance from 0 and in that from the branch point.
        low, high = np.full(x.size, -700.0), np.full(x.size, 700.0)
        for _ in range(BISECTIONS):
            v = (low + high) / 2
            s = np.where(upper, 0.5 * special.expit(v), -np.exp(v))
            gap = np.where(upper, 0.5 * special.expit(-v), 0.5 + np.exp(v))
            beyond = (self._derivative(gap, 1) - x - 1.0 / s > 0) == upper
            low, high = np.where(beyond, low, v), np.where(beyond, v, high)
        return np.asarray(gap)


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
        mean, std, _ = self._moments
        # This holds for normal parts; the tails of quadratic forms replace theirs.
        above = special.ndtr((mean - value) / std)
        for places, tails in self._tails:
            above[places] = tails.above(value)
        return min(float(self.weights @ above), 1.0)

    @cached_property
    def _tails(self) -> list[tuple[NDArray[np.intp], _Tails]]:
        """Tails of the quadratic forms among the parts, and the places of these."""
        forms = {place: part for place, part in enumerate(self.parts) if isinstance(part, QuadraticForm)}
        chunks = [[*forms][k : k + TOGETHER] for k in range(0, len(forms), TOGETHER)]
        return [(np.array(chunk), _Tails([forms[place] for place in chunk])) for chunk in chunks]

    def isf(self, probability: float) -> float:
        def excess(value: float) -> float:
            return float(np.log(max(self.sf(value), 1e-300) / probability))

        # From the quantile of a normal distribution with the same skewness (Cornish & Fisher 1938), outwards.
        z = -float(special.ndtri(probability))
        start = self.mean + self.std * z + (z**2 - 1.0) * self.third / (6.0 * self.std**2)
        return _falling_root(excess, start, 0.02 * self.std)


#: Closed form of a statistic's distribution.
Form = QuadraticForm | Gaussian | Mixture
