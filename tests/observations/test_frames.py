"""Frames from arrays, other packages and documented layouts, and their times against an independent route."""

import re
from pathlib import Path
from typing import Any

import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import InverseVariance, StdDevUncertainty
from astropy.table import Column, Table
from astropy.time import Time
from astropy.timeseries import BinnedTimeSeries, TimeSeries
from layouts import documented_files
from scenes import paper

from mauvecl import Frames, Study, analyse, read_frames, visible
from mauvecl.observations import frame_files
from mauvecl.observations import frames as observed

RNG = np.random.default_rng(29)
TIME = np.arange(100) * 20.0
FLUX = 1000 + RNG.normal(0, 5, 100)


def test_arrays_may_have_units_of_their_own() -> None:
    flux, error = FLUX * u.electron / u.s, np.full(100, 300.0) * u.electron / u.min
    for light, spread in ((flux, error), (Column(flux.value, unit=flux.unit), Column(error.value, unit=error.unit))):
        frames = Frames.of(TIME / 60 * u.min, light, spread)
        assert frames.unit == "electron / s"
        np.testing.assert_allclose((frames.time_s, frames.flux, frames.error), (TIME, FLUX, np.full(100, 5.0)))
    how: dict[str, Any] = {"wavelength_nm": [300.0, 400.0], "temperature_c": np.full(100, 280.0) * u.K}
    placed = Frames.of(TIME, np.ones((100, 2)), direction_deg=(10.0 * u.deg, 600 * u.arcmin), **how)
    assert (placed.temperature_c[0], *placed.direction_deg) == pytest.approx((6.85, 10.0, 10.0))


def test_frames_are_sorted_and_numbered_over_gaps_and_slow_changes_of_the_times() -> None:
    order = RNG.permutation(100)
    frames = Frames.of(TIME[order], FLUX[order], np.full(100, 5.0))
    np.testing.assert_array_equal(frames.flux, FLUX)
    assert len(frames.remarks) == 1
    assert Frames.of(TIME, FLUX).remarks == ()
    assert Frames.of(TIME, FLUX, quality=4 * (TIME == 140.0)).flags[7:9] == ["4", ""]
    kept = np.r_[0:30, 50:100]
    assert Frames.of(TIME[kept], FLUX[kept]).numbers.tolist() == kept.tolist()
    # Barycentric times: 100 s of drift over a year, as of the Earth's motion along the line of sight.
    n = 20_000
    numbers = np.arange(n)
    time = numbers * 120.0 + 500.0 * np.sin(2 * np.pi * numbers * 120.0 / 3.156e7)
    np.testing.assert_array_equal(Frames.of(time, RNG.normal(0, 1, n)).numbers, numbers)


def test_the_errors_are_those_of_the_chosen_flux() -> None:
    """A light curve that lightkurve exports has its own flux next to those of the mission."""
    ones = np.ones(30)
    columns = {"time": np.arange(30.0), "pdcsap_flux": 2 * ones, "pdcsap_flux_err": 3 * ones, "flux": ones}
    table = Table(columns, units={"time": "s"})
    frames = frame_files.frames_of(table)
    assert (frames.flux.tolist(), frames.error) == (ones.tolist(), None)
    table.remove_column("flux")
    frames = frame_files.frames_of(table)
    assert (frames.flux[0], frames.error[0]) == (2.0, 3.0)
    columns = {"time": np.arange(30.0), "flux": np.resize([-100.0, 100.0], 30), "flux_err": 5 * ones}
    frames = frame_files.frames_of(Table(columns, units={"time": "s", "flux": "ppm", "flux_err": "ppm"}))
    assert (frames.flux[0], frames.error[0]) == pytest.approx((1 - 1e-4, 5e-6))


N = 30
WHEN = Time(61_000.0, np.arange(N) * 20.0 / 86_400, format="mjd", scale="tdb")
LIGHT = np.random.default_rng(3).normal(100.0, 1.0, (N, 4))
NM = np.array([300.0, 400.0, 500.0, 600.0])


