"""Distributions of factors as nodes, compared with the priors' moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import instrument, star

from mauvecl import Normal, Processes, Uniform
from mauvecl.noise.scene import FactorDistributions, changes_of, prepare


def drawn(**priors: Normal | Uniform) -> tuple[FactorDistributions, float]:
    """Return the distributions for a few pixels, and the slope of the dark with temperature."""
    quiet, *_ = star(payload=instrument(part=True))
    found = FactorDistributions.of(prepare([quiet], processes=Processes(**priors)))
    assert found is not None
    return found, quiet.conditions["dark_slope_per_c"]


def test_moments_equal_those_of_priors() -> None:
    """Compare the exponential of a normal temperature, a uniform loss and the mean jitter of ten frames, to float32."""
    found, slope = drawn(detector_temperature=Normal(21.0, 0.5, 17.0, 25.0))
    dark, s2 = found.spreads["dark"], (slope * 0.5) ** 2
    assert dark.mean == pytest.approx(np.exp(s2 / 2), rel=2e-6)
    assert dark.sd == pytest.approx(np.exp(s2 / 2) * np.sqrt(np.expm1(s2)), rel=2e-4)
    assert not dark.normal
    found, _ = drawn(qe_scale=Uniform(0.7, 1.1))
    light = found.spreads["light"]
    assert light.mean == pytest.approx(0.9, rel=1e-5)
    assert light.sd == pytest.approx(0.4 / np.sqrt(12), rel=1e-3)
    assert not light.normal
    found, _ = drawn(jitter=Uniform(0.0, 0.05), qe_scale=Normal(1.0, 0.01, 0.9, 1.1))
    light = found.spreads["light"]
    assert light.mean == pytest.approx(0.975, rel=1e-5)
    assert light.sd == pytest.approx(np.hypot(0.05 / np.sqrt(120), 0.975 * 0.01), rel=1e-3)
    assert light.normal


@pytest.mark.parametrize("weighted", [True, False])
def test_nodes_sum_to_one_and_have_mean_of_factors(weighted: bool) -> None:
    """Check the sum of probabilities and the means of factors."""
    quiet, *_ = star("K3V", 3.7, payload=instrument(part=True))
    how = Processes(
        jitter=Uniform(0.0, 0.05),
        detector_temperature=Uniform(20.0, 23.0),
        light_loss=Uniform(0.2, 0.5),
        sky_level=Normal(1.0, 0.1, 0.5, 1.5),
    )
    found = FactorDistributions.of(prepare([quiet], processes=how))
    assert found is not None
    nodes, rows = found.nodes(quiet, weighted=weighted)
    share = np.array([node.probability for node in nodes])
    assert share.sum() == pytest.approx(1.0, abs=1e-12)
    for name in ("light", "dark", "sky"):
        assert share @ [getattr(node, name) for node in nodes] == pytest.approx(found.spreads[name].mean, rel=1e-4)
    # The sky alone is faint enough to be an amplitude.
    assert rows.shape == (1, quiet.wavelength_nm.size)
    assert rows[0] == pytest.approx(found.spreads["sky"].sd * quiet.sky_dn)


@pytest.mark.parametrize("magnitude", [-2.0, -1.2, -1.0, 2.0])
def test_changes_are_slopes_of_recorded_moments(magnitude: float) -> None:
    """Compare with a star whose light, or dark, is larger by 1e-5, where no, some and most pixels saturate."""
    quiet, *_ = star("K3V", magnitude, payload=instrument(part=True))
    means, variances = changes_of(quiet)
    step = 1e-5
    light = ("source_electrons", "sky_electrons", "neighbour_electrons")
    for row, names in ((0, light), (1, light[1:2]), (2, ("dark_dn",))):
        moved = replace(quiet, **{name: getattr(quiet, name) * (1 + step) for name in names})
        slope, unclipped = (
            (moved.recorded_dn - quiet.recorded_dn) / step,
            (moved.mean_raw_dn - quiet.mean_raw_dn) / step,
        )
        # The width of the distribution changes too, by much less than its mean.
        assert slope / quiet.n_frames == pytest.approx(means[row] / quiet.n_frames, abs=5e-3 * unclipped.max())
    # Dark and light together are all of what factors change: without them the variance is not negative.
    assert (quiet.variance_dn2 - variances[0] - variances[2] >= 0).all()
    assert (means >= 0).all()
    assert (quiet.cut_share.max() > 0.1) == (magnitude < 0)
