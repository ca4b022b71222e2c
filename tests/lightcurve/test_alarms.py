"""Alarms of one stare: each flare is found once, however bright, whatever other flares there are."""

from __future__ import annotations

import numpy as np
import pytest

from mauvecl import Event, Study
from mauvecl.lightcurve.flares.events import coefficients
from mauvecl.lightcurve.search.alarms import LEFT_BEHIND, alarms
from mauvecl.study.cases import Case
from mauvecl.study.surveys import StarSurvey, survey_star

#: One false alarm in a star-month at 4.91, by importance sampling, and so 5e-6 in an orbit at 6.
THRESHOLD = 6.0


@pytest.fixture(scope="module")
def known() -> StarSurvey:
    study = Study().with_settings(['star=[{library="G2V", magnitude=7.4}]', "search.half_widths_s=[22, 42, 77, 144]"])
    return survey_star(Case(study))


def drawn(known: StarSurvey, events: list[Event], seed: int) -> np.ndarray:
    """Draw sums of normal noise with unit covariance and of flares of the study's temperature."""
    stare = known.survey.stare
    flare = coefficients(events, stare.start_s, stare.frame_s, np.array([10_000.0]))
    coefs = known.survey.components.coefficients(stare, flare)
    noise = np.random.Generator(np.random.Philox(seed)).standard_normal((stare.n_frames, 3))
    return known.survey.components.means(coefs) + noise


def found(known: StarSurvey, events: list[Event], seed: int = 1) -> list:
    return alarms(known.survey, known.templates, drawn(known, events, seed), THRESHOLD)


def test_bright_flare_is_found_once(known):
    # S/N of 400: its fit leaves no second alarm in any template. A false alarm: once in 7e4 runs.
    for seed in range(3):
        (one,) = found(known, [Event(3000.0, 60.0, 1.0)], seed)
        assert abs(one.recovered.peak_s[0] - 3000.0) < 5.0
        assert one.rho > 300


def test_unfitted_shape_leaves_at_most_the_allowed_residual(known):
    # The other published shape: its fit is wrong, but its rests are no flares.
    several = found(known, [Event(3000.0, 60.0, 1.0, shape="tovarmendoza2022")])
    assert several[0].rho > 300
    assert all(one.rho > THRESHOLD + LEFT_BEHIND * several[0].rho for one in several[1:])
    assert len(several) <= 2


@pytest.mark.long
def test_separate_flares_are_found_in_order_of_value(known):
    events = [Event(1500.0, 40.0, 0.1), Event(3000.0, 60.0, 0.3), Event(4500.0, 100.0, 0.05)]
    several = found(known, events)
    assert [round(float(one.recovered.peak_s[0]), -2) for one in several] == [3000.0, 1500.0, 4500.0]
    assert [one.rho for one in several] == sorted((one.rho for one in several), reverse=True)
    for one, event in zip(several, (events[1], events[0], events[2]), strict=True):
        fit = one.recovered
        # Beyond five standard errors once in 2e6.
        assert abs(fit.amplitude[0] - event.amplitude) < 5 * fit.amplitude_error[0]
        assert (
            abs(np.log(fit.half_width_s[0] / event.half_width_s)) < 5 * fit.half_width_error_s[0] / fit.half_width_s[0]
        )


def test_nothing_is_found_in_noise(known):
    # A false alarm in one of ten orbits: once in 2e4 runs.
    assert all(not found(known, [], seed) for seed in range(10, 20))
