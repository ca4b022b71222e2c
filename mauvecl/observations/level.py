"""Quiescent level of a light curve, in alternation with the mask of flares, and the noise about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.arrays import PER_MAD, Bool, Float
from mauvecl.observations.frames import Frames
from mauvecl.observations.process import MAX_TRIED, BinnedLightCurve, Process, Steps, criterion_of_process, fit_process
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DAY_S

#: Distance from the level, in standard deviations, beyond which a frame below it lacks the light of the star, and a
#: single frame above it is a spike.
FAR = 5.0
#: Largest distance of the neighbours of a spike.
NEAR = 3.0
#: A guessed flare begins with a rise of this many robust standard deviations, within one of these numbers of frames.
JUMP, JUMP_FRAMES = 8.0, (1, 2, 3)
#: A guessed flare ends at this share of its rise, or within this number of standard deviations of the level before it.
DECAYED, WITHIN = 0.02, 3.0
#: Largest share of the frames in guessed flares.
MOST_GUESSED = 0.8
#: Number of frames in which the end of a guessed flare is sought first; further pieces are longer.
FIRST_PIECE = 256
#: Largest mean of counts in a frame whose noise is treated as Poisson noise rather than as normal noise.
MAX_COUNTS = 100.0
#: Factor by which the noise of frames without weight exceeds the standard deviation of the process.
NO_WEIGHT = 1e4
#: Largest share of frames far below the level that are left out; more of them are light of the star.
MOST_BELOW = 0.03
#: Smallest variance of the noise of a frame relative to the typical one.
LEAST_VARIANCE = 0.1
#: Smallest step from frame to frame as a share of the light; numbers of single precision are rounded by 1e-7.
LEAST_NOISE = 1e-10
#: Smallest number of frames without a fault.
MIN_USABLE = 10
#: Smallest and largest number of simulated light curves from which the standard error of the level is estimated, to
#: 1 / sqrt(2 times as many), and number of values in all of them, which bounds the time.
LEVEL_DRAWS, LEVEL_VALUES = (8, 32), 2**22
#: Second half of the generator's key, which makes the draws independent of others.
LEVEL_KEY = 0x6C65766C


@dataclass(frozen=True, eq=False)
class QuiescentLevel:
    """Quiescent level and noise of a light curve."""

    level: Float  # shape (n_frame,); mean of the process given the quiescent frames
    level_error: Float  # shape (n_frame,); its standard error
    error: Float  # shape (n_frame,); standard deviation of a frame at that level, as measured
    excess: float  # measured scatter over the stated errors of quiescent frames; NaN if no errors are stated
    quiet: Bool  # shape (n_frame,); frames that are searched and belong to no event
    reasons: NDArray[np.int64]  # shape (n_frame,); why frames are not searched; see `frames.Reason`
    process: Process  # in standard deviations of the noise of a typical frame
    spread: float  # standard deviation of the level without its steps, relative to the typical level
    changes: tuple[tuple[int, float], ...] = ()  # first frames after steps of the level, and its relative changes

    def times(self, relative: Float) -> QuiescentLevel:
        """Return the level of light that was divided by one which changes in steps, shape (n_frame,)."""
        places = np.flatnonzero(np.diff(relative)) + 1
        changes = tuple((int(place), float(relative[place] / relative[place - 1] - 1)) for place in places)
        level, level_error, error = (values * relative for values in (self.level, self.level_error, self.error))
        return replace(self, level=level, level_error=level_error, error=error, changes=changes)

    @property
    def used(self) -> Bool:
        """Frames that are searched."""
        return np.asarray(self.reasons == 0)


def counts_per_unit(frames: Frames) -> float | None:
    """Return the number of counts in a unit of the flux if frames hold few counts, or None.

    Fluxes that are whole numbers, or become so by multiplication with the exposure time, are counts.
    """
    flux = frames.flux
    finite = np.isfinite(flux)
    if flux.ndim > 1 or not finite.any() or (flux[finite] < 0).any():
        return None
    for factor in (1.0, float(np.median(frames.exposure_s))):
        counts = flux[finite] * factor
        # Fluxes such as 1e-15 are near zero, but are no counts.
        integer = np.abs(counts - np.rint(counts)) <= 1e-6 * counts
        # Half of the frames may have no count at all.
        if integer.all() and np.ptp(counts) > 0 and float(np.quantile(counts, 0.75)) < MAX_COUNTS:
            return factor
    return None


def noise_of_steps(numbers: NDArray[np.int64], flux: Float) -> float:
    """Return the robust standard deviation of a frame from steps between neighbours; zero without any."""
    steps = np.diff(flux)[np.diff(numbers) == 1]
    return PER_MAD * float(np.median(np.abs(steps))) / float(np.sqrt(2.0)) if steps.size else 0.0


def guess_flares(numbers: NDArray[np.int64], flux: Float, least: float = 0.0) -> Bool:
    """Return a first guess of the frames in flares, which rise faster than the star otherwise does, shape (n_frame,).

    `least` is the least standard deviation of a frame, since most of few counts are equal.
    """
    inside = np.zeros(flux.size, np.bool_)
    rises: list[tuple[float, int]] = []
    noise = max(noise_of_steps(numbers, flux), least)
    for lag in JUMP_FRAMES:
        rise = np.where(numbers[lag:] - numbers[:-lag] <= 2 * lag, flux[lag:] - flux[:-lag], 0.0)
        limit = JUMP * max(PER_MAD * float(np.median(np.abs(rise))), np.sqrt(2.0) * least)
        rises += [(float(rise[k]), int(k)) for k in np.flatnonzero(rise > max(limit, 1e-300))]
    n_inside = 0
    for rise_of_flare, start in sorted(rises, reverse=True):
        if inside[start]:
            continue
        # The first frames belong to the rise; it ends at the first of two faint frames in a row.
        faint = float(flux[start]) + max(WITHIN * noise, DECAYED * rise_of_flare)
        first, size, last = start + 4, FIRST_PIECE, flux.size
        while first + 1 < last:
            below = flux[first : first + size + 1] < faint
            ends = np.flatnonzero(below[:-1] & below[1:])
            last = first + int(ends[0]) if ends.size else last
            first, size = first + size, 2 * size
        added = int(np.count_nonzero(~inside[start + 1 : last + 1]))
        if n_inside + added <= MOST_GUESSED * flux.size:
            inside[start + 1 : last + 1] = True
            n_inside += added
    return inside


def quiet_variance(flux: Float, error: Float, level: Float, quiet: Bool) -> tuple[Float, float]:
    """Return the variance of the noise of each frame at its level as stated, and its rise with the flux.

    Stated errors often follow the counts of the frame, of which the difference from the level is taken away.
    """
    squared, difference = error**2, (flux - level)[quiet]
    spread, typical = float(difference @ difference), float(np.median(squared[quiet]))
    slope = 0.0
    if spread > 0:
        slope = max(float(difference @ (squared[quiet] - squared[quiet].mean())) / spread, 0.0)
    return np.maximum(squared - slope * (flux - level), LEAST_VARIANCE * typical), slope


def noise_of_frames(
    frames: Frames, flux: Float, error: Float | None, level: Float, quiet: Bool, counts: float | None
) -> tuple[Float, float]:
    """Return the variance of the noise of each frame at its level, and its rise with the flux."""
    if counts is not None:
        return np.maximum(level, 1e-3 * float(np.median(level[quiet])) + 1e-300) / counts, 1.0 / counts
    if error is not None:
        return quiet_variance(flux, error, level, quiet)
    spread = noise_of_steps(frames.numbers[quiet], flux[quiet])
    return np.full(flux.size, (spread if spread > 0 else float(np.std(flux[quiet]))) ** 2), 0.0


def check_usable(frames: Frames, reasons: NDArray[np.int64]) -> None:
    """Raise InputError if too few frames are without a fault, or if most of them have the same flux."""
    usable = reasons == 0
    if (n := usable.sum()) < MIN_USABLE:
        raise InputError(f"{frames.name} needs at least {MIN_USABLE} frames without a fault, but has {n}", key="frames")
    flux = frames.white_light[0][usable]
    if np.median(np.abs(np.diff(flux))) <= LEAST_NOISE * np.abs(np.median(flux)) and counts_per_unit(frames) is None:
        fault = "must be a light curve with noise, but the flux of most frames is the same"
        raise InputError(f"{frames.name} {fault}", key="flux")


class ConditionalLevel:
    """Means of a process at all times given quiescent values, by one factorisation for all values at these times.

    The sum of the `weights` of the values is the inverse of the variance of the constant level.
    """

    def __init__(self, process: Process, time_s: Float, variance: Float, quiet: Bool) -> None:
        self.process, self.quiet = process, quiet
        noise = variance * process.excess**2
        self.weights = np.where(quiet, 1.0 / noise, 0.0)
        if process.terms:
            # Values without weight have a large variance.
            self._noise = np.where(quiet, noise, NO_WEIGHT**2 * (process.sd**2 + np.median(noise)))
            self._covariance = process.covariance(time_s, self._noise)
            self.weights = np.where(quiet, self._covariance.solve(quiet.astype(np.float64)), 0.0)

    def of(self, values: Float) -> Float:
        """Return the mean of the process given values, shape (n,) or (n, k) as these."""
        columns = values.reshape(len(values), -1)
        quiet, weights = self.quiet, self.weights
        mean = weights[quiet] @ columns[quiet] / weights.sum()
        if not self.process.terms:
            return np.asarray(np.broadcast_to(mean, columns.shape)).reshape(values.shape)
        residual = np.where(quiet[:, None], columns - mean, 0.0)
        # The mean of the process at a value is the value less its noise.
        process = residual - self._noise[:, None] * self._covariance.solve(residual)
        return np.asarray(process + mean).reshape(values.shape)


def level_error(process: Process, time_s: Float, variance: Float, quiet: Bool, seed: int, steps: Steps) -> Float:
    """Return the standard error of the mean of a process at all times, shape (n,).

    It is the scatter of differences between simulated processes and their means given noisy values (Matheron's rule),
    with that of the constant level. `steps` reports each of these.
    """
    level = ConditionalLevel(process, time_s, variance, quiet)
    if not process.terms:
        return np.full(time_s.size, (1.0 / float(level.weights.sum())) ** 0.5)
    noise = variance * process.excess**2
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, LEVEL_KEY]))
    tiny = np.full(time_s.size, 1e-9 * (process.sd**2 + float(np.median(noise))))
    simulated = process.covariance(time_s, tiny)
    total = np.zeros(time_s.size)
    draws = int(np.clip(LEVEL_VALUES // time_s.size, *LEVEL_DRAWS))
    for _ in steps.track(range(draws), draws):
        truth = simulated.coloured(rng.standard_normal(time_s.size))
        total += (level.of(truth + np.sqrt(noise) * rng.standard_normal(time_s.size)) - truth) ** 2
    return np.sqrt(total / draws)


def single_frames(numbers: NDArray[np.int64], sigmas: Float, usable: Bool) -> Bool:
    """Return single frames far above the level, by `sigmas`, whose neighbours on both sides are not.

    A flare that is shorter than a frame cannot be distinguished from a cosmic ray. Frames without a fault are `usable`.
    """
    frames, single = np.flatnonzero(usable), np.zeros(sigmas.size, np.bool_)
    middle, before, after = frames[1:-1], frames[:-2], frames[2:]
    adjacent = (numbers[after] - numbers[before]) == 2
    low = (np.abs(sigmas[before]) < NEAR) & (np.abs(sigmas[after]) < NEAR)
    single[middle] = adjacent & low & (sigmas[middle] > FAR)
    return single


#: Numbers of frames per bin at which the scatter is measured.
BINS = (1, 2, 4, 8, 16, 32, 64, 128)
#: Smallest number of bins.
MIN_BINS = 8
#: Largest lag of correlations in frames.
MAX_LAG = 40
#: Correlation of the residuals above which the process does not describe them, if it also has this significance.
CORRELATED, SIGNIFICANT = 0.12, 5.0


@dataclass(frozen=True, eq=False)
class NoiseComparison:
    """Comparison of the residuals of the fitted process with independent noise."""

    correlations: Float  # shape (n_lag,); at lags of 1, 2 ... frames, of the sum that is most correlated
    errors: Float  # shape (n_lag,); their standard errors for independent residuals, of which long lags have fewer

    @property
    def excess(self) -> Float:
        """Correlations relative to the largest that the process may leave, shape (n_lag,)."""
        return np.asarray(np.abs(self.correlations) / np.maximum(CORRELATED, SIGNIFICANT * self.errors))

    @property
    def alike(self) -> bool:
        """True unless the residuals are significantly and clearly correlated."""
        return bool(self.excess.max() < 1)


def likeness(numbers: NDArray[np.int64], residual: Float) -> NoiseComparison:
    """Return the autocorrelation of residuals, shape (n_frame, n_sum), at lags of the frames' numbers."""
    # Single extreme values would hide correlations, or feign them.
    scaled = np.clip(residual, -4.0, 4.0)
    scaled = (scaled - scaled.mean(axis=0)) / np.maximum(scaled.std(axis=0), 1e-300)
    lags = np.arange(1, max(2, min(MAX_LAG, len(numbers) // 4) + 1))
    correlations, errors = np.zeros((residual.shape[1], lags.size)), np.ones(lags.size)
    for k, lag in enumerate(lags):
        # Frames that are a lag apart, with any number of others between them.
        _, first, second = np.intersect1d(numbers, numbers - lag, assume_unique=True, return_indices=True)
        if first.size > 10:
            correlations[:, k] = (scaled[first] * scaled[second]).mean(axis=0)
            errors[k] = first.size**-0.5
    return max((NoiseComparison(row, errors) for row in correlations), key=lambda noise: float(noise.excess.max()))


@dataclass(frozen=True)
class Scatter:
    """Scatter of means of several consecutive quiescent frames."""

    frames: int  # number of frames in a mean
    count: int  # number of means
    measured: float  # their standard deviation, in units of the noise of one frame
    white: float  # the same for independent frames: one over the root of `frames`
    low: float  # range of `measured`, with `high`, in 95 % of light curves of independent, normal frames
    high: float

    @property
    def red(self) -> bool:
        """True if the frames are correlated on this time scale."""
        return self.measured > self.high


def binned_scatter(numbers: NDArray[np.int64], residual: Float) -> list[Scatter]:
    """Measure the scatter of means of consecutive frames without gaps, in units of the noise of a frame."""
    scatter = list[Scatter]()
    # Place of each frame among consecutive ones, and their number.
    first = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 2) != 1)
    lengths = np.diff(np.append(first, numbers.size))
    place, length = np.arange(numbers.size) - np.repeat(first, lengths), np.repeat(lengths, lengths)
    for size in BINS:
        # Bins do not overlap, and begin with the first frame after a gap.
        starts = np.flatnonzero((place % size == 0) & (place + size <= length))
        if (dof := len(starts) - 1) < MIN_BINS - 1:
            break
        means = residual[starts[:, None] + np.arange(size)].mean(axis=1)
        low, high = np.sqrt(scipy.stats.chi2.ppf([0.025, 0.975], dof) / dof / size).tolist()
        scatter.append(Scatter(size, dof + 1, float(means.std(ddof=1)), size**-0.5, low, high))
    return scatter


Places = NDArray[np.intp]

#: Numbers of frames on each side whose parabolas are compared, and the difference, relative to its usual size, above
#: which it may be a step (assumed).
SIDES, SUDDEN = (12, 40), 8.0
#: Largest number of steps (assumed).
MOST_STEPS = 30
#: Time after a rise that may belong to a flare, and lengths of time before it and after that time whose medians differ
#: by the step to within a factor, s (assumed).
FLARE_S, LENGTHS_S, LASTS = DAY_S / 4, (2 * DAY_S, 4 * DAY_S), 2.0
#: Smallest step relative to its standard error, and without the frames that may belong to a flare (assumed).
STEP_ERRORS, AFTER_FLARE = 6.0, 2.5
#: Largest number of fits of the process and the steps.
ROUNDS = 4
#: Largest ratio of the levels before and after a step (assumed).
LARGEST = 2.0


def relative_level(time_s: Float, numbers: NDArray[np.int64], flux: Float, frame_s: float) -> Float:
    """Return the level of each frame relative to the median one, which changes by steps only, shape (n_frame,).

    Sudden changes are steps if each is larger than its error, with and without the frames in which a flare may have
    begun there, and if together they lower the Bayesian information criterion. No frame has a fault.
    """
    constant, process = np.ones(flux.size), None
    values = flux / BinnedLightCurve(time_s, flux, constant, frame_s).noise
    places, sizes = _find_sudden_changes(time_s, values)
    if not places.size or not np.median(values) > 0:
        return constant

    def binned(light: Float) -> BinnedLightCurve:
        return BinnedLightCurve(time_s[quiet], light[quiet], constant[quiet], frame_s).binned(MAX_TRIED)

    for _ in range(ROUNDS):
        without_steps = values - np.cumsum(np.bincount(places, sizes, values.size))
        quiet = ~guess_flares(numbers, without_steps)
        process = fit_process(binned(without_steps), process)
        change, error = _fit_steps(process, time_s, without_steps, quiet, places, frame_s)
        # A flare may shine after each rise.
        rises = [(time_s >= start) & (time_s < start + FLARE_S) for start in time_s[places[sizes > 0]]]
        no_flare = quiet & ~np.any(rises, axis=0)
        later_change, later_error = _fit_steps(process, time_s, without_steps, no_flare, places, frame_s)
        later_sizes, sizes = sizes + later_change, sizes + change
        steps = (np.abs(sizes) > STEP_ERRORS * error) & (later_sizes / np.sign(sizes) > AFTER_FLARE * later_error)
        settled = steps.all() and (np.abs(change) < error).all()
        places, sizes = places[steps], sizes[steps]
        if settled or not places.size:
            break
    if not places.size:
        return constant
    added = np.cumsum(np.bincount(places, sizes, values.size))
    costs = []
    for light, start, n_steps in ((values - added, process, places.size), (values, None, 0)):
        data = binned(light)
        size = float(np.log(data.values.size))
        costs.append(2 * n_steps * size + criterion_of_process(fit_process(data, start), data, size))
    level = 1.0 + added / float(np.median(values - added))
    level = level / np.median(level)
    return level if costs[0] < costs[1] and level.min() > 1 / LARGEST and level.max() < LARGEST else constant


def _find_sudden_changes(time_s: Float, flux: Float) -> tuple[Places, Float]:
    """Return the first frames after sudden changes that last, in order of time, and the changes of the flux."""
    changes: dict[int, tuple[float, float]] = {}
    for side in (side for side in SIDES if flux.size >= 4 * side):
        # Parabolas through the frames before and after, half a frame beyond their ends.
        weights = np.linalg.pinv(np.vander(np.arange(side) - (side - 0.5), 3))[-1]
        before = np.convolve(flux, weights[::-1], mode="valid")[:-side]
        change = np.convolve(flux, weights, mode="valid")[side:] - before
        usual = max(PER_MAD * float(np.median(np.abs(change))), 1e-300)
        for k in np.flatnonzero(np.abs(change) > SUDDEN * usual).tolist():
            largest = np.abs(change[max(0, k - side) : k + side + 1]).max()
            if np.abs(change[k]) >= largest and not any(abs(k + side - place) <= side for place in changes):
                changes[k + side] = (float(np.abs(change[k])) / usual, float(change[k]))
    lasting = set()
    for (place, (_, size)), length_s in product(changes.items(), LENGTHS_S):
        # The median of the light differs days later too, as not after flares, losses and rotation.
        ends = time_s[place] + np.array([-length_s, FLARE_S, FLARE_S + length_s])
        first, later, last = np.searchsorted(time_s, ends)
        before, after = flux[first:place], flux[later:last]
        enough = min(before.size, after.size) >= SIDES[0]
        if enough and 1 / LASTS < float(np.median(after) - np.median(before)) / size < LASTS:
            lasting.add(place)
    places = sorted(sorted(lasting, key=lambda place: changes[place], reverse=True)[:MOST_STEPS])
    return np.array(places, np.intp), np.array([changes[place][1] for place in places])


def _fit_steps(
    process: Process, time_s: Float, flux: Float, quiet: Bool, places: Places, frame_s: float
) -> tuple[Float, Float]:
    """Return the steps of a light curve by generalised least squares, and their standard errors, (n_step,) each."""
    data = BinnedLightCurve(time_s[quiet], flux[quiet], np.ones(int(quiet.sum())), frame_s)
    after = np.flatnonzero(quiet) >= places[:, None]
    steps = [replace(data, values=step.astype(np.float64)).binned().values for step in after]
    data = data.binned()
    covariance = process.covariance(data.time_s, data.variance * process.excess**2)
    white = covariance.whitened(np.column_stack([np.ones(data.values.size), *steps, data.values]))
    design, values = white[:, :-1], white[:, -1]
    spread = np.linalg.pinv(design.T @ design)
    return (spread @ (design.T @ values))[1:], np.sqrt(np.diag(spread))[1:]
