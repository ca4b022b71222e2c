"""Families of flare shapes: integrals of their parts, and fits of all shapes at once."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mauvecl import SHAPES
from mauvecl.observations.event_fits import Mixture
from mauvecl.observations.event_windows import Likelihood
from mauvecl.observations.families import Family, families

GENERAL = Family.general()


def test_prior_weights_add_up_to_one() -> None:
    for searched in SHAPES.values():
        every = families(searched)
        assert sum(one.prior for one in every) == pytest.approx(1.0)
        assert searched.name in [one.name for one in every]


@pytest.mark.parametrize("k", range(0, len(GENERAL.weights), 37))
def test_shapes_have_a_peak_of_one_and_the_integral_of_their_values(k: int) -> None:
    shape = GENERAL.shape(k)
    # Values are differences of the integrals from both ends, which agree.
    tau = np.concatenate([-np.geomspace(1e-6, 12, 4000)[::-1], np.geomspace(1e-6, 150, 8000)])
    up, down = np.diff(shape.before(tau)), -np.diff(shape.after(tau))
    np.testing.assert_allclose(up, down, rtol=1e-5, atol=1e-13)
    at = up / np.diff(tau)
    assert at.max() == pytest.approx(1.0, abs=2e-3)
    assert np.argmax(at) == pytest.approx(np.searchsorted(tau, 0.0), abs=600)
    assert (at >= -1e-8).all()
    assert np.sum(np.diff(tau) * at) == pytest.approx(shape.equivalent_duration, rel=1e-4)
    assert GENERAL.durations[k] == pytest.approx(shape.equivalent_duration, rel=1e-12)


def test_fits_of_all_shapes_are_those_of_each() -> None:
    rng = np.random.default_rng(3)
    n, n_node = 12, 5
    parts = rng.random((len(GENERAL.parts), n_node, n))
    root = rng.standard_normal((n, n))
    likelihood = Likelihood(SimpleNamespace(), root @ root.T, 0.0, np.zeros(n), 0.0, np.zeros(n), 0.0)  # type: ignore[arg-type]
    values = 5 + rng.standard_normal(n)
    slope, information = likelihood.matched(parts, GENERAL.weights, values)
    for k in range(0, len(GENERAL.weights), 29):
        for node in range(n_node):
            model = GENERAL.weights[k] @ parts[:, node]
            assert information[k, node] == pytest.approx(model @ likelihood.inverse @ model, rel=1e-10)
            assert slope[k, node] == pytest.approx(model @ likelihood.inverse @ values, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("mean", [-40.0, -5.0, 0.0, 3.0, 1e4])
def test_quantiles_are_those_of_a_truncated_normal_distribution(mean: float) -> None:
    mixture = Mixture(np.log([0.2, 0.8]), np.full(2, mean), np.full(2, 2.0))
    expected = stats.truncnorm(-mean / 2, np.inf, mean, 2.0)
    for probability in (0.025, 0.16, 0.5, 0.84, 0.975):
        assert mixture.quantile(probability) == pytest.approx(float(expected.ppf(probability)), rel=1e-5)


def test_quantiles_of_a_mixture_are_those_of_its_draws() -> None:
    """The allowed errors are five standard errors of the draws."""
    log_weight, mean, sd = np.log([1.0, 2.0, 3.0]), np.array([-1.0, 2.0, 6.0]), np.array([1.0, 3.0, 0.5])
    rng = np.random.default_rng(5)
    which = rng.choice(3, 400_000, p=np.exp(log_weight) / 6)
    drawn = mean[which] + sd[which] * rng.standard_normal(which.size)
    drawn = drawn[drawn > 0]
    for probability in (0.025, 0.16, 0.5, 0.84, 0.975):
        below = np.mean(drawn < Mixture(log_weight + 3.0, mean, sd).quantile(probability))
        assert abs(below - probability) < 5 * np.sqrt(probability * (1 - probability) / drawn.size)
