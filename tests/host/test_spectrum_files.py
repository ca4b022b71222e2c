"""The same spectrum in every form of file is read alike or refused."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits, votable
from astropy.table import Column, MaskedColumn, Table
from refusals import refused

from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError

# Astropy warns of the usual units when it writes a VOTable.
pytestmark = pytest.mark.filterwarnings("ignore:The unit .* has been deprecated in the VOUnit standard")

FLAM = u.erg / (u.s * u.cm**2 * u.AA)
#: Two nm apart; not straight, so that a wrong order, unit or shift shows at each point.
NM = np.arange(170.0, 1000.0, 2.0)
FLUX = 1e-13 * (1.1 + np.sin(NM / 37.0)) * np.exp(-(((NM - 560.0) / 300.0) ** 2))


def alike(path: Path | str, rtol: float = 1e-9, reported: str | None = None, **options: Any) -> Source:
    star = Source.read(path, **options)
    np.testing.assert_allclose(star.wavelength_nm, NM, rtol=rtol)
    np.testing.assert_allclose(star.flux_flam, FLUX, rtol=rtol)
    assert reported is None or any(reported in text for text in star.messages), star.messages
    return star


def lines(*columns: np.ndarray, mark: str = " ", head: str = "") -> str:
    return head + "\n".join(mark.join(f"{value:.12g}" for value in row) for row in zip(*columns, strict=True)) + "\n"


def table(
    names: tuple[str, ...] = ("WAVELENGTH", "FLUX"),
    columns: tuple[Any, ...] = (10 * NM, FLUX),
    units: tuple[str | None, ...] = ("ANGSTROMS", "FLAM"),
    formats: tuple[str, ...] | None = None,
    header: dict[str, Any] | None = None,
) -> bytes:
    import io

    made = [
        fits.Column(name, form, array=values, unit=unit)
        for name, values, unit, form in zip(names, columns, units, formats or ("D",) * len(names), strict=True)
    ]
    out = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(header=fits.Header(header or {})), fits.BinTableHDU.from_columns(made)]).writeto(out)
    return out.getvalue()


def image(flux: np.ndarray, **cards: Any) -> bytes:
    import io

    out = io.BytesIO()
    header = fits.Header({key.replace("_", "-") if key != "CD1_1" else key: value for key, value in cards.items()})
    fits.PrimaryHDU(flux, header=header).writeto(out)
    return out.getvalue()


PLAIN = lines(10 * NM, FLUX, head="# wavelength (Angstrom) flux (erg/s/cm2/A)\n")
PER_NM = (FLUX * FLAM).to_value(u.W / u.m**2 / u.nm)
JANSKY = (FLUX * FLAM).to_value(u.Jy, u.spectral_density(NM * u.nm))
MICRON = NM / 1000


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        lines(NM, FLUX, head="wavelength_nm,flux_flam\n", mark=","),
        lines(FLUX, 10 * NM, head="flux wave\nerg/s/cm2/A Angstrom\n"),
        lines(NM, PER_NM, head="# wave [nm], flux [W m-2 nm-1]\n"),
        lines(NM, 10 * FLUX, head="# lambda(nm) flux(erg s-1 cm-2 nm-1)\n"),
        lines(MICRON, JANSKY, head="% Wavelength in microns, flux density in Jy\n"),
        lines(10 * NM, 1e15 * FLUX, head="# Wavelength (Å)  Flux (10⁻¹⁵ erg/s/cm²/Å)\n"),
        lines(10 * NM, 1e17 * FLUX, head="! wave(A) flux(10^-17 erg/cm^2/s/A)\n"),
        lines(10 * NM, FLUX, 0.1 * FLUX, head="WAVELENGTH\tFLUX\tERROR\nA\tFLAM\tFLAM\n--\t--\t--\n", mark="\t"),
        lines(10 * NM, 0 * NM, FLUX, head="Wavelength [Angstrom],Error [x],Flux [erg/s/cm^2/A]\n", mark=","),
        lines(np.log10(10 * NM), FLUX, head="# loglam flux\n# units: Angstrom, FLAM\n"),
        lines(10 * NM[::-1], FLUX[::-1], head="# Units: Angstroms(A) and erg/s/cm**2/A\n"),
        lines(np.repeat(NM, 2), np.repeat(FLUX, 2), head="#nm erg/s/cm2/A\n"),
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("e-1", "D-1"),
        lines(10 * NM, FLUX, head="wavelength (A);flux (erg/s/cm2/A)\n", mark=";").replace(".", ","),
        lines(10 * NM + 0.0, FLUX, head="wave (A)\tflux (FLAM)\n", mark="\t").replace(".", ","),
    ],
)
def test_text_with_its_units(tmp_path: Path, text: str) -> None:
    (tmp_path / "star").write_text(text, encoding="utf-8")
    star = alike(tmp_path / "star", rtol=1e-8)
    assert not any("ASSUMED" in one for one in star.messages)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress, bytes])
@pytest.mark.parametrize("content", [PLAIN.encode(), table(), b"\xef\xbb\xbf" + PLAIN.encode(), PLAIN.encode("utf-16")])
@pytest.mark.parametrize("name", ["star.txt", "star.fits", "star"])
def test_format_follows_content_not_file_name(
    tmp_path: Path, pack: Callable[[bytes], bytes], content: bytes, name: str
) -> None:
    (tmp_path / name).write_bytes(pack(content))
    alike(tmp_path / name)


WAVENUMBER2 = (1000 / NM) ** 2
FROM_AIR = 10 * NM / (1 + 8.34254e-5 + 2.406147e-2 / (130 - WAVENUMBER2) + 1.5998e-4 / (38.9 - WAVENUMBER2))


def short_rows(values: np.ndarray) -> np.ndarray:
    return np.array([values])


FITS = {
    "swapped": table(("FLUX", "WAVELENGTH"), (FLUX, 10 * NM), ("FLAM", "ANGSTROMS")),
    "single precision": table(formats=("E", "E")),
    "ascii names": table(("Wave ", "Flam"), units=("nm", "erg/s/cm2/A"), columns=(NM, FLUX)),
    "units of others": table(
        ("WAVELENGTH", "FLUX", "DATAQUAL", "TOTEXP", "NET", "MJD"),
        (10 * NM, FLUX, *[np.ones(NM.size)] * 4),
        ("ANGSTROMS", "FLAM", "NONE", "SEC", "Counts/s", "mjd"),
    ),
    "frequency": table(
        ("FREQUENCY", "FLUX"), ((NM * u.nm).to_value(u.Hz, u.spectral()), JANSKY), ("HZ", "JY")
    ),
    "one row": table(columns=(short_rows(10 * NM), short_rows(FLUX)), formats=(f"{NM.size}D",) * 2),
    "variable length": table(
        columns=(np.array([10 * NM, None], object)[:1], np.array([FLUX, None], object)[:1]), formats=("PD()", "PD()")
    ),
    "start and step": table(
        ("WAVELENGTH", "DELTAW", "NPOINTS", "FLUX"),
        ([1700.0], [20.0], [NM.size], short_rows(np.append(FLUX, [0.0, 0.0]))),
        ("ANGSTROM", "ANGSTROM", None, "ERG/CM2/S/A"),
        ("D", "D", "J", f"{NM.size + 2}D"),
    ),
    "sdss": table(("flux", "loglam"), (1e17 * FLUX, np.log10(10 * NM)), (None, None), header={
        "BUNIT": "1E-17 erg/cm^2/s/Ang"}),
    "no rows of nothing": table(columns=(np.append(10 * NM, np.nan), np.append(FLUX, np.nan))),
    "linear image": image(FLUX, CRVAL1=1700.0, CDELT1=20.0, CUNIT1="Angstrom", BUNIT="erg/s/cm2/A"),
    "image of one row": image(FLUX[None, :], CRVAL1=170.0, CD1_1=2.0, CRPIX1=1.0, CUNIT1="nm", BUNIT="FLAM",
                              CTYPE1="WAVE"),
    "later reference": image(FLUX, CRVAL1=1720.0, CDELT1=20.0, CRPIX1=2.0, CUNIT1="Angstrom", BUNIT="FLAM"),
}  # fmt: skip


@pytest.mark.parametrize("form", FITS)
def test_fits_in_many_forms(tmp_path: Path, form: str) -> None:
    (tmp_path / "star.dat").write_bytes(FITS[form])
    alike(tmp_path / "star.dat", rtol=1e-6 if form == "single precision" else 1e-9)


def test_wavelengths_of_logarithmic_images_equal_those_of_astropy(tmp_path: Path) -> None:
    """Compare IRAF's DC-FLAG and CTYPE WAVE-LOG with astropy's WCS."""
    from astropy.wcs import WCS

    nm = 10 ** np.linspace(2.2, 3.0, 500)
    flux = 1e-13 * nm / 500
    step = 0.8 / 499
    (tmp_path / "iraf.fits").write_bytes(
        image(flux, CRVAL1=3.2, CD1_1=step, DC_FLAG=1, BUNIT="FLAM", CUNIT1="Angstrom")
    )
    star = Source.read(tmp_path / "iraf.fits")
    np.testing.assert_allclose(star.wavelength_nm, nm, rtol=1e-12)
    np.testing.assert_allclose(star.flux_flam, flux, rtol=1e-6)
    cards = {"CTYPE1": "WAVE-LOG", "CRVAL1": 1585.0, "CDELT1": 1585.0 * step * np.log(10), "CRPIX1": 1.0}
    (tmp_path / "wcs.fits").write_bytes(image(flux, **cards, CUNIT1="Angstrom", BUNIT="FLAM"))
    with fits.open(tmp_path / "wcs.fits") as hdus:
        metres = WCS(hdus[0].header).all_pix2world(np.arange(500), 0)[0]
    np.testing.assert_allclose(Source.read(tmp_path / "wcs.fits").wavelength_nm, 1e9 * metres, rtol=1e-12)


def test_air_becomes_vacuum_where_the_file_says_air(tmp_path: Path) -> None:
    """Compare with Birch & Downs 1994 as in VALD (Morton 2000, ApJS 130, 403) to 1e-7."""
    air = FROM_AIR[NM > 205]
    flux = FLUX[NM > 205]
    full = np.append(10 * NM[NM <= 205][:-1], air), np.append(FLUX[NM <= 205][:-1], flux)
    cases = {
        "a.txt": lines(*full, head="# wavelength in air (Angstrom), flux (FLAM)\n").encode(),
        "b.txt": lines(*full, head="wave_air,flux\nA,FLAM\n", mark=",").encode(),
        "c.fits": table(columns=full, header={"AIRORVAC": "air"}),
        "d.fits": table(columns=full, header={"VACUUM": False}),
        "e.fits": table(("wave_air", "flux"), full),
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        star = Source.read(tmp_path / name)
        assert any("in air, converted to vacuum" in text for text in star.messages), name
        inside = NM > 210
        np.testing.assert_allclose(star.wavelength_nm[-inside.sum() :], NM[inside], rtol=1e-7)
    alike_path = tmp_path / "v.fits"
    alike_path.write_bytes(table(header={"HISTORY": "All wavelengths are in vacuum."}))
    alike(alike_path)
    (tmp_path / "said.txt").write_text(lines(*full))
    said = Source.read(tmp_path / "said.txt", wavelength_unit="Angstrom air", flux_unit="flam")
    assert said.wavelength_nm[-1] == pytest.approx(NM[-1], rel=1e-7)
    awav = image(flux, CRVAL1=2100.0, CDELT1=20.0, CTYPE1="AWAV", CUNIT1="Angstrom", BUNIT="FLAM")
    (tmp_path / "awav.fits").write_bytes(awav)
    found = read_spectrum(tmp_path / "awav.fits")
    assert found.wavelength_nm[145] == pytest.approx(500.1394, abs=1e-4)  # 500 nm in air, by SDSS


def test_tables_that_name_their_units(tmp_path: Path) -> None:
    made = Table({"wave": (NM * u.nm).to(u.AA), "flux": FLUX * FLAM})
    made.write(tmp_path / "a.dat", format="ascii.ecsv")
    made.write(tmp_path / "b.dat", format="votable")
    votable.from_table(Table({"wave": [10 * NM] * u.AA, "flux": [FLUX] * FLAM})).to_xml(
        str(tmp_path / "c.dat"), tabledata_format="binary2"
    )
    for name in ("a.dat", "b.dat", "c.dat"):
        alike(tmp_path / name)
    (tmp_path / "d.dat").write_bytes(gzip.compress((tmp_path / "b.dat").read_bytes()))
    alike(tmp_path / "d.dat")


def test_assumed_units_are_reported(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(lines(NM, FLUX))
    assert [text.split(",")[0] for text in alike(tmp_path / "a.txt").messages] == [
        "ASSUMED: wavelength in nm",
        "ASSUMED: flux in erg / (Angstrom s cm2)",
        "its own points cover 170-998 nm",
    ]
    (tmp_path / "b.txt").write_text(lines(10 * NM, PER_NM))
    star = alike(tmp_path / "b.txt", wavelength_unit="Angstrom", flux_unit="W m-2 nm-1")
    assert star.messages == ("its own points cover 170-998 nm",)
    alike(tmp_path / "b.txt", wavelength_unit=u.AA, flux_unit=u.W / u.m**2 / u.nm)
    (tmp_path / "c.fits").write_bytes(table(units=(None, None)))
    alike(tmp_path / "c.fits", reported="ASSUMED: wavelength in Angstrom")


def test_angstrom_that_spans_the_range_as_numbers_is_not_nm(tmp_path: Path) -> None:
    """Refuse a spectrum from X-rays to the infrared without units, whose Angstrom could be taken for nm."""
    angstrom = np.geomspace(5.0, 55_000.0, 3000)
    for low, high, sentence in (
        (0.0, 1e9, ("wavelength_unit", "200-700")),
        (60.0, 9000.0, ("wavelength_unit", "200-700")),
        (60.0, 9e9, ("wavelength_unit", "`wavelength_unit='nm'`", "`wavelength_unit='Angstrom'`")),
        (1150.0, 9000.0, ("wavelength_unit", "`wavelength_unit='Angstrom'`")),
    ):
        kept = angstrom[(angstrom > low) & (angstrom < high)]
        (tmp_path / "sed.txt").write_text(lines(kept, 1e-13 + 0 * kept))
        with refused(*sentence):
            Source.read(tmp_path / "sed.txt")
        right = Source.read(tmp_path / "sed.txt", wavelength_unit="Angstrom")
        np.testing.assert_allclose(right.wavelength_nm, kept / 10, rtol=1e-9)


@pytest.mark.parametrize("extend", [None, "M3V"])
@pytest.mark.parametrize(
    ("low", "high"),
    [
        (1000, 4440),
        (1004, 4440),
        (1150, 3200),
        (1669, 399_000),
        (1199, 3348),
        (2000, 7000),
        (3000, 10_000),
        (1700, 5000),
    ],
)
def test_angstrom_without_a_unit_gets_a_single_hint(
    tmp_path: Path, low: float, high: float, extend: str | None
) -> None:
    """Check one hint for ranges such as that of the AD Leo flare, where nm would give another star's light."""
    angstrom = np.geomspace(low, high, 1500)
    (tmp_path / "flare.dat").write_text(lines(angstrom, 1e-13 + 1e-17 * angstrom))
    with refused("wavelength_unit", "`wavelength_unit='Angstrom'`") as caught:
        Source.read(tmp_path / "flare.dat", extend=extend)
    assert "`extend`" not in str(caught.value)


