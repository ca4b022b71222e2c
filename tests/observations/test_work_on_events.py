"""Long light curves: the work on an event does not grow with their length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mauvecl import SHAPES, Frames
from mauvecl.observations import event_windows
from mauvecl.observations.detection import detect_events
from mauvecl.observations.events import measure_event
from mauvecl.observations.process import Covariance, Process, ProcessTerm
from mauvecl.observations.search import Detection, SeriesSurvey

Float = NDArray[np.float64]
SHAPE = SHAPES["davenport2014"]
CADENCE_S, LEVEL, SD = 20.0, 10_000.0, 10.0
SHORT, LONG = 80_000, 320_000
SMOOTH = Process((ProcessTerm("smooth", (np.log(2.0), np.log(40_000.0))),), 1.0)
WHITE = Process((), 1.0)


def survey_of(n: int, model: Process) -> SeriesSurvey:
    """Return frames with a flare in the middle, around which light curves of each length are the same."""
    noise = np.random.default_rng(5).normal(0.0, SD, LONG)[(LONG - n) // 2 : (LONG + n) // 2]
    time = np.arange(n) * CADENCE_S
    edges = np.column_stack([time, time + CADENCE_S])
    flux = LEVEL * (1 + 0.05 * SHAPE.mean_over(edges, time[n // 2], 120.0)) + noise
    frames = Frames.of(time, flux, np.full(n, SD))
    survey = SeriesSurvey.of(frames, flux, np.full(n, SD**2), np.ones(n, np.bool_), LEVEL, 0.0, SHAPE)
    return replace(survey, processes=(model,), flux_process=model)


def event_of(survey: SeriesSurvey) -> Detection:
    middle = survey.stare.n_frames // 2
    return Detection(100.0, 120.0, float(survey.stare.start_s[middle]), 0, 20.0, middle - 8, middle + 120)


class Sizes:
    """Numbers of values that functions are called with."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monkeypatch, self.found = monkeypatch, list[tuple[str, int]]()

    def watch(self, owner: object, name: str, place: int) -> None:
        """Record the size of an argument of a function."""
        original = getattr(owner, name)

        def recorded(*given, **others):  # type: ignore[no-untyped-def]
            self.found.append((name, np.size(given[place])))
            return original(*given, **others)

        self.monkeypatch.setattr(owner, name, recorded)

    def taken(self) -> list[tuple[str, int]]:
        """Return the sizes and forget them."""
        found, self.found = self.found, []
        return found


@pytest.mark.parametrize("model", [SMOOTH, WHITE], ids=["smooth", "white"])
def test_work_of_an_event_does_not_grow_with_the_light_curve(model: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = Sizes(monkeypatch)
    sizes.watch(event_windows, "_bins", 0)
    sizes.watch(Process, "covariance", 1)
    sizes.watch(Process, "times", 1)
    sizes.watch(Process, "at", 1)
    measured, work = [], []
    for n in (SHORT, LONG):
        survey = survey_of(n, model)
        one = event_of(survey)
        taken = np.zeros(n, np.bool_)
        taken[one.first : one.last + 1] = True
        measured.append(measure_event(survey, taken, np.full(n, LEVEL / SD), one).energy)
        work.append(sizes.taken())
    assert work[0]
    assert work[0] == work[1]
    assert max(size for name, size in work[0] if name != "at") <= 2 * event_windows.WINDOW_FRAMES + 200
    for name in ("summed_s", "summed_error_s", "fitted_s", "low_s", "high_s"):
        assert getattr(measured[1], name) == pytest.approx(getattr(measured[0], name), rel=1e-4)


def test_search_solves_as_many_templates_around_an_event_in_a_longer_light_curve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes = Sizes(monkeypatch)
    sizes.watch(Covariance, "squared_norms", 1)
    work = []
    for n in (SHORT, LONG):
        found, _ = detect_events(survey_of(n, SMOOTH), 7.0)
        assert len(found) == 1
        work.append(sum(size for _, size in sizes.taken()))
    assert work[1] == pytest.approx(work[0], rel=0.02)
