"""Closed forms of weighted sums over drawn unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import star

from mauvecl import Normal, Nuisances, Processes, Uniform
from mauvecl.detection.requests import STATISTICS
from mauvecl.detection.statistics import Differences, Setting
from mauvecl.noise.scene import FactorDistributions, changes_of, prepare


@pytest.mark.parametrize("name", ["matched", "uv_excess"])
def test_weighted_sums_over_drawn_unknowns_have_the_moments_of_their_nodes(name: str) -> None:
    """Compare each node's mean and variance with the sums over pixels at its temperature and light."""
    quiet, flare = star(amplitudes=(0.1,))
    processes = Processes(
        jitter=Uniform(0.0, 0.05),
        detector_temperature=Normal(21.0, 0.5, 18.5, 23.5),
        sky_level=Normal(1.0, 0.1, 0.5, 1.5),
    )
    drawn, statistic = FactorDistributions.of(prepare([quiet], processes=processes)), STATISTICS[name]
    setting = Setting(quiet, ~quiet.saturated, nuisances=Nuisances.of(quiet, {"dark": 0.5, "sky": 0.1}))
    assert drawn is not None
    nodes, rows = drawn.nodes(flare, weighted=True)
    amounts = np.array([node.amounts for node in nodes])
    assert len(nodes) > 100
    means, variances = changes_of(flare)
    delta = flare.recorded_light_dn - quiet.recorded_light_dn
    weights = statistic.weights_per_dn(setting, flare)
    seen = Differences(delta, flare.variance_dn2, scatter=rows)
    found = statistic.moved_forms(setting, seen, amounts, means, variances, flare)
    for one, amount in zip(found, amounts, strict=True):
        variance = weights**2 @ (flare.variance_dn2 + amount @ variances) + np.sum((rows @ weights) ** 2)
        wanted = float(weights @ (delta + amount @ means)), float(np.sqrt(variance))
        assert (one.mean, one.std) == pytest.approx(wanted, rel=1e-12)
