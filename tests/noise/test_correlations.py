"""Draws: independence by every method, extreme words, stacks against their frames, and saturation, also by hits."""

from dataclasses import replace
from typing import Any

import exact
import numpy as np
import pytest
from marks import long_but
from reference import statistics as numpy_kernels
from refusals import refused
from scenes import instrument, prepare, star
from scipy import optimize, stats

from mauvecl import CosmicRays, Engine, Expectation, InputError, Normal, Processes, Uniform
from mauvecl.device.launches import scene_launches
from mauvecl.noise import layout, reference

#: Sixteen groups of four; pixel i of group g has a mean for the expansion where bit i of g is set, else for a table.
MIXED = np.array([1500.0 + 7 * g if g >> i & 1 else 300.0 + 11 * g for g in range(16) for i in range(4)])


def detector(dark: Any, photons: Any, read: float = 0.7, **kind: Any) -> Expectation:
    return exact.flat(64, 1, dark=dark, photons=photons, read=read, **kind)


SCENES = {
    "joint": (detector(2225.0, 40.0, read=12.0), {}),
    "joint, fourth power": (detector(40.0, 40.0, read=12.0), {}),
    "priors": (detector(2225.0, 0.0, read=12.0), {"processes": Processes(qe_scale=Normal(1.0, 0.1, 0.5, 1.5))}),
    "tables": (detector(30.0 + np.arange(64), 60.0, photon_noise="poisson"), {}),
    "expansion": (detector(1500.0 + np.arange(64), 2000.0, photon_noise="poisson"), {}),
    "both by every mixture": (detector(MIXED, MIXED[::-1], photon_noise="poisson"), {"recipe": "apart"}),
    "cosmic rays": (
        detector(MIXED, 0.0),
        {"processes": Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=3000.0, electrons=(20.0, 40.0)))},
    ),
}
ROWS = 50_000


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_draws_are_uncorrelated(engine: Engine, name: str) -> None:
    """Correlate values, squares and neighbours' products of 64 pixels in two frames; each fails once in 6e4 seeds."""
    x, how = SCENES[name]
    values = []
    for frame in (0, 1):
        rows = engine.realise(x, count=ROWS, seed=17, first_frame=frame, **how)
        values.append((rows - rows.mean(axis=0)) / rows.std(axis=0))
    # Single precision moves no z by 0.01, and takes half as long.
    z = np.hstack(values, dtype=np.float32)
    pixel = np.arange(z.shape[1])
    features = np.hstack([z, z**2, z[:, :-1] * z[:, 1:]])
    features = (features - features.mean(axis=0)) / features.std(axis=0)
    first, last = np.hstack([pixel, pixel, pixel[:-1]]), np.hstack([pixel, pixel, pixel[1:]])
    apart = (last[:, None] < first[None, :]) | (first[:, None] > last[None, :])
    found = (features.T @ features / np.sqrt(ROWS))[apart]
    assert found.size > 70_000
    assert np.abs(found).max() < 6.5


def test_pairs_of_pixels_use_one_method() -> None:
    """Check that no pair mixes tables with the expansion, and that pairs of one kind are drawn as alone."""
    scene = prepare([detector(MIXED, MIXED[::-1], photon_noise="poisson")], recipe="apart")
    for counts, mean in ((scene.dark_counts[:64], MIXED), (scene.photon_counts[0, :64], MIXED[::-1])):
        pairs = (counts["bits"] == 0).reshape(-1, 2)
        assert (pairs[:, 0] == pairs[:, 1]).all()
        np.testing.assert_array_equal(pairs[:, 0], (mean >= 1000.0).reshape(-1, 2).all(axis=1))
        # A table in place of the expansion is the same one that the mean has anywhere.
        p = int(np.flatnonzero((counts["bits"] > 0) & (mean >= 1000.0))[0])
        table = layout.alias_table(mean[p])
        start = int(counts["table"][p])
        np.testing.assert_array_equal(scene.tables[start : start + table.entries.size], table.entries)
    # The last of an odd number has no neighbour.
    odd = exact.flat(65, 1, dark=np.append(MIXED, 1500.0), read=0.7)
    assert prepare([odd]).dark_counts["bits"][64] == 0


INVERSE = [pow(m, -1, 2**32) for m in (0xD2511F53, 0xCD9E8D57)]


