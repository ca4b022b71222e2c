"""Measured noise of observed frames: scatter of means, and correlation of the residuals of the fitted process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Float = NDArray[np.float64]

#: Numbers of frames per bin at which the scatter is measured.
BINS = (1, 2, 4, 8, 16, 32, 64, 128)
#: Smallest number of bins.
MIN_BINS = 8
#: Largest lag of correlations in frames.
MAX_LAG = 40
#: Correlation of the residuals from which the process does not describe them, if it is also as many standard errors.
CORRELATED, SIGNIFICANT = 0.12, 5.0


@dataclass(frozen=True, eq=False)
class Likeness:
    """Comparison of the residuals of the fitted process with independent noise."""

    correlations: (
        Float  # shape (n_lag,); autocorrelation at lags of 1, 2 ... frames, of the sum that is most correlated
    )
    error: float  # its standard error for independent residuals

    @property
    def lag(self) -> int:
        """Lag of the largest correlation in frames."""
        return int(np.argmax(np.abs(self.correlations))) + 1

    @property
    def correlation(self) -> float:
        """Largest correlation."""
        return float(self.correlations[self.lag - 1])

    @property
    def alike(self) -> bool:
        """True unless the residuals are significantly and clearly correlated."""
        return abs(self.correlation) < max(CORRELATED, SIGNIFICANT * self.error)


def likeness(numbers: NDArray[np.int64], residual: Float) -> Likeness:
    """Return the autocorrelation of residuals.

    Parameters
    ----------
    numbers : ndarray, shape (n_frame,)
        Numbers of the frames on their regular grid.
    residual : ndarray, shape (n_frame, n_sum)
    """
    # Single extreme values would hide correlations, or feign them.
    scaled = np.clip(residual, -4.0, 4.0)
    scaled = (scaled - scaled.mean(axis=0)) / np.maximum(scaled.std(axis=0), 1e-300)
    lags = np.arange(1, max(2, min(MAX_LAG, len(numbers) // 4) + 1))
    found = np.zeros((residual.shape[1], lags.size))
    for k, lag in enumerate(lags):
        pairs = numbers[lag:] - numbers[:-lag] == lag
        if pairs.sum() > 10:
            found[:, k] = (scaled[lag:][pairs] * scaled[:-lag][pairs]).mean(axis=0)
    worst = int(np.argmax(np.abs(found).max(axis=1)))
    return Likeness(found[worst], float(len(numbers) ** -0.5))


@dataclass(frozen=True)
class Scatter:
    """Scatter of means of several consecutive quiescent frames."""

    frames: int  # number of frames in a mean
    count: int  # number of means
    measured: float  # their standard deviation, in units of the noise of one frame
    white: float  # the same for independent frames: one over the root of `frames`
    # low, high: range of `measured` in 95 % of light curves of independent, normal frames.
    low: float
    high: float

    @property
    def red(self) -> bool:
        """True if the frames are correlated on this time scale."""
        return self.measured > self.high


def binned_scatter(numbers: NDArray[np.int64], residual: Float) -> list[Scatter]:
    """Measure the scatter of means of consecutive frames without gaps.

    Parameters
    ----------
    numbers : ndarray, shape (n_frame,)
        Numbers of the frames on their regular grid.
    residual : ndarray, shape (n_frame,)
        Flux of quiescent frames less their level, in units of the noise of one frame.
    """
    found = []
    # Place of each frame among consecutive ones, and their number.
    first = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 2) != 1)
    lengths = np.diff(np.append(first, numbers.size))
    place, length = np.arange(numbers.size) - np.repeat(first, lengths), np.repeat(lengths, lengths)
    for size in BINS:
        # Bins do not overlap, and begin with the first frame after a gap.
        kept = np.flatnonzero((place % size == 0) & (place + size <= length))
        if len(kept) < MIN_BINS:
            break
        means = residual[kept[:, None] + np.arange(size)].mean(axis=1)
        dof = len(kept) - 1
        low, high = (float(np.sqrt(scipy.stats.chi2.ppf(p, dof) / dof / size)) for p in (0.025, 0.975))
        found.append(Scatter(size, len(kept), float(means.std(ddof=1)), size**-0.5, low, high))
    return found
