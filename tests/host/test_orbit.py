"""The orbit, what is seen from it, and the zodiacal light, compared with SGP4's verification, astropy and geometry."""

import re
import socket
import sys
import threading
from concurrent.futures import Future
from datetime import datetime
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import astropy.units as u
import numpy as np
import pytest
import sgp4
from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord, get_sun, solar_system_ephemeris
from astropy.table import Table
from astropy.time import Time
from astropy.utils import iers
from refusals import refused
from scipy.interpolate import RegularGridInterpolator
from tables import DATA

import mauvecl
from mauvecl import InputError, Sky, Study, plan, visible

VECTORS = Path(sgp4.__file__).parent
PROTONS = Path(mauvecl.__file__).parent / "host" / "orbit" / "protons.ecsv"
EARTH_KM = 6378.137
NAMES = ("eps Eri", "AU Mic", "V889 Her", "EK Dra", "DX Leo")
NO_LIMITS = dict.fromkeys(("earth_limb_deg", "sun_deg", "moon_deg", "declination_deg", "proton_flux"), "none")
MONTH = {"start": "2026-12-20T06:30", "days": 40.0, "targets": list(NAMES)}


def section(**orbit: Any) -> Any:
    return Study.build({"orbit": orbit}, "test").orbit


def track(**orbit: Any) -> Any:
    made = section(**orbit)
    return made.orbit().track(made.times())


def seen(**orbit: Any) -> Any:
    return visible(Study.build({"orbit": orbit}, "test")).visibility


@pytest.fixture(scope="module")
def month() -> Any:
    return seen(**MONTH)


