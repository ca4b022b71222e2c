"""Distributions from whole numbers: moments, quantiles and tails against NumPy on the same values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mauvecl import layout, reference_sums
from mauvecl.host.errors import InputError
from mauvecl.tally import Distribution, Grid, Tally


def distribution(values: np.ndarray, grid: Grid) -> Distribution:
    tally = Tally([grid])
    histogram, sums = reference_sums.tally(values[None].astype(np.float32), Grid.pack([grid]))
    tally.add(histogram, sums, values.size)
    return tally.distribution(0)


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    return np.random.default_rng(3).chisquare(1643, 200_000)


@pytest.fixture(scope="module")
def found(values: np.ndarray) -> Distribution:
    return distribution(values, Grid(0, 1643.0, np.sqrt(2 * 1643)))


BIN = np.sqrt(2 * 1643) * 2**layout.FINE_BITS / layout.STEPS_PER_SIGMA


def test_moments(values: np.ndarray, found: Distribution) -> None:
    """A fine step is 1/2048 of a standard deviation; its rounding averages out."""
    assert found.mean == pytest.approx(values.mean(), abs=BIN / 200)
    assert found.std == pytest.approx(values.std(), rel=1e-5)


@pytest.mark.parametrize("p", [0.001, 0.5, 0.97])
def test_quantile_intervals_cover(p: float) -> None:
    """300 samples of 2000: at least 268 hold the true quantile, fewer once in 5000 runs of new seeds."""
    rng, grid = np.random.default_rng(9), Grid(0, 0.0, 1.0)
    found = [distribution(rng.normal(size=2000), grid).quantile_interval(p) for _ in range(300)]
    assert sum(q.low <= stats.norm.ppf(p) <= q.high for q in found) >= 268
    assert all(q.low <= q.value <= q.high for q in found)
    assert (
        np.mean([q.high - q.low for q in found]) < 10 * np.sqrt(p * (1 - p) / 2000) / stats.norm.pdf(stats.norm.ppf(p))
        or p == 0.001
    )


def test_a_quantile_beyond_all_values_has_no_end(found: Distribution) -> None:
    assert found.quantile_interval(1e-6).low == -np.inf
    assert found.quantile_interval(1 - 1e-6).high == np.inf
    for p in (0.0, 1.0, np.nan):
        with pytest.raises(InputError, match="quantile at"):
            found.quantile_interval(p)


def test_quantiles(values: np.ndarray, found: Distribution) -> None:
    for p in (0.00135, 0.16, 0.5, 0.84, 0.99865):
        assert found.quantile(p) == pytest.approx(np.quantile(values, p), abs=1.5 * BIN)


def test_counts_beyond_an_edge_are_exact(values: np.ndarray, found: Distribution) -> None:
    index = found.first_bin_with_at_most(200)
    edge = found.edge(index)
    assert found.above(index) == np.sum(values.astype(np.float32) >= edge) <= 200
    assert found.above(index - 1) > 200


def test_far_values_are_counted_at_the_ends() -> None:
    values = np.array([-1e9, 0.0, 0.1, 1e9])
    found = distribution(values, Grid(0, 0.0, 1.0))
    assert found.beyond == 2
    assert found.counts.sum() == 4
    assert found.above(found.counts.size - 1) == 1


def test_picture_bins_hold_every_realisation(values: np.ndarray, found: Distribution) -> None:
    edges, counts = found.histogram(bins=100)
    assert counts.sum() == values.size
    assert len(edges) == len(counts) + 1 <= 101
    direct, _ = np.histogram(values.astype(np.float32), edges)
    # The fine step is rounded, the edge is not: values at the very edge may fall either way.
    assert np.abs(np.cumsum(direct) - np.cumsum(counts)).max() <= 3


def test_moments_of_long_runs_stay_exact() -> None:
    """Sums grow past 64 bits without wrapping."""
    tally = Tally([Grid(0, 0.0, 1.0)])
    sums = np.array([[2**40, 2**62]])
    for _ in range(8):
        tally.add(np.zeros((1, layout.BINS), np.uint32), sums, 2**40)
    found = tally.distribution(0)
    assert found.first == 8 * 2**40
    assert found.second == 2**65
    assert found.mean == 1 / layout.STEPS_PER_SIGMA
