"""The line function: how a spectrograph spreads light of one wavelength over its pixels, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, ndtr

if TYPE_CHECKING:
    from .instrument import Instrument

Float = NDArray[np.float64]

#: Gaussian tails end here, in sigma: what lies beyond is below 1e-15.
REACH_SIGMA = 8.0
#: The widest panel in which a pixel's share of a line is smooth enough for a polynomial, in sigma of the Gaussian.
PANEL_SIGMA = 0.5


@dataclass(frozen=True)
class Line:
    """The line function and the pixels that it falls on, all in nm.

    Attributes
    ----------
    centres : tuple of float
        Pixel centres.
    pixel, top_hat, sigma : float
        Widths of a pixel and of the top hat, and the Gaussian's sigma.
    """

    centres: tuple[float, ...]
    pixel: float
    top_hat: float
    sigma: float

    @classmethod
    def of(cls, instrument: Instrument) -> Line:
        """The line function of an instrument."""
        return cls(
            tuple(instrument.wavelength_nm.tolist()),
            instrument.dispersion_nm_per_pixel,
            instrument.top_hat_width_nm,
            instrument.gaussian_fwhm_nm / np.sqrt(8 * np.log(2)),
        )

    @property
    def reach(self) -> float:
        """Farthest distance from a pixel's centre that sends light into it."""
        return (self.top_hat + self.pixel) / 2 + REACH_SIGMA * self.sigma

    @property
    def mean_density(self) -> float:
        """The line function's mean over its own light, the integral of its square, nm^-1, with the pixel's width."""
        offset = np.linspace(-self.reach, self.reach, 4001)
        return float(np.trapezoid((self.landing(offset) / self.pixel) ** 2, offset))

    def density(self, offset_nm: ArrayLike) -> Float:
        """The line function, nm^-1, unit integral: a difference of two error functions."""
        x = np.asarray(offset_nm, np.float64)
        if self.top_hat == 0:
            return np.asarray(np.exp(-0.5 * (x / self.sigma) ** 2) / (self.sigma * np.sqrt(2 * np.pi)))
        half = self.top_hat / 2
        if self.sigma == 0:
            return np.where(np.abs(x) <= half, 1 / self.top_hat, 0.0)
        scale = self.sigma * np.sqrt(2)
        return np.asarray((erf((x + half) / scale) - erf((x - half) / scale)) / (2 * self.top_hat))

    def landing(self, offset_nm: Float) -> Float:
        """Fraction of a line's light that a pixel takes, by the distance of its centre from the line."""
        # Even in the offset; on the left side of the line no digits cancel.
        x = -np.abs(offset_nm)
        half = self.pixel / 2
        return np.asarray(self.below(x + half) - self.below(x - half))

    def below(self, x: Float) -> Float:
        """Fraction of a line's light that lands below x."""
        if self.top_hat == 0:
            return np.asarray(ndtr(x / self.sigma))
        half = self.top_hat / 2
        return (self._ramp(x + half) - self._ramp(x - half)) / self.top_hat

    def _ramp(self, x: Float) -> Float:
        """Integral of the Gaussian's distribution function from far below to x."""
        if self.sigma == 0:
            return np.maximum(x, 0.0)
        z = x / self.sigma
        return np.asarray(self.sigma * (z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)))

    def panel_edges(self, knots: Float) -> Float:
        """Edges of panels in which every pixel's `landing` is smooth, cut at `knots` too; shape (n_panel + 1,)."""
        low, high = self.centres[0] - self.reach, self.centres[-1] + self.reach
        parts = [np.array([low, high]), knots[(knots > low) & (knots < high)]]
        if self.sigma > 0:
            parts.append(np.linspace(low, high, int(np.ceil((high - low) / (PANEL_SIGMA * self.sigma))) + 1))
        else:
            # Without a Gaussian it is a trapezoid: straight between these corners.
            ends = np.append(np.asarray(self.centres) - self.pixel / 2, self.centres[-1] + self.pixel / 2)
            parts += [ends - self.top_hat / 2, ends + self.top_hat / 2]
        edges = np.unique(np.concatenate(parts))
        # Knots that rounding has split apart would make empty panels.
        kept: Float = edges[np.append(True, np.diff(edges) > 1e-9)]
        return kept
