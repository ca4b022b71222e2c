"""Analysis of observed frames: level, noise, false alarms, events, and what is excluded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.defaults import Per, per_day
from mauvecl.lightcurve.flares.shapes import shape_of
from mauvecl.lightcurve.search.importance_sampling import SampledRate
from mauvecl.observations.colour import Colour, event_colour
from mauvecl.observations.completeness import Completeness, inject
from mauvecl.observations.events import ObservedEvent, detect_events, measure_events
from mauvecl.observations.frames import Frames
from mauvecl.observations.level import QuiescentLevel, quiescent_level
from mauvecl.observations.noise import Scatter, binned_scatter
from mauvecl.observations.search import MeasuredRate, SeriesSurvey
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S

Float = NDArray[np.float64]

#: False alarms per star-day above which events are candidates.
CANDIDATES = 1.0


@dataclass(frozen=True, eq=False)
class Analysis:
    """Analysis of the frames of one star.

    Attributes
    ----------
    frames : Frames
    flux, error : ndarray, shape (n_frame,)
        The light curve that was searched; of spectra, the sum over wavelength.
    level : QuiescentLevel
    survey : SeriesSurvey
    wanted : float
        Wanted false alarms per star-day.
    normal : SampledRate
        False-alarm rate in normal noise of the measured variance.
    measured : MeasuredRate
        False-alarm rate in noise resampled from quiescent frames.
    threshold : float
        Threshold for the wanted rate: the higher of the thresholds of both.
    candidates : float
        Threshold for candidates.
    events : list of ObservedEvent
        Events above the threshold of candidates, in order of time.
    completeness : Completeness
        Share of flares that the search detects in these frames.
    scatter : list of Scatter
    """

    frames: Frames
    flux: Float
    error: Float | None
    level: QuiescentLevel
    survey: SeriesSurvey
    wanted: float
    normal: SampledRate
    measured: MeasuredRate
    threshold: float
    candidates: float
    events: list[ObservedEvent]
    completeness: Completeness
    scatter: list[Scatter]

    @cached_property
    def days(self) -> float:
        """Star-days of the searched frames."""
        return self.survey.stare.observed_s / DAY_S

    def false_alarms(self, event: ObservedEvent) -> tuple[float, float]:
        """Return the false alarms per star-day at an event's statistic: in normal noise, and in noise as measured."""
        try:
            normal = self.normal.rate(event.value).value
        except InputError:
            # Beyond the largest sampled threshold the rate is smaller than there.
            normal = self.normal.rate(float(self.normal.thresholds[-1])).value
        return normal, self.measured.rate(event.value)

    def colour(self, event: ObservedEvent) -> Colour | None:
        """Return the colour of an event in spectra with errors, against quiescent frames; None without these."""
        frames = self.frames
        if frames.flux.ndim == 1 or frames.error is None:
            return None
        used = np.flatnonzero(self.level.used)
        inside, quiet = np.zeros((2, frames.n_frames), np.bool_)
        inside[used[event.first : event.last + 1]] = True
        quiet[used] = self.level.quiet[used]
        for other in self.events:
            quiet[used[other.first : other.last + 1]] = False
        return event_colour(frames.flux, frames.error, inside, quiet)

    @property
    def messages(self) -> list[str]:
        """Statements about the data that a reader must know, the most important first."""
        lines = list(self.frames.remarks)
        reasons = self.level.reasons
        if (reasons != 0).any():
            lines.append(f"{np.count_nonzero(reasons)} of {reasons.size} frames are not searched; the table of frames "
                         "states the reason of each.")  # fmt: skip
        if self.level.excess > 1.2:
            lines.append(f"The scatter of quiescent frames is {self.level.excess:.2f} times the stated errors; the "
                         "measured scatter is used.")  # fmt: skip
        red = next((one for one in self.scatter if one.red), None)
        if red is not None:
            lines.append(
                f"Quiescent frames are correlated: means of {red.frames} frames scatter {red.measured / red.white:.2f} "
                "times as much as independent frames."
            )
        if self.wanted < self.measured.smallest:
            lines.append(
                f"The noise as measured shows rates down to {self.measured.smallest:.2g} false alarms per star-day; "
                "its threshold for fewer is extrapolated with the tail of normal noise."
            )
        return lines


def analyse_frames(
    frames: Frames, *, false_alarms: float = 1.0, per: Per = "day", shape: str = "davenport2014", seed: int = 1
) -> Analysis:
    """Find the flares in observed frames.

    Parameters
    ----------
    frames : Frames
    false_alarms : float
        Wanted false alarms in a star-time of frames.
    per : {"day", "month", "year"}
    shape : str
        Shape of the templates; see `SHAPES`.
    seed : int
        Seed of the resampled noise and of injections.
    """
    wanted = per_day(false_alarms, per)
    flux, error = frames.white_light
    level = quiescent_level(frames, flux, error)
    survey = SeriesSurvey.of(frames, flux, error, level, shape_of(shape))
    frequent = max(wanted, CANDIDATES)
    normal = survey.normal_rate(frequent, seed)
    first = _threshold(normal, frequent)
    # Real flares are no noise: what exceeds the threshold of normal noise is left out of the resampled light curves.
    _, taken = detect_events(survey, first)
    measured = survey.measured_rate(level.quiet[level.used] & ~taken, wanted, seed)
    threshold = max(_threshold(normal, wanted), measured.threshold(wanted))
    candidates = min(max(first, measured.threshold(frequent)), threshold)
    detected, taken = detect_events(survey, candidates)
    events = measure_events(survey, taken, candidates, detected)
    quiet = level.quiet[level.used] & ~taken
    residual = survey.sums[:, 0] / np.sqrt(survey.variance)
    return Analysis(
        frames, flux, error, level, survey, wanted, normal, measured, threshold, candidates, events,
        inject(survey, ~taken, threshold, seed),
        binned_scatter(survey.stare.numbers[quiet], residual[quiet]),
    )  # fmt: skip


def _threshold(normal: SampledRate, rate: float) -> float:
    """Return the threshold for a rate in normal noise, and the lowest that is sampled if the rate is reached there.

    Few frames a day give few false alarms at any sensible threshold.
    """
    lowest = float(normal.thresholds[0])
    return lowest if rate >= normal.rate(lowest).value else normal.threshold(rate).value
