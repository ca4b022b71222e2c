"""Containers of other packages as frames."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import InverseVariance, StdDevUncertainty
from astropy.time import Time
from astropy.timeseries import BinnedTimeSeries, TimeSeries

from mauvecl.observations.frame_files import frames_of
from mauvecl.observations.mapping import FrameMapping

N = 30
WHEN = Time(61_000.0, np.arange(N) * 20.0 / 86_400, format="mjd", scale="tdb")
FLUX = np.random.default_rng(3).normal(100.0, 1.0, (N, 4))
NM = np.array([300.0, 400.0, 500.0, 600.0])


def test_time_series_of_astropy_are_frames() -> None:
    series = TimeSeries(time=WHEN, data={"flux": FLUX[:, 0] * u.Jy, "flux_err": np.full(N, 1000.0) * u.mJy})
    frames = frames_of(series)
    np.testing.assert_allclose(frames.flux, FLUX[:, 0])
    assert frames.error is not None
    np.testing.assert_allclose(frames.error, 1.0)
    np.testing.assert_allclose(frames.time_s, np.arange(N) * 20.0, atol=2e-5)
    assert (frames.unit, frames.scale, frames.reference_mjd) == ("Jy", "tdb", pytest.approx(61_000.0))


def test_binned_time_series_are_frames_through_a_mapping() -> None:
    series = BinnedTimeSeries(time_bin_start=WHEN, time_bin_size=18.0 * u.s, data={"flux": FLUX[:, 0]})
    how = FrameMapping(time="time_bin_start", time_at="start", exposure="time_bin_size", flux="flux")
    frames = frames_of(series, how)
    np.testing.assert_allclose(frames.time_s, np.arange(N) * 20.0 + 9.0, atol=2e-5)
    np.testing.assert_allclose(frames.exposure_s, 18.0)


@pytest.mark.parametrize("kind", [StdDevUncertainty, InverseVariance, None])
def test_spectra_of_specutils_are_frames(kind: type | None) -> None:
    specutils = pytest.importorskip("specutils")
    error = np.full(FLUX.shape, 0.5)
    uncertainty = None if kind is None else StdDevUncertainty(error).represent_as(kind)
    mask = np.zeros(FLUX.shape, bool)
    mask[3, 1] = True
    spectra = specutils.Spectrum(
        flux=FLUX * u.adu, spectral_axis=NM * 10 * u.AA, uncertainty=uncertainty, mask=mask, meta={"OBJECT": "AU Mic"}
    )
    frames = frames_of(spectra, time=WHEN)
    np.testing.assert_allclose(frames.flux, np.where(mask, np.nan, FLUX))
    assert frames.wavelength_nm is not None
    np.testing.assert_allclose(frames.wavelength_nm, NM)
    assert (frames.unit, frames.name, frames.scale) == ("adu", "AU Mic", "tdb")
    if kind is None:
        assert frames.error is None
    else:
        assert frames.error is not None
        np.testing.assert_allclose(frames.error, 0.5)
