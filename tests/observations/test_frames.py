"""Frames from arrays, other packages, documented layouts and files larger than memory, and their barycentric times."""

import json
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
from astropy.time import Time, TimeDelta
from astropy.timeseries import BinnedTimeSeries, TimeSeries
from layouts import documented_files
from processes import python
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
    assert (Frames.of(TimeDelta(TIME * u.s), FLUX, 5.0).error == 5.0).all()
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
    axis, meta = np.array([3000.0, 4000.0, 5000.0, 6000.0]) * u.AA, {"OBJECT": "AU Mic"}
    how = {"spectral_axis": axis, "uncertainty": uncertainty, "mask": mask, "meta": meta}
    frames = frame_files.frames_of(specutils.Spectrum(flux=LIGHT * u.adu, **how), time=WHEN)
    np.testing.assert_allclose(frames.flux, np.where(mask, np.nan, LIGHT))
    np.testing.assert_allclose(frames.wavelength_nm, [300.0, 400.0, 500.0, 600.0])
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


#: The address space may grow by this while a file is read, of which at most the other is read at once.
MARGIN_MIB, CONTENT_MIB = 96, 16
#: A process that reads `path`, whose address space is limited after its imports and a first, small file.
CHILD = f"""
import json, resource, sys
import astropy.io.fits, astropy.table, astropy.time, scipy.special
import numpy as np
from mauvecl import read_frames
from mauvecl.observations import frame_files
# OpenBLAS reserves address space at the first large product; reading does not need it.
np.ones((300, 300)) @ np.ones((300, 300))
small, path, out, mapping = sys.argv[1:]
mapping = frame_files.FrameMapping(**json.loads(mapping))
weights = np.zeros((2, read_frames(small, mapping).wavelength_nm.size)); weights[0, 3] = 1.0; weights[1, :2] = 1.0
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + {MARGIN_MIB} * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
frames = read_frames(path, mapping)
reduced = frame_files.reduce_frames(path, weights, mapping)
one, two = (curve.flux for curve in reduced.light_curves)
print(*frames.remarks, sep=chr(10), file=sys.stderr)
np.savez(out, time=frames.time_s, white=frames.flux, one=one, two=two, mean=reduced.pixels.mean,
         scatter=reduced.pixels.scatter)
"""
IN_FITS = {"time": "TIME", "time_unit": "s", "flux": "FLUX", "wavelength": "WAVES", "wavelength_unit": "nm"}
IN_CSV = {"time": "time", "flux": "flux_*", "wavelength": "names", "wavelength_unit": "nm"}


def write(path: Path, light: np.ndarray, form: str) -> None:
    """Write frames of 5 s with their times and wavelengths: an image, or a spectrum in each row of a table."""
    n, pixels = light.shape
    if form == "csv":
        start = np.datetime64("2026-03-01T00:00:00")
        with path.open("w") as file:
            file.write(",".join(["time", *(f"flux_{200 + k}" for k in range(pixels))]) + "\n")
            for row, values in enumerate(light):
                file.write(f"{start + np.timedelta64(5 * row, 's')},{','.join(map(str, values.tolist()))}\n")
        return
    flux, times = light.astype(np.float32), np.arange(n) * 5.0
    hdus = [fits.ImageHDU(flux, name="FLUX"), fits.ImageHDU(times, name="TIME")]
    if form == "table":
        columns = [fits.Column("TIME", "D", array=times), fits.Column("FLUX", f"{pixels}E", array=flux)]
        hdus = [fits.BinTableHDU.from_columns(columns)]
    waves = fits.ImageHDU(np.arange(pixels) + 200.0, name="WAVES")
    fits.HDUList([fits.PrimaryHDU(), *hdus, waves]).writeto(path)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the size of a process as Linux states it")
