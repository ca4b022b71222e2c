"""Unknown factor on all light of an exposure, which dims a flare as it dims the star.

A fit of weighted sums finds the flare as it is recorded. Quantities of the flare itself are those of the recorded one
over the factor, so that their profile intervals at a given temperature are those of a ratio of two normal estimates
(Fieller 1954, doi 10.1111/j.2517-6161.1954.tb00159.x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np
import scipy
from numpy.typing import NDArray

Float = NDArray[np.float64]


#: Shares of a prior in the variance of a ratio at which thresholds are computed, and steps of their bisection.
SHARES, HALVINGS = np.linspace(0.0, 1.0, 65), 40


@lru_cache(maxsize=16)
def _thresholds(prior: bytes, allowed: float) -> Float:
    """Return squared thresholds at `SHARES` that deviations exceed as often as normal ones exceed `allowed`."""
    deviation, weight = np.frombuffer(prior).reshape(2, -1)
    # A small normal part keeps the distribution continuous.
    normal = np.sqrt(np.maximum(1.0 - SHARES, 1e-4))[:, None]
    moved = np.sqrt(SHARES)[:, None] * deviation
    level = 2.0 * scipy.special.ndtr(np.sqrt(allowed)) - 1.0
    low, high = np.zeros(SHARES.size), np.full(SHARES.size, 10.0)
    for _ in range(HALVINGS):
        middle = ((low + high) / 2.0)[:, None]
        inside = scipy.special.ndtr((middle - moved) / normal) - scipy.special.ndtr((-middle - moved) / normal)
        enough = inside @ weight >= level
        low, high = np.where(enough, low, middle[:, 0]), np.where(enough, middle[:, 0], high)
    return np.asarray(((low + high) / 2.0) ** 2)


@dataclass(frozen=True, eq=False)
class LightFactor:
    """Weighted sum of an exposure that estimates the factor on its light, and its means for the flares of a model.

    Attributes
    ----------
    weights : ndarray, shape (n_pixel,)
        Weights per DN; the sum has unit variance if the flare is known.
    scale : float
        Change of the sum for a change of the factor by one.
    expected : float
        Factor for which the mean of the sum is zero without a flare.
    log_k, hot : ndarray, shape (n_node,)
        Temperatures of the model, and mean sums for a blackbody of amplitude 1.
    fixed : ndarray, shape (n_linear - 1,)
        Mean sums of the other components for unit amplitude.
    prior_share : float
        Share of the prior in the information on the factor if the flare is known.
    prior : ndarray, shape (2, n)
        Deviations of the prior in standard deviations, and their probabilities; empty if it is normal.
    """

    weights: Float
    scale: float
    expected: float
    log_k: Float
    hot: Float
    fixed: Float
    prior_share: float
    prior: Float

    @cached_property
    def spline(self) -> scipy.interpolate.CubicSpline:
        """Mean sum of the blackbody over log temperature."""
        return scipy.interpolate.CubicSpline(self.log_k, self.hot)

    def with_second(self, log_k: float, end: int) -> Self:
        """Return the factor next to a blackbody of a second temperature, as another component of fixed shape."""
        fixed = np.concatenate([[float(self.spline(log_k))], self.fixed])
        return replace(self, log_k=self.log_k[:end], hot=self.hot[:end], fixed=fixed)

    def change(self, value: Float, factor: Float, width: Float, allowed: float) -> Float:
        """Return how far the thresholds of quantities are from `allowed`, since the prior is not normal, shape (n,).

        The part of a quantity's scatter that comes from the prior has the distribution of the prior.

        Parameters
        ----------
        value, factor : ndarray, shape (n,)
            Quantity, and the best factor on light.
        width : ndarray, shape (n,)
            Width of the quantity's interval for a rise of chi-squared by `allowed`.
        """
        share = np.zeros_like(value)
        known = np.isfinite(value) & np.isfinite(width) & (width > 0.0) & (factor > 0.0)
        by_prior = value[known] * np.sqrt(self.prior_share) / (self.scale * factor[known])
        share[known] = np.clip(4.0 * allowed * (by_prior / width[known]) ** 2, 0.0, 1.0)
        return np.asarray(np.interp(share, SHARES, _thresholds(self.prior.tobytes(), allowed)) - allowed)

    def estimate(self, sums: Float, log_k: Float, linear: Float) -> Float:
        """Return the best factor, (n, ...), for sums (n,), temperatures (n, ...) and amplitudes (n, ..., n_linear)."""
        flare = linear[..., 0] * self.spline(log_k) + linear[..., 1:] @ self.fixed
        own = sums.reshape(sums.shape + (1,) * (log_k.ndim - 1))
        return np.asarray(self.expected + (own - flare) / self.scale)

    def weights_of(self, log_k: Float) -> Float:
        """Return the decrease of the best factor per unit of each amplitude, shape (..., n_linear)."""
        hot = self.spline(log_k)[..., None]
        return np.asarray(np.concatenate([hot, np.broadcast_to(self.fixed, (*log_k.shape, self.fixed.size))], -1)
                          / self.scale)  # fmt: skip


def undimmed(values: Float, factor: Float) -> Float:
    """Return light (n, k) over the factor by which it was dimmed, (n,); infinite where the factor is not above zero."""
    lost = (factor <= 0.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.where(values == 0.0, 0.0, np.where(lost, np.copysign(np.inf, values), values / factor[:, None]))
        )


@dataclass(frozen=True, eq=False)
class Ratio:
    """Ratio of two normal estimates, such as a flux as it is recorded and the factor on the light."""

    top: Float
    bottom: Float
    # Variances of both, and their covariance.
    top_variance: Float
    bottom_variance: Float
    covariance: Float

    @property
    def value(self) -> Float:
        """Ratio of the estimates; that of a bottom of at most zero is undefined."""
        return np.divide(self.top, self.bottom, out=np.full_like(self.top, np.nan), where=self.bottom > 0.0)

    def variance_at(self, ratio: Float) -> Float:
        """Return the variance of top - ratio x bottom."""
        return self.top_variance - 2.0 * ratio * self.covariance + ratio**2 * self.bottom_variance

    def end(self, left: Float, sign: float) -> Float:
        """Return the end of the set of ratios that raise chi-squared by at most `left`, with a positive bottom.

        The end is infinite if the bottom may be zero, and of the other sign, no end, if it cannot be positive.
        """
        left = np.maximum(left, 0.0)
        a = self.bottom**2 - left * self.bottom_variance
        b = self.top * self.bottom - left * self.covariance
        c = self.top**2 - left * self.top_variance
        root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
        positive = self.bottom > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            closed = (b + sign * root) / a
            # Where the bottom may be zero, the ratio ends only on the side of zero, if the top is not zero.
            open_end = np.where((c > 0.0) & (sign * self.top < 0.0), c / (b - sign * root), sign * np.inf)
        return np.asarray(np.where(a > 0.0, np.where(positive, closed, -sign * np.inf), open_end))
