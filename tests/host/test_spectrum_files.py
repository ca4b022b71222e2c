"""Spectra of tables at random, of archives, and of files that are too large or none: right or refused."""

import bz2
import csv
import gzip
import lzma
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Column, MaskedColumn
from corpus import CORPUS, FLUX, NM, cases, value, written
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused
from tables import DATA, toml

from mauvecl import InputError, Instrument, Source, expect

CASES = dict(cases(CORPUS / "spectrum_files.toml"))


def is_right(star: Source) -> bool:
    pairs = ((star.wavelength_nm, NM, 1e-8), (star.flux_flam, FLUX, 1e-6))
    return star.wavelength_nm.size == NM.size and all(np.allclose(*both, rtol, 0) for *both, rtol in pairs)


def is_right_or_raises(folder: Path, head: str, mark: str, columns: dict[str, Any], may_raise: bool) -> None:
    rows = [mark.join(f"{value:.12g}" for value in row) for row in zip(*columns.values(), strict=True)]
    (folder / "star.dat").write_text("\n".join([head, *rows, ""]))
    try:
        star = Source.read(folder / "star.dat")
    except InputError as error:
        assert may_raise, error  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert is_right(star), star.messages


def test_units_may_be_those_of_astropy_and_frequencies_may_rise_or_fall(tmp_path: Path) -> None:
    case = CASES["spectrum_files assumed units txt"] | {"columns": {"w": "10 * nm", "f": "flux / 100"}}
    assert is_right(Source.read(written(case, tmp_path), wavelength_unit=u.AA, flux_unit=u.W / u.m**2 / u.nm))
    frequency, flux = (NM * u.nm).to(u.Hz, u.spectral()), value('per("Jy")') * u.Jy
    for order in (slice(None), slice(None, None, -1)):
        assert is_right(Source.from_arrays(frequency[order], flux[order]))
    # Columns of a plain table have units but are no Quantities, and values below a mask are none.
    spoilt = MaskedColumn(np.where(NM < 175.0, 1.0, FLUX / 100), unit=u.W / u.m**2 / u.nm, mask=NM < 175.0)
    star = Source.from_arrays(Column(10 * NM, unit=u.AA), spoilt)
    np.testing.assert_allclose((star.wavelength_nm, star.flux_flam), (NM[NM > 175.0], FLUX[NM > 175.0]), rtol=1e-6)


RANDOM = toml("corpus/spectrum_files.toml")["random"]
WAVES, FLUXES = ({name: value(text) for name, text in RANDOM[key].items()} for key in ("waves", "fluxes"))
#: Columns that are not taken for the flux.
NOT_FLUX = [case["head"].split(",")[0] for name, case in CASES.items() if " a column that is no flux " in name]
AT_RANDOM = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.long
@given(
    wave=st.sampled_from(sorted(WAVES)),
    flux=st.sampled_from(sorted(FLUXES)),
    extras=st.lists(
        st.tuples(st.sampled_from(NOT_FLUX + RANDOM["extras"]), st.booleans()), max_size=5, unique_by=lambda one: one[0]
    ),
    order=st.randoms(use_true_random=False),
    mark=st.sampled_from([",", "\t", " ", ";"]),
    remark=st.sampled_from(["", "# "]),
    prose=st.sampled_from(["", "# vacuum wavelengths\n", "# fluxes and errors, in 3 columns\n", "# made in 2024\n"]),
)
@AT_RANDOM
def test_any_table_is_read_correctly_or_raises(
    tmp_path: Path, wave: str, flux: str, extras: list[tuple[str, bool]], order: Any, mark: str, remark: str, prose: str
) -> None:
    columns = [(wave, WAVES[wave]), (flux, FLUXES[flux])]
    columns += [(name, 0.3 * k * FLUX if like else NM + 3.0 * k) for k, (name, like) in enumerate(extras, 1)]
    order.shuffle(columns)
    # Without another column of light there is nothing to ask.
    may_raise = {"foo", *RANDOM["extras"]} & {*dict(extras)}
    is_right_or_raises(tmp_path, prose + remark + mark.join(dict(columns)), mark, dict(columns), bool(may_raise))


