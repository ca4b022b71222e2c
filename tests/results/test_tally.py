"""Distributions from whole numbers: moments, quantiles and tails against NumPy on the same values."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from marks import long_but
from refusals import refused
from scipy import stats

from mauvecl.noise import layout
from mauvecl.results import numpy_kernels
from mauvecl.results.counts.tally import Distribution, Grid, Tally
from mauvecl.results.detection.roc import Roc


def distribution(values: np.ndarray, grid: Grid) -> Distribution:
    tally = Tally([grid])
    values = values.astype(np.float32)
    histogram, sums, outside = numpy_kernels.tally(values[None], tally.packed)
    tally.add(histogram, sums, values.size)
    assert tally.add_far(0, values) == outside[0]
    return tally.distribution(0)


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    return np.random.default_rng(3).chisquare(1643, 200_000)


@pytest.fixture(scope="module")
def found(values: np.ndarray) -> Distribution:
    return distribution(values, Grid(0, 1643.0, np.sqrt(2 * 1643)))


BIN = np.sqrt(2 * 1643) * 2**layout.FINE_BITS / layout.STEPS_PER_SIGMA


def test_moments_equal_those_of_the_values(values: np.ndarray, found: Distribution) -> None:
    """Compare moments on fine steps of 1/2048 of a standard deviation, whose rounding averages out."""
    assert found.mean == pytest.approx(values.mean(), abs=BIN / 200)
    assert found.std == pytest.approx(values.std(), rel=1e-5)


@pytest.mark.parametrize("p", [0.001, 0.5, 0.97])
def test_quantile_intervals_have_nominal_coverage(p: float) -> None:
    """Check that 268 of 300 intervals contain the true quantile; fails once in 5000 new seeds."""
    rng, grid = np.random.default_rng(9), Grid(0, 0.0, 1.0)
    found = [distribution(rng.normal(size=2000), grid).quantile_interval(p) for _ in range(300)]
    assert sum(q.low <= stats.norm.ppf(p) <= q.high for q in found) >= 268
    assert all(q.low <= q.value <= q.high for q in found)
    assert (
        np.mean([q.high - q.low for q in found]) < 10 * np.sqrt(p * (1 - p) / 2000) / stats.norm.pdf(stats.norm.ppf(p))
        or p == 0.001
    )


def test_quantile_beyond_all_values_has_an_open_interval(found: Distribution) -> None:
    assert found.quantile_interval(1e-6).low == -np.inf
    assert found.quantile_interval(1 - 1e-6).high == np.inf
    for p in (0.0, 1.0, np.nan):
        with refused("probability"):
            found.quantile_interval(p)


def test_quantiles_equal_those_of_sorting(values: np.ndarray, found: Distribution) -> None:
    for p in (0.00135, 0.16, 0.5, 0.84, 0.99865):
        assert found.quantile(p) == pytest.approx(np.quantile(values, p), abs=1.5 * BIN)


def test_counts_beyond_an_edge_are_exact(values: np.ndarray, found: Distribution) -> None:
    edge = found.edge_with_at_most(200)
    assert found.above(edge) == np.sum(values.astype(np.float32) >= edge) <= 200
    assert found.above(edge - BIN) > 200
    assert (found.above(-np.inf), found.above(np.inf)) == (values.size, 0)
    assert found.edge_with_at_most(values.size) == -np.inf


#: What no fine grid reaches, with every sign and exponent, and what lies next to its ends.
FLOATS = np.frombuffer(np.random.default_rng(6).bytes(80_000), np.float32)
FAR = {
    "every float": np.concatenate(
        [FLOATS[np.isfinite(FLOATS)], [0.0, -0.0, 1e-45, -1e-45, 3.4028235e38, -3.4028235e38]]
    ),
    "around the ends": np.random.default_rng(7).uniform(-40, 40, 40_000),
    "one side": np.random.default_rng(8).lognormal(4, 1, 20_000),
    "near a far value": np.random.default_rng(9).normal(-1e6, 30.0, 20_000),
    "all equal": np.full(5000, 77.7),
}
GRIDS = {
    "unit": Grid(0, 0.0, 1.0),
    "far and narrow": Grid(0, -1e6, 1.0),
    "no float32 steps": Grid(0, 0.0, 1e50),
    "none so small": Grid(0, 0.0, 1e-300),
    "a far centre": Grid(0, 1e300, 1.0),
    "tiny": Grid(0, 3.0, 1e-30),
}


def bin_of(value: float, grid: Grid) -> float:
    """Return the largest width of a bin around a value: 1/512 of a standard deviation, or 2**-13 of the value."""
    return max(4 / 2048 * grid.sigma if grid.sigma < 1e30 else 0.0, abs(value) * 2.0**-13, 1e-40)


@pytest.mark.parametrize(("far", "on"), long_but(product(FAR, GRIDS), *zip(FAR, GRIDS, strict=False)))
def test_numbers_agree_with_sorting_for_any_float(far: str, on: str) -> None:
    """Compare moments, counts, thresholds and quantiles of any float32 on any grid with sorting and exact sums."""
    values, grid = FAR[far].astype(np.float32), GRIDS[on]
    found, ordered = distribution(values, grid), np.sort(values.astype(float))
    n = values.size
    lower, upper, counts = found.bins
    assert counts.sum() == n
    assert (lower < upper).all()
    assert (upper[:-1] <= lower[1:]).all()
    # Rounding in float32 at the grid's far places, and a fine step.
    scale = max(abs(grid.centre) if abs(grid.centre) < 1e30 else 0.0, grid.sigma if grid.sigma < 1e30 else 0.0)
    slack = 1e-6 * scale + 1e-12
    for share in (0.0004, 0.01, 0.3, 0.5, 0.9, 0.999):
        k = int(share * n)
        cut, exact = found.edge_with_at_most(k), ordered[n - 1 - k]
        assert exact - slack <= cut <= exact + bin_of(exact, grid) + slack
        assert abs(found.above(cut) - np.sum(ordered >= cut)) <= np.sum(np.abs(ordered - cut) <= slack)
        between = found.above(exact)
        assert np.sum(ordered > exact + bin_of(exact, grid) + slack) <= between
        assert between <= np.sum(ordered >= exact - bin_of(exact, grid) - slack)
        q = found.quantile(share)
        low, high = ordered[max(int(share * n) - 1, 0)], ordered[min(int(share * n) + 1, n - 1)]
        assert low - bin_of(low, grid) - slack <= q <= high + bin_of(high, grid) + slack
    wide = [Fraction(float(x)) for x in values]
    mean = sum(wide) / n
    variance = sum(x * x for x in wide) / n - mean**2
    fine = grid.sigma / 2048 if grid.sigma < 1e30 else 0.0
    assert found.mean == pytest.approx(float(mean), rel=1e-7, abs=fine / 50 + slack)
    assert found.std == pytest.approx(math.sqrt(variance), rel=1e-6, abs=fine + slack)
    edges, heights = found.histogram(50)
    assert heights.sum() == n
    assert (heights >= 0).all()
    assert len(edges) == len(heights) + 1 <= 51
    np.testing.assert_allclose(np.diff(edges), np.diff(edges)[0], rtol=1e-6, atol=4 * slack)


def test_nan_is_refused() -> None:
    """Count NaN, and refuse numbers that depend on them."""
    found = distribution(np.array([0.0, np.nan, np.inf, -np.inf, 1.0, 1e9]), Grid(0, 0.0, 1.0))
    assert (found.far.undefined, found.far.n, found.counts.sum()) == (3, 1, 2)
    for read in (
        lambda: found.mean,
        lambda: found.std,
        lambda: found.above(0.5),
        lambda: found.edge_with_at_most(1),
        lambda: found.quantile(0.5),
        lambda: found.quantile_interval(0.5),
        lambda: found.histogram(),
        lambda: Roc.of(found, found),
    ):
        with refused("statistic", "3", "6"):
            read()


def test_order_and_splitting_change_nothing() -> None:
    """Add the same values backwards and in uneven pieces; all counts and both exact sums agree."""
    values, grid = FAR["every float"].astype(np.float32), GRIDS["unit"]
    whole, parts = Tally([grid]), Tally([grid])
    whole.add_far(0, values)
    for piece in np.split(values[::-1], [1, 7, 5000, 5001]):
        parts.add_far(0, piece)
    ours, theirs = whole.far[0].frozen(), parts.far[0].frozen()
    assert ours.equals(theirs)
    inside = np.abs(np.rint(values.astype(float) * 2048) + 0.5) < 65532
    assert ours.first == sum(Fraction(float(x)) for x in values[~inside]) * 2**149
    assert ours.second == sum(Fraction(float(x)) ** 2 for x in values[~inside]) * 2**298


def test_picture_bins_contain_every_realisation(values: np.ndarray, found: Distribution) -> None:
    edges, counts = found.histogram(bins=100)
    assert counts.sum() == values.size
    assert len(edges) == len(counts) + 1 <= 101
    direct, _ = np.histogram(values.astype(np.float32), edges)
    # The fine step is rounded, the edge is not: values at the very edge may fall either way.
    assert np.abs(np.cumsum(direct) - np.cumsum(counts)).max() <= 3


def test_moments_of_long_runs_stay_exact() -> None:
    """Let sums grow past 64 bits without overflow."""
    tally = Tally([Grid(0, 0.0, 1.0)])
    sums = np.array([[2**40, 2**62]])
    for _ in range(8):
        tally.add(np.zeros((1, layout.BINS), np.uint32), sums, 2**40)
    found = tally.distribution(0)
    assert found.first == 8 * 2**40
    assert found.second == 2**65
    assert found.mean == 1 / layout.STEPS_PER_SIGMA
