"""Drawn stares: cumulants, pixels, an independent recipe, the engine's exposures, and the reference's bits."""

import time
from typing import Any

import numpy as np
import pytest
from reference import stares as stare_reference
from refusals import refused
from scenes import NEAR, Components, instrument, star
from scipy import special

from mauvecl import CosmicRays, Engine, Processes, Stare, Stares, Study
from mauvecl.flares import stare_scene

METHODS = ["pixels", "cumulants"]


def test_frames_sum_to_exposures_of_the_engine(engine: Engine, stares: Stares) -> None:
    """Compare counts of the same draws, of which float32 rounds hardly one in 1e5 frames to another DN."""
    one, long = (
        star(magnitude=-0.7, amplitudes=(0.24,), exposure=s, payload=instrument(part=True)) for s in (5.0, 50.0)
    )
    # The brightest that does not saturate, and others.
    usable = np.flatnonzero(~one[0].saturated)
    pixels = usable[np.argsort(one[0].mean_raw_dn[usable])[[-1, -2, -3, -20, 0]]]
    components = Components.of(one[0], one[1:], np.eye(one[0].wavelength_nm.size)[pixels])
    for scenario, amplitude in ((0, 0.0), (1, 1.0)):
        raw = engine.realise(long[scenario], start=2**32 - 100, count=300, seed=3, mode="frames")[:, pixels]
        given = np.full((10, 1), amplitude)
        y = stares.frames(components, Stare.of(50.0), given, first=2**32 - 100, count=300, seed=3)
        off = y.sum(axis=1, dtype=np.float64) + 10 * one[0].mean_raw_dn[pixels] - raw
        assert np.abs(off).max() < 1.1
        assert np.mean(np.abs(off) > 0.1) < 2e-3
        clipped = np.mean(y[..., 0] + one[0].mean_raw_dn[pixels[0]] > one[0].highest_dn - 0.1)
        assert clipped > 0.02, "frames are cut off where they saturate, one by one"


def test_only_pixels_with_a_weight_take_time(stares: Stares) -> None:
    """A sum of few neighbouring pixels takes a fraction of the time of one of all, in the best of three draws."""
    (x,) = star(amplitudes=(), exposure=5.0)
    stare, n = Stare.of(10_000.0), x.wavelength_nm.size
    seconds = []
    for width in (8, n):
        weights = np.where(~x.saturated & (np.arange(n) < width), 1.0, 0.0)[None]
        times = []
        for seed in range(4):
            start = time.perf_counter()
            stares.frames(Components.of(x, [], weights), stare, seed=seed)
            times.append(time.perf_counter() - start)
        seconds.append(min(times))
    assert seconds[0] < seconds[1] / 2


def recipe(components: Components, stare: Stare, flare: np.ndarray, n: int, seed: int) -> np.ndarray:
    """Draw a stare by a plain NumPy recipe: the paper's counts (Gaussian photons, Poisson dark in DN)."""
    x, rng = components.quiet, np.random.default_rng(seed)
    star_off, warm_off, warm_drift = rng.standard_normal((3, n, 1))
    shape = (n, stare.n_frames)
    hours = (stare.start_s + 2.5 - (stare.start_s[0] + stare.start_s[-1] + 5.0) / 2) / 3600
    kept = 1 + 0.03 * rng.standard_normal(shape)
    glow = 1 + 0.2 / 3 * rng.standard_normal(shape)
    warm = stare.temperature_c + 0.1 * rng.standard_normal(shape) + 0.3 * warm_off + 60.0 * warm_drift * hours
    out = np.zeros((*shape, components.n_statistics))
    for p in range(x.wavelength_nm.size):
        light = x.source_electrons[p] * (1 + 0.02 * star_off) + glow * x.sky_electrons[p]
        light = kept * (light + flare @ components.flare_electrons[:, p])
        dark = rng.poisson(x.dark_dn[p] * np.exp(0.0684 * (warm - 21.0)))
        signal = x.gain_dn_per_electron[p] * (light + np.sqrt(light) * rng.standard_normal(shape))
        raw = np.rint(signal + dark + x.bias_dn[p] + x.read_noise_dn[p] * rng.standard_normal(shape))
        out += (raw - x.mean_raw_dn[p])[..., None] * components.weights[:, p]
    return out