def unwind(words: tuple[int, int, int, int], seed: int) -> tuple[int, int, int, int]:
    """Return the counter that gives these Philox words, which exists because each round is a bijection."""
    k0, k1 = seed & 0xFFFFFFFF, seed >> 32
    c = words
    for r in reversed(range(10)):
        a, b = (k0 + r * 0x9E3779B9) & 0xFFFFFFFF, (k1 + r * 0xBB67AE85) & 0xFFFFFFFF
        # out = (high1 ^ c1 ^ a, low1, high0 ^ c3 ^ b, low0)
        c2, c0 = c[1] * INVERSE[1] & 0xFFFFFFFF, c[3] * INVERSE[0] & 0xFFFFFFFF
        high0, high1 = c0 * 0xD2511F53 >> 32, c2 * 0xCD9E8D57 >> 32
        c = (c0, c[0] ^ high1 ^ a, c2, c[2] ^ high0 ^ b)
    return c


def place_of(words: tuple[int, int, int, int], stream: str) -> tuple[int, int, int, int]:
    """Return a seed, realisation, frame and group that give these words in a stream."""
    for seed in range(100_000):
        c = unwind(words, seed)
        if c[3] >> 24 == layout.STREAMS[stream] and c[1] < 2**31:
            return seed, c[1] << 32 | c[0], c[2], c[3] & 0xFFFFFF
    raise AssertionError("no such place")


ENDS = [
    (0, 0, 0, 0),
    (2**32 - 1,) * 4,
    (0, 2**32 - 1, 0, 2**32 - 1),
    (2**32 - 1, 0, 1, 2**31),
    (1, 2**31 - 1, 2**32 - 2, 2**30),
]


@pytest.mark.parametrize("words", ENDS)
@pytest.mark.parametrize(("stream", "options", "how"), [
    ("noise", {}, {}), ("noise", {"temperature_c": -30.0}, {}), ("dark", {}, {"recipe": "apart"}),
    ("dark", {"temperature_c": -30.0}, {"recipe": "apart"}), ("photon", {"name": "mauve"}, {"recipe": "apart"}),
    ("cosmic_rays", {}, {"processes": Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=500.0))}),
])  # fmt: skip
def test_extreme_words_in_production_kernel_equal_reference(
    engine: Engine, words: tuple[int, int, int, int], stream: str, options: dict, how: dict
) -> None:
    seed, index, frame, group = place_of(words, stream)
    np.testing.assert_array_equal([int(w[0]) for w in reference.words_at([index], frame, stream, group, seed)], words)
    (x,) = star(payload=instrument(**{"part": True, "output_max_nm": 310.0} | options), exposure=5.0)
    scene = prepare([x], first_frame=frame, first_group=group, **how)
    raw = np.empty((1, scene.n_pixel), np.int32)
    with scene_launches(engine.open_device, scene, seed) as launches:
        launches.realise(engine._tiles.at(index, 1, 4096), raw)
    np.testing.assert_array_equal(raw, reference.realise(scene, np.array([index], np.uint64), seed))
    # No word gives more than 6.77 sigma of its own noise, or half the tables' 2**-33.
    z = (raw[0, :4] - x.mean_raw_dn[:4]) / np.sqrt(x.variance_dn2[:4])
    if stream != "cosmic_rays":
        assert np.abs(z).max() < 15
    if stream == "noise" and words == (0, 0, 0, 0):
        assert z[0] > 6.5


def test_largest_number_of_pixels_is_drawn(engine: Engine) -> None:
    """Draw 65 536 pixels: all equal the reference, all groups differ, and statistics are defined."""
    x = exact.flat(65_536, 1, dark=2225.0, photons=40.0)
    raw = engine.realise(x, start=2**40, count=2, seed=3)
    np.testing.assert_array_equal(raw, reference.realise(prepare([x]), np.array([2**40, 2**40 + 1], np.uint64), 3))
    z = (raw - x.mean_raw_dn) / np.sqrt(x.variance_dn2)
    assert len(np.unique(z[0].reshape(-1, 4), axis=0)) == 16_384
    found = engine.detect(x, [], realisations=4000, seed=3, statistics=("chi2",)).distribution("chi2")
    assert abs(found.mean - 65_536) < 5 * np.sqrt(2 * 65_536 / 4000)
    with refused("pixels", "65540", "65536"):
        prepare([exact.flat(65_540, 1)])


#: Smallest number of draws of one pixel that distinguish an allowed stack from its frames, by exact convolution.
SOONEST = 4e13


def quiet(read: float, frames: int, **kind: Any) -> Expectation:
    """Return eight pixels whose bias has different fractions of a DN."""
    return exact.flat(8, frames, read=read, **({"bias": 600.0 + np.arange(8) / 8} | kind))


