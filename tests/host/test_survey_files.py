"""Files in the layouts of HST/COS, LAMOST, DESI and SDSS, written by astropy from their data models; checksums.

Layouts: COS Data Handbook 5.1, section 2.4.3 (hst-docs.stsci.edu/cosdhb); LAMOST,
https://dr5.lamost.org/v3/doc/data-production-description (image) and DR8 and later (table COADD); DESI,
https://desidatamodel.readthedocs.io/en/latest/DESI_SPECTRO_REDUX/SPECPROD/healpix/SURVEY/PROGRAM/PIXGROUP/PIXNUM/coadd-SURVEY-PROGRAM-PIXNUM.html;
SDSS, https://data.sdss.org/datamodel/files/BOSS_SPECTRO_REDUX/RUN2D/spectra/PLATE4/spec.html.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from refusals import refused

from mauvecl.host.expectation import expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.host.stars.source import Source

DATA = Path(__file__).parents[1] / "data" / "spectra"
LOG_STEP, LOG_START, N_LOG = 1e-4, 3.5682, 3909
LOGLAM = LOG_START + LOG_STEP * np.arange(N_LOG)


def light(angstrom: np.ndarray) -> np.ndarray:
    """Return a curved spectrum, erg s-1 cm-2 A-1."""
    return 1e-13 * (1.5 + np.sin(angstrom / 370.0))


def table(columns: dict[str, tuple[str, Any, str | None]], name: str = "") -> fits.BinTableHDU:
    made = [fits.Column(key, form, array=values, unit=unit) for key, (form, values, unit) in columns.items()]
    return fits.BinTableHDU.from_columns(made, name=name)


def written(tmp_path: Path, hdus: list[Any], **options: Any) -> Path:
    path = tmp_path / "spec.fits"
    fits.HDUList(hdus).writeto(path, **options)
    return path


def cos(tmp_path: Path, ranges: list[tuple[str, float, float]]) -> Path:
    """Make a COS x1d file: one row per detector segment, longer wavelengths first, padded and flagged ends."""
    n = 1024
    wave = np.array([np.linspace(low, high, n) for _, low, high in ranges])
    weight = np.ones((len(ranges), n))
    weight[:, :20] = weight[:, -30:] = 0.0
    flux = np.where(weight > 0, light(wave), 0.0)
    cells = f"{n}D"
    density = "erg /s /cm**2 /angstrom"
    columns = {
        "SEGMENT": ("4A", [name for name, *_ in ranges], None),
        "EXPTIME": ("D", [1000.0] * len(ranges), "s"),
        "NELEM": ("J", [n] * len(ranges), None),
        "WAVELENGTH": (cells, wave, "angstrom"),
        "FLUX": (cells, flux, density),
        "ERROR": (cells, 0.1 * flux, density),
        "ERROR_LOWER": (cells, 0.1 * flux, density),
        "GROSS": (cells, 3 * weight, "count /s"),
        "GCOUNTS": (cells, 3 * weight, "count"),
        "NET": (cells, 2 * weight, "count /s"),
        "BACKGROUND": (cells, weight, "count /s"),
        "DQ": (f"{n}I", np.where(weight > 0, 0, 128), None),
        "DQ_WGT": (cells, weight, None),
    }
    primary = fits.PrimaryHDU(header=fits.Header({"TELESCOP": "HST", "INSTRUME": "COS", "TARGNAME": "AD-LEO"}))
    return written(tmp_path, [primary, table(columns, "SCI")])


def test_cos_segments_are_joined(tmp_path: Path) -> None:
    path = cos(tmp_path, [("FUVA", 1280.0, 1440.0), ("FUVB", 1130.0, 1290.0)])
    read = read_spectrum(path)
    assert read.name == "AD-LEO"
    assert (np.diff(read.wavelength_nm) > 0).all()
    np.testing.assert_allclose(read.flux_flam, light(10 * read.wavelength_nm), rtol=1e-12)
    # The flagged ends are left out, and the overlap is cut once.
    assert read.wavelength_nm[[0, -1]] == pytest.approx([113.3, 143.5], abs=0.1)
    assert read.messages[0] == "its 2 segments (FUVA, FUVB) are joined"
    assert "two segments overlap at 128.313-128.531 nm and are cut at 128.422 nm" in read.messages[1]
    one = read_spectrum(Path(f"{path}[FUVB]"))
    assert one.wavelength_nm[-1] == pytest.approx(128.53, abs=0.01)
    assert not one.messages
    with refused("extend", "113", "0%", "200-700"):
        Source.read(path)


def test_nested_segments_need_a_choice(tmp_path: Path) -> None:
    with refused("table", "FILE"):
        read_spectrum(cos(tmp_path, [("NUVA", 2000.0, 3000.0), ("NUVB", 2400.0, 2600.0)]))


def lamost_image(tmp_path: Path) -> Path:
    """Write a file as of DR1-DR7: an image of five rows, COEFF0 and COEFF1, relative fluxes without a unit."""
    angstrom = 10**LOGLAM
    rows = np.array([1e15 * light(angstrom), 1e3 + 0 * angstrom, angstrom, 0 * angstrom, 1 + 0 * angstrom], np.float32)
    cards = {
        "TELESCOP": "LAMOST",
        "OBJECT": "LAMOST J1",
        "CRVAL1": LOG_START,
        "CD1_1": LOG_STEP,
        "CRPIX1": 1,
        "DC-FLAG": 1,
        "WFITTYPE": "LOG-LINEAR",
        "COEFF0": LOG_START,
        "COEFF1": LOG_STEP,
        "VACUUM": True,
    }
    return written(tmp_path, [fits.PrimaryHDU(rows, fits.Header(cards))])


def lamost_table(tmp_path: Path) -> Path:
    """Write a file as of DR8 and later: a table COADD with a row of arrays."""
    angstrom = 10**LOGLAM
    form = f"{N_LOG}E"
    names = ("FLUX", "IVAR", "WAVELENGTH", "ANDMASK", "ORMASK", "NORMALIZATION")
    values = (1e15 * light(angstrom), angstrom, angstrom, 0 * angstrom, 0 * angstrom, 2 * light(angstrom))
    columns = {name: (form, value[None, :], None) for name, value in zip(names, values, strict=True)}
    primary = fits.PrimaryHDU(header=fits.Header({"TELESCOP": "LAMOST", "OBJECT": "LAMOST J1"}))
    return written(tmp_path, [primary, table(columns, "COADD")])


@pytest.mark.parametrize("form", [lamost_image, lamost_table])
def test_lamost_files_are_read(tmp_path: Path, form: Any) -> None:
    star = Source.read(form(tmp_path), extend="K5V")
    measured = (star.wavelength_nm > 371) & (star.wavelength_nm < 700)
    np.testing.assert_allclose(star.flux_flam[measured], 1e15 * light(10 * star.wavelength_nm[measured]), rtol=1e-3)
    assert star.name == "LAMOST J1"
    assert any("cover 369.999-909.913 nm, 66% of 200-700 nm" in text for text in star.messages), star.messages
    mauve = Instrument.load("mauve")
    with refused("magnitude", "LAMOST"):
        expect(star, mauve, exposure=5.0)
    assert expect(star.at_magnitude(8.0), mauve, exposure=5.0).signal_dn.max() > 0


ARMS = {"B": (3600.0, 5800.0), "R": (5760.0, 7620.0), "Z": (7520.0, 9824.0)}
TARGETS = [39627652591521181, 39627652591521182, 39627652591521183]


def desi(tmp_path: Path, targets: list[int]) -> Path:
    unit = "10**-17 erg/(s cm2 Angstrom)"
    fibres = {
        "TARGETID": ("K", targets, None),
        "FLUX_R": ("E", np.ones(len(targets)), None),
        "LAMBDA_REF": ("E", np.full(len(targets), 5400.0), None),
        "OBJTYPE": ("3A", ["TGT"] * len(targets), None),
    }
    hdus: list[Any] = [fits.PrimaryHDU(), table(fibres, "FIBERMAP")]
    for arm, (low, high) in ARMS.items():
        wave = np.arange(low, high + 0.1, 0.8)
        flux = np.array([(k + 1) * 1e17 * light(wave) for k in range(len(targets))], np.float32)
        hdus += [
            fits.ImageHDU(wave, fits.Header({"BUNIT": "Angstrom"}), name=f"{arm}_WAVELENGTH"),
            fits.ImageHDU(flux, fits.Header({"BUNIT": unit}), name=f"{arm}_FLUX"),
            fits.ImageHDU(1 / (0.01 * flux) ** 2, name=f"{arm}_IVAR"),
            fits.ImageHDU(np.zeros(flux.shape, np.int32), name=f"{arm}_MASK"),
            fits.ImageHDU(np.ones((len(targets), 11, wave.size), np.float32), name=f"{arm}_RESOLUTION"),
        ]
    return written(tmp_path, [*hdus, table({"TARGETID": ("K", targets, None)}, "SCORES")], checksum=True)


def test_desi_fibres_and_arms(tmp_path: Path) -> None:
    path = desi(tmp_path, TARGETS)
    with refused("rows", "3", "39627652591521181", "FILE"):
        read_spectrum(path)
    with refused("columns", "'5'"):
        read_spectrum(Path(f"{path}[5]"))
    for words in (f"{TARGETS[1]}", "row 2"):
        read = read_spectrum(Path(f"{path}[{words}]"))
        np.testing.assert_allclose(read.flux_flam, 2 * light(10 * read.wavelength_nm), rtol=1e-6)
        assert read.wavelength_nm[[0, -1]] == pytest.approx([360.0, 982.4])
        assert (np.diff(read.wavelength_nm) > 0).all()
    assert "its parts B, R, Z are joined" in read.messages
    assert sum("two segments overlap" in text for text in read.messages) == 2
    red = read_spectrum(Path(f"{path}[R,row 3]"))
    assert red.wavelength_nm[[0, -1]] == pytest.approx([576.0, 762.0])
    with refused("row", "4", "3", "1"):
        read_spectrum(Path(f"{path}[row 4]"))
    assert any("continued by K5V" in text for text in Source.read(f"{path}[row 1]", extend="K5V").messages)


def test_one_desi_target(tmp_path: Path) -> None:
    read = read_spectrum(desi(tmp_path, TARGETS[:1]))
    np.testing.assert_allclose(read.flux_flam, light(10 * read.wavelength_nm), rtol=1e-6)


def sdss(tmp_path: Path, exposures: bool) -> Path:
    angstrom = 10**LOGLAM
    columns = {
        "flux": ("E", 1e17 * light(angstrom), None),
        "loglam": ("E", LOGLAM, None),
        "ivar": ("E", angstrom, None),
        "and_mask": ("J", 0 * LOGLAM, None),
        "or_mask": ("J", 0 * LOGLAM, None),
        "wdisp": ("E", 0 * LOGLAM + 1, None),
        "sky": ("E", 3e17 * light(angstrom), None),
        "model": ("E", 2e17 * light(angstrom), None),
    }
    catalogue = {
        "WAVEMIN": ("E", [3600.0], None),
        "WAVEMAX": ("E", [9000.0], None),
        "SPECTROFLUX": ("5E", np.ones((1, 5)), None),
        "PLUG_RA": ("D", [10.0], None),
    }
    lines = {
        "LINENAME": ("10A", ["H_alpha"], None),
        "LINEWAVE": ("D", [6564.6], "Angstrom"),
        "LINEAREA": ("E", [1.0], None),
    }
    hdus = [
        fits.PrimaryHDU(header=fits.Header({"BUNIT": "1E-17 erg/cm^2/s/Ang", "OBJECT": "spec"})),
        table(columns, "COADD"),
        table(catalogue, "SPECOBJ"),
        table(lines, "SPZLINE"),
    ]
    if exposures:
        one = {**columns, "flux": ("E", 5e17 * light(angstrom), None)}
        hdus += [table(one, name) for name in ("B1-00108366-00108370-00108371", "R1-00108366-00108370-00108371")]
    return written(tmp_path, hdus)


@pytest.mark.parametrize("exposures", [False, True])
def test_sdss_coadds_are_read(tmp_path: Path, exposures: bool) -> None:
    path = sdss(tmp_path, exposures)
    read = read_spectrum(path)
    np.testing.assert_allclose(read.flux_flam, light(10 * read.wavelength_nm), rtol=1e-3)
    np.testing.assert_allclose(read.wavelength_nm, 10 ** (LOGLAM - 1), rtol=1e-5)
    assert any("its wavelengths are logarithms (loglam)" in text for text in read.messages)
    if exposures:
        other = read_spectrum(Path(f"{path}[B1-00108366-00108370-00108371]"))
        np.testing.assert_allclose(other.flux_flam, 5 * read.flux_flam, rtol=1e-5)
    model = read_spectrum(Path(f"{path}[COADD,model]"))
    assert np.median(model.flux_flam / read.flux_flam) > 1.5


def test_sdss_plates_and_old_files(tmp_path: Path) -> None:
    """spPlate (classic.sdss.org/dr7/dm/flatFiles/spPlate.html), a fibre a row, and spSpec, whose first row is flux."""
    angstrom = 10**LOGLAM
    cards = {"TELESCOP": "SDSS 2.5-M", "COEFF0": LOG_START, "COEFF1": LOG_STEP, "BUNIT": "1E-17 erg/cm^2/s/Ang"}
    for rows, words, factor in ((20, "[row 3]", 3.0), (5, "", 1.0)):
        data = np.array([(k + 1) * 1e17 * light(angstrom) for k in range(rows)], np.float32)
        path = written(tmp_path, [fits.PrimaryHDU(data, fits.Header(cards))], overwrite=True)
        read = read_spectrum(Path(f"{path}{words}"))
        np.testing.assert_allclose(read.flux_flam, factor * light(10 * read.wavelength_nm), rtol=1e-6)
        if words:
            with refused("rows", "20", "1", "FILE"):
                read_spectrum(path)


def test_ab_magnitudes_in_tables(tmp_path: Path) -> None:
    angstrom = np.arange(1700.0, 10_000.0, 20.0)
    flam = u.erg / (u.s * u.cm**2 * u.AA)
    magnitude = (light(angstrom) * flam).to_value(u.ABmag, u.spectral_density(angstrom * u.AA))
    for unit, name in ((u.ABmag, "mag"), (u.mag, "ABmag"), (u.mag, "mag_AB")):
        made = Table({"wavelength": angstrom * u.AA, name: magnitude})
        made[name].unit = unit
        made.write(tmp_path / "star.ecsv", format="ascii.ecsv", overwrite=True)
        star = Source.read(tmp_path / "star.ecsv")
        np.testing.assert_allclose(star.flux_flam, light(10 * star.wavelength_nm), rtol=1e-9)
    made = Table({"wavelength": angstrom * u.AA, "mag": magnitude * u.mag})
    made.write(tmp_path / "star.ecsv", format="ascii.ecsv", overwrite=True)
    with refused("columns"):
        Source.read(tmp_path / "star.ecsv")


def test_checksums_are_verified(tmp_path: Path) -> None:
    """Damage each byte of a file with DATASUM and CHECKSUM; files without them are read as before."""
    angstrom = np.arange(1700.0, 10_000.0, 20.0)
    columns = {"WAVELENGTH": ("D", angstrom, "Angstrom"), "FLUX": ("D", light(angstrom), "FLAM")}
    path = written(tmp_path, [fits.PrimaryHDU(), table(columns, "SCI")], checksum=True)
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
