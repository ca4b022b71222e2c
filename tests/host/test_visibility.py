"""Visibility: closed forms of circular orbits, other packages' limits, windows and their sums."""

import sys
import threading
import types
from collections.abc import Callable

import numpy as np
import pytest
from astropy.table import Table
from numpy.typing import NDArray
from refusals import refused

from mauvecl.host.orbit import constraints
from mauvecl.host.orbit.conditions import Particles, Thermal
from mauvecl.host.orbit.earth import direction, unit
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.host.orbit.orbit import Orbit, circular
from mauvecl.host.orbit.radiation import proton_map
from mauvecl.host.orbit.season import elongation_deg, zodiacal_light
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import TimeGrid
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.host.sky.helioecliptic import helioecliptic
from mauvecl.host.sky.zodiacal import zodiacal_brightness
from mauvecl.host.tables.times import offline

AXIS_KM = 6879.0


@pytest.fixture(scope="module")
def month() -> Visibility:
    """Return the visibility of five targets over forty days that include the end of a month."""
    track = Orbit.load().track(TimeGrid("2026-12-20T06:30", 40.0, 60.0))
    names = ("eps Eri", "AU Mic", "V889 Her", "EK Dra", "DX Leo")
    return Visibility.of(track, np.array([Target.of(name).direction for name in names]))


@pytest.mark.parametrize(
    ("from_plane_deg", "shares"),
    [(0.0, (0.622, 0.567, 0.511)), (90 - 39.1, (0.703, 0.607, 0.518))],
)
def test_visible_share_of_a_circular_orbit(from_plane_deg: float, shares: tuple[float, ...]) -> None:
    """Compare with TIME.md, section 5, to 0.5 %: 1 - arccos(cos(rho + x) / cos b) / pi."""
    position, _ = circular(AXIS_KM, 1.2, 0.4, np.linspace(0, 2 * np.pi, 20_000, endpoint=False))
    normal = unit(np.cross(position[0], position[5000]))
    target = np.cos(np.radians(from_plane_deg)) * unit(position[0]) + np.sin(np.radians(from_plane_deg)) * normal
    for margin, share in zip((0.0, 10.0, 20.0), shares, strict=True):
        found = constraints.clear_of_earth(position, target[None], margin).mean()
        assert found == pytest.approx(share, abs=0.005 * share)
        rho = np.arcsin(6378.137 / AXIS_KM)
        cosine = np.cos(rho + np.radians(margin)) / np.cos(np.radians(from_plane_deg))
        assert found == pytest.approx(1 - np.arccos(cosine) / np.pi, abs=2e-4)


@pytest.mark.parametrize("margin", [0.0, 10.0, 20.0])
def test_targets_near_the_pole_are_always_visible(margin: float) -> None:
    """Check targets within 22.0 - x deg of the orbit's pole."""
    position, _ = circular(AXIS_KM, 0.0, 0.0, np.linspace(0, 2 * np.pi, 400, endpoint=False))
    from_pole = np.arange(0.0, 30.0, 0.05)
    seen = constraints.clear_of_earth(position, direction(0.0, 90 - from_pole), margin).all(axis=0)
    assert from_pole[seen].max(initial=-1.0) == pytest.approx(22.0 - margin, abs=0.1)


