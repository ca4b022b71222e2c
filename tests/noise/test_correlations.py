"""Independence of draws, for every method and every mixture of methods in a group."""

from typing import Any

import exact
import numpy as np
import pytest

from mauvecl import CosmicRays, Engine, Expectation, Normal, Processes
from mauvecl.noise import layout
from mauvecl.noise.scene import prepare

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
    "dark by every mixture": (detector(MIXED, 0.0), {}),
    "photons by every mixture": (detector(0.0, MIXED, photon_noise="poisson"), {}),
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
    """Correlate values, squares and neighbours' products of 64 pixels in two frames.

    The limit |z| < 6.5 for 73 000 correlations fails once in 1e5 seeds per scene, and 1.5 times as often with the long
    tails of squares.
    """
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
