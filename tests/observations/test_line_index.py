"""Line indices above a straight continuum: closed forms, error propagation, specutils, and the spectra of AU Mic."""

from __future__ import annotations

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest

from mauvecl.observations.line_index import MG_II_CONTINUUM_NM, MG_II_NM, line_index

AU_MIC = Path(__file__).parents[1] / "data" / "flares" / "aumic_iue"
NM = np.linspace(270.0, 290.0, 201)
LINE = np.exp(-((NM - 280.0) ** 2) / 2 / 0.3**2) / 0.3 / np.sqrt(2 * np.pi)


def mg_ii(nm: np.ndarray, flux: np.ndarray, error: np.ndarray | None = None) -> tuple[float, float]:
    found = line_index(nm, flux, error, band_nm=MG_II_NM, continuum_nm=MG_II_CONTINUUM_NM)
    return float(found.flux), float(found.error)


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_straight_continuum_is_removed_exactly(slope: float) -> None:
    found = line_index(NM, 5.0 + slope * (NM - 280) + 2 * LINE, band_nm=MG_II_NM, continuum_nm=MG_II_CONTINUUM_NM)
    assert found.flux == pytest.approx(2.0, abs=2e-6)
    assert found.equivalent_width_nm == pytest.approx(0.4, abs=1e-5)
    assert np.isnan(found.error)


def test_error_is_that_of_linear_propagation() -> None:
    """The derivative by each pixel is measured; the index is linear, so that differences of any size are exact."""
    error = 0.1 + 0.02 * np.sin(NM)
    flux = 5.0 + LINE
    one = np.array([mg_ii(NM, flux + np.eye(NM.size)[k], error)[0] for k in range(NM.size)])
    start, stated = mg_ii(NM, flux, error)
    assert stated == pytest.approx(np.sqrt((((one - start) * error) ** 2).sum()), rel=1e-9)


@pytest.mark.long
def test_flux_equals_that_of_specutils() -> None:
    specutils = pytest.importorskip("specutils")
    from specutils.analysis import line_flux

    # Limits of the band on the edges of pixels, which both packages count alike.
    low, high = 278.45, 281.55
    inside = ((NM > 275.5) & (NM < 278)) | ((NM > 282) & (NM < 284.5))
    flux = 3.0 + 0.1 * (NM - 280) + LINE
    net = flux - np.polyval(np.polyfit(NM[inside], flux[inside], 1), NM)
    spectrum = specutils.Spectrum(spectral_axis=NM * u.nm, flux=net * u.one)
    there = line_flux(spectrum, specutils.SpectralRegion(278.5 * u.nm, 281.5 * u.nm)).to_value(u.nm)
    found = line_index(NM, flux, band_nm=(low, high), continuum_nm=[(275.5, 278), (282, 284.5)])
    assert found.flux == pytest.approx(there, rel=1e-5)


def test_batch_of_spectra_equals_single_spectra() -> None:
    rng = np.random.default_rng(1)
    flux, error = 5.0 + rng.normal(0, 0.1, (4, NM.size)), rng.uniform(0.05, 0.2, (4, NM.size))
    error[2, 60] = np.nan
    found = line_index(NM * u.nm, flux, error, band_nm=MG_II_NM, continuum_nm=MG_II_CONTINUUM_NM)
    for k in range(4):
        assert (found.flux[k], found.error[k]) == pytest.approx(mg_ii(NM, flux[k], error[k]), rel=1e-12)


def test_mg_ii_of_au_mic_lies_in_the_published_range() -> None:
    """20 IUE spectra: 0.6-3.5e-12 erg/s/cm2, median 3.0e-12; formal errors from 1e-13, of long exposures, to 5e-13."""
    found = []
    for path in sorted(AU_MIC.glob("lp*.txt")):
        angstrom, flux, error = np.loadtxt(path, skiprows=19, usecols=(0, 1, 2)).T
        # Per nm, so that the index is a flux.
        found.append(mg_ii(angstrom / 10, 10 * flux, 10 * error))
    flux, error = np.array(found).T
    assert flux.size == 20
    assert [round(float(1e12 * x), 1) for x in (flux.min(), np.median(flux), flux.max())] == [0.6, 3.0, 3.5]
    assert 7e-14 < error.min() < 1e-13
    assert error.max() < 5e-13