@pytest.mark.long
def test_constraints_agree_with_m4opt() -> None:
    """Compare angles with `m4opt.constraints` 2.3.1, by astropy's horizontal frame.

    The Earth's limb: altitude + arccos(R_earth / distance); its altitude is over the ellipsoid's horizon, up to 0.2 deg
    from the sphere's. Sun and Moon: `get_body` for the place, and `separation`.
    """
    track = Orbit.load().track(TimeGrid("2026-09-14T12:00", 0.5, 600.0))
    names = ("eps Eri", "AU Mic", "Vega")
    target = np.array([Target.of(name).direction for name in names])
    with offline():
        import astropy.units as u
        from astropy.constants import R_earth
        from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body
        from astropy.time import Time

        times = Time(*track.times.julian, format="jd", scale="utc")
        longitude, latitude = track.subsatellite_deg
        height = np.linalg.norm(track.of_date_km, axis=1) * u.km
        # The place at its true distance: geodetic height by the ellipsoid.
        place = EarthLocation.from_geodetic(longitude * u.deg, latitude * u.deg, 0 * u.m)
        up = np.linalg.norm([place.x.to_value("km"), place.y.to_value("km"), place.z.to_value("km")], axis=0)
        place = EarthLocation.from_geodetic(longitude * u.deg, latitude * u.deg, height - up * u.km)
        for star, name in zip(target, names, strict=True):
            one = Target.of(name)
            there = SkyCoord(one.ra_deg, one.dec_deg, unit="deg")
            altitude = there.transform_to(AltAz(obstime=times, location=place)).alt.deg
            theirs = altitude + np.degrees(np.arccos(R_earth.to_value("km") / height.to_value("km")))
            ours = np.degrees(
                np.arccos(-unit(track.position_km) @ star) - constraints.limb_angle_rad(track.position_km)
            )
            assert np.abs(theirs - ours).max() < 0.25
            for body, found in (
                ("sun", track.bodies.sun),
                ("moon", unit(track.bodies.moon_km - track.position_km)),
            ):
                seen = get_body(body, time=times, location=place).separation(there, origin_mismatch="ignore").deg
                assert np.abs(seen - np.degrees(np.arccos(found @ star))).max() < 0.02


def test_limits_apply_to_the_angles(month: Visibility) -> None:
    """Compare each limit, computed with cosines in float32, with angles in float64."""
    track, target = month.track, month.target
    part = slice(0, 3000)
    at = track.position_km[part]
    above = np.degrees(np.arccos(-unit(at) @ target.T) - constraints.limb_angle_rad(at)[:, None])
    _agree(constraints.clear_of_earth(at, target, 25.0), above - 25.0)
    sun = np.degrees(np.arccos(track.bodies.sun[part] @ target.T))
    _agree(constraints.clear_of_sun(track.bodies.sun[part], target, 46.0), sun - 46.0)
    moon = np.degrees(np.arccos(unit(track.bodies.moon_km[part] - at) @ target.T))
    _agree(constraints.clear_of_moon(track.bodies.moon_km[part], at, target, 25.0), moon - 25.0)


def _agree(flags: NDArray[np.bool_], over_deg: NDArray[np.float64]) -> None:
    sure = np.abs(over_deg) > 1e-4
    assert sure.mean() > 0.99
    assert (flags == (over_deg >= 0))[sure].all()


def test_windows_sum_to_the_visible_time(month: Visibility) -> None:
    names, hours = month.by_month()
    assert names == ["2026-12", "2027-01"]
    for k in range(len(month.target)):
        windows = month.windows(k)
        total = month.hours[k]
        assert windows.length_s.sum() / 3600 == pytest.approx(total)
        assert hours[:, k].sum() == pytest.approx(total)
        assert month.by_day(k).sum() == pytest.approx(total)
        assert month.by_orbit(k).sum() / 60 == pytest.approx(total)
        assert (windows.in_shadow_s <= windows.length_s).all()
        assert (windows.start_s[1:] > windows.stop_s[:-1]).all()
    # Days begin at midnight: the first after 17.5 hours.
    second = np.floor((month.track.times.seconds / 3600 - 17.5) / 24) == 0
    assert month.by_day(0)[1] == pytest.approx(month.seen[second, 0].sum() / 60)
    assert len(month.by_day(0)) == 41
    # The first of January begins after 11 days and 17.5 hours.
    split = month.track.times.seconds < (11 * 24 + 17.5) * 3600
    assert hours[0] == pytest.approx(month.seen[split].sum(axis=0) / 60)
    # Orbits of 94.6 minutes in forty days.
    assert len(month.by_orbit(0)) in (609, 610)


def test_fraction_allowed_by_each_limit(month: Visibility) -> None:
    """Check that all limits together allow no more than each alone."""
    assert (month.share <= np.min(list(month.kept_by.values()), axis=0) + 1e-12).all()
    free = Limits(earth_limb_deg=None, sun_deg=None, moon_deg=None, declination_deg=None, proton_flux=None)
    assert Visibility.of(month.track, month.target, free).share == pytest.approx(1.0)


def test_eclipse_rule_selects_times_in_shadow(month: Visibility) -> None:
    both, dark, light = (
        Visibility.of(month.track, month.target, Limits(eclipse=rule)).seen for rule in ("any", "only", "never")
    )
    assert (dark ^ light == both).all()
    assert (dark[~month.shadow] == 0).all()
    assert month.windows(0).in_shadow_s.sum() == dark[:, 0].sum() * 60


