"""Spectra of flares: light, totals, and observed spectra."""

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.physical_models import BlackBody
from refusals import refused

from mauvecl import BalmerFlare, Blackbody, FlareWithLines, ObservedFlare, TwoBlackbodies

DATA = Path(__file__).parent.parent / "data"
FLARE, QUIET = DATA / "spectra" / "ADLeo_912s.dat", DATA / "flares" / "adleo_quiescent2.dat"


def blackbody(nm: np.ndarray, kelvin: float) -> np.ndarray:
    """Return the surface flux of astropy's blackbody, erg s-1 cm-2 A-1."""
    unit = u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    return np.asarray(np.pi * BlackBody(temperature=kelvin * u.K, scale=1.0 * unit)(nm * u.nm).to_value(unit))


SPECTRA = {
    "blackbody": Blackbody(9000.0),
    "two": TwoBlackbodies(7000.0, 25_000.0, 0.1),
    "Balmer": BalmerFlare(9500.0, 2.5),
    "lines": FlareWithLines(BalmerFlare(9500.0, 1.5), {"Mg II": 0.03, "Ca II": 0.02, "Balmer": 0.1, "250": 0.01}),
    "observed": ObservedFlare.read(FLARE, QUIET, wavelength_unit="Angstrom", continue_at_k=9500.0),
}


@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_total_equals_the_integral_on_a_grid_with_lines_and_edges(spectrum: Any) -> None:
    grids = (spectrum.grid(np.linspace(180.0, 750.0, n)) for n in (1141, 57_001))
    coarse, fine = (np.trapezoid(spectrum.flux(grid), grid) for grid in grids)
    assert coarse == pytest.approx(fine, rel=1e-5)
    grid = spectrum.grid(np.geomspace(10.0, 300_000.0, 40_001))
    total = 10.0 * np.trapezoid(spectrum.flux(grid), grid)
    assert spectrum.bolometric_flux() == pytest.approx(total, rel=2e-5)


def test_blackbody_equals_astropy_to_the_last_bit() -> None:
    nm = np.arange(170.0, 1100.0)
    for kelvin in (3000.0, 5772.0, 10_000.0, 50_000.0):
        np.testing.assert_array_equal(Blackbody(kelvin).flux(nm), blackbody(nm, kelvin))


def test_balmer_flare_follows_its_formula() -> None:
    nm, flare = np.array([200.0, 300.0, 364.5, 364.7, 500.0]), BalmerFlare(9500.0, 2.5, 8000.0)
    edge = blackbody(np.array([364.6]), 9500.0)[0]
    # h, c and k of CODATA 2018, SI.
    exponent = 6.62607015e-34 * 2.99792458e8 / (1.380649e-23 * 8000.0) * (1 / nm - 1 / 364.6) * 1e9
    added = np.where(nm <= 364.6, 1.5 * edge * (364.6 / nm) ** 2 * np.exp(-exponent), 0.0)
    np.testing.assert_allclose(flare.flux(nm), blackbody(nm, 9500.0) + added, rtol=1e-8)
    sides = flare.flux(np.array([364.6, 364.601]))
    assert sides[0] / sides[1] == pytest.approx(2.5, rel=1e-4)
    assert BalmerFlare(9500.0, 1.0).flux(nm) == pytest.approx(blackbody(nm, 9500.0), rel=1e-15)


def test_relative_lines_carry_their_fraction_and_absolute_ones_their_flux() -> None:
    plain, nm = Blackbody(10_000.0), np.linspace(200.0, 700.0, 50_001)
    lined = FlareWithLines(plain, {"Mg II": 0.05}, {"H beta": 2e-13})
    grid = lined.grid(nm)
    added = np.trapezoid(lined.flux(grid) - plain.flux(grid), grid) / np.trapezoid(plain.flux(nm), nm)
    assert added == pytest.approx(0.05, rel=1e-6)
    assert 10 * np.trapezoid(lined.flux_at_telescope(grid), grid) == pytest.approx(2e-13, rel=1e-12)
    assert lined.fixed_lines
    assert not FlareWithLines(plain, {"Mg II": 0.05}).fixed_lines


def test_lines_have_the_wavelengths_of_their_atoms() -> None:
    """Compare with the Rydberg constant of hydrogen, 1.09677583e7 m-1 (CODATA), and NIST's lines of Ca II and Mg II."""

    def centre(*lines: str) -> float:
        flare = FlareWithLines(Blackbody(), {}, dict.fromkeys(lines, 1e-13))
        nm = flare.grid(np.linspace(200.0, 700.0, 50_001))
        return float(np.average(nm, weights=flare.flux_at_telescope(nm) * np.gradient(nm)))

    for n, name in enumerate(("h_ALPHA", "H beta", "H gamma", "H delta", "H epsilon", "H8"), 3):
        assert centre(name) == pytest.approx(1e9 / (1.09677583e7 * (0.25 - 1 / n**2)), abs=0.02)
    for name, nm in (("Ca II K", 393.478), ("Ca II H", 396.959), ("Mg II k", 279.635), ("Mg II h", 280.353)):
        assert centre(name) == pytest.approx(nm, abs=0.002)
    assert centre("Ca II") == pytest.approx(centre("Ca II K", "Ca II H"), abs=1e-6)


def test_coarse_spectrum_is_continued_from_its_last_point_if_asked() -> None:
    flare = ObservedFlare.from_arrays([150.0, 300.0, 500.0], [1.0, 2.0, 3.0], continue_at_k=8000.0)
    assert flare.measured_nm == (150.0, 500.0)
    assert "8000 K continues it" in flare.messages[-1]
    far = blackbody(np.array([500.0, flare.wavelength_nm[-1]]), 8000.0)
    assert flare.flux_flam[-1] == pytest.approx(3.0 * far[1] / far[0])


def test_quiescent_spectrum_is_subtracted(tmp_path: Path) -> None:
    nm, other = np.linspace(150.0, 800.0, 1301), np.linspace(190.0, 820.0, 2001)
    for name, at, flux in (("both", nm, 3e-14 * nm), ("star", other, 1e-14 * other)):
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack([at, flux]))
    flare = ObservedFlare.read(tmp_path / "both.txt", tmp_path / "star.txt")
    assert flare.measured_nm == (190.0, 800.0)
    inside = nm[nm >= 190.0]
    np.testing.assert_allclose(flare.flux(inside), 2e-14 * inside, rtol=1e-9)
    assert not any("gaps" in text for text in flare.messages)
    # What is left of equal spectra may be their rounding.
    for factor in (1.0, 1.0 - 1e-14, 1.01):
        np.savetxt(tmp_path / "same.txt", np.column_stack([nm, factor * 3e-14 * nm]), fmt="%.17e")
        with refused("quiescent", "brighter than same"):
            ObservedFlare.read(tmp_path / "both.txt", tmp_path / "same.txt", continue_at_k=9000.0)
    kept = (nm < 330.0) | (nm > 356.0)
    gap = ObservedFlare.from_arrays(nm[kept], 1e-14 * nm[kept])
    assert any("gaps at 329.5-356.5 nm" in text for text in gap.messages)
