"""Events of observed light curves: flares, or other changes, their detection and their times, causes and energies.

The largest statistics above a threshold become events; their frames are taken away, and the rest is searched again.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy

from mauvecl.flares.shapes import consecutive_integrals
from mauvecl.host.arrays import Bool, Float, map_in_threads
from mauvecl.observations.event_fits import Fit, NormalMixture, fit_event, joined, light_of
from mauvecl.observations.event_windows import GENERAL, LOG_TIME, FittedFlare, Likelihood, Window, log_time
from mauvecl.observations.process import UNREPORTED, Steps
from mauvecl.observations.search import MIN_BASELINE, DetectedEvent, ProcessSearch, SeriesSurvey
from mauvecl.schema.fields import DAY_S
from mauvecl.search.templates import REACH

#: Largest number of searches.
MAX_PASSES = 40
#: Number of events after which no further ones are searched, and the same for each frame of a long light curve.
MOST_EVENTS, MOST_PER_FRAME = 500, 1 / 500
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
            rows, flux = light_of_flare(survey, one.peak_s, one.half_width_s, one.amplitude)
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


def light_of_flare(survey: SeriesSurvey, peak_s: float, half_width_s: float, amplitude: float) -> tuple[slice, Float]:
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
#: Errors of the sum of an event's frames by which they are fainter than the level, from which they show no flare.
FAINTER_ERRORS = 2.0


Kind = Literal["flare", "step", "dip", "throughput", "dark current", "sky", "cosmic ray"]

#: Number of missing frames next to an event from which it may have begun before or gone on after them.
GAP_FRAMES = 3
#: Share of a flare's light outside the frames of its event from which their sum is a lower limit.
UNSEEN = 0.05


def _without_departures(window: Window, fit: Fit) -> tuple[Likelihood, Float]:
    """Return the likelihood of flares without departures from their shape, and their light in the bins, shape (n,)."""
    return Likelihood.of(window, fit.flares, fit.shape, 0.0), light_of(window, fit.shape, fit.flares)


def _kind(window: Window, fits: Sequence[Fit], summed: float, error: float) -> Kind:
    """Return whether an event is a flare by its fits of published shapes, since the general family resembles all kinds.

    The frames of a dip, with the light `summed` above the level, lack that of the best fit, as by an eclipse. The sum
    over wavelength of spectra may fall during a flare, by a loss of light that their weights leave out.
    """
    best = max(fits, key=lambda fit: fit.mixture.log_total)
    plain, model = _without_departures(window, best)
    level = float(plain.level_without(model))
    survey, one = window.survey, window.one
    start = survey.stare.start_s[one.first : one.last + 1]
    edges, within = np.column_stack([start, start + survey.stare.frame_s]), 0.0
    for flare in best.flares:
        light = consecutive_integrals(best.shape, (edges - flare.peak_s) / flare.half_width_s)
        within += flare.amplitude * flare.half_width_s * float(light.sum())
    mixture = joined([fit.mixture for fit in fits])
    low, high = (mixture.quantile(0.5 + sign * LEVELS[0] / 2) for sign in (-1, 1))
    lacking, uncertain = (within - summed) / level, float(np.hypot(error / level, (high - low) / 2))
    if not survey.weighted and lacking > LACKING_ERRORS * uncertain and lacking > LACKING_SHARE * within / level:
        return "dip"
    return "step" if _is_step(window, fits) else "flare"


def _summed(survey: SeriesSurvey, taken: Bool, level: Float, one: DetectedEvent) -> tuple[float, float]:
    """Return the sum of the light above the level over the frames of an event, amplitude x s, and its error.

    Missing frames are interpolated. The error includes that of the level given the quiescent frames.
    """
    rows = slice(one.first, one.last + 1)
    flux, numbers = survey.flux[rows] - level[rows], survey.stare.numbers[rows]
    every = np.arange(numbers[0], numbers[-1] + 1)
    factor = survey.stare.frame_s * survey.scale / survey.level
    total = float(np.interp(every, numbers, flux).sum()) * factor
    # Each frame counts for itself and for the missing frames next to it.
    counts = np.bincount(np.rint(np.interp(every, numbers, np.arange(numbers.size))).astype(np.int64),
                         minlength=numbers.size)  # fmt: skip
    process = survey.flux_process
    begin = max(0, one.first - NEARBY)
    part = slice(begin, one.last + 1 + NEARBY)
    time, noise = survey.stare.start_s[part], survey.variance[part] * process.excess**2
    event = slice(one.first - begin, one.last + 1 - begin)
    photon = survey.photon / survey.scale * np.maximum(flux, 0.0)
    variance = float(counts**2 @ (noise[event] + photon))
    quiet = ~taken[part]
    if quiet.sum() >= MIN_BASELINE:
        # Variance of the sum of the level given quiescent frames: w^T K w less what they say of it.
        near = np.zeros(quiet.size)
        near[event] = counts
        # Durations are relative to the level at the peak.
        middle = time[event] + survey.stare.frame_s / 2
        peak = event.start + min(int(np.searchsorted(middle, one.peak_s)), numbers.size - 1)
        near[peak] += total / factor / max(float(level[begin + peak]), 1e-12)
        given = process.covariance(time[quiet], noise[quiet])
        weights = given.solve(np.ones(int(quiet.sum())))
        shared = process.times(time, near)
        # The constant level is known to 1 / (1^T C^-1 1).
        rest = float(near.sum() - weights @ shared[quiet])
        of_level = float(near @ shared - shared[quiet] @ given.solve(shared[quiet])) + rest**2 / float(weights.sum())
        variance += of_level
    return total, float(np.sqrt(max(variance, 0.0))) * factor


def _is_step(window: Window, fits: Sequence[Fit]) -> bool:
    """Return whether a step of the level fits an event better than the flares of every fit do."""
    inside = window.middle[window.inside]
    if inside.size < 3:
        return False
    starts = window.edges[(window.middle > inside[0] - np.ptp(inside)) & (window.middle < inside[-1]), 0]
    if not starts.size:
        return False
    scored = []
    for fit in fits:
        one, model = _without_departures(window, fit)
        # Each further flare has three parameters more (Schwarz 1978).
        scored.append((float(one.chi2(model)) + 3 * (len(fit.flares) - 1) * float(np.log(window.values.size)), one))
    least, plain = min(scored, key=lambda pair: pair[0])
    models = (window.middle >= starts[:, None]).astype(np.float64)
    slope = models @ (plain.inverse @ window.values)
    information = np.einsum("ki,ki->k", models @ plain.inverse, models)
    fine = information > 1e-12
    gain = np.where(fine & (slope > 0), slope**2 / np.where(fine, information, 1.0), 0.0)
    whole = float(plain.chi2(np.zeros(window.values.size)))
    return whole - float(gain.max()) < least - STEP_GAIN


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
    survey: SeriesSurvey, taken: Bool, found: Sequence[DetectedEvent], causes: Sequence[Kind], steps: Steps
) -> list[ObservedEvent]:
    """Measure detected events in order of time; `taken` are their frames, and `causes` follow from their spectra.

    Weaker events next to a step or a dip belong to it. `steps` reports each event.
    """
    level = survey.flux_level(~taken)
    pairs = list(zip(found, causes, strict=True))
    measured = map_in_threads(lambda pair: measure_event(survey, taken, level, *pair), pairs)
    events = list(steps.each(measured, len(found)))
    for k, event in enumerate(events):
        ends = (event.first - 1, event.last + 1)
        sides = [each for each in events[max(0, k - 1) : k + 2] if each.last == ends[0] or each.first == ends[1]]
        larger = [each for each in sides if each.kind in ("step", "dip") and each.value > event.value]
        if event.kind == "flare" and larger:
            events[k] = replace(event, kind=larger[0].kind)
    return events


def measure_event(
    survey: SeriesSurvey, taken: Bool, level: Float, found: DetectedEvent, cause: Kind = "flare"
) -> ObservedEvent:
    """Measure an event, given its cause, the frames of all events, `taken`, and the level in units of the scale."""
    first, last, frame_s = found.first, found.last, survey.stare.frame_s
    rows, numbers, middle = slice(first, last + 1), survey.stare.numbers, survey.stare.middle_s
    peak = int(np.clip(np.searchsorted(middle, found.peak_s), 0, survey.stare.n_frames - 1))
    at_peak = float(level[peak]) * survey.scale / survey.level
    window = replace(Window.of(survey, taken, found), quiet_level=at_peak if at_peak > 0 else 1.0)
    fits = fit_event(window, survey.bank.shape)
    best = max(fits, key=lambda fit: fit.mixture.log_total)
    plain, model = _without_departures(window, best)
    chi2, dof = float(plain.chi2(model)), window.values.size - 1 - 3 * len(best.flares)
    of_star = float(plain.level_without(model))
    mixture = _posterior(window, taken, fits, scipy.stats.chi2.sf(chi2, dof) < POOR)
    fitted_s = mixture.quantile(0.5)
    low, high = ([mixture.quantile(0.5 + sign * width / 2) for width in LEVELS] for sign in (-1, 1))
    flares = [replace(f, amplitude=f.amplitude / of_star, equivalent_duration_s=f.equivalent_duration_s / of_star)
              for f in best.flares]  # fmt: skip
    summed, error = _summed(survey, taken, level, found)
    published = [fit for fit in fits if fit.shape.name != GENERAL]
    kind = _kind(window, published, summed, error) if cause == "flare" else cause
    flux = (survey.flux[rows] - level[rows]) * survey.scale
    # In the sum over wavelength of spectra a drift of the dark current may exceed a flare, but not near its peak.
    near = np.abs(middle[rows] - found.peak_s) <= found.half_width_s + frame_s
    several = flux if not (survey.weighted and near.any()) else np.where(near, flux, -np.inf)
    brightest = first + int(np.argmax(several))
    around = numbers[max(brightest - 1, 0) : brightest + 2]
    missing_s = (int(np.diff(around).max()) - 1) * frame_s
    ends = (first == 0, last == survey.stare.n_frames - 1)
    cut = any(ends) or bool((np.diff(numbers[[first - 1, first, last, last + 1]])[::2] > GAP_FRAMES).any())
    # Fits of scipy leave circular references to arrays of some 20 MB, which are few objects and would be kept long.
    gc.collect(1)
    return ObservedEvent(
        value=found.value, first=first, last=last, brightest=brightest, half_width_s=found.half_width_s,
        amplitude=float(flux.max()) / survey.level / of_star,
        missing=int(numbers[last] - numbers[first] + 1 - flux.size), cut=cut, kind=kind,
        gap_at_peak=missing_s >= min(found.half_width_s, flares[0].half_width_s),
        summed_s=summed / of_star, summed_error_s=error / of_star,
        fitted_s=fitted_s, low_s=(low[0], low[1]), high_s=(high[0], high[1]),
        flares=tuple(flares), shape=best.shape.name, chi2=chi2, dof=dof,
        peak_observed=bool((np.abs(middle[rows] - flares[0].peak_s) <= 1.5 * frame_s).any()), level=of_star,
    )  # fmt: skip


def _posterior(window: Window, taken: Bool, fits: Sequence[Fit], poor: bool) -> NormalMixture:
    """Return the posterior of an event's equivalent duration."""
    mixtures = [fit.mixture for fit in fits]
    totals = np.array([each.log_total for each in mixtures])
    if poor:
        # What a wrong shape leaves varies slowly: bins count as many times as there are independent departures in the
        # event (a power likelihood as of Miller & Dunson 2019, doi 10.1080/01621459.2018.1469995).
        place = log_time(window.middle[window.inside], fits[int(np.argmax(totals))].flares[0])
        power = min(1.0, (1.0 + float(np.ptp(place)) / LOG_TIME) / place.size)
        mixtures = [replace(m, log_weight=m.log_weight + (power - 1) * (m.log_total - totals.max())) for m in mixtures]
    mixture, survey, one = joined(mixtures), window.survey, window.one
    if len(survey.bank.directions) == 1:
        return mixture
    # Flares of other temperatures have another light for the same sum: the S/N of each, and the value of its amplitude.
    scores = []
    for direction in range(len(survey.bank.directions)):
        other = Window.of(survey, taken, one, direction)
        noise = np.diag(other.process) + other.noise
        model = other.model(survey.bank.shape, np.array([one.peak_s]), np.array([one.half_width_s]))[0]
        weight, outside = model / noise, ~other.inside
        level = float(np.average(other.values[outside], weights=1 / noise[outside])) if outside.any() else 0.0
        scores.append((float(weight @ (other.values - level)) / np.sqrt(float(weight @ model)), other.scale))
    snr, scale = scores[one.direction]
    every = [(0.5 * np.sign(value) * value**2 - 0.5 * snr**2, scale / own * value / snr)
             for value, own in scores if value > 0]  # fmt: skip
    return joined([NormalMixture(mixture.log_weight + weight, factor * mixture.mean, factor * mixture.sd)
                   for weight, factor in every])  # fmt: skip
