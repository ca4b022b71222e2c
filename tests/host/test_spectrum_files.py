"""Spectra of arrays and of tables at random, and of surveys; named cases are in tests/data/corpus.

A file is read right or refused in one sentence.
"""

import re
import warnings
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from corpus import CORPUS, FLUX, NM, cases, curve, per, written
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused

from mauvecl import InputError, Instrument, Source, expect

CASES = dict(cases(CORPUS / "surveys.toml")) | dict(cases(CORPUS / "spectrum_files.toml"))
ANGSTROM, ERRORS = 10 * NM, 0.03 * FLUX


def text(columns: dict[str, Any], mark: str = ",", head: str | None = None) -> str:
    rows = "\n".join(mark.join(f"{value:.12g}" for value in row) for row in zip(*columns.values(), strict=True))
    return f"{mark.join(columns) if head is None else head}\n{rows}\n"


def read(tmp_path: Path, content: str) -> Source:
    path = tmp_path / "star.dat"
    path.write_text(content)
    return Source.read(path)


def is_right(star: Source) -> bool:
    return (
        star.wavelength_nm.size == NM.size
        and np.allclose(star.wavelength_nm, NM, rtol=1e-8, atol=0)
        and np.allclose(star.flux_flam, FLUX, rtol=1e-6, atol=0)
    )


def test_units_may_be_those_of_astropy(tmp_path: Path) -> None:
    path = written(
        CASES["spectrum_files assumed units txt"] | {"columns": {"w": "10 * nm", "f": "flux / 100"}}, tmp_path
    )
    assert is_right(Source.read(path, wavelength_unit=u.AA, flux_unit=u.W / u.m**2 / u.nm))


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_frequencies_of_arrays_may_rise_or_fall(order: slice) -> None:
    assert is_right(Source.from_arrays((NM * u.nm).to(u.Hz, u.spectral())[order], (per("Jy") * u.Jy)[order]))


@pytest.mark.parametrize("form", ["image of DR1-DR7, with relative fluxes in the first of five rows", "table of DR8"])
def test_relative_fluxes_of_lamost_need_a_magnitude(form: str, tmp_path: Path) -> None:
    star = Source.read(written(CASES[f"surveys LAMOST {form} fits"], tmp_path), extend="K5V")
    measured = (star.wavelength_nm > 371) & (star.wavelength_nm < 700)
    wanted = 1e15 * curve(10 * star.wavelength_nm[measured])
    np.testing.assert_allclose(star.flux_flam[measured], wanted, rtol=1e-3)
    assert any("cover 369.999-909.913 nm, 66% of 200-700 nm" in text for text in star.messages), star.messages
    mauve = Instrument.load("mauvesim")
    with refused("magnitude", "LAMOST"):
        expect(star, mauve, exposure=5.0)
    assert expect(star.at_magnitude(8.0), mauve, exposure=5.0).signal_dn.max() > 0


def test_fibre_of_desi_is_continued(tmp_path: Path) -> None:
    path = written(CASES["surveys DESI fibres and arms 39627652591521181 + np.arange(3) fits"], tmp_path)
    assert any("continued by K5V" in text for text in Source.read(f"{path}[row 1]", extend="K5V").messages)


def test_calspec_saved_by_astropy_as_ecsv(tmp_path: Path) -> None:
    path = Path(__file__).parents[1] / "data" / "spectra" / "18sco_stis_004.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        Table.read(path, hdu=1).write(tmp_path / "star.ecsv", format="ascii.ecsv")
    star, whole = Source.read(tmp_path / "star.ecsv"), Source.read(path)
    np.testing.assert_allclose(star.flux_flam, whole.flux_flam, rtol=1e-6)
    np.testing.assert_allclose(star.wavelength_nm, whole.wavelength_nm, rtol=1e-12)