def degrees_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between vectors of shapes (n, 3) and (k, 3), or (n, 3) each."""
    one, other = (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True) for vectors in (one, other))
    cosine = np.einsum("ni,ni->n", one, other) if one.shape == other.shape else one @ other.T
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


LINES = (VECTORS / "SGP4-VER.TLE").read_text().splitlines()
#: Elements of the satellites in the verification of SGP4, by number.
TLES = {a[2:7]: f"{a[:69]}\n{b[:69]}\n" for a, b in pairwise(LINES) if a[:2] == "1 " and b[:2] == "2 "}


def test_newest_elements_of_mauve_are_chosen_among_those_of_others(tmp_path: Path) -> None:
    mauve = section().orbit().elements
    older = f"{mauve.first[:20]}200{mauve.first[23:68]}"
    older += str(sum(int(one) if one.isdigit() else one == "-" for one in older) % 10)
    others = list(TLES.values())[:3]
    path = tmp_path / "group.tle"
    path.write_text("".join([*others, f"MAUVE\n{mauve.first}\n{mauve.second}\n{older}\n{mauve.second}\n"]))
    assert section(tle=str(path)).orbit().elements.first == mauve.first
    path.write_text(f"{older}\n{mauve.second}\n")
    assert section(tle=str(path)).orbit().elements.first == older
    path.write_text("".join(others))
    with refused("elements", "3 satellites", "00005", "66756"):
        section(tle=str(path)).orbit()


def test_track_matches_the_verification_vectors(tmp_path: Path) -> None:
    """Compare a low orbit at the times of a plan; the text of its epoch is accurate to 20 m."""
    (tmp_path / "own.tle").write_text(f"NAME\n{TLES['06251']}")
    block = (VECTORS / "tcppver.out").read_text().split("6251 xx")[1].split("xx")[0]
    # Minutes since the epoch and positions; the last line names the next satellite.
    minutes, *wanted = np.array([line.split()[:4] for line in block.splitlines()[1:-1]], float).T
    step = float(minutes[1] - minutes[0]) * 60
    # Times are the middles of steps.
    days = float(TLES["06251"][20:32]) - 1 + (minutes[0] * 60 - step / 2) / 86_400
    start = str(np.datetime64("2006-01-01", "us") + np.timedelta64(round(days * 86_400e6), "us"))
    when = {"start": start, "days": minutes.size * step / 86_400, "step_s": step}
    found = track(tle=str(tmp_path / "own.tle"), kind="tle", **when)
    assert np.abs(found.of_date_km - np.transpose(wanted)).max() < 0.02


@pytest.mark.long
def test_frames_agree_with_astropy() -> None:
    from astropy.coordinates import GCRS, ITRS, TEME, CartesianRepresentation, get_body

    day = track(start="2026-09-14T12:00", days=1.0)
    with iers.conf.set_temp("auto_download", False):
        times = Time(*day.times.julian, format="jd", scale="utc")
        here = TEME(CartesianRepresentation(day.of_date_km.T * u.km), obstime=times)
        there = here.transform_to(GCRS(obstime=times)).cartesian.xyz.to_value("km").T
        place = here.transform_to(ITRS(obstime=times)).earth_location.geodetic
        moon = get_body("moon", times).cartesian.xyz.to_value("km").T
        sun = get_body("sun", times).cartesian.xyz.to_value("km").T
    assert np.abs(there - day.position_km).max() < 0.005
    longitude, latitude = place.lon.deg - day.subsatellite_deg[0], place.lat.deg - day.subsatellite_deg[1]
    assert np.abs((longitude + 180) % 360 - 180).max() < 0.005  # UT1 - UTC
    assert np.abs(latitude).max() < 0.001
    assert np.abs(moon - day.bodies.moon_km).max() < 2.0  # 1 arcsec
    assert np.abs(sun / np.linalg.norm(sun, axis=1)[:, None] - day.bodies.sun).max() < 5e-7
    found = seen(days=0.1, targets=["90 0", "10 85", "200 -30"]).target
    wanted = SkyCoord([90, 10, 200] * u.deg, [0, 85, -30] * u.deg).cartesian.xyz.value.T
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@pytest.mark.long
def test_orbit_has_the_documented_values() -> None:
    elements = section().orbit().elements
    assert elements.period_s / 60 == pytest.approx(94.635, abs=0.001)
    assert elements.axis_km == pytest.approx(6879.0, abs=0.1)
    assert elements.epoch == "2026-09-14T15:42:13"
    assert track(start="2026-09-14T12:00", days=1.0).local_time_h.mean() * 60 == pytest.approx(626, abs=0.5)
    # Ten whole orbits; a step of 20 s is 0.04 % of them.
    whole = {"start": "2026-09-14T12:00", "days": 10 * elements.period_s / 86_400, "step_s": 20.0}
    assert seen(**whole, targets=["Vega"]).shadow.mean() == pytest.approx(0.368, abs=0.002)
    year = track(start="2026-09-14", days=365.0, step_s=7200.0)
    assert 16.5 < year.beta_deg.min() < 18.5
    assert 27.5 < year.beta_deg.max() < 28.5
    for flux, percent in ((1.0, 6.3), (10.0, 5.0), (100.0, 3.2)):
        found = seen(start="2026-09-14", days=30.0, targets=["Vega"], limits=NO_LIMITS | {"proton_flux": flux})
        assert 100 * (1 - found.kept_by["anomaly"][0]) == pytest.approx(percent, abs=0.15)


def test_mean_orbit_begins_at_the_satellite_and_keeps_its_local_time() -> None:
    """It begins at SGP4's position and follows it for a fortnight but for drag; messages say how far an orbit holds."""
    orbit = section().orbit()
    # Short-period terms of J2 and the eccentricity, and drag, which only SGP4 has.
    for start, most_km in (("2026-09-14T15:00", 30.0), ("2026-09-28T00:00", 3 * orbit.along_track_km(14))):
        mean, exact = (track(start=start, days=0.1, step_s=30.0, kind=kind) for kind in ("mean", "tle"))
        assert np.linalg.norm(mean.of_date_km - exact.of_date_km, axis=1).max() < most_km
        assert degrees_between(mean.normal, exact.normal).max() < 0.1
    times = section(start="2027-06-01", days=30.0).times()
    # The time farthest from the epoch counts, before or after it.
    early = section(start="2026-07-01", days=70.0).times()
    assert [orbit.resolved(times), orbit.resolved(early), orbit.resolved_at(-61.0)] == ["mean"] * 3
    assert np.abs(orbit.track(times).local_time_h - mean.local_time_h.mean()).max() < 0.01
    assert "mean Sun-synchronous" in orbit.messages(times)[0]
    assert orbit.messages(section(start="2026-09-20", days=5.0).times()) == []
    assert "along its track" in orbit.messages(section(start="2026-10-10", days=5.0).times())[0]
    assert orbit.along_track_km(30) == pytest.approx(1 + 60 + 0.5 * 5.125e-5 * 900 * 2 * np.pi * 6879.04, rel=1e-4)