@pytest.mark.long
def test_worst_allowed_stack_is_indistinguishable_from_frames() -> None:
    """Search read noise, counts, gain, frames and phase for the stack that is easiest to distinguish."""
    tried = 0

    def merit(point: np.ndarray) -> float:
        nonlocal tried
        read, dark, light, gain, frames = 10.0 ** point[:5]
        kind = {
            "unit": "electrons" if point[5] > 0.5 else "DN",
            "photon_noise": "poisson" if point[6] > 0.5 else "gaussian",
            "bias": 600.0 + point[7],
        }
        x = quiet(read, round(frames), dark=dark, photons=light if point[2] > -2 else 0.0, gain=gain, **kind)
        if prepare([x]).frames:
            return 30.0
        tried += 1
        return float(np.log10(exact.draws_to_tell(exact.of_frames(x), exact.of_stack(x))))

    bounds = [(-0.8, 0.8), (-3.0, 1.5), (-2.2, 2.0), (-1.5, 0.5), (np.log10(2), 2.0), (0, 1), (0, 1), (0, 1)]
    found = optimize.differential_evolution(merit, bounds, rng=1, popsize=10, maxiter=25, polish=False)
    assert tried > 300
    assert SOONEST < 10**found.fun < 3 * SOONEST


def test_nearly_noiseless_detector_is_drawn_frame_by_frame(engine: Engine) -> None:
    """Compare with frames whose stack would have 118 times their variance; fails once in 1e5 seeds."""
    x = quiet(0.15, 20)
    rows = 40_000
    assert prepare([x]).frames
    with refused("mode", "'stacked'"):
        prepare([x], mode="stacked")
    raw = engine.realise(x, count=rows, seed=5).astype(float)
    for pixel in range(8):
        p = exact.of_frames(x, pixel)
        dn = exact.span(x, pixel)[0] + np.arange(p.size)
        mean = p @ dn
        variance, fourth = (p @ (dn - mean) ** k for k in (2, 4))
        assert abs(raw[:, pixel].mean() - mean) < 5 * np.sqrt(variance / rows) + 1e-9
        spread = np.sqrt(max(fourth - variance**2, 0.0) / rows)
        assert abs(((raw[:, pixel] - mean) ** 2).mean() - variance) < 5 * spread + 1e-9
    # The least light that a prior allows decides, whose photons smooth the rounding least.
    smooth = quiet(0.1, 100, photons=60.0)
    assert not prepare([smooth]).frames
    assert prepare([smooth], processes=Processes(qe_scale=Uniform(0.01, 1.0))).frames


N = 4000


def bright(seed: int) -> tuple[Expectation, Expectation]:
    """Return a star whose brightest pixel is close to saturation, and a flare that saturates more pixels."""
    some = np.random.default_rng(seed)
    frames = int(some.choice([1, 1, 2, 5]))
    frame_s = float(some.uniform(3.0, 7.0))
    payload = instrument(part=True, output_min_nm=290.0, output_max_nm=350.0, frame_s=frame_s)
    name = str(some.choice(["G2V", "K3V", "B2IV"]))
    quiet, flare = star(name, 5.0, amplitudes=(float(10 ** some.uniform(-3, -0.3)),), exposure=frames * frame_s,
                        payload=payload)  # fmt: skip
    # The quiescent star's own brightest pixel just below saturation, or well below.
    room = quiet.ceiling_dn - quiet.bias_dn - quiet.dark_dn
    sd = np.sqrt(quiet.gain_dn_per_electron * room)
    scale = float(np.min((room + some.choice([-8.0, -1.0, 0.5]) * sd) / (quiet.light_dn / frames)))
    found = [replace(x, source_electrons=scale * x.source_electrons, messages=()) for x in (quiet, flare)]
    return found[0], found[1]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
def test_closed_forms_follow_simulation(engine: Engine, seed: int) -> None:
    """Compare means, variances and statistics of random bright stars and flares; one seed in 1e5 fails by chance."""
    quiet, flare = bright(seed)
    assert flare.cut_share.max() > 0
    for x in (quiet, flare):
        raw = engine.realise(x, count=N, seed=4).astype(np.float64)
        assert raw.max() <= x.n_frames * x.highest_dn == x.n_frames * 59_578
        sd = np.sqrt(x.variance_dn2)
        # A third of a DN for values too rare to have a standard error.
        assert np.all(np.abs(raw.mean(axis=0) - x.recorded_dn) < 6 * sd / np.sqrt(N) + 1 / 3)
        square = (raw - x.recorded_dn) ** 2
        some = x.cut_share < 0.9  # rarer values than these have a variance too few realisations know
        error = square.std(axis=0)[some] / np.sqrt(N)
        assert np.all(np.abs(square.mean(axis=0) - x.variance_dn2)[some] < 6 * error)
        np.testing.assert_allclose(x.recorded_light_dn, x.recorded_dn - x.n_frames * (x.bias_dn + x.dark_dn), rtol=1e-9)
    found = engine.detect(quiet, [flare], realisations=N, seed=4, statistics=("chi2", "chi2_element", "matched"))
    for statistic in found.statistics:
        for k in (None, 0):
            seen, form = found.distribution(statistic, k), found.closed_form(statistic, k)
            # A value is known to a step of its grid, 1/2048 of the null's standard deviation, and to float32's sums.
            known = 1e-3 * found.closed_form(statistic).std + 1e-6 * abs(form.mean)
            assert abs(seen.mean - form.mean) < 5 * seen.std / np.sqrt(N) + known