@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "n", "pixels", "mapping"),
    [("image", 65_536, 1024, IN_FITS), ("table", 65_536, 1024, IN_FITS), ("csv", 44_000, 512, IN_CSV)],
)
def test_a_file_larger_than_memory_is_read_in_pieces(
    form: str, n: int, pixels: int, mapping: dict[str, str], tmp_path: Path
) -> None:
    small, path, out = tmp_path / f"small.{form}", tmp_path / f"large.{form}", tmp_path / "found.npz"
    pattern, pixel = np.arange(n) * 7919 % 101, np.arange(pixels)
    for file, rows in ((small, pattern[:30]), (path, pattern)):
        write(file, rows[:, None] + pixel, form)
    assert path.stat().st_size > (0.8 if form == "csv" else 2.5) * MARGIN_MIB * 2**20
    limits = {"MAUVECL_LARGEST_CONTENT_MIB": str(CONTENT_MIB), "OPENBLAS_NUM_THREADS": "1"}
    done = python(CHILD, small, path, out, json.dumps(mapping), **limits)
    path.unlink()
    found = np.load(out)
    assert "they were summed over wavelength while they were read" in done.stderr
    np.testing.assert_allclose(found["time"], np.arange(n) * 5.0, atol=1e-3)
    np.testing.assert_allclose(found["white"], pixels * pattern + pixel.sum())
    np.testing.assert_allclose(found["one"], pattern + 3)
    np.testing.assert_allclose(found["two"], 2 * pattern + 1)
    np.testing.assert_allclose(found["mean"], pattern.mean() + pixel)
    np.testing.assert_allclose(found["scatter"], np.sqrt((np.diff(pattern) ** 2).mean() / 2))


@pytest.mark.long
def test_pieces_give_what_the_whole_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, n, path = np.random.default_rng(29), 1500, tmp_path / "rows.fits"
    flux = rng.normal(1000.0, 5.0, (n, 50)) * np.linspace(0.5, 1.5, 50)
    error = 0.01 * flux
    flux[:, 4], flux[11, 5], flux[[13, 800], 5] = 9.97e36, np.nan, -99_999.0
    bad = (np.arange(n) == 7).astype(int)
    columns = {"T": 20.0 * np.arange(n), "QUAL": bad, "DQ": np.tile(bad[:, None], 50), "FLUX": flux, "ERR": error,
               "W": np.tile(np.linspace(250.5, 650.5, 50), (n, 1))}  # fmt: skip
    Table(columns, units={"T": "s", "FLUX": "adu/s", "ERR": "adu/s", "W": "nm"}).write(path)
    how: dict[str, Any] = {"flux": "FLUX", "error": "ERR", "quality": "QUAL", "wavelength": "W", "exposure_s": 18.0}
    mapping = frame_files.FrameMapping(time="T", **how)
    whole = read_frames(path, mapping)
    monkeypatch.setattr("mauvecl.host.tables.table.PIECE_BYTES", 8 * 50 * 400)
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "1")
    pieces = read_frames(path, mapping)
    for found, wanted in zip((pieces.flux, pieces.error), whole.white_light, strict=True):
        np.testing.assert_allclose(found, wanted)
    np.testing.assert_array_equal(pieces.quality, whole.quality)
    assert "1 pixel is not finite in most frames" in pieces.remarks[-1]
    pixels, same = (frame_files.reduce_frames(path, mapping=mapping.model_copy(update={"quality": name})).pixels
                    for name in ("QUAL", "DQ"))  # fmt: skip
    np.testing.assert_array_equal(same.mean, pixels.mean)
    quiet = np.delete(flux, 7, axis=0)
    np.testing.assert_allclose(pixels.mean[:4], quiet[:, :4].mean(axis=0))
    assert pixels.count[[3, 4, 5]].tolist() == [1499, 0, 1496]
    steps = np.diff(np.where(np.arange(1500)[:, None] == 7, np.nan, flux), axis=0)
    np.testing.assert_allclose(pixels.scatter[6:], np.sqrt(np.nanmean(steps[:, 6:] ** 2, axis=0) / 2))
    np.testing.assert_allclose(pixels.stated[6:], np.sqrt((np.delete(error, 7, axis=0)[:, 6:] ** 2).mean(axis=0)))
