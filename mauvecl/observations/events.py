"""Events: flares, or other changes, with their times, causes and energies."""

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
from mauvecl.observations.search import MIN_BASELINE, DetectedEvent, SeriesSurvey

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


def _directions(survey: SeriesSurvey, taken: Bool, one: DetectedEvent) -> list[tuple[float, float]]:
    """Return the log weight of each direction of the bank, and its light relative to that of the event's direction."""
    if len(survey.bank.directions) == 1:
        return [(0.0, 1.0)]
    scores = []
    for direction in range(len(survey.bank.directions)):
        window = Window.of(survey, taken, one, direction)
        noise = np.diag(window.process) + window.noise
        model = window.model(survey.bank.shape, np.array([one.peak_s]), np.array([one.half_width_s]))[0]
        weight = model / noise
        outside = ~window.inside
        level = float(np.average(window.values[outside], weights=1 / noise[outside])) if outside.any() else 0.0
        value = float(weight @ (window.values - level)) / np.sqrt(float(weight @ model))
        scores.append((value, window.scale))
    mine = scores[one.direction]
    return [(0.5 * np.sign(value) * value**2 - 0.5 * mine[0] ** 2, mine[1] / scale * value / mine[0])
            for value, scale in scores if value > 0]  # fmt: skip


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
    survey: SeriesSurvey, taken: Bool, found: list[DetectedEvent], causes: Sequence[Kind] | None = None,
    steps: Steps = UNREPORTED,
) -> list[ObservedEvent]:  # fmt: skip
    """Measure detected events in order of time; `taken` are their frames, and `causes` follow from their spectra.

    Weaker events next to a step or a dip belong to it. `steps` reports each event.
    """
    level = survey.flux_level(~taken)
    kinds: Sequence[Kind] = causes or ["flare"] * len(found)
    measured = map_in_threads(lambda k: measure_event(survey, taken, level, found[k], kinds[k]), range(len(found)))
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
    mixture = joined(mixtures)
    # Flares of other temperatures have another light for the same sum.
    return joined([NormalMixture(mixture.log_weight + weight, factor * mixture.mean, factor * mixture.sd)
                   for weight, factor in _directions(window.survey, taken, window.one)])  # fmt: skip