def test_snr_and_clipped_counts_of_saturated_pixels(engine: Engine) -> None:
    """Compare clipped frames and rows with the reference, and frequency and S/N with closed forms, to 5 sigma."""
    quiet, flare = bright(1)
    index = np.arange(64, dtype=np.uint64)
    for x in (quiet, flare):
        raw, cut = engine.realise_and_count(x, count=64, seed=9, mode="frames")
        scene = prepare([x], mode="frames")
        np.testing.assert_array_equal(raw, reference.realise(scene, index, 9))
        np.testing.assert_array_equal(cut, numpy_kernels.clipped(scene, index, 9).sum(axis=(1, 2)))
        found, trials = engine.snr(x, realisations=N, seed=9, mode="frames"), N * x.n_frames
        counts = found.counts.clipped[:, 1]
        np.testing.assert_allclose(found.pixel["clipped_high"], counts / trials)
        assert not found.pixel["clipped_low"].any()
        spread = np.sqrt(trials * x.cut_share * (1 - x.cut_share)) + 1
        assert np.abs(counts - trials * x.cut_share).max() < 5 * spread.max()
        # The square root of a few electrons has a bias.
        gap = np.abs(found.pixel["mean"] - found.pixel["expected"])
        assert np.all(gap < 5 * found.pixel["std"] / np.sqrt(N) + 0.02 * np.maximum(found.pixel["std"], 0.05))
        _, *parts, total = (column.value for column in x.noise_budget().itercols())
        np.testing.assert_allclose(x.signal_dn / total, x.snr(), rtol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(parts, axis=0), total, rtol=1e-9)


def test_priors_that_reach_saturation_are_drawn_frame_by_frame(engine: Engine) -> None:
    """Choose the mode by the prior's range instead of the mean, since stacks cannot be clipped."""
    quiet, _ = bright(1)
    stack = replace(quiet, n_frames=4, source_electrons=0.5 * quiet.source_electrons)
    assert not prepare([stack]).frames
    brighter = Processes(qe_scale=Normal(1.5, 0.5, 0.5, 4.0))
    assert prepare([stack], processes=brighter).frames
    # Neither of two priors reaches saturation alone; a single hit does.
    together: dict[str, Uniform] = {"light_loss": Uniform(0.1, 0.34), "qe_scale": Uniform(0.9, 1.5)}
    for names in (("light_loss",), ("qe_scale",), tuple(together)):
        drawn = Processes(**{name: together[name] for name in names})
        assert prepare([stack], processes=drawn).frames == (len(names) == 2)
    assert prepare([stack], processes=Processes(cosmic_rays=CosmicRays(electrons=(9e4, 9e4)))).frames
    assert engine.realise(stack, count=2000, seed=2, processes=brighter).max() == 4 * 59_578


def test_flare_that_saturates_every_pixel_gives_nan(engine: Engine) -> None:
    """Return NaN and a message for this flare, and numbers for another one."""
    quiet, flare = bright(1)
    blinding = replace(flare, source_electrons=flare.source_electrons + 2e5, name="blinding")
    found = engine.detect(quiet, [flare, blinding], realisations=N, seed=4, statistics=("chi2", "matched"))
    assert found.blinding == (1,)
    for statistic in found.statistics:
        seen, nothing = found.detection_probability(0.03, statistic)
        assert 0 <= seen.value <= 1
        assert np.isnan([nothing.value, nothing.low, nothing.high]).all()
    table = found.table(0.03)
    of_flare = ("expected", "mean", "std", "probability", "low", "high", "closed_form_probability")
    numbers = np.array([table[name] for name in of_flare])
    assert np.isfinite(numbers[:, :2]).all()
    assert np.isnan(numbers[:, 2:]).all()
    # Of chi-squared alone: a weighted sum has no degrees of freedom.
    np.testing.assert_array_equal(np.isfinite(table["reduced"]), [True, False, False, False])
    assert found.messages == (
        f"SATURATED: flare 2 saturates every pixel of {quiet.name} that counts: what is recorded no longer depends on "
        "the flare, and no number is given.",
    )


