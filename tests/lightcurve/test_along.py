"""Stares along the orbit: the frames are those in which the target is seen, and the temperature follows the shadow."""

import numpy as np
import pytest
from refusals import refused

from mauvecl.host.orbit.conditions import Thermal
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.host.orbit.orbit import Orbit
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import TimeGrid
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.lightcurve.stares.orbit_stare import OrbitStare, stare_along

START, HOURS = "2026-09-20T03:00:00", 8.0


@pytest.fixture(scope="module")
def orbit() -> Orbit:
    return Orbit.load()


@pytest.fixture(scope="module")
def night(orbit: Orbit) -> OrbitStare:
    return stare_along(orbit, "eps Eri", START, HOURS * 3600, drifts={"light": 0.01}, offsets={"sky": 0.1})


def test_frames_are_those_of_the_windows(orbit: Orbit, night: OrbitStare) -> None:
    track = orbit.track(TimeGrid(START, HOURS / 24, 5.0))
    windows = Visibility.of(track, Target.of("eps Eri").direction[None]).windows(0)
    assert night.stare.gtis == pytest.approx(np.column_stack([windows.start_s, windows.stop_s]))
    assert 0 < night.stare.n_frames < HOURS * 720
    assert night.stare.unknowns[0].curve.shape == (night.stare.n_frames,)
    # Most of a drift about the middle of the stare is still there: the curve is the whole stare's.
    drift = next(one for one in night.stare.unknowns if one.of == "light")
    assert drift.curve == pytest.approx((night.stare.middle_s - HOURS * 1800) / 3600)


def test_temperature_follows_the_orbit(orbit: Orbit, night: OrbitStare) -> None:
    """Check that it stays between both ends, falls in shadow, rises in sunlight, and depends on no start time."""
    stare, dark = night.stare, night.in_shadow
    assert dark.any()
    assert not dark.all()
    assert ((stare.temperature_c > 13) & (stare.temperature_c < 21)).all()
    together = np.diff(stare.numbers) == 1
    steady = together & (dark[1:] == dark[:-1])
    change = np.diff(stare.temperature_c)
    # The penumbra, 8 s, is neither.
    assert (np.sign(change) == np.where(dark[1:], -1, 1))[steady].mean() > 0.99
    later = stare_along(orbit, "eps Eri", "2026-09-20T07:00:00", 3600.0 * 4)
    same = stare.temperature_c[stare.start_s >= 4 * 3600]
    assert later.stare.temperature_c == pytest.approx(same, abs=0.02)  # of 8 deg C, after 8 time constants


def test_thermal_curve_and_hits_can_be_given(orbit: Orbit) -> None:
    still = stare_along(orbit, "eps Eri", START, 7200.0, thermal=Thermal(15.0, 15.0))
    assert still.stare.temperature_c == pytest.approx(15.0)
    everywhere = Limits(earth_limb_deg=None, sun_deg=None, moon_deg=None, declination_deg=None, proton_flux=None)
    through = stare_along(orbit, "eps Eri", START, 24 * 3600.0, frame_s=60.0, limits=everywhere)
    outside = stare_along(orbit, "eps Eri", START, 24 * 3600.0, frame_s=60.0)
    assert through.hits_per_cm2_s.max() > 100  # the anomaly
    assert outside.hits_per_cm2_s.max() < 10
    assert through.stare.n_frames == 1440
    assert through.mean_hits_per_cm2_s > outside.mean_hits_per_cm2_s >= 1.0


def test_target_is_given_by_name_or_position(orbit: Orbit, night: OrbitStare) -> None:
    found = stare_along(orbit, Target.of("eps Eri"), START, HOURS * 3600).stare
    assert found.start_s == pytest.approx(night.stare.start_s)
    assert night.messages == ()
    assert "along its track" in stare_along(orbit, "eps Eri", "2026-10-20", 7200.0).messages[0]


def test_study_has_a_stare_along_the_orbit(orbit: Orbit, night: OrbitStare) -> None:
    from mauvecl import Study
    from mauvecl.study.cases import Case
    from mauvecl.study.stare_expectation import orbit_lines

    study = Study().with_settings(
        ["stare.along_orbit=true", f"stare.duration_s={HOURS * 3600}", "orbit.targets=['eps Eri']",
         f"orbit.start='{START}'", "stare.offsets.sky=0.1"]
    )  # fmt: skip
    found = Case(study).stare
    assert found.start_s == pytest.approx(night.stare.start_s)
    assert found.temperature_c == pytest.approx(night.stare.temperature_c)
    assert [one.name for one in found.unknowns] == ["sky offset"]
    later = study.with_settings(["orbit.start=2027-06-01"])
    assert "assumptions" in orbit_lines(study.stare, study.orbit, 5.0)[-1]
    assert "mean Sun-synchronous" in orbit_lines(later.stare, later.orbit, 5.0)[0]
    assert orbit_lines(Study().stare, Study().orbit, 5.0) == []
    for wrong in ("stare.orbit_gap_s=100", "orbit.targets=['eps Eri', 'Vega']"):
        with refused("stare.along_orbit"):
            _ = Case(study.with_settings([wrong])).stare
