"""Zodiacal light: cells of the table, the helio-ecliptic position, and refusals."""

import re
import socket
from datetime import datetime
from typing import Any
from unittest.mock import Mock

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord, get_sun, solar_system_ephemeris
from astropy.time import Time
from astropy.utils import iers
from refusals import refused
from tables import DATA

from mauvecl import InputError, Sky, Study, visible

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
def test_cells_of_the_table(lookup: str) -> None:
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


def test_brightness_is_interpolated_between_cells() -> None:
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
