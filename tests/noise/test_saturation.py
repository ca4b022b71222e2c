"""Draws and closed forms near and beyond saturation, also by cosmic rays that together saturate a frame."""

from dataclasses import replace

import numpy as np
import pytest
from marks import long_but
from reference import statistics as numpy_kernels
from scenes import instrument, star
from scipy import stats

from mauvecl import CosmicRays, Engine, Expectation, InputError, Normal, Processes, Uniform
from mauvecl.noise import reference
from mauvecl.noise.scene import prepare

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