@pytest.mark.parametrize(("low", "high"), [(100, 250), (540, 2000), (800, 2500), (90, 190), (115, 360)])
def test_extension_needs_a_third_of_the_range(tmp_path: Path, low: float, high: float) -> None:
    nm = np.linspace(low, high, 800)
    (tmp_path / "short.txt").write_text(lines(nm, 1e-13 + 1e-15 * nm, head="# nm FLAM\n"))
    for extend in ("G2V", None):
        with refused("extend", "200-700"):
            Source.read(tmp_path / "short.txt", extend=extend)


@pytest.mark.parametrize(("low", "high", "part"), [(290, 2500, 82), (100, 444, 49), (195, 370, 34), (360, 980, 68)])
def test_measured_range_is_always_reported(tmp_path: Path, low: float, high: float, part: int) -> None:
    nm = np.linspace(low, high, 2000)
    (tmp_path / "short.txt").write_text(lines(nm, 1e-13 + 1e-15 * nm, head="# nm FLAM\n"))
    star = Source.read(tmp_path / "short.txt", extend="G2V")
    assert star.messages[0] == f"its own points cover {low:g}-{high:g} nm, {part}% of 200-700 nm"


def test_gap_is_not_measured(tmp_path: Path) -> None:
    nm = np.append(np.arange(170.0, 260.0), np.arange(650.0, 900.0))
    (tmp_path / "gap.txt").write_text(lines(nm, 1e-13 + 1e-15 * nm, head="# nm FLAM\n"))
    with refused("extend", "170-899", "22%", "200-700"):
        Source.read(tmp_path / "gap.txt")


