"""Frames from arrays: order, gaps, and faults."""

from __future__ import annotations

import numpy as np
from astropy.table import Table

from mauvecl import Frames
from mauvecl.observations.frame_files import frames_of

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
    frames = Frames.of(TIME, flux, error, quality=quality)
    assert np.flatnonzero(frames.faults).tolist() == [3, 5, 7]
    assert frames.faults[3] == frames.faults[5] != frames.faults[7]
    assert frames.flags[7] == "4"


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
