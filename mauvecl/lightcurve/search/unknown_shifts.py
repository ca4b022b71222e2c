"""Effect of unknown light, sky and temperature on the false-alarm rate of a search.

A search weights frames by their known variance. If the star is brighter or the detector warmer than assumed, the
scatter of a template's value increases by a factor r, and it exceeds u as often as u / r is exceeded otherwise. If the
baseline has trends that the search neither subtracts nor marginalises over, values are shifted, and exceed u as often
as u less the shift is exceeded otherwise. The unknowns of a stare are drawn from a widened distribution and weighted
accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.false_alarm_rate import WEIGHTING_THRESHOLD, TemplateGrid

if TYPE_CHECKING:
    from collections.abc import Callable

    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]

#: Number of draws of the unknowns, and of times in the stare at which the noise is evaluated.
DRAWS, POINTS = 500, 16
#: Factor by which half of the proposals are widened.
WIDENING = 1.5
#: Second half of the generator's key.
CONDITIONS_KEY = 0x636F6E64
#: Relative change of the scatter that is neglected.
NEGLIGIBLE = 1e-6
#: Shift that is neglected, bin width of shifts, and number of draws of which one is used for shifts.
MIN_SHIFT, SHIFT_STEP, ONE_IN = 0.2, 0.1, 4
#: Largest shift; larger ones are counted in the last bin.
MAX_SHIFT = 60.0


@dataclass(frozen=True, eq=False)
class UnknownShifts:
    """Scatter and shift of templates' values for drawn conditions."""

    scales: Float  # standard deviations of values at some times and all temperatures, nominally 1, shape (n_draw, n)
    weights: Float  # of the draws, sum 1, shape (n_draw,)
    shifts: Float  # means of values, ascending, shape (n_shift,)
    shares: Float  # shares of templates with each mean, shape (n_draw, n_shift)

    @classmethod
    def of(cls, survey: Survey, seed: int, part: Survey | None = None) -> UnknownShifts:
        """Draw the unknowns of a stare and compute scatter and shift of templates' values.

        Parameters
        ----------
        survey : Survey
        seed : int
        part : Survey, optional
            Part of the stare in which shifts are evaluated; all of it by default.
        """
        stare, components, rows = survey.stare, survey.components, survey.bank.directions
        at = np.unique(np.linspace(0, stare.n_frames - 1, POINTS).astype(int))
        rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, CONDITIONS_KEY]))
        n = len(stare.unknowns)
        z = rng.standard_normal((DRAWS, n))
        z[DRAWS // 2 :] *= WIDENING
        log = -np.sum(z**2, axis=1) / 2
        weights = np.exp(log - np.logaddexp(log, log / WIDENING**2 - n * np.log(WIDENING)))
        moved = {of: np.zeros((DRAWS, at.size)) for of in ("star", "light", "sky", "temperature")}
        for amplitude, one in zip(z.T, stare.unknowns, strict=True):
            moved[one.of] += amplitude[:, None] * one.sd * one.curve[at]
        slope = components.quiet.conditions["dark_slope_per_c"]
        coefficients = np.broadcast_to(survey.coefficients[at], (DRAWS, at.size, survey.coefficients.shape[1])).copy()
        coefficients[..., 0] *= (1 + moved["light"]) * (1 + moved["star"])
        coefficients[..., 1] *= (1 + moved["light"]) * (1 + moved["sky"])
        coefficients[..., 2] *= np.exp(slope * moved["temperature"])
        coefficients[..., 3] *= 1 + moved["light"]
        covariance = components.covariance(coefficients)
        for of, direction in components.directions(coefficients).items():
            jitter = stare.jitters.get(of, 0.0)  # type: ignore[call-overload]
            covariance += jitter**2 * direction[..., :, None] * direction[..., None, :]
        variance = np.einsum("dk,ntkl,dl->ntd", rows, covariance, rows, optimize=True) / survey.variance[at, None]
        scales = np.sqrt(np.maximum(variance, 1e-12)).reshape(DRAWS, -1)
        searched = survey if part is None else part
        if not _shifted(searched):
            return cls(scales, weights / weights.sum(), np.zeros(1), np.ones((DRAWS, 1)))
        # The same share of draws from both halves.
        some = slice(None, None, ONE_IN)
        weights = weights[some]
        return cls(scales[some], weights / weights.sum(), *_shifts(searched, z[some]))

    @property
    def is_nominal(self) -> bool:
        """True if scatter and shift are as the search assumes."""
        return bool(np.abs(self.scales - 1).max() < NEGLIGIBLE and not self.shifts.any())

    def alarm_probability(self, threshold: float, days: float, rate: Callable[[Float], Float]) -> Float:
        """Return the probability of an alarm in each draw, shape (n_draw,).

        Parameters
        ----------
        threshold : float
        days : float
            Star-days of the stare.
        rate : callable
            False alarms per star-day at a threshold for the noise that the search assumes.
        """
        rates = np.zeros(self.weights.size)
        largest = np.zeros(self.weights.size)
        for shift, share in zip(self.shifts, self.shares.T, strict=True):
            rates += share * rate((threshold - shift) / self.scales).mean(axis=1)
            largest = np.where(share > 0, shift, largest)
        if not self.shifts.any():
            return np.asarray(-np.expm1(-days * rates))
        # A few templates with a large mean suffice for an alarm.
        return np.asarray(1 - np.exp(-days * rates) * scipy.special.ndtr(threshold - largest))


def _shifted(survey: Survey) -> bool:
    """Return whether unknowns of several standard deviations shift a template's value."""
    if survey.unknowns is None:
        return False
    return bool(survey.search.largest(survey.unsubtracted(survey.unknowns.extremes)).maximum.max() > MIN_SHIFT)


def _shifts(survey: Survey, amplitudes: Float) -> tuple[Float, Float]:
    """Return binned means of templates' values, and the share of templates in each bin for each draw."""
    bins = np.arange(-MAX_SHIFT, MAX_SHIFT + SHIFT_STEP, SHIFT_STEP)
    shares = np.zeros((len(amplitudes), bins.size))
    weights = TemplateGrid.from_bank(survey.bank).peak_probabilities(WEIGHTING_THRESHOLD)
    for draw, amplitude in enumerate(amplitudes):
        for (row, rho), weight in zip(survey.search.values(survey.unsubtracted(amplitude[None])), weights, strict=True):
            means = rho[0][:, row.per_amplitude > 0]
            place = np.clip(np.rint((means + MAX_SHIFT) / SHIFT_STEP), 0, bins.size - 1).astype(np.int64)
            each = np.broadcast_to(weight[:, None], means.shape)
            shares[draw] += np.bincount(place.ravel(), each.ravel(), bins.size)
    shares /= shares.sum(axis=1, keepdims=True)
    used = shares.any(axis=0)
    return bins[used], shares[:, used]
