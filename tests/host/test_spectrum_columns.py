"""Choice of columns and units by name; a wrong column is never used silently.

Every case holds the same spectrum, which is not straight, so that a wrong column, unit or order shows at each point. A
file is read right or refused in one sentence.
"""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Column, Table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused

from mauvecl.host.spectra.column_roles import role_of
from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError

# Astropy warns of the usual units when it writes a VOTable.
pytestmark = pytest.mark.filterwarnings("ignore:The unit .* has been deprecated in the VOUnit standard")

FLAM = u.erg / (u.s * u.cm**2 * u.AA)
NM = np.arange(170.0, 1000.0, 2.0)
ANGSTROM = 10 * NM
FLUX = 1e-13 * (1.1 + np.sin(NM / 37.0)) * np.exp(-(((NM - 560.0) / 300.0) ** 2))
PER_HZ = u.spectral_density(NM * u.nm)
ERRORS = 0.03 * FLUX
LOW, HIGH = NM - 1.0, NM + 1.0


def text(columns: dict[str, Any], mark: str = ",", head: str | None = None) -> str:
    rows = "\n".join(mark.join(f"{value:.12g}" for value in row) for row in zip(*columns.values(), strict=True))
    return f"{mark.join(columns) if head is None else head}\n{rows}\n"


def read(tmp_path: Path, content: str | bytes, words: str = "", **options: Any) -> Source:
    path = tmp_path / "star.dat"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return Source.read(f"{path}{words}", **options)


def is_right(star: Source) -> bool:
    return (
        star.wavelength_nm.size == NM.size
        and np.allclose(star.wavelength_nm, NM, rtol=1e-8, atol=0)
        and np.allclose(star.flux_flam, FLUX, rtol=1e-6, atol=0)
    )


NOT_FLUX = [
    "error",
    "err",
    "flux_err",
    "FluxErr",
    "e_flux",
    "eflux",
    "sigma",
    "STATERROR",
    "unc",
    "uncertainty",
    "ivar",
    "stdev",
    "flux_error_low",
    "S/N",
    "snr",
    "noise",
    "weight",
    "wave_err",
    "dlambda",
    "bin_width",
    "fwhm",
    "resolution",
    "quality",
    "DATAQUAL",
    "dq",
    "flag",
    "and_mask",
    "continuum",
    "flux_cont",
    "counts",
    "net",
    "gross_counts",
    "sky",
    "BACKGROUND",
    "bgflux",
    "flux_sky",
    "transmission",
    "throughput",
    "model",
    "template",
    "flux_upper",
    "mag",
    "L_lambda",
    "foo",
    "NPOINTS",
    "airmass",
    "normalization",
]


@pytest.mark.parametrize("extra", NOT_FLUX)
def test_flux_column_is_never_confused_with_another(tmp_path: Path, extra: str) -> None:
    """Place another column between wavelength and flux, where a reader that drops unknown names would take it."""
    assert is_right(read(tmp_path, text({"nm": NM, extra: ERRORS, "flux": FLUX})))
    units = {"wavelength": (NM, "nm"), extra: (ERRORS, None), "flux": (FLUX, "FLAM")}
    made = [fits.Column(name, "D", array=values, unit=unit) for name, (values, unit) in units.items()]
    out = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(made)]).writeto(out)
    assert is_right(read(tmp_path, out.getvalue()))


