"""Neighbours in the fibre: closed forms against a sum of spectra, and the choice of spectra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mauvecl import Expectation, Instrument, Source, Study, expect, simulate

STAR = Source.from_library("G2V").at_magnitude(7.4)
HEAD = "name,separation,V,sptype"
B, C, FAR = "B,12.5,6.9,K5V", "C,47.0,8.0,F5V", "D,47.47,1.0,A0V"


def seen(folder: Path, *rows: str, head: str = HEAD, share: float = 1.0) -> Expectation:
    """Return the expectation of the star with neighbours in a table."""
    (folder / "near.csv").write_text("\n".join((head, *rows)) + "\n")
    star = {"library": "G2V", "magnitude": 7.4, "neighbours": str(folder / "near.csv"), "neighbour_share": share}
    study = {"star": [star], "observation": {"exposure_s": 50.0}}
    return simulate(Study.build(study, "test")).inputs[0]


def alone(star: Source = STAR) -> Expectation:
    return expect(star, Instrument.load("mauve"), exposure=50.0)


def blend(share: float) -> Source:
    """Return the sum of the spectra of the star and its neighbours, made by hand."""
    b, c = Source.from_library("K5V").at_magnitude(6.9), Source.from_library("F5V").at_magnitude(8.0)
    nm = np.unique(np.concatenate([one.wavelength_nm for one in (STAR, b, c)]))
    nm = nm[(nm >= max(one.wavelength_nm[0] for one in (STAR, b, c))) & (nm <= 1000)]
    flux = [np.interp(nm, one.wavelength_nm, one.flux_flam) for one in (STAR, b, c)]
    return Source.from_arrays(nm, flux[0] + share * (flux[1] + flux[2]), name="blend")


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_light_and_noise_equal_those_of_the_summed_spectrum(tmp_path: Path, share: float) -> None:
    x, whole = seen(tmp_path, B, C, FAR, share=share), alone(blend(share))
    np.testing.assert_allclose(x.mean_raw_dn, whole.mean_raw_dn, rtol=1e-9)
    np.testing.assert_allclose(x.variance_dn2, whole.variance_dn2, rtol=1e-9)
    # The signal is the star's alone, and its S/N falls by the noise of the others.
    np.testing.assert_allclose(x.signal_dn, alone().signal_dn, rtol=1e-9)
    noise = np.sqrt(whole.variance_dn2 - x.n_frames / 12)
    np.testing.assert_allclose(x.snr(), alone().signal_dn / noise, rtol=1e-6)
    budget = x.noise_budget()
    parts = [budget[name].value ** 2 for name in budget.colnames if name not in ("wavelength", "total")]
    np.testing.assert_allclose(np.sum(parts, axis=0), budget["total"].value ** 2, rtol=1e-12)
    assert "neighbour_photon" not in alone().noise_budget().colnames


def test_dilution_follows_from_magnitudes(tmp_path: Path) -> None:
    """Check that stars of one type share the light by their magnitudes."""
    x = seen(tmp_path, "twin,1.0,8.4,G2V", "faint,1.0,9.9,G2V", share=0.5)
    assert x.target_share == pytest.approx(1 / (1 + 0.5 * (10**-0.4 + 10**-1.0)), rel=1e-9)


def test_stars_beyond_the_fibre_or_without_share_add_nothing(tmp_path: Path) -> None:
    """A star beyond the fibre needs neither magnitude nor type."""
    for x in (seen(tmp_path, FAR), seen(tmp_path, "x,50,,"), seen(tmp_path, B, share=0.0)):
        np.testing.assert_array_equal(x.variance_dn2, alone().variance_dn2)
        assert x.target_share == 1.0
    said = " ".join(seen(tmp_path, FAR).messages)
    assert "none within 47.46 arcsec; 1 star beyond does not enter" in said


@pytest.mark.parametrize(
    ("head", "row", "spectrum", "statement"),
    [
        (HEAD, "a,1,9,K5V", "K5V", ""),
        (HEAD, "b,1,9,k3v", "K2.5V", ""),
        (HEAD, "c,1,9,M2V", "M1V", "of type M2V: M1V, the nearest type"),
        ("name,separation,V,teff", "d,1,9,6040", "F8V", "of 6040 K: F8V (6039 K), the nearest"),
        ("name,separation,V,bp_rp", "e,1,9,2.95", "M4V", "of BP - RP = 2.95: M4V (2.98), the nearest colour"),
        (f"{HEAD},teff", "f,1,9,A0V,3000", "A0V", ""),
    ],
)
def test_spectra_are_chosen_and_stated(tmp_path: Path, head: str, row: str, spectrum: str, statement: str) -> None:
    x = seen(tmp_path, row, head=head)
    light = alone(Source.from_library(spectrum).at_magnitude(9.0)).source_electrons
    np.testing.assert_allclose(x.neighbour_electrons, light, rtol=1e-9)
    assert any("nearest" in text for text in x.messages) == bool(statement)
    assert statement in " ".join(x.messages)


def test_star_at_the_same_place_is_pointed_out(tmp_path: Path) -> None:
    assert any("neighbours_of" in text for text in seen(tmp_path, "A,0.3,7.2,G2V").messages)