def test_declination_cone_and_duty_cycle(month: Visibility) -> None:
    low = Visibility.of(month.track, month.target, Limits(declination_deg=(-90, 0))).share
    south = month.target[:, 2] < 0
    assert (low[~south] == 0).all()
    assert (low[south] > 0).any()
    cone = Visibility.of(month.track, month.target, Limits(normal_cone_deg=60.0, declination_deg=None))
    angle = np.degrees(np.arccos(month.track.normal @ month.target.T))
    assert not (cone.seen & (np.abs(angle - 90) < 29.9)).any()
    half = Visibility.of(month.track, month.target, Limits(duty_cycle=0.5))
    assert half.hours == pytest.approx(month.hours / 2)


def test_short_windows_are_dropped(month: Visibility) -> None:
    long = Visibility.of(month.track, month.target, Limits(shortest_s=1200.0))
    for k in range(len(month.target)):
        every, kept = month.windows(k), long.windows(k)
        assert kept.start_s.tolist() == every.start_s[every.length_s >= 1200].tolist()


def test_shadow_of_a_circular_orbit() -> None:
    """Compare with a cylinder, arccos(sqrt(1 - (R/a)^2) / cos beta) / pi, to the width of the penumbra."""
    position, _ = circular(AXIS_KM, 0.0, 0.0, np.linspace(0, 2 * np.pi, 50_000, endpoint=False))
    for beta in (0.0, 17.0, 28.0, 60.0, 75.0):
        sun = np.broadcast_to(direction(30.0, beta), position.shape)
        found = (constraints.sunlight(position, sun, np.full(len(position), 1.496e8)) < 0.5).mean()
        cosine = np.sqrt(1 - (6378.137 / AXIS_KM) ** 2) / np.cos(np.radians(beta))
        assert found == pytest.approx(0.0 if cosine > 1 else np.arccos(cosine) / np.pi, abs=2e-4)


def test_polygon_across_the_date_line() -> None:
    corners = np.array([[170.0, -10.0], [-170.0, -10.0], [-170.0, 10.0], [170.0, 10.0]])
    longitude = np.array([175.0, -175.0, 185.0, 165.0, -165.0, 0.0])
    assert constraints.in_polygon(longitude, np.zeros(6), corners).tolist() == [True, True, True, False, False, False]
    assert not constraints.in_polygon(np.array([180.0]), np.array([11.0]), corners)[0]


def test_flux_map_interpolates_between_cells() -> None:
    """Check cells, points halfway between them, the date line and the poles."""
    flux = proton_map()
    grid = flux.flux[10]
    row, column = np.unravel_index(np.argmax(grid), grid.shape)
    longitude, latitude = -180 + 2.0 * column, -90 + 2.0 * row
    assert flux.at(np.array([longitude]), np.array([latitude])) == pytest.approx(grid[row, column])
    between = flux.at(np.array([longitude + 1.0]), np.array([latitude]))
    assert between == pytest.approx(grid[row, column : column + 2].mean())
    edge = np.array([-180.0, 179.999, 180.0])
    assert flux.at(edge, np.array([-90.0, 0.0, 90.0])) == pytest.approx(0.0)
    with refused("above_mev", "10", "30"):
        flux.at(edge, edge * 0, above_mev=5)  # type: ignore[arg-type]


@pytest.mark.long
def test_zodiacal_light_over_the_year() -> None:
    """Compare with `Sky.at` for each target and day."""
    times = TimeGrid("2027-01-01", 360.0, 86_400 * 30)
    bodies = Orbit.load().track(times).bodies
    for name in ("eps Eri", "Vega"):
        star = Target.of(name)
        light, away = zodiacal_light(bodies, star.direction), elongation_deg(bodies.sun, star.direction)
        for i, seconds in enumerate(times.seconds):
            place = helioecliptic(f"{star.ra_deg} {star.dec_deg}", times.iso(float(seconds)))
            assert away[i] == pytest.approx(place.separation_deg, abs=0.01)
            if np.isfinite(light[i]):
                assert light[i] == pytest.approx(zodiacal_brightness(place), abs=0.01)
            else:
                with refused("target"):
                    zodiacal_brightness(place)


