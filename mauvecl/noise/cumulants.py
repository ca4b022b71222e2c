"""The noise of one draw by its cumulants, and as a polynomial of one normal.

Gaussian and Poisson noise of a pixel reach the ADC as a sum. Its distribution is fixed by its cumulants, which
simply add, and the Cornish-Fisher expansion (1938, doi 10.2307/1400905; Abramowitz & Stegun 26.2.49) turns one normal
into it. Where Gaussian noise smooths the Poisson steps away, no number of draws that anyone makes could tell.
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

#: Gaussian noise of this many Poisson steps leaves 2 exp(-2 pi^2 1.5^2) = 1e-19 of the steps.
SMOOTH_STEPS = 1.5
#: Up to this skewness what the expansion leaves out is ruled by its first terms, which `left_out` counts.
MOST_SKEW = 0.04
#: What is drawn in another way than frame by frame and count by count would show in Pearson's test of whole DN, at five
#: sigma, after so many draws of one pixel by the estimate here. By exact convolution the worst of all that is allowed
#: lies at 4e13 (tests/kernels/test_joint_bound.py, tests/noise/test_stacks.py): met by the payload at every temperature
#: and exposure with its cheapest draws, some at 5e13 to 1e14.
DRAWS_TO_NOTICE = 4.2e13
#: Of the sawtooth of rounding, at most; beyond them a Gaussian of .02 DN leaves nothing.
HARMONICS = 64


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

    def over_sd(self, last: int) -> list[Float]:
        """As `shape` up to a higher order, by products, which are cheaper than powers."""
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
        """The same draw with so many times the light and the dark."""
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


def shows(distance: Float, variance: Float) -> NDArray[np.bool_]:
    """Whether Pearson's test would notice within `DRAWS_TO_NOTICE` draws, by the distance sum (p - q)^2 / p.

    Five sigma of chi-squared, whose degrees of freedom are the whole DN within 7.65 standard deviations: those of a
    probability above 1e-14.
    """
    steps = np.maximum(15.3 * np.sqrt(variance), 1.0)
    return np.asarray(distance * DRAWS_TO_NOTICE > 5.0 * np.sqrt(2.0 * steps))


def left_out(c: Cumulants, *, fourth_power: bool, varying: bool = False) -> Float:
    """Pearson's distance between a draw and its polynomial, by the next terms of the expansion, shape (n_pixel,).

    A term a He_k(z) moves the density by a He_(k + 1)(z) times the normal's, and the squares of these integrate to
    a^2 (k + 1)!. Rounding to whole DN can only shorten the distance.

    Parameters
    ----------
    c : Cumulants
    fourth_power : bool
        Whether the polynomial goes up to z^4, or stops short of it.
    varying : bool
        Whether it is the kernels' one for factors on light and dark, which without the fourth power has no term of
        gamma_5, rather than `polynomial`.
    """
    return expansion_error(c.over_sd(7), fourth_power=fourth_power, varying=varying)


def expansion_error(over_sd: Sequence[Float], *, fourth_power: bool, varying: bool = False) -> Float:
    """`left_out` from the third to seventh cumulants over their powers of the standard deviation."""
    g3, g4, g5, g6, g7 = over_sd
    g3_3 = g3 * g3 * g3
    g3_4 = g3_3 * g3
    # Abramowitz & Stegun 26.2.49 with gamma_1 there gamma_3 here: the terms after those of `polynomial`.
    fifth = g6 / 720 - 3 * g4**2 / 384 - 2 * g3 * g5 / 180 + 14 * g3**2 * g4 / 288 - 252 * g3_4 / 7776
    third = -6 * g4**2 / 384 - 3 * g3 * g5 / 180 + 37 * g3**2 * g4 / 288 - 832 * g3_4 / 7776
    first = -2 * g4**2 / 384 + 8 * g3**2 * g4 / 288 - 227 * g3_4 / 7776
    loss = 720 * fifth**2 + 24 * third**2 + 2 * first**2 + g7**2 / 5040
    if not fourth_power:
        second = 19 * g3_3 / 324 - g3 * g4 / 24
        fourth = g5 / 120 - g3 * g4 / 24 + g3_3 / 27
        # Without gamma_5 both Hermite terms are missing; `polynomial` lacks z^4 = He_4 + 6 He_2 + 3 alone.
        loss = loss + (120 * fourth**2 + 6 * second**2 if varying else 345 * fourth**2)
    return np.asarray(loss)


def joint_is_exact(c: Cumulants) -> NDArray[np.bool_]:
    """Pixels whose whole noise may be drawn from one normal, shape (n_pixel,)."""
    step = np.maximum(np.where(c.dark_dn > 0, c.dark_step, 0.0), np.where(c.photons > 0, c.photon_step, 0.0))
    smooth = np.sqrt(c.gaussian) >= SMOOTH_STEPS * step
    return np.asarray(smooth & (c.over_sd(3)[0] <= MOST_SKEW) & ~shows(left_out(c, fourth_power=True), c.variance))


def needs_fourth_power(c: Cumulants, *, varying: bool = False) -> bool:
    """Whether leaving the last power of the polynomial out would show; see `left_out`."""
    return bool(shows(left_out(c, fourth_power=False, varying=varying), c.variance).any())


def stack_is_exact(c: Cumulants, x: Expectation) -> NDArray[np.bool_]:
    """Pixels whose frames may be drawn as one stack, shape (n_pixel,).

    Parameters
    ----------
    c : Cumulants
        Of ONE frame.
    x : Expectation

    Notes
    -----
    A stack takes each frame's rounding for noise of mean 0 and variance 1/12 that is Gaussian in the sum. The error
    of rounding is a sawtooth, the sum over k of sin(2 pi k x) / (pi k), so what it knows of the frame's own noise is
    the characteristic function there (Widrow, Kollar & Liu 1996, doi 10.1109/19.492748): f_k its size and l_k the
    slope of its logarithm at 2 pi k. Given the sum of N frames of variance v, a frame's sine is f_k exp(u_k / 2) at
    most, u_k = l_k^2 / (N v), which moves the sum's density by Pearson's distance below. Counts of whole DN blur no
    rounding at all. The sum of N uniform errors has the fourth cumulant -N / 120.

    Poisson counts whose steps show in the sum do not help: given the counts, the rest stands alone, and a mixture is
    never told more easily than its parts.
    """
    n = x.n_frames
    blur = np.sqrt(n * (c.gaussian + 1 / 12))
    dark = np.divide(c.dark_dn, c.dark_step, out=np.zeros_like(c.dark_dn), where=c.dark_dn > 0)
    steps = np.stack([c.photon_step, c.dark_step])
    counts = np.where(blur >= SMOOTH_STEPS * steps, np.stack([c.photons, dark]), 0.0)
    frame = c.gaussian + (counts * steps**2).sum(axis=0) + 1 / 12
    # Twice, here and below: for the Poisson counts' skew, and the sawtooth's square.
    loss = 2 * ((n - 1) / (120 * n**2 * frame**2)) ** 2 / 24
    quietest = float(np.sqrt(c.gaussian.min()))
    last = HARMONICS if HARMONICS * quietest < 1.5 else int(np.ceil(1.5 / quietest))
    for k in range(1, last + 1):
        turned = np.abs(np.sin(np.pi * k * steps))
        size = 2 * np.pi**2 * k**2 * c.gaussian + 2 * (counts * turned**2).sum(axis=0)
        slope = 2 * np.pi * k * c.gaussian + 2 * (counts * steps * turned).sum(axis=0)
        ripple = slope**2 / (n * frame)
        loss += 2 * n / (np.pi**2 * k**2 * frame) * (1 + ripple) * np.exp(np.minimum(ripple - 2 * size, 0.0))
    # What lies beyond is left to the Gaussian noise.
    loss += n / frame * np.exp(-4 * np.pi**2 * last**2 * c.gaussian)
    return ~shows(loss, n * frame)


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
