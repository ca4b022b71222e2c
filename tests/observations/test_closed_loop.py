"""Simulated light curves with a known truth: false alarms as promised, intervals that cover, limits that hold."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from mauvecl.lightcurve.flares.shapes import shape_of
from mauvecl.observations.analysis import analyse_frames
from mauvecl.observations.detection import detect_events
from mauvecl.observations.events import measure_event, measure_events
from mauvecl.observations.false_alarms import simulated_rates
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.light_curve import survey_light_curve
from mauvecl.observations.noise import binned_scatter
from mauvecl.observations.search import SeriesSurvey

SHAPE = shape_of("davenport2014")
FRAMES, CADENCE_S, LEVEL, SD = 600, 60.0, 1000.0, 5.0
TIME = np.arange(FRAMES) * CADENCE_S


def survey_of(frames: Frames) -> SeriesSurvey:
    return survey_light_curve(frames, SHAPE, 1)[0]


def light_curve(rng: np.random.Generator, mean: NDArray[np.float64] | float = LEVEL) -> Frames:
    return Frames.of(TIME, rng.normal(mean, SD, FRAMES), np.full(FRAMES, SD))


def flare(peak_s: float, half_width_s: float) -> NDArray[np.float64]:
    edges = np.column_stack([TIME - CADENCE_S / 2, TIME + CADENCE_S / 2])
    return SHAPE.mean_over(edges, peak_s, half_width_s)


@pytest.fixture(scope="module")
def threshold() -> float:
    survey = survey_of(light_curve(np.random.default_rng(1)))
    rates = simulated_rates(survey, np.ones(survey.stare.n_frames, np.bool_), 2.0, 1)
    return max(rate.threshold(2.0) for rate in rates)


@pytest.mark.long
def test_false_alarms_in_white_noise_are_as_many_as_promised(threshold: float) -> None:
    """Two a star-day, level and noise estimated from each light curve; fails by chance once in a thousand times."""
    rng = np.random.default_rng(290)
    count, days = 0, 0.0
    for _ in range(250):
        survey = survey_of(light_curve(rng))
        count += len(detect_events(survey, threshold)[0])
        days += survey.stare.observed_s / 86_400
    # The threshold has a standard error of some 3 %, and an estimated noise makes alarms more frequent: by
    # exp(u^2 s^2 / 2) u^2 of 4 % in the noise.
    low, high = stats.poisson.ppf([0.0005, 0.9995], 2.0 * days)
    assert 0.9 * low < count < 1.15 * high


@pytest.mark.long
def test_intervals_of_the_fitted_equivalent_duration_cover(threshold: float) -> None:
    """68 % intervals of flares of S/N 30-200; the binomial range fails by chance once in a thousand times."""
    rng = np.random.default_rng(291)
    inside, number = 0, 40
    for _ in range(number):
        width, amplitude, peak = rng.uniform(200, 900), rng.uniform(0.03, 0.2), rng.uniform(9000, 27_000)
        survey = survey_of(light_curve(rng, LEVEL * (1 + amplitude * flare(peak, width))))
        found, taken = detect_events(survey, threshold)
        nearest = max(found, key=lambda one: one.value)
        energy = measure_event(survey, taken, survey.flux_level(~taken), nearest).energy
        low, high = energy.low_s[0], energy.high_s[0]
        inside += low <= amplitude * width * SHAPE.equivalent_duration <= high
    assert stats.binom.ppf(0.0005, number, 0.6827) <= inside <= stats.binom.ppf(0.9995, number, 0.6827)


def test_long_flares_are_fitted_in_bins_with_the_same_result(threshold: float, monkeypatch: pytest.MonkeyPatch) -> None:
    survey = survey_of(light_curve(np.random.default_rng(298), LEVEL * (1 + 0.05 * flare(15_000, 3000))))
    found, taken = detect_events(survey, threshold)
    (best,) = found
    fits = []
    for bins in (400, 150):
        monkeypatch.setattr("mauvecl.observations.event_windows.MAX_INSIDE", bins)
        fits.append(measure_event(survey, taken, survey.flux_level(~taken), best).energy)
    whole, binned = fits
    assert whole.dof > 1.3 * binned.dof
    # Bins tell shapes apart less well: both fits differ by a part of the standard error.
    width = whole.high_s[0] - whole.low_s[0]
    assert binned.fitted_s == pytest.approx(whole.fitted_s, abs=0.3 * width)
    assert binned.high_s[0] - binned.low_s[0] == pytest.approx(width, rel=0.5)


def test_a_flare_is_found_at_its_time_and_a_step_is_a_step(threshold: float) -> None:
    rng = np.random.default_rng(292)
    survey = survey_of(light_curve(rng, LEVEL * (1 + 0.1 * flare(15_000, 400))))
    found, taken = detect_events(survey, 5.0)
    (event,) = (measure_event(survey, taken, survey.flux_level(~taken), one) for one in found)
    assert event.kind == "flare"
    assert abs(survey.time_s[event.brightest] - 15_000) < 300
    stepped = survey_of(light_curve(rng, LEVEL + np.where(TIME > 24_000, 40.0, 0.0)))
    found, taken = detect_events(stepped, 6.0)
    assert {one.kind for one in measure_events(stepped, taken, found)} == {"step"}


def test_single_frames_and_dips_are_flagged_and_a_flare_of_three_frames_is_not() -> None:
    rng = np.random.default_rng(293)
    mean = np.full(FRAMES, LEVEL)
    mean[100] += 100
    mean[200] -= 100
    mean[300:303] += (100, 60, 40)
    frames = light_curve(rng, mean)
    reasons = survey_light_curve(frames, SHAPE, 1)[1].reasons
    assert {int(k): int(reasons[k]) for k in np.flatnonzero(reasons)} == {100: Reason.SPIKE, 200: Reason.BELOW}


def test_the_level_follows_rotation_and_the_noise_does_not() -> None:
    rng = np.random.default_rng(294)
    time = np.arange(8000) * 120.0
    rotation = LEVEL * (1 + 0.02 * np.sin(2 * np.pi * time / 2.6e5))
    frames = Frames.of(time, rng.normal(rotation, SD), np.full(time.size, SD / 2))
    level = survey_light_curve(frames, SHAPE, 1)[1]
    # Six standard errors of the level, which are those of its departures from the truth.
    assert np.abs((level.level - rotation) / level.level_error).max() < 6
    assert np.sqrt(np.mean(((level.level - rotation) / level.level_error) ** 2)) == pytest.approx(1.0, abs=0.5)
    # The stated errors are half of the true ones; their estimate has a standard error of 1.4 %.
    assert level.excess == pytest.approx(2.0, rel=0.06)


@pytest.mark.long
def test_independent_frames_are_called_red_as_often_as_stated() -> None:
    """2.5 % of light curves at each number of frames; each range fails by chance once in ten thousand times."""
    rng = np.random.default_rng(295)
    numbers, count = np.arange(2000), 400
    red = np.array([[one.red for one in binned_scatter(numbers, rng.normal(0, 1, 2000))] for _ in range(count)])
    low, high = stats.binom.ppf([0.00005, 0.99995], count, 0.025)
    assert red.shape == (count, 8)
    assert ((red.sum(axis=0) >= low) & (red.sum(axis=0) <= high)).all()


def test_correlated_frames_are_red_and_gaps_are_not_bridged() -> None:
    rng = np.random.default_rng(296)
    slow = np.convolve(rng.normal(0, 1, 20_000), np.ones(10) / np.sqrt(10), "same")
    found = binned_scatter(np.arange(slow.size), slow)
    assert all(one.red for one in found if one.frames >= 2)
    # With a gap after every second frame there are no means of four.
    pairs = np.arange(20_000) + np.arange(20_000) // 2 * 5
    assert [one.frames for one in binned_scatter(pairs, slow)] == [1, 2]


@pytest.mark.long
def test_flares_at_the_limit_are_detected_nine_times_in_ten() -> None:
    """New light curves with flares at the stated limit; fails by chance once in a thousand times."""
    rng = np.random.default_rng(297)
    analysis = analyse_frames(light_curve(rng))
    width = float(analysis.completeness.half_widths_s[1])
    limit = analysis.completeness.limit(1)
    amplitude = limit / width / SHAPE.equivalent_duration
    seen, number = 0, 100
    for _ in range(number):
        peak = float(rng.uniform(4000, 32_000))
        survey = survey_of(light_curve(rng, LEVEL * (1 + amplitude * flare(peak, width))))
        best = survey.search.largest(survey.sums[None])
        seen += best.maximum[0] >= analysis.candidates and abs(best.peak_s[0] - peak) < 4 * width + 300
    # The limit itself comes from forty injections per size: its completeness is known to some 5 %.
    low, high = stats.binom.ppf([0.0005, 0.9995], number, [0.78, 0.97])
    assert low <= seen <= high