BAD_TEXT = {
    "magnitudes": (lines(NM, 12 + FLUX), ("flux_unit",)),
    "magnitudes in words": (lines(NM, FLUX, head="# wavelength and magnitude\n"), ("flux_unit", "'magnitude'")),
    "counts": (lines(NM, FLUX, head="# wavelength in nm and counts\n"), ("flux_unit", "'counts'")),
    "two units": (lines(NM, FLUX, head="# nm or Angstrom\n# FLAM\n"), ("wavelength_unit",)),
    "two fluxes": (
        lines(NM, FLUX, FLUX, head="wave flux_1 flux_2\n"), ("columns", "2", "flux_1", "flux_2"),
    ),
    "mixed commas": (lines(NM, FLUX).replace("1.", "1,"), ("columns",)),
    "commas or columns": ("\n".join(f"{n},5,1,2e-14" for n in range(200, 800)), ("columns",)),
    "words": (lines(NM, FLUX) + "end of file\n", ("columns", "416", "'end of file'")),
    "underscores": (lines(NM, FLUX) + "1_000 2\n", ("columns", "416", "'1_000 2'")),
    "not rising": (lines(np.roll(NM, 5), FLUX), ("wavelength",)),
    "hole": (lines(NM, np.where(NM == 300, np.nan, FLUX)), ("flux", "66", "300")),
    "subnormal": (lines(NM, 0 * NM + 5e-324, head="# nm FLAM\n"), ("flux", "1e-40", "1e+30")),
    "too bright": (lines(NM, 0 * NM + 1e35, head="# nm FLAM\n"), ("flux", "1e-40", "1e+30")),
    "no light": (lines(NM, -FLUX), ("flux", "200-700")),
    "sign for none": (lines(NM, np.where(NM == 300, -999.0, FLUX)), ("flux",)),
    "html": ("<!DOCTYPE html><html>404</html>", ("file",)),
    "entities": ('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><VOTABLE/>', ("file",)),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_TEXT)
