"""Analysis of observed frames: events, false alarms, and completeness by injections into these very frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mauvecl.fits.spectrum import Measurement
from mauvecl.flares import RANK
from mauvecl.flares.shapes import shape_of
from mauvecl.host.arrays import Float
from mauvecl.observations import spectra as spectral
from mauvecl.observations.events import LONG_S, Kind, ObservedEvent, detect_events, measure_events, most_events
from mauvecl.observations.frame_model import FrameModel
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.level import NoiseComparison, QuiescentLevel, Scatter, binned_scatter, likeness
from mauvecl.observations.light_curve import survey_light_curve
from mauvecl.observations.process import Steps
from mauvecl.observations.search import NO_COLOUR_K, SeriesSurvey, SimulatedRate, innovations, simulated_rates
from mauvecl.schema.fields import DAY_S
from mauvecl.search.completeness import size_at

#: Numbers of half-widths, sizes and peak times of injected flares.
WIDTHS, SIZES, TIMES = 4, 12, 40
#: Injections that are searched together, a divisor of `TIMES`, and the largest number of frames of an injection.
BATCH, MAX_FRAMES = 10, 2**15
#: Range of sizes, in equivalent durations whose S/N without a baseline equals these multiples of the threshold.
RANGE = (0.5, 4.0)
#: Probability of detection that limits refer to.
POWER = 0.9
#: Second half of the generator's key, which makes the draws independent of others.
INJECTION_KEY = 0x696E6A65


@dataclass(frozen=True, eq=False)
class InjectionCompleteness:
    """Share of injected flares that the search detects."""

    half_widths_s: Float  # shape (n_width,)
    equivalent_durations_s: Float  # shape (n_width, n_size)
    detected: NDArray[np.int64]  # shape (n_width, n_size)
    injected: int  # number of injections per cell

    def limit(self, width: int, power: float = POWER) -> float:
        """Return the equivalent duration of flares that are detected with a probability; NaN if none is."""
        shares = np.maximum.accumulate(self.detected[width]) / self.injected
        size = size_at(self.equivalent_durations_s[width], shares, power)
        return size if np.isfinite(size) else float("nan")


def inject(
    quiet: SeriesSurvey, threshold: float, seed: int, temperature_k: float, steps: Steps
) -> InjectionCompleteness:
    """Inject flares of several half-widths and sizes at random times, and count those that the search detects.

    They are injected into `quiet` frames, which belong to no event. `steps` reports each half-width.
    """
    n_frames, frame_s, bank = quiet.stare.n_frames, quiet.stare.frame_s, quiet.bank
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, INJECTION_KEY]))
    widths = np.geomspace(bank.half_widths_s[0], bank.half_widths_s[-1], WIDTHS)
    kelvin = quiet.templates.nearest(temperature_k)
    direction = quiet.templates.directions[kelvin]
    photon_noise = np.linalg.cholesky(quiet.templates.noise[kelvin] + 1e-300 * np.eye(direction.size))
    unit_snr = float(np.linalg.norm(direction))
    durations, detected = np.zeros((WIDTHS, SIZES)), np.zeros((WIDTHS, SIZES), np.int64)
    for w, width in steps.track(enumerate(widths.tolist()), WIDTHS):
        if w == 0 or n_frames > MAX_FRAMES:
            # Part of a long light curve, another one for each half-width.
            start = int(rng.integers(max(n_frames - MAX_FRAMES, 0) + 1))
            segment = quiet.frames(slice(start, start + MAX_FRAMES))
        starts = segment.stare.start_s
        edges = np.column_stack([starts, starts + frame_s])
        amplitudes = threshold / (unit_snr * _typical_snr(segment, width)) * np.geomspace(*RANGE, SIZES)
        durations[w] = amplitudes * width * bank.shape.equivalent_duration
        for _ in range(0, TIMES, BATCH):
            peaks = starts[rng.integers(starts.size, size=BATCH)] + frame_s * rng.random(BATCH)
            shapes = np.array([bank.shape.mean_over(edges, peak, width) for peak in peaks])
            # The photon noise of the flare itself, here for unit amplitude, is added to that of the frames.
            noise = rng.standard_normal((*shapes.shape, direction.size)) @ photon_noise.T
            noise *= np.sqrt(np.maximum(shapes, 0.0))[:, :, None]
            best = _largest_near(segment, peaks, width, amplitudes, shapes[:, :, None] * direction, noise)
            detected[w] += (best >= threshold).sum(axis=1)
    return InjectionCompleteness(widths, durations, detected, TIMES)


def _largest_near(
    survey: SeriesSurvey, peaks: Float, width: float, amplitudes: Float, flares: Float, noise: Float
) -> Float:
    """Return the largest statistic near each flare that is added with its noise, shape (n_amplitude, n_flare).

    Flares and their noise have the shape (n_flare, n_frame, n_sum), for unit amplitude. Statistics are linear in the
    sums, so that one search serves all amplitudes.
    """
    count, amplitude = peaks.size, amplitudes[:, None, None]
    best = np.full((amplitudes.size, count), -np.inf)
    for row, rho in survey.search.values(np.concatenate([survey.sums[None], flares, noise])):
        times = survey.search.peaks_s(row)
        searched = (row.per_amplitude > 0).any(axis=0)
        for k, peak in enumerate(peaks):
            reach = 2 * (width + survey.stare.frame_s) + row.template.half_width_s
            near = searched & (np.abs(times - peak) <= reach)
            if near.any():
                quiet, flare, flare_noise = (rho[n][:, near] for n in (0, 1 + k, 1 + count + k))
                values = quiet + amplitude * flare + np.sqrt(amplitude) * flare_noise
                best[:, k] = np.maximum(best[:, k], values.max(axis=(1, 2)))
    return best


def _typical_snr(survey: SeriesSurvey, width: float) -> float:
    """Return the typical S/N of a flare of a half-width whose peak is one standard deviation of a frame."""
    row = min(survey.search.rows, key=lambda row: abs(np.log(row.template.half_width_s / width)))
    searched = row.per_amplitude[row.per_amplitude > 0]
    typical = float(np.median(searched)) if searched.size else 1.0
    return typical * float(np.sqrt(width / row.template.half_width_s))


#: Shares of the work at which its stages begin and end: level, false alarms, search, events and injections (measured
#: with a light curve of 10^5 frames).
STAGES = (0.0, 0.45, 0.55, 0.65, 0.95, 1.0)
#: False alarms per star-day above which events are candidates.
CANDIDATES = 1.0
#: Probability of a dip as large as the largest from noise below which the noise of the light is not symmetric.
CHANCE_DIP = 1e-3
#: Share of the searched frames in events, their number, and length of the light curve in half-widths of the longest
#: event, above which the events are no exception from the light of the star (assumed).
MOST_IN_EVENTS, MOST_EVENTS, LONG = 0.5, 2, 100.0
#: Range of the dark current in the sum over wavelength, over the level, from which this is not the star's (assumed).
DARK_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Analysis:
    """Analysis of the frames of one star."""

    frames: Frames
    flux: Float  # shape (n_frame,); the light curve that was searched; for spectra, the sum over wavelength
    level: QuiescentLevel
    survey: SeriesSurvey
    rate: float  # largest rate of false alarms per star-day at which an event is detected
    modelled: SimulatedRate  # false-alarm rate in light curves of the fitted process
    measured: SimulatedRate  # the same with residuals resampled from quiescent frames
    threshold: float  # threshold for this rate: the higher of the thresholds of both
    candidates: float  # threshold for candidates
    dip: float  # statistic of the largest dip, which is the threshold if it is too large for the noise
    events: list[ObservedEvent]  # events above the threshold of candidates, in order of time
    completeness: InjectionCompleteness  # share of flares that the search detects in these frames
    scatter: list[Scatter]
    residual: Float  # shape (n_quiet, n_sum); of quiescent frames given those before them, in standard deviations
    quiet: NDArray[np.bool_]  # shape (n_searched,); frames of the residuals
    likeness: NoiseComparison  # of the residuals and independent noise
    spectra: spectral.SpectralSeries | None  # if they are searched with weights for flares
    event_spectra: list[spectral.EventSpectrum | None]  # of these, those of the events, in their order
    measurements: list[Measurement | str]  # flares fitted to these, or the reasons why none are

    @property
    def days(self) -> float:
        """Star-days of the searched frames."""
        return self.survey.stare.observed_s / DAY_S

    @cached_property
    def light_misleads(self) -> bool:
        """True if the light that all pixels share changes suddenly and the search does not leave it out."""
        series = self.spectra
        return series is not None and bool(series.changes) and bool(np.isfinite(series.jitters["light"]))

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Searched frames in events."""
        inside = np.zeros(self.survey.stare.n_frames, np.bool_)
        for event in self.events:
            inside[event.first : event.last + 1] = True
        return inside

    @property
    def crowded(self) -> bool:
        """True if most frames of a long light curve are in events, so that too few show the star without them."""
        longest = max((event.half_width_s for event in self.events), default=0.0)
        many = len(self.events) > MOST_EVENTS and self.inside.mean() > MOST_IN_EVENTS
        return many and self.survey.stare.duration_s > min(LONG * longest, LONG_S)

    def false_alarms(self, event: ObservedEvent) -> tuple[float, float]:
        """Return the false alarms per star-day at an event's statistic: by the process, and with measured residuals."""
        return self.modelled.rate(event.value), self.measured.rate(event.value)

    @property
    def dark_misleads(self) -> bool:
        """True if the sum over wavelength changes with the dark current, so that its level is not the star's."""
        return self.spectra is not None and self.spectra.dark_drift > DARK_SHARE

    @property
    def level_ratio(self) -> float:
        """Level over the light of the star: 1, unless the dark current changes it; NaN if the star is not known."""
        return 1.0 / self.spectra.star_level if self.spectra is not None and self.dark_misleads else 1.0

    @property
    def messages(self) -> list[str]:
        """Statements about the data that a reader must know, the most important first."""
        of_pixels = () if self.spectra is None else _spectral_messages(self.spectra)
        before = (*self.frames.remarks, *self._frame_messages(), *of_pixels)
        return [*before, *self._level_messages(), *self._verdict_messages()]

    def _frame_messages(self) -> Iterator[str]:
        """Yield messages on what is searched and on the noise of frames."""
        if self.crowded:
            yield (
                f"Events take {100 * self.inside.mean():.2g} % of the searched frames, so that what the star does "
                "without them is not known, and there are no verdicts: the light probably has eclipses, transits or "
                "pulsation, or is another column than the flux; mark the frames to leave out in a column of quality, "
                "or name the columns in a mapping."
            )
        if len(self.events) >= most_events(self.survey.stare.n_frames):
            yield (
                f"The search ended at {len(self.events)} events: there may be smaller ones, which are taken for "
                "quiescent light; a light curve of fewer frames may show them."
            )
        reasons = self.level.reasons
        if lost := np.count_nonzero(reasons):
            are = "is" if lost == 1 else "are"
            yield f"{lost} of {reasons.size} frames {are} not searched; the table of frames states the reason of each."
        if lost := np.count_nonzero(reasons & Reason.LOSS):
            yield (
                f"In {lost} of these frames light is suddenly lost, as by pointing losses or eclipses; flares "
                "in them are not searched."
            )
        if (excess := self.level.excess) > 1.2:
            fault = f"The scatter of quiescent frames is {excess:.2f} times the stated errors"
            yield f"{fault}; the measured scatter is used."

    def _level_messages(self) -> Iterator[str]:
        """Yield messages on changes of the light that are not flares."""
        if self.light_misleads:
            yield (
                "The throughput changes, as by pointing losses; short changes may resemble flares: "
                'search.frame.light = "free", the default, searches without the light that all pixels share.'
            )
        if changes := self.level.changes:
            largest = max(changes, key=lambda change: abs(change[1]))[1]
            often = "once" if len(changes) == 1 else f"{len(changes)} times"
            yield (
                f"The level changes {often} suddenly for a day or more, by {100 * largest:+.2g} % at the "
                "most: light is relative to the level after each change, and the table of frames has that level."
            )
        if self.level.process.terms and not self.dark_misleads:
            # A light curve that shows few periods of a process has another standard deviation than the process.
            terms = self.level.process.describe(self.survey.level / self.survey.scale)
            yield (
                "The quiescent light is not constant: its fitted level has a standard deviation of "
                f"{100 * self.level.spread:.2g} %, by {terms}."
            )
        if (series := self.spectra) is not None and self.dark_misleads:
            if series.cleaned.model.star_is_known:
                reference = "relative to the light of the star by the shape of its spectrum"
            else:
                reference = (
                    "stated only if the star is named: its spectrum distinguishes its light from the dark current"
                )
            yield (
                f"The dark current changes the sum over wavelength by {series.dark_drift:.2g} times its level, as in a "
                f"detector whose temperature changes: peaks are not stated, and equivalent durations are {reference}."
            )

    def _verdict_messages(self) -> Iterator[str]:
        """Yield messages on why events have no verdict or another threshold than that of the rate of false alarms."""
        if not self.likeness.alike:
            clearest = int(np.argmax(self.likeness.excess))
            yield (
                f"Residuals of the quiescent light are correlated ({self.likeness.correlations[clearest]:.2f} at a lag "
                f"of {clearest + 1} frames), which the fitted process does not describe: there are no verdicts. "
                f"Sudden dips, which are no flares, have an S/N of up to {max(self.dip, self.candidates):.3g}: rises "
                "of that size are no evidence of flares."
            )
        elif self.dip == self.threshold:
            yield (
                f"The light falls suddenly, as by losses of light, with an S/N of {self.dip:.3g}: rises of that size "
                "may be returns from a loss, and only larger ones are called detected."
            )
        if self.rate < self.measured.smallest:
            yield (
                f"Simulated light curves show rates down to {self.measured.smallest:.2g} false alarms per star-day; "
                "the threshold for fewer is extrapolated with the tail of their noise."
            )


