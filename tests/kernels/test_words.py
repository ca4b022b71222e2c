"""From words to draws, against what is exact: Philox, normals, Poisson counts, priors, and the joint draw."""

from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

import exact
import numpy as np
import pytest
import randomgen
from probes import Probes
from refusals import refused
from scenes import instrument, prepare, star
from scipy import optimize, special, stats

from mauvecl import Engine, Expectation, InputError, Normal, Processes, Uniform
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


Prior = Normal | Uniform
CONDITIONS = {"temperature_c": 21.0, "dark_slope_per_c": 0.0684, "light_loss": 0.34, "pointing_loss": 0.02}
PRIORS = [
    ("qe_scale", Normal(1.0, 0.01, 0.5, 1.5)),  # cut at 50 sd
    ("qe_scale", Normal(1.0, 1e-6, 0.5, 1.5)),  # narrower than float32 near one
    ("qe_scale", Normal(50.0, 1e-5, 40.0, 60.0)),  # far from one
    ("qe_scale", Normal(1.0, 0.3, 0.4, 1.6)),
    ("qe_scale", Normal(0.5, 0.1, 0.5, 5.0)),  # half a normal
    ("qe_scale", Normal(0.1, 0.03, 1.0, 5.0)),  # cut 30 sd away, an exponential
    ("qe_scale", Normal(90.0, 0.001, 0.5, 1.5)),  # and 88 500 sd on the other side
    ("qe_scale", Normal(1.0, 100.0, 0.99, 1.01)),  # flat between the cuts
    ("qe_scale", Uniform(0.5, 1.5)),
    ("qe_scale", Uniform(1.0, 1.0 + 1e-7)),
    ("light_loss", Normal(0.34, 0.01, 0.1, 0.6)),
    ("light_loss", Uniform(0.24, 0.44)),
    ("pointing_loss", Normal(0.0, 0.02, 0.0, 0.5)),
    ("pointing_loss", Uniform(0.0, 0.99)),
    ("jitter", Uniform(0.0, 0.05)),
    ("jitter", Normal(0.02, 0.001, 0.0, 0.5)),
    ("detector_temperature", Uniform(13.0, 21.0)),
    ("detector_temperature", Normal(21.0, 0.01, -40.0, 65.0)),
    ("detector_temperature", Normal(13.0, 10.0, -40.0, 65.0)),
    ("detector_temperature", Uniform(-40.0, 65.0)),
]


@cache
def factors(name: str, prior: Prior) -> tuple[np.ndarray, float]:
    """Return the table of one prior, made once for all tests, and the factor at its median."""
    scene = prepare([replace(selftest.toy(), conditions=CONDITIONS)], processes=Processes(**{name: prior}))
    return scene.priors[0], float(np.prod(scene.medians))


def drawn(probes: Probes, name: str, prior: Prior, tail: np.ndarray, upper: bool) -> np.ndarray:
    """Return the device's factors at probabilities from an end of the table."""
    table, centre = factors(name, prior)
    scaled = np.append(tail, np.full(-tail.size % 16, 0.5)) * 2**32
    word = np.minimum(np.floor(scaled), 2**31 - 1).astype(np.uint32)
    finer = np.minimum((scaled - word) * 2**23, 2**23 - 1).astype(np.uint32)
    # Bits above the finer ones belong to someone else.
    finer |= np.uint32(0xA5800000)
    less_one = probes.prior(~word if upper else word, finer, table).astype(np.float64)[: tail.size]
    return centre * (1 + less_one)


def law(prior: Prior) -> Any:
    if isinstance(prior, Uniform):
        return stats.uniform(prior.low, prior.high - prior.low)
    cuts = ((end - prior.mean) / prior.sd for end in (prior.low, prior.high))
    return stats.truncnorm(*cuts, prior.mean, prior.sd)


def inverted(name: str, factor: np.ndarray) -> np.ndarray:
    """Return the prior's values that belong to factors on the light or the dark."""
    if name == "detector_temperature":
        return 21.0 + np.log(factor) / 0.0684
    if name == "qe_scale":
        return factor
    return 1 - factor * (1 - CONDITIONS.get(name, 0.0))


