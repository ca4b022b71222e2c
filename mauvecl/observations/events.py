"""Events in an observed light curve: their extent, their resemblance to other changes, and their measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.alarms import Alarm, alarms
from mauvecl.lightcurve.search.bank import TAIL
from mauvecl.lightcurve.search.search import LargestValue
from mauvecl.observations.search import SeriesSurvey

Float = NDArray[np.float64]
Kind = Literal["flare", "step", "throughput", "dark current", "sky", "cosmic ray"]

#: Number of consecutive frames below one standard deviation that end an event.
END_FRAMES = 3
#: Flux of a template, in standard deviations of a frame, to which its tail belongs to the event.
FAINT = 0.2
#: Largest number of events, after which the light curve is declared too variable for a search.
MAX_EVENTS = 500
#: Smallest number of frames for a baseline.
MIN_BASELINE = 10
#: Smallest number of means of frames in a half-width to which flares are fitted: standard errors rise by less than 5 %.
FITTED_BINS = 10
#: Fall of chi-squared by which a step must fit better than a flare.
STEP_GAIN = 9.0


@dataclass(frozen=True, eq=False)
class ObservedEvent:
    """A detected event; frames are counted among the searched ones."""

    value: float  # largest statistic of the search: the S/N of the best template
    # first, last: first and last frame of the event, inclusive.
    first: int
    last: int
    brightest: int  # frame of the largest flux
    half_width_s: float  # half-width of the best template
    amplitude: float  # largest flux above the level, relative to the level
    # equivalent_duration_s, equivalent_duration_error_s: Sum of the flux above the level over the frames of the event,
    # relative to the level, and its standard error. Missing frames inside the event are interpolated.
    equivalent_duration_s: float
    equivalent_duration_error_s: float
    missing: int  # number of frames missing inside the event
    cut: bool  # true if the event reaches the first or last frame of the light curve or of the part before a longer gap
    # A flare, or what resembles one: a step of the level or, in spectra, a change of the throughput, the dark current
    # or the sky, or a cosmic ray.
    kind: Kind
    components: list[Alarm]  # flares fitted to the event together, the largest first; empty if the event is no flare


@dataclass(frozen=True)
class Detection:
    """Event above the threshold of the search, before it is measured.

    Attributes
    ----------
    value, half_width_s, peak_s, direction : float, float, float, int
        Statistic, half-width, time of the peak in the stare, and row of the bank's directions, of the best template.
    first, last : int
        First and last frame of the event.
    """

    value: float
    half_width_s: float
    peak_s: float
    direction: int
    first: int
    last: int


def detect_events(survey: SeriesSurvey, threshold: float) -> tuple[list[Detection], NDArray[np.bool_]]:
    """Detect all events above a threshold, in order of time, and return the frames that belong to them.

    The search is repeated without the frames of detected events until there are no more, so that the residuals of a
    bright flare of unusual shape are not mistaken for other flares.
    """
    taken = np.zeros(survey.stare.n_frames, np.bool_)
    found: list[Detection] = []
    while len(found) < MAX_EVENTS:
        new = _search_once(survey, taken, threshold)
        if new is None:
            break
        best, peak = new
        first, last = _extent(survey, taken, peak, best)
        value, half_width, peak_s = (float(each[0]) for each in (best.maximum, best.half_width_s, best.peak_s))
        found.append(Detection(value, half_width, peak_s, int(best.temperature[0]), first, last))
        taken[first : last + 1] = True
    return sorted(found, key=lambda one: one.first), taken


def _search_once(survey: SeriesSurvey, taken: NDArray[np.bool_], threshold: float) -> tuple[LargestValue, int] | None:
    """Return the best template among frames that are left, and its brightest frame; None below the threshold."""
    left = np.flatnonzero(~taken)
    if left.size < 3:
        return None
    part = survey.frames(~taken)
    best = part.search.largest(part.net(part.sums)[None])
    if float(best.maximum[0]) < threshold:
        return None
    near = np.flatnonzero(np.abs(part.stare.middle_s - best.peak_s[0]) <= best.half_width_s[0] + part.stare.frame_s)
    if not near.size:
        near = np.array([int(np.argmin(np.abs(part.stare.middle_s - best.peak_s[0])))])
    return best, int(left[near[np.argmax(part.along(int(best.temperature[0]))[near])]])


def _extent(survey: SeriesSurvey, taken: NDArray[np.bool_], peak: int, best: LargestValue) -> tuple[int, int]:
    """Return the first and last frame of an event.

    It includes half of a half-width of the best template before the brightest frame, and after it at least a whole one
    and the tail of the template above `FAINT` standard deviations. It ends where the flux stays within the noise for
    several frames, at a gap, or at another event.
    """
    half_width, amplitude = float(best.half_width_s[0]), float(best.amplitude[0])
    sigma = survey.along(int(best.temperature[0])) / np.sqrt(survey.variance)
    numbers = survey.stare.numbers
    frames = half_width / survey.stare.frame_s
    tau = np.linspace(0.0, TAIL, 400)
    bright = tau[amplitude * survey.bank.shape.at(tau) > FAINT * np.sqrt(survey.variance[peak])]
    tail = max(1.0, float(bright[-1]) if bright.size else 0.0)

    def end(step: int) -> int:
        least = frames * tail if step > 0 else frames / 2
        last, quiet, at = peak, 0, peak + step
        while 0 <= at < sigma.size and not taken[at]:
            inside = abs(int(numbers[at]) - int(numbers[peak])) <= least
            if abs(int(numbers[at]) - int(numbers[at - step])) > END_FRAMES or (quiet >= END_FRAMES and not inside):
                break
            if inside:
                last = at
            quiet = quiet + 1 if sigma[at] < 1.0 else 0
            if not quiet:
                last = at
            at += step
        return last

    return end(-1), end(1)


def measure_events(
    survey: SeriesSurvey,
    taken: NDArray[np.bool_],
    threshold: float,
    found: list[Detection],
    causes: Sequence[Kind] | None = None,
) -> list[ObservedEvent]:
    """Measure detected events in order of time; `taken` are their frames, and `causes` follow from their spectra.

    The level follows a step with a delay, so that weaker events next to a step belong to it.
    """
    known: Sequence[Kind] = causes or ["flare"] * len(found)
    events = [measure_event(survey, taken, threshold, *one) for one in zip(found, known, strict=True)]
    for k, event in enumerate(events):
        ends = (event.first - 1, event.last + 1)
        sides = [each for each in events[max(0, k - 1) : k + 2] if each.last == ends[0] or each.first == ends[1]]
        if event.kind == "flare" and any(each.kind == "step" and each.value > event.value for each in sides):
            events[k] = replace(event, kind="step", components=[])
    return events


def measure_event(
    survey: SeriesSurvey, taken: NDArray[np.bool_], threshold: float, found: Detection, cause: Kind = "flare"
) -> ObservedEvent:
    """Measure a detected event; `taken` are the frames of all events, and `cause` follows from its spectrum."""
    value, half_width, first, last = found.value, found.half_width_s, found.first, found.last
    rows = slice(first, last + 1)
    baseline, baseline_variance = _baseline(survey, taken, first, last, half_width)
    flux, numbers = (survey.flux[rows] - baseline) * survey.scale, survey.stare.numbers[rows]
    every = np.arange(numbers[0], numbers[-1] + 1)
    missing = every.size - numbers.size
    cadence = survey.stare.frame_s
    total = float(np.interp(every, numbers, flux).sum()) * cadence / survey.level
    variance = survey.flux_variance[rows] * survey.scale**2 + survey.photon * np.maximum(flux, 0.0)
    # The baseline of all frames is wrong by the same amount.
    variance_of_sum = variance.sum() * every.size / numbers.size + baseline_variance * (survey.scale * every.size) ** 2
    error = float(np.sqrt(variance_of_sum)) * cadence / survey.level
    brightest = first + int(np.argmax(flux))
    ends = (first == 0, last == survey.stare.n_frames - 1)
    gaps = np.diff(survey.stare.numbers) > END_FRAMES
    cut = any(ends) or bool(first > 0 and gaps[first - 1]) or bool(last < survey.stare.n_frames - 1 and gaps[last])
    others = taken.copy()
    others[rows] = False
    lead, tail = survey.bank.window(half_width)
    number = survey.stare.numbers
    part = survey.frames(~others & (number >= number[first] - lead) & (number <= number[last] + tail))
    peak = int(np.searchsorted(part.stare.numbers, survey.stare.numbers[brightest]))
    kind = _kind(part, peak, half_width, found.direction) if cause == "flare" else cause
    components = _components(part, max(threshold, value / 4), half_width) if kind == "flare" else []
    middle = survey.stare.middle_s[[first, last]]
    inside = [
        c
        for c in components
        if c.measured and middle[0] - half_width <= c.recovered.peak_s[0] <= middle[1] + half_width
    ]
    return ObservedEvent(
        value, first, last, brightest, half_width, float(flux.max()) / survey.level, total, error, missing, cut, kind,
        inside,
    )  # fmt: skip


def _components(survey: SeriesSurvey, threshold: float, half_width: float) -> list[Alarm]:
    """Fit flares to an event, in means of frames if its flare is long."""
    binned = survey.binned(max(1, int(half_width / FITTED_BINS / survey.stare.frame_s)))
    return alarms(binned, binned.templates, binned.sums, threshold, profiled=("equivalent_duration_s",))


def _baseline(
    survey: SeriesSurvey, taken: NDArray[np.bool_], first: int, last: int, half_width: float
) -> tuple[Float, float]:
    """Return the baseline of the flux under an event, shape (n_frame,), and the variance of its mean.

    A straight line through the frames of the event's window that belong to no event, or a constant if they are on one
    side only: a line is not extrapolated.
    """
    lead, tail = survey.bank.window(half_width)
    numbers = survey.stare.numbers
    near = ~taken & (numbers >= numbers[first] - lead) & (numbers <= numbers[last] + tail)
    inside = survey.stare.middle_s[first : last + 1]
    time, y, weight = survey.stare.middle_s[near], survey.flux[near], 1.0 / survey.flux_variance[near]
    if time.size < MIN_BASELINE:
        return np.zeros(inside.size), float(np.mean(survey.flux_variance))
    middle = inside.mean()
    degree = 1 if min((time < inside[0]).sum(), (time > inside[-1]).sum()) >= MIN_BASELINE / 2 else 0
    design = np.vander((time - middle) / half_width, degree + 1)
    inverse = np.linalg.inv((design.T * weight) @ design)
    line = inverse @ ((design.T * weight) @ y)
    return np.vander((inside - middle) / half_width, degree + 1) @ line, float(inverse[-1, -1])


def _kind(survey: SeriesSurvey, peak: int, half_width: float, direction: int) -> Kind:
    """Return whether an event is more like a flare or like a step of the level.

    Both are fitted with a straight line to the window of the event: the flare with the time and half-width of any
    template of the bank, the step at any frame.
    """
    lead, tail = survey.bank.window(half_width)
    number = survey.stare.numbers
    window = (number >= number[peak] - lead) & (number <= number[peak] + tail)
    y = survey.along(direction)[window]
    time = survey.stare.middle_s[window]
    # The photon noise of a flare that rises the sum along the direction by as much.
    templates, along = survey.templates, survey.bank.directions[direction]
    row = templates.chosen[direction]
    rise = float(along @ templates.noise[row] @ along) / float(along @ templates.directions[row])
    flare = np.maximum(y, 0.0) * rise
    weight = 1.0 / np.sqrt(survey.variance[window] + flare)
    line = np.column_stack([np.ones_like(time), (time - time.mean()) / max(float(np.ptp(time)), 1.0)])

    def chi2(shape: Float) -> float:
        design = np.column_stack([line, shape]) * weight[:, None]
        left = y * weight - design @ np.linalg.lstsq(design, y * weight, rcond=None)[0]
        return float(left @ left)

    edges = np.column_stack([time, time]) + np.array([-0.5, 0.5]) * survey.stare.frame_s
    peaks = survey.stare.middle_s[peak] + np.linspace(-1.0, 1.0, 9) * half_width
    flares = min(
        chi2(survey.bank.shape.mean_over(edges, p, w)) for p in peaks for w in half_width * np.geomspace(0.4, 2.5, 7)
    )
    steps = min((chi2((time >= at).astype(np.float64)) for at in time[2:-2]), default=np.inf)
    return "step" if steps < flares - STEP_GAIN else "flare"
