"""Closed forms against scipy's exact distributions and plain simulation; intervals against their definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mauvecl.statistics import Normal, QuadraticForm, clopper_pearson


@pytest.mark.parametrize("n", [10, 48, 1643])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_equal_weights_are_a_scaled_non_central_chi_squared(n: int, scale: float) -> None:
    """scipy's ncx2 is another method (Boost); weights of 1 + 1e-12 keep ours from handing over to it."""
    shift = np.linspace(-0.5, 0.7, n)
    form = QuadraticForm(np.full(n, scale * (1 + 1e-12)), shift)
    exact = stats.ncx2(n, np.sum(shift**2), scale=scale)
    assert form.mean == pytest.approx(exact.mean())
    assert form.std == pytest.approx(exact.std())
    for p in (0.999999, 0.99, 0.5, 1e-2, 1e-4, 1e-6, 1e-9):
        assert form.sf(float(exact.isf(p))) == pytest.approx(p, rel=1e-4, abs=1e-13)


def test_unit_weights_are_handed_to_scipy() -> None:
    assert QuadraticForm(np.ones(30), np.zeros(30)).isf(1e-3) == stats.chi2.isf(1e-3, 30)
    form = QuadraticForm(np.ones(30), np.full(30, 0.3))
    assert form.sf(40.0) == pytest.approx(stats.ncx2.sf(40.0, 30, 30 * 0.09), rel=1e-12)


def test_two_weights_with_a_closed_form() -> None:
    """Pairs of equal weights make exponentials: a hypoexponential tail, exact."""
    a, b = 1.0, 3.0
    form = QuadraticForm(np.array([a, a, b, b]), np.zeros(4))
    for x in (0.5, 5.0, 20.0, 60.0):
        exact = (b * np.exp(-x / (2 * b)) - a * np.exp(-x / (2 * a))) / (b - a)
        assert form.sf(x) == pytest.approx(exact, rel=1e-6)


def test_unequal_weights_against_simulation() -> None:
    """A fixed seed; 5 standard errors at 4e5, so one chance failure in 3e5 seeds for the five values."""
    generator = np.random.default_rng(77)
    weight, shift = generator.uniform(0.8, 1.4, 60), generator.normal(0, 0.5, 60)
    form = QuadraticForm(weight, shift)
    draws = ((generator.standard_normal((400_000, 60)) + shift) ** 2) @ weight
    for p in (0.9, 0.5, 0.1, 1e-2, 1e-3):
        x = form.isf(p)
        assert abs(np.mean(draws > x) - p) < 5 * np.sqrt(p * (1 - p) / draws.size)


def test_quantiles_invert_probabilities() -> None:
    form = QuadraticForm(np.linspace(0.5, 2.0, 100), np.linspace(0.0, 1.0, 100))
    for distribution in (form, Normal(2.0, 3.0)):
        for p in (0.9, 0.1, 1e-3, 1e-6):
            assert distribution.sf(distribution.isf(p)) == pytest.approx(p, rel=1e-5)


@pytest.mark.parametrize(("k", "n"), [(0, 10), (10, 10), (3, 10), (1000, 1_000_000)])
def test_clopper_pearson_is_scipys_exact_interval(k: int, n: int) -> None:
    ours, theirs = clopper_pearson(k, n), stats.binomtest(k, n).proportion_ci(method="exact")
    assert ours.value == k / n
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=1e-9)
