"""The noise of one draw by its cumulants, and as a polynomial of one normal.

Gaussian and Poisson noise of a pixel reach the ADC as a sum. Its distribution is fixed by its cumulants, which
simply add, and the Cornish-Fisher expansion (1938, doi 10.2307/1400905; Abramowitz & Stegun 26.2.49) turns one normal
into it. Where Gaussian noise smooths the Poisson steps away, no number of draws that anyone makes could tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: Gaussian noise of this many Poisson steps leaves 2 exp(-2 pi^2 1.5^2) = 1e-19 of the steps.
SMOOTH_STEPS = 1.5
#: Up to this skewness the expansion's error would need 1e14 draws to show (tests/kernels/test_joint.py).
MOST_SKEW = 0.04
#: Up to this share of the standard deviation the fourth power's coefficient does not show.
SMALL_FOURTH = 1e-7


@dataclass(frozen=True, eq=False)
class Cumulants:
    """One draw of one scenario, DN; arrays have the shape (n_pixel,).

    Attributes
    ----------
    mean : ndarray
        With bias.
    gaussian : ndarray
        Variance of what is Gaussian: read noise, the rounding of a stack's frames, photons if they are.
    photons : ndarray
        Mean electrons of light.
    photon_step, dark_step : ndarray
        DN of one Poisson count; the first is 0 where photon noise is Gaussian.
    dark_dn, light_dn : ndarray
        Means.
    light_variance : ndarray
        Of the photons, Gaussian or not.
    """

    mean: Float
    gaussian: Float
    photons: Float
    photon_step: Float
    dark_step: Float
    dark_dn: Float
    light_dn: Float
    light_variance: Float

    @staticmethod
    def of(x: Expectation, each: int) -> Cumulants:
        """Of a draw of `each` frames."""
        gain = x.gain_dn_per_electron
        photons = each * (x.source_electrons + x.sky_electrons)
        poisson = x.photon_noise == "poisson"
        # A stack of n rounded frames has n/12 of rounding variance; its own rounding brings the last 1/12.
        other = each * x.read_noise_dn**2 + (each - 1) / 12
        return Cumulants(
            mean=each * x.mean_raw_dn,
            gaussian=other if poisson else other + gain**2 * photons,
            photons=photons,
            photon_step=gain if poisson else np.zeros_like(gain),
            dark_step=x.dark_step_dn,
            dark_dn=each * x.dark_dn,
            light_dn=gain * photons,
            light_variance=gain**2 * photons,
        )

    def photon_cumulant(self, order: int) -> Float:
        """Third and higher cumulants of the photons."""
        return np.asarray(self.photon_step**order * self.photons)

    def dark_cumulant(self, order: int) -> Float:
        """Second and higher cumulants of the dark."""
        return np.asarray(self.dark_step ** (order - 1) * self.dark_dn)

    @property
    def dark_variance(self) -> Float:
        return self.dark_cumulant(2)

    @property
    def variance(self) -> Float:
        """Of everything before the draw's own rounding."""
        return self.gaussian + self.photon_cumulant(2) + self.dark_variance

    def shape(self) -> tuple[Float, Float, Float]:
        """Third, fourth and fifth cumulants over their powers of the standard deviation."""
        sd = np.sqrt(self.variance)
        third, fourth, fifth = (
            np.divide(self.photon_cumulant(r) + self.dark_cumulant(r), sd**r, out=np.zeros_like(sd), where=sd > 0)
            for r in (3, 4, 5)
        )
        return third, fourth, fifth


def joint_is_exact(c: Cumulants) -> NDArray[np.bool_]:
    """Pixels whose whole noise may be drawn from one normal, shape (n_pixel,)."""
    step = np.maximum(np.where(c.dark_dn > 0, c.dark_step, 0.0), np.where(c.photons > 0, c.photon_step, 0.0))
    smooth = np.sqrt(c.gaussian) >= SMOOTH_STEPS * step
    return np.asarray(smooth & (c.shape()[0] <= MOST_SKEW))


def needs_fourth_power(c: Cumulants, c4: Float) -> bool:
    """Whether leaving the last coefficient of `polynomial` out would show in fewer than 1e15 draws."""
    return bool((np.abs(c4) > SMALL_FOURTH * np.sqrt(c.variance)).any())


def polynomial(c: Cumulants) -> tuple[Float, Float, Float, Float, Float]:
    """Coefficients of z^0 to z^4 of a draw less its mean, DN, each shape (n_pixel,)."""
    g1, g2, g3 = c.shape()
    sd = np.sqrt(c.variance)
    return (
        sd * (-g1 / 6 + g3 / 40 - g1 * g2 / 12 + 17 * g1**3 / 324),
        sd * (1 - g2 / 8 + 5 * g1**2 / 36),
        sd * (g1 / 6 - g3 / 20 + 5 * g1 * g2 / 24 - 53 * g1**3 / 324),
        sd * (g2 / 24 - g1**2 / 18),
        sd * (g3 / 120 - g1 * g2 / 24 + g1**3 / 27),
    )
