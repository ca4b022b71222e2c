"""Quiescent light of light curves, without events and sudden losses of light by drifts out of the fibre and eclipses.

Process and events are found in alternation: a process that is fitted to flares would hide them, and a flare that is
searched with a wrong process would be too long or too short.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter, uniform_filter1d

from mauvecl.flares.shapes import Shape
from mauvecl.host.arrays import PER_MAD, Bool, Float, true_runs
from mauvecl.observations import level as levels
from mauvecl.observations.event_fits import flares_of
from mauvecl.observations.events import END_FRAMES, LONG_S, MIN_QUIET, detect_events, light_of_flare
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.process import UNREPORTED, BinnedLightCurve, Process, Steps, criterion_of_process, fit_process
from mauvecl.observations.search import DetectedEvent, SeriesSurvey, bank_of
from mauvecl.schema.errors import InputError

#: Statistic above which the frames of an event are left out of fits of the process.
PROVISIONAL = 5.0
#: Largest number of alternations of process and events.
ALTERNATIONS = 12
#: Largest number of events in independent noise that are compared with a process, and parameters of a flare.
MAX_COMPARED, PARAMETERS = 8, 3
#: Departures of flares from their shape that are tried for the criterion.
DEPARTURES = (0.0, 0.03, 0.2)
#: Shortest period of rotation (assumed: 0.2 d), and the rise of the criterion for a faster process of which
#: the frames show fewer periods or time scales than a number (both assumed).
FASTEST_ROTATION_S, SEEN_ONCE, REPEATED = 17_280.0, 20.0, 10.0
#: Share of the frames in events that may change in the last alternation, and when single frames are left out (assumed).
SETTLED, RAN_AWAY = 0.002, 0.02


#: A survey with processes, and its frames in events.
Fitted = tuple[SeriesSurvey, Bool]


def fit_quiet_light(survey: SeriesSurvey, guessed: Bool, before: SeriesSurvey | None, steps: Steps) -> Fitted:
    """Fit process and events in alternation, from the guess and, if need be, from the events in independent noise.

    A bright, slow flare resembles a process that is seen once. There, the fit with the events in independent noise is
    compared by the Bayesian information criterion, with the flares among the parameters. For arguments see `alternate`.
    """
    fitted, in_events = alternate(survey, guessed, before, steps)
    if before is not None and float((in_events ^ guessed).mean()) > RAN_AWAY:
        # Nearly the same frames had other events: which of them explain the light better?
        previous = survey.fitted(before), guessed
        if criterion(*previous) < criterion(fitted, in_events):
            return previous
    if not _seen_once(fitted):
        return fitted, in_events
    noise = tuple(Process((), process.excess) for process in fitted.processes)
    events, guessed = detect_events(replace(survey, processes=noise), PROVISIONAL)
    if len(events) > MAX_COMPARED or not (guessed & ~in_events).any():
        return fitted, in_events
    other = alternate(survey, guessed, None, steps)
    if float((other[1] ^ in_events).mean()) <= SETTLED:
        return fitted, in_events
    light = light_of_events(fitted, in_events)
    return other if criterion(*other, further=light) < criterion(fitted, in_events, light) else (fitted, in_events)


@dataclass(frozen=True, eq=False)
class EventLight:
    """Light of the flares that fit an event."""

    event: DetectedEvent
    rows: slice
    light: Float  # along the direction of the event, shape (n_row,)
    photon: Float  # variance that it adds
    n_flares: int


def light_of_events(survey: SeriesSurvey, in_events: Bool) -> list[EventLight]:
    """Return the light of the events above `PROVISIONAL`."""
    fits = []
    for event in detect_events(survey, PROVISIONAL)[0]:
        flares, scale, photon = flares_of(survey, in_events, event)
        total = np.zeros(survey.stare.n_frames)
        lights = [light_of_flare(survey, flare.peak_s, flare.half_width_s, flare.amplitude) for flare in flares]
        for rows, flux in lights:
            total[rows] += flux
        rows = slice(min(rows.start for rows, _ in lights), max(rows.stop for rows, _ in lights))
        fits.append(EventLight(event, rows, scale * total[rows], photon * total[rows], len(flares)))
    return fits


def criterion(
    survey: SeriesSurvey, in_events: Bool, fits: Sequence[EventLight] | None = None,
    further: Sequence[EventLight] = (), *, shapeless: bool = False,
) -> float:  # fmt: skip
    """Return the Bayesian information criterion of the processes of a survey and of the flares of `light_of_events`.

    A process of minutes that is hardly seen to repeat costs `SEEN_ONCE`: stars and instruments repeat what they do. If
    `shapeless`, or in independent noise, the light of an event may have any smooth shape, or depart from that of its
    flares, or of `further` ones, by a process.
    """
    fits = light_of_events(survey, in_events) if fits is None else fits
    total = min(_criterion_of(survey, fits, np.ones_like(in_events), epsilon) for epsilon in DEPARTURES)
    shapeless = shapeless or not any(process.terms for process in survey.processes)
    if fits and shapeless and survey.sums.shape[1] == 1:
        in_fits = sum(_shapeless_cost(survey, fit.event, (fits, further)) for fit in fits)
        total = min(total, _criterion_of(survey, [], ~in_events, 0.0) + in_fits)
    return total + (SEEN_ONCE if _seen_once(survey) else 0.0)


def _shapeless_cost(survey: SeriesSurvey, event: DetectedEvent, light: Sequence[Sequence[EventLight]]) -> float:
    """Return the criterion of an event whose light is a process, alone or in addition to that of fitted flares."""
    size = float(np.log(survey.stare.n_frames))
    rows, added = slice(event.first, event.last + 1), [(1, *_add_light(survey, [], 0.0))]
    for fits in light:
        near = (fit for fit in fits if event.first <= fit.event.last and fit.event.first <= event.last)
        if number := sum(fit.n_flares for fit in near):
            added += [(number, *_add_light(survey, fits, epsilon)) for epsilon in DEPARTURES]
    costs = []
    for n_flares, flux, extra in added:
        values, variance = survey.sums[rows, 0] - flux[rows, 0], survey.variance[rows] + extra[rows]
        data = BinnedLightCurve(survey.stare.start_s[rows], values, variance, survey.stare.frame_s)
        process = fit_process(data) if event.last - event.first >= MIN_QUIET else Process((), 1.0)
        costs.append(PARAMETERS * n_flares * size + criterion_of_process(process, data, size))
    return min(costs)


def _add_light(survey: SeriesSurvey, fits: Sequence[EventLight], epsilon: float) -> tuple[Float, Float]:
    """Return the light of flares in the sums, (n_frame, n_sum), and the variance of flares that depart by a share."""
    light, variance = np.zeros_like(survey.sums), np.zeros(survey.stare.n_frames)
    for fit in fits:
        light[fit.rows] += fit.light[:, None] * survey.bank.directions[fit.event.direction]
        variance[fit.rows] += fit.photon + (epsilon * fit.light) ** 2
    return light, variance


def _criterion_of(survey: SeriesSurvey, fits: Sequence[EventLight], chosen: Bool, epsilon: float) -> float:
    """Return the criterion of some frames, with flares that depart by a share from their shape."""
    start, size = survey.stare.start_s[chosen], float(np.log(survey.stare.n_frames))
    light, extra = _add_light(survey, fits, epsilon)
    total = PARAMETERS * size * sum(fit.n_flares for fit in fits)
    for process, column in zip(survey.processes, (survey.sums - light)[chosen].T, strict=True):
        noise = (survey.variance * process.excess**2 + extra)[chosen]
        if fits and not process.terms:
            # Frames without events in the tail of a flare have more scatter than noise.
            noise = (survey.variance + extra)[chosen]
            process = fit_process(BinnedLightCurve(start, column, noise, survey.stare.frame_s), process)
            noise = noise * process.excess**2
        # The excess is in the noise already.
        data = BinnedLightCurve(start, column, noise, survey.stare.frame_s)
        total += criterion_of_process(replace(process, excess=1.0), data, size)
    return total


def _seen_once(survey: SeriesSurvey) -> bool:
    """Return whether a process is faster than rotation, but too slow to be seen to repeat."""
    span, terms = survey.stare.duration_s, (term for process in survey.processes for term in process.terms)
    return any(span / REPEATED < term.scale_s < FASTEST_ROTATION_S for term in terms)


def alternate(survey: SeriesSurvey, guessed: Bool, before: SeriesSurvey | None, steps: Steps) -> Fitted:
    """Fit process and events in alternation; return the survey with processes, and the frames above `PROVISIONAL`.

    The terms of `before`, a survey of nearly the same frames, are kept as long as the events hardly change.
    """
    in_events, rounds = guessed, dict[tuple[bytes, SeriesSurvey | None], Fitted]()
    for _ in range(ALTERNATIONS):
        key = in_events.tobytes(), before
        if key in rounds:
            # Rounds repeat from there on, and chance decides which comes last; flares are exceptions from the light.
            repeated = list(rounds.values())[list(rounds).index(key) :]
            return min(repeated, key=lambda state: int(state[1].sum()))
        fitted = _fit_processes(survey, ~in_events, before, steps)
        detected = detect_events(fitted, PROVISIONAL, steps)[1]
        rounds[key] = fitted, detected
        changed = float((detected ^ in_events).mean())
        in_events = detected
        if changed <= SETTLED:
            break
        # Terms are chosen again as long as many frames change.
        before = fitted if changed < 10 * SETTLED else None
    return fitted, in_events


def _fit_processes(survey: SeriesSurvey, quiet: Bool, before: SeriesSurvey | None, steps: Steps) -> SeriesSurvey:
    """Fit the processes of a survey to its quiescent frames, from those of a survey of nearly the same frames."""
    # The flux of a light curve is its only sum.
    columns, fits = [*survey.sums.T, *([survey.flux] if survey.weighted else [])], list[Process]()
    starts = [None] * len(columns) if before is None else [*before.processes, before.flux_process]
    for column, start in zip(columns, starts, strict=False):
        time, values, variance = survey.stare.start_s[quiet], column[quiet], survey.variance[quiet]
        fits.append(fit_process(BinnedLightCurve(time, values, variance, survey.stare.frame_s).binned(), start, steps))
    return replace(survey, processes=tuple(fits[: survey.sums.shape[1]]), flux_process=fits[-1])


#: Share of the frames in events of a star whose light is constant, and of one that rotates, and noise relative to the
#: stated one, above which losses are tried (assumed).
MOST_FLARING, MOST_ACTIVE, MOST_EXCESS = 0.1, 0.3, 1.5
#: Time scale from which a process is slow (assumed: 2 d, twelve times the longest loss that is searched).
SLOW_S = 172_800.0
#: Smallest standard deviation of a process that losses of light may have caused, relative to the noise of a mean over
#: its time scale (assumed: losses with an S/N of 5 in 1 % of the frames give 0.5).
LEAST_LOSS = 0.5
#: Largest share of the frames in losses; more of them are the level of the star, before or after a step (assumed).
MOST_LOST = 0.4
#: The same where the light returns from losses to a constant level, which it does not after a step (assumed).
MOST_LOST_CONSTANT = 0.9
#: Standard deviations of a frame above the median of a constant light from which frames belong to flares; their number
#: before and, relative to the length, after the bright frames; the largest share of such frames (assumed).
BRIGHT, BEFORE, DECAY, MOST_BRIGHT = 4.0, 2, 3, 0.3
#: Shortest period of eclipses, their durations as shares of the period, and the factor by which the guessed ones are
#: widened, because they begin and end gradually (assumed).
SHORTEST_PERIOD_S, ECLIPSES, WIDENED = 17_280.0, np.array([0.03, 0.06, 0.12]), 1.6
#: Largest number of values in which eclipses are guessed, and the shift of a box in its durations between two periods.
MOST_BINNED, MOVED = 3000, 0.5
#: Smallest number of eclipses, and smallest share that is at least half as deep as the median (a flare may fill some).
LEAST_ECLIPSES, ALIKE = 3, 0.8
#: Share of the period whose median is the light around an eclipse, and parameters of the times of eclipses.
AROUND, EPHEMERIS = 0.3, 5
#: Mean of consecutive frames, in standard deviations of a frame below the star, that belong to an eclipse.
FAINT = 1.5


class Loss(Shape):
    """A constant loss that begins and ends suddenly, for two half-widths."""

    name = "loss"
    source = "assumed"
    square_integral = 2.0

    def at(self, tau: ArrayLike) -> Float:
        return (np.abs(tau) <= 1.0).astype(np.float64)

    def before(self, tau: ArrayLike) -> Float:
        return np.clip(np.asarray(tau, np.float64) + 1.0, 0.0, 2.0)

    def after(self, tau: ArrayLike) -> Float:
        return np.clip(1.0 - np.asarray(tau, np.float64), 0.0, 2.0)


def sudden_losses(survey: SeriesSurvey, fitted: SeriesSurvey, in_events: Bool, steps: Steps) -> Bool:
    """Return the frames in which light is lost, if losses explain a light curve better than flares do.

    Without losses, a star does not flare in many of its frames, keeps its noise, and varies slowly. Otherwise the light
    curve, `survey`, is searched upside down, and the criterion of `fitted` and its events is compared.
    """
    lost, process = np.zeros_like(in_events), fitted.flux_process
    rotates = any(term.rotates for term in process.terms)
    slow_s = min(survey.stare.duration_s / 3, SLOW_S)
    noise = process.excess * float(np.sqrt(np.median(fitted.variance)))
    short = [term for term in process.terms if not term.rotates and term.scale_s < slow_s]
    fast = any(term.sd * np.sqrt(term.scale_s / survey.stare.frame_s) > LEAST_LOSS * noise for term in short)
    active = in_events.mean() > MOST_ACTIVE
    many = active or (in_events.mean() > MOST_FLARING and not rotates)
    if survey.weighted or not (many or process.excess > MOST_EXCESS or fast):
        return lost
    dark = ~_bright_frames(survey)
    survey, fitted, in_events = survey.frames(dark), fitted.frames(dark), in_events[dark]
    down = replace(survey.inverted(), bank=bank_of(survey.stare, survey.bank.directions, Loss()))
    # Losses in independent noise are the first guess: a process that is fitted to losses would hide them.
    guessed = detect_events(down, PROVISIONAL, steps)[1]
    # The criterion of flares without losses, which takes long.
    usual = cache(partial(criterion, fitted, in_events))
    # Those of a star that varies are most of its frames; eclipses repeat.
    if active and guessed.mean() >= MOST_LOST and (eclipses := _find_eclipses(survey, usual)).any():
        lost[dark] = eclipses
        return lost
    other, losses = alternate(down, guessed, None, steps)
    # The star is constant between losses, or before and after one; not only before or after a step.
    returns = np.count_nonzero(np.diff(true_runs(~losses)) > END_FRAMES) > 1
    constant = returns and not other.flux_process.terms and other.flux_process.excess < MOST_EXCESS
    if 0 < losses.mean() < (MOST_LOST_CONSTANT if constant else MOST_LOST):
        # Beside flares in even more frames, the star would be more than its noise.
        simpler = constant and losses.mean() < in_events.mean() and process.excess > MOST_EXCESS
        if simpler or criterion(other, losses, shapeless=True) < usual():
            lost[dark] = losses
    return lost


def _find_eclipses(survey: SeriesSurvey, usual: Callable[[], float]) -> Bool:
    """Return the frames in periodic losses if these lower the criterion, which is `usual()` without them."""
    guessed = guess_eclipses(survey)
    lost, size = np.zeros_like(guessed), float(np.log(guessed.size))
    if not 0 < guessed.mean() < MOST_LOST:
        return lost
    bright, dim = survey.frames(~guessed), survey.frames(guessed)
    guess = levels.guess_flares(bright.stare.numbers, bright.flux)
    fitted, in_events = fit_quiet_light(bright, guess, None, UNREPORTED)
    # The light in eclipses may have any smooth shape.
    data = BinnedLightCurve(dim.stare.start_s, dim.sums[:, 0], dim.variance, dim.stare.frame_s)
    cost = EPHEMERIS * size + criterion_of_process(fit_process(data), data, size)
    if criterion(fitted, in_events) + cost >= usual():
        return lost
    quiet = ~guessed
    quiet[quiet] = ~in_events
    sigma = uniform_filter1d(survey.fitted(fitted).along(0, quiet), END_FRAMES)
    # Frames at the ends of the guess that are as bright as the star are searched.
    for first, end in true_runs(guessed):
        faint = first + np.flatnonzero(sigma[first:end] < -FAINT)
        if faint.size:
            lost[max(first, faint[0] - END_FRAMES) : min(end, faint[-1] + END_FRAMES + 1)] = True
    return lost


def guess_eclipses(survey: SeriesSurvey) -> Bool:
    """Return a first guess of the frames in periodic losses, by box least squares, shape (n_frame,).

    As of a binary star, there may be two boxes of one period (Kovacs, Zucker & Mazeh 2002, doi
    10.1051/0004-6361:20020802).
    """
    from astropy.timeseries import BoxLeastSquares

    time = survey.stare.start_s
    inside = np.zeros(time.size, np.bool_)
    data = BinnedLightCurve(time, survey.flux, survey.variance, survey.stare.frame_s).binned(MOST_BINNED)
    period = max(SHORTEST_PERIOD_S, 2 * data.step_s / ECLIPSES[0])
    grids = []
    while period < data.span_s / 3:
        # Between neighbouring periods the last box moves by a part of the shortest duration.
        number = max(2, int(data.span_s / (2 * period) / (MOVED * ECLIPSES[0])))
        grids.append(1 / np.linspace(1 / (2 * period), 1 / period, number))
        period *= 2
    if not grids:
        return inside
    values = data.values
    for _ in range(2):
        outside = ~inside[np.searchsorted(time, data.time_s)]
        search = BoxLeastSquares(data.time_s[outside], values[outside])
        periodograms = [search.power(grid, ECLIPSES * grid.min()) for grid in grids]
        best = max(periodograms, key=lambda periodogram: float(periodogram.power.max()))
        k = int(np.argmax(best.power))
        period, middle, length = float(best.period[k]), float(best.transit_time[k]), float(best.duration[k])
        size = max(3, round(AROUND * period / data.step_s))
        turn, distance = _turns(data.time_s, period, middle)
        dim = (distance < length / 2) & outside
        around = data.values - median_filter(data.values, size, mode="nearest")
        depths = np.array([np.median(around[dim & (turn == number)]) for number in np.unique(turn[dim])])
        # Losses that are seen once or twice, or that differ in depth, are no eclipses.
        if depths.size < LEAST_ECLIPSES or np.mean(depths < 0.5 * np.median(depths)) < ALIKE or np.median(depths) >= 0:
            break
        inside |= _turns(time, period, middle)[1] < WIDENED * length / 2
        grids = [np.array([period])]
        # The star may vary by more than the shallower eclipse.
        outside = ~inside[np.searchsorted(time, data.time_s)]
        values = data.values.copy()
        values[outside] -= median_filter(values[outside], size, mode="nearest")
    return inside


def _turns(time: Float, period: float, middle: float) -> tuple[Float, Float]:
    """Return the number of the nearest eclipse, and the time from its middle."""
    turn = np.rint((time - middle) / period)
    return turn, np.abs(time - middle - turn * period)


def _bright_frames(survey: SeriesSurvey) -> Bool:
    """Return frames far above the level that most frames have, and those after them, as long as flares decay."""
    sigmas = (survey.flux - np.median(survey.flux)) / np.sqrt(survey.variance)
    bright = np.zeros(sigmas.size, np.bool_)
    for first, end in true_runs(sigmas > BRIGHT):
        bright[max(0, first - BEFORE) : end + DECAY * (end - first)] = True
    return bright if bright.mean() < MOST_BRIGHT else np.zeros_like(bright)


#: Number of frames whose median is the level around a single bright frame.
SPIKE_FRAMES = 9
#: Largest number of times that single frames are left out and the others are fitted again.
ROUNDS = 3


def survey_light_curve(
    frames: Frames, shape: Shape, seed: int, steps: Steps = UNREPORTED
) -> tuple[SeriesSurvey, levels.QuiescentLevel, Frames]:
    """Fit the quiescent light of a light curve, and prepare its search; `seed` is that of the error of the level.

    Frames of few counts are returned with a remark and without errors. `steps` reports fits, searches and draws.
    """
    fits = steps.part(0.0, 0.9)
    frames, counts, reasons, steps_of_level = _prepare(frames)
    used = reasons == 0
    flux, error = frames.white_light
    flux, error = flux / steps_of_level, None if error is None else error / steps_of_level
    # A frame of no count at the least has the Poisson noise of one.
    least = 0.0 if counts is None else float(np.sqrt(max(np.median(flux[used]) * counts, 1.0))) / counts
    survey: SeriesSurvey | None = None
    for number in range(ROUNDS):
        used = reasons == 0
        if survey is None:
            guessed = np.zeros(flux.size, np.bool_)
            guessed[used] = levels.guess_flares(frames.numbers[used], flux[used], least)
            level = np.full(flux.size, _mean(frames.name, flux[used & ~guessed], least))
        quiet = used & ~guessed
        variance, photon = levels.noise_of_frames(frames, flux, error, level, quiet, counts)
        typical = float(np.median(level[quiet]))
        new = SeriesSurvey.of(frames, flux, variance, used, typical, photon, shape, counts or 0.0)
        survey, in_events = fit_quiet_light(new, guessed[used], survey, fits)
        if number == 0 and counts is None and (lost := sudden_losses(new, survey, in_events, fits)).any():
            reasons[used] |= np.where(lost, Reason.LOSS, 0)
            survey = None
            continue
        level = np.interp(frames.time_s, frames.time_s[used], survey.flux_level(~in_events) * survey.scale)
        sd = np.sqrt(variance) * survey.flux_process.excess
        guessed = np.zeros(flux.size, np.bool_)
        guessed[used] = in_events
        flagged = _flag_single_frames(frames, flux, level, sd, used, guessed, counts)
        if not flagged[used].any():
            break
        reasons = np.where(used, reasons | flagged, reasons)
    assert survey is not None
    below = np.isfinite(flux) & (reasons != 0) & (flux - level < -levels.FAR * sd)
    reasons = np.where(below, reasons | Reason.BELOW, reasons)
    survey = survey.frames((reasons == 0)[np.searchsorted(frames.time_s, survey.time_s)])
    light = quiescent_light(frames, survey, reasons, ~guessed, seed, steps.part(0.9, 1.0))
    return survey, light.times(steps_of_level), frames


def _prepare(frames: Frames) -> tuple[Frames, float | None, NDArray[np.int64], Float]:
    """Return frames, counts in a unit of their flux, why some are not searched, and the level relative to the typical.

    Frames of few counts have no errors; for others, counts are None. Raises InputError if too few frames are usable.
    """
    if (counts := levels.counts_per_unit(frames)) is not None:
        remark = "the frames hold few counts: their noise is Poisson noise of the level, and stated errors are not used"
        frames = replace(frames, error=None).with_remarks((remark,))
    flux, error = frames.white_light
    reasons, level = frames.faults.copy(), np.ones(flux.size)
    levels.check_usable(frames, reasons)
    if counts is None:
        # Single frames far above the frames around them, as the level is not known yet.
        usable, sigmas = reasons == 0, np.zeros(flux.size)
        scatter = levels.noise_of_steps(frames.numbers[usable], flux[usable])
        sd = np.full(int(usable.sum()), scatter) if error is None else np.maximum(error[usable], scatter)
        above = flux[usable] - median_filter(flux[usable], size=SPIKE_FRAMES, mode="nearest")
        sigmas[usable] = np.divide(above, sd, out=np.zeros(sd.size), where=sd > 0)
        reasons[levels.single_frames(frames.numbers, sigmas, usable)] |= Reason.SPIKE
        if np.ptp(frames.time_s) > LONG_S:
            rows = np.flatnonzero(reasons == 0)
            relative = levels.relative_level(frames.time_s[rows], frames.numbers[rows], flux[rows], frames.cadence_s)
            # Frames that are not searched have the level of the next one that is.
            level = relative[np.clip(np.searchsorted(rows, np.arange(flux.size)), 0, rows.size - 1)]
    return frames, counts, reasons, level


def _mean(name: str, flux: Float, least: float) -> float:
    """Return the mean without outliers, which must not be zero; a median of whole numbers would be one of them."""
    middle = float(np.median(flux))
    spread = max(PER_MAD * float(np.median(np.abs(flux - middle))), least)
    near = np.abs(flux - middle) <= max(levels.FAR * spread, 1e-12 * abs(middle))
    if (mean := float(flux[near].mean())) == 0.0:
        raise InputError(f"{name}: the level of the star's light must not be zero", key="flux")
    return mean


def _flag_single_frames(
    frames: Frames, flux: Float, level: Float, sd: Float, used: Bool, events: Bool, counts: float | None
) -> NDArray[np.int64]:
    """Return the reasons not to search single frames: far below the level, or alone far above it."""
    sigmas = np.where(used, (flux - level) / sd, 0.0)
    flagged = np.zeros(flux.size, np.int64)
    below = (sigmas < -levels.FAR) & ~events
    if below.mean() <= levels.MOST_BELOW:
        flagged[below] = Reason.BELOW
    if counts is None:
        flagged[levels.single_frames(frames.numbers, sigmas, used)] |= Reason.SPIKE
    return flagged


def quiescent_light(
    frames: Frames, survey: SeriesSurvey, reasons: NDArray[np.int64], outside: Bool, seed: int, steps: Steps
) -> levels.QuiescentLevel:
    """Return level, its error, and noise of all frames, from those that are searched and `outside` of events."""
    used, process = reasons == 0, survey.flux_process
    quiet, excess = outside[used], process.excess if frames.error is not None else float("nan")
    error = levels.level_error(process, survey.stare.start_s, survey.variance, quiet, seed, steps)
    searched, time_s = (survey.flux_level(quiet), error, np.sqrt(survey.variance) * process.excess), frames.time_s
    level, sd, noise = (np.interp(time_s, time_s[used], values * survey.scale) for values in searched)
    spread = float(level[used].std()) / survey.level
    return levels.QuiescentLevel(level, sd, noise, excess, used & outside, reasons, process, spread)
