"""Closed forms of the detection statistics, and intervals of simulated fractions (METHODS section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.errors import InputError
from mauvecl.noise.comparison import TEMPLATE, Comparison
from mauvecl.statistics.inversion import Squares

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Names of the statistics that `detect` computes, and what the report says of them.
STATISTICS = {
    "chi2": "sum over pixels of (observed - template)^2 / variance",
    "chi2_element": "the same over sums of 10.5 nm resolution elements",
    "chi2_pair": "against a noisy quiescent exposure: twice the variance",
    "matched": "weighted sum with the flare's own shape as template, in standard deviations",
    "uv_excess": "net counts from 200 to 360 nm, in standard deviations",
    "paper": "the MauveSim paper's sum of (F - Q)^2 / F on smoothed spectra in DN/s, Q a noisy exposure, F flaring; "
    "a few faint pixels make most of it (see `effective_terms`)",
}
#: Statistics that look for one flare's shape: each flare has a null of its own.
SHAPED = ("matched", "paper")
#: Statistics that compare with one noisy exposure, whatever the others are compared with.
PAIRED = ("chi2_pair", "paper")
#: Where `uv_excess` looks, nm.
UV_NM = (200.0, 360.0)

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
    low = 0.0 if successes == 0 else float(special.betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(special.betainccinv(successes + 1, trials - successes, tail))
    return Interval(successes / trials, low, high)


def central_counts(trials: int, probability: float, confidence: float = CONFIDENCE) -> tuple[int, int]:
    """The smallest counts that a binomial variable stays at or below with probability 1/2 -+ confidence/2.

    Order statistics at these ranks enclose a quantile with that confidence.
    """
    bounds = []
    for p in ((1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0):
        count = int(np.ceil(special.bdtrik(p, trials, probability)))
        # The inverse is continuous; the count below may do as well.
        bounds.append(count - 1 if count > 0 and special.bdtr(count - 1, trials, probability) >= p else count)
    return bounds[0], bounds[1]


#: Standard deviations from the mean within which a transform is computed once for all values, if there are as many
#: effective terms and the probability is as large.
NEAR, MANY, RARE = 40.0, 30.0, 1e-9


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """sum_i weight_i (z_i + shift_i)^2 with independent standard normals z_i: a generalised chi-squared.

    Attributes
    ----------
    weight : ndarray, shape (n,)
        Positive.
    shift : ndarray, shape (n,)
        Means in standard deviations.
    """

    weight: NDArray[np.float64]
    shift: NDArray[np.float64]

    @property
    def mean(self) -> float:
        return float(np.sum(self.weight * (1.0 + self.shift**2)))

    @property
    def std(self) -> float:
        return float(np.sqrt(np.sum(self.weight**2 * (2.0 + 4.0 * self.shift**2))))

    @property
    def effective_terms(self) -> float:
        """How many equal terms would scatter as much for their sum: (sum of weights)^2 / sum of their squares."""
        return float(self.weight.sum() ** 2 / np.sum(self.weight**2))

    def sf(self, value: float) -> float:
        """Probability of exceeding `value`.

        Notes
        -----
        Of many terms, and not far out, Davies's inversion of the characteristic function (1973, doi
        10.1093/biomet/60.2.415), computed once for all values: a trapezoidal sum whose aliasing error is the
        probability of lying more than 2 pi / spacing away. The spacing puts that 40 standard deviations out, below
        1e-15 for ten terms or more; the sum stops where its terms have fallen below 1e-15. Of few terms, and far out,
        the integral of `inversion`, which keeps its digits.
        """
        if value <= 0.0:
            return 1.0
        if self._is_chi_squared():
            if not self.shift.any():
                return float(special.chdtrc(self.weight.size, value))
            # scipy.stats takes a second to load, and is not needed by most studies.
            from scipy.stats import ncx2

            return float(ncx2.sf(value, self.weight.size, np.sum(self.shift**2)))
        if self.effective_terms >= MANY and abs(value - self.mean) <= NEAR * self.std:
            u, size, phase = self._near
            found = 0.5 + float(np.sum(size * np.sin(phase - u * value))) / np.pi
            if found >= RARE:
                return min(found, 1.0)
        upper = value > self.mean
        tail = float(np.exp(self._squares.tail(value / self._squares.unit, upper=upper)[0]))
        return tail if upper else 1.0 - tail

    @cached_property
    def _squares(self) -> Squares:
        return Squares.of(self.weight, self.shift)

    @cached_property
    def _near(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies, and the characteristic function's modulus and phase there, for all values that are near."""
        spacing = 2.0 * np.pi / ((40.0 + NEAR) * self.std)
        pull = self.shift**2 * self.weight
        parts = []
        k = 0.5 + np.arange(256)
        while True:
            u = k * spacing
            turn = 2.0 * np.outer(u, self.weight)
            spread = 1.0 + turn**2
            log_size = -0.25 * np.log(spread).sum(axis=1) - (u[:, None] * turn * pull / spread).sum(axis=1)
            phase = 0.5 * np.arctan(turn).sum(axis=1) + (u[:, None] * pull / spread).sum(axis=1)
            parts.append((u, np.exp(log_size) / k, phase))
            k = k + 256
            if log_size[-1] < np.log(1e-15 * k[0]):
                us, sizes, phases = zip(*parts, strict=True)
                return np.concatenate(us), np.concatenate(sizes), np.concatenate(phases)

    def isf(self, probability: float) -> float:
        """The value exceeded with this probability, 0 < probability < 1."""
        if self._is_chi_squared() and not self.shift.any():
            return float(special.chdtri(self.weight.size, probability))
        if self.effective_terms >= MANY and RARE < probability < 1.0 - RARE:
            from scipy.optimize import brentq

            low, high = max(self.mean - 12 * self.std, 0.0), self.mean + 40 * self.std
            return float(brentq(lambda x: self.sf(x) - probability, low, high, xtol=1e-9 * self.std))
        upper = probability <= 0.5
        wanted = probability if upper else 1.0 - probability
        return self._squares.unit * self._squares.quantile(wanted, upper=upper)

    def _is_chi_squared(self) -> bool:
        return bool(np.all(self.weight == 1.0))


