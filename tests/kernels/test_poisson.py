"""Poisson draws by alias table: exact probabilities, Pearson tests, extreme words."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mauvecl.device import selftest
from mauvecl.device.engine import Engine
from mauvecl.device.probes import Probes
from mauvecl.device.toy_exposure import toy
from mauvecl.noise import random_numbers, reference
from mauvecl.noise.poisson import SMALLEST_EXPANDED, alias_table, table_set
from mauvecl.noise.scene import prepare

MEANS = [0.0, 0.5, 5.0, 64.0, 2225.0, 22250.0, 222500.0]


@pytest.mark.parametrize("mean", [*MEANS, 1e-9, 0.01, 1.0, 999.5, 1e6, 1e7])
def test_alias_table_has_the_probabilities_of_scipy(mean: float) -> None:
    """Count the words of each outcome exactly and compare with scipy to one word in 2**32."""
    table = alias_table(mean)
    words = table.words_per_column()
    assert words.sum() == 2**32
    counts = table.low + np.arange(words.size)
    np.testing.assert_allclose(words / 2**32, stats.poisson.pmf(counts, mean), rtol=0, atol=2.0**-32 * 1.01)
    # Nothing that matters lies outside the table.
    outside = stats.poisson.cdf(table.low - 1, mean) + stats.poisson.sf(counts[-1], mean)
    assert outside < 2.0**-31


@pytest.mark.parametrize("mean", MEANS)
def test_extreme_words_and_column_edges(probes: Probes, mean: float) -> None:
    table = alias_table(mean)
    share = 2 ** (32 - table.bits)
    starts = np.arange(2**table.bits, dtype=np.int64) * share
    threshold = table.entries.astype(np.int64) & (share - 1)
    words = np.concatenate([starts, starts + share - 1, starts + threshold, starts + np.maximum(threshold - 1, 0)])
    words = np.append(words, np.zeros(-words.size % 16, np.int64)).astype(np.uint32)
    ours = probes.alias(words, table.entries, table.bits)
    np.testing.assert_array_equal(ours, reference.alias_draw(words, table.entries, table.bits))
    # Both sides of every threshold: the column below it, its alias from there on.
    column, alias = words >> np.uint32(32 - table.bits), table.entries >> np.uint32(32 - table.bits)
    below = (words & np.uint32(share - 1)) < threshold[column]
    np.testing.assert_array_equal(ours, np.where(below, column, alias[column]))


def pearson(counts: np.ndarray, low: int, mean: float) -> float:
    """Return the two-sided p-value of Pearson's statistic with scipy's probabilities of low, low + 1, ..."""
    return selftest.pearson(counts, stats.poisson.pmf(low + np.arange(counts.size), mean))


#: Draws of each mean by expansion, and by table.
DRAWS, OF_TABLE = 100_000_000, 10_000_000
EXPANDED = [SMALLEST_EXPANDED, 2225.0, 22250.0, 222500.0]


@pytest.fixture(scope="module")
def drawn(probes_fast: Probes) -> dict[tuple[str, float], np.ndarray]:
    """Count the draws of each value for each mean, by table and by expansion."""
    tables = {mean: alias_table(mean) for mean in MEANS}
    half = {mean: int(10 * np.sqrt(mean)) for mean in EXPANDED}
    counts = {("table", mean): np.zeros(2**table.bits, np.int64) for mean, table in tables.items()}
    counts |= {("expansion", mean): np.zeros(2 * half[mean], np.int64) for mean in EXPANDED}
    rng = np.random.Generator(np.random.Philox(99))
    w = rng.integers(0, 2**32, OF_TABLE, np.uint32)
    for mean, table in tables.items():
        counts["table", mean] += np.bincount(probes_fast.alias(w, table.entries, table.bits), minlength=2**table.bits)
    for _ in range(DRAWS // OF_TABLE):
        w = rng.integers(0, 2**32, (4, OF_TABLE // 4), np.uint32)
        for mean in EXPANDED:
            found = probes_fast.expansion(w[[0, 2]].ravel(), w[[1, 3]].ravel(), mean)
            counts["expansion", mean] += np.bincount(found.ravel() + half[mean], minlength=2 * half[mean])
    return counts


@pytest.mark.long
@pytest.mark.parametrize("mean", MEANS)
def test_pearson_of_the_table(drawn: dict[tuple[str, float], np.ndarray], mean: float) -> None:
    """Pearson's test at 1e7 draws; fails by chance once in 1e6 runs of a new seed.

    Words between the edges that are tested above must give the same counts as the edges. A rounded normal of mean 2225
    gives p < 1e-70 here.
    """
    counts = drawn["table", mean]
    assert counts.sum() == OF_TABLE
    if mean == 0.0:
        assert counts[0] == counts.sum()
    else:
        assert pearson(counts, alias_table(mean).low, mean) > 1e-6


@pytest.mark.long
@pytest.mark.parametrize("mean", EXPANDED)
def test_pearson_of_the_expansion(drawn: dict[tuple[str, float], np.ndarray], mean: float) -> None:
    """The same at 1e8 draws from the expansion. A rounded normal of mean 2225 gives p < 1e-100 here."""
    counts = drawn["expansion", mean]
    assert counts.sum() == DRAWS
    assert pearson(counts, round(mean) - int(10 * np.sqrt(mean)), mean) > 1e-6


def draws_to_tell(mean: float, offset: float, slope: float, cubic: float) -> float:
    """Return the number of draws after which Pearson's test detects the expansion at five sigma."""
    half = int(9 * np.sqrt(mean))
    n = np.arange(-half, half + 1) + round(mean)
    z = np.linspace(-8.9, 8.9, 400_001)
    drawn = round(mean) + offset + z * (slope + z * (1 / 6 + z * cubic))
    at = np.interp(np.append(n, n[-1] + 1) - 0.5, drawn, z)
    q = np.where(at[1:] < 0, np.diff(stats.norm.cdf(at)), -np.diff(stats.norm.sf(at)))
    p = stats.poisson.pmf(n, mean)
    common = p > 1e-14
    return float(5 * np.sqrt(2 * common.sum()) / np.sum((p - q)[common] ** 2 / p[common]))