@pytest.mark.parametrize("method", METHODS)
def test_moments_equal_those_of_the_recipe(stares: Stares, method: Any) -> None:
    """Compare means and covariances within and between frames: 27 numbers within 6 standard errors, 1e-7 by chance."""
    quiet, *flares = star(
        magnitude=4.0, amplitudes=(0.5, 1.0), exposure=5.0, payload=instrument(output_min_nm=300.0, output_max_nm=306.0)
    )
    n_pixel, n = quiet.wavelength_nm.size, 20_000
    components = Components.of(quiet, flares, np.stack([np.ones(n_pixel), np.linspace(-1.0, 1.0, n_pixel)]))
    stare = Stare.of(
        40.0, gaps=[(5.0, 20.0), (25.0, 35.0)], thermal=0.5, orbit_s=60.0,
        jitters={"light": 0.03, "sky": 0.2 / 3, "temperature": 0.1}, offsets={"star": 0.02, "temperature": 0.3},
        drifts={"temperature": 60.0},
    )  # fmt: skip
    flare = np.array([[0.0, 0.0], [0.4, 0.0], [0.1, 0.3]])
    wanted = recipe(components, stare, flare, n, 8).reshape(n, -1)
    found = stares.frames(components, stare, flare, count=n, seed=4, method=method).reshape(n, -1).astype(float)
    spread = wanted.std(axis=0)
    error = np.sqrt(2.0 / n)
    assert np.abs((found.mean(axis=0) - wanted.mean(axis=0)) / spread).max() < 6 * error
    ours, theirs = (np.cov((y / spread).T) for y in (found, wanted))
    product = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)) + theirs**2)
    assert np.abs((ours - theirs) / product).max() < 6 * error
    between = theirs[:2, 2:4]
    assert np.abs(between).max() > 20 * error, "what a stare shares is seen between its frames"


N_STARES, N_FRAMES = 10_000, 1000


@pytest.mark.long
@pytest.mark.parametrize(
    ("payload", "wobble", "n_sums"),
    [
        # Sums as skewed as the expansion is used for: few counts in few pixels.
        ({"temperature_c": -20.0, "output_max_nm": 303.0}, {}, 2),
        ({"output_max_nm": 309.0, "photon_noise": "poisson"}, {"jitters": {"light": 0.03, "temperature": 0.05}}, 3),
    ],
    ids=["cold", "Poisson photons, jitter"],
)
def test_sums_by_cumulants_are_distributed_as_by_pixels(stares: Stares, payload: Any, wobble: Any, n_sums: int) -> None:
    """Compare sums and mixtures in 1e7 frames drawn each way: distances, tails, moments, less than 1e-5 by chance."""
    used = instrument(**({"output_min_nm": 300.0} | payload))
    quiet, flare = star(amplitudes=(1.0,), exposure=5.0, payload=used)
    along = np.linspace(-1.0, 1.0, quiet.wavelength_nm.size)
    components = Components.of(quiet, [flare], np.stack([np.exp(0.3 * along), along + 0.3, along**2])[:n_sums])
    stare = Stare.of(5.0 * N_FRAMES, temperature_c=used.temperature_c, **wobble)
    given = np.full((N_FRAMES, 1), 0.7)
    coefficients = components.coefficients(stare, given)[0]
    covariance = components.covariance(coefficients)
    for of, direction in components.directions(coefficients).items():
        covariance = covariance + np.outer(direction, direction) * stare.jitters.get(of, 0.0) ** 2
    drawn = [
        stares.frames(components, stare, given, first=k * N_STARES, count=N_STARES, seed=12, method=method)
        for k, method in enumerate(METHODS)
    ]
    n = N_STARES * N_FRAMES
    mixtures = [*np.eye(n_sums), np.array([1.0, -1.0, 0.5])[:n_sums], np.array([0.3, 2.0, -1.0])[:n_sums]]
    for mixture in mixtures:
        sd = np.sqrt(mixture @ covariance @ mixture)
        mean = mixture @ components.means(coefficients)
        counts, moments = [], []
        for y in drawn:
            z = sum((y[..., k].ravel() * np.float32(m / sd) for k, m in enumerate(mixture)), np.float32(-mean / sd))
            bins = (np.clip(z, -7.9, 7.9) * np.float32(256.0) + np.float32(2048.0)).astype(np.int16)
            counts.append(np.bincount(bins, minlength=4096))
            at = (np.arange(4096) + 0.5 - 2048.0) / 256.0
            moments.append([counts[-1] @ at**r / n for r in (1, 2, 3, 4)])
        a, b = counts
        distance = np.abs(np.cumsum(a - b)).max() / n
        assert special.kolmogorov(distance * np.sqrt(n / 2)) > 1e-6
        for level in (4.0, 4.5, 5.0):
            edge = int(256 * level)
            for ours, theirs in ((b[: 2048 - edge], a[: 2048 - edge]), (b[2048 + edge :], a[2048 + edge :])):
                assert abs(ours.sum() - theirs.sum()) < 5.5 * np.sqrt(ours.sum() + theirs.sum() + 1)
        if not wobble:
            # Hermite's polynomials, whose sample means are independent: 0, 0, third and fourth cumulants.
            shape = []
            for order in (3, 4):
                constant, each = components.sum_cumulants(order)
                cumulant = constant + np.tensordot(coefficients, each, 1)
                for _ in range(order):
                    cumulant = cumulant @ mixture
                shape.append(cumulant / sd**order)
            for first, second, third, fourth in moments:
                found = np.array([first, second - 1, third - 3 * first, fourth - 6 * second + 3])
                error = np.sqrt(np.array([1.0, 2.0, 6.0, 24.0]) / n)
                assert (np.abs(found - [0.0, 1 / 12 / 256**2, *shape]) < 5.5 * error).all()


