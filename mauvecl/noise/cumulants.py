"""Cumulants of the noise of one draw, and its expansion as a polynomial of one normal deviate.

Gaussian and Poisson noise of a pixel reach the ADC as a sum, whose cumulants are the sums of theirs. The Cornish-Fisher
expansion (1938, doi 10.2307/1400905; Abramowitz & Stegun 26.2.49) turns a normal deviate into a draw with these
cumulants. If Gaussian noise smooths the Poisson steps, no realistic number of draws reveals the difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: Gaussian noise with a standard deviation of this many Poisson steps reduces them to 2 exp(-2 pi^2 1.5^2) = 1e-19.
SMOOTH_STEPS = 1.5
#: Up to this skewness, the first omitted terms, which `truncation_distance` includes, dominate the expansion's error.
MAX_SKEW = 0.04
#: Estimated number of draws of one pixel after which Pearson's test of whole DN would detect, at five sigma, that they
#: are not drawn frame by frame and count by count. By exact convolution, the worst allowed case needs 4e13 draws
#: (tests/kernels/test_joint.py, tests/noise/test_stacks.py). The payload's fastest draws satisfy this at every
#: temperature and exposure, some with only 5e13 to 1e14.
DRAWS_TO_NOTICE = 4.2e13
#: Largest number of harmonics of the rounding error's sawtooth; Gaussian noise of 0.02 DN suppresses all others.
HARMONICS = 64


@dataclass(frozen=True, eq=False)
class Cumulants:
    """Cumulants of one draw of a scenario, DN; arrays have the shape (n_pixel,)."""

    mean: Float  # mean, including bias
    #: Variance of the Gaussian part: read noise, rounding of a stack's frames, and Gaussian photon noise.
    gaussian: Float
    photons: Float  # mean electrons of light
    #: DN per Poisson count; the first is 0 for Gaussian photon noise.
    photon_step: Float
    dark_step: Float
    #: Means of dark and light.
    dark_dn: Float
    light_dn: Float
    light_variance: Float  # variance of the light, Gaussian or Poisson

    @staticmethod
    def of(x: Expectation, each: int) -> Cumulants:
        """Compute the cumulants of a draw of `each` frames."""
        gain = x.gain_dn_per_electron
        photons = each * x.light_electrons
        poisson = x.photon_noise == "poisson"
        # A stack of n rounded frames has a rounding variance of n/12; the rounding of the draw adds the last 1/12.
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
        """Return a cumulant of the photons, for orders of 3 and above."""
        return np.asarray(self.photon_step**order * self.photons)

    def dark_cumulant(self, order: int) -> Float:
        """Return a cumulant of the dark, for orders of 2 and above."""
        return np.asarray(self.dark_step ** (order - 1) * self.dark_dn)

    @property
    def dark_variance(self) -> Float:
        return self.dark_cumulant(2)

    @property
    def variance(self) -> Float:
        """Total variance before the draw's own rounding."""
        return self.gaussian + self.photon_cumulant(2) + self.dark_variance

    def shape(self) -> tuple[Float, Float, Float]:
        """Return the third, fourth and fifth cumulants divided by powers of the standard deviation."""
        sd = np.sqrt(self.variance)
        third, fourth, fifth = (
            np.divide(self.photon_cumulant(r) + self.dark_cumulant(r), sd**r, out=np.zeros_like(sd), where=sd > 0)
            for r in (3, 4, 5)
        )
        return third, fourth, fifth

    def over_sd(self, last: int) -> list[Float]:
        """Return standardised cumulants from the third to order `last`, by products, which are faster than powers."""
        sd = np.sqrt(self.variance)
        each = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
        light, dark = self.photon_step * each, self.dark_step * each
        of_light, of_dark = self.photons * light**2, self.dark_dn * each * dark
        bounds = []
        for _ in range(3, last + 1):
            of_light, of_dark = of_light * light, of_dark * dark
            bounds.append(of_light + of_dark)
        return bounds

    def scaled(self, light: float | Float, dark: float) -> Cumulants:
        """Return the cumulants with light and dark multiplied by factors."""
        gaussian_light = np.where(self.photon_step > 0, 0.0, self.light_variance)
        return Cumulants(
            mean=self.mean + (light - 1.0) * self.light_dn + (dark - 1.0) * self.dark_dn,
            gaussian=self.gaussian + (light - 1.0) * gaussian_light,
            photons=light * self.photons,
            photon_step=self.photon_step,
            dark_step=self.dark_step,
            dark_dn=dark * self.dark_dn,
            light_dn=light * self.light_dn,
            light_variance=light * self.light_variance,
        )