def analyse_frames(
    frames: Frames, *, rate: float = 1.0, shape: str = "davenport2014", seed: int = 1,
    model: FrameModel | None = None, rank: int = RANK, jitters: Mapping[str, float] | None = None,
    temperature_k: float = NO_COLOUR_K, report: Callable[[float], None] | None = None,
) -> Analysis:  # fmt: skip
    """Find the flares in observed frames.

    The `rate` is that of false alarms per star-day. The `model` is that of the pixels of spectra, which are
    searched as their sum over wavelength without it; `rank` is the largest number of weighted sums. `jitters`, standard
    deviations of light, dark current and sky from frame to frame, are infinite for those that the search leaves out; by
    default the light, and the dark current as measured. The temperature is that of injected flares in spectra. `report`
    is called with the share of the work that is done, and may raise to stop the work.
    """
    stages = (Steps(report).part(first, last) for first, last in pairwise(STAGES))
    level_steps, rate_steps, search_steps, event_steps, injection_steps = stages
    series: spectral.SpectralSeries | None = None
    if model is None:
        survey, level, frames = survey_light_curve(frames, shape_of(shape), seed, level_steps)
    else:
        survey, series, level = spectral.survey_spectra(
            frames, model, shape_of(shape), rank, seed, jitters, level_steps
        )
        frames = series.cleaned.frames
    rates, threshold, candidates, dip = _thresholds(survey, level.quiet[level.used], rate, seed, rate_steps)
    detected, in_events = detect_events(survey, candidates, search_steps)
    spectra = [
        None if series is None else spectral.event_spectrum(survey, series, in_events, event) for event in detected
    ]
    causes: list[Kind] = ["flare" if spectrum is None else spectrum.cause for spectrum in spectra]
    events = measure_events(survey, in_events, detected, causes, event_steps)
    measurements = list[Measurement | str]()
    for measured, event in zip(events, detected, strict=True):
        if series is None:
            measurements.append("no spectra of the instrument are given")
        elif measured.kind != "flare":
            measurements.append(f"its kind is {measured.kind}")
        else:
            measurements.append(spectral.measure_flare(survey, series, in_events, event))
    quiet = ~in_events
    residual, numbers = innovations(survey, quiet), survey.stare.numbers[quiet]
    return Analysis(
        frames, frames.white_light[0], level, survey, rate, *rates,
        threshold=threshold, candidates=candidates, dip=dip, events=events, measurements=measurements,
        completeness=inject(survey.frames(quiet), threshold, seed, temperature_k, injection_steps),
        scatter=binned_scatter(numbers, residual @ survey.bank.directions[len(survey.bank.directions) // 2]),
        residual=residual, quiet=quiet, likeness=likeness(numbers, residual), spectra=series, event_spectra=spectra,
    )  # fmt: skip


def _thresholds(
    survey: SeriesSurvey, quiet: NDArray[np.bool_], rate: float, seed: int, steps: Steps
) -> tuple[tuple[SimulatedRate, SimulatedRate], float, float, float]:
    """Return simulated rates of false alarms, the thresholds of events and of candidates, and the largest dip.

    Quiescent frames are searched upside down, in both directions of time, for dips that begin or end suddenly. Losses
    of light have larger dips than noise; those below `candidates` may be missed.
    """
    simulated = simulated_rates(survey, quiet, rate, seed, steps)
    allowed = (rate, max(rate, CANDIDATES))
    threshold, candidates = (max(alarms.threshold(most) for alarms in simulated) for most in allowed)
    down = survey.frames(quiet).inverted()
    start = down.stare.start_s
    stare = replace(down.stare, start_s=start[-1] + start[0] - start[::-1])
    back = replace(down, stare=stare, sums=down.sums[::-1], variance=down.variance[::-1])
    values = (inverted.search.values(inverted.sums[None], candidates) for inverted in (down, back))
    dip = max(float(rho.max(initial=-np.inf)) for rows in values for _, rho in rows)
    chance = -np.expm1(-max(alarms.rate(dip) for alarms in simulated) * survey.stare.observed_s / DAY_S)
    return simulated, max(threshold, dip) if chance < CHANCE_DIP else threshold, candidates, dip


def _spectral_messages(spectra: spectral.SpectralSeries) -> Iterator[str]:
    """Yield statements about the pixels of spectra that a reader must know."""
    cleaned, noise = spectra.cleaned, spectra.noise
    if count := int(cleaned.rays.sum()):
        yield (
            f"{count} single values in {np.count_nonzero(cleaned.rays)} frames stand out from their spectrum, as "
            "cosmic rays do; a fit to the other pixels replaces them, and the table of frames counts them."
        )
    if not cleaned.has_errors:
        yield "The frames state no errors: the noise of each pixel is that of the instrument's model."
    if many := int(noise.departs.sum()):
        ratio = noise.measured / noise.stated
        yield (
            f"The noise of {many} of {ratio.size} pixels departs from what is stated: their measured noise is used, "
            f"{ratio.min():.2f} to {ratio.max():.2f} times it."
        )
    if changes := spectra.changes:
        largest = max(changes, key=lambda change: abs(change.change))
        often = "once" if len(changes) == 1 else f"{len(changes)} times"
        yield (
            f"The light that all pixels share changes suddenly {often}, by up to {100 * abs(largest.change):.2g} %, as "
            "by pointing losses and re-acquisitions; the table of throughput states when."
        )
    for name, sd in spectra.jitters.items():
        if np.isfinite(sd):
            size = f"{sd:.2g} deg C" if name == "dark" else f"{100 * sd:.2g} %"
            yield f"The {spectral.CAUSES[name]} of single frames changes: {size}, which the search marginalises over."
        elif name == "light":
            yield (
                "The level of each frame is free in the search, because pointing losses change it: flares keep "
                f"{100 * spectra.snr_kept:.2g} % of their S/N; "
                "search.frame.light states its standard deviation instead (1e-6: steady)."
            )
        else:
            yield f"The search leaves out all changes of the {spectral.CAUSES[name]} of single frames."