def test_time_series_of_astropy_are_frames() -> None:
    series = TimeSeries(time=WHEN, data={"flux": LIGHT[:, 0] * u.Jy, "flux_err": np.full(N, 1000.0) * u.mJy})
    frames = frame_files.frames_of(series)
    np.testing.assert_allclose(frames.flux, LIGHT[:, 0])
    np.testing.assert_allclose(frames.error, 1.0)
    np.testing.assert_allclose(frames.time_s, np.arange(N) * 20.0, atol=2e-5)
    assert (frames.unit, frames.scale, frames.reference_mjd) == ("Jy", "tdb", pytest.approx(61_000.0))
    # Binned ones need a mapping.
    series = BinnedTimeSeries(time_bin_start=WHEN, time_bin_size=18.0 * u.s, data={"flux": LIGHT[:, 0]})
    how = frame_files.FrameMapping(time="time_bin_start", exposure="time_bin_size", flux="flux")
    for at, shift_s in (("start", 9.0), ("middle", 0.0), ("end", -9.0)):
        frames = frame_files.frames_of(series, how.model_copy(update={"time_at": at}))
        np.testing.assert_allclose(frames.time_s, np.arange(N) * 20.0 + shift_s, atol=2e-5)
        np.testing.assert_allclose(frames.exposure_s, 18.0)


@pytest.mark.parametrize("kind", [StdDevUncertainty, InverseVariance, None])
def test_spectra_of_specutils_are_frames(kind: type | None) -> None:
    specutils = pytest.importorskip("specutils")
    error = np.full(LIGHT.shape, 0.5)
    uncertainty = None if kind is None else StdDevUncertainty(error).represent_as(kind)
    mask = np.arange(LIGHT.size).reshape(LIGHT.shape) == 13
    how = {"spectral_axis": NM * 10 * u.AA, "uncertainty": uncertainty, "mask": mask, "meta": {"OBJECT": "AU Mic"}}
    frames = frame_files.frames_of(specutils.Spectrum(flux=LIGHT * u.adu, **how), time=WHEN)
    np.testing.assert_allclose(frames.flux, np.where(mask, np.nan, LIGHT))
    np.testing.assert_allclose(frames.wavelength_nm, NM)
    assert (frames.unit, frames.name, frames.scale) == ("adu", "AU Mic", "tdb")
    assert frames.error is None if kind is None else np.allclose(frames.error, 0.5, atol=0)


def test_every_example_of_the_page_gives_the_same_frames(tmp_path: Path) -> None:
    documented_files(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "mapping.md").read_text(encoding="utf-8")
    examples = re.findall(
        r"```toml\n# ([\w-]+\.toml)\n(.*?)```.*?read_frames\(\"([\w.-]+)\", \"\1\"\)", page, re.DOTALL
    )
    assert [name for name, _, _ in examples] == re.findall(r"^# ([\w-]+\.toml)$", page, re.MULTILINE)
    assert len(examples) == 6
    for name, text, file in examples:
        (tmp_path / name).write_text(text)
        frames = read_frames(tmp_path / file, tmp_path / name)
        np.testing.assert_allclose(frames.flux, 100.0 + np.arange(120.0).reshape(30, 4))
        np.testing.assert_allclose(frames.error, frames.flux / 10)
        # The page's images have wavelengths in air, by a refractive index of 1.00028 within 1e-5.
        np.testing.assert_allclose(frames.wavelength_nm, [300.25, 400.25, 500.25, 600.25], rtol=2e-5)
        assert frames.date(float(frames.time_s[0]))[:21] == ("2026-03-01T00:00:02.5")
        np.testing.assert_allclose(np.diff(frames.time_s), 5.0, atol=1e-3)
        np.testing.assert_allclose(frames.exposure_s, 5.0)


SECONDS = np.arange(200) * 30.0 + 15.0
LIGHT_AT = RNG.normal(1000, 5, SECONDS.size)
ORBIT = Study().paper().orbit.orbit()
(AU_MIC,) = visible(paper("orbit.targets=['311.2897 -31.3409']", "orbit.days=0.1")).targets
#: Days near the epoch of the embedded elements, and far from them.
NEAR, LATE = "2026-09-16T03:00:00", "2027-03-01T00:00:00"


def _frames(start: str, position: str, scale: str = "utc") -> Frames:
    mjd = float(Time(start, scale=scale).mjd)
    return Frames.of(SECONDS, LIGHT_AT, reference_mjd=mjd, scale=scale, position=position, name="AU Mic")