def is_noticeable(distance: Float, variance: Float) -> NDArray[np.bool_]:
    """Return whether Pearson's test detects the distance sum (p - q)^2 / p within `DRAWS_TO_NOTICE` draws.

    The limit is five standard deviations of chi-squared, whose degrees of freedom are the whole DN within 7.65 standard
    deviations of the mean, those with a probability above 1e-14.
    """
    steps = np.maximum(15.3 * np.sqrt(variance), 1.0)
    return np.asarray(distance * DRAWS_TO_NOTICE > 5.0 * np.sqrt(2.0 * steps))


def truncation_distance(c: Cumulants, *, fourth_power: bool, varying: bool = False) -> Float:
    """Estimate Pearson's distance between a draw and its polynomial from the next terms, shape (n_pixel,).

    A term a He_k(z) changes the density by a He_(k + 1)(z) times the normal's, and the squares of these integrate to
    a^2 (k + 1)!. Rounding to whole DN can only reduce the distance.

    Parameters
    ----------
    fourth_power : bool
        Whether the polynomial includes z^4.
    varying : bool
        Whether to use the kernels' polynomial for factors on light and dark instead of `polynomial`. Without the fourth
        power, it has no terms of gamma_5.
    """
    return expansion_error(c.over_sd(7), fourth_power=fourth_power, varying=varying)


def expansion_error(over_sd: Sequence[Float], *, fourth_power: bool, varying: bool = False) -> Float:
    """Compute `truncation_distance` from the standardised third to seventh cumulants."""
    g3, g4, g5, g6, g7 = over_sd
    g3_3 = g3 * g3 * g3
    g3_4 = g3_3 * g3
    # The terms of Abramowitz & Stegun 26.2.49 after those of `polynomial`; their gamma_1 is g3.
    fifth = g6 / 720 - 3 * g4**2 / 384 - 2 * g3 * g5 / 180 + 14 * g3**2 * g4 / 288 - 252 * g3_4 / 7776
    third = -6 * g4**2 / 384 - 3 * g3 * g5 / 180 + 37 * g3**2 * g4 / 288 - 832 * g3_4 / 7776
    first = -2 * g4**2 / 384 + 8 * g3**2 * g4 / 288 - 227 * g3_4 / 7776
    loss = 720 * fifth**2 + 24 * third**2 + 2 * first**2 + g7**2 / 5040
    if not fourth_power:
        second = 19 * g3_3 / 324 - g3 * g4 / 24
        fourth = g5 / 120 - g3 * g4 / 24 + g3_3 / 27
        # Without gamma_5, both Hermite terms are missing; `polynomial` lacks only z^4 = He_4 + 6 He_2 + 3.
        loss = loss + (120 * fourth**2 + 6 * second**2 if varying else 345 * fourth**2)
    return np.asarray(loss)


def joint_is_exact(c: Cumulants) -> NDArray[np.bool_]:
    """Return the pixels whose noise can be drawn from one normal, shape (n_pixel,)."""
    step = np.maximum(np.where(c.dark_dn > 0, c.dark_step, 0.0), np.where(c.photons > 0, c.photon_step, 0.0))
    smooth = np.sqrt(c.gaussian) >= SMOOTH_STEPS * step
    return np.asarray(
        smooth & (c.over_sd(3)[0] <= MAX_SKEW) & ~is_noticeable(truncation_distance(c, fourth_power=True), c.variance)
    )


