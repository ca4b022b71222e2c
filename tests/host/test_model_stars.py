"""Blackbody and power-law stars against Planck's law of synphot and closed forms."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from synphot import SourceSpectrum
from synphot.models import BlackBodyNorm1D
from synphot.units import FLAM

from mauvecl.host.stars.source import Source
from mauvecl.host.stars.star_names import all_names, resolve
from tests.refusals import refused


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
def test_power_law_has_its_index(index: float) -> None:
    star = Source.from_library(f"power-law {index}").at_magnitude(9.0)
    slope = np.diff(np.log(star.flux_flam)) / np.diff(np.log(star.wavelength_nm))
    np.testing.assert_allclose(slope, index, atol=1e-9)
    assert star.magnitude("V") == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("BLACK BODY 9e3K", "blackbody 9000 K"),
        ("planck 5772.5 K", "blackbody 5772.5 K"),
        ("powerlaw +1.50", "power law 1.5"),
    ],
)
def test_names_are_read_in_several_spellings_and_give_the_star_again(text: str, name: str) -> None:
    star, again = resolve(text), resolve(name)
    assert star == again
    assert star is not None
    assert star.spectrum == name


@pytest.mark.parametrize("text", ["blackbody", "blackbody nan K", "power law", "power law -2 nm", "body 3000 K"])
def test_other_names_are_no_formula(text: str) -> None:
    assert resolve(text) is None


@pytest.mark.parametrize(
    ("text", "value"), [("blackbody 999 K", 999.0), ("power law 11", 11.0), ("power law -10.1", -10.1)]
)
def test_numbers_out_of_range_are_refused(text: str, value: float) -> None:
    key = "temperature_of_the_blackbody" if text.startswith("blackbody") else "index_of_the_power_law"
    with refused(key, value=value):
        Source.from_library(text)


def test_level_of_a_formula_is_asked_for() -> None:
    """Its examples are offered among the names of stars."""
    assert {"blackbody 9000 K", "power law -2"} <= set(all_names())
    assert Source.from_library("power law -2").unscaled
    assert not Source.from_library("power law -2").at_magnitude(7.0).unscaled