def _geocentric_s(start: str) -> np.ndarray:
    """Return barycentric TDB less UTC for an observer at the geocentre, s, by ERFA alone."""
    mjd = Time(start, scale="utc").mjd
    days = SECONDS / 86_400
    # 37 leap seconds since 2017, and TT - TAI of 32.184 s.
    tt = mjd + days + 69.184 / 86_400
    tdb_tt = erfa.dtdb(2_400_000.5, tt, 0.0, 0.0, 0.0, 0.0)
    _, barycentric_au = erfa.epv00(2_400_000.5, tt + tdb_tt / 86_400)
    ra, dec = np.radians([AU_MIC.ra_deg, AU_MIC.dec_deg])
    star = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    # Light time for 1 au (IAU 2012, 149 597 870.7 km; c = 299 792.458 km/s).
    return 69.184 + tdb_tt + barycentric_au["p"] @ star * 149_597_870.7 / 299_792.458


def _late_s(frames: Frames, start: str) -> np.ndarray:
    return (frames.reference_mjd - float(Time(start, scale="utc").mjd)) * 86_400 + frames.time_s - SECONDS


@pytest.mark.parametrize(
    ("start", "kind", "words"), [(NEAR, "tle", "along the track"), (LATE, "mean", "good to 23 ms")]
)
def test_barycentric_times_are_those_of_erfa_and_of_the_satellites_place(start: str, kind: str, words: str) -> None:
    found = observed.barycentric(_frames(start, "GEOCENTER"), AU_MIC)
    # A modified Julian date in double precision resolves a microsecond.
    np.testing.assert_allclose(_late_s(found, start), _geocentric_s(start), atol=3e-6)
    assert (found.scale, found.position) == ("tdb", "BARYCENTER")
    assert found.direction_deg == (AU_MIC.ra_deg, AU_MIC.dec_deg)
    same = observed.barycentric(_frames(Time(start, scale="utc").tt.isot, "GEOCENTER", "tt"), AU_MIC)
    assert (same.reference_mjd - found.reference_mjd) * 86_400 == pytest.approx(0.0, abs=2e-6)
    np.testing.assert_allclose(same.time_s, found.time_s, atol=1e-6)
    again = observed.barycentric(found, AU_MIC)
    np.testing.assert_array_equal(again.time_s, found.time_s)
    assert "barycentric already" in again.remarks[-1]
    found = observed.barycentric(_frames(start, "TOPOCENTER"), AU_MIC, ORBIT)
    orbit = {"start": start, "days": SECONDS.size * 30 / 86_400, "step_s": 30.0}
    grid = Study.build({"orbit": orbit}, "test").orbit.times()
    assert ORBIT.resolved(grid) == kind
    expected = ORBIT.track(grid).position_km @ AU_MIC.direction / 299_792.458
    assert np.ptp(expected) > 5e-3
    np.testing.assert_allclose(_late_s(found, start) - _geocentric_s(start), expected, atol=5e-6)
    assert words in found.remarks[0]


def test_nothing_is_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("astropy.utils.data.download_file", "astropy.utils.iers.iers.download_file"):
        monkeypatch.delattr(place)
    later = Frames.of(SECONDS, LIGHT_AT, reference_mjd=70_000.0, scale="utc", position="TOPOCENTER")
    assert observed.barycentric(later, AU_MIC, ORBIT).position == "BARYCENTER"


@pytest.mark.long
def test_tables_of_an_analysis_state_epoch_scale_and_place(tmp_path: Path) -> None:
    hdu = fits.table_to_hdu(Table({"TIME": SECONDS, "FLUX": LIGHT_AT}))
    hdu.header.update({"TIMEUNIT": "s", "MJDREF": 61_299.0, "TREFPOS": "TOPOCENTER", "INSTRUME": "mauvesim"})
    hdu.writeto(tmp_path / "a.fits")
    answer = analyse(Study.build({"data": {"file": str(tmp_path / "a.fits"), "barycentric": "AU Mic"}}, "test"))
    where = {"TIMESYS": "TDB", "TREFPOS": "BARYCENTER", "TREFDIR": "RA_OBJ,DEC_OBJ"}
    assert where.items() <= answer.events.meta.items()
    answer.frames.write(tmp_path / "frames.ecsv")
    again, given = read_frames(tmp_path / "frames.ecsv"), answer.analysis.frames
    assert (again.scale, again.position, again.direction_deg) == ("tdb", "BARYCENTER", given.direction_deg)
    assert again.reference_mjd == pytest.approx(given.reference_mjd, abs=1e-10)
    np.testing.assert_allclose(again.time_s, given.time_s - given.time_s[0], atol=2e-5)
    np.testing.assert_allclose(again.flux, given.flux)
