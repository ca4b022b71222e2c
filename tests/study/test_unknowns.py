"""Averages over unknown instrument values, and their importance."""

from functools import cache
from itertools import permutations
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from scenes import study_of_g2v
from scipy import special, stats

from mauvecl import Engine, Instrument, Study, detect, limit
from mauvecl import map as detection_map

ALL = ("temperature_c", "light_loss", "pointing_loss", "qe_scale", "conversion_uv_per_electron", "read_noise_dn")


def study(unknowns: dict[str, Any], **changes: Any) -> Study:
    return study_of_g2v(run={"realisations": 40_000}, unknowns={"draws": 8} | unknowns, **changes)


def assert_shares_are_those_of_a_linear_model(unknown: Any) -> None:
    """Add the unknowns to a linear fit in each of 720 orders, and average what each adds to the explained variance."""
    x, y = stats.zscore(unknown.draws.values), unknown.limits

    @cache
    def explained(some: frozenset[int]) -> float:
        fitted = np.column_stack([x[:, sorted(some)], np.ones(len(y))])
        left = y - fitted @ np.linalg.lstsq(fitted, y, rcond=None)[0]
        return 1.0 - left.var() / y.var()

    orders = list(permutations(range(len(ALL))))
    wanted = np.zeros(len(ALL))
    for order in orders:
        for place, k in enumerate(order):
            before = frozenset(order[:place])
            wanted[k] += (explained(before | {k}) - explained(before)) / len(orders)
    found = dict(unknown.shares)
    assert found.pop("the rest") == pytest.approx(1.0 - wanted.sum())
    assert list(found.values()) == sorted(found.values(), reverse=True)
    np.testing.assert_allclose([found[name] for name in ALL], wanted, rtol=1e-9)


@pytest.mark.long
def test_limit_over_unknowns_has_the_power_on_average(engine: Engine) -> None:
    """The mean of the closed form is the power; worse instruments have brighter limits; one unknown explains most."""
    averaged = limit(study({"draws": 24}), engine)
    (found,) = averaged.limits
    unknown, draws = found.unknown, found.unknown.draws
    assert draws.names == ALL
    values = dict(zip(draws.names, draws.values.T, strict=True))
    # The sample is a Latin hypercube: every 24th of each prior once.
    even = {"temperature_c": stats.uniform(13, 8), "pointing_loss": stats.uniform(0, 0.05),
            "light_loss": stats.truncnorm(-3, 3, loc=0.34, scale=0.1)}  # fmt: skip
    for name, prior in even.items():
        np.testing.assert_array_equal(np.sort(np.floor(24 * prior.cdf(values[name]))), np.arange(24))
    one, nominal = draws.studies[7].observation.load_instrument(), Instrument.load("mauvesim")
    for name in ("temperature_c", "light_loss", "pointing_loss", "conversion_uv_per_electron", "read_noise_dn"):
        assert getattr(one, name) == values[name][7]
    assert one.collecting_area_cm2 == pytest.approx(values["qe_scale"][7] * nominal.collecting_area_cm2)
    few = {"realisations": 10_000, "fap": 1e-2, "statistics": ["matched"]}
    at_limit = [one.at("magnitude", found.closed_form).with_changes({"run": few}, None) for one in draws.studies]
    each = [float(detect(one, engine).table["closed_form_probability"][0]) for one in at_limit]
    assert np.mean(each) == pytest.approx(0.9, abs=2e-3)
    assert found.verdict in ("confirms it", "")
    low, high = unknown.range
    assert low < found.value.value < high
    # The limit must hold for most instruments and is therefore brighter than the median.
    assert found.closed_form < np.median(unknown.limits)
    assert np.corrcoef(values["qe_scale"], unknown.limits)[0, 1] > 0.6
    assert averaged.table["matters_most"][0] == next(iter(unknown.shares)) == "qe_scale"
    limits = [averaged.table[name] for name in ("unknown_low", "unknown_high", "magnitude")]
    assert limits[0][0] < limits[1][0]
    assert {column.unit for column in (*limits, averaged.draws["magnitude"])} == {u.mag}
    np.testing.assert_array_equal(averaged.draws["qe_scale"], values["qe_scale"])
    assert_shares_are_those_of_a_linear_model(unknown)


