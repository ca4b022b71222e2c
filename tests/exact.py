"""Exact distributions of whole DN, by Fourier sums of characteristic functions: right to 1e-15 in each probability."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl import Expectation
from mauvecl.device import selftest

Float = NDArray[np.float64]


def counts(
    gaussian: float, poisson: Sequence[tuple[float, float]], mean: float, low: int, size: int, frames: int = 1
) -> Float:
    """Return the probabilities of low, low + 1, ... for the sum of frames that are each rounded to whole DN.

    A frame has a mean, a variance of Gaussian noise, and pairs of a mean Poisson count and the DN of one count.
    """
    sd = np.sqrt(frames * (gaussian + sum(m * s * s for m, s in poisson) + 1 / 12))
    length = int(2 ** np.ceil(np.log2(max(24 * sd + 64, size + 40))))
    t = 2 * np.pi * np.fft.fftfreq(length)
    # What lies 2 pi apart folds together in whole numbers; nine sigma of the Gaussian's own function leave 1e-18.
    folds = int(np.ceil(9 / np.sqrt(gaussian) / (2 * np.pi))) + 1
    found = np.zeros(length, complex)
    for turn in range(-folds, folds + 1):
        w = t + 2 * np.pi * turn
        term = np.exp(-gaussian * w * w / 2 + 1j * w * mean) * np.sinc(w / (2 * np.pi))
        for count, step in poisson:
            term = term * np.exp(count * (np.exp(1j * step * w) - 1 - 1j * step * w))
        found += term
    return np.asarray(np.fft.fft(found**frames * np.exp(-1j * t * low)).real[:size] / length)


def of_polynomial(coefficients: Sequence[float], sd: float, mean: float, low: int, size: int) -> Float:
    """Return the probabilities of mean + sd * (c0 + c1 z + c2 z^2 + ...), rounded, for normal z."""
    power = np.polynomial.Polynomial(coefficients)
    slope, edge = power.deriv(), (np.arange(low, low + size + 1) - 0.5 - mean) / sd
    z = edge.copy()
    for _ in range(8):
        z = np.clip(z - (power(z) - edge) / slope(z), -10, 10)
    return np.where(z[1:] < 0, np.diff(special.ndtr(z)), -np.diff(special.ndtr(-z)))


def draws_to_tell(p: Float, q: Float) -> float:
    """Return the number of draws from q after which Pearson's test against p reaches five sigma."""
    common = p > 1e-14
    return float(5 * np.sqrt(2 * common.sum()) / np.sum((p - q)[common] ** 2 / p[common]))


def worst_tail(p: Float, q: Float) -> float:
    """Return the largest relative error of q's tails where p's lie between 5 and 6 sigma, on either side."""
    found = 0.0
    for way in (slice(None), slice(None, None, -1)):
        one, other = np.cumsum(p[way]), np.cumsum(q[way])
        here = (one > special.ndtr(-6.0)) & (one < special.ndtr(-5.0))
        found = max(found, float(np.abs(other[here] / one[here] - 1).max(initial=0.0)))
    return found


def expansion(
    gaussian: float, poisson: Sequence[tuple[float, float]], *, fourth_power: bool = True, varying: bool = False
) -> tuple[float, Float]:
    """Return the standard deviation of the noise of `counts`, and its Cornish-Fisher polynomial of a normal.

    Without the fourth power of the normal, that of factors on light and dark (`varying`) lacks all of third order.
    """
    sd = float(np.sqrt(gaussian + sum(mean * step**2 for mean, step in poisson)))
    a, b, c = (sum(mean * (step / sd) ** order for mean, step in poisson) for order in (3, 4, 5))
    shape = np.array([
        -a / 6 + c / 40 - a * b / 12 + 17 * a**3 / 324,
        1 - b / 8 + 5 * a**2 / 36,
        a / 6 - c / 20 + 5 * a * b / 24 - 53 * a**3 / 324,
        b / 24 - a**2 / 18,
        c / 120 - a * b / 24 + a**3 / 27,
    ])  # fmt: skip
    if not fourth_power:
        shape[4] = 0.0
        if varying:
            shape[[0, 2]] = -a / 6, a / 6
    return sd, shape


def flat(pixels: int, frames: int, **uniform: Any) -> Expectation:
    """Return an exposure without sky; values of `selftest.toy` and the following may be arrays.

    `photons` are those of a frame, `gain` and `bias` those of the detector.
    """
    given = {"dark": 0.0, "read": 12.0, "photons": 0.0, "gain": 0.6, "bias": 600.0}
    values = {name: uniform.pop(name, value) * np.ones(pixels) for name, value in given.items()}
    names = ("dark_dn", "read_noise_dn", "source_electrons", "gain_dn_per_electron", "bias_dn")
    arrays = dict(zip(names, values.values(), strict=True))
    return replace(selftest.toy(pixels, frames, **uniform), sky_electrons=np.zeros(pixels), **arrays)


def noise_of(x: Expectation, pixel: int = 0) -> tuple[float, list[tuple[float, float]]]:
    """Return the variance of the Gaussian noise of an exposure's sum, and its Poisson counts with their DN."""
    n, step, gain = x.n_frames, float(x.dark_step_dn[pixel]), float(x.gain_dn_per_electron[pixel])
    light = n * float(x.light_electrons[pixel])
    gaussian = n * float(x.read_noise_dn[pixel]) ** 2 + (n - 1) / 12
    poisson = [(n * float(x.dark_dn[pixel]) / step, step)]
    if x.photon_noise == "poisson":
        return gaussian, [*poisson, (light, gain)]
    return gaussian + gain**2 * light, poisson


def span(x: Expectation, pixel: int = 0) -> tuple[int, int]:
    """Return the first whole DN of an exposure's sum that counts, and the number of them."""
    reach = int(9 * np.sqrt(x.variance_dn2[pixel])) + 6
    return int(x.n_frames * x.mean_raw_dn[pixel]) - reach, 2 * reach


def of_stack(x: Expectation, pixel: int = 0) -> Float:
    """Return the probabilities of the DN of `span` for an exposure that is rounded once."""
    return counts(*noise_of(x, pixel), x.n_frames * float(x.mean_raw_dn[pixel]), *span(x, pixel))


def of_frames(x: Expectation, pixel: int = 0) -> Float:
    """Return the same for frames that are each rounded."""
    frame = noise_of(replace(x, n_frames=1), pixel)
    return counts(*frame, float(x.mean_raw_dn[pixel]), *span(x, pixel), x.n_frames)
