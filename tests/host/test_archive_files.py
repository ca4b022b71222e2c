"""Unmodified files of the archives are read as by hand; those that are refused are in the corpus."""

import csv
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from corpus import CORPUS, cases, written
from refusals import refused

from mauvecl import Instrument, Source, expect

HERE = Path(__file__).parents[1] / "data" / "spectra"
ENTRIES = tomllib.loads((CORPUS / "archive_files.toml").read_text(encoding="utf-8"))
RIGHT, SHORT = ([pytest.param(one, id=one["file"]) for one in ENTRIES[key]] for key in ("right", "short"))
ANGSTROM = {"wavelength_unit": "Angstrom"}


def by_hand(name: str, flux: str = "FLUX", skip: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Read a file's wavelengths and fluxes, Angstrom and erg s-1 cm-2 A-1, by astropy, or as text."""
    if ".fits" in name:
        data = fits.getdata(HERE / name)
        return data["WAVELENGTH"].astype(float), data[flux].astype(float)
    text = (HERE / name).read_text()
    if name.endswith(".csv"):
        # Gaia's fluxes at 336 + 2 i nm, W m-2 nm-1, which are 100 erg s-1 cm-2 A-1.
        row = next(row for row in csv.DictReader(text.splitlines()) if row["source_id"] == "4")
        return 3360.0 + 20.0 * np.arange(343), 100.0 * np.array(row["flux"].strip("()").split(","), float)
    values = np.array([line.split()[:2] for line in text.splitlines()[skip:]], float)
    return values[:, 0], values[:, 1]


def test_every_file_is_tried() -> None:
    held = [case for _, case in cases(CORPUS / "archive_files.toml")] + ENTRIES["right"] + ENTRIES["short"]
    tried = {case["file"].split("[")[0] for case in held}
    assert tried == {path.name for path in HERE.iterdir() if path.suffix != ".md"}


# Astropy, by which files are read by hand, warns of a header with null values of real columns.
@pytest.mark.filterwarnings("ignore:Invalid keyword for column.*TNULLn")
@pytest.mark.parametrize("entry", RIGHT)
def test_archive_files_are_read(entry: dict[str, Any]) -> None:
    options = entry.get("options", {})
    star = Source.read(HERE / entry["file"], **options)
    angstrom, flux = by_hand(entry["file"].split("[")[0], **entry.get("how", {}))
    assert np.isfinite(star.flux_flam).all()
    assert all(any(words in text for text in star.messages) for words in entry.get("messages", ())), star.messages
    assert len(star.messages) == entry.get("n_messages", len(star.messages))
    # Points that stand once and have a flux are there as they stand, to the rounding of the unit.
    once = np.isfinite(flux) & np.isin(angstrom, np.unique(angstrom)[np.unique(angstrom, return_counts=True)[1] == 1])
    inside = once & (angstrom > 2000.0) & (angstrom < 7000.0)
    assert inside.sum() > 100
    place = np.searchsorted(star.wavelength_nm, angstrom[inside] / 10.0 * (1 - 1e-12))
    np.testing.assert_allclose(star.wavelength_nm[place], angstrom[inside] / 10.0, rtol=1e-12)
    np.testing.assert_allclose(star.flux_flam[place], flux[inside], rtol=1e-12)
    if "v" in entry:
        # Zero points of V differ by 0.03 mag; the M7 dwarf varies, and catalogues with it.
        assert star.magnitude("V") == pytest.approx(entry["v"], abs=0.15 if "extend" in options else 0.06)
    messages = expect(star.at_magnitude(8.0), Instrument.load("mauvesim"), exposure=50.0).messages
    assert all(any(text in message for message in messages) for text in star.messages)


@pytest.mark.parametrize("entry", SHORT)
def test_short_spectra_need_an_extension(entry: dict[str, Any]) -> None:
    star = Source.read(HERE / entry["file"], **entry.get("options", {}))
    assert any(text.startswith("its own points cover") for text in star.messages)
    with refused(*entry["refused"]):
        expect(replace(star, unscaled=""), Instrument.load("mauvesim"), exposure=5.0)


def test_messages_of_the_star_that_continues_a_spectrum() -> None:
    """What the library says of its star's ultraviolet is said of a spectrum that it continues to the blue."""
    (noisy,) = Source.from_library("M4V").messages
    assert "noise rules" in noisy
    wavelength = np.arange(90.0, 1100.0)
    # The zeros at the start stand for missing data.
    dark = Source.from_arrays(wavelength, np.where(wavelength < 300.0, 0.0, 1e-12), extend="M4V")
    for star in (Source.read(HERE / "vb8_stiswfcnic_004.fits", extend="M4V"), dark):
        assert f"in M4V, {noisy}" in star.messages


def test_surface_or_relative_fluxes_need_a_magnitude(tmp_path: Path) -> None:
    mauve = Instrument.load("mauvesim")
    lamost = written(dict(cases(CORPUS / "surveys.toml"))["surveys LAMOST table of DR8 fits"], tmp_path)
    model, ngsl = HERE / "ckp00_5750.fits[g45]", HERE / "h_stis_ngsl_hd095735_v2.txtA"
    for star in (Source.read(model), Source.read(ngsl, **ANGSTROM), Source.read(lamost, extend="K5V")):
        with refused("magnitude"):
            expect(star, mauve, exposure=5.0)
        assert expect(star.at_magnitude(7.5), mauve, exposure=5.0).signal_dn.max() > 0


def test_calspec_files_that_start_within_the_line_function_are_continued() -> None:
    """Cut a whole file where three of CALSPEC's begin (180.02-180.10 nm) and P330E does (199.95 nm)."""
    star = Source.read(HERE / "18sco_stis_004.fits")
    assert star.name == "18SCO"
    mauve = Instrument.load("mauvesim")
    whole = expect(star, mauve, exposure=50.0)
    for start in (180.02, 180.10, 199.95):
        kept = star.wavelength_nm >= start
        short = Source.from_arrays(star.wavelength_nm[kept], star.flux_flam[kept], name="short")
        found = expect(short, mauve, exposure=50.0)
        # A tenth of the noise at most, and a tenth of the light.
        error = np.abs(found.signal_dn - whole.signal_dn)
        assert (error < 0.1 * np.sqrt(whole.variance_dn2)).all()
        said = f"starts at {short.wavelength_nm[1]:g} nm and is continued to 180 nm"
        assert any(said in message for message in found.messages)