def test_unusable_text_raises(tmp_path: Path, kind: str) -> None:
    text, sentence = BAD_TEXT[kind]
    (tmp_path / "star.txt").write_text(text)
    with refused(*sentence) as caught:
        Source.read(tmp_path / "star.txt")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


WHOLE = table()
BAD_FITS = {
    "cp1252": (PLAIN.replace("Angstrom", "Å").encode("cp1252"), ("file", "UTF-8", "0xc5", "1")),
    "cut short": (WHOLE[:-2880], ("file",)),
    "many rows": (table(columns=(np.tile(10 * NM, (3, 1)), np.tile(FLUX, (3, 1))), formats=(f"{NM.size}D",) * 2),
                  ("rows", "3")),
    "cube": (image(np.ones((4, 5, 6)), CRVAL1=1.0, CDELT1=1.0), ("table", "6", "5", "4")),
    "two arrays": (table(columns=(10 * NM, np.outer(FLUX, [1, 2])), formats=("D", "2D")), ("rows",)),
    "unequal": (table(columns=(short_rows(10 * NM[:-1]), short_rows(FLUX)),
                      formats=(f"{NM.size - 1}D", f"{NM.size}D")), ("flux", "414", "415")),
    "words": (table(columns=(10 * NM, ["x"] * NM.size), formats=("D", "3A")), ("FLUX",)),
    "counts": (table(units=("ANGSTROMS", "Counts/s")), ("unit", "'Counts/s'")),
    "magnitudes": (table(units=("ANGSTROMS", "mag")), ("unit",)),
    "per steradian": (table(units=("nm", "W m-2 nm-1 sr-1")), ("flux_unit",)),
    "seconds": (table(units=("s", "FLAM")), ("wavelength_unit",)),
    "no axis": (image(FLUX), ("CRVAL1",)),
    "giant": (WHOLE.replace(b"NAXIS2  =                  415", b"NAXIS2  =" + b"4150000000".rjust(21)), ("file",)),
    "negative rows": (WHOLE.replace(b"NAXIS2  =                  415", b"NAXIS2  =                 -415"),
                      ("file", "FITS")),
    "bad card": (WHOLE.replace(b"TFORM1  = 'D       '", b"TFORM1  = 'Q!!     '"), ("file", "FITS")),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_FITS)