#: Columns that are not taken for the flux.
NOT_FLUX = [case["head"].split(",")[0] for name, case in CASES.items() if " a column that is no flux " in name]
WAVES = {
    "nm": NM,
    "Wavelength (nm)": NM,
    "wave[Angstrom]": ANGSTROM,
    "lambda_A": ANGSTROM,
    "log10(wave/AA)": np.log10(ANGSTROM),
    "freq_Hz": (NM * u.nm).to_value(u.Hz, u.spectral()),
    "wavenumber (cm-1)": 1e7 / NM,
    "wavelength in microns": NM / 1000,
}
FLUXES = {
    "flux_flam": FLUX,
    "flux(erg/s/cm2/A)": FLUX,
    "Flux [W/m2/nm]": FLUX / 100,
    "Flam": FLUX,
    "flux": FLUX,
    "log10(flux) (erg/s/cm2/A)": np.log10(FLUX),
    "lamFlam (erg/s/cm2)": FLUX * ANGSTROM,
    "log_flux": np.log10(FLUX),
    "fnu_jy": per("Jy"),
    "F_lambda": FLUX,
}
EXTRAS = [*NOT_FLUX, "wave_lo", "wave_hi", "flux_2", "observed_flux", "model_flux", "w_max"]
AT_RANDOM = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.long
@given(
    wave=st.sampled_from(sorted(WAVES)),
    flux=st.sampled_from(sorted(FLUXES)),
    extras=st.lists(st.sampled_from(EXTRAS), max_size=5, unique=True),
    like_flux=st.lists(st.booleans(), min_size=5, max_size=5),
    order=st.randoms(use_true_random=False),
    mark=st.sampled_from([",", "\t", " ", ";"]),
    remark=st.booleans(),
    prose=st.sampled_from(["", "# vacuum wavelengths\n", "# fluxes and errors, in 3 columns\n", "# made in 2024\n"]),
)
@AT_RANDOM
def test_any_table_is_read_correctly_or_raises(
    tmp_path: Path, wave: str, flux: str, extras: list[str], like_flux: list[bool], order: Any, mark: str, remark: bool,
    prose: str,
) -> None:  # fmt: skip
    columns = [(wave, WAVES[wave]), (flux, FLUXES[flux])]
    columns += [
        (name, 0.3 * (k + 1) * FLUX if one else NM + 3.0 * (k + 1))
        for k, (name, one) in enumerate(zip(extras, like_flux, strict=False))
    ]
    order.shuffle(columns)
    head = prose + ("# " if remark else "") + mark.join(name for name, _ in columns)
    try:
        star = read(tmp_path, text(dict(columns), mark, head))
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017
        # Without another column of light there is nothing to ask.
        assert {"flux_2", "observed_flux", "model_flux", "w_max", "wave_lo", "wave_hi", "foo"} & set(extras), error  # noqa: PT017
    else:
        assert is_right(star), star.messages


PROSE = """vacuum wavelengths; Fluxes calibrated; sky subtracted; error estimates; wavelength flux; V = 7.3 mag; log g
S/N 100; wavelength calibration; resolution 5 nm; flux/continuum; best fit; A star; A0 V; W UMa; M dwarf
Wavelengths: vacuum; Flux: erg/s/cm2/A; Wavelength: nm; units nm, FLAM; See Smith, 2003; col1 wavelength
column 2: flux; nm flam; mean error; min max; wavelength range 170-1000 nm; HST STIS; bin width 2 nm
no errors given; flux density; AB; redshift 0.0; x y; 2 columns; distance 10 pc; counts to flux; 912 s
Teff 5777; wave, flux; Wavelength (nm) Flux (erg/s/cm2/A)"""


@pytest.mark.long
@given(
    lines=st.lists(st.sampled_from(re.split(r"; |\n", PROSE)), min_size=1, max_size=3, unique=True),
    remark=st.sampled_from(["# ", "% ", "! ", ";", ""]),
    mark=st.sampled_from([" ", "\t", ",", "  "]),
    columns=st.sampled_from([(NM, FLUX), (NM, FLUX, ERRORS)]),
)
@AT_RANDOM
def test_prose_in_a_header_changes_nothing(
    tmp_path: Path, lines: list[str], remark: str, mark: str, columns: tuple[np.ndarray, ...]
) -> None:
    """Add prose with words for wavelength, flux, errors and units; the first two columns are read, or it raises."""
    head = "\n".join(remark + line for line in lines)
    try:
        star = read(tmp_path, text({str(k): one for k, one in enumerate(columns)}, mark, head))
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert is_right(star), star.messages