def moments(x: np.ndarray, weight: np.ndarray) -> tuple[float, float, float, float]:
    mean = float(weight @ x)
    sd = float(np.sqrt(weight @ (x - mean) ** 2))
    return mean, sd, *(float(weight @ ((x - mean) / sd) ** k) for k in (3, 4))


CHANCES = [1e-9, 1e-7, 1e-5, 1e-3, 0.1]


@pytest.mark.parametrize(("name", "prior"), PRIORS)
def test_drawn_factors_have_the_moments_and_tails_of_the_prior(probes: Probes, name: str, prior: Prior) -> None:
    """Integrate the values of the prior over every cell of the table, without draws."""
    t, w = np.polynomial.legendre.leggauss(3)
    cells = np.arange(layout.PRIOR_NODES - 1)
    octave, part = np.divmod(cells, 2**layout.PRIOR_BITS)
    edges = np.append(0.0, np.ldexp(1.0 + part / 2**layout.PRIOR_BITS, octave - layout.PRIOR_FINEST))
    half = np.diff(edges)[:, None] / 2
    tail, weight = (edges[:-1, None] + half * (1 + t)).ravel(), (half * w).ravel()
    values = np.concatenate([drawn(probes, name, prior, tail, upper) for upper in (False, True)])
    mean, sd, skew, kurtosis = moments(inverted(name, values), np.append(weight, weight))
    wanted = moments(np.append(law(prior).ppf(tail), law(prior).isf(tail)), np.append(weight, weight))
    assert mean == pytest.approx(wanted[0], abs=1e-4 * wanted[1])
    assert sd == pytest.approx(wanted[1], rel=1e-4)
    assert skew == pytest.approx(wanted[2], abs=1e-3, rel=3e-4)
    assert kurtosis == pytest.approx(wanted[3], rel=3e-4)
    # The probability beyond the device's value is that of its word, to 0.1 % and the resolution of float32.
    table, centre = factors(name, prior)
    for upper in (False, True):
        for chance, value in zip(CHANCES, drawn(probes, name, prior, np.array(CHANCES), upper), strict=True):
            ulp = 2.0**-23 * float(np.abs(table).max()) * centre + 1e-15 * value
            near = inverted(name, value + ulp * np.array([-1.0, 0.0, 1.0]))
            beyond = law(prior).sf(near) if upper else law(prior).cdf(near)
            assert min(beyond) * (1 - 1e-3) <= chance <= max(beyond) * (1 + 1e-3), chance


def test_reference_has_the_same_bits(probes: Probes) -> None:
    """Compare at the ends of words, octaves and cells, and at random words."""
    table, _ = factors(*PRIORS[0])
    ends = np.concatenate([[2**k - 1, 2**k, 2**k + 1] for k in range(1, 32)]).astype(np.uint32)
    word, finer = (grid.ravel() for grid in np.meshgrid(np.concatenate([[0], ends, ~ends, [2**32 - 1]]), ends))
    word, finer = word.astype(np.uint32), finer.astype(np.uint32)
    extra = np.random.default_rng(8).integers(0, 2**32, (2, 2**15 - word.size % 16), dtype=np.uint32)
    word, finer = np.append(word, extra[0]), np.append(finer, extra[1])
    found = probes.prior(word, finer, table)
    np.testing.assert_array_equal(found.view(np.uint32), reference.quantile(word, finer, table).view(np.uint32))
    order = np.argsort(word.astype(np.float64) + (finer & np.uint32(0x7FFFFF)) / 2**23 * (word < 2**31), kind="stable")
    low = order[word[order] < 2**31]
    assert (np.diff(found[low]) >= 0).all()


#: By exact convolution no allowed draw can be distinguished with fewer draws, and the worst hardly needs more.
SOONEST, BORDER = 4e13, 5.1e13
#: Nor is a tail between 5 and 6 sigma further from the exact one than this share of it (a longer search finds .0046).
TAIL = 5e-3


def one_frame(dark: float, photons: float, read: float, *, pixels: int = 8, **kind: Any) -> Expectation:
    usual = {"photon_noise": "poisson", "bias": 3000.25}
    return exact.flat(pixels, 1, dark=dark, photons=photons, read=read, **(usual | kind))


