"""Input from other packages, and output to them."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from scenes import quiescent, source

from mauvecl import Blackbody, Frames, Source, Study
from mauvecl.host.stars import flare as flare_tables

SUN = source("G2V", 7.4)


def test_synphot_spectrum_round_trips_and_one_of_stsynphot_is_read(recwarn: pytest.WarningsRecorder) -> None:
    from synphot import SourceSpectrum
    from synphot.models import Empirical1D

    back = Source.from_synphot(SUN.to_synphot(), name="G2V")
    found = np.interp(SUN.wavelength_nm, back.wavelength_nm, back.flux_flam)
    np.testing.assert_allclose(found, SUN.flux_flam, rtol=1e-10, atol=1e-25)
    # As many photons at all wavelengths are no straight line between two points.
    flat = Source.from_synphot(SourceSpectrum(Empirical1D, points=[1600, 11_000], lookup_table=[1.0, 1.0]))
    nm = np.arange(200.0, 700.0, 7.3)
    light = nm * np.interp(nm, flat.wavelength_nm, flat.flux_flam)
    np.testing.assert_allclose(light, light[0], rtol=1e-5)
    # What stsynphot's parser makes of expressions that need no data files.
    parser = pytest.importorskip("stsynphot.spparser")
    found = Source.from_synphot(parser.parse_spec("rn(bb(9000),box(5500,100),15,abmag)"))
    assert found.at_magnitude(8.0).magnitude("V") == pytest.approx(8.0, abs=1e-6)
    body = Source.from_arrays(found.wavelength_nm, Blackbody(9000.0).flux(found.wavelength_nm))
    np.testing.assert_allclose(found.at_magnitude(8.0).flux_flam, body.at_magnitude(8.0).flux_flam, rtol=1e-3)


def test_specutils_spectra_are_read_and_made() -> None:
    specutils = pytest.importorskip("specutils")
    out = SUN.to_specutils()
    back = Source.from_specutils(out, name="G2V")
    np.testing.assert_array_equal((back.flux_flam, back.wavelength_nm), (SUN.flux_flam, SUN.wavelength_nm))
    other = specutils.Spectrum(spectral_axis=SUN.wavelength_nm * u.nm, flux=out.flux.to(u.W / u.m**2 / u.um))
    np.testing.assert_allclose(Source.from_specutils(other).flux_flam, SUN.flux_flam)
    other.mask = SUN.wavelength_nm > 1000.0
    assert Source.from_specutils(other).wavelength_nm[-1] <= 1000.0
    quiet, signal = quiescent(), quiescent().to_specutils()
    np.testing.assert_array_equal(signal.flux.value, quiet.signal_dn)
    np.testing.assert_allclose(signal.uncertainty.array, np.sqrt(quiet.variance_dn2))
    assert not signal.mask.any()


def test_data_frame_and_fits_table_are_read(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    seconds, light = pandas.Series(np.arange(20.0)), pandas.Series([None] + 19 * [7], dtype="Int64")
    np.testing.assert_array_equal(Frames.of(seconds, light).flux, [np.nan] + 19 * [7.0])
    frame = pandas.DataFrame({"Amplitude": [0.1, 0.2], "Start": [1.0, 2.0]})
    found = flare_tables.flares_of(frame)
    assert (found["amplitude"].tolist(), found["start"].to_value("h").tolist()) == ([0.1, 0.2], [24.0, 48.0])
    frame.to_csv(tmp_path / "f.csv", index=False)
    assert Study.of(flares=str(tmp_path / "f.csv")).flare.amplitudes == (0.1, 0.2)
    Table({"amp": [0.3, 0.1, 0.3], "istart": [1, 2, 3]}).write(tmp_path / "f.fits")
    with pytest.warns(UserWarning, match="not used: istart"):
        study = Study.of(flares=str(tmp_path / "f.fits"))
    assert study.flare.amplitudes == (0.1, 0.3), "each amplitude once"


def test_html_representations_contain_values() -> None:
    assert "best S/N" in quiescent()._repr_html_()
    star = Source.from_arrays(np.linspace(170, 800, 50), np.ones(50), name="<script>")
    assert "<script>" not in star._repr_html_()