@pytest.mark.long
@given(
    lines=st.lists(st.sampled_from(RANDOM["prose"]), min_size=1, max_size=3, unique=True),
    remark=st.sampled_from(["# ", "% ", "! ", ";", ""]),
    mark=st.sampled_from([" ", "\t", ",", "  "]),
    columns=st.sampled_from([{"0": NM, "1": FLUX}, {"0": NM, "1": FLUX, "2": 0.03 * FLUX}]),
)
@AT_RANDOM
def test_prose_in_a_header_changes_nothing(tmp_path: Path, lines: Any, remark: str, mark: str, columns: Any) -> None:
    """Add prose with words for wavelength, flux, errors and units; the first two columns are read, or it raises."""
    is_right_or_raises(tmp_path, "\n".join(remark + line for line in lines), mark, columns, True)


@pytest.mark.long
@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_decompression_bomb_raises_early(pack: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bomb").write_bytes(pack(bytes(64 << 20)))
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "16")
    # Python reserves the memory of the largest file.
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    tracemalloc.start()
    with refused("MAUVECL_LARGEST_CONTENT_MIB", "16"):
        Source.read(tmp_path / "bomb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


def test_only_regular_files_of_limited_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fifo, large = tmp_path / "fifo", tmp_path / "large"
    os.mkfifo(fifo)
    names = ("/dev/zero", fifo, tmp_path, tmp_path / "none", "a\0b", "x\ny" * 5000, tmp_path / ("y" * 300), "\ud800")
    for path in names:
        with refused("file") as caught:
            Source.read(path)
        assert len(str(caught.value)) < 600
    with large.open("wb") as file:
        file.truncate((1 << 20) + 1)
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    with refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        Source.read(large)
    # A file that grows is not cut silently, nor is one whose size the system does not know.
    size, known = os.fstat, os.stat_result
    with monkeypatch.context() as patch, refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        patch.setattr(os, "fstat", lambda handle: known([*size(handle)[:6], 0, *size(handle)[7:]]))
        Source.read(large)
    os.truncate(large, 1 << 20)
    # It is read, and holds no text.
    with refused("file", "null bytes"):
        Source.read(large)
    for limit in ("", "-1", "0", "1e3", "99999999", "٣"):
        monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", limit)
        with refused("MAUVECL_LARGEST_FILE_MIB"):
            Source.read(large)


HERE, ENTRIES = DATA / "spectra", toml("corpus/archive_files.toml")
RIGHT, SHORT = ([pytest.param(one, id=one["file"]) for one in ENTRIES[key]] for key in ("right", "short"))


def by_hand(name: str, flux: str = "FLUX", skip: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Read a file's wavelengths and fluxes, Angstrom and erg s-1 cm-2 A-1, by astropy, or as text."""
    if ".fits" in name:
        data = fits.getdata(HERE / name)
        return data["WAVELENGTH"].astype(float), data[flux].astype(float)
    text = (HERE / name).read_text()
    if name.endswith(".csv"):
        # Gaia's fluxes at 336 + 2 i nm, W m-2 nm-1, which are 100 erg s-1 cm-2 A-1.
        row = next(row for row in csv.DictReader(text.splitlines()) if row["source_id"] == "4")
        return 3360.0 + 20.0 * np.arange(343), 100.0 * np.array(row["flux"].strip("()").split(","), float)
    values = np.array([line.split()[:2] for line in text.splitlines()[skip:]], float)
    return values[:, 0], values[:, 1]


def test_every_file_is_tried() -> None:
    held = [case for _, case in cases(CORPUS / "archive_files.toml")] + ENTRIES["right"] + ENTRIES["short"]
    tried = {case["file"].split("[")[0] for case in held}
    assert tried == {path.name for path in HERE.iterdir() if path.suffix != ".md"}


# Astropy, by which files are read by hand, warns of a header with null values of real columns.
@pytest.mark.filterwarnings("ignore:Invalid keyword for column.*TNULLn")
@pytest.mark.parametrize("entry", RIGHT)
def test_archive_files_are_read(entry: dict[str, Any]) -> None:
    options = entry.get("options", {})
    star = Source.read(HERE / entry["file"], **options)
    angstrom, flux = by_hand(entry["file"].split("[")[0], **entry.get("how", {}))
    assert np.isfinite(star.flux_flam).all()
    assert all(any(words in text for text in star.messages) for words in entry.get("messages", ())), star.messages
    assert len(star.messages) == entry.get("n_messages", len(star.messages))
    # Points that stand once and have a flux are there as they stand, to the rounding of the unit.
    once = np.isfinite(flux) & np.isin(angstrom, np.unique(angstrom)[np.unique(angstrom, return_counts=True)[1] == 1])
    inside = once & (angstrom > 2000.0) & (angstrom < 7000.0)
    assert inside.sum() > 100
    place = np.searchsorted(star.wavelength_nm, angstrom[inside] / 10.0 * (1 - 1e-12))
    np.testing.assert_allclose(star.wavelength_nm[place], angstrom[inside] / 10.0, rtol=1e-12)
    np.testing.assert_allclose(star.flux_flam[place], flux[inside], rtol=1e-12)
    if "v" in entry:
        # Zero points of V differ by 0.03 mag; the M7 dwarf varies, and catalogues with it.
        assert star.magnitude("V") == pytest.approx(entry["v"], abs=0.15 if "extend" in options else 0.06)
    messages = expect(star.at_magnitude(8.0), Instrument.load("mauvesim"), exposure=50.0).messages
    assert all(any(text in message for message in messages) for text in star.messages)


@pytest.mark.parametrize("entry", SHORT)
def test_short_spectra_need_an_extension(entry: dict[str, Any]) -> None:
    star = Source.read(HERE / entry["file"], **entry.get("options", {}))
    assert any(text.startswith("its own points cover") for text in star.messages)
    with refused(*entry["refused"]):
        expect(replace(star, unscaled=""), Instrument.load("mauvesim"), exposure=5.0)


def test_messages_of_the_star_that_continues_a_spectrum() -> None:
    """What the library says of its star's ultraviolet is said of a spectrum that it continues to the blue."""
    (noisy,) = Source.from_library("M4V").messages
    assert "noise rules" in noisy
    wavelength = np.arange(90.0, 1100.0)
    # The zeros at the start stand for missing data.
    dark = Source.from_arrays(wavelength, np.where(wavelength < 300.0, 0.0, 1e-12), extend="M4V")
    for star in (Source.read(HERE / "vb8_stiswfcnic_004.fits", extend="M4V"), dark):
        assert f"in M4V, {noisy}" in star.messages


def test_surface_or_relative_fluxes_need_a_magnitude(tmp_path: Path) -> None:
    mauve = Instrument.load("mauvesim")
    lamost = written(dict(cases(CORPUS / "surveys.toml"))["surveys LAMOST table of DR8 fits"], tmp_path)
    model, ngsl = HERE / "ckp00_5750.fits[g45]", HERE / "h_stis_ngsl_hd095735_v2.txtA"
    for star in (Source.read(model), Source.read(ngsl, wavelength_unit="Angstrom"), Source.read(lamost, extend="K5V")):
        with refused("magnitude"):
            expect(star, mauve, exposure=5.0)
        assert expect(star.at_magnitude(7.5), mauve, exposure=5.0).signal_dn.max() > 0
    # The Sun is as bright as its file states.
    assert not Source.read(HERE / "sun_reference_stis_002.fits").unscaled


def test_calspec_files_that_start_within_the_line_function_are_continued() -> None:
    """Cut a whole file where CALSPEC's first begin (180.02 nm) and P330E does (199.95 nm)."""
    star, mauve = Source.read(HERE / "18sco_stis_004.fits"), Instrument.load("mauvesim")
    assert star.name == "18SCO"
    whole = expect(star, mauve, exposure=50.0)
    for start in (180.02, 199.95):
        kept = star.wavelength_nm >= start
        short = Source.from_arrays(star.wavelength_nm[kept], star.flux_flam[kept], name="short")
        # A tenth of the noise at most.
        error = np.abs(expect(short, mauve, exposure=50.0).signal_dn - whole.signal_dn)
        assert (error < 0.1 * np.sqrt(whole.variance_dn2)).all()
