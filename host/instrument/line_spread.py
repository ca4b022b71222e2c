"""Line spread function of a spectrograph, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, ndtr

if TYPE_CHECKING:
    from .instrument import Instrument

Float = NDArray[np.float64]

#: Cut-off of the Gaussian's tails, in sigma; less than 1e-15 lies beyond.
REACH_SIGMA = 8.0
#: Largest width of a panel in which a polynomial describes a pixel's fraction of a line, in sigma of the Gaussian.
PANEL_SIGMA = 0.5


@dataclass(frozen=True)
class LineSpread:
    """Line spread function, a top hat convolved with a Gaussian, and the pixels that sample it; all in nm."""

    centres: tuple[float, ...]  # of the pixels
    pixel: float  # width of a pixel
    top_hat: float  # full width of the top hat
    sigma: float  # of the Gaussian

    @classmethod
    def of(cls, instrument: Instrument) -> LineSpread:
        """Return the line spread function of an instrument."""
        return cls(
            tuple(instrument.wavelength_nm.tolist()),
            instrument.dispersion_nm_per_pixel,
            instrument.top_hat_width_nm,
            instrument.gaussian_fwhm_nm / np.sqrt(8 * np.log(2)),
        )

    @property
    def reach(self) -> float:
        """Largest distance of a line from a pixel's centre at which light reaches the pixel."""
        return (self.top_hat + self.pixel) / 2 + REACH_SIGMA * self.sigma

    @property
    def mean_density(self) -> float:
        """Integral of the square of the line spread function averaged over a pixel, nm^-1."""
        offset = np.linspace(-self.reach, self.reach, 4001)
        return float(np.trapezoid((self.landing(offset) / self.pixel) ** 2, offset))

    def density(self, offset_nm: ArrayLike) -> Float:
        """Return the line spread function, nm^-1, normalised to unit integral."""
        x = np.asarray(offset_nm, np.float64)
        if self.top_hat == 0:
            return np.asarray(np.exp(-0.5 * (x / self.sigma) ** 2) / (self.sigma * np.sqrt(2 * np.pi)))
        half = self.top_hat / 2
        if self.sigma == 0:
            return np.where(np.abs(x) <= half, 1 / self.top_hat, 0.0)
        scale = self.sigma * np.sqrt(2)
        return np.asarray((erf((x + half) / scale) - erf((x - half) / scale)) / (2 * self.top_hat))

    def landing(self, offset_nm: Float) -> Float:
        """Return the fraction of a line's light that falls on a pixel whose centre is `offset_nm` from the line."""
        # The function is even; on the left of the line no digits cancel.
        x = -np.abs(offset_nm)
        half = self.pixel / 2
        return np.asarray(self.below(x + half) - self.below(x - half))

    def below(self, x: Float) -> Float:
        """Return the fraction of a line's light that falls below x."""
        if self.top_hat == 0:
            return np.asarray(ndtr(x / self.sigma))
        half = self.top_hat / 2
        return (self._ramp(x + half) - self._ramp(x - half)) / self.top_hat

    def _ramp(self, x: Float) -> Float:
        """Integrate the Gaussian's distribution function from minus infinity to x."""
        if self.sigma == 0:
            return np.maximum(x, 0.0)
        z = x / self.sigma
        return np.asarray(self.sigma * (z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)))

    def panel_edges(self, knots: Float) -> Float:
        """Return the edges of panels in which every pixel's `landing` is smooth, shape (n_panel + 1,).

        Panels also end at `knots`.
        """
        low, high = self.centres[0] - self.reach, self.centres[-1] + self.reach
        parts = [np.array([low, high]), knots[(knots > low) & (knots < high)]]
        if self.sigma > 0:
            parts.append(np.linspace(low, high, int(np.ceil((high - low) / (PANEL_SIGMA * self.sigma))) + 1))
        else:
            # Without a Gaussian `landing` is a trapezoid, linear between these corners.
            ends = np.append(np.asarray(self.centres) - self.pixel / 2, self.centres[-1] + self.pixel / 2)
            parts += [ends - self.top_hat / 2, ends + self.top_hat / 2]
        edges = np.unique(np.concatenate(parts))
        # Knots that differ only by rounding would make empty panels.
        kept: Float = edges[np.append(True, np.diff(edges) > 1e-9)]
        return kept
