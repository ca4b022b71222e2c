"""Completeness of a search of observed frames, by injecting flares into these very frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.distributions import Interval, clopper_pearson
from mauvecl.observations.search import NO_COLOUR_K, SeriesSurvey
from mauvecl.observations.steps import Steps

Float = NDArray[np.float64]

#: Default numbers of half-widths, sizes and peak times.
WIDTHS, SIZES, TIMES = 4, 12, 40
#: Injections that are searched together, and the largest number of consecutive frames into which they are made.
BATCH, MAX_FRAMES = 10, 2**15
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


def inject(
    survey: SeriesSurvey, free: NDArray[np.bool_], threshold: float, seed: int, temperature_k: float = NO_COLOUR_K,
    steps: Steps | None = None,
) -> Completeness:  # fmt: skip
    """Inject flares of several half-widths and sizes at random times, and count those that the search detects.

    Parameters
    ----------
    survey : SeriesSurvey
    free : ndarray of bool, shape (n_frame,)
        Frames that belong to no event; flares are injected into these, and the others are left out of the search.
    threshold : float
    seed : int
    temperature_k : float
        Temperature of the flares; light curves have no colour.
    steps : Steps, optional
        Reports each half-width.
    """
    steps = steps or Steps()
    every = np.flatnonzero(free)
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, INJECTION_KEY]))
    bank, frame_s = survey.bank, survey.stare.frame_s
    widths = np.geomspace(bank.half_widths_s[0], bank.half_widths_s[-1], WIDTHS)
    kelvin = np.array(survey.templates.temperatures_k)
    direction = survey.templates.directions[int(np.argmin(np.abs(np.log(kelvin / temperature_k))))]
    # Photon noise of a flare of unit amplitude.
    own_noise = np.linalg.cholesky(survey.templates.noise_of(temperature_k) + 1e-300 * np.eye(direction.size))
    size_of = float(np.linalg.norm(direction))
    durations = np.zeros((WIDTHS, SIZES))
    detected = np.zeros((WIDTHS, SIZES), np.int64)
    for w, width in steps.each(enumerate(widths), WIDTHS):
        if w == 0 or every.size > MAX_FRAMES:
            # Part of a long light curve, another one for each half-width.
            start = int(rng.integers(max(every.size - MAX_FRAMES, 0) + 1))
            kept = np.zeros(free.size, np.bool_)
            kept[every[start : start + MAX_FRAMES]] = True
            part = survey.frames(kept)
        edges = np.column_stack([part.stare.start_s, part.stare.start_s + frame_s])
        power = size_of * _power(part, float(width))
        amplitudes = threshold / power * np.geomspace(*RANGE, SIZES)
        durations[w] = amplitudes * width * bank.shape.equivalent_duration
        for first in range(0, TIMES, BATCH):
            count = min(BATCH, TIMES - first)
            peaks = part.stare.start_s[rng.integers(part.stare.n_frames, size=count)] + frame_s * rng.random(count)
            shapes = np.array([bank.shape.mean_over(edges, peak, float(width)) for peak in peaks])
            # The photon noise of the flare itself is added to that of the frames.
            drawn = rng.standard_normal((*shapes.shape, direction.size)) @ own_noise.T
            added = np.concatenate([
                part.sums[None], shapes[:, :, None] * direction,
                np.sqrt(np.maximum(shapes, 0.0))[:, :, None] * drawn,
            ])  # fmt: skip
            best = np.full((SIZES, count), -np.inf)
            # The statistics are linear in the sums, so that one search serves all sizes.
            for row, rho in part.search.values(added):
                at = part.search.peak_s(row, np.arange(row.peaks.size))
                tried = (row.per_amplitude > 0).any(axis=0)
                for k, peak in enumerate(peaks):
                    near = np.abs(at - peak) <= 2 * (width + frame_s) + row.template.half_width_s
                    near &= tried
                    if near.any():
                        quiet, flare, own = (rho[n][:, near] for n in (0, 1 + k, 1 + count + k))
                        size = amplitudes[:, None, None]
                        best[:, k] = np.maximum(best[:, k], (quiet + size * flare + np.sqrt(size) * own).max((1, 2)))
            detected[w] += (best >= threshold).sum(axis=1)
    return Completeness(widths, durations, detected, TIMES)


def _power(part: SeriesSurvey, width: float) -> float:
    """Return the typical S/N of a flare of a half-width whose peak is one standard deviation of a frame."""
    row = min(part.search.rows, key=lambda one: abs(np.log(one.template.half_width_s / width)))
    tried = row.per_amplitude[row.per_amplitude > 0]
    typical = float(np.median(tried)) if tried.size else 1.0
    return typical * float(np.sqrt(width / row.template.half_width_s))
