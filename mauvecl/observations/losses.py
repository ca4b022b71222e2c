"""Sudden losses of light in light curves: drifts out of the fibre, eclipses and dips of young stars."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.lightcurve.flares.shapes import Shape
from mauvecl.observations.detection import PROVISIONAL, alternate, criterion, detect_events
from mauvecl.observations.search import bank_of

if TYPE_CHECKING:
    from mauvecl.observations.search import SeriesSurvey

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Share of the frames in events of a star whose light is constant, and of one that rotates, and noise relative to the
#: stated one, above which losses are tried (assumed).
MOST_FLARING, MOST_ACTIVE, MOST_EXCESS = 0.1, 0.3, 1.5
#: Largest share of the frames in losses; more of them are the level of the star, before or after a step (assumed).
MOST_LOST = 0.4
#: Standard deviations of a frame above the median of a constant light from which frames belong to flares; their number
#: before and, relative to the length, after the bright frames; the largest share of such frames (assumed).
BRIGHT, BEFORE, DECAY, MOST_BRIGHT = 4.0, 2, 3, 0.3


class Loss(Shape):
    """A constant loss that begins and ends suddenly, for two half-widths."""

    name = "loss"
    source = "assumed"
    peak_at = 0.0
    square_integral = 2.0

    def at(self, tau: ArrayLike) -> Float:
        return (np.abs(tau) <= 1.0).astype(np.float64)

    def before(self, tau: ArrayLike) -> Float:
        return np.clip(np.asarray(tau, np.float64) + 1.0, 0.0, 2.0)

    def after(self, tau: ArrayLike) -> Float:
        return np.clip(1.0 - np.asarray(tau, np.float64), 0.0, 2.0)


def sudden_losses(survey: SeriesSurvey, fitted: SeriesSurvey, taken: Bool) -> Bool:
    """Return the frames in which light is lost, if losses explain a light curve better than flares do.

    Without losses, a star does not flare in many of its frames, keeps its noise, and varies slowly. Where that does not
    hold, the light curve is searched upside down for losses, and the smaller Bayesian information criterion decides.

    Parameters
    ----------
    survey : SeriesSurvey
        Without processes.
    fitted : SeriesSurvey
    taken : ndarray of bool, shape (n_frame,)
        Process and events of `fit_quiet_light`.

    Returns
    -------
    ndarray of bool, shape (n_frame,)
    """
    none, process = np.zeros_like(taken), fitted.flux_process
    rotates = any(term.kind == "rotation" for term in process.terms)
    fast = any(term.kind != "rotation" and term.scale_s < survey.stare.duration_s / 3 for term in process.terms)
    many = taken.mean() > (MOST_ACTIVE if rotates else MOST_FLARING)
    if survey.weighted or not (many or process.excess > MOST_EXCESS or fast):
        return none
    dark = ~_bright(survey)
    survey, fitted, taken = survey.frames(dark), fitted.frames(dark), taken[dark]
    down = replace(survey.inverted(), bank=bank_of(survey.stare, survey.bank.directions, Loss()))
    # Losses in independent noise are the first guess: a process that is fitted to losses would hide them.
    other, losses = alternate(down, detect_events(down, PROVISIONAL)[1])
    if 0 < losses.mean() < MOST_LOST and criterion(other, losses, shapeless=True) < criterion(fitted, taken):
        none[dark] = losses
    return none


def _bright(survey: SeriesSurvey) -> Bool:
    """Return frames far above the level that most frames have, and those after them, as long as flares decay."""
    sigmas = (survey.flux - np.median(survey.flux)) / np.sqrt(survey.flux_variance)
    edges = np.diff((sigmas > BRIGHT).astype(np.int8), prepend=0, append=0)
    bright = np.zeros(sigmas.size, np.bool_)
    for first, stop in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        bright[max(0, first - BEFORE) : stop + DECAY * (stop - first)] = True
    return bright if bright.mean() < MOST_BRIGHT else np.zeros_like(bright)
