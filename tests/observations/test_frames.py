"""Frames from arrays, from containers of other packages and from the layouts of the documentation."""

import re
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import InverseVariance, StdDevUncertainty
from astropy.table import Table
from astropy.time import Time
from astropy.timeseries import BinnedTimeSeries, TimeSeries
from layouts import documented_files

from mauvecl import Frames, read_frames
from mauvecl.observations import frame_files

RNG = np.random.default_rng(29)
TIME = np.arange(100) * 20.0
FLUX = 1000 + RNG.normal(0, 5, 100)
ERROR = np.full(100, 5.0)


def test_frames_are_sorted_and_numbered_over_gaps_and_slow_changes_of_the_times() -> None:
    order = RNG.permutation(100)
    frames = Frames.of(TIME[order], FLUX[order], ERROR[order])
    np.testing.assert_array_equal(frames.flux, FLUX)
    assert len(frames.remarks) == 1
    assert Frames.of(TIME, FLUX).remarks == ()
    kept = np.r_[0:30, 50:100]
    assert Frames.of(TIME[kept], FLUX[kept]).numbers.tolist() == kept.tolist()
    # Barycentric times: 100 s of drift over a year, as of the Earth's motion along the line of sight.
    n = 20_000
    numbers = np.arange(n)
    time = numbers * 120.0 + 500.0 * np.sin(2 * np.pi * numbers * 120.0 / 3.156e7)
    np.testing.assert_array_equal(Frames.of(time, RNG.normal(0, 1, n)).numbers, numbers)


@pytest.mark.parametrize("before", ["", "\n\n", " \n", "\ufeff\n"])
def test_empty_lines_before_a_header_keep_its_units(before: str, tmp_path: Path) -> None:
    table = Table({"time": TIME / 60, "flux": FLUX}, units={"time": "min"})
    table.write(tmp_path / "plain.ecsv", format="ascii.ecsv")
    (tmp_path / "frames.ecsv").write_text(before + (tmp_path / "plain.ecsv").read_text())
    np.testing.assert_allclose(read_frames(tmp_path / "frames.ecsv").time_s, TIME)


def test_faults_of_the_file_are_reasons() -> None:
    flux, error, quality = FLUX.copy(), ERROR.copy(), np.zeros(100)
    flux[3], error[5], quality[7] = np.nan, -1.0, 4
    frames = Frames.of(TIME, flux, error, quality=quality)
    assert np.flatnonzero(frames.faults).tolist() == [3, 5, 7]
    assert frames.faults[3] == frames.faults[5] != frames.faults[7]
    assert frames.flags[7] == "4"


def test_the_errors_are_those_of_the_chosen_flux() -> None:
    """A light curve that lightkurve exports has its own flux next to those of the mission."""
    ones = np.ones(30)
    columns = {"time": np.arange(30.0), "pdcsap_flux": 2 * ones, "pdcsap_flux_err": 3 * ones, "flux": ones}
    frames = frame_files.frames_of(Table(columns, units={"time": "s"}))
    assert frames.flux.tolist() == ones.tolist()
    assert frames.error is None
    frames = frame_files.frames_of(
        Table({name: columns[name] for name in columns if name != "flux"}, units={"time": "s"})
    )
    assert (frames.flux[0], frames.error[0]) == (2.0, 3.0)


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
    how = frame_files.FrameMapping(time="time_bin_start", time_at="start", exposure="time_bin_size", flux="flux")
    frames = frame_files.frames_of(series, how)
    np.testing.assert_allclose(frames.time_s, np.arange(N) * 20.0 + 9.0, atol=2e-5)
    np.testing.assert_allclose(frames.exposure_s, 18.0)


@pytest.mark.parametrize("kind", [StdDevUncertainty, InverseVariance, None])
def test_spectra_of_specutils_are_frames(kind: type | None) -> None:
    specutils = pytest.importorskip("specutils")
    error = np.full(LIGHT.shape, 0.5)
    uncertainty = None if kind is None else StdDevUncertainty(error).represent_as(kind)
    mask = np.zeros(LIGHT.shape, bool)
    mask[3, 1] = True
    spectra = specutils.Spectrum(
        flux=LIGHT * u.adu, spectral_axis=NM * 10 * u.AA, uncertainty=uncertainty, mask=mask, meta={"OBJECT": "AU Mic"}
    )
    frames = frame_files.frames_of(spectra, time=WHEN)
    np.testing.assert_allclose(frames.flux, np.where(mask, np.nan, LIGHT))
    np.testing.assert_allclose(frames.wavelength_nm, NM)
    assert (frames.unit, frames.name, frames.scale) == ("adu", "AU Mic", "tdb")
    if kind is None:
        assert frames.error is None
    else:
        np.testing.assert_allclose(frames.error, 0.5)


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
