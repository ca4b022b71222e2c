"""The orbit, compared with SGP4's verification vectors, astropy's frames, and closed forms."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import sgp4
from refusals import refused

from mauvecl.host.orbit.earth import direction
from mauvecl.host.orbit.elements import Elements
from mauvecl.host.orbit.orbit import MEAN_FROM_D, Orbit, Track
from mauvecl.host.orbit.time_grid import TimeGrid, utc_text
from mauvecl.host.tables.times import offline
from mauvecl.schema.errors import InputError

VECTORS = Path(sgp4.__file__).parent


@pytest.fixture(scope="module")
def orbit() -> Orbit:
    return Orbit.load()


@pytest.fixture(scope="module")
def day(orbit: Orbit) -> Track:
    """Return the track of a day at the elements' epoch."""
    return orbit.track(TimeGrid("2026-09-14T12:00", 1.0, 60.0))


def verification() -> list[tuple[str, str, list[list[float]]]]:
    """Read elements and rows (minutes, x, y, z) of each satellite in the verification of SGP4."""
    lines = (VECTORS / "SGP4-VER.TLE").read_text().splitlines()
    tles = [(a[:69], b[:69]) for a, b in pairwise(lines) if a[:2] == "1 " and b[:2] == "2 "]
    blocks: list[list[list[float]]] = []
    for line in (VECTORS / "tcppver.out").read_text().splitlines():
        if line.rstrip().endswith("xx"):
            blocks.append([])
        elif line.strip():
            blocks[-1].append([float(word) for word in line.split()[:4]])
    return [(*tle, rows) for tle, rows in zip(tles, blocks, strict=True)]


def test_positions_equal_those_of_the_sgp4_verification() -> None:
    """Check gravity model and fields with all satellites whose lines have correct checksums."""
    seen = 0
    for first, second, rows in verification():
        try:
            elements = Elements(first, second, "SGP4-VER")
        except InputError:
            continue
        for minutes, *place in rows:
            error, position, _ = elements.satellite.sgp4_tsince(minutes)
            if not error:
                assert position == pytest.approx(place, abs=2e-5), (first, minutes)
                seen += 1
    assert seen > 400


def test_track_matches_the_verification_vectors() -> None:
    """Compare a low orbit at the times of a plan; the text of its epoch is accurate to 20 m."""
    first, second, rows = next(one for one in verification() if one[0][2:7] == "06251")
    elements = Elements(first, second, "SGP4-VER")
    minutes = np.array([row[0] for row in rows])
    step = float(minutes[1] - minutes[0]) * 60
    start = utc_text(elements.epoch_jd + (minutes[0] * 60 - step / 2) / 86_400, 6)
    track = Orbit(elements, "tle").track(TimeGrid(start, len(rows) * step / 86_400, step))
    assert np.abs(track.of_date_km - np.array(rows)[:, 1:]).max() < 0.02


@pytest.mark.long
def test_frames_agree_with_astropy(day: Track) -> None:
    with offline():
        import astropy.units as u
        from astropy.coordinates import GCRS, ITRS, TEME, CartesianRepresentation, get_body
        from astropy.time import Time

        times = Time(*day.times.julian, format="jd", scale="utc")
        here = TEME(CartesianRepresentation(day.of_date_km.T * u.km), obstime=times)
        there = here.transform_to(GCRS(obstime=times)).cartesian.xyz.to_value("km").T
        place = here.transform_to(ITRS(obstime=times)).earth_location.geodetic
        moon = get_body("moon", times).cartesian.xyz.to_value("km").T
        sun = get_body("sun", times).cartesian.xyz.to_value("km").T
    assert np.abs(there - day.position_km).max() < 0.005
    longitude, latitude = day.subsatellite_deg
    assert np.abs((place.lon.deg - longitude + 180) % 360 - 180).max() < 0.005  # UT1 - UTC
    assert np.abs(place.lat.deg - latitude).max() < 0.001
    assert np.abs(moon - day.bodies.moon_km).max() < 2.0  # 1 arcsec
    assert np.abs(sun / np.linalg.norm(sun, axis=1)[:, None] - day.bodies.sun).max() < 5e-7


@pytest.mark.long
def test_orbit_has_the_documented_values(orbit: Orbit, day: Track) -> None:
    """Compare with TIME.md, section 5."""
    from mauvecl.host.orbit.radiation import proton_map
    from mauvecl.host.orbit.visibility import in_shadow

    elements = orbit.elements
    assert elements.period_s / 60 == pytest.approx(94.635, abs=0.001)
    assert elements.axis_km == pytest.approx(6879.0, abs=0.1)
    assert elements.epoch == "2026-09-14T15:42:13"
    assert day.local_time_h.mean() * 60 == pytest.approx(10 * 60 + 26, abs=0.5)
    # Ten whole orbits; a step of 20 s is 0.04 % of them.
    whole = orbit.track(TimeGrid("2026-09-14T12:00", 10 * elements.period_s / 86_400, 20.0))
    assert in_shadow(whole).mean() == pytest.approx(0.368, abs=0.002)
    year = orbit.track(TimeGrid("2026-09-14", 365.0, 7200.0))
    assert 16.5 < year.beta_deg.min() < 18.5
    assert 27.5 < year.beta_deg.max() < 28.5
    month = orbit.track(TimeGrid("2026-09-14", 30.0, 60.0))
    flux = proton_map().at(*month.subsatellite_deg)
    shares = [100 * float((flux > limit).mean()) for limit in (1, 10, 100)]
    assert shares == pytest.approx([6.3, 5.0, 3.2], abs=0.15)
    longitude, latitude = (np.asarray(values)[flux > 10] for values in month.subsatellite_deg)
    ends = [longitude.min(), longitude.max(), latitude.min(), latitude.max()]
    assert ends == pytest.approx([-71, 31, -55, -10], abs=2.0)  # cells are 2 deg wide


