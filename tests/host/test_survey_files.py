"""Relative fluxes of surveys, fibres that a star continues, and checksums; other files are in tests/data/corpus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from corpus import CORPUS, cases, curve, written
from refusals import refused

from mauvecl import Instrument, Source, expect

CASES = dict(cases(CORPUS / "surveys.toml")) | dict(cases(CORPUS / "spectrum_files.toml"))


@pytest.mark.parametrize(
    "form", ["image of DR1-DR7, with relative fluxes in the first of five rows", "table of DR8"]
)  # fmt: skip
def test_relative_fluxes_of_lamost_need_a_magnitude(form: str, tmp_path: Path) -> None:
    star = Source.read(written(CASES[f"surveys LAMOST {form} fits"], tmp_path), extend="K5V")
    measured = (star.wavelength_nm > 371) & (star.wavelength_nm < 700)
    wanted = 1e15 * curve(10 * star.wavelength_nm[measured])
    np.testing.assert_allclose(star.flux_flam[measured], wanted, rtol=1e-3)
    assert any("cover 369.999-909.913 nm, 66% of 200-700 nm" in text for text in star.messages), star.messages
    mauve = Instrument.load("mauve")
    with refused("magnitude", "LAMOST"):
        expect(star, mauve, exposure=5.0)
    assert expect(star.at_magnitude(8.0), mauve, exposure=5.0).signal_dn.max() > 0


def test_fibre_of_desi_is_continued(tmp_path: Path) -> None:
    path = written(CASES["surveys DESI fibres and arms 39627652591521181 + np.arange(3) fits"], tmp_path)
    assert any("continued by K5V" in text for text in Source.read(f"{path}[row 1]", extend="K5V").messages)


def test_checksums_are_verified(tmp_path: Path) -> None:
    """Damage each byte of a file with DATASUM and CHECKSUM; files without them are read as before."""
    path = written(CASES["spectrum_files FITS table plain fits"] | {"checksum": True}, tmp_path)
    whole = path.read_bytes()
    digest = Source.read(path).digest
    with fits.open(path) as hdus:
        start = hdus[1].fileinfo()["datLoc"]
        header = hdus[1].fileinfo()["hdrLoc"]
    for place, key in ((start + 8 * 2 * 100 + 13, "DATASUM"), (whole.index(b"FLAM", header), "CHECKSUM")):
        damaged = bytearray(whole)
        damaged[place] ^= 1
        path.write_bytes(bytes(damaged))
        with refused(key, value=1):
            Source.read(path)
    without = bytearray(whole)
    for key in (b"CHECKSUM=", b"DATASUM ="):
        at = without.index(key, header)
        without[at : at + 80] = b"COMMENT".ljust(80)
    path.write_bytes(bytes(without))
    assert Source.read(path).digest == digest