@pytest.mark.parametrize("mean", [SMALLEST_EXPANDED, 2225.0, 22250.0, 1e6])
def test_expansion_cannot_be_distinguished_from_exact_draws(mean: float) -> None:
    """Check the device's expansion; without its last term, 2e10 draws of a mean of 1000 would show it."""
    scene = prepare([toy(4, 1, dark=mean)], recipe="apart")
    (source,) = scene.dark_counts[:1]
    assert source["bits"] == 0
    given = (float(source["offset"]), float(source["slope"]), float(source["cubic"]))
    assert draws_to_tell(mean, *given) > 1e13
    if mean < 1e5:  # beyond, what is left is the coefficients' own float32
        assert draws_to_tell(mean, *given[:2], 0.0) < 1e-2 * draws_to_tell(mean, *given)


@pytest.mark.parametrize("mean", [SMALLEST_EXPANDED, 2225.0, 22250.0])
def test_rounded_normal_fails(mean: float) -> None:
    """Check that the test above fails for a rounded normal and without the last term."""
    half = int(10 * np.sqrt(mean))
    n = np.arange(-half, half)
    rounded = np.diff(stats.norm.cdf(np.append(n, half) - 0.5, 0.0, np.sqrt(mean)))
    assert pearson(np.rint(1e8 * rounded).astype(np.int64), round(mean) - half, mean) < 1e-6


def test_expansion_equals_the_reference(probes: Probes) -> None:
    mean = 2225.0
    w = np.array(reference.words_at(np.arange(4096), 0, "dark", 1, 5))
    z = random_numbers.normal_pair(w[0], w[1])
    root = np.sqrt(mean)
    coefficients = [np.float32(c) for c in (-1 / 6, root - 1 / (36 * root), -1 / (72 * root))]
    twin = [reference.expansion_draw(row, *coefficients) for row in z]
    np.testing.assert_array_equal(probes.expansion(w[0], w[1], mean), twin)


@pytest.fixture(scope="session")
def probes_fast(engine: Engine) -> Probes:
    return Probes(device=engine.open_device)


def test_moments_of_the_table() -> None:
    """Compare mean, variance, skewness and kurtosis from the exact word counts."""
    for mean in (5.0, 2225.0, 22250.0):
        table = alias_table(mean)
        p = table.words_per_column() / 2**32
        x = table.low + np.arange(p.size) - mean
        moments = [np.sum(p * x**k) for k in (1, 2, 3, 4)]
        # 2**-32 a column over some ten standard deviations.
        sigma = np.sqrt(mean)
        assert abs(moments[0]) < 1e-7 * sigma
        np.testing.assert_allclose(moments[1:], [mean, mean, mean + 3 * mean**2], rtol=0, atol=1e-5 * sigma**4)
        np.testing.assert_allclose(moments[1], mean, rtol=1e-6)


def test_equal_means_share_a_table() -> None:
    there = [alias_table(7.0)]
    found, starts = table_set([5.0, 64.0, 5.0], there)
    assert found[0] is found[2] is there[1]
    assert found[1] is there[2]
    assert len(there) == 3
    size = [t.entries.size for t in there]
    assert starts == [size[0], size[0] + size[1], size[0]]


@pytest.mark.parametrize("mean", [-1.0, np.nan, np.inf, 1e9])
def test_impossible_means_raise(mean: float) -> None:
    with pytest.raises(ValueError, match="Poisson mean"):
        alias_table(mean)
