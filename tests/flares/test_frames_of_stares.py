"""Frames and gaps of stares, curves over frames, unknowns, and stares along the orbit."""

from typing import Any

import numpy as np
import pytest
from astropy.time import Time
from scenes import paper
from scipy.integrate import quad

from mauvecl import Sinusoid, Stare, Study, stare, visible


def points(*values):
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
        Study().stare.orbit_s, thermal=0.5, temperature_c=13.0, variability=points((0.0, 0.0), (6000.0, 0.06)),
        jitters={"light": 0.02, "temperature": 0.01}, offsets={"sky": 0.1}, drifts={"light": 0.01},
        cycles={"temperature": 0.3},
    )  # fmt: skip
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


START, HOURS = "2026-09-20T03:00:00", 8.0


def asked(start: str = START, hours: float = HOURS, *settings: str) -> Any:
    orbit = ["orbit.targets=['eps Eri']", f"orbit.start='{start}'", f"orbit.days={hours / 24}", "orbit.step_s=5"]
    frames = ["stare.along_orbit=true", f"stare.duration_s={hours * 3600}", "stare.search=false"]
    return paper(*orbit, *frames, *settings)


def frames_of(*given: Any) -> Stare:
    return stare(asked(*given)).stares[0].staring.stare


@pytest.fixture(scope="module")
def night() -> Stare:
    return frames_of(START, HOURS, "stare.drifts.light=0.01", "stare.offsets.sky=0.1")


def test_frames_are_those_of_the_windows(night: Stare) -> None:
    windows = visible(asked()).tables["windows"]
    first = Time(START).mjd
    ends = [(Time(list(windows[name])).mjd - first) * 86_400 for name in ("start", "stop")]
    np.testing.assert_allclose(night.gtis, np.column_stack(ends), atol=1.0)
    assert 0 < night.n_frames < HOURS * 720
    assert sorted(one.name for one in night.unknowns) == ["light drift", "sky offset"]
    # Most of a drift about the middle of the stare is still there: the curve is the whole stare's.
    drift = next(one for one in night.unknowns if one.of == "light")
    np.testing.assert_allclose(drift.curve, (night.middle_s - HOURS * 1800) / 3600)


def test_temperature_follows_the_orbit(night: Stare) -> None:
    """Check ends, shadow as in the table of windows up to the penumbra of 8 s, and independence of the start time."""
    assert ((night.temperature_c > 13) & (night.temperature_c < 21)).all()
    windows = visible(asked()).tables["windows"]
    for (start, stop), minutes in zip(night.gtis, windows["in_shadow"].value, strict=True):
        inside = (night.start_s >= start) & (night.start_s < stop)
        falls = np.diff(night.temperature_c[inside]) < 0
        assert falls.any()
        assert not falls.all()
        assert falls.sum() * 5.0 == pytest.approx(60 * minutes, abs=20.0)
    later = frames_of("2026-09-20T07:00:00", 4.0)
    same = night.temperature_c[night.start_s >= 4 * 3600]
    assert later.temperature_c == pytest.approx(same, abs=0.02)  # of 8 deg C, after 8 time constants


def test_source_of_the_orbit_is_stated() -> None:
    assert any("assumptions" in line for line in stare(asked()).messages)
    assert sum("mean Sun-synchronous" in line for line in stare(asked("2027-01-10")).messages) == 1
    assert not any("orbit" in line for line in stare(paper("stare.search=false")).messages)