def test_limits_apply_to_the_angles_and_shadow(month: Any) -> None:
    """Compare limits, computed with cosines in float32, and the shadow of half of the Sun with angles in float64."""
    path, target = month.track, month.target
    below = np.degrees(np.arcsin(EARTH_KM / np.linalg.norm(path.position_km, axis=1)))
    cone = degrees_between(path.normal, target)
    declination = np.broadcast_to(np.degrees(np.arcsin(target[:, 2])), cone.shape)
    for limit, over in (
        ({"earth_limb_deg": 25.0}, degrees_between(-path.position_km, target) - below[:, None] - 25.0),
        ({"sun_deg": 46.0}, degrees_between(path.bodies.sun, target) - 46.0),
        ({"moon_deg": 25.0}, degrees_between(path.bodies.moon_km - path.position_km, target) - 25.0),
        ({"normal_cone_deg": 60.0}, np.abs(cone - 90.0) - 30.0),
        ({"declination_deg": [-31.0, 0.0]}, np.minimum(-declination, declination + 31.0)),
    ):
        found = seen(**MONTH, limits=NO_LIMITS | limit)
        sure = np.abs(over) > 1e-4
        assert sure.mean() > 0.99
        assert (found.seen == (over >= 0))[sure].all()
        np.testing.assert_allclose(found.share, (over >= 0).mean(axis=0), atol=1e-3)
        assert list(found.kept_by) == [next(iter(limit)).removesuffix("_deg")]
        np.testing.assert_allclose(found.kept_by[next(iter(found.kept_by))], found.share)
    assert (month.share <= np.min(list(month.kept_by.values()), axis=0) + 1e-12).all()
    assert seen(**MONTH, limits=NO_LIMITS).share == pytest.approx(1.0)
    depth = below - degrees_between(-path.position_km, path.bodies.sun)
    sure = np.abs(depth) > 1e-6
    assert (month.shadow == (depth > 0))[sure].all()
    both, dark, light = (seen(**MONTH, limits={"eclipse": rule}) for rule in ("any", "only", "never"))
    assert (dark.seen ^ light.seen == both.seen).all()
    assert not dark.seen[~month.shadow].any()
    assert month.windows(0).in_shadow_s.sum() == dark.seen[:, 0].sum() * 60


def test_days_and_months_begin_where_they_do(month: Any) -> None:
    names, hours = month.by_month()
    assert names == ["2026-12", "2027-01"]
    # Days begin at midnight: the first after 17.5 hours.
    hour, days = month.track.times.seconds / 3600, month.by_day(0)
    assert days[1] == pytest.approx(month.seen[np.floor((hour - 17.5) / 24) == 0, 0].sum() / 60)
    assert len(days) == 41
    # The first of January begins after 11 days and 17.5 hours.
    assert hours[0] == pytest.approx(month.seen[hour < 11 * 24 + 17.5].sum(axis=0) / 60)
    assert seen(**MONTH, limits={"duty_cycle": 0.5}).hours == pytest.approx(month.hours / 2)
    usual = float(np.median(month.windows(0).length_s))
    long = seen(**MONTH, limits={"shortest_s": usual})
    assert usual in long.windows(0).length_s
    for k in range(len(NAMES)):
        every = month.windows(k)
        assert long.windows(k).start_s.tolist() == every.start_s[every.length_s >= usual].tolist()


