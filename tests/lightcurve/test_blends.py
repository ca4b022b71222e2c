"""Overlapping flares are found, counted and measured together, whatever their number, distance and place."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pytest
from scipy.stats import binom

from mauvecl import Event, Study
from mauvecl.lightcurve.flares.events import coefficients
from mauvecl.lightcurve.search.alarms import QUANTITIES, Alarm, alarms
from mauvecl.study.cases import Case
from mauvecl.study.surveys import StarSurvey, survey_star

#: One false alarm in a star-month.
THRESHOLD = 4.92


def survey_of(*settings: str) -> StarSurvey:
    study = Study().with_settings(['star=[{library="M3V", magnitude=9}]', *settings])
    return survey_star(Case(study))


@pytest.fixture(scope="module")
def known() -> StarSurvey:
    return survey_of()


def found(known: StarSurvey, events: list[Event], seed: int, profiled: Collection[str] = QUANTITIES) -> list[Alarm]:
    """Return the alarms of one stare with normal noise, which includes that of the flares' photons.

    Only the intervals of `profiled` are computed, which take most of the time.
    """
    stare, components = known.survey.stare, known.survey.components
    coefs = components.coefficients(stare, coefficients(events, stare.start_s, stare.frame_s, np.array([10_000.0])))
    scatter = np.linalg.cholesky(components.covariance(coefs))
    normal = np.random.Generator(np.random.Philox(seed)).standard_normal((stare.n_frames, 3))
    sums = components.means(coefs) + np.einsum("tij,tj->ti", scatter, normal)
    return alarms(known.survey, known.templates, sums, THRESHOLD, profiled=profiled)


def check(alarm: Alarm, event: Event) -> None:
    """Check agreement within five standard errors, which a normal error exceeds once in 2e6 times."""
    fit = alarm.recovered
    assert abs(fit.peak_s[0] - event.peak_s) < 5 * fit.peak_error_s[0]
    assert abs(np.log(fit.half_width_s[0] / event.half_width_s)) < 5 * fit.half_width_error_s[0] / fit.half_width_s[0]
    error = fit.equivalent_duration_error_s[0] / fit.equivalent_duration_s[0]
    assert abs(np.log(fit.equivalent_duration_s[0] / event.equivalent_duration_s)) < 5 * error


@pytest.mark.long
@pytest.mark.parametrize("apart", [30.0, 60.0, 120.0, 300.0, 900.0])
def test_two_equal_flares_are_separated(known, apart):
    # S/N 83 each. Fitted one after another, those 120 s apart came back as four, one of ten times the energy.
    events = [Event(2800.0, 60.0, 0.5), Event(2800.0 + apart, 60.0, 0.5)]
    several = sorted(found(known, events, 1), key=lambda one: one.recovered.peak_s[0])
    assert len(several) == 2
    for alarm, event in zip(several, events, strict=True):
        check(alarm, event)
        assert alarm.p_value > 1e-6


@pytest.mark.long
@pytest.mark.parametrize(("number", "seeds"), [(2, range(100, 106)), (3, range(200, 203))])
def test_random_pairs_and_triples_are_separated(known, number, seeds):
    # S/N of 30 to 120, peaks one to five half-widths apart. Of 21 flares and three quantities one is beyond five
    # errors in 1e-4 of the runs; a false alarm in 9 orbits: once in 50 runs at most.
    for seed in seeds:
        rng = np.random.Generator(np.random.Philox(seed))
        peak, events = float(rng.uniform(1500, 3000)), []
        for _ in range(number):
            width, snr = 10 ** rng.uniform(1.3, 2.3), 10 ** rng.uniform(1.5, 2.1)
            amplitude = snr / known.unit_snr / np.sqrt(0.72148 * width / 5.0)
            events.append(Event(peak, float(width), float(amplitude)))
            peak += float(rng.uniform(1.0, 5.0) * width + 40.0)
        several = sorted(found(known, events, seed), key=lambda one: one.recovered.peak_s[0])
        assert len(several) == number, (seed, events)
        for alarm, event in zip(several, events, strict=True):
            check(alarm, event)
            assert alarm.p_value > 1e-6


@pytest.mark.long
def test_flares_outside_of_stare_or_bank_are_not_measured(known):
    narrow, wide = known.survey.bank.half_widths_s[0], known.survey.bank.half_widths_s[-1]
    last = known.survey.stare.duration_s
    events = [
        [Event(-150.0, 200.0, 0.5)],
        [Event(last + 20.0, 60.0, 2.0)],
        [Event(2800.0, 2.0, 8.0)],
        [Event(2500.0, 8000.0, 0.3)],
        [Event(5600.0, 500.0, 0.2)],
    ]
    unmeasured = 0
    for seed, some in enumerate(events):
        for alarm in found(known, some, seed):
            fit = alarm.recovered
            if alarm.measured:
                assert 0 <= fit.peak_s[0] <= last
                assert narrow / 1.26 < fit.half_width_s[0] < wide * 1.26
            else:
                unmeasured += 1
                assert alarm.note.startswith("detected but not measured: its ")
                assert all(np.isnan(end) for ends in alarm.intervals.values() for end in ends)
                assert np.isnan(fit.equivalent_duration_s[0])
                assert alarm.rho >= THRESHOLD
    assert unmeasured >= 2


def one_flare(known, seed: int, snr: float, profiled: Collection[str] = QUANTITIES) -> tuple[Event, list[Alarm]]:
    """Return a random flare of the given S/N and the alarms in its stare."""
    rng = np.random.Generator(np.random.Philox([seed, int(snr)]))
    width, peak = 10 ** rng.uniform(np.log10(25), np.log10(250)), rng.uniform(2000, 3500)
    amplitude = snr / known.unit_snr / np.sqrt(0.72148 * width / 5.0)
    event = Event(float(peak), float(width), float(amplitude))
    near = [
        alarm for alarm in found(known, [event], seed, profiled)
        if alarm.measured and abs(alarm.recovered.peak_s[0] - peak) < 3 * width
    ]  # fmt: skip
    return event, near


@pytest.mark.long
@pytest.mark.parametrize("seed", [108, 118, 228, 251])
def test_intervals_include_a_second_optimum(known, seed):
    # Chi-squared at the true half-width is within one of its least, beyond a rise that once ended the interval.
    event, near = one_flare(known, seed, 6.0, ["half_width_s"])
    low, high = near[0].intervals["half_width_s"]
    assert low <= event.half_width_s <= high


@pytest.mark.long
def test_intervals_cover_near_the_threshold(known):
    # 68 % intervals at S/N 6. At a coverage of 65 % each quantity fails once in 1000 runs.
    names = ("peak_s", "half_width_s", "equivalent_duration_s")
    held, count = np.zeros(3, np.int64), 0
    for seed in range(400, 420):
        event, near = one_flare(known, seed, 6.0)
        for alarm in near[:1]:
            count += 1
            ends = [alarm.intervals[name] for name in names]
            held += [low <= getattr(event, name) <= high for (low, high), name in zip(ends, names, strict=True)]
    assert count >= 10
    assert (binom.cdf(held, count, 0.65) > 1e-3).all(), (held, count)


@pytest.mark.long
def test_intervals_cover_above_the_threshold(known):
    # 68 % intervals of 16 stares at S/N 8 and 15. At 65 %, fewer than 5 hold the truth once in 700 runs of each.
    held = np.zeros(2)
    for seed in range(8):
        for snr in (8.0, 15.0):
            rng = np.random.Generator(np.random.Philox([300 + seed, int(snr)]))
            width, peak = 10 ** rng.uniform(np.log10(25), np.log10(250)), rng.uniform(2000, 3500)
            amplitude = snr / known.unit_snr / np.sqrt(0.72148 * width / 5.0)
            event = Event(float(peak), float(width), float(amplitude))
            for alarm in found(known, [event], 300 + seed)[:1]:
                ends = [alarm.intervals[name] for name in ("half_width_s", "equivalent_duration_s")]
                truths = (width, event.equivalent_duration_s)
                held += [low <= truth <= high for (low, high), truth in zip(ends, truths, strict=True)]
    assert (held >= 5).all(), held


@pytest.mark.long
def test_more_than_200_flares_are_found():
    # S/N 60 each, 12 half-widths apart; once no more than 200 were listed.
    known = survey_of("stare.duration_s=26000", "search.window_s=150", "search.half_widths_s=[10.0]")
    amplitude = 60.0 / known.unit_snr / np.sqrt(0.72148 * 10.0 / 5.0)
    events = [Event(120.0 * k + 100.3, 10.0, float(amplitude)) for k in range(210)]
    assert len(found(known, events, 5, profiled=())) == 210
