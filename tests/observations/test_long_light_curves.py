"""Long light curves: the work on an event does not grow with their length, and the analysis reports its progress."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run
from numpy.typing import NDArray

from mauvecl import SHAPES, Detection, Frames, Study, analyse
from mauvecl.cli.session import Session
from mauvecl.observations import event_windows, level
from mauvecl.observations.detection import detect_events
from mauvecl.observations.events import measure_event
from mauvecl.observations.noise import binned_scatter
from mauvecl.observations.process import Covariance, Process, ProcessTerm
from mauvecl.observations.search import SeriesSurvey

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


def test_end_of_a_guessed_flare_is_looked_for_near_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    flux = rng.normal(0.0, 1.0, 3000)
    flux[1000:1400] += 40.0
    flux[2990:] += 40.0
    whole = level.guess_flares(np.arange(3000), flux)
    assert whole[1000:1400].all()
    assert whole[2991:].all()
    assert not whole[1403:2985].any()
    monkeypatch.setattr(level, "FIRST_PIECE", 7)
    np.testing.assert_array_equal(level.guess_flares(np.arange(3000), flux), whole)


@pytest.mark.parametrize(
    "term",
    [ProcessTerm("rotation", (1.0, 8.0, 1.0, 0.1, -0.5)), ProcessTerm("correlated", (0.5, 6.0)), *SMOOTH.terms],
    ids=lambda term: term.kind,
)
def test_level_norms_and_covariances_are_those_of_the_matrices(term: ProcessTerm) -> None:
    rng = np.random.default_rng(8)
    time = np.sort(rng.choice(900, 500, replace=False)) * CADENCE_S
    model = Process((ProcessTerm("smooth", (np.log(3.0), np.log(2000.0))), term), 1.1)
    variance = rng.uniform(0.8, 1.3, time.size)
    quiet = rng.random(time.size) < 0.8
    values = rng.normal(1000.0, 2.0, (time.size, 2))
    noise = variance * model.excess**2
    between = model.at(time[:, None] - time)
    inverse = np.linalg.inv(between[np.ix_(quiet, quiet)] + np.diag(noise[quiet]))
    mean = inverse.sum(axis=0) @ values[quiet] / inverse.sum()
    expected = mean + between[:, quiet] @ inverse @ (values[quiet] - mean)
    found = level.process_level(model, time, values, variance, quiet)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    weights = np.where(np.arange(time.size) % 90 < 20, rng.random(time.size), 0.0)
    np.testing.assert_allclose(model.times(time, weights), between @ weights, rtol=1e-9)
    columns = rng.normal(size=(40, 3))
    padded = np.pad(columns, [(30, time.size - 70), (0, 0)])
    exact = np.einsum("ik,ik->k", padded, np.linalg.solve(between + np.diag(noise), padded))
    np.testing.assert_allclose(model.covariance(time, noise).squared_norms(columns, 30, time.size), exact, rtol=1e-9)


def test_means_of_consecutive_frames_do_not_overlap_and_have_no_gaps() -> None:
    rng = np.random.default_rng(4)
    numbers = np.flatnonzero(rng.random(4000) < 0.97)
    residual = rng.normal(size=numbers.size)
    for one in binned_scatter(numbers, residual):
        means, k = [], 0
        while k + one.frames <= numbers.size:
            if numbers[k + one.frames - 1] - numbers[k] == one.frames - 1:
                means.append(residual[k : k + one.frames].mean())
                k += one.frames
            else:
                k += 1
        assert (one.count, one.measured) == (len(means), pytest.approx(np.std(means, ddof=1)))


def few_frames() -> Frames:
    rng = np.random.default_rng(6)
    time = np.arange(500) * 60.0
    edges = np.column_stack([time, time + 60.0])
    flux = LEVEL * (1 + 0.05 * SHAPE.mean_over(edges, 12_000.0, 300.0)) + rng.normal(0.0, SD, time.size)
    return Frames.of(time, flux, np.full(time.size, SD))


def test_progress_rises_to_the_number_of_frames() -> None:
    reported: list[tuple[int, int]] = []
    answer = analyse(Study(), progress=lambda done, total: reported.append((done, total)), frames=few_frames())
    assert max(row.event.value for row in answer.rows) > 20
    done, totals = (list(each) for each in zip(*reported, strict=True))
    assert set(totals) == {500}
    assert done[0] == 0
    assert done[-1] == 500
    assert (np.diff(done) > 0).all()
    assert len(done) > 20


class StoppedError(Exception):
    """Raised by a report to stop the work."""


def test_a_report_may_stop_the_analysis() -> None:
    def stop(done: int, total: int) -> None:
        if done:
            raise StoppedError

    with pytest.raises(StoppedError):
        analyse(Study(), progress=stop, frames=few_frames())


def test_the_command_shows_progress_in_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = few_frames()
    columns = {"time": frames.time_s, "flux": frames.flux, "error": frames.error}
    Table(columns, units={"time": "s"}).write(tmp_path / "star.ecsv")
    units, original = [], Session.metered

    def metered(session: Session, unit: str, *words: str):  # type: ignore[no-untyped-def]
        meter = original(session, unit, *words)
        units.append((unit, meter))
        return meter

    monkeypatch.setattr(Session, "metered", metered)
    run("analyse", "star.ecsv", "--no-pictures", folder=tmp_path)
    ((unit, meter),) = units
    assert unit == "frames"
    assert (meter._last, meter._total) == (500, 500)
