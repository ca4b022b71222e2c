"""Colour of an event in a sequence of spectra, which distinguishes a flare from a change of throughput."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Colour:
    """Spectrum of an event against the spectrum of the quiescent star."""

    # chi2, dof: chi-squared of the event's spectrum as a multiple of the quiescent one.
    chi2: float
    dof: int
    # Probability of a chi-squared at least as large for an event without colour, such as a step of the throughput.
    p_value: float
    # Rise relative to the quiescent star in the blue half of the pixels over that in the red half: 1 without colour.
    blue_over_red: float
    blue_over_red_error: float


def event_colour(spectra: Float, error: Float, event: NDArray[np.bool_], quiet: NDArray[np.bool_]) -> Colour:
    """Compare the mean spectrum of an event with that of the quiescent star.

    Parameters
    ----------
    spectra, error : ndarray, shape (n_frame, n_pixel)
        Pixels in order of wavelength; those that are not finite in a frame are left out.
    event, quiet : ndarray of bool, shape (n_frame,)
        Frames of the event, and of the quiescent star near it.
    """
    fine = np.isfinite(spectra).all(axis=0) & np.isfinite(error).all(axis=0) & (error > 0).all(axis=0)
    spectra, error = spectra[:, fine], error[:, fine]
    star = spectra[quiet].mean(axis=0)
    excess = spectra[event].mean(axis=0) - star
    count, base = np.count_nonzero(event), np.count_nonzero(quiet)
    variance = (error[event] ** 2).sum(axis=0) / count**2 + (error[quiet] ** 2).sum(axis=0) / base**2
    scale = _multiple(excess, star, variance)
    chi2 = float(((excess - scale[0] * star) ** 2 / variance).sum())
    dof = int(fine.sum()) - 1
    half = fine.sum() // 2
    blue, red = (_multiple(excess[part], star[part], variance[part]) for part in (slice(None, half), slice(half, None)))
    ratio = blue[0] / red[0]
    relative = np.hypot(blue[1] / blue[0], red[1] / red[0])
    return Colour(chi2, dof, float(scipy.stats.chi2.sf(chi2, dof)), float(ratio), float(abs(ratio) * relative))


def _multiple(excess: Float, star: Float, variance: Float) -> tuple[float, float]:
    """Return the best multiple of the star in a spectrum, and its standard error."""
    information = float((star**2 / variance).sum())
    return float((excess * star / variance).sum()) / information, information**-0.5