def test_rare_saturation_is_reported_and_entire_saturation_refused() -> None:
    """Report the share of exposures even if no mean is saturated, and refuse with the longest safe frame."""
    payload = instrument(part=True, output_min_nm=290.0, output_max_nm=350.0)
    (rarely,), (never,), (quiet,) = (star(magnitude=m, payload=payload) for m in (-0.25, 3.0, -6.0))
    reached = 1 - np.prod(1 - rarely.cut_share) ** rarely.n_frames
    assert rarely.messages[0].startswith("SATURATED at times: pixels of G2V ")
    assert f" DN, and reach it in {100 * reached:.3g} % of exposures" in rarely.messages[0]
    assert not never.messages[0].startswith("SATURATED")
    with pytest.raises(InputError, match="frames of at most") as caught:
        Engine().detect(quiet, [quiet], realisations=1000)
    safe = float(str(caught.value).split("at most ")[1].split()[0])
    assert safe <= quiet.longest_safe_frame_s < safe + 0.0011


DRAWS = 2000


def with_hits(seed: int) -> tuple[Expectation, CosmicRays]:
    """Return a star on identical pixels, so far below saturation that a frame can collect some hits, and the hits."""
    rng = np.random.default_rng(seed)
    frame_s = float(rng.uniform(1.0, 10.0))
    frames = int(rng.integers(2, 9))
    payload = instrument(part=True, frame_s=frame_s, output_max_nm=310.0)
    (x,) = star(exposure=frames * frame_s, payload=payload)
    fitting = int(rng.integers(1, 4))
    largest = float(rng.uniform(0.5, 0.99)) * (x.highest_dn - 3000.0) / x.gain_dn_per_electron.max() / fitting
    rays = CosmicRays(
        rate_per_cm2_s=float(10 ** rng.uniform(1.0, 4.0)),
        electrons=(float(int(rng.uniform(0.5, 1.0) * largest)), float(int(largest))),
    )
    light = np.full(x.wavelength_nm.size, float(rng.uniform(50.0, 1000.0)))
    return replace(x, source_electrons=light, messages=()), rays


def drawn_by_numpy(x: Expectation, rays: CosmicRays, rng: np.random.Generator) -> np.ndarray:
    """Draw exposures as sums of single frames, each with hits, light, dark and read noise, rounded and clipped."""
    low, high = (int(e) for e in rays.electrons)
    shape = (DRAWS, x.wavelength_nm.size)
    total = np.zeros(shape)
    for _ in range(x.n_frames):
        electrons = rng.poisson(x.source_electrons + x.sky_electrons, shape).astype(float)
        hits = rng.poisson(rays.rate_per_cm2_s * 0.057 / 2048 * x.frame_s, shape)
        for n in range(1, int(hits.max(initial=0)) + 1):
            hit = hits >= n
            electrons[hit] += rng.integers(low, high, np.count_nonzero(hit), endpoint=True)
        noise = rng.normal(0.0, np.sqrt(x.dark_variance_dn2 + x.read_noise_dn**2), shape)
        frame = x.gain_dn_per_electron * electrons + x.dark_dn + x.bias_dn + noise
        total += np.clip(np.rint(frame), 0, x.highest_dn)
    return total


@pytest.mark.parametrize("seed", long_but(range(24), *range(6)))
def test_sums_of_frames_with_hits_equal_independent_draws(engine: Engine, seed: int) -> None:
    """Compare with independent draws of each frame, in 60 classes of equal count: 24 tests fail once in 4e5 seeds."""
    x, rays = with_hits(seed)
    ours = engine.realise(x, count=DRAWS, seed=seed, processes=Processes(cosmic_rays=rays))
    theirs = drawn_by_numpy(x, rays, np.random.default_rng(1000 + seed))
    # No sum exceeds what frames can hold, and neither does one that holds a single frame cut off.
    assert ours.max() <= x.n_frames * x.highest_dn
    edges = np.unique(np.quantile(np.concatenate([ours.ravel(), theirs.ravel()]), np.linspace(0, 1, 61)[1:-1]))
    counts = [np.bincount(np.searchsorted(edges, one.ravel()), minlength=edges.size + 1) for one in (ours, theirs)]
    assert stats.chi2_contingency(np.array(counts)).pvalue > 1e-7
