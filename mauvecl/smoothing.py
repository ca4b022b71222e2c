"""Spectra smoothed as the MauveSim paper smooths them, and sums of squares of what is left after a subtraction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.statistics import QuadraticForm

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: FWHM of the paper's smoothing, nm.
SMOOTHING_NM = 10.5
#: A Gaussian of this many steps or more, squared, is summed by its values at these steps to 1e-4.
STEPS_PER_SIGMA = 1.75


@dataclass(frozen=True, eq=False)
class Smoothing:
    """A Gaussian smoothing, looked at where its values differ.

    Attributes
    ----------
    centres : ndarray of int, shape (n_centre,)
        Pixels at which the smoothed spectrum is taken.
    starts : ndarray of int, shape (n_centre,)
        First of the pixels that each of them stands for.
    sigma : float
        Pixels.
    rows : ndarray, shape (n_centre, n_pixel)
        Weights of the pixels; zero for those that do not count.
    """

    centres: NDArray[np.int64]
    starts: NDArray[np.int64]
    sigma: float
    rows: Float

    @classmethod
    def of(cls, x: Expectation, used: NDArray[np.bool_]) -> Smoothing:
        """The paper's smoothing on the pixels of an expectation, those that do not count left out."""
        n = x.wavelength_nm.size
        sigma = SMOOTHING_NM / np.sqrt(8 * np.log(2)) / float(np.median(np.diff(x.wavelength_nm)))
        # An odd number of pixels has a middle.
        step = 2 * int((sigma / STEPS_PER_SIGMA + 1) / 2) - 1 if sigma > STEPS_PER_SIGMA else 1
        starts, centres = _places(n, step)
        return cls(centres, starts, sigma, _rows(n, sigma, step) * used)

    def scale(self, flare: Expectation) -> Float:
        """Factors of the squares of smoothed DN, for the paper's sum of (F - Q)^2 / F in DN/s; shape (n_centre,)."""
        from scipy.ndimage import gaussian_filter1d

        expected = gaussian_filter1d(flare.signal_dn, self.sigma, mode="nearest")
        # Faint ends are steep: F is looked at in every pixel.
        inverse = 1.0 / np.where(expected > 0, expected, np.inf)
        return np.asarray(np.add.reduceat(inverse, self.starts) / flare.exposure_s)

    def form(self, scale: Float, delta: Float, variance: Float) -> QuadraticForm:
        """The distribution of the sum for Gaussian noise of a mean and variance per pixel."""
        weight, modes = self.modes(scale, variance)
        return QuadraticForm(weight, modes @ delta / np.sqrt(weight))

    def modes(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """What the sum is made of: independent normals' variances, and the weights of the pixels in each.

        Returns
        -------
        weight : ndarray, shape (n_mode,)
        modes : ndarray, shape (n_mode, n_pixel)
        """
        half = np.sqrt(scale)[:, None] * self.rows
        values, vectors = np.linalg.eigh((half * variance) @ half.T)
        kept = values > 1e-10 * values[-1]
        return values[kept], vectors[:, kept].T @ half

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


def _places(n: int, step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixels of steps, and the pixels in their middles."""
    starts = np.arange(0, n, step)
    return starts, (starts + np.minimum(starts + step, n) - 1) // 2


@lru_cache(maxsize=4)
def _rows(n: int, sigma: float, step: int) -> Float:
    """Weights of the pixels in the smoothed spectrum at each step; kept, for they take a tenth of a second."""
    from scipy.ndimage import gaussian_filter1d

    rows = gaussian_filter1d(np.eye(n), sigma, axis=0, mode="nearest")[_places(n, step)[1]]
    rows.setflags(write=False)
    return np.asarray(rows)
