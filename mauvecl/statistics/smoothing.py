"""Spectra smoothed as the MauveSim paper smooths them, and sums of squares of what is left after a subtraction."""

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
#: So many steps to a standard deviation of the smoothing, and points of an interpolation between them, give the sum
#: over every pixel to 1e-4.
STEPS_PER_SIGMA = 2
POINTS = 8
#: Where they do not give its mean to this share, every pixel is taken.
WORST = 1e-4
#: Modes whose variance is below this share of the largest one's are rounding.
LEAST = 1e-10


@dataclass(frozen=True, eq=False)
class Smoothing:
    """A Gaussian smoothing, and the sum of its squares over every pixel, from some of them.

    Smoothed spectra vary slowly: their squares are interpolated between a few pixels, and what a sum over all pixels
    makes of that is a weight for each of the few.

    Attributes
    ----------
    centres : ndarray of int, shape (n_centre,)
        Pixels at which the smoothed spectrum is taken.
    between : ndarray, shape (n_pixel, n_centre)
        What each of them adds to the squares at every pixel.
    sigma : float
        Pixels.
    weights : csr_array, shape (n_centre, n_pixel)
        Of the pixels; zero for those that do not count.
    """

    centres: NDArray[np.int64]
    between: Float
    sigma: float
    weights: csr_array

    @cached_property
    def rows(self) -> Float:
        """The weights with all their zeros."""
        return np.asarray(self.weights.toarray())

    @classmethod
    def of(cls, x: Expectation, used: NDArray[np.bool_], flares: Sequence[Expectation] = ()) -> Smoothing:
        """For spectra like one, those pixels that do not count left out.

        Parameters
        ----------
        x : Expectation
        used : ndarray of bool, shape (n_pixel,)
        flares : sequence of Expectation
            Whose sums must come out right.
        """
        n = x.wavelength_nm.size
        sigma = SMOOTHING_NM / np.sqrt(8 * np.log(2)) / float(np.median(np.diff(x.wavelength_nm)))
        step = max(int(sigma / STEPS_PER_SIGMA), 1)
        rows = _rows(n, sigma)
        centres, between = _places(n, step)
        smoothing = cls(centres, between, sigma, rows[centres].multiply(used).tocsr())
        if step == 1 or all(smoothing._follows(flare, used) for flare in flares or (x,)):
            return smoothing
        return cls(np.arange(n), np.eye(n), sigma, rows.multiply(used).tocsr())

    def _follows(self, flare: Expectation, used: NDArray[np.bool_]) -> bool:
        """Whether the sum over every pixel comes out on average, by weights of which none is negative."""
        scale, squares = self.scale(flare), _squares(used.size, self.sigma) @ (used * flare.variance_dn2)
        whole, ours = float(self._each(flare) @ squares), float(scale @ squares[self.centres])
        return bool((scale >= 0).all() and abs(ours - whole) <= WORST * whole)

    def _each(self, flare: Expectation) -> Float:
        """One over the smoothed flare in every pixel, DN/s, for squares of DN; zero where it has no light."""
        from scipy.ndimage import gaussian_filter1d

        expected = gaussian_filter1d(flare.recorded_light_dn, self.sigma, mode="nearest")
        return np.asarray(1.0 / np.where(expected > 0, expected, np.inf) / flare.exposure_s)

    def scale(self, flare: Expectation) -> Float:
        """Factors of the squares of smoothed DN, for the paper's sum of (F - Q)^2 / F in DN/s; shape (n_centre,)."""
        return np.asarray(self._each(flare) @ self.between)

    def form(self, scale: Float, delta: Float, variance: Float) -> QuadraticForm:
        """The distribution of the sum for Gaussian noise of a mean and variance per pixel."""
        if not delta.any():
            weight = np.linalg.eigvalsh(self._covariance(scale, variance))
            weight = weight[weight > LEAST * weight[-1]]
            return QuadraticForm(weight, np.zeros(weight.size))
        weight, vectors = self._decomposed(scale, variance)
        return QuadraticForm(weight, (np.sqrt(scale) * (self.weights @ delta)) @ vectors / np.sqrt(weight))

    def modes(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """What the sum is made of: independent normals' variances, and the weights of the pixels in each.

        Returns
        -------
        weight : ndarray, shape (n_mode,)
        modes : ndarray, shape (n_mode, n_pixel)
        """
        weight, vectors = self._decomposed(scale, variance)
        return weight, vectors.T @ (np.sqrt(scale)[:, None] * self.rows)

    def _decomposed(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """The modes' variances, and the weights of the centres in each, shape (n_centre, n_mode)."""
        values, vectors = np.linalg.eigh(self._covariance(scale, variance))
        kept = values > LEAST * values[-1]
        return values[kept], vectors[:, kept]

    def _covariance(self, scale: Float, variance: Float) -> Float:
        """Of the smoothed values times the roots of their factors, shape (n_centre, n_centre)."""
        half = self.weights * np.sqrt(scale)[:, None]
        return np.asarray(((half * variance) @ half.T).toarray())

    def bands(self, n_padded: int, chunk: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """The weights chunk by chunk of pixels, for centres under way, and how many are finished with each chunk.

        Returns
        -------
        weights : ndarray of float32, shape (n_chunk, n_slot, chunk)
            Slot 0 belongs to the first centre that is not finished.
        finished : ndarray of uint32, shape (n_chunk,)
        """
        n_centre, n_pixel = self.rows.shape
        weighs = self.rows != 0
        some = weighs.any(axis=1)
        first = np.where(some, weighs.argmax(axis=1), self.centres)
        last = np.where(some, n_pixel - 1 - weighs[:, ::-1].argmax(axis=1), self.centres)
        ends = np.arange(chunk, n_padded + 1, chunk)
        # A centre is finished no sooner than those before it.
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
def _places(n: int, step: int) -> tuple[NDArray[np.int64], Float]:
    """Pixels some steps apart, the first and the last among them, and the interpolation between them.

    Returns
    -------
    centres : ndarray of int, shape (n_centre,)
    between : ndarray, shape (n, n_centre)
        Lagrange's polynomials through the nearest eight.
    """
    even = np.linspace(0, n - 1, -(-(n - 1) // step) + 1).round().astype(int)
    # An interpolation is worst beside its ends: one more there.
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
    """Weights of the pixels in the smoothed spectrum at each pixel; kept, for they take a tenth of a second."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.sparse import csr_array

    return csr_array(gaussian_filter1d(np.eye(n), sigma, axis=0, mode="nearest"))


@lru_cache(maxsize=2)
def _squares(n: int, sigma: float) -> csr_array:
    """Their squares."""
    return _rows(n, sigma).power(2)
