"""Averages over unknown instrument values, and their importance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused
from scipy import stats

from mauvecl.answers.detection.maps import detection_map
from mauvecl.answers.limits.limits import limiting_magnitude
from mauvecl.answers.limits.search import LimitSearch, MarginalLimitSearch
from mauvecl.device.engine import Engine
from mauvecl.statistics.intervals import Interval
from mauvecl.study.cases import Case
from mauvecl.study.study import Study
from mauvecl.study.unknowns import REST, average, drawn, shares


def study(unknowns: dict[str, Any], **changes: Any) -> Study:
    """Return a study of the paper's G2V star with a 24 % flare."""
    data: dict[str, Any] = {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "flare": {"amplitudes": [0.24]},
        "run": {"realisations": 40_000, "fap": 1e-2, "statistics": ["matched"], "seed": 5},
        "unknowns": {"draws": 8} | unknowns,
    }
    return Study.build(data | changes, "test")


SURE = {
    "light_loss": {"uniform": [0.34, 0.34]},
    "known": ["temperature_c", "pointing_loss", "qe_scale", "conversion_uv_per_electron", "read_noise_dn"],
}


def test_draws_follow_their_priors() -> None:
    draws = drawn(study({"draws": 512}))
    assert draws.names[:2] == ("temperature_c", "light_loss")
    column = dict(zip(draws.names, draws.values.T, strict=True))
    # A Latin hypercube: every 1/512 of each prior once.
    assert np.sort(column["temperature_c"])[::64] == pytest.approx(np.linspace(13, 20, 8), abs=8 / 512)
    cut = stats.truncnorm(-3, 3, loc=0.34, scale=0.1)
    np.testing.assert_allclose(np.sort(cut.cdf(column["light_loss"])), (np.arange(512) + 0.5) / 512, atol=1 / 512)
    one = draws.studies[7].observation.load_instrument()
    nominal = Study().observation.load_instrument()
    assert one.light_loss == column["light_loss"][7]
    assert one.collecting_area_cm2 == pytest.approx(column["qe_scale"][7] * nominal.collecting_area_cm2)
    again = drawn(study({"draws": 512}))
    np.testing.assert_array_equal(again.values, draws.values)


def test_prior_of_zero_width_changes_nothing(engine: Engine) -> None:
    """A prior of zero width gives the limit of the nominal instrument."""
    averaged = limiting_magnitude(study(SURE | {"draws": 2}), engine)
    plain = limiting_magnitude(study({"draws": 0}), engine)
    (one,), (two,) = averaged.limits, plain.limits
    assert one.closed_form == pytest.approx(two.closed_form, abs=1e-4)
    assert one.unknown is not None
    assert one.unknown.range == pytest.approx((two.closed_form, two.closed_form), abs=1e-4)
    assert abs(one.value.value - two.value.value) < 0.03


@pytest.mark.long
def test_limit_over_unknowns_has_the_power_on_average(engine: Engine) -> None:
    """The mean of the closed form is the power; worse instruments have brighter limits; one unknown explains most."""
    asked = study({"draws": 24})
    result = limiting_magnitude(asked, engine)
    (limit,) = result.limits
    question = MarginalLimitSearch(Case(asked.at("amplitude", 0.24)), "matched")
    assert question.theory(limit.closed_form) == pytest.approx(0.9, abs=1e-3)
    assert limit.verdict in ("confirms it", "")
    found = limit.unknown
    assert found is not None
    low, high = found.range
    assert low < limit.value.value < high
    # The limit must hold for most instruments and is therefore brighter than the median.
    assert limit.closed_form < np.median(found.limits)
    by_name = dict(zip(found.draws.names, found.draws.values.T, strict=True))
    assert np.corrcoef(by_name["qe_scale"], found.limits)[0, 1] > 0.6
    assert next(iter(found.shares)) == "qe_scale"
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert min(found.shares.values()) > -1e-9
    table = result.table
    assert table["matters_most"][0] == "qe_scale"
    assert table["unknown_low"][0] < table["unknown_high"][0]


@pytest.mark.long
def test_shares_equal_those_of_a_linear_model() -> None:
    draws = drawn(study({"draws": 2048}))
    column = dict(zip(draws.names, draws.values.T, strict=True))
    outcome = 3.0 * stats.zscore(column["qe_scale"]) + 1.0 * stats.zscore(column["light_loss"])
    found = shares(draws, outcome)
    assert list(found)[:2] == ["qe_scale", "light_loss"]
    assert found["qe_scale"] == pytest.approx(0.9, abs=0.05)
    assert found["read_noise_dn"] == pytest.approx(0.0, abs=0.01)


def test_average_over_unknowns_equals_the_mean() -> None:
    p = average([Interval(0.2, 0.1, 0.3), Interval(0.4, 0.3, 0.5)])
    assert p.value == pytest.approx(0.3)
    assert p.low == pytest.approx(0.3 - np.hypot(1.96 * 0.1, np.hypot(0.1, 0.1) / 2), abs=1e-3)
    assert average([Interval(1.0, 0.99, 1.0)] * 4).high == 1.0


@pytest.mark.long
def test_map_is_the_mean_of_its_draws(engine: Engine) -> None:
    axes = {
        "x": {"quantity": "magnitude", "values": [7.0, 10.5]},
        "y": {"quantity": "amplitude", "values": [0.1, 0.24]},
    }
    asked = study({"draws": 4}, map=axes)
    found = detection_map(asked, engine)
    each = [detection_map(one, engine) for one in drawn(asked).studies]
    np.testing.assert_allclose(found.probability, np.mean([one.probability for one in each], axis=0))
    assert np.all((found.low <= found.probability) & (found.probability <= found.high))
    assert set(found.shares["matched"]) == {*drawn(asked).names, REST}


def test_values_of_the_study_are_not_drawn() -> None:
    stated = study({}, observation={"temperature_c": 15.0, "changes": {"light_loss": 0.3}})
    assert not {"temperature_c", "light_loss"} & set(drawn(stated).names)
    with refused("unknowns.draws"):
        drawn(study({"known": [*SURE["known"], "light_loss"]}))
    with refused("light_loss"):
        drawn(study({"light_loss": {"uniform": [0.9, 1.2]}}))


@pytest.mark.parametrize("of", ["magnitude", "amplitude", "exposure"])
@pytest.mark.parametrize("geometry", ["added", "replaces"])
def test_light_is_linear(of: str, geometry: str) -> None:
    """The scaled expectation of the closed form equals the expectation of the host."""
    asked = study({"draws": 0}, limit={"of": of}).with_settings(
        [f"flare.geometry={geometry}", "flare.photosphere_temperature_k=5800"]
    )
    question = LimitSearch(Case(asked.at("amplitude", 0.24)), "matched")
    for value in {"magnitude": (6.0, 11.3), "amplitude": (0.02, 0.7), "exposure": (5.0, 35.0)}[of]:
        for scaled, whole in zip(question.scaled(value), question.pair(value), strict=True):
            np.testing.assert_allclose(scaled.signal_dn, whole.signal_dn, rtol=1e-9)
            np.testing.assert_allclose(scaled.variance_dn2, whole.variance_dn2, rtol=1e-9)
            assert scaled.n_frames == whole.n_frames
