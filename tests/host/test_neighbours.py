"""Neighbours in the fibre: closed forms against a sum of spectra, and the choice of spectra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mauvecl.host.expectation import Expectation, expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.neighbour_table import read_neighbours
from mauvecl.host.neighbours import Neighbour, Neighbours
from mauvecl.host.stars.source import Source
from mauvecl.noise.comparison import Comparison
from mauvecl.statistics.linear import Matched
from mauvecl.statistics.statistic import Setting

MAUVE = Instrument.load("mauve")
STAR = Source.from_library("G2V").at_magnitude(7.4)
B = Neighbour("B", 12.5, 6.9, "V", "K5V")
C = Neighbour("C", 47.0, 8.0, "V", "F5V")
FAR = Neighbour("D", 47.47, 1.0, "V", "A0V")


def seen(star: Source, *neighbours: Neighbour, share: float = 1.0) -> Expectation:
    return expect(star, MAUVE, exposure=50.0, neighbours=Neighbours(neighbours, share) if neighbours else None)


def blend(share: float) -> Source:
    """Return the sum of the spectra of the star and its neighbours, made by hand."""
    b, c = Source.from_library("K5V").at_magnitude(6.9), Source.from_library("F5V").at_magnitude(8.0)
    nm = np.unique(np.concatenate([one.wavelength_nm for one in (STAR, b, c)]))
    nm = nm[(nm >= max(one.wavelength_nm[0] for one in (STAR, b, c))) & (nm <= 1000)]
    flux = [np.interp(nm, one.wavelength_nm, one.flux_flam) for one in (STAR, b, c)]
    return Source.from_arrays(nm, flux[0] + share * (flux[1] + flux[2]), name="blend")


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_light_and_noise_equal_those_of_the_summed_spectrum(share: float) -> None:
    x, whole = seen(STAR, B, C, FAR, share=share), seen(blend(share))
    np.testing.assert_allclose(x.mean_raw_dn, whole.mean_raw_dn, rtol=1e-9)
    np.testing.assert_allclose(x.variance_dn2, whole.variance_dn2, rtol=1e-9)
    # The signal is the star's alone, and its S/N falls by the noise of the others.
    np.testing.assert_allclose(x.signal_dn, seen(STAR).signal_dn, rtol=1e-9)
    noise = np.sqrt(whole.variance_dn2 - x.n_frames / 12)
    np.testing.assert_allclose(x.snr(), seen(STAR).signal_dn / noise, rtol=1e-6)


def test_flare_snr_equals_that_of_the_summed_spectrum() -> None:
    """Compare with sqrt(sum(delta^2 / v)), where v includes the photons of all stars."""
    quiet, flare, whole = seen(STAR, B, C), seen(STAR.flaring(0.081), B, C), seen(blend(1.0))
    delta = seen(STAR.flaring(0.081)).recorded_light_dn - seen(STAR).recorded_light_dn
    expected = np.sqrt(np.sum(delta**2 / whole.variance_dn2))
    setting = Setting(quiet, ~quiet.saturated, Comparison.of("template", "model"), [flare], None, None)
    form = Matched().closed_form(setting, flare, flare)
    assert form.mean / Matched().closed_form(setting, quiet, flare).std == pytest.approx(expected, rel=1e-6)


def test_dilution_follows_from_magnitudes() -> None:
    """Check that stars of one type share the light by their magnitudes."""
    x = seen(STAR, Neighbour("twin", 1.0, 8.4, "V", "G2V"), Neighbour("faint", 1.0, 9.9, "V", "G2V"), share=0.5)
    assert x.target_share == pytest.approx(1 / (1 + 0.5 * (10**-0.4 + 10**-1.0)), rel=1e-9)


def test_stars_beyond_the_fibre_or_without_share_add_nothing() -> None:
    for x in (seen(STAR, FAR), seen(STAR, B, share=0.0)):
        np.testing.assert_array_equal(x.variance_dn2, seen(STAR).variance_dn2)
        assert x.target_share == 1.0
    assert "none within 47.46 arcsec; 1 star beyond does not enter" in seen(STAR, FAR).messages[0]


def test_noise_budget_has_the_photons_of_neighbours() -> None:
    budget = seen(STAR, B).noise_budget()
    parts = [budget[name].value ** 2 for name in budget.colnames if name not in ("wavelength", "total")]
    np.testing.assert_allclose(np.sum(parts, axis=0), budget["total"].value ** 2, rtol=1e-12)
    assert "neighbour_photon" not in seen(STAR).noise_budget().colnames


@pytest.mark.parametrize(
    ("star", "spectrum", "statement"),
    [
        (Neighbour("a", 1.0, 9.0, spectral_type="K5V"), "K5V", ""),
        (Neighbour("b", 1.0, 9.0, spectral_type="k3v"), "K2.5V", ""),
        (Neighbour("c", 1.0, 9.0, spectral_type="M2V"), "M1V", "of type M2V: M1V, the nearest type"),
        (Neighbour("d", 1.0, 9.0, temperature_k=6040.0), "F8V", "of 6040 K: F8V (6039 K), the nearest"),
        (Neighbour("e", 1.0, 9.0, bp_rp=2.95), "M4V", "of BP - RP = 2.95: M4V (2.98), the nearest colour"),
        (Neighbour("f", 1.0, 9.0, spectral_type="A0V", temperature_k=3000.0), "A0V", ""),
    ],
)
def test_spectra_are_chosen_and_stated(star: Neighbour, spectrum: str, statement: str) -> None:
    assert star.spectrum[0] == spectrum
    assert star.spectrum[1].startswith(statement)
    assert bool(statement) == bool(star.spectrum[1])
    assert any("nearest" in text for text in seen(STAR, star).messages) == bool(statement)


def test_missing_values_matter_only_within_the_fibre() -> None:
    for star in (Neighbour("x", 5.0, 9.0), Neighbour("x", 5.0, spectral_type="G2V")):
        with refused("neighbours", "x", "5 arcsec"):
            seen(STAR, star)
    with refused("spectral_type", "DA2"):
        seen(STAR, Neighbour("x", 5.0, 9.0, spectral_type="DA2"))
    seen(STAR, Neighbour("x", 50.0))


def test_rows_may_name_spectrum_files(tmp_path: Path) -> None:
    (tmp_path / "b.txt").write_text("\n".join(f"{nm} 1e-13" for nm in range(180, 751)))
    (tmp_path / "near.csv").write_text("name,separation,file\nB,3,b.txt\n")
    (star,), _ = read_neighbours(tmp_path / "near.csv")
    assert star.source.flux_flam.max() == pytest.approx(1e-13)


def test_star_at_the_same_place_is_pointed_out() -> None:
    assert any("star.neighbours_of" in text for text in seen(STAR, Neighbour("A", 0.3, 7.2, "V", "G2V")).messages)
