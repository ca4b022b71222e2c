"""Events of observed light curves: flares, or other changes, their detection and their times, causes and energies.

The largest statistics above a threshold become events; their frames are removed, and the others are searched again.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Literal

import numpy as np
import scipy

from mauvecl.flares.shapes import consecutive_integrals
from mauvecl.host.arrays import Bool, Float, map_in_threads
from mauvecl.observations.event_fits import Fit, NormalMixture, fit_event, join
from mauvecl.observations.event_windows import GENERAL, LOG_TIME, FittedFlare, Window, log_time
from mauvecl.observations.process import UNREPORTED, Steps
from mauvecl.observations.search import MIN_BASELINE, DetectedEvent, SeriesSurvey
from mauvecl.schema.fields import DAY_S
from mauvecl.search.search import REACH

#: Largest number of searches.
MAX_PASSES = 40
#: Number of events at which the search ends, and the same for each frame of a long light curve.
MOST_EVENTS, MOST_PER_FRAME = 500, 1 / 500
#: Smallest number of quiescent frames to which a process is fitted; with fewer, the longest events are shortened.
MIN_QUIET = 20
#: Share of its template's response to earlier events, whose shapes are inexact, that a further event must exceed.
UNCERTAIN = 0.5
#: Flux of a template, in standard deviations of a frame, at which the tail of an event ends. The next larger one is
#: tried if more than a number of events take more than a share of the frames (both assumed).
FAINT, FEW, MOST_IN_EVENTS = (0.05, 0.2, 0.8), 2, 0.3
#: Length of a light curve above which events are an exception from the light of the star (assumed).
LONG_S = 2 * DAY_S
#: Longest tail and beginning of a template that belong to an event, in half-widths.
LONGEST_TAIL, BEGINNING = 60.0, 1.2
#: Ratio of the statistics of two adjacent events below which the smaller is the beginning or tail of the larger.
BELONGING = 0.1
#: Distance from a larger event within which smaller ones wait for the next search, in half-widths and in shortest time
#: scales of the process.
NEAR_WIDTHS, NEAR_SCALES = 20.0, 2.0
#: Mean of frames at the end of an event above which it continues, in standard deviations of a frame, and their number.
STILL_BRIGHT, END_FRAMES = 1.0, 4


def detect_events(
    survey: SeriesSurvey, threshold: float, steps: Steps = UNREPORTED
) -> tuple[list[DetectedEvent], Bool]:
    """Detect events above a threshold, the largest first.

    Return them in order of time, and the frames that belong to events, shape (n_frame,).
    """
    # Where the star is constant, or observed for a short time, events may contain any number of frames.
    varies_for_days = survey.stare.duration_s > LONG_S and any(process.terms for process in survey.processes)
    for faint in FAINT if varies_for_days else FAINT[:1]:
        events, in_events = _detect_with_tails(survey, threshold, faint, steps)
        if len(events) <= FEW or in_events.mean() <= MOST_IN_EVENTS:
            break
    return events, in_events


def _detect_with_tails(
    survey: SeriesSurvey, threshold: float, faint: float, steps: Steps
) -> tuple[list[DetectedEvent], Bool]:
    """Detect events as `detect_events` does; their tails end where they are `faint`, in standard deviations."""
    n = survey.stare.n_frames
    in_events, events = np.zeros(n, np.bool_), list[DetectedEvent]()
    light = np.zeros_like(survey.sums)
    noise = float(np.sqrt(np.median(survey.variance))) * min(process.excess for process in survey.processes)
    for _ in range(MAX_PASSES):
        quiet = ~in_events
        if quiet.sum() < MIN_QUIET or len(_merge(events)) >= most_events(n):
            break
        largest = _search_once(survey if quiet.all() else survey.frames(quiet), light[quiet], threshold)
        steps.step()
        if not largest:
            break
        located = []
        for event in largest:
            rows, flux = light_of_flare(survey, event.peak_s, event.half_width_s, event.amplitude)
            light[rows] += flux[:, None] * survey.bank.directions[event.direction]
            first, last = _find_extent(survey, in_events, faint * noise, event)
            # Some frames remain for the level; they are the faintest of the event.
            lacking = MIN_QUIET - int(np.count_nonzero(~in_events)) + last - first + 1
            last = max(last - max(lacking, 0), first)
            located.append(replace(event, first=first, last=last))
            in_events[first : last + 1] = True
        for event in _extend(survey, in_events, located, crowded=faint > FAINT[0]):
            in_events[event.first : event.last + 1] = True
            events.append(event)
    return _merge(events), in_events


def most_events(n_frames: int) -> int:
    """Return the number of events at which a search of some frames ends, although there may be more."""
    return max(MOST_EVENTS, int(MOST_PER_FRAME * n_frames))


def _merge(events: list[DetectedEvent]) -> list[DetectedEvent]:
    """Return the events in order of time, without those that overlap a larger one or are its beginning or tail."""
    merged: list[DetectedEvent] = []
    for event in sorted(events, key=lambda event: event.first):
        before = merged[-1] if merged else event
        smaller, larger = sorted((event, before), key=lambda event: event.value)
        touching = event.first == before.last + 1 and smaller.value < BELONGING * larger.value
        if merged and (event.first <= before.last or touching):
            merged[-1] = replace(larger, first=min(event.first, before.first), last=max(event.last, before.last))
        else:
            merged.append(event)
    return merged


def light_of_flare(survey: SeriesSurvey, peak_s: float, half_width_s: float, amplitude: float) -> tuple[slice, Float]:
    """Return the frames in which a flare is not negligible, and its mean in each, in the unit of the amplitude."""
    start, frame_s = survey.stare.start_s, survey.stare.frame_s
    # From the frame on in which it begins.
    ends = [peak_s - REACH[0] * half_width_s - frame_s, peak_s + REACH[1] * half_width_s]
    rows = slice(*np.searchsorted(start, ends))
    edges = np.column_stack([start[rows], start[rows] + frame_s])
    return rows, amplitude * survey.bank.shape.mean_over(edges, peak_s, half_width_s)


def _search_once(survey: SeriesSurvey, light: Float, threshold: float) -> list[DetectedEvent]:
    """Return the largest events of a survey, at most one near another, without their frames.

    `light` is that of the events of earlier searches, shape (n_frame, n_sum).
    """
    sums = np.stack([survey.sums, UNCERTAIN * light]) if light.any() else survey.sums[None]
    # Local maxima above the threshold, of which there are many where the process does not describe the light.
    maxima = []
    for row, rho in survey.search.values(sums, threshold):
        excess = rho[0] - np.abs(np.where(np.isfinite(rho[1]), rho[1], 0.0)) if len(rho) > 1 else rho[0]
        direction = excess.argmax(axis=0)
        best = excess[direction, np.arange(excess.shape[1])]
        # Neighbours of a maximum belong to the same event.
        top = (best >= np.append(best[1:], -np.inf)) & (best >= np.insert(best[:-1], 0, -np.inf))
        onset = np.flatnonzero(top & (best >= threshold))
        along, half_width = direction[onset], np.full(onset.size, row.template.half_width_s)
        value = rho[0, along, onset]
        amplitude = value / row.per_amplitude[along, onset]
        maxima.append(np.array([best[onset], value, half_width, survey.search.peaks_s(row)[onset], along, amplitude]))
    values = np.concatenate(maxima, axis=1)
    order = np.argsort(values[0])[::-1][: 4 * most_events(survey.stare.n_frames)]
    shortest_s = min(process.shortest_s for process in survey.processes)
    scale = NEAR_SCALES * shortest_s if np.isfinite(shortest_s) else 0.0
    accepted: list[DetectedEvent] = []
    peaks, reaches = np.empty((2, order.size))
    for n, (value, half_width, peak, along, amplitude) in enumerate(values[1:, order].T.tolist()):
        peaks[n], reaches[n] = peak, max(NEAR_WIDTHS * half_width, scale)
        if (np.abs(peak - peaks[:n]) > np.maximum(reaches[n], reaches[:n])).all():
            accepted.append(DetectedEvent(value, half_width, peak, int(along), amplitude, 0, 0))
    return accepted


def _find_extent(survey: SeriesSurvey, in_events: Bool, faint: float, event: DetectedEvent) -> tuple[int, int]:
    """Return the first and last frame in which the template of an event is brighter than a flux.

    The frames of other events around the peak end it.
    """
    tau = np.linspace(0.0, LONGEST_TAIL, 1200)
    bright = tau[event.amplitude * survey.bank.shape.at(tau) > faint]
    tail = max(1.0, float(bright[-1]) if bright.size else 0.0)
    frame_s = survey.stare.frame_s
    start = event.peak_s - BEGINNING * event.half_width_s - frame_s / 2
    stop = event.peak_s + tail * event.half_width_s + frame_s / 2
    first, last, peak = np.searchsorted(survey.stare.start_s, np.array([start, stop, event.peak_s]) - frame_s / 2)
    peak = min(int(peak), survey.stare.n_frames - 1)
    first, last = min(int(first), peak), max(int(last) - 1, peak)
    before, after = np.flatnonzero(in_events[first:peak]), np.flatnonzero(in_events[peak : last + 1])
    if before.size:
        first = first + int(before[-1]) + 1
    if after.size and after[0] > 0:
        last = peak + int(after[0]) - 1
    return first, max(first, last)


def _extend(
    survey: SeriesSurvey, in_events: Bool, events: list[DetectedEvent], *, crowded: bool
) -> list[DetectedEvent]:
    """Extend events to frames that are brighter than the level; in crowded light curves, cut off those that are not."""
    quiet = ~in_events
    if quiet.sum() < MIN_QUIET:
        return events
    steps = np.diff(survey.stare.numbers)
    sigmas = {direction: survey.along(direction, quiet) for direction in {event.direction for event in events}}
    extended, bright = [], STILL_BRIGHT
    for event in events:
        sigma, first, last = sigmas[event.direction], event.first, event.last
        length = last - first + 1
        if crowded:
            peak = first + int(sigma[first : last + 1].argmax())
            while last > peak + 1 and sigma[max(peak, last + 1 - END_FRAMES) : last + 1].mean() < bright:
                last -= 1
        # Gaps that are longer than it end an event.
        before, after = steps[max(0, first - length) : first] > length, steps[last : last + length] > length
        stop = last + (int(after.argmax()) if after.any() else length)
        stop = min(stop, sigma.size - 1, last + int(quiet.sum()) - MIN_QUIET)
        while last < stop and not in_events[last + 1] and sigma[last + 1 : last + 1 + END_FRAMES].mean() > bright:
            last += 1
        start = first - int(before[::-1].argmax()) if before.any() else max(first - length, 0)
        while first > start and not in_events[first - 1] and sigma[max(0, first - END_FRAMES) : first].mean() > bright:
            first -= 1
        extended.append(replace(event, first=first, last=last))
    return extended


#: Fall of chi-squared by which a step must fit better than a flare.
STEP_GAIN = 9.0
#: Light of the fitted flares that the frames of an event may lack, in standard errors and as a share.
LACKING_ERRORS, LACKING_SHARE = 5.0, 0.5
#: Probability of a larger chi-squared below which no shape fits an event without departures.
POOR = 1e-3
#: Levels of the intervals.
LEVELS = (0.6826894921370859, 0.95)
#: Number of frames on each side of an event from which the error of its level follows.
NEARBY = 10_000
#: An event shows no flare if its frames are together fainter than the level by this many errors of their sum.
FAINTER_ERRORS = 2.0


Kind = Literal["flare", "step", "dip", "throughput", "dark current", "sky", "cosmic ray"]

#: Number of missing frames next to an event beyond which it may have begun before or continued after them.
GAP_FRAMES = 3
#: Share of a flare's light outside the frames of its event from which their sum is a lower limit.
UNSEEN = 0.05


def _find_kind(fits: Sequence[Fit], summed: float, error: float) -> Kind:
    """Return whether an event is a flare, a step or a dip, by its fits of published shapes.

    The general family would resemble all of these. In a dip, the light `summed` over the frames lacks much of that of
    the best fit, as during an eclipse. Spectra show no dips: their sum over wavelength may fall during a flare, by a
    loss of light that their weights leave out.
    """
    best = max(fits, key=lambda fit: fit.mixture.log_total)
    level, window = float(best.plain.level_without(best.light)), best.window
    survey, event = window.survey, window.event
    start = survey.stare.start_s[event.first : event.last + 1]
    edges, within = np.column_stack([start, start + survey.stare.frame_s]), 0.0
    for flare in best.flares:
        light = consecutive_integrals(best.shape, (edges - flare.peak_s) / flare.half_width_s)
        within += flare.amplitude * flare.half_width_s * float(light.sum())
    mixture = join([fit.mixture for fit in fits])
    low, high = (mixture.quantile(0.5 + sign * LEVELS[0] / 2) for sign in (-1, 1))
    lacking, uncertain = (within - summed) / level, float(np.hypot(error / level, (high - low) / 2))
    if not survey.weighted and lacking > LACKING_ERRORS * uncertain and lacking > LACKING_SHARE * within / level:
        return "dip"
    return "step" if _is_step(fits) else "flare"


def _sum_light(survey: SeriesSurvey, in_events: Bool, level: Float, event: DetectedEvent) -> tuple[float, float]:
    """Return the sum of the light above the level over the frames of an event, amplitude x s, and its error.

    Missing frames are interpolated. The error includes that of the level given the quiescent frames.
    """
    rows = slice(event.first, event.last + 1)
    flux, numbers = survey.flux[rows] - level[rows], survey.stare.numbers[rows]
    all_numbers = np.arange(numbers[0], numbers[-1] + 1)
    factor = survey.stare.frame_s * survey.scale / survey.level
    total = float(np.interp(all_numbers, numbers, flux).sum()) * factor
    # Each frame counts for itself and for the missing frames next to it.
    nearest = np.rint(np.interp(all_numbers, numbers, np.arange(numbers.size))).astype(np.int64)
    counts = np.bincount(nearest, minlength=numbers.size)
    process = survey.flux_process
    begin = max(0, event.first - NEARBY)
    near = slice(begin, event.last + 1 + NEARBY)
    time, noise = survey.stare.start_s[near], survey.variance[near] * process.excess**2
    inside = slice(event.first - begin, event.last + 1 - begin)
    variance = float(counts**2 @ (noise[inside] + survey.photon / survey.scale * np.maximum(flux, 0.0)))
    quiet = ~in_events[near]
    if quiet.sum() >= MIN_BASELINE:
        # Variance of the sum of the level given quiescent frames: w^T K w less what they determine of it.
        weights = np.zeros(quiet.size)
        weights[inside] = counts
        # Durations are relative to the level at the peak.
        middle = time[inside] + survey.stare.frame_s / 2
        peak = inside.start + min(int(np.searchsorted(middle, event.peak_s)), numbers.size - 1)
        if (at_peak := float(level[begin + peak])) > 0:
            weights[peak] += total / factor / at_peak
        covariance = process.covariance(time[quiet], noise[quiet])
        of_constant = covariance.solve(np.ones(int(quiet.sum())))
        shared = process.times(time, weights)
        # The variance of the constant level is 1 / (1^T C^-1 1).
        constant = float(weights.sum() - of_constant @ shared[quiet])
        of_level = float(weights @ shared - shared[quiet] @ covariance.solve(shared[quiet]))
        variance += of_level + constant**2 / float(of_constant.sum())
    return total, float(np.sqrt(max(variance, 0.0))) * factor


def _is_step(fits: Sequence[Fit]) -> bool:
    """Return whether a step of the level fits an event better than the flares of every fit do."""
    window = fits[0].window
    inside = window.middle[window.inside]
    starts = window.edges[(window.middle > inside[0] - np.ptp(inside)) & (window.middle < inside[-1]), 0]
    if inside.size < 3 or not starts.size:
        return False
    # Each further flare has three parameters more (Schwarz 1978).
    size = float(np.log(window.values.size))
    scores = [(float(fit.plain.chi2(fit.light)) + 3 * (len(fit.flares) - 1) * size, fit.plain) for fit in fits]
    least, plain = min(scores, key=itemgetter(0))
    steps = (window.middle >= starts[:, None]).astype(np.float64)
    slope = steps @ (plain.inverse @ window.values)
    information = np.einsum("ki,ki->k", steps @ plain.inverse, steps)
    usable = information > 1e-12
    gain = np.where(usable & (slope > 0), slope**2 / np.where(usable, information, 1.0), 0.0)
    constant = float(plain.chi2(np.zeros(window.values.size)))
    return constant - float(gain.max()) < least - STEP_GAIN


@dataclass(frozen=True, eq=False)
class ObservedEvent:
    """A measured event; frames are counted among the searched ones, and durations are equivalent durations."""

    value: float  # largest statistic of the search: the S/N of the best template
    first: int
    last: int  # inclusive
    brightest: int  # frame of the largest flux; in spectra, next to the peak of the best template
    half_width_s: float  # half-width of the best template
    amplitude: float  # largest flux above the level, relative to the level
    missing: int  # number of frames missing inside the event
    cut: bool  # true if the event reaches the first or last frame of the light curve or of the part before a longer gap
    kind: Kind  # a flare, or what resembles one; "step" and "dip" are those of the level
    gap_at_peak: bool  # true if frames are missing next to the brightest, for as long as the half-width of the fit
    summed_s: float  # sum of the light above the level over the frames of the event
    summed_error_s: float
    fitted_s: float  # of the whole flares, the recommended one; median of the posterior
    low_s: tuple[float, float]  # lower ends of the intervals of `LEVELS`
    high_s: tuple[float, float]
    flares: tuple[FittedFlare, ...]  # of the shape of the largest weight, the largest first
    shape: str
    chi2: float  # of these without departures from the shape
    dof: int
    peak_observed: bool  # the peak lies in or next to an observed frame
    level: float  # of the star at the peak, in units of the survey's level

    @property
    def is_limit(self) -> bool:
        """True if the sum of the light in the frames is a lower limit: a gap or an end cuts the flare."""
        return self.cut and self.summed_s < (1 - UNSEEN) * self.fitted_s

    @property
    def unclear(self) -> bool:
        """True if the frames are together fainter than the level by more than its error: they show no light of a flare.

        Where the level is uncertain, as in a gap of hours of a star that rotates, the sum says nothing.
        """
        return self.summed_s < -FAINTER_ERRORS * self.summed_error_s

    @property
    def poor(self) -> bool:
        """True if no shape fits without departures: the interval also includes the disagreement of the shapes."""
        return bool(scipy.stats.chi2.sf(self.chi2, self.dof) < POOR)


def measure_events(
    survey: SeriesSurvey, in_events: Bool, detected: Sequence[DetectedEvent], causes: Sequence[Kind], steps: Steps
) -> list[ObservedEvent]:
    """Measure detected events in order of time; `causes` are those of their spectra, or else flares.

    A weaker event next to a step or a dip belongs to it, and has its kind. `steps` reports each event.
    """
    level = survey.flux_level(~in_events)
    pairs = list(zip(detected, causes, strict=True))
    measured = map_in_threads(lambda pair: measure_event(survey, in_events, level, *pair), pairs)
    events = list(steps.track(measured, len(detected)))
    for k, event in enumerate(events):
        for other in events[max(0, k - 1) : k + 2]:
            adjacent = other.last == event.first - 1 or other.first == event.last + 1
            if event.kind == "flare" and adjacent and other.kind in ("step", "dip") and other.value > event.value:
                events[k] = replace(event, kind=other.kind)
                break
    return events


def measure_event(
    survey: SeriesSurvey, in_events: Bool, level: Float, detected: DetectedEvent, cause: Kind = "flare"
) -> ObservedEvent:
    """Measure an event, given its cause, the frames of all events, `in_events`, and the level in units of the scale."""
    first, last, frame_s = detected.first, detected.last, survey.stare.frame_s
    rows, numbers, middle = slice(first, last + 1), survey.stare.numbers, survey.stare.middle_s
    peak = int(np.clip(np.searchsorted(middle, detected.peak_s), 0, survey.stare.n_frames - 1))
    at_peak = float(level[peak]) * survey.scale / survey.level
    window = replace(Window.of(survey, in_events, detected), quiet_level=at_peak if at_peak > 0 else 1.0)
    fits = fit_event(window, survey.bank.shape)
    best = max(fits, key=lambda fit: fit.mixture.log_total)
    chi2, dof = float(best.plain.chi2(best.light)), window.values.size - 1 - 3 * len(best.flares)
    of_star = float(best.plain.level_without(best.light))
    mixture = _posterior(in_events, fits, scipy.stats.chi2.sf(chi2, dof) < POOR)
    fitted_s = mixture.quantile(0.5)
    low, high = ([mixture.quantile(0.5 + sign * width / 2) for width in LEVELS] for sign in (-1, 1))
    flares = [replace(f, amplitude=f.amplitude / of_star, equivalent_duration_s=f.equivalent_duration_s / of_star)
              for f in best.flares]  # fmt: skip
    summed, error = _sum_light(survey, in_events, level, detected)
    published = [fit for fit in fits if fit.shape.name != GENERAL]
    kind = _find_kind(published, summed, error) if cause == "flare" else cause
    flux = (survey.flux[rows] - level[rows]) * survey.scale
    # In the sum over wavelength of spectra a drift of the dark current may exceed a flare, but not near its peak.
    near = np.abs(middle[rows] - detected.peak_s) <= detected.half_width_s + frame_s
    brightness = np.where(near, flux, -np.inf) if survey.weighted and near.any() else flux
    brightest = first + int(np.argmax(brightness))
    missing_s = (int(np.diff(numbers[max(brightest - 1, 0) : brightest + 2]).max()) - 1) * frame_s
    at_end = first == 0 or last == survey.stare.n_frames - 1
    cut = at_end or bool((np.diff(numbers[[first - 1, first, last, last + 1]])[::2] > GAP_FRAMES).any())
    # Fits of scipy leave circular references to arrays of some 20 MB, which are few objects and would be kept long.
    gc.collect(1)
    return ObservedEvent(
        value=detected.value, first=first, last=last, brightest=brightest, half_width_s=detected.half_width_s,
        amplitude=float(flux.max()) / survey.level / of_star,
        missing=int(numbers[last] - numbers[first] + 1 - flux.size), cut=cut, kind=kind,
        gap_at_peak=missing_s >= min(detected.half_width_s, flares[0].half_width_s),
        summed_s=summed / of_star, summed_error_s=error / of_star,
        fitted_s=fitted_s, low_s=(low[0], low[1]), high_s=(high[0], high[1]),
        flares=tuple(flares), shape=best.shape.name, chi2=chi2, dof=dof,
        peak_observed=bool((np.abs(middle[rows] - flares[0].peak_s) <= 1.5 * frame_s).any()), level=of_star,
    )  # fmt: skip


def _posterior(in_events: Bool, fits: Sequence[Fit], poor: bool) -> NormalMixture:
    """Return the posterior of an event's equivalent duration."""
    window, mixtures = fits[0].window, [fit.mixture for fit in fits]
    totals = np.array([mixture.log_total for mixture in mixtures])
    if poor:
        # What a wrong shape leaves varies slowly: bins count as many times as there are independent departures in the
        # event (a power likelihood as of Miller & Dunson 2019, doi 10.1080/01621459.2018.1469995).
        place = log_time(window.middle[window.inside], fits[int(np.argmax(totals))].flares[0])
        power = min(1.0, (1.0 + float(np.ptp(place)) / LOG_TIME) / place.size)
        mixtures = [replace(m, log_weight=m.log_weight + (power - 1) * (m.log_total - totals.max())) for m in mixtures]
    mixture, survey, event = join(mixtures), window.survey, window.event
    if len(survey.bank.directions) == 1:
        return mixture
    # Flares of other temperatures have another light for the same sum: the S/N of each, and its amplitude.
    scores = []
    for direction in range(len(survey.bank.directions)):
        other = Window.of(survey, in_events, replace(event, direction=direction))
        noise = np.diag(other.level_covariance) + other.noise
        model = other.model(survey.bank.shape, event.peak_s, event.half_width_s)[0]
        weight, outside = model / noise, ~other.inside
        level = float(np.average(other.values[outside], weights=1 / noise[outside])) if outside.any() else 0.0
        slope, information = float(weight @ (other.values - level)), float(weight @ model)
        scores.append((slope / np.sqrt(information), slope / information))
    snr, amplitude = scores[event.direction]
    scaled = []
    for value, other_amplitude in scores:
        if value > 0:
            factor, log_weight = other_amplitude / amplitude, 0.5 * (value**2 - snr**2)
            scaled.append(NormalMixture(mixture.log_weight + log_weight, factor * mixture.mean, factor * mixture.sd))
    return join(scaled)