def test_unusable_fits_raises(tmp_path: Path, kind: str) -> None:
    content, sentence = BAD_FITS[kind]
    (tmp_path / "star.fits").write_bytes(content)
    with refused(*sentence) as caught:
        Source.read(tmp_path / "star.fits")
    assert "\n" not in str(caught.value)


def test_damaged_files_raise_or_are_read(tmp_path: Path) -> None:
    """Change random bytes of whole files with a fixed seed; only InputError may be raised."""
    rng = np.random.default_rng(14)
    for content in (WHOLE, FITS["linear image"], FITS["start and step"], PLAIN.encode(), gzip.compress(WHOLE)):
        for _ in range(60):
            damaged = bytearray(content)
            # Headers stand at the front.
            for place in rng.integers(0, min(len(damaged), 6000), 6):
                damaged[place] = rng.integers(32, 127)
            (tmp_path / "x").write_bytes(bytes(damaged))
            try:
                Source.read(tmp_path / "x")
            except InputError as error:
                assert "\n" not in str(error)  # noqa: PT017


def test_one_of_several_tables_or_rows(tmp_path: Path) -> None:
    columns = fits.ColDefs(
        [fits.Column("WAVELENGTH", "D", array=10 * NM, unit="A"), fits.Column("FLUX", "D", array=FLUX, unit="FLAM")]
    )
    other = fits.ColDefs(
        [fits.Column("WAVELENGTH", "D", array=10 * NM, unit="A"), fits.Column("FLUX", "D", array=2 * FLUX, unit="FLAM")]
    )
    hdus = [fits.PrimaryHDU()] + [
        fits.BinTableHDU.from_columns(c, name=name) for name, c in (("ONE", columns), ("TWO", other))
    ]
    path = tmp_path / "two.fits"
    fits.HDUList(hdus).writeto(path)
    with refused("table", "2", "FILE"):
        Source.read(path)
    for word in ("ONE", "one", "1", "ONE,FLUX"):
        alike(f"{path}[{word}]")
    rows = table(
        ("APERTURE", "WAVELENGTH", "FLUX"),
        (["LARGE", "SMALL"], np.tile(10 * NM, (2, 1)), np.array([FLUX, 2 * FLUX])),
        (None, "ANGSTROM", "ERG/CM2/S/A"),
        ("5A", f"{NM.size}D", f"{NM.size}D"),
    )
    (tmp_path / "rows.fits").write_bytes(rows)
    with refused("rows", "LARGE", "SMALL"):
        Source.read(tmp_path / "rows.fits")
    alike(f"{tmp_path / 'rows.fits'}[LARGE]")
    (tmp_path / "a[1].txt").write_text(PLAIN)
    alike(tmp_path / "a[1].txt")


