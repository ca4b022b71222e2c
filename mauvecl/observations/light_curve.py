"""Search of light curves: quiescent level, noise, and the frames that are searched."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.detection import fit_quiet_light
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.level import (
    FAR,
    MOST_BELOW,
    PER_MAD,
    QuiescentLevel,
    counts_per_unit,
    guess_flares,
    level_error,
    quiet_variance,
    single_frames,
    spikes,
)
from mauvecl.observations.losses import sudden_losses
from mauvecl.observations.search import SeriesSurvey
from mauvecl.observations.steps import Steps
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Smallest number of frames without a fault.
MIN_USABLE = 10
#: Largest number of times that single frames are left out and the rest is fitted again.
ROUNDS = 3


def survey_light_curve(
    frames: Frames, shape: Shape, seed: int, steps: Steps | None = None
) -> tuple[SeriesSurvey, QuiescentLevel, Frames]:
    """Fit the quiescent light of a light curve, and prepare its search.

    Parameters
    ----------
    seed : int
        Seed of the standard error of the level.
    steps : Steps, optional
        Reports fits, searches and draws.

    Returns
    -------
    survey : SeriesSurvey
    level : QuiescentLevel
    frames : Frames
        With a remark, and without errors, if they hold few counts.
    """
    steps = steps or Steps()
    fits = steps.part(0.0, 0.9)
    counts = counts_per_unit(frames)
    if counts is not None:
        remark = "the frames hold few counts: their noise is Poisson noise of the level, and stated errors are not used"
        frames = replace(frames, error=None).with_remarks((remark,))
    flux, error = frames.white_light
    reasons = frames.faults.copy()
    check_usable(frames, reasons)
    if counts is None:
        reasons[spikes(frames.numbers, flux, error, reasons == 0)] |= Reason.SPIKE
    used = reasons == 0
    guessed = np.zeros(flux.size, np.bool_)
    survey: SeriesSurvey | None = None
    for number in range(ROUNDS):
        used = reasons == 0
        if survey is None:
            guessed[used] = guess_flares(frames.numbers[used], flux[used])
            level = np.full(flux.size, _mean(flux[used & ~guessed]))
        quiet = used & ~guessed
        variance, photon = _noise(frames, flux, error, level, quiet, counts)
        typical = float(np.median(level[quiet]))
        new = SeriesSurvey.of(frames, flux, variance, used, typical, photon, shape, counts or 0.0)
        survey, taken = fit_quiet_light(new, guessed[used], survey, fits)
        if number == 0 and counts is None and (lost := sudden_losses(new, survey, taken, fits)).any():
            reasons[used] |= np.where(lost, Reason.LOSS, 0)
            survey = None
            continue
        level = level_of(frames, flux, used, survey, ~taken)
        sd = np.sqrt(variance) * survey.flux_process.excess
        guessed = np.zeros(flux.size, np.bool_)
        guessed[used] = taken
        flagged = _single(frames, flux, level, sd, used, guessed, counts)
        if not flagged[used].any():
            break
        reasons = np.where(used, reasons | flagged, reasons)
    assert survey is not None
    finite = np.isfinite(flux)
    below = finite & (reasons != 0) & (np.where(finite, flux, 0.0) - level < -FAR * sd)
    reasons = np.where(below, reasons | Reason.BELOW, reasons)
    used = reasons == 0
    survey = survey.frames(used[searched_among(survey, frames)])
    draws = steps.part(0.9, 1.0)
    light = quiescent_light(frames, flux, error, survey, used, used & ~guessed, reasons, seed, draws)
    return survey, light, frames


def searched_among(survey: SeriesSurvey, frames: Frames) -> NDArray[np.intp]:
    """Return the numbers of a survey's frames among all frames, shape (n_searched,)."""
    return np.searchsorted(frames.time_s, survey.time_s)


def check_usable(frames: Frames, reasons: NDArray[np.int64]) -> None:
    """Raise InputError if too few frames are without a fault, or if most of them have the same flux."""
    usable = reasons == 0
    if usable.sum() < MIN_USABLE:
        raise InputError(
            f"{frames.name} has {usable.sum()} frames without a fault",
            f"at least {MIN_USABLE}",
            key="frames",
            value=int(usable.sum()),
        )
    flux = frames.white_light[0][usable]
    if (np.diff(flux) == 0).mean() > 0.5 and counts_per_unit(frames) is None:
        raise InputError(
            f"{frames.name}: the flux of most frames is the same",
            "a light curve with noise",
            key="flux",
            value=float(np.median(flux)),
        )


def _mean(flux: Float) -> float:
    """Return the mean without outliers; a median of whole numbers would be one of them."""
    middle = float(np.median(flux))
    spread = PER_MAD * float(np.median(np.abs(flux - middle)))
    near = np.abs(flux - middle) <= max(FAR * spread, 1e-12 * abs(middle))
    return float(flux[near].mean())


def _noise(
    frames: Frames, flux: Float, error: Float | None, level: Float, quiet: Bool, counts: float | None
) -> tuple[Float, float]:
    """Return the variance of the noise of each frame at its level, and its rise with the flux."""
    if counts is not None:
        return np.maximum(level, 1e-3 * float(np.median(level[quiet])) + 1e-300) / counts, 1.0 / counts
    if error is not None:
        return quiet_variance(flux, error, level, quiet)
    steps = np.diff(flux[quiet])[np.diff(frames.numbers[quiet]) == 1]
    spread = PER_MAD * float(np.median(np.abs(steps))) / np.sqrt(2.0) if steps.size else 0.0
    return np.full(flux.size, (spread if spread > 0 else float(np.std(flux[quiet]))) ** 2), 0.0


def level_of(frames: Frames, flux: Float, used: Bool, survey: SeriesSurvey, quiet: Bool) -> Float:
    """Return the quiescent level of all frames, shape (n_frame,); between searched frames it is interpolated.

    Parameters
    ----------
    used : ndarray of bool, shape (n_frame,)
        Frames of the survey.
    quiet : ndarray of bool, shape (n_used,)
    """
    return np.interp(frames.time_s, frames.time_s[used], survey.flux_level(quiet) * survey.scale)


def _single(
    frames: Frames, flux: Float, level: Float, sd: Float, used: Bool, events: Bool, counts: float | None
) -> NDArray[np.int64]:
    """Return the reasons not to search single frames: far below the level, or alone far above it."""
    sigmas = np.where(used, (flux - level) / sd, 0.0)
    flagged = np.zeros(flux.size, np.int64)
    below = (sigmas < -FAR) & ~events
    if below.mean() <= MOST_BELOW:
        flagged[below] = Reason.BELOW
    if counts is None:
        flagged[single_frames(frames.numbers, sigmas, used)] |= Reason.SPIKE
    return flagged


def quiescent_light(
    frames: Frames, flux: Float, error: Float | None, survey: SeriesSurvey, used: Bool, quiet: Bool,
    reasons: NDArray[np.int64], seed: int, steps: Steps,
) -> QuiescentLevel:  # fmt: skip
    """Return level, its error, and noise of all frames."""
    process, time = survey.flux_process, survey.stare.start_s
    part = quiet[used]
    level = level_of(frames, flux, used, survey, part)

    def everywhere(values: Float) -> Float:
        return np.interp(frames.time_s, frames.time_s[used], values * survey.scale)

    return QuiescentLevel(
        level,
        everywhere(level_error(process, time, survey.flux_variance, part, seed, steps)),
        everywhere(np.sqrt(survey.flux_variance) * process.excess),
        process.excess if error is not None else float("nan"),
        quiet,
        reasons,
        process,
    )