def by_polynomial(x: Expectation, pixel: int = 0) -> np.ndarray:
    """Return the probabilities of the polynomial that the kernels evaluate; raise InputError if they do not."""
    scene = prepare([x], recipe="joint")
    assert scene.joint
    level = scene.levels[0, pixel]
    shape, sd = np.array([level[f"c{k}"] for k in range(5)], float), float(level["c1"])
    if not scene.quartic:
        shape[4] = 0.0
    return exact.of_polynomial(shape / sd, sd, float(scene.base_dn[0, pixel]), *exact.span(x, pixel))


#: Dark and photons per frame, read noise: the payload at 21 and at -40 C, the largest skew with its read noise, faint
#: light on a quiet detector, dark in electrons.
PIXELS = {
    "payload": {"dark": 2225.0, "photons": 3.0, "read": 12.0},
    "cold": {"dark": 34.0, "photons": 0.3, "read": 12.0},
    "most skewed": {"dark": 288.0, "photons": 1.0, "read": 12.0},
    "counting": {"dark": 5.0, "photons": 40.0, "read": 6.0},
    "electrons": {"dark": 2225.0, "photons": 20.0, "read": 12.0, "unit": "electrons"},
    "gaussian photons": {"dark": 100.0, "photons": 50.0, "read": 12.0, "photon_noise": "gaussian"},
}


@pytest.mark.parametrize("name", PIXELS)
def test_joint_draws_cannot_be_distinguished_from_exact_ones(name: str) -> None:
    """Pearson's test would need 1e14 draws to see the polynomial at five sigma; most cases far more."""
    x = one_frame(**PIXELS[name])
    p, q = exact.of_stack(x), by_polynomial(x)
    np.testing.assert_allclose([p.sum(), q.sum()], 1.0, atol=1e-12)
    assert exact.draws_to_tell(p, q) > 1e14


@pytest.mark.parametrize("name", ["mauvesim", "mauve"])
def test_nominal_payload_is_drawn_jointly_and_stacked_at_all_settings(name: str) -> None:
    """Check nine temperatures and 1 to 100 frames, in the pixels with most and least light."""
    for temperature in (-40, -30, -20, -9, 0, 9, 15, 21, 25):
        payload = instrument(name, part=True, temperature_c=float(temperature))
        for frames in (1, 2, 10, 100):
            (x,) = star(payload=payload, exposure=5.0 * frames)
            assert not prepare([x]).frames
            for pixel in (int(x.light_dn.argmin()), int(x.light_dn.argmax())):
                assert exact.draws_to_tell(exact.of_stack(x, pixel), by_polynomial(x, pixel)) > SOONEST


#: Logarithms of Gaussian noise over a Poisson step, gain and dark, the dark's unit, logarithm of light, phase in a DN.
BOUNDS = [(np.log10(1.5), 1.5), (-1.0, 1.0), (-2.5, 3.3), (0.0, 1.0), (-4.5, 3.3), (0.0, 1.0)]


@pytest.mark.long
@pytest.mark.parametrize("varying", [False, True], ids=["steady", "factors on light and dark"])
@pytest.mark.parametrize("what", ["Pearson", "tails"])
def test_worst_draws_that_the_region_allows(what: str, varying: bool) -> None:
    """Search all jointly drawn cases for the smallest number of draws that shows a difference, and the worst tail."""
    tried = 0
    constant = Processes(qe_scale=Uniform(1.0, 1.0))

    def merit(point: np.ndarray) -> float:
        nonlocal tried
        over, gain, dark, _, light, _ = 10.0**point
        unit, step = ("electrons", gain) if point[3] > 0.5 else ("DN", 1.0)
        light = light if point[4] > -4 else 0.0
        x = one_frame(dark * step, light, over * max(step, gain), gain=gain, unit=unit, bias=3000.0 + point[5])
        try:
            if varying:
                quartic = prepare([x], processes=constant).quartic
                sd, shape = exact.expansion(*exact.noise_of(x), fourth_power=quartic, varying=True)
                q = exact.of_polynomial(shape, sd, float(x.mean_raw_dn[0]), *exact.span(x))
            else:
                q = by_polynomial(x)
        except InputError:
            return 30.0
        tried += 1
        p = exact.of_stack(x)
        return float(np.log10(exact.draws_to_tell(p, q)) if what == "Pearson" else -exact.worst_tail(p, q))

    found = optimize.differential_evolution(merit, BOUNDS, rng=1, popsize=12, maxiter=25, polish=False)
    assert tried > 500
    if what == "Pearson":
        assert SOONEST < 10**found.fun < BORDER  # and the search did find the border
    else:
        assert TAIL / 4 < -found.fun < TAIL


