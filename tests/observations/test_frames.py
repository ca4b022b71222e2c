"""Frames from arrays and files: order, gaps, dates, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import frames_of, read_frames
from tests.refusals import refused

RNG = np.random.default_rng(29)
TIME = np.arange(100) * 20.0
FLUX = 1000 + RNG.normal(0, 5, 100)
ERROR = np.full(100, 5.0)


def test_unsorted_frames_are_sorted_with_a_remark() -> None:
    order = RNG.permutation(100)
    frames = Frames.of(TIME[order], FLUX[order], ERROR[order])
    np.testing.assert_array_equal(frames.flux, FLUX)
    assert len(frames.remarks) == 1
    assert Frames.of(TIME, FLUX).remarks == ()


def test_numbers_follow_the_cadence_over_gaps_and_slow_changes_of_the_times() -> None:
    kept = np.r_[0:30, 50:100]
    assert Frames.of(TIME[kept], FLUX[kept]).numbers.tolist() == kept.tolist()
    # Barycentric times: 100 s of drift over a year, as of the Earth's motion along the line of sight.
    n = 20_000
    numbers = np.arange(n)
    time = numbers * 120.0 + 500.0 * np.sin(2 * np.pi * numbers * 120.0 / 3.156e7)
    np.testing.assert_array_equal(Frames.of(time, RNG.normal(0, 1, n)).numbers, numbers)


def test_faults_of_the_file_are_reasons() -> None:
    flux, error, quality = FLUX.copy(), ERROR.copy(), np.zeros(100)
    flux[3], error[5], quality[7] = np.nan, -1.0, 4
    faults = Frames.of(TIME, flux, error, quality=quality).faults
    assert np.flatnonzero(faults).tolist() == [3, 5, 7]
    assert [Reason.words(int(faults[k])) for k in (3, 5, 7)] == ["not finite", "not finite", "quality"]


def _table() -> Table:
    table = Table({"t": TIME / 86_400, "f": FLUX, "e": ERROR, "ok": np.zeros(100, int)})
    table["t"].unit = "d"
    return table


def test_csv_ecsv_and_fits_give_the_same_frames(tmp_path: Path) -> None:
    table = _table()
    table.write(tmp_path / "a.csv")
    table.write(tmp_path / "a.ecsv")
    table.write(tmp_path / "a.fits")
    mapping = FrameMapping(time="t", time_unit="d", flux="f", error="e", quality="ok", epoch="btjd", scale="tdb")
    every = [read_frames(tmp_path / f"a.{end}", mapping) for end in ("csv", "ecsv", "fits")]
    for frames in every:
        np.testing.assert_allclose(frames.time_s, TIME, atol=1e-6)
        np.testing.assert_allclose(frames.flux, FLUX)
        assert frames.scale == "tdb"
        assert frames.reference_mjd == pytest.approx(56_999.5)


def test_light_curves_of_tess_and_kepler_need_no_mapping(tmp_path: Path) -> None:
    columns = [
        fits.Column("TIME", "D", "BJD - 2457000, days", array=TIME / 86_400 + 1500),
        fits.Column("SAP_FLUX", "E", "e-/s", array=FLUX + 1),
        fits.Column("PDCSAP_FLUX", "E", "e-/s", array=FLUX),
        fits.Column("PDCSAP_FLUX_ERR", "E", "e-/s", array=ERROR),
        fits.Column("QUALITY", "J", array=np.arange(100) == 9),
    ]
    hdu = fits.BinTableHDU.from_columns(columns, name="LIGHTCURVE")
    primary = fits.PrimaryHDU()
    primary.header["OBJECT"] = "TIC 1"
    hdu.header.update({"BJDREFI": 2457000, "BJDREFF": 0.0, "TIMESYS": "TDB", "TREFPOS": "BARYCENTER"})
    fits.HDUList([primary, hdu]).writeto(tmp_path / "tess.fits")
    frames = read_frames(tmp_path / "tess.fits")
    assert (frames.name, frames.scale, frames.position) == ("TIC 1", "tdb", "BARYCENTER")
    assert frames.reference_mjd == pytest.approx(58_499.5)
    np.testing.assert_allclose(frames.flux, FLUX, rtol=1e-6)
    assert np.flatnonzero(frames.faults).tolist() == [9]


def test_the_errors_are_those_of_the_chosen_flux() -> None:
    """A light curve that lightkurve exports has its own flux next to those of the mission."""
    ones = np.ones(30)
    columns = {"time": np.arange(30.0), "pdcsap_flux": 2 * ones, "pdcsap_flux_err": 3 * ones, "flux": ones}
    frames = frames_of(Table(columns, units={"time": "s"}))
    assert frames.flux.tolist() == ones.tolist()
    assert frames.error is None
    frames = frames_of(Table({name: columns[name] for name in columns if name != "flux"}, units={"time": "s"}))
    assert frames.error is not None
    assert (frames.flux[0], frames.error[0]) == (2.0, 3.0)


def test_an_unknown_time_scale_of_a_mapping_is_refused() -> None:
    with refused("scale", "martian"):
        FrameMapping(time="time", flux="flux", scale="martian")
