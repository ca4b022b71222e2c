"""Names of stars, wherever a star can be given, and stars that are formulas; names that are refused are in a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table
from synphot import SourceSpectrum
from synphot.models import BlackBodyNorm1D
from synphot.units import FLAM

import mauvecl
from mauvecl import InputError, Sky, Source, Study, visible

KNOWN = Table.read(
    Path(mauvecl.__file__).parent / "host" / "stars" / "library" / "well_known.ecsv", format="ascii.ecsv"
)


def target(name: str) -> Any:
    """Return the target of a name."""
    return visible(Study.build({"orbit": {"targets": [name], "days": 0.1}}, "test")).targets[0]


@pytest.mark.parametrize(("text", "name"), [
    ("M3", "M3V"), ("m3v", "M3V"), (" g2v ", "G2V"),  # without luminosity class, in other letters
    ("K3V", "K2.5V"), ("K2.5", "K2.5V"), ("hd 40307", "K2.5V"),  # an alias, and the star of the class
    ("gj581", "M3V"), ("GX And", "M1V"),  # stars with spectra of their own; the library has one as GJ 15A
    ("BLACK BODY 9e3K", "blackbody 9000 K"), ("planck 5772.5 K", "blackbody 5772.5 K"),
    ("powerlaw +1.50", "power law 1.5"),
])  # fmt: skip
def test_names_of_spectra_are_resolved(text: str, name: str) -> None:
    assert Source.from_library(text).name == name
    assert Source.from_library(name).digest == Source.from_library(text).digest


@pytest.mark.parametrize(("texts", "name", "magnitude"), [
    (("eps Eri", "epsilon Eri", "EPS ERI", "HD 22049", "hd22049", "HIP 16537"), "eps Eri", 3.72),
    (("gj581",), "GJ 581", 10.57), (("HD 40307",), "HD 40307", 7.17), (("GX And",), "GX And", 8.09),
    (("AU Mic",), "AU Mic", 8.81), (("Proxima",), "Proxima Cen", 11.01), (("HD 1835",), "BE Cet", 6.39),
    (("GJ 354.1",), "DX Leo", 7.05),  # a decimal point that counts
])  # fmt: skip
def test_names_of_targets_are_resolved(texts: tuple[str, ...], name: str, magnitude: float) -> None:
    for text in texts:
        assert (target(text).name, target(text).magnitude) == (name, magnitude)


def test_every_listed_name_is_found() -> None:
    """No name stands for two stars, and each has its coordinates as a target and for the sky."""
    for row in KNOWN:
        place = SkyCoord(row["ra"] * u.deg, row["dec"] * u.deg)
        for name in {row["name"], *str(row["other_names"]).split(", ")} - {"", "--"}:
            assert target(name).name == row["name"], name
            assert (target(name).ra_deg, target(name).dec_deg) == (row["ra"], row["dec"])
        skies = set()
        for one in (str(row["name"]), place):
            try:
                skies.add(Sky.at(one, "2027-07-01").description)
            except InputError as error:
                skies.add(str(error))
        assert len(skies) == 1, row["name"]
    assert target("19h22m00s -11d12m00s").ra_deg == pytest.approx(290.5)


@pytest.mark.parametrize("kelvin", [3000, 5772, 30_000])
def test_blackbody_equals_that_of_synphot(kelvin: int) -> None:
    """Between its points, too, since answers interpolate it; relative to its flux at 550 nm."""
    star = Source.from_library(f"Blackbody {kelvin} k")
    at = np.linspace(200.0, 700.0, 1001)
    other = SourceSpectrum(BlackBodyNorm1D, temperature=kelvin)(at * u.nm, flux_unit=FLAM).value
    own = np.interp(at, star.wavelength_nm, star.flux_flam)
    middle = np.searchsorted(at, 550.0)
    np.testing.assert_allclose(own / own[middle], other / other[middle], rtol=3e-5)
    assert star.temperature_k == kelvin


def test_flat_power_law_has_no_colour() -> None:
    """A flux per wavelength of index -2 is constant per frequency, and AB magnitudes are those of a constant."""
    star = Source.from_library("power law -2")
    magnitudes = [star.magnitude(band, "ab") for band in ("B", "V", "Kepler", "GALEX NUV", "TESS", "Gaia G")]
    # Trapezoids between the points of the bands' tables differ by 2e-4 mag from the integrals.
    assert np.ptp(magnitudes) < 3e-4


@pytest.mark.parametrize("index", [-4.0, 0.0, 2.5])
def test_power_law_has_its_index_and_no_level(index: float) -> None:
    formula = Source.from_library(f"power-law {index}")
    assert formula.unscaled
    star = formula.at_magnitude(9.0)
    assert not star.unscaled
    slope = np.diff(np.log(star.flux_flam)) / np.diff(np.log(star.wavelength_nm))
    np.testing.assert_allclose(slope, index, atol=1e-9)
    assert star.magnitude("V") == pytest.approx(9.0)