def test_mean_orbit_begins_at_the_satellite(orbit: Orbit) -> None:
    """Check that it begins at SGP4's position, keeps its local time, and is described as a mean orbit."""
    near = TimeGrid("2026-09-14T15:00", 0.1, 30.0)
    mean, exact = (Orbit(orbit.elements, kind).track(near) for kind in ("mean", "tle"))
    apart = np.linalg.norm(mean.of_date_km - exact.of_date_km, axis=1)
    assert apart.max() < 30  # short-period terms of J2 and the eccentricity
    later = TimeGrid("2027-06-01", 30.0, 60.0)
    assert orbit.resolved(later) == "mean"
    assert np.abs(orbit.track(later).local_time_h - mean.local_time_h.mean()).max() < 0.01
    assert "mean Sun-synchronous" in orbit.messages(later)[0]
    # J2 turns the node of these very elements nearly as fast as the Sun moves.
    assert orbit.elements.node_drift_deg_per_day == pytest.approx(0.98565, abs=0.002)


def test_mean_orbit_follows_sgp4_for_a_fortnight(orbit: Orbit) -> None:
    """Compare node and place along the orbit, except for drag, which only SGP4 has."""
    fortnight = TimeGrid("2026-09-28T00:00", 0.1, 30.0)
    mean, exact = (Orbit(orbit.elements, kind).track(fortnight) for kind in ("mean", "tle"))
    assert np.degrees(np.arccos((mean.normal * exact.normal).sum(axis=1))).max() < 0.1
    apart = np.linalg.norm(mean.of_date_km - exact.of_date_km, axis=1).max()
    assert apart < 3 * orbit.along_track_km(14)


def test_messages_about_the_epoch(orbit: Orbit) -> None:
    assert orbit.messages(TimeGrid("2026-09-20", 5.0)) == []
    reported = orbit.messages(TimeGrid("2026-10-10", 5.0))
    assert len(reported) == 1
    assert "along its track" in reported[0]
    assert orbit.along_track_km(30) == pytest.approx(1 + 60 + 0.5 * 5.125e-5 * 900 * 2 * np.pi * 6879.04, rel=1e-4)
    assert orbit.farthest_d(TimeGrid("2026-10-10", 5.0)) < MEAN_FROM_D


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("no elements here", ("elements",)),
        ("1 66756U 25276CU  26257.65431682  .00005125  00000+0  22992-3 0  9997\n2 66756", ("elements",)),
        ("1 66756U\n2 66756", ("elements", "69")),
    ],
)
def test_invalid_elements_raise(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    (tmp_path / "bad.tle").write_text(text)
    with refused(*words):
        Orbit.load(tmp_path / "bad.tle")


def test_elements_from_a_file(tmp_path: Path, orbit: Orbit) -> None:
    text = f"MAUVE\n{orbit.elements.first}\n{orbit.elements.second}\n"
    (tmp_path / "own.tle").write_text(text)
    assert Orbit.load(tmp_path / "own.tle").elements.satellite.ndot == orbit.elements.satellite.ndot


@pytest.mark.parametrize("start", ["2027-01-01", "2027-01-01T11:59:59", "2027-01-01T12:00:01", "2027-01-01T23:59:59.5"])
def test_days_begin_at_midnight(start: str) -> None:
    """Check all divisions of a date into two numbers by astropy."""
    times = TimeGrid(start, 1.0, 3600.0)
    midnight, fraction = times.first
    assert midnight % 1 == 0.5
    assert 0 <= fraction < 1
    assert times.iso(0.0, 1) == f"{start}T00:00:00.0" if len(start) == 10 else f"{start}.0"[:21]
    assert np.floor(times.julian[1][0]) == 0 or start.endswith("59.5")


def test_global_state_is_restored(orbit: Orbit) -> None:
    from astropy.coordinates import solar_system_ephemeris
    from astropy.utils import iers

    before = iers.conf.auto_download, solar_system_ephemeris.get()
    _ = orbit.track(TimeGrid("2027-03-01", 1.0)).beta_deg
    assert (iers.conf.auto_download, solar_system_ephemeris.get()) == before


def test_direction_of_coordinates() -> None:
    assert direction(90.0, 0.0) == pytest.approx([0, 1, 0], abs=1e-15)
    assert direction(np.array([0.0, 10.0]), 90.0)[1] == pytest.approx([0, 0, 1], abs=1e-15)
