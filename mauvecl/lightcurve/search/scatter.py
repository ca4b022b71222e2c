"""Noise that is not what a search takes it for: of stares whose light, sky or temperature are not the known ones.

A search weighs frames by their known variance. Where the star is brighter than that, or the detector warmer, a
template's value scatters by a factor r more, and exceeds u as often as u / r would be exceeded without. Where the level
does what the search neither subtracts nor marginalises over, values are shifted, and exceed u as u less the shift would
be. What is unknown of a stare is drawn, some of it farther out than it is distributed, with weights that make up for
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.trials import WEIGHED_AT, Trials

if TYPE_CHECKING:
    from collections.abc import Callable

    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]

#: Draws of what is unknown, and times of the stare at which they are looked at.
DRAWS, POINTS = 500, 16
#: Half of the draws are so many times as far out.
FARTHER = 1.5
#: Second half of the generator's key.
CONDITIONS_KEY = 0x636F6E64
#: Relative change of a scatter below which it is none.
LEAST = 1e-6
#: Shift of a value below which it is none, at unknowns that are far out; steps of shifts; draws of which one is taken.
LEAST_SHIFT, SHIFT_STEP, ONE_IN = 0.2, 0.1, 4
#: Largest shift that is told from larger ones.
MOST_SHIFT = 60.0


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of templates' values under conditions that are drawn.

    Attributes
    ----------
    scales : ndarray, shape (n_draw, n)
        Standard deviation of a template's value, at some times and for every temperature, where the search takes one.
    weights : ndarray, shape (n_draw,)
        Their sum is one.
    shifts : ndarray, shape (n_shift,)
        Means of templates' values, ascending.
    shares : ndarray, shape (n_draw, n_shift)
        Of templates that have each mean.
    """

    scales: Float
    weights: Float
    shifts: Float
    shares: Float

    @classmethod
    def of(cls, survey: Survey, seed: int, part: Survey | None = None) -> Scatter:
        """Return what a stare's unknowns do to the frames, and to the values of templates.

        Parameters
        ----------
        survey : Survey
        seed : int
        part : Survey, optional
            Of frames over which values are looked at; all of them by default.
        """
        stare, components, rows = survey.stare, survey.components, survey.bank.directions
        at = np.unique(np.linspace(0, stare.n_frames - 1, POINTS).astype(int))
        rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, CONDITIONS_KEY]))
        n = len(stare.unknowns)
        z = rng.standard_normal((DRAWS, n))
        z[DRAWS // 2 :] *= FARTHER
        log = -np.sum(z**2, axis=1) / 2
        weights = np.exp(log - np.logaddexp(log, log / FARTHER**2 - n * np.log(FARTHER)))
        moved = {of: np.zeros((DRAWS, at.size)) for of in ("star", "light", "sky", "temperature")}
        for amplitude, one in zip(z.T, stare.unknowns, strict=True):
            moved[one.of] += amplitude[:, None] * one.sd * one.curve[at]
        slope = components.quiet.conditions["dark_slope_per_c"]
        coefficients = np.broadcast_to(survey.coefficients[at], (DRAWS, at.size, survey.coefficients.shape[1])).copy()
        coefficients[..., 0] *= (1 + moved["light"]) * (1 + moved["star"])
        coefficients[..., 1] *= (1 + moved["light"]) * (1 + moved["sky"])
        coefficients[..., 2] *= np.exp(slope * moved["temperature"])
        covariance = components.covariance(coefficients)
        for of, direction in components.directions(coefficients).items():
            jitter = stare.jitters.get(of, 0.0)  # type: ignore[call-overload]
            covariance += jitter**2 * direction[..., :, None] * direction[..., None, :]
        variance = np.einsum("dk,ntkl,dl->ntd", rows, covariance, rows, optimize=True) / survey.variance[at, None]
        scales = np.sqrt(np.maximum(variance, 1e-12)).reshape(DRAWS, -1)
        searched = survey if part is None else part
        if not _shifted(searched):
            return cls(scales, weights / weights.sum(), np.zeros(1), np.ones((DRAWS, 1)))
        # Every so many draws of either half.
        some = slice(None, None, ONE_IN)
        weights = weights[some]
        return cls(scales[some], weights / weights.sum(), *_shifts(searched, z[some]))

    @property
    def known(self) -> bool:
        """Whether they are what the search takes them for."""
        return bool(np.abs(self.scales - 1).max() < LEAST and not self.shifts.any())

    def alarmed(self, threshold: float, days: float, rate: Callable[[Float], Float]) -> Float:
        """Return the probability of an alarm in each draw, shape (n_draw,).

        Parameters
        ----------
        threshold : float
        days : float
            Star-days of the stare.
        rate : callable
            False alarms per star-day at a threshold where the noise is what the search takes it for.
        """
        rates = np.zeros(self.weights.size)
        largest = np.zeros(self.weights.size)
        for shift, share in zip(self.shifts, self.shares.T, strict=True):
            rates += share * rate((threshold - shift) / self.scales).mean(axis=1)
            largest = np.where(share > 0, shift, largest)
        if not self.shifts.any():
            return np.asarray(-np.expm1(-days * rates))
        # Few templates with a large mean alarm all the same.
        return np.asarray(1 - np.exp(-days * rates) * scipy.special.ndtr(threshold - largest))


def _shifted(survey: Survey) -> bool:
    """Return whether unknowns far out shift a template's value."""
    if survey.unknowns is None:
        return False
    return bool(survey.search.largest(survey.left(survey.unknowns.far)).maximum.max() > LEAST_SHIFT)


def _shifts(survey: Survey, amplitudes: Float) -> tuple[Float, Float]:
    """Return the means of templates' values in steps, and the share of templates that have each, for each draw."""
    bins = np.arange(-MOST_SHIFT, MOST_SHIFT + SHIFT_STEP, SHIFT_STEP)
    shares = np.zeros((len(amplitudes), bins.size))
    weights = Trials.of(survey.bank).peaked(WEIGHED_AT)
    for draw, amplitude in enumerate(amplitudes):
        for (row, rho), weight in zip(survey.search.values(survey.left(amplitude[None])), weights, strict=True):
            means = rho[0][:, row.per_amplitude > 0]
            place = np.clip(np.rint((means + MOST_SHIFT) / SHIFT_STEP), 0, bins.size - 1).astype(np.int64)
            each = np.broadcast_to(weight[:, None], means.shape)
            shares[draw] += np.bincount(place.ravel(), each.ravel(), bins.size)
    shares /= shares.sum(axis=1, keepdims=True)
    met = shares.any(axis=0)
    return bins[met], shares[:, met]