@dataclass(frozen=True)
class Normal:
    """A normal distribution, with the same face as `QuadraticForm`."""

    mean: float
    std: float

    def sf(self, value: float) -> float:
        """Probability of exceeding `value`."""
        return float(special.ndtr((self.mean - value) / self.std))

    def isf(self, probability: float) -> float:
        """The value exceeded with this probability."""
        return float(self.mean - self.std * special.ndtri(probability))


@dataclass(frozen=True, eq=False)
class Linear:
    """A statistic of one's own: the sum over pixels of weight times (observed - template), DN of the exposure.

    Attributes
    ----------
    name : str
    weights : ndarray, shape (n_pixel,)
        Per DN; pixels that a template saturates are left out.
    """

    name: str
    weights: NDArray[np.float64]

    def __post_init__(self) -> None:
        weights = np.array(self.weights, np.float64)
        object.__setattr__(self, "weights", weights)
        if self.name in STATISTICS:
            raise InputError(f"statistic {self.name!r} is one of mauvecl's own, expected another name")
        if weights.ndim != 1 or not np.isfinite(weights).all() or not weights.any():
            bad = int((~np.isfinite(weights)).sum())
            raise InputError(
                f"statistic {self.name!r} has weights of the shape {weights.shape}, {bad} of them no numbers, expected "
                "one finite value per pixel, not all zero"
            )


def uv_weights(quiet: Expectation, used: NDArray[np.bool_], comparison: Comparison = TEMPLATE) -> NDArray[np.float64]:
    """Weights per DN of `uv_excess`, one over the noise of the sum, shape (n_pixel,); zero without any pixel there."""
    inside = used & (quiet.wavelength_nm >= UV_NM[0]) & (quiet.wavelength_nm <= UV_NM[1])
    noise = np.sqrt((1.0 + comparison.share) * np.sum(quiet.variance_dn2[inside]))
    return np.asarray(inside / (noise or 1.0))


def matched_weights(
    quiet: Expectation, flare: Expectation, used: NDArray[np.bool_], comparison: Comparison = TEMPLATE
) -> NDArray[np.float64]:
    """Weights per DN of the matched statistic, delta / v / sqrt(lambda), shape (n_pixel,).

    The statistic then has variance one without a flare, and mean sqrt(lambda) with it, lambda = sum delta^2 / v; v is
    the variance of the difference, that of what is subtracted included.
    """
    delta = np.where(used, flare.signal_dn - quiet.signal_dn, 0.0)
    variance = (1.0 + comparison.share) * quiet.variance_dn2
    strength = float(np.sqrt(np.sum(delta**2 / variance)))
    weights: NDArray[np.float64] = delta / variance / (strength or 1.0)
    return weights


def closed_form(
    statistic: str,
    quiet: Expectation,
    observed: Expectation,
    used: NDArray[np.bool_],
    weights: NDArray[np.float64] | None = None,
    comparison: Comparison = TEMPLATE,
) -> QuadraticForm | Normal:
    """The distribution of a statistic for Gaussian noise (METHODS section 6).

    Parameters
    ----------
    statistic : str
        "chi2", "chi2_element" or "chi2_pair"; anything else is linear.
    quiet : Expectation
        The template and the model variances.
    observed : Expectation
        What is on the sky; `quiet` for the null.
    used : ndarray of bool, shape (n_pixel,)
        Pixels that count.
    weights : ndarray, shape (n_pixel,), optional
        Of a linear statistic.
    comparison : Comparison
        Estimated variances are taken for the true ones, which is what they are on average.
    """
    delta = np.where(used, observed.signal_dn - quiet.signal_dn, 0.0)
    if weights is not None:
        spread = float(np.sqrt(weights**2 @ (observed.variance_dn2 + comparison.share * quiet.variance_dn2)))
        # By estimated variances a linear statistic comes in its own standard deviations.
        mean = float(weights @ delta)
        return Normal(mean / spread, 1.0) if comparison.estimated else Normal(mean, spread)
    share = 1.0 if statistic in PAIRED else comparison.share
    true = (observed.variance_dn2 + share * quiet.variance_dn2) * used
    model = true if comparison.estimated else (1.0 + share) * quiet.variance_dn2 * used
    if statistic == "chi2_element":
        delta, model, true = (quiet.per_element(values) for values in (delta, model, true))
    counts = model > 0
    delta, model, true = delta[counts], model[counts], true[counts]
    return QuadraticForm(true / model, delta / np.sqrt(true))
