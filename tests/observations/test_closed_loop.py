"""Simulated light curves with a known truth: false alarms as promised, intervals that cover, limits that hold."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import scenes
from numpy.typing import NDArray
from scenes import analysed
from scipy import stats

from mauvecl import SHAPES, Frames
from mauvecl.observations import events
from mauvecl.observations import level as levels
from mauvecl.observations import search as searches
from mauvecl.observations.detection import detect_events
from mauvecl.observations.light_curve import survey_light_curve

SHAPE = SHAPES["davenport2014"]
FRAMES, CADENCE_S, LEVEL, SD = 600, 60.0, 1000.0, 5.0
TIME = np.arange(FRAMES) * CADENCE_S
flare = partial(scenes.flare, TIME, CADENCE_S)


def survey_of(frames: Frames) -> Any:
    return survey_light_curve(frames, SHAPE, 1)[0]


def light_curve(rng: np.random.Generator, mean: NDArray[np.float64] | float = LEVEL) -> Frames:
    return Frames.of(TIME, rng.normal(mean, SD, FRAMES), np.full(FRAMES, SD))


@pytest.fixture(scope="module")
def threshold() -> float:
    survey = survey_of(light_curve(np.random.default_rng(1)))
    rates = searches.simulated_rates(survey, np.ones(survey.stare.n_frames, np.bool_), 2.0, 1)
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
    """Intervals of 68 and 95 % of flares of S/N 30-200, and pulls; each range fails by chance once in a thousand times.

    The sum of squares of 16 pulls notices intervals of half the width in 86 of 100 sets.
    """
    rng = np.random.default_rng(291)
    inside, pulls, number = np.zeros(2), list[float](), 16
    for _ in range(number // 2):
        width, amplitude = rng.uniform(200, 900, 2), rng.uniform(0.03, 0.2, 2)
        peak = rng.uniform((4000, 20_000), (10_000, 28_000))
        light = sum(size * flare(*each) for size, *each in zip(amplitude, peak, width, strict=True))
        survey = survey_of(light_curve(rng, LEVEL * (1 + light)))
        found, taken = detect_events(survey, threshold)
        level = survey.flux_level(~taken)
        for truth, at in zip(amplitude * width * SHAPE.equivalent_duration, peak, strict=True):
            near = (one for one in found if abs(one.peak_s - at) < 2000)
            energy = events.measure_event(survey, taken, level, max(near, key=lambda one: one.value)).energy
            inside += [low <= truth <= high for low, high in zip(energy.low_s, energy.high_s, strict=True)]
            end = (energy.high_s if truth > energy.fitted_s else energy.low_s)[1]
            pulls.append(stats.norm.isf(0.025) * (truth - energy.fitted_s) / (end - energy.fitted_s))
    low, high = stats.binom.ppf([[0.0005], [0.9995]], number, [0.6827, 0.95])
    assert ((low <= inside) & (inside <= high)).all(), inside
    least, most = stats.chi2.ppf([0.0005, 0.9995], number)
    assert least < np.sum(np.square(pulls)) < most, pulls


@pytest.mark.long
def test_flares_at_the_limit_are_detected_nine_times_in_ten() -> None:
    """New light curves with two flares at the stated limit; fails by chance once in a thousand times."""
    rng = np.random.default_rng(297)
    answer = analysed(light_curve(rng))
    width, limit = (answer.limits[name][1].to_value("s") for name in ("half_width", "limit"))
    amplitude = limit / width / SHAPE.equivalent_duration
    seen, number = 0, 20
    for _ in range(number // 2):
        peaks = rng.uniform((4000, 20_000), (16_000, 32_000))
        light = amplitude * sum(flare(peak, width) for peak in peaks)
        survey = survey_of(light_curve(rng, LEVEL * (1 + light)))
        found, _ = detect_events(survey, answer.analysis.threshold)
        seen += sum(any(abs(one.peak_s - peak) < 4 * width + 300 for one in found) for peak in peaks)
    # The limit itself comes from forty injections per size: its completeness is known to some 5 %.
    low, high = stats.binom.ppf([0.0005, 0.9995], number, [0.78, 0.97])
    assert low <= seen <= high


def test_noise_at_the_level_is_that_of_its_counts() -> None:
    """Stated errors are those of the counts of each frame, of which a flare has more than the level."""
    rng = np.random.default_rng(300)
    mean = LEVEL * (1 + 0.5 * flare(15_000, 400))
    flux = rng.normal(mean, np.sqrt(mean + 25))
    quiet = mean < 1.001 * LEVEL
    level = flux[quiet].mean()
    variance, slope = levels.quiet_variance(flux, np.sqrt(flux + 25), np.full(FRAMES, level), quiet)
    assert slope == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(variance, level + 25, rtol=1e-9)


def test_correlations_do_not_bridge_gaps() -> None:
    """Pairs of frames in which the second is like the first are correlated; those like the pair before are not."""
    first, other = np.random.default_rng(301).normal(0, 1, (2, 2000))
    pairs = np.arange(4000) + np.arange(4000) // 2 * 50
    for second, alike in ((first, False), (np.roll(first, -1), True), (other, True)):
        assert levels.likeness(pairs, np.column_stack([first, second]).reshape(-1, 1)).alike == alike
    # Visits of 40 frames have few pairs at long lags: 4000 correlations exceed five errors once in some 200 runs.
    rng = np.random.default_rng(303)
    numbers = (1000 * np.arange(12)[:, None] + np.arange(40)).ravel()
    assert all(levels.likeness(numbers, rng.normal(0, 1, (numbers.size, 1))).alike for _ in range(100))


def test_a_flare_is_found_at_its_time_and_a_step_is_a_step() -> None:
    rng = np.random.default_rng(292)
    (event,) = analysed(light_curve(rng, LEVEL * (1 + 0.1 * flare(15_000, 400)))).events
    assert event["kind"] == "flare"
    assert abs(event["tpeak"].to_value("s") - 15_000) < 300
    stepped = analysed(light_curve(rng, LEVEL + np.where(TIME > 24_000, 40.0, 0.0))).events
    assert "flare" not in set(stepped["kind"][stepped["verdict"] == "detected"])
    assert "step" in set(stepped["kind"])


def test_single_frames_and_dips_are_flagged_and_a_flare_of_three_frames_is_not() -> None:
    rng = np.random.default_rng(293)
    mean = np.full(FRAMES, LEVEL)
    mean[100] += 100
    mean[200] -= 100
    mean[300:303] += (100, 60, 40)
    reasons = analysed(light_curve(rng, mean)).frames["reason"]
    assert {k: str(one) for k, one in enumerate(reasons) if one} == {100: "spike", 200: "below"}


@pytest.mark.long
def test_the_level_follows_rotation_and_the_noise_does_not() -> None:
    rng = np.random.default_rng(294)
    time = np.arange(6000) * 120.0
    rotation = LEVEL * (1 + 0.02 * np.sin(2 * np.pi * time / 2.6e5))
    table = analysed(Frames.of(time, rng.normal(rotation, SD), np.full(time.size, SD / 2))).frames
    # Six standard errors of the level, which are those of its departures from the truth.
    off = np.asarray((table["level"] - rotation) / table["level_error"])
    assert np.abs(off).max() < 6
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.5)
    # The stated errors are half of the true ones; their estimate has a standard error of 1.4 %.
    assert float(np.median(table["error"])) == pytest.approx(SD, rel=0.06)


def test_error_of_a_summed_duration_includes_that_of_its_level() -> None:
    """A star whose level is known to 1.3 %: the level is that of all frames outside of the event."""
    sd = 30.0
    flux = 100.0 * (1 + 40.0 * flare(15_000, 300.0)) + np.random.default_rng(299).normal(0.0, sd, FRAMES)
    (event,) = analysed(Frames.of(TIME, flux, np.full(FRAMES, sd))).analysis.events
    energy, inside = event.energy, event.last - event.first + 1
    frames = energy.summed_s / CADENCE_S
    quiet = FRAMES - inside
    expected = sd / 100.0 * CADENCE_S * np.sqrt(inside + (inside + frames) ** 2 / quiet)
    assert energy.summed_error_s == pytest.approx(expected, rel=0.15)
