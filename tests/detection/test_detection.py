"""Detection: calibrated nulls, probabilities against closed forms, inversions, and refusals."""

from typing import Any

import numpy as np
import pytest
from answers import STATISTICS
from scenes import instrument, star
from scipy import stats

from mauvecl import Detection, Engine, Linear

N = 1_000_000
#: The paper's G2V star, with flares around the edge of detection for one statistic or another.
AMPLITUDES = (0.03, 0.081, 0.15, 0.24)


@pytest.fixture(scope="module")
def found(engine: Engine) -> Detection:
    quiet, *flares = star(amplitudes=AMPLITUDES)
    return engine.detect(quiet, flares, realisations=N, seed=20, statistics=tuple(STATISTICS))


def ks_probability(d: Any, sf: object) -> float:
    """Return the probability of the Kolmogorov-Smirnov test at the edges of filled bins, 32 per standard deviation."""
    filled = np.flatnonzero(d.counts)
    # The last edge, too: all values in one bin are no distribution.
    edges = np.asarray(d.edge(np.unique(np.append(np.arange(filled[0], filled[-1] + 2, 16), filled[-1] + 1))))
    ours = np.array([d.above(x) / d.n for x in edges])
    theirs = np.array([sf(float(x)) for x in edges])
    return float(stats.kstwo.sf(np.abs(ours - theirs).max(), d.n))


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
def test_null_follows_its_closed_form(found: Detection, statistic: str) -> None:
    """Compare 1e6 realisations of a star for which Gaussian limits hold; fails once in 1e6 seeds."""
    d = found.distribution(statistic)
    # The smoothed sum is a generalised chi-squared, which test_statistics.py looks at.
    exact = stats.norm() if statistic in ("matched", "uv_excess") else stats.chi2(found.dof(statistic))
    exact = found.closed_form(statistic) if statistic == "paper" else exact
    assert ks_probability(d, exact.sf) > 1e-6
    assert d.far.n == 0


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("flare", range(len(AMPLITUDES)))
def test_flare_follows_its_closed_form(found: Detection, statistic: str, flare: int) -> None:
    """Compare the whole distribution under a flare, on its own grid, by the same test."""
    assert ks_probability(found.distribution(statistic, flare), found.closed_form(statistic, flare).sf) > 1e-6


def test_delong_interval_agrees_with_repeated_draws(engine: Engine) -> None:
    """Check that 178 of 200 intervals contain the exact area; fails once in 1e4 new seeds."""
    quiet, flare = star(amplitudes=(0.015,), payload=instrument(output_min_nm=300.0, output_max_nm=310.0))
    held = 0
    for seed in range(200):
        found = engine.detect(quiet, [flare], realisations=400, seed=seed, statistics="matched")
        if seed == 0:
            null, with_flare = (found.closed_form("matched", f) for f in (None, 0))
            gap = (with_flare.mean - null.mean) / np.hypot(null.std, with_flare.std)
            assert 0.3 < gap < 1.5
        area = found.roc("matched", 0).area
        held += area.low <= stats.norm.cdf(gap) <= area.high
    assert held >= 178
    assert stats.binom.cdf(177, 200, 0.95) < 3e-4


def test_tail_samples_are_reproducible_extremes(engine: Engine) -> None:
    quiet, flare = star(amplitudes=(0.081,))
    kind = {"seed": 3, "start": 70, "statistics": ("chi2", "matched")}
    found = engine.detect(quiet, [flare], realisations=3000, **kind)
    values = engine.statistic_values(quiet, [flare], count=3000, **kind)
    for statistic, null, with_flare in (("chi2", 0, 3), ("matched", 6, 7)):
        largest, smallest = found.tail_samples(statistic), found.tail_samples(statistic, 0)
        np.testing.assert_array_equal(largest["value"], np.sort(values[null])[::-1][:1000])
        np.testing.assert_array_equal(smallest["value"], np.sort(values[with_flare])[:1000])
        np.testing.assert_array_equal(values[null][largest["realisation"] - 70], largest["value"])


def test_saturated_pixels_are_left_out(engine: Engine) -> None:
    """Check that pixels saturated without a flare do not enter, and that the others give a calibrated null."""
    payload = instrument(part=True)
    quiet, flare = star(magnitude=-0.17, amplitudes=(0.05,), exposure=10.0, payload=payload)
    assert 0 < quiet.saturated.sum() < 10
    found = engine.detect(quiet, [flare], realisations=100_000, seed=3)
    dof = int((~quiet.saturated).sum())
    assert found.dof("chi2") == dof
    assert found.scene.frames
    mean = found.distribution("chi2").mean
    assert abs(mean - dof) < 5 * np.sqrt(2 * dof / 100_000)


@pytest.mark.long
def test_own_weights_define_a_statistic(engine: Engine) -> None:
    """Give the matched filter as weights, and compare other weights with their normal distribution."""
    quiet, *flares = star(amplitudes=AMPLITUDES)
    delta = flares[1].signal_dn - quiet.signal_dn
    twin = Linear("twin", delta / quiet.variance_dn2 / np.sqrt(np.sum(delta**2 / quiet.variance_dn2)))
    slope = Linear("slope", np.linspace(-1.0, 2.0, delta.size))
    found = engine.detect(
        quiet, flares, realisations=N, seed=3, statistics=("matched", twin, "uv_excess", slope, "chi2")
    )
    assert found.statistics == ("matched", "twin", "uv_excess", "slope", "chi2")
    for flare in (None, 1):
        ours, wanted = found.distribution("twin", flare), found.distribution("matched", flare, template=1)
        # The weights differ in their last bits.
        assert (ours.mean, ours.std) == pytest.approx((wanted.mean, wanted.std), rel=1e-5, abs=1e-5)
        assert np.abs(ours.counts.astype(int) - wanted.counts).sum() < 0.01 * N
        for name in ("slope", "uv_excess"):
            d = found.distribution(name, flare)
            assert ks_probability(d, found.closed_form(name, flare).sf) > 1e-6
    assert found.dof("slope") == 1