def test_masks_and_integers_that_mark_nothing(tmp_path: Path) -> None:
    hidden = np.isin(NM, [172.0, 990.0])
    made = Table({"wavelength": Column(NM, unit="nm"), "flux": MaskedColumn(FLUX, mask=hidden, unit=FLAM)})
    for name, form in (("a.ecsv", "ascii.ecsv"), ("b.vot", "votable"), ("c.fits", "fits")):
        made.write(tmp_path / name, format=form)
        star = Source.read(tmp_path / name)
        assert star.wavelength_nm[[0, -1]].tolist() == [174.0, 988.0]
        assert "cut to 174.0-988.0 nm: undefined flux beyond" in star.notes
    inner = Table({"wavelength": Column(NM, unit="nm"), "flux": MaskedColumn(FLUX, mask=NM == 300, unit=FLAM)})
    inner.write(tmp_path / "d.vot", format="votable")
    with refused("flux", "66", "300"):
        Source.read(tmp_path / "d.vot")


def test_coverage_is_checked_before_ends_are_dropped(tmp_path: Path) -> None:
    flux = np.where(NM < 230, np.nan, FLUX)
    (tmp_path / "a.txt").write_text(lines(NM, flux, head="# nm FLAM\n"))
    with refused("flux", "200"):
        Source.read(tmp_path / "a.txt")


def test_yaml_alias_bomb_raises(tmp_path: Path) -> None:
    """Refuse a header of 1 KiB that expands to 10**9 values, but read one with aliases of astropy's."""
    levels = ["a0: &a0 [x,x,x,x,x,x,x,x,x,x]"]
    levels += [f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    meta = "\n".join(f"# meta: {{{', '.join(levels)}}}".splitlines())
    text = f"# %ECSV 1.0\n# ---\n# datatype: [{{name: wave, datatype: float64}}]\n{meta}\nwave\n1.0\n"
    (tmp_path / "bomb.txt").write_text(text)
    with refused("file", "100000"):
        Source.read(tmp_path / "bomb.txt")
    shared = [1, 2]
    made = Table({"wave": NM * u.nm, "flux": FLUX * FLAM}, meta={"a": shared, "b": shared})
    made.write(tmp_path / "own.ecsv", format="ascii.ecsv")
    alike(tmp_path / "own.ecsv")
