"""Times: FITS keywords, dates, and the Solar System's barycentre against an independent route."""

from pathlib import Path
from typing import Any

import erfa
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from scenes import paper

from mauvecl import Frames, Study, analyse, read_frames, visible
from mauvecl.observations import frames as observed

RNG = np.random.default_rng(29)
TIME = np.arange(200) * 30.0 + 15.0
FLUX = RNG.normal(1000, 5, TIME.size)
ORBIT = Study().paper().orbit.orbit()
(AU_MIC,) = visible(paper("orbit.targets=['311.2897 -31.3409']", "orbit.days=0.1")).targets
#: Days near the epoch of the embedded elements, and far from them.
NEAR, FAR = "2026-09-16T03:00:00", "2027-03-01T00:00:00"


def _frames(start: str, position: str, scale: str = "utc") -> Frames:
    mjd = float(Time(start, scale=scale).mjd)
    return Frames.of(TIME, FLUX, reference_mjd=mjd, scale=scale, position=position, name="AU Mic")


def _geocentric_s(start: str) -> np.ndarray:
    """Return barycentric TDB less UTC for an observer at the geocentre, s, by ERFA alone."""
    mjd = Time(start, scale="utc").mjd
    days = TIME / 86_400
    # 37 leap seconds since 2017, and TT - TAI of 32.184 s.
    tt = mjd + days + 69.184 / 86_400
    tdb_tt = erfa.dtdb(2_400_000.5, tt, 0.0, 0.0, 0.0, 0.0)
    _, barycentric_au = erfa.epv00(2_400_000.5, tt + tdb_tt / 86_400)
    ra, dec = np.radians([AU_MIC.ra_deg, AU_MIC.dec_deg])
    star = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    # Light time for 1 au (IAU 2012, 149 597 870.7 km; c = 299 792.458 km/s).
    return 69.184 + tdb_tt + barycentric_au["p"] @ star * 149_597_870.7 / 299_792.458


def _late_s(frames: Frames, start: str) -> np.ndarray:
    return (frames.reference_mjd - float(Time(start, scale="utc").mjd)) * 86_400 + frames.time_s - TIME


@pytest.mark.parametrize("start", [NEAR, FAR])
def test_barycentric_times_of_the_geocentre_are_those_of_erfa(start: str) -> None:
    found = observed.barycentric(_frames(start, "GEOCENTER"), AU_MIC)
    # A modified Julian date in double precision resolves a microsecond.
    np.testing.assert_allclose(_late_s(found, start), _geocentric_s(start), atol=3e-6)
    assert (found.scale, found.position) == ("tdb", "BARYCENTER")
    assert found.direction_deg == (AU_MIC.ra_deg, AU_MIC.dec_deg)


@pytest.mark.parametrize(("start", "kind"), [(NEAR, "tle"), (FAR, "mean")])
def test_the_satellites_place_counts_with_its_light_travel_time(start: str, kind: str) -> None:
    found = observed.barycentric(_frames(start, "TOPOCENTER"), AU_MIC, ORBIT)
    orbit = {"start": start, "days": TIME.size * 30 / 86_400, "step_s": 30.0}
    grid = Study.build({"orbit": orbit}, "test").orbit.times()
    assert ORBIT.resolved(grid) == kind
    expected = ORBIT.track(grid).position_km @ AU_MIC.direction / 299_792.458
    assert np.ptp(expected) > 5e-3
    np.testing.assert_allclose(_late_s(found, start) - _geocentric_s(start), expected, atol=5e-6)
    words = "good to 23 ms" if kind == "mean" else "along the track"
    assert words in found.remarks[0]


def test_other_scales_give_the_same_instants_and_barycentric_times_stay() -> None:
    utc = observed.barycentric(_frames(NEAR, "GEOCENTER"), AU_MIC)
    tt = Frames.of(TIME, FLUX, reference_mjd=float(Time(NEAR, scale="utc").tt.mjd), scale="tt", position="GEOCENTER")
    found = observed.barycentric(tt, AU_MIC)
    assert (found.reference_mjd - utc.reference_mjd) * 86_400 == pytest.approx(0.0, abs=2e-6)
    np.testing.assert_allclose(found.time_s, utc.time_s, atol=1e-6)
    again = observed.barycentric(utc, AU_MIC)
    np.testing.assert_array_equal(again.time_s, utc.time_s)
    assert "barycentric already" in again.remarks[-1]


def test_nothing_is_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(*_: Any, **__: Any) -> None:
        raise AssertionError("a download")

    for place in ("astropy.utils.data.download_file", "astropy.utils.iers.iers.download_file"):
        monkeypatch.setattr(place, download)
    later = Frames.of(TIME, FLUX, reference_mjd=70_000.0, scale="utc", position="TOPOCENTER")
    assert observed.barycentric(later, AU_MIC, ORBIT).position == "BARYCENTER"


@pytest.mark.long
def test_tables_of_an_analysis_state_epoch_scale_and_place(tmp_path: Path) -> None:
    hdu = fits.table_to_hdu(Table({"TIME": TIME, "FLUX": FLUX}))
    hdu.header.update({"TIMEUNIT": "s", "MJDREF": 61_299.0, "TREFPOS": "TOPOCENTER", "INSTRUME": "mauvesim"})
    hdu.writeto(tmp_path / "a.fits")
    settings = {"data": {"file": str(tmp_path / "a.fits"), "barycentric": "AU Mic"}}
    answer = analyse(Study.build(settings, "test"))
    meta = answer.events.meta
    assert (meta["TIMESYS"], meta["TREFPOS"], meta["TREFDIR"]) == ("TDB", "BARYCENTER", "RA_OBJ,DEC_OBJ")
    answer.frames.write(tmp_path / "frames.ecsv")
    again = read_frames(tmp_path / "frames.ecsv")
    given = answer.analysis.frames
    assert (again.scale, again.position, again.direction_deg) == ("tdb", "BARYCENTER", given.direction_deg)
    assert again.reference_mjd == pytest.approx(given.reference_mjd, abs=1e-10)
    np.testing.assert_allclose(again.time_s, given.time_s - given.time_s[0], atol=2e-5)
    np.testing.assert_allclose(again.flux, given.flux)
