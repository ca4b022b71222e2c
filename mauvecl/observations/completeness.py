"""Completeness of a search of observed frames, by injecting flares into these very frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.search import SeriesSurvey
from mauvecl.statistics.intervals import Interval, clopper_pearson

Float = NDArray[np.float64]

#: Default numbers of half-widths, sizes and peak times.
WIDTHS, SIZES, TIMES = 4, 12, 40
#: Range of sizes, in equivalent durations whose S/N without a baseline equals these multiples of the threshold.
RANGE = (0.5, 4.0)
#: Probability of detection that limits refer to.
POWER = 0.9
#: Second half of the generator's key, which makes the draws independent of others.
INJECTION_KEY = 0x696E6A65


@dataclass(frozen=True, eq=False)
class Completeness:
    """Share of injected flares that the search detects.

    Attributes
    ----------
    half_widths_s : ndarray, shape (n_width,)
    equivalent_durations_s : ndarray, shape (n_width, n_size)
    detected : ndarray of int, shape (n_width, n_size)
    injected : int
        Number of injections per cell.
    """

    half_widths_s: Float
    equivalent_durations_s: Float
    detected: NDArray[np.int64]
    injected: int

    def interval(self, width: int, size: int) -> Interval:
        """Return the completeness of a cell with its 95 % interval."""
        return clopper_pearson(int(self.detected[width, size]), self.injected)

    def limit(self, width: int, power: float = POWER) -> float:
        """Return the equivalent duration of flares that are detected with a probability; NaN if none is.

        Interpolated in the logarithm between the sizes.
        """
        share = np.maximum.accumulate(self.detected[width] / self.injected)
        if share[-1] < power:
            return float("nan")
        k = int(np.argmax(share >= power))
        logs = np.log(self.equivalent_durations_s[width])
        if k == 0:
            return float(np.exp(logs[0]))
        part = (power - share[k - 1]) / (share[k] - share[k - 1])
        return float(np.exp(logs[k - 1] + part * (logs[k] - logs[k - 1])))


def inject(survey: SeriesSurvey, free: NDArray[np.bool_], threshold: float, seed: int) -> Completeness:
    """Inject flares of several half-widths and sizes at random times, and count those that the search detects.

    Parameters
    ----------
    survey : SeriesSurvey
    free : ndarray of bool, shape (n_frame,)
        Frames that belong to no event; flares are injected into these, and the others are left out of the search.
    threshold : float
    seed : int
    """
    part = survey.frames(free)
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, INJECTION_KEY]))
    bank, frame_s = part.bank, part.stare.frame_s
    widths = np.geomspace(bank.half_widths_s[0], bank.half_widths_s[-1], WIDTHS)
    noise = float(np.median(np.sqrt(part.variance)))
    durations = np.zeros((WIDTHS, SIZES))
    detected = np.zeros((WIDTHS, SIZES), np.int64)
    for w, width in enumerate(widths):
        power = float(np.sqrt(np.max(bank.template(float(width)).power))) / noise
        amplitudes = threshold / power * np.geomspace(*RANGE, SIZES)
        durations[w] = amplitudes * part.scale / part.level * width * bank.shape.equivalent_duration
        lead, tail = bank.window(bank.half_widths_s[-1])
        for _ in range(TIMES):
            middle = int(rng.integers(part.stare.n_frames))
            peak = float(part.stare.start_s[middle] + frame_s * rng.random())
            number = part.stare.numbers
            near = np.abs(number - number[middle]) <= lead + tail
            here = part.frames(near)
            edges = np.column_stack([here.stare.start_s, here.stare.start_s + frame_s])
            shape = bank.shape.mean_over(edges, peak, float(width))
            light = amplitudes[:, None] * shape
            # The photon noise of the flare itself is added to that of the frames.
            own = np.sqrt(np.maximum(part.photon / part.scale * light, 0.0)) * rng.standard_normal(light.shape)
            sums = (here.sums[:, 0] + light + own)[:, :, None]
            best = here.search.largest(sums.astype(np.float32))
            close = np.abs(best.peak_s - peak) <= 2 * (width + frame_s) + best.half_width_s
            detected[w] += (best.maximum >= threshold) & close
    return Completeness(widths, durations, detected, TIMES)