def test_prior_of_zero_width_changes_nothing(engine: Engine) -> None:
    """A prior of zero width gives the limit of the nominal instrument, and no draw if all values are known."""
    sure = {"light_loss": {"uniform": [0.34, 0.34]}, "known": [name for name in ALL if name != "light_loss"]}
    first, second = (limit(study(given), engine) for given in (sure | {"draws": 2}, {"draws": 0}))
    (one,), (two,) = first.limits, second.limits
    assert [one.views[0].title.rpartition(" test, ")[2] for one in (first, second)] == [
        "20,000 realisations of each draw",
        "40,000 realisations",
    ]
    assert first.table["matters_most"].tolist() == [""], "nothing moves the limit"
    assert one.closed_form == pytest.approx(two.closed_form, abs=1e-4)
    assert one.unknown.range == pytest.approx((two.closed_form, two.closed_form), abs=1e-4)
    assert abs(one.value.value - two.value.value) < 0.03


def test_map_is_the_mean_of_its_draws(engine: Engine) -> None:
    """The interval holds the error of each draw and of few draws, cut at 0 and 1; a constant has no share."""
    axes = {
        "x": {"quantity": "magnitude", "values": [7.0, 10.5]},
        "y": {"quantity": "amplitude", "values": [0.1, 0.24]},
    }
    asked = study({"draws": 4, "known": ALL[2:], "light_loss": {"uniform": [0.25, 0.25]}}, map=axes)
    found = detection_map(asked, engine)
    each = [detection_map(one, engine) for one in limit(asked, engine).limits[0].unknown.draws.studies]
    values = np.array([one.probability for one in each])
    np.testing.assert_allclose(found.probability, values.mean(axis=0))
    own = np.array([one.high - one.low for one in each]) / 2
    reach = special.ndtri(0.975) * values.std(axis=0, ddof=1) / 2
    half = np.hypot(reach, np.sqrt(np.sum(own**2, axis=0)) / 4)
    np.testing.assert_allclose(found.low, np.maximum(found.probability - half, 0.0))
    np.testing.assert_allclose(found.high, np.minimum(found.probability + half, 1.0))
    # A prior of zero width explains nothing.
    assert set(found.shares["matched"]) == {*ALL[:2], "the rest"}
    assert 0.0 <= found.shares["matched"]["light_loss"] < 1e-12


def test_values_of_the_study_are_not_drawn(engine: Engine) -> None:
    stated = study({"draws": 2}, observation={"temperature_c": 15.0, "changes": {"light_loss": 0.3}})
    unknown = limit(stated, engine).limits[0].unknown
    assert unknown.draws.names == ALL[2:]
    for one in unknown.draws.studies:
        instrument = one.observation.load_instrument()
        assert (instrument.temperature_c, instrument.light_loss) == (15.0, 0.3)


@pytest.mark.parametrize("of", ["magnitude", "amplitude", "exposure"])
@pytest.mark.parametrize("geometry", ["added", "replaces"])
def test_closed_form_of_a_detection_at_the_limit_is_the_power(of: str, geometry: str, engine: Engine) -> None:
    """The search scales expectations, the detection makes them anew; an exposure is the first frame that suffices."""
    asked = study({"draws": 0}, limit={"of": of}).with_settings(
        [f"flare.geometry={geometry}", "flare.photosphere_temperature_k=5800", "star.0.magnitude=12"]
    )
    (found,) = limit(asked, engine).limits

    def probability(value: float) -> float:
        one = asked.at(of, value).with_settings(["run.realisations=10000"])
        return float(detect(one, engine).table["closed_form_probability"][0])

    if of == "exposure":
        assert probability(found.closed_form) >= 0.9 > probability(found.closed_form - 5.0)
    else:
        assert probability(found.closed_form) == pytest.approx(0.9, abs=2e-4)