@pytest.mark.parametrize(("west", "middle", "east"), [(170.0, 180.0, -170.0), (-100.0, 0.0, 100.0)])
def test_polygon_across_the_date_line_or_half_the_earth(west: float, middle: float, east: float) -> None:
    corners = [[west, -10.0], [middle, -10.0], [east, -10.0], [east, 10.0], [middle, 10.0], [west, 10.0]]
    found = seen(days=10.0, targets=["Vega"], limits=NO_LIMITS | {"anomaly": corners})
    longitude, latitude = found.track.subsatellite_deg
    inside = ((longitude - west) % 360 < (east - west) % 360) & (np.abs(latitude) < 10)
    assert inside.sum() > 50
    np.testing.assert_array_equal(found.seen[:, 0], ~inside)


def test_protons_and_temperature_along_the_orbit(month: Any) -> None:
    """Compare the limit and the hits of protons with scipy, and temperatures from balance on with exp(-t / 3000 s)."""
    table, place = Table.read(PROTONS, format="ascii.ecsv"), np.column_stack(month.track.subsatellite_deg[::-1])
    at = tuple(np.round((table[name] + end) / 2).astype(int) for name, end in (("latitude", 90), ("longitude", 180)))
    flux = {}
    for energy in (10, 30):
        # Cells without a row are zero.
        grid = np.zeros((91, 181))
        grid[at] = table[f"above_{energy}_mev"]
        grid[:, 180] = grid[:, 0]
        flux[energy] = RegularGridInterpolator((np.arange(-90, 91, 2.0), np.arange(-180, 181, 2.0)), grid)(place)
    allowed = seen(**MONTH, limits=NO_LIMITS | {"proton_flux": 10.0}).seen[:, 0]
    np.testing.assert_array_equal(allowed, flux[10] <= 10.0)
    asked = {"targets": [{"name": name} for name in NAMES[:2]], "completeness": "closed form"}
    orbit = MONTH | {"targets": [], "limits": NO_LIMITS | {"earth_limb_deg": 25.0}}
    planned = plan(Study.build({"plan": asked, "orbit": orbit}, "test"))
    end, keep = 13.0 + 8.0 * month.track.sunlight, np.exp(-60 / 3000)
    warmth = np.array([*accumulate(end, lambda last, one: one + (last - one) * keep, initial=end.mean())][1:])
    for row, there in zip(planned.stars, planned.seen.visibility.seen.T, strict=True):
        assert row["hits"].value == pytest.approx(1.0 + 0.5 * flux[30][there].mean(), rel=1e-9)
        assert row["hits"].value > 2.0
        assert row["temperature"].value == pytest.approx(warmth[there].mean(), abs=1e-9)