RIGHT = {
    "bin edges": text({"wave_lo(nm)": LOW, "wave_hi(nm)": HIGH, "flux(erg/s/cm2/A)": FLUX}),
    "bin edges, other names": text({"w_min": LOW, "w_max": HIGH, "flux": FLUX}),
    "bins": text({"bin_left_nm": LOW, "bin_right_nm": HIGH, "flux": FLUX}),
    "edges beside a wavelength": text({"w_min": LOW, "w_max": HIGH, "wavelength": NM, "flux": FLUX}),
    "flux and model": text({"flux": FLUX, "model": 2 * FLUX, "wavelength": NM}),
    "flux and model flux": text({"model_flux": 2 * FLUX, "flux": FLUX, "wavelength": NM}),
    "a model alone": text({"wavelength": NM, "model": FLUX}),
    "vacuum and air": text({"wave_air": NM - 0.1, "wave_vac": NM, "flux": FLUX}),
    "one known name of two": text({"lambda_A": ANGSTROM, "Fstar": FLUX}),
    "the flux first, by a name of one's own": text({"Fstar": FLUX, "wave_um": NM / 1000}),
    "units under types": text(
        {"w": NM / 1000, "f": 1e15 * FLUX}, " ", "|wave |flux |\n|double|double|\n|microns|10^-15*erg/s/cm2/A|"
    ),
    "a remark of two words": text({"w": NM, "f": FLUX}, " ", "# vacuum wavelengths"),
    "remarks": text({"w": NM, "f": FLUX}, " ", "# flux calibrated\n# stellar wavelengths\n# wavelengths and fluxes"),
    "flux first": text({"f": FLUX, "w": NM}, " ", "# flux wavelength"),
    "remark with names": text({"w": NM, "e": ERRORS, "f": FLUX}, " ", "# for wavelengths see below\n# wave err flux"),
    "units for names": text({"e": ERRORS, "f": FLUX, "w": ANGSTROM}, " ", "# error  FLAM  Angstrom"),
    "two words to a name": text({"w": ANGSTROM, "f": FLUX}, " ", "# Wavelength (A)  Flux density (erg/s/cm2/A)"),
    "unit with blanks": text({"w": NM, "e": ERRORS, "f": FLUX}, " ", "# wave (nm) err flux [erg / (s cm2 Angstrom)]"),
    "numbered": text(
        {"w": NM, "e": ERRORS, "f": FLUX}, " ", "# column 1: wavelength (nm)\n# column 2: error\n# column 3: flux"
    ),
    "numbered, as SExtractor": text(
        {"e": ERRORS, "f": FLUX, "w": NM}, " ", "#  1 ERR\n#  2 FLUX\n#  3 WAVELENGTH [nm]"
    ),
    "units under names": text(
        {"error": ERRORS, "wave": ANGSTROM, "flux": FLUX}, "\t", "error\twave\tflux\nFLAM\tA\tFLAM\n-----\t-----\t-----"
    ),
    "short line of names": text({"w": NM, "f": FLUX, "e": ERRORS}, " ", "# wavelength flux"),
    "preamble": text({"w": ANGSTROM, "f": FLUX}, "\t", "\t912 s\nA\terg/s/cm2/A"),
    "pipes": text(
        {"w": NM, "e": ERRORS, "f": FLUX}, " ", "|wave |sigma |flux |\n|double|double|double|\n|nm|FLAM|FLAM|"
    ),
    "quoted": text({"w": NM, "e": ERRORS, "f": FLUX}, ",", '"Wavelength (nm)","Error","Flux (erg/s/cm^2/A)"'),
    "a data frame with its index": text({"": np.arange(NM.size), "wavelength": NM, "error": ERRORS, "flux": FLUX}),
    "the same with tabs": text({"": np.arange(NM.size), "wavelength": NM, "flux": FLUX}, "\t"),
    "log flux": text({"nm": NM, "log_flux": np.log10(FLUX)}),
    "log10(F)": text({"nm": NM, "log10(F)": np.log10(FLUX)}),
    "logflam": text({"nm": NM, "error": ERRORS, "logflam": np.log10(FLUX)}),
    "ln": text({"nm": NM, "ln_flux": np.log(FLUX)}),
    "log of both": text({"log10(wave/AA)": np.log10(ANGSTROM), "log(flux) (erg/s/cm2/A)": np.log10(FLUX)}),
    "loglam": text({"flux": FLUX, "loglam": np.log10(ANGSTROM), "ivar": ERRORS}),
    "log unit under the name": text({"w": NM, "flux": np.log10(FLUX)}, ",", "wave,flux\nnm,log(erg/s/cm2/A)"),
    "lambda F_lambda": text({"nm": NM, "lamFlam (erg/s/cm2)": FLUX * ANGSTROM}),
    "nu F_nu": text({"nm": NM, "nuFnu [W/m2]": FLUX * ANGSTROM * 1e-3}),
    "wFw": text({"nm": NM, "wFw": FLUX * ANGSTROM}, ",", "nm,wFw\nnm,erg/s/cm2"),
    "AB magnitudes": text({"nm": NM, "ABmag": (FLUX * FLAM).to_value(u.ABmag, PER_HZ)}),
    "AB magnitudes in words": text({"nm": NM, "AB magnitude": (FLUX * FLAM).to_value(u.ABmag, PER_HZ)}),
    "ST magnitudes": text({"nm": NM, "m_ST": (FLUX * FLAM).to_value(u.STmag)}),
    "nanomaggies": text({"nm": NM, "flux": (FLUX * FLAM).to_value(u.AB, PER_HZ) * 1e9}, ",", "nm,flux\nnm,nanomaggies"),
    "wavenumbers": text({"w": 1e7 / NM, "f": FLUX}, " ", "# wavenumber in cm-1, flux in erg/s/cm2/A"),
    "millijansky": text({"nm": NM, "flux_mJy": (FLUX * FLAM).to_value(u.mJy, PER_HZ)}),
}


