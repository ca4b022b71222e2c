"""Exact distributions of whole DN, by Fourier sums of characteristic functions: right to 1e-15 in each probability."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

Float = NDArray[np.float64]


def counts(
    gaussian: float, poisson: Sequence[tuple[float, float]], mean: float, low: int, size: int, frames: int = 1
) -> Float:
    """Return the probabilities of low, low + 1, ... for the sum of frames that are each rounded to whole DN.

    Parameters
    ----------
    gaussian : float
        Variance of a frame's Gaussian noise, above 0.
    poisson : sequence of (mean count, DN of one count)
    mean : float
        Of one frame.
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
    """Return the standard deviation of Gaussian and Poisson noise, and its Cornish-Fisher polynomial of a normal.

    Parameters
    ----------
    gaussian, poisson
        As in `counts`.
    fourth_power : bool
        Whether the polynomial includes z^4.
    varying : bool
        Whether it is that of factors on light and dark: without the fourth power, it lacks all of third order.
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


def pearson(found: NDArray[np.int64], probability: Float) -> float:
    """Return the two-sided p-value of Pearson's statistic, with rare outcomes in one bin."""
    expected = found.sum() * probability
    common = expected > 20
    observed = np.append(found[common], found[~common].sum())
    wanted = np.append(expected[common], found.sum() - expected[common].sum())
    if wanted[-1] < 20:
        observed, wanted = observed[:-1], wanted[:-1]
    upper = float(special.chdtrc(observed.size - 1, np.sum((observed - wanted) ** 2 / wanted)))
    return 2 * min(upper, 1 - upper)
