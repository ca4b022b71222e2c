"""Families of shapes and the process of a light curve: their matrices, and work that does not grow with its length."""

import time
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from celerite2 import terms
from scenes import flare, noisy
from scipy import stats
from scipy.linalg import null_space

from mauvecl import SHAPES, Frames, Study, analyse
from mauvecl.observations import event_windows, events
from mauvecl.observations import level as levels
from mauvecl.observations import process as processes
from mauvecl.observations import search as searches


@pytest.mark.parametrize("middle", [-40.0, -3.0, 0.1, 5.0, 300.0, 1e4])
def test_quantiles_of_many_parts_are_those_of_their_sum(middle: float) -> None:
    rng = np.random.default_rng(2)
    log_weight, mean, log_sd = rng.normal([0.0, middle, 0.0], [1.0, 2.0, 0.4], (50_000, 3)).T
    mixture, weight = events.NormalMixture(log_weight, mean, np.exp(log_sd)), np.exp(log_weight)
    shares = (0.025, 0.16, 0.5, 0.84, 0.975)
    none, *above = (weight @ stats.norm.sf(q, mean, np.exp(log_sd)) for q in (0.0, *map(mixture.quantile, shares)))
    assert np.array(above) / none == pytest.approx(1 - np.array(shares), abs=2e-5)


CADENCE_S, LEVEL, SD = 20.0, 10_000.0, 10.0
SHORT, LONG = 80_000, 320_000
SMOOTH = processes.Process((processes.ProcessTerm("smooth", (np.log(2.0), np.log(40_000.0))),), 1.0)


