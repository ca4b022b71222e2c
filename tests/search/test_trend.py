"""Unknowns beyond first order in sums that NumPy draws alone; `test_injections.py` counts their false alarms."""

from __future__ import annotations

import numpy as np
import pytest
from searches import DAVENPORT, survey

from mauvecl import Stare
from mauvecl.search.flare_fits import SingleFlareFit
from mauvecl.search.templates import Baseline


def drawn(one, rng, count, farther):
    """Draw stares without a flare from the pixels' means and variances; return them and their unknown amplitudes.

    The dark of each pixel is exponential in the temperature; photons, dark and reading are normal.
    """
    x, weights, stare = one.components.quiet, one.components.weights, one.stare
    z = farther * rng.standard_normal((count, len(stare.unknowns)))
    change = {"star": 0.0, "light": 0.0, "sky": 0.0, "temperature": 0.0}
    for amplitude, unknown in zip(z.T, stare.unknowns, strict=True):
        change[unknown.of] = change[unknown.of] + amplitude[:, None] * unknown.sd * unknown.curve
    warmer = stare.temperature_c - x.conditions["temperature_c"] + change["temperature"]
    light = stare.light * (1 + change["light"])
    factors = (
        light * stare.star * (1 + change["star"]),
        light * stare.sky * (1 + change["sky"]),
        np.exp(x.conditions["dark_slope_per_c"] * warmer),
    )
    gain = x.gain_dn_per_electron
    means = (x.source_electrons * gain, x.sky_electrons * gain, np.broadcast_to(x.dark_dn, x.source_electrons.shape))
    steps = (gain, gain, x.dark_step_dn)
    shape = (count, stare.n_frames, len(weights))
    root = np.linalg.cholesky(weights * (x.read_noise_dn**2 + 1 / 12) @ weights.T)
    sums = rng.standard_normal(shape) @ root.T
    for factor, mean, step in zip(factors, means, steps, strict=True):
        factor = np.broadcast_to(factor, shape[:2])[..., None]
        root = np.linalg.cholesky(weights * mean * step @ weights.T)
        sums += (factor - 1) * (weights @ mean) + np.sqrt(factor) * (rng.standard_normal(shape) @ root.T)
    return sums, z


@pytest.fixture(scope="module")
def drifting():
    """Return a star whose detector warms by an unknown 0.3 deg C per hour, and its templates."""
    stare = Stare.of(11_360.0, drifts={"temperature": 0.3})
    return survey(stare, Baseline(), (25.0, 60.0, 120.0), star="K2.5V", magnitude=5.0)


def test_amplitudes_are_recovered(drifting):
    """Compare amplitudes up to four standard deviations of the prior, to thousandths of one."""
    one, _ = drifting
    sums, z = drawn(one, np.random.default_rng(2), 6, 2.0)
    found = one.trend.fitted(sums - one.known)
    assert np.abs(found - z).max() < 5e-3


def test_trend_of_zero_changes_nothing():
    """Check that unknowns of light alone, or of an unbent dark, leave sums unchanged."""
    for unknowns in ({"drifts": {"star": 0.01}}, {"drifts": {"temperature": 1e-4}}, {}):
        one, _ = survey(Stare.of(6000.0, **unknowns), Baseline(), (25.0,), part=True)
        assert one.trend is None


@pytest.mark.parametrize("size", [20.0, 100.0, 1000.0])
def test_flares_equal_those_without_a_drift(drifting, size):
    """Compare values and energies of flares with three drifts and without one, in the same noise.

    Within 1 % or half a standard deviation, for flares that a search finds at 20 to 1000.
    """
    one, templates = drifting
    plain, _ = survey(Stare.of(11_360.0), Baseline(), (25.0, 60.0, 120.0), star="K2.5V", magnitude=5.0)
    peak, width = 3000.0, 60.0
    edges = np.column_stack([one.stare.start_s, one.stare.start_s + 5.0])
    shape = DAVENPORT.mean_over(edges, peak, width)
    unit = np.ones(5)
    response = one.components.means(unit)
    amplitude = size / np.linalg.norm(shape) / np.linalg.norm(response)
    flare = amplitude * shape[:, None] * response
    x, weights = one.components.quiet, one.components.weights
    noise = np.random.default_rng(4).standard_normal((1, one.stare.n_frames, len(weights)))
    fit, values, energies = SingleFlareFit(one.bank, templates), [], []
    for drift in (None, -2.5, 1.0, 3.0):
        sums = noise + flare
        if drift is not None:
            change = drift * one.stare.unknowns[0].sd * one.stare.unknowns[0].curve
            sums = sums + np.expm1(x.conditions["dark_slope_per_c"] * change)[:, None] * (weights @ x.dark_dn)
        net = (plain if drift is None else one).net(sums)
        values.append(one.search.largest(net).maximum[0])
        found = fit.run(
            net, one.stare.start_s, peak_s=[peak], half_width_s=[width],
            variance=one.search.variance,
        )  # fmt: skip
        energies.append(found.equivalent_duration_s[0])
    assert values[1:] == pytest.approx([values[0]] * 3, rel=0.01, abs=0.5)
    assert energies[1:] == pytest.approx([energies[0]] * 3, rel=max(0.01, 0.5 / size))
