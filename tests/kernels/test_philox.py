"""Philox against known answers, Box-Muller against float64, both with the reference's bits, and the memory layout."""

from fractions import Fraction

import numpy as np
import pytest
import randomgen
from probes import Probes
from scipy import special, stats

from mauvecl import Engine
from mauvecl.device import selftest
from mauvecl.noise import layout, reference


def test_philox_gives_the_known_answers(probes: Probes) -> None:
    """Compare kernels and reference with Random123's vectors and with the words of an independent implementation."""
    generator, known = np.random.default_rng(20_261), len(selftest.PHILOX_VECTORS)
    counters, keys = (generator.integers(0, 2**32, (5000, n), dtype=np.uint32) for n in (4, 2))
    counters[:known], keys[:known], answers = zip(*selftest.PHILOX_VECTORS, strict=True)
    ours = probes.philox(counters, keys)
    np.testing.assert_array_equal(ours[:known, :4], answers)
    np.testing.assert_array_equal(ours[:, :4], ours[:, 4:], err_msg="the loop-invariant form")
    for counter, key, words in zip(counters[:200], keys, ours[:, :4], strict=False):
        number = sum(int(word) << (32 * i) for i, word in enumerate(counter))
        key_number = int(key[1]) << 32 | int(key[0])
        np.testing.assert_array_equal(np.array(reference.philox(counter, key_number)), words)
        # It increments its counter before use.
        oracle = randomgen.Philox(counter=(number - 1) % 2**128, key=key_number, number=4, width=32)
        np.testing.assert_array_equal(words, oracle.random_raw(4).astype(np.uint32))


def test_every_offset_on_the_device(probes: Probes) -> None:
    expected = []
    for dtype in layout.STRUCTS.values():
        expected += [offset for _, offset in dtype.fields.values()] + [dtype.itemsize]
    out = probes.run("probe_layout", 1, np.zeros(len(expected), np.uint32))
    np.testing.assert_array_equal(out, expected)


#: Words at every end of every branch: zeros, ones, signs, quadrants, the split of the logarithm.
EDGES = np.array(
    [0, 1, 2, 3, 2**16, 2**23, 2**24 - 1, 2**24, 2**24 + 1, 2**30, 2**31 - 1, 2**31, 2**31 + 1, 3 * 2**30]
    + [2**32 - 2**8, 2**32 - 2, 2**32 - 1, 0xB504F333, 0xB504F334, 0x5A827999],
    np.uint32,
)


def test_normals_have_a_bounded_error_and_the_bits_of_the_reference(probes: Probes) -> None:
    ends = np.array([grid.ravel() for grid in np.meshgrid(EDGES, EDGES)])
    extra = np.random.default_rng(5).integers(0, 2**32, (2, 2**18 - ends.shape[1]), dtype=np.uint32)
    radius, angle = np.hstack([ends, extra])
    z = probes.normal(radius, angle)
    twin = np.stack(reference.normal_pair(radius, angle))
    np.testing.assert_array_equal(z.view(np.uint32), twin.view(np.uint32))
    # The word as float32 has it, 24 bits: what the kernel defines, not an error of its arithmetic.
    t = radius.astype(np.float32) + np.float32(0.5)
    r = np.sqrt(-2.0 * np.log(t.astype(np.float64) / 2**32))
    # The top bit turns by pi; the rest run over [-pi/2, pi/2) from 0 up, then from -pi/2.
    half = np.mod(2.0 * np.pi * angle.astype(np.float64) / 2**32, np.pi)
    half = np.where(half >= np.pi / 2, half - np.pi, half)
    sign = np.where(angle >= 2**31, -1.0, 1.0)
    exact = np.stack([sign * r * np.cos(half), sign * r * np.sin(half)])
    # A few float32 roundings of values below 7.
    np.testing.assert_allclose(z.astype(np.float64), exact, rtol=0, atol=1.2e-6)
    assert np.isfinite(z).all()
    assert 6.75 < np.abs(z).max() < 6.77


@pytest.mark.long
def test_every_word_is_finite(engine: Engine) -> None:
    """Try all 2**32 radius words with angles at two ends of the sine's range."""
    probes = Probes(device=engine.open_device)
    items, per_item = 2**14, 2**18
    for angle in (0, 2**31 - 1):
        ends = np.empty((items, 2, probes.width), np.float32)
        bad = np.empty((items, probes.width), np.uint32)
        probes.run("probe_every_word", items, bad, np.uint32(per_item), np.uint32(angle), out_first=ends)
        assert bad.sum() == 0
        reach = np.abs(ends).max()
        assert 6.75 < reach < 6.77


@pytest.mark.long
def test_thousand_million_draws(engine: Engine) -> None:
    """Pearson, Kolmogorov-Smirnov and tails to six sigma at 1e9; each fails by chance once in 1e6 new seeds."""
    probes = Probes(device=engine.open_device)
    items, groups = 4096, 3815
    counts = np.zeros((items, 4096), np.uint32)
    probes.run("probe_histogram", items, counts, np.uint32(77), np.uint32(groups), start=counts)
    found = counts.sum(axis=0, dtype=np.int64)
    n = int(found.sum())
    assert n == items * groups * 4 * probes.width > 1e9 - 1e6
    edges = np.arange(4097) / 256 - 8
    expected = n * np.where(edges[1:] <= 0, np.diff(special.ndtr(edges)), -np.diff(special.ndtr(-edges)))
    common = expected > 20
    statistic = np.sum((found - expected)[common] ** 2 / expected[common])
    rare = found[~common].sum(), expected[~common].sum()
    statistic += (rare[0] - rare[1]) ** 2 / rare[1]
    assert 1e-6 < stats.chi2.cdf(statistic, common.sum()) < 1 - 1e-6
    distance = np.abs(np.cumsum(found) / n - special.ndtr(edges[1:])).max()
    assert stats.kstwobign.sf(distance * np.sqrt(n)) > 1e-6
    for sigma in (1, 2, 3, 4, 5, 6):
        below, above = found[edges[1:] <= -sigma].sum(), found[edges[:-1] >= sigma].sum()
        for tail in (below, above):
            p = stats.binom.cdf(tail, n, special.ndtr(-sigma)), stats.binom.sf(tail - 1, n, special.ndtr(-sigma))
            assert min(p) > 1e-6


def test_fused_multiply_add_rounds_once() -> None:
    """Compare the reference's float32 fma with exact rational arithmetic."""
    generator = np.random.default_rng(8)
    a, b, c = generator.standard_normal((3, 2000)).astype(np.float32)
    # Sums next to a tie of float32, where rounding twice goes wrong.
    a[:500], b[:500] = 1 + 2.0**-23, 1 + 2.0**-12 * generator.integers(0, 4, 500)
    c[:500] = 2.0 ** generator.integers(-60, 30, 500)
    ours = reference.fma(a, b, c)
    for x, y, z, result in zip(a, b, c, ours, strict=True):
        exact = Fraction(float(x)) * Fraction(float(y)) + Fraction(float(z))
        around = [float(np.nextafter(result, np.float32(s))) for s in (-np.inf, np.inf)]
        error = abs(Fraction(float(result)) - exact)
        assert all(error <= abs(Fraction(neighbour) - exact) for neighbour in around)
