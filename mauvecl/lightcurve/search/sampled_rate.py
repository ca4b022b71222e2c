"""False-alarm rate of a survey by importance sampling, with the unknowns of its stare.

A search weights frames by their known variance and marginalises over known curves. The unknowns of a stare are drawn
from a widened distribution and weighted accordingly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.false_alarm_rate import WEIGHTING_THRESHOLD, TemplateGrid
from mauvecl.lightcurve.search.importance_sampling import SampledRate, sample_rate
from mauvecl.lightcurve.search.unknown_shifts import UnknownShifts

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]

#: Largest length of the part of a stare that importance sampling uses, star-days.
SAMPLED_DAYS = 2.0
#: Number of draws of the unknowns, and of times in the stare at which the noise is evaluated.
DRAWS, POINTS = 500, 16
#: Factor by which half of the proposals are widened.
WIDENING = 1.5
#: Second half of the generator's key.
CONDITIONS_KEY = 0x636F6E64
#: Shift that is neglected, bin width of shifts, and number of draws of which one is used for shifts.
MIN_SHIFT, SHIFT_STEP, ONE_IN = 0.2, 0.1, 4
#: Largest shift; larger ones are counted in the last bin.
MAX_SHIFT = 60.0


def sampled_rate(survey: Survey, seed: int) -> SampledRate:
    """Estimate the false-alarm rate of a survey by importance sampling, including the unknowns of its stare."""
    part = survey.of_days(SAMPLED_DAYS)
    return sample_rate(part.search, seed=seed).under(draw_shifts(survey, seed, part))


def draw_shifts(survey: Survey, seed: int, part: Survey | None = None) -> UnknownShifts:
    """Draw the unknowns of a stare and compute scatter and shift of templates' values.

    Parameters
    ----------
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
        return UnknownShifts(scales, weights / weights.sum(), np.zeros(1), np.ones((DRAWS, 1)))
    # The same share of draws from both halves.
    some = slice(None, None, ONE_IN)
    weights = weights[some]
    return UnknownShifts(scales[some], weights / weights.sum(), *_shifts(searched, z[some]))


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
