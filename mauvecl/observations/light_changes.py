"""Sudden changes of the light that all pixels of spectra share, as by pointing losses and re-acquisitions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.observations.level import PER_MAD

Float = NDArray[np.float64]

#: Numbers of frames before and after a change whose means are compared.
WIDTHS = (2, 4, 8, 16, 32, 64)
#: Expected number of changes that noise feigns in a light curve.
CHANCE = 0.001
#: Fall of chi-squared by which one cause must fit better than another: 3 standard deviations for one parameter.
CLEARLY = 9.0
#: Frames that may be missing in the frames that are compared.
MISSING = 3


@dataclass(frozen=True)
class LightChange:
    """Change of the light that all pixels share."""

    frame: int  # first frame after the change
    width: int  # number of frames before and after it that are compared
    # change, error: light after the change less that before, relative to the quiescent star, and its standard error.
    change: float
    error: float


def chi2_of_one(spectrum: Float, variance: Float, rows: Float) -> Float:
    """Return chi-squared of a spectrum with each of some spectra alone, whose amplitude is fitted, shape (n_row,)."""
    along = rows @ (spectrum / variance)
    whole = float((spectrum**2 / variance).sum())
    return np.asarray(whole - along**2 / np.einsum("kp,kp->k", rows, rows / variance))


def light_changes(
    excess: Float, frames: NDArray[np.intp], numbers: NDArray[np.int64], light: Float, others: Float, sd: Float
) -> list[LightChange]:  # fmt: skip
    """Find sudden changes of the light that all pixels share, in order of time.

    The light is fitted to each frame, and its means before and after each frame are compared. A change counts if the
    spectrum of the difference is clearly that of the star rather than one of `others`.

    Parameters
    ----------
    excess : ndarray, shape (n_frame, n_pixel)
        Spectra less that of the quiescent star.
    frames : ndarray of int
        Frames that are compared, ascending.
    numbers : ndarray of int, shape (n_frame,)
        Numbers of all frames on the regular grid.
    light : ndarray, shape (n_pixel,)
        Spectrum of the quiescent star.
    others : ndarray, shape (k, n_pixel)
        Spectra of flares, dark current and sky.
    sd : ndarray, shape (n_pixel,)
        Noise of a frame.
    """
    weights = light / sd**2 / float(((light / sd) ** 2).sum())
    amplitude, at = excess[frames] @ weights, numbers[frames]
    noise = PER_MAD * float(np.median(np.abs(np.diff(amplitude)))) / np.sqrt(2.0)
    widths = [width for width in WIDTHS if 4 * width <= amplitude.size]
    if not widths or not noise > 0:
        return []
    limit = float(scipy.stats.norm.isf(CHANCE / 2 / amplitude.size / len(widths)))
    total = np.concatenate([[0.0], np.cumsum(amplitude)])
    sizes = np.zeros((len(widths), amplitude.size))
    for row, width in zip(sizes, widths, strict=True):
        k = np.arange(width, amplitude.size - width + 1)
        whole = at[k + width - 1] - at[k - width] <= 2 * width - 1 + MISSING
        row[k[whole]] = ((total[k + width] - 2 * total[k] + total[k - width]) / width)[whole]
    errors = noise * np.sqrt(2.0 / np.array(widths))[:, None]
    significance = np.abs(sizes) / errors
    found = []
    while significance.max() > limit:
        best, place = divmod(int(significance.argmax()), amplitude.size)
        width = widths[best]
        step = excess[frames[place : place + width]].mean(axis=0) - excess[frames[place - width : place]].mean(axis=0)
        variance = 2 * sd**2 / width
        if chi2_of_one(step, variance, light[None])[0] < chi2_of_one(step, variance, others).min() - CLEARLY:
            found.append(LightChange(int(frames[place]), width, float(sizes[best, place]), float(errors[best, 0])))
        # Windows that overlap this one see the same change.
        for other, wide in zip(significance, widths, strict=True):
            other[max(0, place - width - wide + 1) : place + width + wide] = 0.0
    return sorted(found, key=lambda one: one.frame)
