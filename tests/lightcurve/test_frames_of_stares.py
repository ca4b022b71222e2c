"""Frames and gaps of stares, curves over frames, and unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import instrument, star
from scipy.integrate import quad

from mauvecl import Sinusoid, Stare, Study


def points(*values):
    """Return a curve through some points, as of a study."""
    return Study.build({"stare": {"variability": {"points": values}}}, "test").stare.variability


def test_frames_skip_gaps():
    stare = Stare.of(5998, gaps=[(1000, 2000), (3001, 3004.9)])
    assert stare.n_frames == 1200 - 200 - 1
    assert stare.duration_s == 6000.0
    assert stare.observed_s == 5 * stare.n_frames
    np.testing.assert_array_equal(stare.gtis, [[0, 1000], [2000, 3000], [3005, 6000]])
    np.testing.assert_array_equal(stare.numbers * 5.0, stare.start_s)
    assert not stare.start_s.flags.writeable


@pytest.mark.parametrize("curve", [Sinusoid(0.3, 400.0, 1.0), points((20, 1.0), (33, -2.0), (36, 5.0), (90, 0.5))])
def test_curves_are_averaged_over_frames(curve):
    def at(t):
        if isinstance(curve, Sinusoid):
            return curve.amplitude * np.sin(2 * np.pi * t / curve.period_s + curve.phase)
        return np.interp(t, *zip(*curve.points, strict=True))

    start = np.arange(0.0, 120.0, 5.0)
    exact = [quad(at, t, t + 5.0, points=[20.0, 33.0, 36.0, 90.0])[0] / 5.0 for t in start]
    np.testing.assert_allclose(curve.mean_over(start, 5.0), exact, atol=1e-12)


def test_known_conditions_and_unknowns_are_separate():
    stare = Stare.of(
        Study().stare.orbit_s,
        thermal=0.5,
        temperature_c=13.0,
        variability=points((0.0, 0.0), (6000.0, 0.06)),
        jitters={"light": 0.02, "temperature": 0.01},
        offsets={"sky": 0.1},
        drifts={"light": 0.01},
        cycles={"temperature": 0.3},
    )
    assert np.ptp(stare.temperature_c) == pytest.approx(1.0, abs=1e-4)
    assert stare.temperature_c.mean() == pytest.approx(13.0, abs=1e-3)
    np.testing.assert_allclose(stare.star, 1 + 1e-5 * stare.middle_s)
    np.testing.assert_array_equal(stare.sky, 1.0)
    assert stare.jitters == {"light": 0.02, "sky": 0.0, "temperature": 0.01}
    named = {unknown.name: unknown for unknown in stare.unknowns}
    assert list(named) == ["sky offset", "light drift", "temperature sine", "temperature cosine"]
    drift = named["light drift"].curve
    assert drift.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(drift) == pytest.approx((stare.n_frames - 1) * 5 / 3600)
    sine, cosine = named["temperature sine"].curve, named["temperature cosine"].curve
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0, atol=1e-5)


def test_dark_current_follows_the_law_of_the_instrument():
    (quiet,) = star(payload=instrument(part=True))
    stare = Stare.of(50.0, thermal=points((0.0, 1.0), (50.0, 1.0)))
    np.testing.assert_allclose(stare.dark_factor(quiet), np.exp(0.0684))