def test_components_equal_the_expectations(stares: Stares) -> None:
    quiet, *flares = star(amplitudes=(0.5, 2.0), exposure=5.0, payload=instrument(part=True), neighbours=NEAR)
    assert quiet.target_share < 0.7
    rng = np.random.default_rng(2)
    weights = rng.standard_normal((3, quiet.wavelength_nm.size))
    components = Components.of(quiet, flares, weights)
    for wanted, rise in ((quiet, [0, 0]), (flares[0], [1, 0]), (flares[1], [0, 1])):
        coefficients = [1, 1, 1, 1, *rise]
        means = components.means(np.array(coefficients, float))
        np.testing.assert_allclose(means, weights @ (wanted.mean_raw_dn - quiet.mean_raw_dn), rtol=1e-9, atol=1e-9)
        covariance = components.covariance(np.array(coefficients, float))
        np.testing.assert_allclose(covariance, weights * wanted.unsaturated_variance_dn2 @ weights.T, rtol=1e-9)
    # What small changes of the conditions move.
    at, little = np.array([[0.9, 1.2, 1.5, 1.1, 0.3, 0.1]]), 1e-6
    changes = {"star": [0], "light": [0, 1, 3, 4, 5], "sky": [1], "temperature": [2]}
    for of, direction in components.directions(at).items():
        there = at.copy()
        there[:, changes[of]] *= np.exp(little * (0.0684 if of == "temperature" else 1.0))
        moved = (components.means(there) - components.means(at)) / little
        np.testing.assert_allclose(direction, moved, rtol=1e-4)


SEED = 2**63 + 12345
#: Around the boundary of the counter's first word.
FIRST, COUNT = 2**32 - 24, 40
WOBBLE: dict[str, Any] = {
    "jitters": {"light": 0.02, "sky": 0.03, "temperature": 0.1},
    "offsets": {"star": 0.01, "light": 0.02, "sky": 0.05, "temperature": 0.3},
    "drifts": {"star": 0.02, "temperature": 0.5},
    "thermal": 0.5,
    "gaps": [(20.0, 60.0)],
}
DRIFTS = Study().with_settings(["stare.pointing={rate_per_h=100.0, duration_s=30.0, depth=0.9}"]).stare.pointing
DRIFTING: dict[str, Any] = {"pointing": DRIFTS}
#: Payload, stare, sums, flare temperatures, scenarios, further words.
CASES: dict[str, tuple[dict[str, Any], dict[str, Any], int, int, int, dict[str, Any]]] = {
    "plain": ({}, {}, 1, 0, 0, {}),
    "all that wobbles": ({}, WOBBLE, 3, 2, 0, {}),
    "jitter alone": ({}, {"jitters": {"light": 0.03}}, 2, 1, 0, {}),
    "unknown alone": ({}, {"offsets": {"temperature": 1.0}}, 5, 0, 0, {}),
    "electrons": ({"name": "mauve"}, WOBBLE, 2, 1, 3, {}),
    "cold, fourth cumulants": ({"temperature_c": -20.0, "output_max_nm": 303.0}, WOBBLE, 2, 1, 0, {}),
    "Poisson photons": ({"photon_noise": "poisson"}, WOBBLE, 3, 1, 0, {}),
    "neighbours": ({}, WOBBLE, 3, 2, 0, {}),
    "pointing drifts": ({}, WOBBLE | DRIFTING, 3, 2, 3, {}),
    "pointing drifts alone": ({}, DRIFTING, 2, 1, 0, {}),
    "cosmic rays": ({}, WOBBLE, 2, 1, 2, {"processes": Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=200.0))}),
}