def needs_fourth_power(c: Cumulants, *, varying: bool = False) -> bool:
    """Return whether omitting the fourth power of the polynomial is noticeable; see `truncation_distance`."""
    return bool(is_noticeable(truncation_distance(c, fourth_power=False, varying=varying), c.variance).any())


def stack_is_exact(c: Cumulants, x: Expectation) -> NDArray[np.bool_]:
    """Return the pixels whose frames can be drawn as one stack, shape (n_pixel,).

    Parameters
    ----------
    c : Cumulants
        Cumulants of ONE frame.

    Notes
    -----
    A stack treats each frame's rounding error as noise of mean 0 and variance 1/12 that is Gaussian in the sum. The
    error is a sawtooth, the sum over k of sin(2 pi k x) / (pi k), which depends on the frame's noise through its
    characteristic function at 2 pi k (Widrow, Kollar & Liu 1996, doi 10.1109/19.492748): its modulus f_k and the slope
    l_k of its logarithm. Given the sum of N frames of variance v, the conditional mean of a frame's sine is at most
    f_k exp(u_k / 2) with u_k = l_k^2 / (N v), which changes the density of the sum by Pearson's distance below. Counts
    of whole DN do not smooth the rounding. The sum of N uniform errors has the fourth cumulant -N / 120.

    Poisson counts whose steps are visible in the sum are ignored: given the counts, only the remaining noise smooths
    the rounding, and a mixture is never easier to distinguish than its components.
    """
    n = x.n_frames
    blur = np.sqrt(n * (c.gaussian + 1 / 12))
    dark = np.divide(c.dark_dn, c.dark_step, out=np.zeros_like(c.dark_dn), where=c.dark_dn > 0)
    steps = np.stack([c.photon_step, c.dark_step])
    counts = np.where(blur >= SMOOTH_STEPS * steps, np.stack([c.photons, dark]), 0.0)
    frame = c.gaussian + (counts * steps**2).sum(axis=0) + 1 / 12
    # The factors of two, here and below, account for the Poisson counts' skewness and the square of the sawtooth.
    loss = 2 * ((n - 1) / (120 * n**2 * frame**2)) ** 2 / 24
    quietest = float(np.sqrt(c.gaussian.min()))
    last = HARMONICS if HARMONICS * quietest < 1.5 else int(np.ceil(1.5 / quietest))
    for k in range(1, last + 1):
        turned = np.abs(np.sin(np.pi * k * steps))
        size = 2 * np.pi**2 * k**2 * c.gaussian + 2 * (counts * turned**2).sum(axis=0)
        slope = 2 * np.pi * k * c.gaussian + 2 * (counts * steps * turned).sum(axis=0)
        ripple = slope**2 / (n * frame)
        loss += 2 * n / (np.pi**2 * k**2 * frame) * (1 + ripple) * np.exp(np.minimum(ripple - 2 * size, 0.0))
    # Bound on the harmonics beyond `last`, from the Gaussian noise.
    loss += n / frame * np.exp(-4 * np.pi**2 * last**2 * c.gaussian)
    return ~is_noticeable(loss, n * frame)


def polynomial(c: Cumulants) -> tuple[Float, Float, Float, Float, Float]:
    """Return the coefficients of z^0 to z^4 of a draw minus its mean, DN, each shape (n_pixel,)."""
    g1, g2, g3 = c.shape()
    sd = np.sqrt(c.variance)
    return (
        sd * (-g1 / 6 + g3 / 40 - g1 * g2 / 12 + 17 * g1**3 / 324),
        sd * (1 - g2 / 8 + 5 * g1**2 / 36),
        sd * (g1 / 6 - g3 / 20 + 5 * g1 * g2 / 24 - 53 * g1**3 / 324),
        sd * (g2 / 24 - g1**2 / 18),
        sd * (g3 / 120 - g1 * g2 / 24 + g1**3 / 27),
    )