def survey_of(n: int, model: processes.Process, second: float = 0.0) -> searches.SeriesSurvey:
    """Return frames with a flare in the middle and perhaps another, about which light curves of all lengths agree."""
    noise = np.random.default_rng(5).normal(0.0, SD, LONG)[(LONG - n) // 2 : (LONG + n) // 2]
    time = np.arange(n) * CADENCE_S
    rise = (flare(time + CADENCE_S / 2, CADENCE_S, time[n // 2] + after, 120.0) for after in (0.0, 500.0))
    flux = LEVEL * (1 + 0.05 * next(rise) + second * next(rise)) + noise
    frames = Frames.of(time, flux, np.full(n, SD))
    every, shape = np.ones(n, np.bool_), SHAPES["davenport2014"]
    survey = searches.SeriesSurvey.of(frames, flux, np.full(n, SD**2), every, LEVEL, 0.0, shape)
    return replace(survey, processes=(model,), flux_process=model)


def measured_event(survey: searches.SeriesSurvey, missing: int = 0) -> Any:
    """Return the equivalent durations of the event in the middle, after which some frames are missing."""
    n = len(survey.stare.start_s)
    one = searches.DetectedEvent(100.0, 120.0, float(survey.stare.start_s[n // 2]), 0, 20.0, n // 2 - 8, n // 2 + 120)
    survey = survey.frames(~np.isin(np.arange(n), one.last + 1 + np.arange(missing)))
    taken = np.isin(np.arange(n - missing), range(one.first, one.last + 1))
    return events.measure_event(survey, taken, np.full(n - missing, LEVEL / SD), one)


def watch(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, place: int, found: list[tuple[str, int]]) -> None:
    """Record the size of an argument of a function, whenever it is called."""
    original = getattr(owner, name)

    def recorded(*given, **others):  # type: ignore[no-untyped-def]
        found.append((name, np.size(given[place])))
        return original(*given, **others)

    monkeypatch.setattr(owner, name, recorded)


def test_general_family_has_the_same_bits_in_each_process() -> None:
    """Weights that depend on ten points in a random order repeat once in thousands of times."""
    made = []
    for _ in range(3):
        event_windows.Family.general.cache_clear()
        made.append(event_windows.Family.general().weights.tobytes())
    assert made[0] == made[1] == made[2]


@pytest.mark.parametrize("model", [SMOOTH, processes.Process((), 1.0)], ids=["smooth", "white"])
def test_work_of_an_event_does_not_grow_with_the_light_curve(model: processes.Process, monkeypatch: Any) -> None:
    sizes, measured, work, solved, templates = list[tuple[str, int]](), [], [], list[tuple[str, int]](), []
    watch(monkeypatch, event_windows, "_bins", 0, sizes)
    for name in ("covariance", "times", "at"):
        watch(monkeypatch, processes.Process, name, 1, sizes)
    watch(monkeypatch, processes.Covariance, "squared_norms", 1, solved)
    for n in (SHORT, LONG):
        measured.append(measured_event(survey_of(n, model)))
        work.append(sizes[:])
        found, _ = events.detect_events(survey_of(n, model), 7.0)
        assert len(found) == 1
        templates.append(sum(size for _, size in solved))
        sizes.clear()
        solved.clear()
    assert templates[1] == pytest.approx(templates[0], rel=0.02)
    assert work[0]
    assert work[0] == work[1]
    assert max(size for name, size in work[0] if name != "at") <= 2 * event_windows.WINDOW_FRAMES + 200
    for name in ("summed_s", "summed_error_s", "fitted_s", "low_s", "high_s"):
        assert getattr(measured[1], name) == pytest.approx(getattr(measured[0], name), rel=1e-4)


def test_flares_that_may_be_one_or_two_are_measured_alike_at_any_time() -> None:
    """Compare an event 2 and 9 days after the start, in which one flare and two are about as probable."""
    early, late = (measured_event(survey_of(n, SMOOTH, second=0.005)) for n in (SHORT // 4, SHORT))
    for name in ("fitted_s", "low_s", "high_s"):
        assert getattr(late, name) == pytest.approx(getattr(early, name), rel=5e-4)


def test_event_that_a_gap_cuts_may_be_a_limit_and_one_below_the_level_is_unclear() -> None:
    whole, cut = (measured_event(survey_of(2000, SMOOTH), missing) for missing in (2, 3))
    assert (whole.cut, cut.cut) == (False, True)
    less = [replace(one, summed_s=share * one.fitted_s) for one in (whole, cut) for share in (0.94, 0.96)]
    assert [one.is_limit for one in less] == [False, False, True, False]
    below = [replace(cut, summed_s=-errors * cut.summed_error_s) for errors in (1.9, 2.1)]
    assert [one.unclear for one in below] == [False, True]


@pytest.mark.parametrize(("kind", "parameters", "kernel"), [
    ("correlated", [1.6, 400.0], terms.RealTerm(a=1.6**2, c=1 / 400)),
    ("smooth", [2.0, 40_000.0], terms.SHOTerm(sigma=2.0, rho=40_000.0, Q=2**-0.5)),
    ("rotation", [2.7, 3000.0, 2.7, 1.1, 0.6], terms.RotationTerm(sigma=2.7, period=3000.0, Q0=2.7, dQ=1.1, f=0.6)),
    ("sharp rotation", [2.0, 3000.0, 3.0, 0.3], terms.TermSum(*(
        terms.SHOTerm(sigma=2.0 * 0.3**k / np.linalg.norm(0.3 ** np.arange(6)), rho=3000 / (k + 1), Q=3.0 * (k + 1))
        for k in range(6)
    ))),
], ids=["correlated", "smooth", "rotation", "sharp rotation"])  # fmt: skip
def test_level_norms_and_covariances_are_those_of_the_matrices(kind: Any, parameters: list[float], kernel: Any) -> None:
    """Covariances of two terms are those of celerite2's terms with these parameters, one of which is smooth."""
    rng = np.random.default_rng(8)
    time = np.sort(rng.choice(900, 500, replace=False)) * CADENCE_S
    both = (processes.ProcessTerm(*one) for one in (("smooth", np.log([3.0, 2000.0])), (kind, np.log(parameters))))
    model = processes.Process(tuple(both), 1.1)
    variance = rng.uniform(0.8, 1.3, time.size)
    quiet = rng.random(time.size) < 0.8
    values = rng.normal(1000.0, 2.0, (time.size, 2))
    noise = variance * model.excess**2
    kernel = terms.TermSum(terms.SHOTerm(sigma=3.0, rho=2000.0, Q=2**-0.5), kernel)
    between = kernel.get_value(np.abs(time[:, None] - time))
    np.testing.assert_allclose(model.at(time[:, None] - time), between, rtol=1e-12, atol=1e-12)
    dense, made = between + np.diag(noise), model.covariance(time, noise)
    inverse = np.linalg.inv(dense[np.ix_(quiet, quiet)])
    mean = inverse.sum(axis=0) @ values[quiet] / inverse.sum()
    expected = mean + between[:, quiet] @ inverse @ (values[quiet] - mean)
    found = levels.ConditionalLevel(model, time, variance, quiet).of(values)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    weights = np.where(np.arange(time.size) % 90 < 20, rng.random(time.size), 0.0)
    np.testing.assert_allclose(model.times(time, weights), between @ weights, rtol=1e-9)
    columns = rng.normal(size=(40, 3))
    padded = np.pad(columns, [(30, time.size - 70), (0, 0)])
    exact = np.einsum("ik,ik->k", padded, np.linalg.solve(dense, padded))
    np.testing.assert_allclose(made.squared_norms(columns, 30, time.size), exact, rtol=1e-9)
    values = rng.standard_normal((time.size, 3))
    np.testing.assert_allclose(dense @ made.solve(values), values, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(made.coloured(made.whitened(values)), values, rtol=1e-9, atol=1e-9)
    assert made.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-10)
    mean, log_likelihood, _ = processes.level_fit(made, values[:, 0])
    ones = np.linalg.solve(dense, np.ones(time.size))
    assert mean == pytest.approx(float(ones @ values[:, 0] / ones.sum()))
    # A constant of any size leaves the sums of values whose weights add up to zero.
    sums = null_space(np.ones((1, time.size))).T
    within = stats.multivariate_normal(np.zeros(time.size - 1), sums @ dense @ sums.T).logpdf(sums @ values[:, 0])
    constant = (time.size - 1) / 2 * np.log(2 * np.pi) - np.log(time.size) / 2
    assert log_likelihood == pytest.approx(within + constant, rel=1e-10)


def test_bins_of_a_long_light_curve_are_means_with_their_variance() -> None:
    frames = np.delete(np.arange(24.0), [5, 6, 7, 14])
    data = processes.BinnedLightCurve(10 * frames, frames**2, 1 + frames, 10.0).binned(7)
    # Of three frames each, of which one is too few.
    ends = ((0, 3), (3, 5), (9, 12), (12, 14), (15, 18), (18, 21), (21, 24))
    bins = [np.arange(*map(float, pair)) for pair in ends]
    expected = [(10 * of.mean(), (of**2).mean(), (1 + of).sum() / of.size**2) for of in bins]
    np.testing.assert_allclose(np.column_stack([data.time_s, data.values, data.variance]), expected)
    assert data.step_s == 30.0


def test_progress_rises_to_the_number_of_frames_and_may_stop_the_analysis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events that wait are not measured once the analysis is stopped."""
    # Frequent false alarms, whose rate takes little time.
    at, often, progress = np.arange(500) * 60.0, Study.build({"search": {"per": "day"}}, "test"), Mock()
    frames = noisy(6, at, LEVEL * (1 + 0.05 * flare(at, 60.0, 12_000.0, 300.0)), SD)
    answer = analyse(often, progress=progress, frames=frames)
    assert max(row.event.value for row in answer.rows) > 20
    done, totals = zip(*(one.args for one in progress.call_args_list), strict=True)
    assert (set(totals), done[0], done[-1]) == ({500}, 0, 500)
    assert (np.diff(done) > 0).all()
    assert len(done) > 20
    with pytest.raises(KeyboardInterrupt):
        analyse(often, progress=Mock(side_effect=[None, KeyboardInterrupt]), frames=frames)
    measure = Mock(side_effect=lambda *given: time.sleep(0.02))
    monkeypatch.setattr(events, "measure_event", measure)
    survey, quiet, steps = Mock(), np.zeros(3, np.bool_), processes.Steps(Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        events.measure_events(survey, quiet, [None] * 100, ["flare"] * 100, steps)
    assert 0 < measure.call_count < 30
