"""Spectra from arrays and with units of astropy, and files with random damage; other files are in tests/data/corpus."""

from __future__ import annotations

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from corpus import CORPUS, FLUX, NM, cases, per, written

from mauvecl import InputError, Source

CASES = dict(cases(CORPUS / "spectrum_files.toml"))


def test_units_may_be_those_of_astropy(tmp_path: Path) -> None:
    path = written(
        CASES["spectrum_files assumed units txt"] | {"columns": {"w": "10 * nm", "f": "flux / 100"}}, tmp_path
    )
    star = Source.read(path, wavelength_unit=u.AA, flux_unit=u.W / u.m**2 / u.nm)
    np.testing.assert_allclose(star.wavelength_nm, NM, rtol=1e-9)
    np.testing.assert_allclose(star.flux_flam, FLUX, rtol=1e-9)


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_frequencies_of_arrays_may_rise_or_fall(order: slice) -> None:
    star = Source.from_arrays((NM * u.nm).to(u.Hz, u.spectral())[order], (per("Jy") * u.Jy)[order])
    np.testing.assert_allclose(star.wavelength_nm, NM, rtol=1e-12)
    np.testing.assert_allclose(star.flux_flam, FLUX, rtol=1e-9)


@pytest.mark.parametrize(
    "name", ["FITS table plain fits", "FITS image linear fits", "FITS table start and step fits",
             "content instead of a name text txt", "content instead of a name fits.gz"]
)  # fmt: skip
def test_damaged_files_raise_or_are_read(name: str, tmp_path: Path) -> None:
    """Change random bytes of whole files with a fixed seed; only InputError may be raised."""
    rng = np.random.default_rng(14)
    path = written(CASES[f"spectrum_files {name}"], tmp_path)
    content = path.read_bytes()
    for _ in range(60):
        damaged = bytearray(content)
        # Headers stand at the front.
        for place in rng.integers(0, min(len(damaged), 6000), 6):
            damaged[place] = rng.integers(32, 127)
        path.write_bytes(bytes(damaged))
        try:
            Source.read(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
