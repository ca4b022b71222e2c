"""Quiescent level and noise of a light curve, estimated robustly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.observations.frames import Frames, Reason
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S

Float = NDArray[np.float64]

#: Standard deviation of a normal distribution in units of its median absolute deviation.
PER_MAD = 1.0 / float(scipy.special.ndtri(0.75))
#: Distance from the level, in standard deviations, beyond which a frame is no part of the quiescent star.
CLIP = 3.0
#: Smallest distance of a frame without light of the star, below, and of a single bright frame, above.
FAR = 5.0
#: Largest distance of the neighbours of a single bright frame.
NEAR = 3.0
#: Iterations of clipping; it converges in a few.
ROUNDS = 20
#: Default length of the running median: flares are shorter, and rotation of active stars is slower (assumed).
MEDIAN_S = 0.3 * DAY_S


@dataclass(frozen=True, eq=False)
class QuiescentLevel:
    """Quiescent level and noise of a light curve."""

    level: Float  # shape (n_frame,); median flux of the quiescent star around each frame
    # Shape (n_frame,); standard deviation of a frame at that level: the stated error of quiescent frames times
    # `excess`, or the scatter of quiescent frames if no errors are stated.
    error: Float
    excess: float  # measured scatter over the stated errors of quiescent frames; NaN if no errors are stated
    # Shape (n_frame,); frames that are used and within `CLIP` standard deviations of the level.
    quiet: NDArray[np.bool_]
    reasons: NDArray[np.int64]  # shape (n_frame,); why frames are not searched; see `frames.Reason`

    @property
    def used(self) -> NDArray[np.bool_]:
        """Frames that are searched."""
        return np.asarray(self.reasons == 0)

    def without(self, single: NDArray[np.bool_]) -> QuiescentLevel:
        """Return the level without some single bright frames."""
        return replace(
            self, quiet=self.quiet & ~single, reasons=np.where(single, self.reasons | Reason.SPIKE, self.reasons)
        )


def quiescent_level(
    frames: Frames,
    flux: Float,
    error: Float | None,
    median_s: float = MEDIAN_S,
    *,
    saturated: NDArray[np.bool_] | None = None,
) -> QuiescentLevel:
    """Estimate level and noise of a light curve, and flag frames that cannot be part of a flare.

    Parameters
    ----------
    flux, error : ndarray, shape (n_frame,)
        The light curve; for spectra, light in a band.
    median_s : float
        Length of the running median.
    saturated : ndarray of bool, shape (n_frame,), optional
        Frames with saturated pixels.
    """
    reasons = frames.faults | (0 if saturated is None else np.where(saturated, Reason.SATURATED, 0))
    usable = reasons == 0
    if usable.sum() < 10:
        raise InputError(
            f"{frames.name} has {usable.sum()} frames without a fault",
            "at least 10",
            key="frames",
            value=int(usable.sum()),
        )
    width = max(3, round(median_s / frames.cadence_s))
    quiet = usable.copy()
    excess = float("nan")
    for _ in range(ROUNDS):
        level = running_median(frames, flux, quiet, width)
        stated = np.ones_like(flux) if error is None else running_median(frames, error, quiet, width)
        spread = _scatter(frames.numbers[quiet], ((flux - level) / stated)[quiet])
        if not spread > 0:
            raise InputError(
                f"{frames.name}: the flux of most frames is the same",
                "a light curve with noise",
                key="flux",
                value=float(np.median(flux[quiet])),
            )
        now = usable & (np.abs(flux - level) < CLIP * spread * stated)
        if (now == quiet).all():
            break
        quiet = now
    noise = stated * spread
    excess = spread if error is not None else float("nan")
    finite = np.isfinite(flux)
    sigmas = np.where(usable, (flux - level) / noise, 0.0)
    reasons |= np.where(finite & (np.where(finite, flux, 0.0) - level < -FAR * noise), Reason.BELOW, 0)
    fine = reasons == 0
    reasons |= np.where(single_frames(frames, sigmas, fine), Reason.SPIKE, 0)
    return QuiescentLevel(level, noise, excess, quiet & (reasons == 0), reasons)


def running_median(frames: Frames, values: Float, chosen: NDArray[np.bool_], width: int) -> Float:
    """Return the running median of chosen frames, interpolated to all frames."""
    at = np.flatnonzero(chosen)
    if at.size <= width:
        return np.full(values.size, float(np.median(values[at])))
    smooth = scipy.ndimage.median_filter(values[at], size=width, mode="reflect")
    return np.asarray(np.interp(frames.time_s, frames.time_s[at], smooth))


def _scatter(numbers: NDArray[np.int64], values: Float) -> float:
    """Return the standard deviation of frames, from differences of neighbours: slow variability has no part in it."""
    steps = np.diff(values)[np.diff(numbers) == 1]
    return PER_MAD * float(np.median(np.abs(steps))) / np.sqrt(2.0) if steps.size else float("nan")


def single_frames(frames: Frames, sigmas: Float, fine: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return single frames far above the level whose neighbours on both sides are not.

    A flare decays over several frames; one that is shorter than a frame cannot be distinguished from a cosmic ray.

    Parameters
    ----------
    sigmas : ndarray, shape (n_frame,)
        Distance of the frames from the level, in standard deviations.
    fine : ndarray of bool, shape (n_frame,)
        Frames without another fault.
    """
    at = np.flatnonzero(fine)
    single = np.zeros(sigmas.size, np.bool_)
    if at.size < 3:
        return single
    here, before, after = at[1:-1], at[:-2], at[2:]
    adjacent = (frames.numbers[after] - frames.numbers[before]) == 2
    low = (np.abs(sigmas[before]) < NEAR) & (np.abs(sigmas[after]) < NEAR)
    single[here] = adjacent & low & (sigmas[here] > FAR)
    return single