def test_simbad_is_asked_for_other_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read an answer; refuse a name that SIMBAD does not know, a network that fails or never answers, no astroquery."""
    asked, done, names = [], threading.Event(), ("ra", "dec", "plx_value", "sp_type", "V")

    def answer(_: Any, query: str, **__: Any) -> Table:
        asked.append(query)
        if "HD 1" in query:
            done.wait(60)
        if "HD 0" in query:
            raise ConnectionError("no route to host")
        rows = [] if "HD 3" in query else [(10.5, -3.25, 50.0, " K2V ", 7.5)]
        table = Table(rows=rows or None, names=names, masked=True, dtype=(*"fff", "O", "f"))
        for column in names[2:] if "HD 2" in query else ():
            table[column].mask = True
        return table

    def looked_up(name: str) -> Any:
        return visible(Study.build({"orbit": {"targets": [name], "days": 0.1, "simbad": True}}, "test")).targets[0]

    monkeypatch.setattr(pytest.importorskip("astroquery.simbad").SimbadClass, "query_tap", answer)
    star, bare = looked_up("Barnard's other star"), looked_up("HD 2")
    assert (star.ra_deg, star.dec_deg, star.distance_pc, star.magnitude) == (10.5, -3.25, 20.0, 7.5)
    assert (star.spectral_type, star.source) == ("K2V", "SIMBAD")
    assert "ident.id = 'Barnard''s other star'" in asked[0]
    assert (bare.name, bare.distance_pc, bare.magnitude, bare.spectral_type) == ("HD 2", None, None, None)
    asked.clear()
    targets = [{"name": name, "spectral_type": "K2V"} for name in ("HD 4", "HD 5")]
    plan(Study.build({"plan": {"targets": targets}, "orbit": {"days": 0.1, "simbad": True}}, "test"))
    assert [query[-5:] for query in asked] == ["HD 4'", "HD 5'"]
    # Half a second passes in place of ten.
    result = Future.result
    monkeypatch.setattr(Future, "result", lambda future, seconds: result(future, seconds / 20))
    for name, fault in (("HD 3", "SIMBAD knows no"), ("HD 0", "ConnectionError"), ("HD 1", "within 10 s")):
        with refused("target", fault):
            looked_up(name)
    done.set()
    monkeypatch.setitem(sys.modules, "astroquery.simbad", None)
    with refused("target", "astroquery"):
        looked_up("HD 1")


#: The paper's table, longitude 180 to 0 downwards, latitude 0 to 90 across.
PAPER = (DATA / "zodiacal-light.txt").read_text(encoding="utf-8").splitlines()
CELLS = {
    (180 - 15 * row, 15 * column): cell for row, line in enumerate(PAPER) for column, cell in enumerate(line.split())
}
DATE = "2026-03-01T12:00:00"


def almanac(ra_deg: float, dec_deg: float, utc: str) -> tuple[float, float, float]:
    """Return helio-ecliptic longitude, latitude and the Sun's separation by a low-precision Sun, to 0.03 deg."""
    # Page C5 of the Astronomical Almanac, for 1950-2050, the obliquity of J2000 and general precession.
    n = (datetime.fromisoformat(utc) - datetime(2000, 1, 1, 12)).total_seconds() / 86400
    anomaly = np.radians(357.528 + 0.9856003 * n)
    sun = 280.460 + 0.9856474 * n + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    tilt = np.radians(23.4393)
    ra, dec = np.radians([ra_deg, dec_deg])
    x, y, z = np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)
    latitude = np.degrees(np.arcsin(z * np.cos(tilt) - y * np.sin(tilt)))
    longitude = np.degrees(np.arctan2(y * np.cos(tilt) + z * np.sin(tilt), x)) + 3.82394e-5 * n
    folded = abs((longitude - sun + 180) % 360 - 180)
    separation = np.degrees(np.arccos(np.cos(np.radians(latitude)) * np.cos(np.radians(folded))))
    return folded, abs(latitude), separation


def beside_the_sun(longitude: float, latitude: float, lookup: Any = "bilinear") -> float:
    """Return the brightness of the sky at a helio-ecliptic position."""
    time = Time(DATE, scale="utc")
    frame = GeocentricTrueEcliptic(equinox=time, obstime=time)
    sun = get_sun(time).transform_to(frame).lon.deg
    place = SkyCoord((sun + longitude) * u.deg, latitude * u.deg, frame=frame)
    return float(Sky.at(place, DATE, lookup).surface_brightness or 0.0)


