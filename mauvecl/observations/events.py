"""Events in observed frames: what they are, and their measurements."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.energies import Energy, measure_energy
from mauvecl.observations.search import Detection, SeriesSurvey
from mauvecl.observations.steps import Steps

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Kind = Literal["flare", "step", "dip", "throughput", "dark current", "sky", "cosmic ray"]

#: Number of missing frames next to an event from which it may have begun before or gone on after them.
GAP_FRAMES = 3
#: Share of a flare's light outside the frames of its event from which their sum is a lower limit.
UNSEEN = 0.05


@dataclass(frozen=True, eq=False)
class ObservedEvent:
    """A measured event; frames are counted among the searched ones."""

    value: float  # largest statistic of the search: the S/N of the best template
    # first, last: first and last frame of the event, inclusive.
    first: int
    last: int
    brightest: int  # frame of the largest flux
    half_width_s: float  # half-width of the best template
    amplitude: float  # largest flux above the level, relative to the level
    missing: int  # number of frames missing inside the event
    cut: bool  # true if the event reaches the first or last frame of the light curve or of the part before a longer gap
    # A flare, or what resembles one: a step of the level, the edge of a dip or, in spectra, a change of the throughput,
    # the dark current or the sky, or a cosmic ray.
    kind: Kind
    energy: Energy

    @property
    def equivalent_duration_s(self) -> float:
        """Recommended equivalent duration."""
        return self.energy.fitted_s

    @property
    def is_limit(self) -> bool:
        """True if the sum of the light in the frames is a lower limit: a gap or an end cuts the flare."""
        return self.cut and self.energy.summed_s < (1 - UNSEEN) * self.energy.fitted_s


def measure_events(
    survey: SeriesSurvey, taken: Bool, found: list[Detection], causes: Sequence[Kind] | None = None,
    steps: Steps | None = None,
) -> list[ObservedEvent]:  # fmt: skip
    """Measure detected events in order of time; `taken` are their frames, and `causes` follow from their spectra.

    Weaker events next to a step or a dip belong to it. `steps` reports each event.
    """
    steps = steps or Steps()
    known: Sequence[Kind] = causes or ["flare"] * len(found)
    level = survey.flux_level(~taken)
    events = []
    for one in steps.each(zip(found, known, strict=True), len(found)):
        events.append(measure_event(survey, taken, level, *one))
        # Fits of scipy leave circular references to arrays of some 20 MB, which are few objects and would be kept long.
        gc.collect()
    for k, event in enumerate(events):
        ends = (event.first - 1, event.last + 1)
        sides = [each for each in events[max(0, k - 1) : k + 2] if each.last == ends[0] or each.first == ends[1]]
        larger = [each for each in sides if each.kind in ("step", "dip") and each.value > event.value]
        if event.kind == "flare" and larger:
            events[k] = replace(event, kind=larger[0].kind)
    return events


def measure_event(
    survey: SeriesSurvey, taken: Bool, level: Float, found: Detection, cause: Kind = "flare"
) -> ObservedEvent:
    """Measure a detected event.

    Parameters
    ----------
    taken : ndarray of bool, shape (n_frame,)
        Frames of all events.
    level : ndarray, shape (n_frame,)
        Quiescent level of the flux, in units of the survey's scale.
    found : Detection
    cause : str
        Follows from the spectrum of the event.
    """
    first, last = found.first, found.last
    rows = slice(first, last + 1)
    energy = measure_energy(survey, taken, level, found)
    flux, numbers = (survey.flux[rows] - level[rows]) * survey.scale, survey.stare.numbers
    ends = (first == 0, last == survey.stare.n_frames - 1)
    cut = any(ends) or bool((np.diff(numbers[[first - 1, first, last, last + 1]])[::2] > GAP_FRAMES).any())
    kind = cause
    if cause == "flare":
        # The sum over wavelength of spectra may fall during a flare, by a loss of light that their weights leave out.
        kind = "dip" if energy.dips and not survey.weighted else "step" if energy.step else cause
    return ObservedEvent(
        found.value, first, last, first + int(np.argmax(flux)), found.half_width_s,
        float(flux.max()) / survey.level / energy.level, int(numbers[last] - numbers[first] + 1 - flux.size), cut, kind,
        energy,
    )  # fmt: skip
