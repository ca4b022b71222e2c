"""Cosmic rays that together saturate a frame are clipped as in single frames."""

from dataclasses import replace

import numpy as np
import pytest
from marks import long_but
from scenes import instrument, star
from scipy import stats

from mauvecl import CosmicRays, Engine, Expectation, Processes

N = 2000
SEEDS = 24


def case(seed: int) -> tuple[Expectation, CosmicRays]:
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
    shape = (N, x.wavelength_nm.size)
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


@pytest.mark.parametrize("seed", long_but(range(SEEDS), *range(6)))
def test_sums_of_frames_with_hits_equal_independent_draws(engine: Engine, seed: int) -> None:
    """Compare the engine's sums with independent draws of each frame, in 60 classes of equal count.

    A class holds pixels of one exposure, which are independent but for their means; p < 1e-7 in 24 tests: a false
    failure in 4e5.
    """
    x, rays = case(seed)
    ours = engine.realise(x, count=N, seed=seed, processes=Processes(cosmic_rays=rays))
    theirs = drawn_by_numpy(x, rays, np.random.default_rng(1000 + seed))
    # No sum exceeds what frames can hold, and neither does one that holds a single frame cut off.
    assert ours.max() <= x.n_frames * x.highest_dn
    edges = np.unique(np.quantile(np.concatenate([ours.ravel(), theirs.ravel()]), np.linspace(0, 1, 61)[1:-1]))
    counts = [np.bincount(np.searchsorted(edges, one.ravel()), minlength=edges.size + 1) for one in (ours, theirs)]
    assert stats.chi2_contingency(np.array(counts)).pvalue > 1e-7
