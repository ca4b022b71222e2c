"""Noise that is not what a search takes it for: of stares whose light, sky or temperature are not the known ones.

A search weighs frames by their known variance. Where the star is brighter than that, or the detector warmer, a
template's value scatters by a factor r more, and exceeds u as often as u / r would be exceeded without. What is unknown
of a stare is drawn, some of it farther out than it is distributed, with weights that make up for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
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


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of templates' values under conditions that are drawn.

    Attributes
    ----------
    scales : ndarray, shape (n_draw, n)
        Standard deviation of a template's value, at some times and for every temperature, where the search takes one.
    weights : ndarray, shape (n_draw,)
        Their sum is one.
    """

    scales: Float
    weights: Float

    @classmethod
    def of(cls, survey: Survey, seed: int) -> Scatter:
        """What a stare's unknowns do to the frames."""
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
        return cls(np.sqrt(np.maximum(variance, 1e-12)).reshape(DRAWS, -1), weights / weights.sum())

    @property
    def known(self) -> bool:
        """Whether they are what the search takes them for."""
        return bool(np.abs(self.scales - 1).max() < LEAST)