def test_temperature_follows_its_equation() -> None:
    """Check exp(-t / tau) after a step from shadow to sunlight, and that balance is kept."""
    thermal = Thermal(20.0, 10.0, 600.0)
    assert thermal.temperature_c(np.full(50, 1.0), 30.0) == pytest.approx(20.0)
    light = np.r_[np.zeros(5000), np.ones(100)]
    found = thermal.temperature_c(light, 30.0)
    t = 30.0 * np.arange(1, 101)
    assert found[5000:] == pytest.approx(20 - 10 * np.exp(-t / 600), abs=1e-6)
    # Steps of any length agree where they meet.
    assert thermal.temperature_c(np.repeat(light, 3), 10.0)[2::3] == pytest.approx(found, abs=1e-9)


def test_hits_along_the_orbit(month: Visibility) -> None:
    rate = Particles(1.0, 0.5).rate_per_cm2_s(month.track)
    assert rate.min() == 1.0
    flux = proton_map().at(*month.track.subsatellite_deg, above_mev=30)
    assert rate.max() == pytest.approx(1 + flux.max() / 2)


def test_names_in_any_spelling() -> None:
    same = {Target.of(name) for name in ("eps Eri", "epsilon Eri", "EPS ERI", "HD 22049", "hd22049", "HIP 16537")}
    assert len(same) == 1
    assert Target.of("19h22m00s -11d12m00s").ra_deg == pytest.approx(290.5)


def _simbad(monkeypatch: pytest.MonkeyPatch, query_tap: Callable[[str], object]) -> None:
    """Replace SIMBAD's query, in astroquery if it is installed, else in a module of the same form."""
    try:
        from astroquery.simbad import SimbadClass
    except ImportError:
        package, module = types.ModuleType("astroquery"), types.ModuleType("astroquery.simbad")
        module.Simbad = types.SimpleNamespace(query_tap=query_tap)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "astroquery", package)
        monkeypatch.setitem(sys.modules, "astroquery.simbad", module)
    else:
        monkeypatch.setattr(SimbadClass, "query_tap", lambda _, query, **__: query_tap(query))


def test_answer_of_simbad_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read degrees and mas of the TAP service, masked values, blanks and quotes."""
    asked = []

    def answer(query: str) -> Table:
        asked.append(query)
        names, rows = ("ra", "dec", "plx_value", "sp_type", "V"), [(10.5, -3.25, 50.0, " K2V ", 7.5)]
        if "HD 2" in query:
            rows = [(1.0, 2.0, 0.0, "", 0.0)]
        table = Table(rows=[] if "HD 3" in query else rows, names=names, masked=True, dtype=(*"fff", "O", "f"))
        if "HD 2" in query:
            for column in ("plx_value", "sp_type", "V"):
                table[column].mask = True
        return table

    _simbad(monkeypatch, answer)
    star = Target.of("Barnard's other star", simbad=True)
    assert (star.ra_deg, star.dec_deg, star.distance_pc, star.magnitude, star.spectral_type, star.source) == (
        10.5, -3.25, 20.0, 7.5, "K2V", "SIMBAD",
    )  # fmt: skip
    assert "ident.id = 'Barnard''s other star'" in asked[0]
    bare = Target.of("HD 2", simbad=True, name="mine")
    assert (bare.name, bare.distance_pc, bare.magnitude, bare.spectral_type) == ("mine", None, None, None)
    with refused("target", "SIMBAD"):
        Target.of("HD 3", simbad=True)


def test_network_failure_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a network that fails, one that never answers, and missing astroquery."""
    from mauvecl.host.orbit import targets

    def fails(_: str) -> None:
        raise ConnectionError("no route to host")

    with monkeypatch.context() as patch:
        _simbad(patch, fails)
        with refused("target", "10"):
            Target.of("HD 1", simbad=True)
    with monkeypatch.context() as patch:
        done = threading.Event()
        _simbad(patch, lambda _: done.wait(60))
        patch.setattr(targets, "TIMEOUT_S", 0.1)
        with refused("target", "0.1"):
            Target.of("HD 1", simbad=True)
        done.set()
    monkeypatch.setitem(sys.modules, "astroquery.simbad", None)
    with refused("target"):
        Target.of("HD 1", simbad=True)