@pytest.mark.parametrize("lookup", ["bilinear", "nearest"])
def test_cells_of_the_table_and_brightness_between_them(lookup: str) -> None:
    assert len(CELLS) == 91
    for (longitude, latitude), cell in CELLS.items():
        # The last cells are approached from inside.
        at = min(longitude, 179.999), min(latitude, 89.999), lookup
        if cell == "SA":
            with refused("target"):
                beside_the_sun(*at)
        else:
            assert beside_the_sun(*at) == pytest.approx(float(cell), abs=1e-4)
    # The nearest cell decides on avoidance, at half a step.
    assert beside_the_sun(52.51, 0.0) == pytest.approx(21.3)
    with refused("target"):
        beside_the_sun(52.4, 0.0, lookup)
    # Between cells it is interpolated.
    at = beside_the_sun
    assert [at(82.5, 7.5), at(-82.5, -7.5)] == pytest.approx([(22.0 + 22.3 + 21.7 + 22.2) / 4] * 2)
    assert at(80.0, 0.0) == pytest.approx(21.7 + (22.0 - 21.7) / 3)
    assert (at(80.0, 5.0, "nearest"), at(83.0, 8.0, "nearest")) == (21.7, 22.3)
    # Beside avoided cells the others share their weight: (60, 0) and (60, 15) here, a third and two thirds.
    assert at(55.0, 10.0) == pytest.approx((21.3 + 2 * 21.9) / 3)


@pytest.mark.parametrize(
    ("ra", "dec"), [(290.0, -11.2), (0.0, 0.0), (53.2327, -9.4583), (243.9053, -8.3694), (180.0, 85.0), (84.4, 21.1)]
)
@pytest.mark.parametrize("utc", [DATE, "2026-06-21T00:00:00", "2027-11-05T05:06:07", "1999-12-31"])
def test_position_agrees_with_the_almanac(ra: float, dec: float, utc: str) -> None:
    """Compare the angles that the description of a sky, or its refusal near the Sun, states to 0.1 deg."""
    try:
        said = Sky.at(SkyCoord(ra * u.deg, dec * u.deg), Time(utc, scale="utc")).description
    except InputError as error:
        said = str(error)
    folded, latitude, separation = almanac(ra, dec, utc)
    found = [float(one) for one in re.findall(r"(\d+\.\d) deg", said)]
    if said.startswith("the Sun is"):
        found = [*found[1:], found[0]]
    assert found[0] == pytest.approx(folded, abs=0.05 + 0.05 / np.cos(np.radians(latitude)))
    assert found[1:3] == pytest.approx([latitude, separation], abs=0.1)


def test_equivalent_targets_and_times() -> None:
    target = SkyCoord("19h22m00s -11d12m00s")
    same = Sky.at(target, Time("2026-07-01T00:00:00", scale="utc"))
    for place, time in (
        ("19h22m00s -11d12m00s", "2026-07-01"), ("19:22:00 -11:12:00", "2026-07-01 00:00:00Z"),
        ("290.5 -11.2", "2026-07-01T00:00:00.0"), ("290.5, -11.2", "2026-07-01T00:00"),
    ):  # fmt: skip
        assert Sky.at(place, time) == same
    assert Sky.at("eps Eri", DATE) == Sky.at(SkyCoord(53.23269 * u.deg, -9.45826 * u.deg), DATE)
    turned, nearest = Sky.at(target.galactic, "2026-07-01"), Sky.at(target, "2026-07-01", "nearest")
    assert turned.surface_brightness == pytest.approx(same.surface_brightness, abs=1e-6)
    assert nearest.surface_brightness == 22.5


@pytest.mark.filterwarnings("error")
def test_no_network_access_and_no_global_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", Mock(side_effect=AssertionError("the network was asked")))
    before = (iers.conf.auto_download, solar_system_ephemeris.get())
    # Decades past the bundled tables of Earth rotation.
    assert Sky.at("290 -11", "2085-07-01").surface_brightness == pytest.approx(22.4, abs=0.1)
    visible(Study.build({"orbit": {"targets": ["290 -11"], "days": 1.0, "start": "2085-07-01"}}, "test"))
    assert (iers.conf.auto_download, solar_system_ephemeris.get()) == before