@pytest.mark.parametrize("case", RIGHT)
def test_columns_are_recognised(tmp_path: Path, case: str) -> None:
    star = read(tmp_path, RIGHT[case])
    assert is_right(star), star.messages


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("bin edges", "middles of bins, from wave_lo(nm) and wave_hi(nm)"),
        ("log flux", "its fluxes are logarithms (log_flux), raised to powers of ten"),
        ("ln", "its fluxes are logarithms (ln_flux), raised to powers of e"),
        ("loglam", "its wavelengths are logarithms (loglam), raised to powers of ten"),
        ("AB magnitudes", "its magnitudes (mag(AB)) are converted to fluxes"),
        ("short line of names", "ASSUMED: wavelength in nm"),
    ],
)
def test_conversions_are_reported(tmp_path: Path, case: str, message: str) -> None:
    assert any(message in reported for reported in read(tmp_path, RIGHT[case]).messages)


ONE, TWO = FLUX, 2 * FLUX
REFUSED = {
    "model and observed": (
        text({"wavelength": NM, "model_flux": ONE, "observed_flux": TWO}),
        ("columns", "2", "model_flux", "observed_flux"),
    ),
    "two fluxes": (text({"nm": NM, "flux_1": ONE, "flux_2": TWO}), ("columns", "flux_1", "flux_2")),
    "flam and fnu": (text({"nm": NM, "f_lambda": ONE, "f_nu": TWO}), ("columns", "f_lambda", "f_nu")),
    "rest and observed": (text({"wave_rest": NM, "wave_obs": NM + 1, "flux": ONE}), ("columns",)),
    "parts by unknown names": (text({"nm": NM, "star": ONE, "spot": TWO}), ("columns",)),
    "errors alone": (text({"nm": NM, "error": ONE}), ("columns", "error")),
    "counts": (text({"nm": NM, "counts": ONE}), ("columns", "counts")),
    "a light curve": (
        text({"": np.arange(NM.size), "t0": NM, "t1": NM, "cps": ONE, "flux": ONE}),
        ("columns", "1", "t0", "t1"),
    ),
    "one edge": (text({"wave_lo": LOW, "flux": ONE}), ("columns",)),
    "edges in two units": (text({"wave_lo_nm": LOW, "wave_hi_A": 10 * HIGH, "flux": ONE}), ("wavelength_unit",)),
    "unknown names": (text({"a": NM, "b": ONE, "c": TWO}), ("columns",)),
    "names for other columns": (text({"i": NM, "w": NM, "f": ONE}, " ", "wavelength flux"), ("columns", "2")),
    "more names than columns": (text({"f": ONE, "w": NM}, " ", "# Total flux Rest wavelength"), ("columns", "4")),
    "log of nothing": (text({"nm": NM, "log_flux": ONE}), ("log_flux",)),
    "log wavelengths that are none": (text({"loglam": ANGSTROM, "flux": ONE}), ("loglam", "1700")),
    "energy per area": (text({"nm": NM, "flux": ONE}, ",", "nm,flux\nnm,W/m2"), ("flux_unit",)),
    "erg per area": (text({"w": NM, "f": ONE}, " ", "# wavelength (nm), flux (erg/s/cm2)"), ("flux_unit",)),
    "name and unit disagree": (
        text({"nm": NM, "lamFlam": ONE}, ",", "nm,lamFlam\nnm,W/m2/nm"),
        ("flux_unit",),
    ),
    "per steradian": (text({"w": NM, "f": ONE}, " ", "# nm  W/m2/nm/sr"), ("flux_unit",)),
    "per steradian in words": (
        text({"w": NM, "f": ONE}, " ", "# wave in nm\n# flux in W m-2 nm-1 sr-1"),
        ("flux_unit",),
    ),
    "per square arcsecond": (text({"nm": NM, "flux(erg/s/cm2/A/arcsec2)": ONE}), ("flux_unit",)),
    "luminosity": (text({"nm": NM, "flux": ONE}, ",", "nm,flux\nnm,erg/s/A"), ("flux_unit",)),
    "a factor alone": (text({"nm": NM, "flux (10^-15)": ONE}), ("flux_unit",)),
    "an unknown unit": (text({"nm": NM, "flux (cgs/2)": ONE}), ("unit", "'cgs/2'")),
    "parsec": (
        text({"w": NM, "f": ONE}, " ", "# wavelength (parsec), flux (FLAM)"),
        ("wavelength", "1"),
    ),
    "furlongs": (
        text({"w": NM, "f": ONE}, " ", "# wavelengths in furlongs\n# flux in FLAM"),
        ("unit", "'furlongs'"),
    ),
    "seconds": (text({"w": NM, "f": ONE}, ",", "wave (s),flux"), ("wavelength_unit",)),
    "magnitudes": (text({"nm": NM, "mag": 12.5 + 0 * FLUX}), ("columns",)),
    "throughput": (text({"nm": NM, "throughput": FLUX / FLUX.max()}), ("columns", "throughput")),
    "filter": (
        text({"w": NM, "f": FLUX / FLUX.max()}, " ", "# Bessell V passband"),
        ("flux_unit", "'passband'"),
    ),
    "transmission for a title": (text({"w": NM, "f": FLUX / FLUX.max()}, " ", "# total transmission"), ("flux_unit",)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_ambiguous_tables_raise(tmp_path: Path, case: str) -> None:
    content, sentence = REFUSED[case]
    with refused(*sentence) as caught:
        read(tmp_path, content)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_column_is_chosen_by_its_name(tmp_path: Path) -> None:
    content = text({"wave_rest": NM + 5, "wave_obs": NM, "model_flux": TWO, "observed_flux": ONE})
    assert is_right(read(tmp_path, content, "[wave_obs,observed_flux]"))
    assert is_right(read(tmp_path, text({"nm": NM, "model": ONE, "flux": TWO}), "[model]"))
    nameless = text({"a": TWO, "b": ONE, "c": NM}, " ", "# no names")
    assert is_right(read(tmp_path, nameless, "[3,2]"))
    with refused("columns", "'banana'"):
        read(tmp_path, text({"nm": NM, "model": ONE, "flux": TWO}), "[banana]")


def test_arguments_override_the_file(tmp_path: Path) -> None:
    per_nm = FLUX / 100
    assert is_right(read(tmp_path, text({"nm": NM, "flux (W/m2)": per_nm}), flux_unit="W m-2 nm-1"))
    magnitudes = text({"nm": NM, "flux": (FLUX * FLAM).to_value(u.ABmag, PER_HZ)})
    with refused("flux_unit"):
        read(tmp_path, magnitudes)
    assert is_right(read(tmp_path, magnitudes, flux_unit="ABmag"))
    assert is_right(read(tmp_path, text({"nm": NM, "log_flux": np.log10(per_nm)}), flux_unit="W m-2 nm-1"))


@pytest.mark.parametrize("values", [np.ones(NM.size, bool), FLUX * (1 + 1j)], ids=["boolean", "complex"])
@pytest.mark.parametrize("form", ["fits", "votable", "ascii.ecsv"])
def test_complex_and_boolean_columns_raise(tmp_path: Path, values: Any, form: str) -> None:
    made = Table({"wavelength": Column(NM, unit="nm"), "flux": Column(values, unit=FLAM)})
    made.write(tmp_path / "star.dat", format=form)
    with refused("flux"):
        Source.read(tmp_path / "star.dat")


UNITS = {
    "calspec": ("ANGSTROMS", "FLAM", ANGSTROM, FLUX),
    "words": ("microns", "ergs/s/cm**2/A", NM / 1000, FLUX),
    "angstroem": ("Angstroem", "erg cm-2 s-1 A-1", ANGSTROM, FLUX),
    "sdss": ("Angstroms", "1E-17 erg/cm^2/s/Ang", ANGSTROM, 1e17 * FLUX),
    "desi": ("Angstrom", "10**-17 erg/(s cm2 Angstrom)", ANGSTROM, 1e17 * FLUX),
    "eso": ("nm", "10**(-16)erg.cm**(-2).s**(-1).angstrom**(-1)", NM, 1e16 * FLUX),
    "calcos": ("angstrom", "erg /s /cm**2 /angstrom", ANGSTROM, FLUX),
    "vizier": ("0.1nm", "10-17W/m2/nm", ANGSTROM, 1e15 * FLUX),
    "ampere is none": ("A", "erg/s/cm2/A", ANGSTROM, FLUX),
    "dex": ("dex(Angstrom)", "dex(erg/s/cm2/A)", np.log10(ANGSTROM), np.log10(FLUX)),
    "AB": ("nm", "ABmag", NM, (FLUX * FLAM).to_value(u.ABmag, PER_HZ)),
    "mag(AB)": ("nm", "mag(AB)", NM, (FLUX * FLAM).to_value(u.ABmag, PER_HZ)),
    "photons": ("nm", "PHOTLAM", NM, (FLUX * FLAM).to_value(u.photon / u.s / u.cm**2 / u.AA, PER_HZ)),
}


@pytest.mark.parametrize("form", ["ecsv", "fits", "text", "name"])
@pytest.mark.parametrize("case", UNITS)
def test_units_are_normalised_alike_in_all_formats(tmp_path: Path, case: str, form: str) -> None:
    """Include spellings that astropy refuses, such as FLAM, and A, which it reads as ampere."""
    length, density, wavelength, flux = UNITS[case]
    if form == "ecsv":
        head = "".join(
            f"# - {{name: {name}, unit: '{unit}', datatype: float64}}\n"
            for name, unit in (("wavelength", length), ("flux", density))
        )
        content = f"# %ECSV 1.0\n# ---\n# datatype:\n{head}# schema: astropy-2.0\n" + text(
            {"wavelength": wavelength, "flux": flux}, " "
        )
    elif form == "fits":
        out = io.BytesIO()
        columns = [fits.Column("wavelength", "D", array=wavelength), fits.Column("flux", "D", array=flux)]
        table = fits.BinTableHDU.from_columns(columns)
        # As written by others: astropy would warn, and change some.
        table.header["TUNIT1"], table.header["TUNIT2"] = length, density
        fits.HDUList([fits.PrimaryHDU(), table]).writeto(out)
        content = out.getvalue()  # type: ignore[assignment]
    elif form == "text":
        content = text({"wavelength": wavelength, "flux": flux}, ",", f"wavelength,flux\n{length},{density}")
    else:
        content = text({f"wavelength [{length}]": wavelength, f"flux [{density}]": flux})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert is_right(read(tmp_path, content))


def test_calspec_saved_by_astropy_as_ecsv(tmp_path: Path) -> None:
    path = Path(__file__).parents[1] / "data" / "spectra" / "18sco_stis_004.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        Table.read(path, hdu=1).write(tmp_path / "star.ecsv", format="ascii.ecsv")
    star, whole = Source.read(tmp_path / "star.ecsv"), Source.read(path)
    np.testing.assert_allclose(star.flux_flam, whole.flux_flam, rtol=1e-6)
    np.testing.assert_allclose(star.wavelength_nm, whole.wavelength_nm, rtol=1e-12)


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
    "fnu_jy": (FLUX * FLAM).to_value(u.Jy, PER_HZ),
    "F_lambda": FLUX,
}


@pytest.mark.long
@given(
    wave=st.sampled_from(sorted(WAVES)),
    flux=st.sampled_from(sorted(FLUXES)),
    extras=st.lists(
        st.sampled_from([*NOT_FLUX, "wave_lo", "wave_hi", "flux_2", "observed_flux", "model_flux", "w_max"]),
        max_size=5,
        unique=True,
    ),
    like_flux=st.lists(st.booleans(), min_size=5, max_size=5),
    order=st.randoms(use_true_random=False),
    mark=st.sampled_from([",", "\t", " ", ";"]),
    remark=st.booleans(),
    prose=st.sampled_from(["", "# vacuum wavelengths\n", "# fluxes and errors, in 3 columns\n", "# made in 2024\n"]),
)
@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_table_is_read_correctly_or_raises(
    tmp_path: Path,
    wave: str,
    flux: str,
    extras: list[str],
    like_flux: list[bool],
    order: Any,
    mark: str,
    remark: bool,
    prose: str,
) -> None:
    """Read tables of random columns in random order; each gives the spectrum or an InputError."""
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
@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
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


def test_column_names_are_recognised_in_any_style() -> None:
    for kind, names in {
        "wavelength": "wavelength WAVE lambda λ wl_nm Wavelength[um] log_wave loglam frequency awav energy_keV",
        "flux": "flux FLUX F_lambda fλ flam nuFnu Flux_Density spectralFluxDensity sflux irradiance logflux ABmag",
        "error": "err FluxErr e_Flux SIGMA_FLUX ivar invvar flux_unc dflux STATERROR stdev sys_err flux_min variance",
        "lower edge": "wave_lo WMIN lambda_left bin_start",
        "upper edge": "wave_hi w_max wavelength_end",
        "quality": "flag DQ and_mask DATAQUAL",
        "counts": "counts NET gross_counts ADU",
        "background": "sky bkg_flux BGFLUX",
        "throughput": "transmission qe Efficiency",
        "continuum": "cont flux_continuum",
        "model": "model bestfit",
    }.items():
        for name in names.split():
            assert role_of(name).kind == kind, name
