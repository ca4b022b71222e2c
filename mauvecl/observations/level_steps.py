"""Steps of the level of a light curve: sudden changes that last, by the instrument or where observations are joined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.level import PER_MAD, guess_flares
from mauvecl.observations.process import MAX_TRIED, Binned, Process, criterion_of_process, fit_process
from mauvecl.schema.physical import DAY_S

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Places = NDArray[np.intp]

#: Numbers of frames on each side whose parabolas are compared, and their difference in its usual deviations from which
#: it may be a step (assumed).
SIDES, SUDDEN = (12, 40), 8.0
#: Largest number of steps (assumed).
MOST_STEPS = 30
#: Time after a rise that may belong to a flare, and lengths of time before it and after that time whose medians differ
#: by the step to within a factor, s (assumed).
FLARE_S, LENGTHS_S, LASTS = DAY_S / 4, (2 * DAY_S, 4 * DAY_S), 2.0
#: Smallest step relative to its standard error, and without the frames that may belong to a flare (assumed).
SIGNIFICANT, AFTER_FLARE = 6.0, 2.5
#: Largest number of fits of the process and the steps.
ROUNDS = 4
#: Largest ratio of the levels before and after a step (assumed).
LARGEST = 2.0


def relative_level(time_s: Float, numbers: NDArray[np.int64], flux: Float, frame_s: float) -> Float:
    """Return the level of each frame relative to the median one, which changes by steps only, shape (n_frame,).

    Sudden changes that last are fitted together with the process of the light. They are steps if each is larger than
    its error allows, with and without the frames in which a flare may have begun there, and if together they lower the
    Bayesian information criterion. The frames are those without a fault, `frame_s` apart on the grid of their numbers.
    """
    constant = np.ones(flux.size)
    values = flux / Binned(time_s, flux, constant, frame_s).noise
    places, sizes = _sudden_changes(time_s, values)
    typical = float(np.median(values))
    process: Process | None = None
    if not places.size or not typical > 0:
        return constant

    def binned(light: Float) -> Binned:
        return Binned.of(time_s[quiet], light[quiet], np.ones(int(quiet.sum())), frame_s, MAX_TRIED)

    for _ in range(ROUNDS):
        left = values - _light_of_steps(values.size, places, sizes)
        quiet = ~guess_flares(numbers, left)
        process = fit_process(binned(left), process)
        change, error = _fitted_steps(process, time_s, left, quiet, places, frame_s)
        no_flare = quiet & ~_after_rises(time_s, places, sizes)
        apart, error_apart = _fitted_steps(process, time_s, left, no_flare, places, frame_s)
        before, sizes = sizes, sizes + change
        kept = (np.abs(sizes) > SIGNIFICANT * error) & ((before + apart) / np.sign(sizes) > AFTER_FLARE * error_apart)
        settled = kept.all() and (np.abs(change) < error).all()
        places, sizes = places[kept], sizes[kept]
        if settled or not places.size:
            break
    if not places.size:
        return constant
    added = _light_of_steps(values.size, places, sizes)
    costs = []
    for light, each, n_steps in ((values - added, process, places.size), (values, None, 0)):
        data = binned(light)
        fitted = fit_process(data, each)
        size = float(np.log(data.values.size))
        noise = replace(data, variance=data.variance * fitted.excess**2)
        costs.append(2 * n_steps * size + criterion_of_process(fitted, noise, size))
    level = 1.0 + added / typical
    level = level / np.median(level)
    return level if costs[0] < costs[1] and level.min() > 1 / LARGEST and level.max() < LARGEST else constant


def _sudden_changes(time_s: Float, flux: Float) -> tuple[Places, Float]:
    """Return the first frames after sudden changes that last, in order of time, and the changes of the flux."""
    found: dict[int, tuple[float, float]] = {}
    for side in SIDES:
        if flux.size < 4 * side:
            continue
        # Parabolas through the frames before and after, half a frame beyond their ends.
        weights = np.linalg.pinv(np.vander(np.arange(side) - (side - 0.5), 3))[-1]
        before = np.convolve(flux, weights[::-1], mode="valid")[:-side]
        change = np.convolve(flux, weights, mode="valid")[side:] - before
        usual = max(PER_MAD * float(np.median(np.abs(change))), 1e-300)
        for k in np.flatnonzero(np.abs(change) > SUDDEN * usual):
            largest = np.abs(change[max(0, k - side) : k + side + 1]).max()
            if np.abs(change[k]) >= largest and not any(abs(k + side - one) <= side for one in found):
                found[int(k + side)] = (float(np.abs(change[k])) / usual, float(change[k]))
    lasting = [one for one in found if _lasts(time_s, flux, one, found[one][1])]
    places = np.array(sorted(sorted(lasting, key=lambda one: found[one], reverse=True)[:MOST_STEPS]), np.intp)
    return places, np.array([found[int(one)][1] for one in places])


def _lasts(time_s: Float, flux: Float, place: int, size: float) -> bool:
    """Return whether a change is not undone within days, as that of a flare or a loss of light is.

    The light of a star that turns in less time has the same median before and after.
    """
    start = time_s[place]
    for length_s in LENGTHS_S:
        first, later, last = np.searchsorted(time_s, [start - length_s, start + FLARE_S, start + FLARE_S + length_s])
        before, after = flux[first:place], flux[later:last]
        if min(before.size, after.size) >= SIDES[0]:
            share = float(np.median(after) - np.median(before)) / size
            if 1 / LASTS < share < LASTS:
                return True
    return False


def _light_of_steps(n_frames: int, places: Places, sizes: Float) -> Float:
    """Return the sum of steps in each frame."""
    added = np.zeros(n_frames)
    added[places] = sizes
    return np.cumsum(added)


def _after_rises(time_s: Float, places: Places, sizes: Float) -> Bool:
    """Return the frames in which a flare may shine that began at a rise."""
    inside = np.zeros(time_s.size, np.bool_)
    for start in time_s[places[sizes > 0]]:
        inside |= (time_s >= start) & (time_s < start + FLARE_S)
    return inside


def _fitted_steps(
    process: Process, time_s: Float, flux: Float, quiet: Bool, places: Places, frame_s: float
) -> tuple[Float, Float]:
    """Return the steps of a light curve by generalised least squares, and their standard errors, (n_step,) each."""
    rows, time = np.flatnonzero(quiet), time_s[quiet]

    def binned(column: Float | Bool) -> Binned:
        return Binned.of(time, column.astype(np.float64), np.ones(rows.size), frame_s)

    data = binned(flux[quiet])
    columns = [np.ones(data.values.size), *(binned(rows >= place).values for place in places), data.values]
    covariance = process.covariance(data.time_s, data.variance * process.excess**2)
    white = covariance.whitened(np.column_stack(columns))
    spread = np.linalg.pinv(white[:, :-1].T @ white[:, :-1])
    return (spread @ (white[:, :-1].T @ white[:, -1]))[1:], np.sqrt(np.diag(spread))[1:]