def case(name: str) -> tuple[Components, Stare, Any, Any, dict[str, Any]]:
    payload, wobble, n_sums, n_flares, n_scenarios, more = CASES[name]
    options = {"output_min_nm": 300.0, "output_max_nm": 312.0} | payload
    used = instrument(options.pop("name", "mauvesim"), **options)
    near = NEAR if name == "neighbours" else None
    quiet, *flares = star(amplitudes=(0.5, 2.0)[:n_flares], exposure=5.0, payload=used, neighbours=near)
    wavelength = quiet.wavelength_nm - quiet.wavelength_nm.mean()
    weights = np.array([np.cos(k * wavelength / wavelength.max()) + 0.2 for k in range(n_sums)])
    stare = Stare.of(110.0, temperature_c=used.temperature_c, **wobble)
    rng = np.random.default_rng(5)
    flare = rng.uniform(0.0, 2.0, (COUNT, stare.n_frames, n_flares)) if n_flares else None
    amplitudes = rng.uniform(0.0, 3.0, (n_scenarios, COUNT)) if n_scenarios else None
    return Components.of(quiet, flares, weights), stare, flare, amplitudes, more


@pytest.fixture(scope="module", params=["vectors", "scalar"])
def any_stares(request: pytest.FixtureRequest, engine: Engine) -> Stares:
    """Return stares with vectors, as on processors, and in tiles with one stare or frame per work-item, as on a GPU."""
    return Stares(engine.open_device) if request.param == "vectors" else Stares(width=1, tile=16)


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("method", METHODS)
def test_stares_equal_the_reference(any_stares: Stares, name: str, method: Any) -> None:
    components, stare, flare, amplitudes, more = case(name)
    if more and method == "cumulants":
        with refused("method", "cumulants"):
            any_stares.frames(components, stare, flare, count=COUNT, seed=SEED, method=method, **more)
        return
    how: dict[str, Any] = {"seed": SEED, "method": method, "amplitudes": amplitudes, **more}
    found = any_stares.frames(components, stare, flare, first=FIRST, count=COUNT, **how)
    scene = stare_scene.StareScene.of(components, stare, **more)
    flares = stare_scene.Flares.of(components, stare, flare, amplitudes, COUNT)
    numbers = np.arange(FIRST, FIRST + COUNT, dtype=np.uint64)
    frames = range(0, stare.n_frames, 1 if method == "cumulants" else 6)
    drawn = {"pixels": stare_reference.pixels, "cumulants": stare_reference.sums}[method]
    ours = drawn(scene, flares, numbers, frames, SEED)
    np.testing.assert_array_equal(found[..., list(frames), :], ours if amplitudes is not None else ours[0])
    assert found.std() > 0
    # The noise of flares' sums, and the light of the frames that it depends on.
    request = stare_scene.StaresRequest(components, stare, COUNT, SEED, start=FIRST, method=method, glow=True)
    glow = stare_reference.glow(scene, numbers, range(stare.n_frames), SEED)
    np.testing.assert_array_equal(any_stares.reduced(request)["glow"], glow)


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_stares_depend_on_neither_scenarios_nor_gaps(stares: Stares, method: Any) -> None:
    """Check flares of a scenario against the same without one, and that frames depend on their time alone."""
    components, stare, flare, amplitudes, _ = case("electrons")
    how: dict[str, Any] = {"seed": SEED, "method": method}
    place: dict[str, Any] = {"first": FIRST, "count": COUNT}
    whole = stares.frames(components, stare, flare, amplitudes=amplitudes, **place, **how)
    alone = stares.frames(components, stare, flare * amplitudes[1][:, None, None], **place, **how)
    # The device multiplies in float32 what is multiplied in float64 here: whole DN may differ now and then.
    np.testing.assert_allclose(alone, whole[1], atol=5.0)
    # The frames that a gap leaves are those of the stare without it.
    warm = {"temperature_c": components.quiet.conditions["temperature_c"]}
    gapless, gapped = (Stare.of(110.0, gaps=gaps, **warm) for gaps in ((), [(20.0, 60.0)]))
    both = [stares.frames(components, s, None, count=2, **how) for s in (gapless, gapped)]
    np.testing.assert_array_equal(both[0][:, gapped.numbers], both[1])
