"""Detection of events in observed light curves, and the process of the light without them.

The largest statistics above a threshold become events; their frames are taken away, and the rest is searched again.
Process and events are found in alternation: a process that is fitted to flares would hide them, and a flare that is
searched with a wrong process would be too long or too short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mauvecl.host.arrays import Bool, Float
from mauvecl.observations.event_fits import flares_of
from mauvecl.observations.process import UNREPORTED, Binned, Process, Steps, criterion_of_process, fit_process
from mauvecl.observations.search import DetectedEvent, ProcessSearch, SeriesSurvey
from mauvecl.schema.fields import DAY_S
from mauvecl.search.templates import REACH

#: Statistic of events whose frames take no part in fits of the process.
PROVISIONAL = 5.0
#: Largest number of alternations of process and events, and of searches.
ROUNDS, MAX_PASSES = 12, 40
#: Number of events after which no further ones are searched, and the same for each frame of a long light curve.
MOST_EVENTS, MOST_PER_FRAME = 500, 1 / 500
#: Largest number of events in independent noise that are compared with a process, and parameters of a flare.
MAX_COMPARED, PARAMETERS = 8, 3
#: Departures of flares from their shape that are tried for the criterion.
DEPARTURES = (0.0, 0.03, 0.2)
#: Shortest period of rotation (assumed: 0.2 d), and the rise of the criterion for a faster process of which
#: the frames show fewer periods or time scales than a number (both assumed).
FASTEST_ROTATION_S, SEEN_ONCE, REPEATED = 17_280.0, 20.0, 10.0
#: Share of the frames in events that may change in the last alternation.
SETTLED = 0.002
#: Smallest number of quiescent frames to which a process is fitted; with fewer, the longest events are shortened.
MIN_QUIET = 20
#: Share of a template's response to other events, of inexact shapes, that a further event must exceed.
UNCERTAIN = 0.5
#: Flux of a template, in standard deviations of a frame, to which its tail belongs to the event: the smallest for which
#: more than a few events leave most frames to the star (number and share assumed).
FAINT, FEW, MOST_TAKEN = (0.05, 0.2, 0.8), 2, 0.3
#: Length of a light curve above which events are an exception from the light of the star (assumed).
LONG_S = 2 * DAY_S
#: Longest tail and beginning of a template that belong to an event, in half-widths.
LONGEST_TAIL, BEGINNING = 60.0, 1.2
#: Statistic of an event, relative to that of an event next to it, below which it is that one's beginning or tail.
BELONGING = 0.1
#: Half-widths, and shortest time scales of the process, in which smaller events wait for the next search.
NEAR_WIDTHS, NEAR_SCALES = 20.0, 2.0
#: Mean of the last frames of an event, in standard deviations of a frame, and their number, with which it goes on.
STILL_BRIGHT, END_FRAMES = 1.0, 4


def fit_quiet_light(
    survey: SeriesSurvey, guessed: Bool, before: SeriesSurvey | None = None, steps: Steps = UNREPORTED
) -> tuple[SeriesSurvey, Bool]:
    """Fit process and events in alternation, from the guess and, if need be, from the events in independent noise.

    A bright, slow flare resembles a process that is seen once. There, the fit with the events in independent noise is
    compared by the Bayesian information criterion, with the flares among the parameters. For arguments see `alternate`.
    """
    fitted, taken = alternate(survey, guessed, before, steps)
    if not _seen_once(fitted):
        return fitted, taken
    noise = tuple(Process((), process.excess) for process in fitted.processes)
    found, others = detect_events(replace(survey, processes=noise), PROVISIONAL)
    if len(found) > MAX_COMPARED or not (others & ~taken).any():
        return fitted, taken
    other, others = alternate(survey, others, None, steps)
    if float((others ^ taken).mean()) <= SETTLED:
        return fitted, taken
    light = light_of_events(fitted, taken)
    first, second = criterion(fitted, light, taken), criterion(other, light_of_events(other, others), others, light)
    return (other, others) if second < first else (fitted, taken)


@dataclass(frozen=True, eq=False)
class EventLight:
    """Light of the flares that fit an event."""

    event: DetectedEvent
    rows: slice
    light: Float  # along the direction of the event, shape (n_row,)
    photon: Float  # variance that it adds
    n_flares: int


def light_of_events(survey: SeriesSurvey, taken: Bool) -> list[EventLight]:
    """Return the light of the events above `PROVISIONAL`."""
    fits = []
    for event in detect_events(survey, PROVISIONAL)[0]:
        flares, scale, photon = flares_of(survey, taken, event)
        total = np.zeros(survey.stare.n_frames)
        every = [_light_of(survey, each.peak_s, each.half_width_s, each.amplitude) for each in flares]
        for rows, flux in every:
            total[rows] += flux
        rows = slice(min(rows.start for rows, _ in every), max(rows.stop for rows, _ in every))
        fits.append(EventLight(event, rows, scale * total[rows], photon * total[rows], len(flares)))
    return fits


def criterion(
    survey: SeriesSurvey,
    fits: Sequence[EventLight],
    taken: Bool,
    further: Sequence[EventLight] = (),
    *,
    shapeless: bool = False,
) -> float:
    """Return the Bayesian information criterion of the processes of a survey and of the flares of `light_of_events`.

    A process of minutes that is hardly seen to repeat costs `SEEN_ONCE`: stars and instruments repeat what they do. If
    `shapeless`, or in independent noise, the light of an event may have any smooth shape, or depart from that of its
    flares, or of `further` ones, by a process.
    """
    size = float(np.log(survey.stare.n_frames))
    every = np.ones(survey.stare.n_frames, np.bool_)
    total = min(_criterion_of(survey, fits, every, epsilon) for epsilon in DEPARTURES)
    shapeless = shapeless or not any(process.terms for process in survey.processes)
    if fits and shapeless and survey.sums.shape[1] == 1:
        alone = []
        for event in (fit.event for fit in fits):
            rows, added = slice(event.first, event.last + 1), [(1, *_added(survey, [], 0.0))]
            for others in (fits, further):
                near = (fit for fit in others if event.first <= fit.event.last and fit.event.first <= event.last)
                if number := sum(fit.n_flares for fit in near):
                    added += [(number, *_added(survey, others, epsilon)) for epsilon in DEPARTURES]
            costs = []
            for n_flares, light, extra in added:
                values, variance = survey.sums[rows, 0] - light[rows, 0], survey.variance[rows] + extra[rows]
                data = Binned(survey.stare.start_s[rows], values, variance, survey.stare.frame_s)
                process = fit_process(data) if event.last - event.first >= MIN_QUIET else Process((), 1.0)
                costs.append(PARAMETERS * n_flares * size + criterion_of_process(process, data, size))
            alone.append(min(costs))
        total = min(total, _criterion_of(survey, [], ~taken, 0.0) + sum(alone))
    return total + (SEEN_ONCE if _seen_once(survey) else 0.0)


def _added(survey: SeriesSurvey, fits: Sequence[EventLight], epsilon: float) -> tuple[Float, Float]:
    """Return the light of flares in the sums, (n_frame, n_sum), and the variance of flares that depart by a share."""
    light, variance = np.zeros_like(survey.sums), np.zeros(survey.stare.n_frames)
    for fit in fits:
        light[fit.rows] += fit.light[:, None] * survey.bank.directions[fit.event.direction]
        variance[fit.rows] += fit.photon + (epsilon * fit.light) ** 2
    return light, variance


def _criterion_of(survey: SeriesSurvey, fits: Sequence[EventLight], kept: Bool, epsilon: float) -> float:
    """Return the criterion of some frames, with flares that depart by a share from their shape."""
    start, size = survey.stare.start_s[kept], float(np.log(survey.stare.n_frames))
    light, extra = _added(survey, fits, epsilon)
    total = PARAMETERS * size * sum(fit.n_flares for fit in fits)
    for process, column in zip(survey.processes, (survey.sums - light)[kept].T, strict=True):
        noise = (survey.variance * process.excess**2 + extra)[kept]
        if fits and not process.terms:
            # Frames without events in the tail of a flare have more scatter than noise.
            noise = (survey.variance + extra)[kept]
            process = fit_process(Binned(start, column, noise, survey.stare.frame_s), process)
            noise = noise * process.excess**2
        # The excess is in the noise already.
        data = Binned(start, column, noise, survey.stare.frame_s)
        total += criterion_of_process(replace(process, excess=1.0), data, size)
    return total


def _seen_once(survey: SeriesSurvey) -> bool:
    """Return whether a process is faster than rotation, but too slow to be seen to repeat."""
    span = survey.stare.duration_s
    return any(
        span / REPEATED < term.scale_s < FASTEST_ROTATION_S for process in survey.processes for term in process.terms
    )


def alternate(
    survey: SeriesSurvey, guessed: Bool, before: SeriesSurvey | None, steps: Steps
) -> tuple[SeriesSurvey, Bool]:
    """Fit process and events in alternation; return the survey with processes, and the frames above `PROVISIONAL`.

    The terms of `before`, a survey of nearly the same frames, are kept as long as the events hardly change.
    """
    taken, rounds = guessed, dict[tuple[bytes, SeriesSurvey | None], tuple[SeriesSurvey, Bool]]()
    for _ in range(ROUNDS):
        # Rounds may come back to the same frames.
        key = taken.tobytes(), before
        if key not in rounds:
            # The flux of a light curve is its only sum.
            columns, fits = [*survey.sums.T, *([survey.flux] if survey.weighted else [])], list[Process]()
            befores = [None] * len(columns) if before is None else [*before.processes, before.flux_process]
            for column, start in zip(columns, befores, strict=False):
                time, values, variance = (each[~taken] for each in (survey.stare.start_s, column, survey.variance))
                fits.append(fit_process(Binned.of(time, values, variance, survey.stare.frame_s), start, steps))
            fitted = replace(survey, processes=tuple(fits[: survey.sums.shape[1]]), flux_process=fits[-1])
            rounds[key] = fitted, detect_events(fitted, PROVISIONAL, steps)[1]
        fitted, now = rounds[key]
        changed = float((now ^ taken).mean())
        taken = now
        if changed <= SETTLED:
            break
        # Terms are chosen again as long as many frames change.
        before = fitted if changed < 10 * SETTLED else None
    return fitted, taken


def detect_events(
    survey: SeriesSurvey, threshold: float, steps: Steps = UNREPORTED
) -> tuple[list[DetectedEvent], Bool]:
    """Detect events above a threshold, the largest first, and return them in order of time with their frames."""
    # Where the star is constant, or seen for a short time, events may take any number of frames.
    varies_for_days = survey.stare.duration_s > LONG_S and any(process.terms for process in survey.processes)
    for faint in FAINT if varies_for_days else FAINT[:1]:
        events, taken = _detect_to(survey, threshold, faint, steps)
        if len(events) <= FEW or taken.mean() <= MOST_TAKEN:
            break
    return events, taken


def _detect_to(survey: SeriesSurvey, threshold: float, faint: float, steps: Steps) -> tuple[list[DetectedEvent], Bool]:
    """Detect events whose tails end at a flux in standard deviations of a frame, as `detect_events`."""
    n = survey.stare.n_frames
    taken, found = np.zeros(n, np.bool_), list[DetectedEvent]()
    light = np.zeros_like(survey.sums)
    noise = float(np.sqrt(np.median(survey.variance))) * min(process.excess for process in survey.processes)
    search = survey.search
    for _ in range(MAX_PASSES):
        left = ~taken
        if left.sum() < MIN_QUIET or len(_merged(found)) >= most_events(n):
            break
        part = survey.frames(left)
        if taken.any():
            search = ProcessSearch(part.bank, part.stare, part.processes, part.variance, search)
        new = _search_once(part, search, light[left], threshold)
        steps.step()
        if not new:
            break
        for one in new:
            unit = survey.bank.directions[one.direction]
            rows, flux = _light_of(survey, one.peak_s, one.half_width_s, one.amplitude)
            light[rows] += flux[:, None] * unit
        mine = []
        for one in new:
            first, last = _extent(survey, taken, faint * noise, one)
            # Some frames are left for the level, the faintest of the event.
            short = MIN_QUIET - int(np.count_nonzero(~taken)) + last - first + 1
            last = max(last - max(short, 0), first)
            mine.append((first, last))
            taken[first : last + 1] = True
        mine = _extended(survey, taken, mine, new, crowded=faint > FAINT[0])
        for (first, last), one in zip(mine, new, strict=True):
            taken[first : last + 1] = True
            found.append(replace(one, first=first, last=last))
    return _merged(found), taken


def most_events(n_frames: int) -> int:
    """Return the number of events at which a search of some frames ends, although there may be more."""
    return max(MOST_EVENTS, int(MOST_PER_FRAME * n_frames))


def _merged(found: list[DetectedEvent]) -> list[DetectedEvent]:
    """Return the events in order of time, without those that overlap a larger one or are its beginning or tail."""
    kept: list[DetectedEvent] = []
    for one in sorted(found, key=lambda each: each.first):
        if kept:
            smaller, larger = sorted((one, kept[-1]), key=lambda each: each.value)
            touching = one.first == kept[-1].last + 1 and smaller.value < BELONGING * larger.value
            if one.first <= kept[-1].last or touching:
                other = kept.pop()
                one = replace(larger, first=min(one.first, other.first), last=max(one.last, other.last))
        kept.append(one)
    return kept


def _light_of(survey: SeriesSurvey, peak_s: float, half_width_s: float, amplitude: float) -> tuple[slice, Float]:
    """Return the frames in which a flare is not negligible, and its mean in each, in the unit of the amplitude."""
    start, frame_s = survey.stare.start_s, survey.stare.frame_s
    # From the frame on in which it begins.
    ends = [peak_s - REACH[0] * half_width_s - frame_s, peak_s + REACH[1] * half_width_s]
    rows = slice(*np.searchsorted(start, ends))
    edges = np.column_stack([start[rows], start[rows] + frame_s])
    return rows, amplitude * survey.bank.shape.mean_over(edges, peak_s, half_width_s)


def _search_once(part: SeriesSurvey, search: ProcessSearch, light: Float, threshold: float) -> list[DetectedEvent]:
    """Return the largest events among the frames that are left, at most one near another."""
    both = np.stack([part.sums, UNCERTAIN * light]) if light.any() else part.sums[None]
    # Local maxima above the threshold, of which there are many where the process does not describe the light.
    parts = []
    for row, rho in search.values(both, threshold):
        excess = rho[0] - np.abs(np.where(np.isfinite(rho[1]), rho[1], 0.0)) if len(rho) > 1 else rho[0]
        direction = excess.argmax(axis=0)
        best = excess[direction, np.arange(excess.shape[1])]
        # Local maxima only: neighbours belong to the same event.
        top = (best >= np.append(best[1:], -np.inf)) & (best >= np.insert(best[:-1], 0, -np.inf))
        onset = np.flatnonzero(top & (best >= threshold))
        along, half_width = direction[onset], np.full(onset.size, row.template.half_width_s)
        value = rho[0, along, onset]
        amplitude = value / row.per_amplitude[along, onset]
        parts.append(np.array([best[onset], value, half_width, search.peaks_s(row)[onset], along, amplitude]))
    bests, *others = np.concatenate(parts, axis=1)
    order = np.argsort(bests)[::-1][: 4 * most_events(part.stare.n_frames)]
    scales = min(one.shortest_s for one in part.processes)
    scale = NEAR_SCALES * scales if np.isfinite(scales) else 0.0
    accepted: list[DetectedEvent] = []
    peaks, reaches = np.empty((2, order.size))
    for n, (value, half_width, peak, along, amplitude) in enumerate(np.array(others)[:, order].T.tolist()):
        peaks[n], reaches[n] = peak, max(NEAR_WIDTHS * half_width, scale)
        if (np.abs(peak - peaks[:n]) > np.maximum(reaches[n], reaches[:n])).all():
            accepted.append(DetectedEvent(value, half_width, peak, int(along), amplitude, 0, 0))
    return accepted


def _extent(survey: SeriesSurvey, taken: Bool, faint: float, one: DetectedEvent) -> tuple[int, int]:
    """Return the first and last frame in which the template of an event is brighter than a flux."""
    tau = np.linspace(0.0, LONGEST_TAIL, 1200)
    bright = tau[one.amplitude * survey.bank.shape.at(tau) > faint]
    tail = max(1.0, float(bright[-1]) if bright.size else 0.0)
    frame_s = survey.stare.frame_s
    start = one.peak_s - BEGINNING * one.half_width_s - frame_s / 2
    stop = one.peak_s + tail * one.half_width_s + frame_s / 2
    # As the middles of frames, at which they are looked up, but for half a frame.
    first, last, peak = np.searchsorted(survey.stare.start_s, np.array([start, stop, one.peak_s]) - frame_s / 2)
    peak = min(int(peak), survey.stare.n_frames - 1)
    first, last = min(int(first), peak), max(int(last) - 1, peak)
    # Other events end it.
    before, after = np.flatnonzero(taken[first:peak]), np.flatnonzero(taken[peak : last + 1])
    if before.size:
        first = first + int(before[-1]) + 1
    if after.size and after[0] > 0:
        last = peak + int(after[0]) - 1
    return first, max(first, last)


def _extended(
    survey: SeriesSurvey, taken: Bool, extents: list[tuple[int, int]], found: list[DetectedEvent], *, crowded: bool
) -> list[tuple[int, int]]:
    """Extend events to frames that are brighter than the level; in crowded light curves, cut off those that are not."""
    quiet = ~taken
    if quiet.sum() < MIN_QUIET:
        return extents
    steps = np.diff(survey.stare.numbers)
    sigmas = {direction: survey.along(direction, quiet) for direction in {one.direction for one in found}}
    longer = []
    for (first, last), one in zip(extents, found, strict=True):
        sigma, length = sigmas[one.direction], last - first + 1
        if crowded:
            peak = first + int(sigma[first : last + 1].argmax())
            while last > peak + 1 and sigma[max(peak, last + 1 - END_FRAMES) : last + 1].mean() < STILL_BRIGHT:
                last -= 1
        # Gaps that are longer than it end an event.
        before, after = steps[max(0, first - length) : first] > length, steps[last : last + length] > length
        stop = last + (int(after.argmax()) if after.any() else length)
        stop = min(stop, sigma.size - 1, last + int(quiet.sum()) - MIN_QUIET)
        while last < stop and not taken[last + 1] and sigma[last + 1 : last + 1 + END_FRAMES].mean() > STILL_BRIGHT:
            last += 1
        start, ends = first - int(before[::-1].argmax()) if before.any() else max(first - length, 0), END_FRAMES
        while first > start and not taken[first - 1] and sigma[max(0, first - ends) : first].mean() > STILL_BRIGHT:
            first -= 1
        longer.append((first, last))
    return longer
