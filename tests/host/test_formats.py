"""Special cases of user files: masks, the archives' spellings of units, and descending axes."""

from __future__ import annotations

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from refusals import refused

from mauvecl.host.stars.source import Source

FLAM = u.erg / (u.s * u.cm**2 * u.AA)
NM = np.arange(170.0, 1100.0, 1.0)
FLUX = 1e-15 * NM
HIDDEN = np.isin(NM, 300.0)


def read_ecsv(path: Path, wavelength: object, flux: object) -> Source:
    Table({"wavelength": wavelength, "flux": flux}).write(path, format="ascii.ecsv")
    return Source.read(path)


def read_fits(path: Path, wavelength_unit: str, flux_unit: str, per_nm: float = 10.0) -> Source:
    columns = [
        fits.Column("WAVELENGTH", "D", array=NM * per_nm, unit=wavelength_unit),
        fits.Column("FLUX", "D", array=FLUX, unit=flux_unit),
    ]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(path)
    return Source.read(path)


def test_masked_values_are_not_read(tmp_path: Path) -> None:
    masked = MaskedColumn(FLUX, mask=HIDDEN, unit=FLAM)
    with refused("flux", "131"):
        read_ecsv(tmp_path / "a.ecsv", NM * u.nm, masked)
    with refused("wavelength", "131"):
        read_ecsv(tmp_path / "b.ecsv", MaskedColumn(NM, mask=HIDDEN, unit="nm"), FLUX * FLAM)


def test_ecsv_must_name_its_units(tmp_path: Path) -> None:
    with refused("wavelength_unit"):
        read_ecsv(tmp_path / "a.ecsv", NM, FLUX * FLAM)
    with refused("flux_unit"):
        read_ecsv(tmp_path / "b.ecsv", NM * u.nm, FLUX)


@pytest.mark.parametrize("flux_unit", ["FLAM", "ergs/s/cm**2/A", "ERG/CM**2/S/ANGSTROM", "erg s-1 cm-2 Angstrom-1"])
def test_flux_units_as_archives_spell_them(tmp_path: Path, flux_unit: str) -> None:
    star = read_fits(tmp_path / "a.fits", "ANGSTROMS", flux_unit)
    np.testing.assert_allclose(star.flux_flam, FLUX, rtol=1e-12)


@pytest.mark.parametrize(("unit", "per_nm"), [("A", 10.0), ("Angstrom", 10.0), ("NM", 1.0), ("MICRONS", 1e-3)])
def test_wavelength_units_as_archives_spell_them(tmp_path: Path, unit: str, per_nm: float) -> None:
    np.testing.assert_allclose(read_fits(tmp_path / "a.fits", unit, "FLAM", per_nm).wavelength_nm, NM, rtol=1e-12)


def test_unknown_unit_raises(tmp_path: Path) -> None:
    with refused("unit", "FLUX", "'banana'") as caught:
        read_fits(tmp_path / "a.fits", "ANGSTROMS", "banana")
    assert len(str(caught.value)) < 140


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_frequencies_may_rise_or_fall(tmp_path: Path, order: slice) -> None:
    hertz = (NM * u.nm).to(u.Hz, u.spectral())[order]
    jansky = (FLUX * FLAM).to(u.Jy, u.spectral_density(NM * u.nm))[order]
    for star in (read_ecsv(tmp_path / "a.ecsv", hertz, jansky), Source.from_arrays(hertz, jansky)):
        np.testing.assert_allclose(star.wavelength_nm, NM, rtol=1e-12)
        np.testing.assert_allclose(star.flux_flam, FLUX, rtol=1e-9)


def test_text_from_other_editors(tmp_path: Path) -> None:
    text = "".join(f"{w} {f}\r\n" for w, f in zip(NM, FLUX, strict=True))
    (tmp_path / "windows.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
    np.testing.assert_allclose(Source.read(tmp_path / "windows.txt").flux_flam, FLUX)
    (tmp_path / "null.txt").write_bytes(b"\0" * 100)
    with refused("file"):
        Source.read(tmp_path / "null.txt")
