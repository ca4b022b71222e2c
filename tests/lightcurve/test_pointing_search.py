"""Searches of stares with pointing drifts: false alarms stay as promised, and flares in drifts lose light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mauvecl import Stares, Study
from mauvecl.lightcurve.search.sampled_rate import sampled_rate
from mauvecl.lightcurve.search.survey import Survey
from mauvecl.noise.pointing import PointingDrifts
from mauvecl.study.cases import Case, cases
from mauvecl.study.surveys import survey_star

#: Heavy drifts: a quarter of the time, all of the light at worst.
HEAVY = "stare.pointing={rate_per_h=6.0, depth=1.0, duration_s=200.0}"
PER_DAY, N_STARES, SEED = 3.0, 500, 7


def case(star: str, *settings: str) -> Case:
    (one,) = cases(Study().with_settings([f"star=[{star}]", "stare.duration_s=8000", *settings]))
    return one


def maxima(survey: Survey, count: int) -> np.ndarray:
    return np.asarray(Stares().reduced(survey.largest_value_request(count, SEED))["maximum"])


@pytest.mark.long
@pytest.mark.parametrize("star", ['{library="M3V", magnitude=9.0}', '{library="K3V", magnitude=4.5}'])
def test_false_alarms_stay_as_promised_with_drifts(star: str) -> None:
    """Count at most the wanted rate within 4.5 standard deviations; fails in 3e-6 of runs.

    Thresholds are bounds from above, and frames in drifts have less noise, so that there may be somewhat fewer alarms.
    """
    survey = survey_star(case(star, HEAVY)).survey
    threshold = sampled_rate(survey, 5).threshold(PER_DAY).value
    p = -np.expm1(-PER_DAY * survey.stare.observed_s / 86_400.0)
    alarmed = np.count_nonzero(maxima(survey, N_STARES) >= threshold)
    assert alarmed < N_STARES * p + 4.5 * np.sqrt(N_STARES * p * (1 - p))
    assert alarmed > 0.6 * N_STARES * p - 4.5 * np.sqrt(N_STARES * p * (1 - p))


def test_search_that_does_not_marginalise_alarms_in_nearly_every_stare() -> None:
    plain = survey_star(case('{library="M3V", magnitude=9.0}')).survey
    drifting = replace(plain, stare=replace(plain.stare, pointing=PointingDrifts(rate_per_h=6.0, depth=1.0)))
    assert np.mean(maxima(drifting, 40) > 6.0) > 0.8
    assert np.mean(maxima(plain, 40) > 6.0) < 0.1


def test_drifts_move_marginalised_sums_by_less_than_their_noise() -> None:
    """Draw the same noise with and without drifts; sums of frames hardly differ."""
    survey = survey_star(case('{library="M3V", magnitude=9.0}', HEAVY)).survey
    steady = replace(survey, stare=replace(survey.stare, pointing=None))
    found = [
        Stares().frames(one.components, one.stare, count=4, seed=SEED, method="cumulants") for one in (survey, steady)
    ]
    lost = survey.stare.pointing_losses(np.arange(4, dtype=np.uint64), SEED)
    assert lost.max() > 0.8
    change = np.sqrt(np.mean((found[0] - found[1])[lost > 0] ** 2, axis=0))
    assert (change < 0.1).all()
    np.testing.assert_array_equal(found[0][lost == 0], found[1][lost == 0])


def test_flares_lose_light_in_drifts() -> None:
    """Compare the mean excess of a flare of constant amplitude with the share of the light that is left."""
    survey = survey_star(case('{library="M3V", magnitude=9.0}', HEAVY)).survey
    n = survey.stare.n_frames
    amplitudes = np.array([[0.0], [50.0]])
    how = {"count": 4, "seed": SEED, "method": "cumulants", "amplitudes": amplitudes}
    without, with_it = Stares().frames(survey.components, survey.stare, np.ones((n, 1)), **how)
    left = 1 - survey.stare.pointing_losses(np.arange(4, dtype=np.uint64), SEED)
    rise = (with_it - without)[..., 0]
    fit = np.polynomial.Polynomial.fit(left.ravel(), rise.ravel(), 1).convert().coef
    assert abs(fit[0]) < 0.02 * fit[1]