def test_noise_that_is_not_smooth_is_drawn_separately() -> None:
    """Include noise whose skewness alone is too large, and steps of counts that nothing smooths."""
    # Of the first gamma_3 is small, but 2e9 draws show a tail off by a fifth.
    rough = ((0.14, 0.0, 1.5), (2225.0, 0.0, 1.4), (2.0, 0.0, 1.0), (0.0, 9.0, 0.5), (500.0, 0.0, 3.0))
    for dark, photons, read in rough:
        x = one_frame(dark, photons, read)
        assert not prepare([x]).joint
        with refused("recipe", "'joint'"):
            prepare([x], recipe="joint")
    with refused("qe_scale"):
        prepare([one_frame(0.14, 0.0, 1.5)], processes=Processes(qe_scale=Uniform(0.9, 1.1)))
    # Rounding alone, or Gaussian photons alone, need no Poisson steps smoothed.
    assert prepare([one_frame(0.0, 500.0, 0.0, photon_noise="gaussian")]).joint
    assert prepare([one_frame(0.0, 0.0, 0.0)]).joint


@pytest.mark.parametrize("photon_noise", ["gaussian", "poisson"])
@pytest.mark.parametrize("quartic", [False, True])
def test_factors_follow_the_cumulants(quartic: bool, photon_noise: str) -> None:
    """Compare the reference's draw under factors on light and dark with the polynomial of the scaled cumulants."""
    x = selftest.toy(8, 1, dark=288.0 if quartic else 2225.0, read=12.0, photon_noise=photon_noise)
    processes = Processes(qe_scale=Uniform(1.4, 1.4), detector_temperature=Uniform(12.0, 12.0))
    scene, index = prepare([x], processes=processes), np.arange(3000, dtype=np.uint64)
    assert scene.quartic == quartic
    factors = reference.factors(scene, index, 0, 5)
    warm = np.exp(x.conditions["dark_slope_per_c"] * (12.0 - x.conditions["temperature_c"]))
    other = replace(
        x, source_electrons=1.4 * x.source_electrons, sky_electrons=1.4 * x.sky_electrons, dark_dn=warm * x.dark_dn
    )
    drawn = reference.draws(scene, index, 0, 5)
    counts = reference.analogue(scene, drawn, 0, *factors)[:8].astype(float) + scene.base_dn[0][:, None]
    for p in range(8):
        sd, shape = exact.expansion(*exact.noise_of(other, p), fourth_power=quartic, varying=True)
        # float32 of a draw of up to a thousand DN from its base.
        wanted = other.mean_raw_dn[p] + sd * np.polynomial.Polynomial(shape)(drawn.z[p].astype(float))
        np.testing.assert_allclose(counts[p], wanted, rtol=0, atol=3e-4)


#: Realisations of 1643 pixels that are all alike: 1e8 draws, which see a skewness that is off by 0.003.
ROWS = 61_000


@pytest.mark.long
@pytest.mark.parametrize("recipe", ["joint", "apart"])
@pytest.mark.parametrize("name", ["payload", "cold", "counting", "electrons"])
def test_pearson_of_raw_counts(engine: Engine, name: str, recipe: str) -> None:
    """Pearson's test of 1e8 raw counts from the production kernel; fails by chance once in 1e6 new seeds."""
    x = one_frame(**PIXELS[name], pixels=1643)
    low, size = exact.span(x)
    assert prepare([x], recipe=recipe).joint == (recipe == "joint")
    found = engine.snr(x, realisations=ROWS, seed=31, recipe=recipe)
    assert (found.observers["bin_shift"] == 0).all()
    first = int(found.scene.base_dn[0, 0]) - layout.OBSERVER_BINS // 2
    counts = found.counts.dense("pixel").sum(axis=0)[low - first : low - first + size]
    assert counts.sum() == ROWS * x.wavelength_nm.size
    assert selftest.pearson(counts, exact.of_stack(x)) > 1e-6
