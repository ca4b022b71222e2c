"""The MauveSim paper's smoothing of spectra, and sums of squares of smoothed differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.statistics.distributions import QuadraticForm

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: FWHM of the paper's smoothing, nm.
SMOOTHING_NM = 10.5
#: Centres per standard deviation of the smoothing, and points of the interpolation between them, which give the sum
#: over all pixels to 1e-4.
STEPS_PER_SIGMA = 2
POINTS = 8
#: Relative error of the sum's mean above which every pixel becomes a centre.
MAX_MEAN_ERROR = 1e-4
#: Variance, relative to the largest, below which a mode is due to rounding.
MIN_MODE_VARIANCE = 1e-10


@dataclass(frozen=True, eq=False)
class Smoothing:
    """A Gaussian smoothing at a few centres that represents the sum of squares over all pixels.

    Smoothed spectra vary slowly, so their squares are interpolated between the centres. The sum over all pixels is then
    a weighted sum over the centres.
    """

    centres: NDArray[np.int64]  # pixels at which the smoothed spectrum is computed, shape (n_centre,)
    between: Float  # interpolation of squares from centres to pixels, shape (n_pixel, n_centre)
    sigma: float  # standard deviation of the smoothing, pixels
    weights: csr_array  # smoothing weights, zero for unused pixels, shape (n_centre, n_pixel)

    @cached_property
    def rows(self) -> Float:
        """Dense array of the weights."""
        return np.asarray(self.weights.toarray())

    @classmethod
    def of(cls, x: Expectation, used: NDArray[np.bool_], flares: Sequence[Expectation] = ()) -> Smoothing:
        """Make the smoothing of the used pixels of spectra like `x`, accurate for the sums of `flares`."""
        n = x.wavelength_nm.size
        sigma = SMOOTHING_NM / np.sqrt(8 * np.log(2)) / float(np.median(np.diff(x.wavelength_nm)))
        step = max(int(sigma / STEPS_PER_SIGMA), 1)
        rows = _rows(n, sigma)
        centres, between = _interpolation(n, step)
        smoothing = cls(centres, between, sigma, rows[centres].multiply(used).tocsr())
        if step == 1 or all(smoothing._preserves_sum(flare, used) for flare in flares or (x,)):
            return smoothing
        return cls(np.arange(n), np.eye(n), sigma, rows.multiply(used).tocsr())

    def _preserves_sum(self, flare: Expectation, used: NDArray[np.bool_]) -> bool:
        """Return whether non-negative factors of the centres reproduce the mean of the sum over all pixels."""
        scale, squares = self.scale(flare), _squares(used.size, self.sigma) @ (used * flare.variance_dn2)
        whole, ours = float(self._inverse_flare(flare) @ squares), float(scale @ squares[self.centres])
        return bool((scale >= 0).all() and abs(ours - whole) <= MAX_MEAN_ERROR * whole)

    def _inverse_flare(self, flare: Expectation) -> Float:
        """Return the inverse of the smoothed flare at every pixel, for squares of DN; zero where there is no light."""
        from scipy.ndimage import gaussian_filter1d

        expected = gaussian_filter1d(flare.recorded_light_dn, self.sigma, mode="nearest")
        return np.asarray(1.0 / np.where(expected > 0, expected, np.inf) / flare.exposure_s)

    def scale(self, flare: Expectation) -> Float:
        """Return the factors of squared smoothed DN in the sum of (F - Q)^2 / F in DN/s, shape (n_centre,)."""
        return np.asarray(self._inverse_flare(flare) @ self.between)

    def form(self, scale: Float, delta: Float, variance: Float) -> QuadraticForm:
        """Return the distribution of the sum for Gaussian noise with a mean and variance per pixel."""
        if not delta.any():
            weight = np.linalg.eigvalsh(self._covariance(scale, variance))
            weight = weight[weight > MIN_MODE_VARIANCE * weight[-1]]
            return QuadraticForm(weight, np.zeros(weight.size))
        weight, vectors = self._eigenmodes(scale, variance)
        return QuadraticForm(weight, (np.sqrt(scale) * (self.weights @ delta)) @ vectors / np.sqrt(weight))

    def modes(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """Return the variances of the sum's independent modes, shape (n_mode,), and their weights per pixel."""
        weight, vectors = self._eigenmodes(scale, variance)
        return weight, vectors.T @ (np.sqrt(scale)[:, None] * self.rows)

    def _eigenmodes(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """Return the variances of the modes, and their weights per centre, shape (n_centre, n_mode)."""
        values, vectors = np.linalg.eigh(self._covariance(scale, variance))
        kept = values > MIN_MODE_VARIANCE * values[-1]
        return values[kept], vectors[:, kept]

    def _covariance(self, scale: Float, variance: Float) -> Float:
        """Return the covariance of the smoothed values times the roots of their factors."""
        half = self.weights * np.sqrt(scale)[:, None]
        return np.asarray(((half * variance) @ half.T).toarray())

    def bands(self, n_padded: int, chunk: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Return the weights of unfinished centres per chunk of pixels, and the number of centres each chunk finishes.

        Returns
        -------
        weights : ndarray of float32, shape (n_chunk, n_slot, chunk)
            Slot 0 belongs to the first unfinished centre.
        finished : ndarray of uint32, shape (n_chunk,)
        """
        n_centre, n_pixel = self.rows.shape
        weighs = self.rows != 0
        some = weighs.any(axis=1)
        first = np.where(some, weighs.argmax(axis=1), self.centres)
        last = np.where(some, n_pixel - 1 - weighs[:, ::-1].argmax(axis=1), self.centres)
        ends = np.arange(chunk, n_padded + 1, chunk)
        # Centres are finished in order.
        done = np.searchsorted(np.maximum.accumulate(last), ends - 1, side="right")
        begun = np.searchsorted(np.minimum.accumulate(first[::-1])[::-1], ends, side="left")
        before = np.append(0, done[:-1])
        slots = -(-int((begun - before).max()) // 4) * 4
        weights = np.zeros((ends.size, slots, chunk), np.float32)
        padded = np.zeros((n_centre, n_padded), np.float32)
        padded[:, :n_pixel] = self.rows
        for c, (low, high) in enumerate(zip(before, begun, strict=True)):
            weights[c, : high - low] = padded[low:high, c * chunk : (c + 1) * chunk]
        return weights, np.diff(done, prepend=0).astype(np.uint32)


@lru_cache(maxsize=4)
def _interpolation(n: int, step: int) -> tuple[NDArray[np.int64], Float]:
    """Return evenly spaced pixels, including both ends, and the interpolation from them to all pixels.

    Returns
    -------
    centres : ndarray of int, shape (n_centre,)
    between : ndarray, shape (n, n_centre)
        Lagrange polynomials through the nearest eight centres.
    """
    even = np.linspace(0, n - 1, -(-(n - 1) // step) + 1).round().astype(int)
    # One more centre next to each end, where interpolation is least accurate.
    centres = np.unique([*even, step // 2, n - 1 - step // 2]) if step > 1 else np.arange(n)
    points = min(POINTS, centres.size)
    between = np.zeros((n, centres.size))
    first = np.clip(np.searchsorted(centres, np.arange(n), side="right") - points // 2, 0, centres.size - points)
    near = first[:, None] + np.arange(points)
    at, own = centres[near], np.eye(points, dtype=bool)
    ratios = (np.arange(n)[:, None, None] - at[:, None, :]) / np.where(own, 1, at[:, :, None] - at[:, None, :])
    np.put_along_axis(between, near, np.where(own, 1.0, ratios).prod(axis=2), axis=1)
    between.setflags(write=False)
    return centres, between


@lru_cache(maxsize=2)
def _rows(n: int, sigma: float) -> csr_array:
    """Return the weights of pixels in the smoothed spectrum; cached, as the computation takes a tenth of a second."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.sparse import csr_array

    return csr_array(gaussian_filter1d(np.eye(n), sigma, axis=0, mode="nearest"))


@lru_cache(maxsize=2)
def _squares(n: int, sigma: float) -> csr_array:
    """Return the squared weights of `_rows`."""
    return _rows(n, sigma).power(2)
