"""Input from other packages, and output to them."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from scenes import star

from mauvecl import Blackbody, Frames, Source, Study
from mauvecl.host.stars import flare as flare_tables


def test_synphot_spectrum_round_trips() -> None:
    source = Source.from_library("G2V").at_magnitude(7.4)
    back = Source.from_synphot(source.to_synphot(), name="G2V")
    np.testing.assert_allclose(
        np.interp(source.wavelength_nm, back.wavelength_nm, back.flux_flam), source.flux_flam, rtol=1e-10, atol=1e-25
    )
    assert back.magnitude("V") == pytest.approx(7.4, abs=1e-4)


def test_synphot_blackbody_is_read() -> None:
    from synphot import SourceSpectrum
    from synphot.models import BlackBodyNorm1D, Empirical1D

    body = Source.from_synphot(SourceSpectrum(BlackBodyNorm1D, temperature=6000))
    inside = (body.wavelength_nm > 200) & (body.wavelength_nm < 700)
    shape = body.flux_flam[inside] / Blackbody(6000.0).flux(body.wavelength_nm[inside])
    np.testing.assert_allclose(shape, shape[0], rtol=1e-3)
    # As many photons at all wavelengths are no straight line between two points.
    flat = Source.from_synphot(SourceSpectrum(Empirical1D, points=[1600, 11_000], lookup_table=[1.0, 1.0]))
    nm = np.arange(200.0, 700.0, 7.3)
    light = nm * np.interp(nm, flat.wavelength_nm, flat.flux_flam)
    np.testing.assert_allclose(light, light[0], rtol=1e-5)


def test_reddening_has_the_total_extinction_of_its_law() -> None:
    """The laws of dust_extinction are those relative to A(V), which is A at 550 nm."""
    pytest.importorskip("dust_extinction")
    star = Source.from_library("G2V")
    for rv in (3.1, 5.0):
        pair = (star, star.reddened(0.3, rv=rv))
        bare, dimmed = (np.interp(550.0, one.wavelength_nm, one.flux_flam) for one in pair)
        assert 2.5 * np.log10(bare / dimmed) == pytest.approx(rv * 0.3, rel=2e-3)


def test_stsynphot_spectrum_is_read(recwarn: pytest.WarningsRecorder) -> None:
    """Read the result of its parser for expressions that need no data files."""
    parser = pytest.importorskip("stsynphot.spparser")
    found = Source.from_synphot(parser.parse_spec("rn(bb(9000),box(5500,100),15,abmag)"))
    assert found.at_magnitude(8.0).magnitude("V") == pytest.approx(8.0, abs=1e-6)
    body = Source.from_arrays(found.wavelength_nm, Blackbody(9000.0).flux(found.wavelength_nm))
    np.testing.assert_allclose(found.at_magnitude(8.0).flux_flam, body.at_magnitude(8.0).flux_flam, rtol=1e-3)


def test_specutils_spectrum_round_trips() -> None:
    specutils = pytest.importorskip("specutils")
    source = Source.from_library("K3V").at_magnitude(6.0)
    out = source.to_specutils()
    assert out.flux.unit.is_equivalent(u.erg / (u.s * u.cm**2 * u.AA))
    back = Source.from_specutils(out, name="K3V")
    np.testing.assert_array_equal(back.flux_flam, source.flux_flam)
    np.testing.assert_array_equal(back.wavelength_nm, source.wavelength_nm)
    other = specutils.Spectrum(spectral_axis=source.wavelength_nm * u.nm, flux=out.flux.to(u.W / u.m**2 / u.um))
    np.testing.assert_allclose(Source.from_specutils(other).flux_flam, source.flux_flam)
    other.mask = source.wavelength_nm < 150.0
    assert Source.from_specutils(other).wavelength_nm[0] >= 150.0


def test_expectation_converts_to_a_specutils_spectrum() -> None:
    pytest.importorskip("specutils")
    (quiet,) = star()
    out = quiet.to_specutils()
    np.testing.assert_array_equal(out.flux.value, quiet.signal_dn)
    np.testing.assert_allclose(out.uncertainty.array, np.sqrt(quiet.variance_dn2))
    assert not out.mask.any()


ALTAIPONY = """istart,istop,cstart,cstop,tstart,tstop,ed_rec,ed_rec_err,ampl_rec,dur,total_n_valid_data_points
10,14,1,5,1325.301,1325.304,12.1,0.3,0.081,0.0028,18000
90,95,81,86,1330.117,1330.121,40.5,0.5,0.24,0.0035,18000
99,102,90,93,1331.2,1331.203,1.1,0.2,0.081,0.002,18000
"""


def test_altaipony_table_is_read(tmp_path: Path) -> None:
    """Read the columns that FlareLightCurve.flares writes to CSV; the corpus compares them."""
    (tmp_path / "flares.csv").write_text(ALTAIPONY)
    with pytest.warns(UserWarning, match="not used: istart"):
        study = Study.of(flares=str(tmp_path / "flares.csv"))
    assert study.flare.amplitudes == (0.081, 0.24), "each amplitude once"


def test_data_frame_and_fits_table_are_read(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    seconds, light = pandas.Series(np.arange(20.0)), pandas.Series([None] + 19 * [7], dtype="Int64")
    np.testing.assert_array_equal(Frames.of(seconds, light).flux, [np.nan] + 19 * [7.0])
    frame = pandas.DataFrame({"Amplitude": [0.1, 0.2], "Start": [1.0, 2.0]})
    np.testing.assert_array_equal(flare_tables.flares_of(frame)["amplitude"], [0.1, 0.2])
    Table({"amp": [0.3]}).write(tmp_path / "f.fits")
    np.testing.assert_array_equal(flare_tables.read_flares(tmp_path / "f.fits")["amplitude"], [0.3])


def test_html_representations_contain_values() -> None:
    (quiet,) = star()
    assert "best S/N" in quiet._repr_html_()
    source = Source.from_arrays(np.linspace(170, 800, 50), np.ones(50), name="<script>")
    assert "<script>" not in source._repr_html_()
