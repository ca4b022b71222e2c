"""Poisson draws by alias table and expansion: exact probabilities, extreme words."""

import exact
import numpy as np
import pytest
from probes import Probes
from scenes import prepare
from scipy import stats

from mauvecl.device import selftest
from mauvecl.noise import layout, reference

#: From this mean on, counts are drawn by an expansion.
SMALLEST_EXPANDED = 1000.0
MEANS = [0.0, 0.5, 5.0, 64.0, 2225.0, 22250.0, 222500.0]


@pytest.mark.parametrize("mean", [*MEANS, 1e-9, 0.01, 1.0, 999.5, 1e6, 1e7])
def test_alias_table_has_the_probabilities_of_scipy(mean: float) -> None:
    """Count the words of each outcome exactly and compare with scipy to one word in 2**32."""
    table = layout.alias_table(mean)
    shift, entries = 32 - table.bits, table.entries.astype(np.int64)
    threshold = entries & ((1 << shift) - 1)
    words = threshold.copy()
    np.add.at(words, entries >> shift, (1 << shift) - threshold)
    assert words.sum() == 2**32
    counts = table.low + np.arange(words.size)
    np.testing.assert_allclose(words / 2**32, stats.poisson.pmf(counts, mean), rtol=0, atol=2.0**-32 * 1.01)
    # Nothing that matters lies outside the table.
    outside = stats.poisson.cdf(table.low - 1, mean) + stats.poisson.sf(counts[-1], mean)
    assert outside < 2.0**-31


@pytest.mark.parametrize("mean", MEANS)
def test_extreme_words_and_column_edges(probes: Probes, mean: float) -> None:
    table = layout.alias_table(mean)
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


@pytest.mark.parametrize("mean", [SMALLEST_EXPANDED, 2225.0, 22250.0, 1e6])
def test_expansion_cannot_be_distinguished_from_exact_draws(mean: float) -> None:
    """Check the device's expansion; without its last term, 2e10 draws of a mean of 1000 would show it."""
    (source,) = prepare([selftest.toy(4, 1, dark=mean)], recipe="apart").dark_counts[:1]
    assert source["bits"] == 0
    half, slope = int(9 * np.sqrt(mean)), float(source["slope"])
    low, size = round(mean) - half, 2 * half

    def needed(cubic: float) -> float:
        shape = np.array([float(source["offset"]), slope, 1 / 6, cubic]) / slope
        q = exact.of_polynomial(shape, slope, round(mean), low, size)
        return exact.draws_to_tell(stats.poisson.pmf(low + np.arange(size), mean), q)

    assert needed(float(source["cubic"])) > 1e13
    if mean < 1e5:  # beyond, what is left is the coefficients' own float32
        assert needed(0.0) < 1e-2 * needed(float(source["cubic"]))


def test_equal_means_share_a_table() -> None:
    alike, other = (
        prepare([exact.flat(4, 1, read=0.7, dark=np.array(means))], recipe="apart")
        for means in ([5.0, 5.0, 5.0, 5.0], [5.0, 64.0, 5.0, 64.0])
    )
    assert alike.tables.size == layout.alias_table(5.0).entries.size
    assert other.tables.size == alike.tables.size + layout.alias_table(64.0).entries.size
    assert other.dark_counts["table"][:4].tolist() == [0, alike.tables.size] * 2
