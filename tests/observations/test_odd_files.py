"""Odd files: each gives frames that are the truth where it is defined, or one sentence that names what is wrong."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from commands import run
from layouts import LAYOUTS, Truth
from numpy.typing import NDArray
from refusals import refused

from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import read_frames

N = 60
RNG = np.random.default_rng(2900)
TIME = 20.0 * np.arange(N) + 100.0
FLUX = np.round(RNG.normal(1000, 5, N), 3)
ERROR = np.full(N, 5.0)
EVERY = np.arange(N)

Columns = dict[str, Any]
#: Check frames against the truth, or the key of an error.
Expected = Callable[[Frames], Any] | str


def light_curve(**change: Any) -> Columns:
    """Return the columns of a light curve; None removes one."""
    columns = {"t": TIME, "f": FLUX, "e": ERROR, "q": np.zeros(N, int), "x": np.full(N, 18.0), "c": np.full(N, 21.0)}
    return {key: value for key, value in (columns | change).items() if value is not None}


def kept(rows: NDArray[Any] = EVERY, reasons: dict[int, Reason] | None = None, remark: str = "", **values: Any) -> Any:
    """Return a check that frames are these rows of the truth, and which of them have a fault."""

    def check(frames: Frames) -> None:
        np.testing.assert_allclose(frames.time_s, values.get("time", TIME[rows]), atol=1e-4)
        want = values.get("flux", FLUX[rows])
        good = frames.faults == 0
        np.testing.assert_allclose(frames.flux[good], want[good], rtol=values.get("rtol", 1e-9))
        assert frames.error is not None
        np.testing.assert_allclose(frames.error[good], ERROR[rows][good], rtol=1e-6)
        assert {int(k): Reason(int(frames.faults[k])) for k in np.flatnonzero(~good)} == (reasons or {})
        assert any(remark in one for one in frames.remarks) or (not remark and not frames.remarks), frames.remarks
        assert frames.temperature_c is None or np.allclose(frames.temperature_c, 21.0)

    return check


def at(row: int, value: Any, column: NDArray[Any]) -> NDArray[Any]:
    """Return a column with another value in a row."""
    changed = np.array(column, np.result_type(column, type(value)) if not isinstance(value, str) else object)
    changed[row] = value
    return changed


SHUFFLED = RNG.permutation(N)
GAP = np.r_[0:20, 35:60]
DOUBLE = np.r_[0:30, 29:60]
MASK = EVERY == 9
HOW: dict[str, Any] = {"time": "t", "flux": "f", "error": "e", "quality": "q", "exposure": "x", "temperature": "c",
                       "time_unit": "s", "flux_unit": "DN/s", "exposure_unit": "s",
                       "temperature_unit": "deg_C"}  # fmt: skip


def chosen(rows: NDArray[Any]) -> Columns:
    """Return rows of the light curve."""
    return {key: value[rows] for key, value in light_curve().items()}


#: Tables that every format can hold: columns, changes of the mapping, and what is expected.
TABLES: dict[str, tuple[Columns, Columns, Expected]] = {
    "plain": (light_curve(), {}, kept()),
    "shuffled": (chosen(SHUFFLED), {}, kept(remark="sorted by time")),
    "reversed": (chosen(EVERY[::-1]), {}, kept(remark="sorted by time")),
    "gap": (chosen(GAP), {}, kept(GAP)),
    "a row twice": (chosen(DOUBLE), {}, "time"),
    "two rows at a time": (light_curve(t=at(7, TIME[6], TIME)), {}, "time"),
    "all at one time": (light_curve(t=np.full(N, 5.0)), {}, "time"),
    "a time in another century": (light_curve(t=at(59, 1e11, TIME)), {}, "time"),
    "a time beyond whole numbers": (light_curve(t=at(59, 1.8e19 * 86_400, TIME)), {}, "time"),
    "no time column": (light_curve(t=None), {}, "column"),
    "no flux column": (light_curve(f=None), {}, "column"),
    "no error column": (light_curve(e=None), {}, "column"),
    "no quality column": (light_curve(q=None), {}, "column"),
    "no exposure column": (light_curve(x=None), {}, "column"),
    "no temperature column": (light_curve(c=None), {}, "column"),
    "time is nan": (light_curve(t=at(9, np.nan, TIME)), {}, kept(EVERY[~MASK], remark="1 row has no time")),
    "time is infinite": (light_curve(t=at(9, np.inf, TIME)), {}, kept(EVERY[~MASK], remark="1 row has no time")),
    "every time is nan": (light_curve(t=np.full(N, np.nan)), {}, "time"),
    "flux is nan": (light_curve(f=at(9, np.nan, FLUX)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "flux is infinite": (light_curve(f=at(9, np.inf, FLUX)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "error is nan": (light_curve(e=at(9, np.nan, ERROR)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "error is zero": (light_curve(e=at(9, 0.0, ERROR)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "error is negative": (light_curve(e=at(9, -5.0, ERROR)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "quality is set": (light_curve(q=at(9, 128, np.zeros(N, int))), {}, kept(reasons={9: Reason.QUALITY})),
    "quality is negative": (light_curve(q=at(9, -1, np.zeros(N, int))), {}, kept(reasons={9: Reason.QUALITY})),
    "quality is a number": (light_curve(q=at(9, 2.0, np.zeros(N))), {}, kept(reasons={9: Reason.QUALITY})),
    "flux is masked": (light_curve(f=MaskedColumn(FLUX, mask=MASK)), {}, kept(reasons={9: Reason.NOT_FINITE})),
    "time is masked": (light_curve(t=MaskedColumn(TIME, mask=MASK)), {},
                       kept(EVERY[~MASK], remark="1 row has no time")),
    "no rows": (chosen(EVERY[:0]), {}, "frames"),
    "one row": (chosen(EVERY[:1]), {}, "frames"),
    "nineteen rows": (chosen(EVERY[:19]), {}, "frames"),
    "twenty rows": (chosen(EVERY[:20]), {}, kept(EVERY[:20])),
    "texts of numbers": (light_curve(f=np.array([f" {one:.3f} " for one in FLUX])), {}, kept()),
    "a text among numbers": (light_curve(f=at(9, "bad", FLUX.astype(str))), {}, "f"),
    "a text among times": (light_curve(t=at(9, "noon", TIME.astype(str))), {}, "t"),
    "whole numbers": (light_curve(f=np.rint(FLUX).astype(int)), {}, kept(flux=np.rint(FLUX))),
    "single precision": (light_curve(f=FLUX.astype("f4")), {}, kept(rtol=1e-6)),
    "exposure is negative": (light_curve(x=at(9, -1.0, np.full(N, 18.0))), {}, "exposure"),
    "exposure is zero": (light_curve(x=np.zeros(N)), {}, "exposure"),
    "exposure is nan": (light_curve(x=at(9, np.nan, np.full(N, 18.0))), {}, "exposure"),
    "exposure in minutes": (light_curve(x=np.full(N, 0.3)), {"exposure_unit": "min"}, kept()),
    "exposure in an unknown unit": (light_curve(), {"exposure_unit": "furlong"}, "exposure_unit"),
    "time in minutes": (light_curve(t=TIME / 60), {"time_unit": "min"}, kept()),
    "time in days": (light_curve(t=TIME / 86_400), {"time_unit": "d"}, kept()),
    "time in milliseconds": (light_curve(t=TIME * 1000), {"time_unit": "ms"}, kept()),
    "time in parsec": (light_curve(), {"time_unit": "pc"}, "time_unit"),
    "temperature in kelvin": (light_curve(c=np.full(N, 294.15)), {"temperature_unit": "K"}, kept()),
    "temperature in volts": (light_curve(), {"temperature_unit": "V"}, "temperature_unit"),
    "light in magnitudes": (light_curve(), {"flux_unit": "mag"}, "flux_unit"),
    "flux is a text": (light_curve(f=np.array(["x"] * N)), {}, "f"),
    "capital letters": (light_curve(), {"flux": "F", "time": "T"}, kept()),
    "more columns": (light_curve(extra=np.array(["a"] * N)), {}, kept()),
    "one wavelength for frames": (light_curve(), {"wavelength": "c", "wavelength_unit": "nm"},
                                  lambda frames: np.testing.assert_allclose(frames.flux[:, 0], FLUX)),
}  # fmt: skip
FORMATS = ("csv", "ecsv", "fits", "csv.gz", "fits.xz")


def table_file(columns: Columns, folder: Path, ending: str) -> Path:
    """Write a table, packed if its ending says so."""
    kind, _, packing = ending.partition(".")
    path = folder / f"a.{kind}"
    Table({key: value.astype(str) if value.dtype.kind == "O" else value for key, value in columns.items()}).write(path)
    if packing:
        pack = {"gz": gzip.compress, "xz": lzma.compress}[packing]
        path.with_suffix(f".{kind}.{packing}").write_bytes(pack(path.read_bytes()))
        path = path.with_suffix(f".{kind}.{packing}")
    return path


def judge(path: Path | str, mapping: FrameMapping | None, expected: Expected) -> None:
    """Check that a file gives the expected frames, or one sentence with the expected key."""
    if callable(expected):
        expected(read_frames(path, mapping))
        return
    with refused(expected) as caught:
        read_frames(path, mapping)
    assert 20 < len(str(caught.value)) < 600, str(caught.value)
    assert "Error" not in str(caught.value), str(caught.value)


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("name", TABLES)
def test_odd_tables_give_the_truth_or_an_error(name: str, ending: str, tmp_path: Path) -> None:
    columns, change, expected = TABLES[name]
    judge(table_file(columns, tmp_path, ending), FrameMapping(**(HOW | change)), expected)


def line(text: str) -> str:
    """Return a row of a text."""
    return text.splitlines()[9]


#: Texts of CSV files: a function of the plain text to bytes, changes of the mapping, and what is expected.
TEXTS: dict[str, tuple[Callable[[str], bytes], Columns, Expected]] = {
    "byte-order mark": (lambda text: b"\xef\xbb\xbf" + text.encode(), {}, kept()),
    "line ends of Windows": (lambda text: text.replace("\n", "\r\n").encode(), {}, kept()),
    "UTF-16": (lambda text: text.encode("utf-16"), {}, kept()),
    "Latin-1": (lambda text: ("# \xb5\n" + text).encode("latin-1"), {}, "file"),
    "null bytes": (lambda text: text.encode() + b"\0\0\0", {}, "file"),
    "empty": (lambda _: b"", {}, "file"),
    "blanks only": (lambda _: b"\n \n\n", {}, "file"),
    "comments above": (lambda text: b"# GJ 65\n# by hand, 2026\n" + text.encode(), {}, kept()),
    "comments within": (lambda text: text.replace("\n", "\n# noon\n", 20).encode(), {}, kept()),
    "names in a comment": (lambda text: b"# " + text.encode(), {}, kept()),
    "blank lines": (lambda text: text.replace("\n", "\n\n").encode(), {}, kept()),
    "blanks around commas": (lambda text: text.replace(",", " , ").encode(), {}, kept()),
    "quotes": (lambda text: text.replace("t,f", '"t","f"').encode(), {}, kept()),
    "names only": (lambda text: text.splitlines()[0].encode(), {}, "frames"),
    "no names": (lambda text: text.partition("\n")[2].encode(), {}, "column"),
    "semicolons": (lambda text: text.replace(",", ";").encode(), {}, kept()),
    "a row cut short": (lambda text: text.replace(line(text), line(text)[:12]).encode(), {}, "file"),
    "a row too long": (lambda text: text.replace(line(text), line(text) + ",1").encode(), {}, "file"),
    "cut in the last row": (lambda text: text[:-12].encode(), {}, "file"),
    "a name twice": (lambda text: text.replace("t,f,e", "t,f,f", 1).encode(), {"error": "f_1"}, kept()),
    "a missing cell": (lambda text: text.replace(f",{FLUX[9]},", ",,", 1).encode(), {},
                       kept(reasons={9: Reason.NOT_FINITE})),
    "a cell of words": (lambda text: text.replace(f",{FLUX[9]},", ",n/a,", 1).encode(), {},
                        kept(reasons={9: Reason.NOT_FINITE})),
    "a cell of dashes": (lambda text: text.replace(f",{FLUX[9]},", ",--,", 1).encode(), {},
                         kept(reasons={9: Reason.NOT_FINITE})),
    "exponents of Fortran": (lambda text: text.replace(f",{FLUX[9]},", f",{FLUX[9] / 1000:.6f}D3,", 1).encode(), {},
                             kept()),
    "a web page": (lambda _: b"<html><body>404</body></html>", {}, "file"),
    "random bytes": (lambda _: np.random.default_rng(1).bytes(5000), {}, "file"),
    "gzip cut short": (lambda text: gzip.compress(text.encode())[:-200], {}, "file"),
    "bzip2": (lambda text: bz2.compress(text.encode()), {}, kept()),
    "a line without an end": (lambda text: b"t,f\n" + b"1" * 200_000, {}, "file"),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_odd_texts_give_the_truth_or_an_error(name: str, tmp_path: Path) -> None:
    change, how, expected = TEXTS[name]
    path = table_file(light_curve(), tmp_path, "csv")
    path.write_bytes(change(path.read_text()))
    judge(path, FrameMapping(**(HOW | how)), expected)


def damaged(place: int, value: bytes) -> Callable[[bytes], bytes]:
    """Return a function that writes bytes into a file."""
    return lambda content: content[:place] + value + content[place + len(value) :]


def card(key: str, value: str) -> Callable[[bytes], bytes]:
    """Return a function that writes another value into the last card of a key."""

    def change(content: bytes) -> bytes:
        place = content.rindex(f"{key:8s}=".encode())
        return content[: place + 10] + f"{value:>20s}".encode() + content[place + 30 :]

    return change


#: Bytes of a FITS file with a table: a change, and what is expected.
BYTES: dict[str, tuple[Callable[[bytes], bytes], Expected]] = {
    **{f"cut after {share} %": (lambda content, share=share: content[: len(content) * share // 100], key)
       for share, key in ((1, "file"), (5, "file"), (30, "file"), (40, "file"), (50, "file"), (60, "file"),
                          (75, "file"), (90, "file"))},
    "signature only": (lambda content: content[:9], "file"),
    "no end of the header": (lambda content: content.replace(b"END     ", b"COMMENT ", 1), "file"),
    "more rows than there are": (card("NAXIS2", "600"), "file"),
    "fewer rows than there are": (card("NAXIS2", "30"), kept(EVERY[:30])),
    "negative rows": (card("NAXIS2", "-1"), "file"),
    "rows that are no number": (card("NAXIS2", "many"), "file"),
    "wider rows": (card("NAXIS1", "60"), "file"),
    "an unknown form of a column": (card("TFORM2", "'7Z'"), "file"),
    "text as a column's form": (card("TFORM2", "'8A'"), "f"),
    "trailing bytes": (lambda content: content + b"more", kept()),
    "a table called image": (lambda content: content.replace(b"'BINTABLE'", b"'IMAGE   '"), "column"),
}  # fmt: skip


@pytest.mark.parametrize("name", BYTES)
def test_damaged_fits_files_give_the_truth_or_an_error(name: str, tmp_path: Path) -> None:
    change, expected = BYTES[name]
    path = table_file(light_curve(), tmp_path, "fits")
    path.write_bytes(change(path.read_bytes()))
    judge(path, FrameMapping(**HOW), expected)


def hdu_of(columns: Columns, name: str = "", **keywords: Any) -> fits.BinTableHDU:
    """Return a table as an extension."""
    hdu = fits.table_to_hdu(Table(columns))
    hdu.name = name
    hdu.header.update(keywords)
    return hdu


def with_null(value: int) -> fits.BinTableHDU:
    """Return the light curve as whole numbers, of which one marks what is missing."""
    whole = at(9, value, np.rint(FLUX).astype(int)).astype("i4")
    columns = [fits.Column("t", "D", array=TIME), fits.Column("f", "J", null=value, array=whole),
               fits.Column("e", "D", array=ERROR)]  # fmt: skip
    return fits.BinTableHDU.from_columns(columns)


def unsigned() -> fits.BinTableHDU:
    """Return the light curve with unsigned numbers, which FITS stores with an offset."""
    columns = [fits.Column("t", "J", bzero=2**31, array=TIME.astype("u4")), fits.Column("e", "D", array=ERROR),
               fits.Column("f", "I", bzero=2**15, array=np.rint(FLUX).astype("u2"))]  # fmt: skip
    return fits.BinTableHDU.from_columns(columns)


SHORT = {"time": "t", "flux": "f", "error": "e", "time_unit": "s"}
OTHER = light_curve(f=FLUX * 2)
#: Extensions of a FITS file, the mapping, and what is expected.
EXTENSIONS: dict[str, tuple[Callable[[], list[Any]], Columns | None, Expected]] = {
    "the first of two tables": (lambda: [hdu_of(light_curve(), "A"), hdu_of(OTHER, "B")], SHORT, kept()),
    "the second by name": (lambda: [hdu_of(OTHER, "A"), hdu_of(light_curve(), "B")], SHORT | {"hdu": "B"}, kept()),
    "the second by number": (lambda: [hdu_of(OTHER, "A"), hdu_of(light_curve(), "B")], SHORT | {"hdu": 2}, kept()),
    "a small name": (lambda: [hdu_of(OTHER, "A"), hdu_of(light_curve(), "B")], SHORT | {"hdu": "b"}, kept()),
    "an extension that is not there": (lambda: [hdu_of(light_curve(), "A")], SHORT | {"hdu": "C"}, "hdu"),
    "a number beyond the last": (lambda: [hdu_of(light_curve(), "A")], SHORT | {"hdu": 7}, "hdu"),
    "the table without the columns first": (lambda: [hdu_of({"a": [1, 2]}), hdu_of(light_curve())], SHORT, kept()),
    "columns of two tables": (lambda: [hdu_of({"t": TIME, "f": FLUX}, "A"), hdu_of({"e": ERROR}, "B")], SHORT, kept()),
    "columns of two tables by name": (lambda: [hdu_of({"t": TIME, "f": FLUX}, "A"), hdu_of({"e": ERROR}, "B")],
                                      SHORT | {"error": "B/e"}, kept()),
    "a column in two other tables": (lambda: [hdu_of({"t": TIME, "f": FLUX}), *(hdu_of({"e": ERROR}) for _ in "AB")],
                                     SHORT, "e"),
    "tables of different length": (lambda: [hdu_of({"t": TIME, "f": FLUX}), hdu_of({"e": ERROR[:9]})], SHORT, "e"),
    "images for columns": (lambda: [fits.ImageHDU(TIME, name="T"), fits.ImageHDU(FLUX, name="F"),
                                    fits.ImageHDU(ERROR, name="E")], SHORT, kept()),
    "no extension": (list, SHORT, "file"),
    "no extension and no mapping": (list, None, "file"),
    "known names": (lambda: [hdu_of({"TIME": TIME, "FLUX": FLUX, "FLUX_ERR": ERROR}, TIMEUNIT="s")], None, kept()),
    "known names without a unit": (lambda: [hdu_of({"TIME": TIME, "FLUX": FLUX})], None, "time_unit"),
    "time in a unit of its own": (lambda: [hdu_of({"TIME": TIME / 60, "FLUX": FLUX, "FLUX_ERR": ERROR}, TUNIT1="min",
                                                  TIMEUNIT="d")], None, kept()),
    "an unknown unit of time": (lambda: [hdu_of({"TIME": TIME, "FLUX": FLUX}, TUNIT1="fortnights")], None, "time_unit"),
    "error in another unit": (lambda: [hdu_of(light_curve(e=ERROR * 1000), TUNIT2="Jy", TUNIT3="mJy")], SHORT, kept()),
    "error of another kind": (lambda: [hdu_of(light_curve(), TUNIT2="Jy", TUNIT3="s")], SHORT, "error"),
    "error in an unknown unit": (lambda: [hdu_of(light_curve(), TUNIT2="Jy", TUNIT3="blob")], SHORT, "error"),
    "the file's unknown unit of light": (lambda: [hdu_of(light_curve(), TUNIT2="e-/s", TUNIT3="e-/s")], SHORT, kept()),
    "a value for what is missing": (lambda: [with_null(-99)], SHORT,
                                    kept(flux=np.rint(FLUX), reasons={9: Reason.NOT_FINITE})),
    "unsigned numbers": (lambda: [unsigned()], SHORT, kept(flux=np.rint(FLUX))),
    "complex numbers": (lambda: [hdu_of(light_curve(f=FLUX + 1j))], SHORT, "f"),
    "true and false": (lambda: [hdu_of(light_curve(q=MASK))], SHORT | {"quality": "q"},
                       kept(reasons={9: Reason.QUALITY})),
    "start and end": (lambda: [hdu_of(light_curve(a=TIME - 9, b=TIME + 9))], SHORT | {"time": ("a", "b")}, kept()),
    "end before start": (lambda: [hdu_of(light_curve(a=TIME + 9, b=TIME - 9))], SHORT | {"time": ("a", "b")},
                         "exposure"),
    "start and end in two units": (lambda: [hdu_of(light_curve(a=TIME, b=TIME), TUNIT7="s", TUNIT8="d")],
                                   {"time": ("a", "b"), "flux": "f", "error": "e"}, "time"),
    "a vector for a light curve": (lambda: [hdu_of(light_curve(f=FLUX[:, None], e=ERROR[:, None]))], SHORT, kept()),
    "spectra without wavelengths": (lambda: [hdu_of(light_curve(f=np.tile(FLUX[:, None], 3)))],
                                    {key: SHORT[key] for key in ("time", "flux", "time_unit")}, "wavelength"),
    "errors of a light curve": (lambda: [hdu_of(light_curve(f=np.tile(FLUX[:, None], 3)))], SHORT, "error"),
    "arrays of different length": (lambda: [fits.BinTableHDU.from_columns([
        fits.Column("t", "D", array=TIME), fits.Column("f", "PD()", array=np.array(
            [np.ones(3 + k % 2) for k in range(N)], object))])], {"time": "t", "flux": "f", "time_unit": "s"}, "f"),
}  # fmt: skip


@pytest.mark.parametrize("name", EXTENSIONS)
def test_odd_extensions_give_the_truth_or_an_error(name: str, tmp_path: Path) -> None:
    make, how, expected = EXTENSIONS[name]
    fits.HDUList([fits.PrimaryHDU(), *make()]).writeto(tmp_path / "a.fits")
    judge(tmp_path / "a.fits", None if how is None else FrameMapping(**how), expected)


def test_a_flipped_bit_is_noticed_by_the_checksum(tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    fits.HDUList([fits.PrimaryHDU(), hdu_of(light_curve())]).writeto(path, checksum=True)
    judge(path, FrameMapping(**SHORT), kept())
    content = bytearray(path.read_bytes())
    content[-2000] ^= 1
    path.write_bytes(content)
    judge(path, FrameMapping(**SHORT), "DATASUM")


SPECTRA = Truth.of(n=30, n_pixel=5)


def same_spectra(frames: Frames) -> None:
    """Check that frames are the spectra."""
    SPECTRA.compare(frames)


def changed(**values: Any) -> Truth:
    """Return spectra with other values."""
    return Truth(**(vars(SPECTRA) | values))


def waves(values: Any) -> Truth:
    """Return spectra with other wavelengths."""
    return changed(wavelength_nm=np.asarray(values, np.float64))


def image(change: Callable[[fits.HDUList], None]) -> Callable[[Path], tuple[Path, FrameMapping]]:
    """Return a writer of FITS images that are changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS["FITS images, wavelengths in the header"](SPECTRA, folder)
        with fits.open(path, mode="update") as hdus:
            change(hdus)
        return path, mapping

    return write


def spoilt_folder(change: Callable[[Path], None], layout: str = "folder of texts") -> Any:
    """Return a writer of a folder of spectra in which something is changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS[layout](SPECTRA, folder)
        change(path)
        return path, mapping

    return write


def replaced(path: Path, old: str, new: str) -> None:
    """Change the text of a file."""
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))


def layout(name: str, truth: Truth = SPECTRA, **change: Any) -> Any:
    """Return a writer of a layout with a changed mapping."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS[name](truth, folder)
        return path, FrameMapping(**(mapping.model_dump(exclude_defaults=True) | change))

    return write


def long_rows(change: Callable[[Table], Table]) -> Any:
    """Return a writer of a long table that is changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS["long ECSV"](SPECTRA, folder)
        change(Table.read(path)).write(path, overwrite=True)
        return path, mapping

    return write


def first_frame(flag: int) -> Callable[[Table], Table]:
    """Return a function that flags a pixel of the first frame."""

    def change(table: Table) -> Table:
        table["QUAL"][(table["T"] == table["T"].min()) & (table["W"] < 2600)] = flag
        return table

    return change


def one_pixel_flagged(frames: Frames) -> None:
    """Check that a flagged pixel takes its frame out of the search, and no other value changes."""
    assert np.flatnonzero(frames.faults).tolist() == [0, 7]
    assert np.isnan(frames.flux[0, 0])
    assert np.isfinite(frames.flux[0, 1:]).all()


def transpose(hdus: fits.HDUList) -> None:
    """Exchange the axes of the images."""
    for name in ("FLUX", "ERR"):
        hdus[name].data = hdus[name].data.T.copy()


def keyword(key: str, value: Any) -> Callable[[fits.HDUList], None]:
    """Return a function that sets a keyword of the image, or removes it."""

    def change(hdus: fits.HDUList) -> None:
        if value is None:
            del hdus["FLUX"].header[key]
        else:
            hdus["FLUX"].header[key] = value

    return change


FOLDER, IMAGES = "folder of texts", "folder of FITS images with a table"
#: Odd spectra: a writer of files with their mapping, and what is expected.
ODD_SPECTRA: dict[str, tuple[Callable[[Path], tuple[Path, FrameMapping]], Expected]] = {
    "image plain": (image(lambda _: None), same_spectra),
    "image transposed": (image(transpose), "FLUX"),
    "image in a cube": (image(lambda hdus: setattr(hdus["FLUX"], "data", hdus["FLUX"].data[None])), "FLUX"),
    "image without CRVAL1": (image(keyword("CRVAL1", None)), "CRVAL1"),
    "image without a step": (image(keyword("CDELT1", None)), "CRVAL1"),
    "image of unknown coordinates": (image(keyword("CTYPE1", "VELO-LSR")), "CTYPE1"),
    "image in an unknown unit": (image(keyword("CUNIT1", "cubit")), "wavelength_unit"),
    "image of frequencies": (image(keyword("CUNIT1", "GHz")), lambda frames: None),
    "image with one frame less": (image(lambda hdus: setattr(hdus["FLUX"], "data", hdus["FLUX"].data[:-1])), "FLUX"),
    "errors of another shape": (image(lambda hdus: setattr(hdus["ERR"], "data", hdus["ERR"].data[:, :-1])), "error"),
    "wavelengths of a table by wcs": (layout("FITS table, row per frame", wavelength="wcs"), "flux"),
    "wavelengths too few": (layout("FITS images, wavelengths in an extension", waves(SPECTRA.wavelength_nm[:4])),
                            "wavelength"),
    "wavelengths too many": (layout("FITS images, wavelengths in an extension", waves(np.arange(9) + 300)),
                             "wavelength"),
    "a wavelength is nan": (layout("FITS images, wavelengths in an extension", waves([300, np.nan, 320, 330, 340])),
                            "wavelength"),
    "a wavelength is negative": (layout("FITS table, row per frame", waves([-300, 310, 320, 330, 340])), "wavelength"),
    "a wavelength is zero": (layout("FITS table, row per frame", waves([0, 310, 320, 330, 340])), "wavelength"),
    "no file of wavelengths": (layout("FITS images, wavelengths in a file", wavelength_file="none.txt"), "file"),
    "two columns of wavelengths": (layout("FITS images, wavelengths in a file", wavelength="x"), "column"),
    "an unknown unit of wavelength": (layout("long CSV", wavelength_unit="ell"), "wavelength_unit"),
    "no unit of wavelength": (layout("long CSV", wavelength_unit=None), "wavelength_unit"),
    "no unit of exposure": (layout("long CSV", exposure_unit=None), "exposure_unit"),
    "no unit of temperature": (layout("long CSV", temperature_unit=None), "temperature_unit"),
    "an extension that is not there": (layout("FITS images, wavelengths in an extension", wavelength="W"), "column"),
    "every pixel is nan": (layout("long FITS", changed(flux=SPECTRA.flux * np.nan)), "flux"),
    "a frame is nan": (layout("long FITS", changed(flux=np.where(np.arange(30)[:, None] == 3, np.nan, SPECTRA.flux))),
                       lambda frames: np.testing.assert_array_equal(np.flatnonzero(frames.faults), [3, 7])),
    "a row of a long table is missing": (long_rows(lambda table: table[1:]), "wavelength"),
    "a row of a long table is double": (long_rows(lambda table: table[np.r_[0, 0 : len(table)]]), "wavelength"),
    "a pixel is flagged": (long_rows(first_frame(4)), one_pixel_flagged),
    "exposure changes in a frame": (long_rows(lambda table: _with(table, "EXPT", 3, 5.0)), "EXPT"),
    "temperature changes in a frame": (long_rows(lambda table: _with(table, "TEMP", 3, 5.0)), "TEMP"),
    "no number in a name": (layout("wide CSV", flux="*T*", error=None), "wavelength"),
    "a pattern without a column": (layout("wide CSV", flux="G_*"), "column"),
    "wide without errors": (layout("wide CSV", error="G_*"), "column"),
    "an empty folder": (spoilt_folder(lambda path: [one.unlink() for one in path.iterdir()] and None), "files"),
    "a pattern without a file": (layout(FOLDER, files="*.dat"), "files"),
    "other files in a folder": (spoilt_folder(lambda path: (path / "notes.txt").write_text("clouds") and None),
                                same_spectra),
    "a file without the keyword": (spoilt_folder(lambda path: replaced(path / "003.csv", "# T =", "# U =")), "T"),
    "no file with the keyword": (layout(FOLDER, time="MJD"), "column"),
    "a file with a pixel less": (spoilt_folder(lambda path: (path / "004.csv").write_text(
        "\n".join((path / "004.csv").read_text().splitlines()[:-1]))), "W"),
    "a file with another wavelength": (spoilt_folder(lambda path: replaced(path / "004.csv", "2505,", "2506,")),
                                       "wavelength"),
    "an empty file": (spoilt_folder(lambda path: (path / "005.csv").write_text("") and None), "file"),
    "a file of words": (spoilt_folder(lambda path: replaced(path / "005.csv", "2505,", "2505,x")), "FLUX"),
    "a time of words": (spoilt_folder(lambda path: replaced(path / "005.csv", "# T = ", "# T = x")), "T"),
    "no table of files": (layout(IMAGES, table="none.csv"), "file"),
    "no column of files": (layout(IMAGES, files="spectrum"), "column"),
    "a listed file is missing": (spoilt_folder(lambda path: (path / "004.fits").unlink(), IMAGES), "file"),
    "a listed file is cut short": (spoilt_folder(lambda path: (path / "004.fits").write_bytes(
        (path / "004.fits").read_bytes()[:3000]) and None, IMAGES), "file"),
    "a spectrum with other coordinates": (spoilt_folder(lambda path: _shift(path / "004.fits"), IMAGES), "wavelength"),
}  # fmt: skip


def _with(table: Table, name: str, row: int, value: float) -> Table:
    table[name][row] = value
    return table


def _shift(path: Path) -> None:
    with fits.open(path, mode="update") as hdus:
        hdus["FLUX"].header["CRVAL1"] += 5.0


@pytest.mark.parametrize("name", ODD_SPECTRA)
def test_odd_spectra_give_the_truth_or_an_error(name: str, tmp_path: Path) -> None:
    write, expected = ODD_SPECTRA[name]
    judge(*write(tmp_path), expected)


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + b"\0" * 500])
def test_damaged_hdf5_files_raise(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(content)
    judge(tmp_path / "a.h5", None, "file")


def test_folders_without_a_store_raise(tmp_path: Path) -> None:
    judge(tmp_path, None, "mapping")
    (tmp_path / "zarr.json").write_text("{")
    judge(tmp_path, None, "file")
    (tmp_path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    judge(tmp_path, None, "file")
    judge(tmp_path / "none", None, "file")


@pytest.mark.parametrize("name", ["no flux column", "one row", "time in parsec"])
def test_command_ends_with_a_message(name: str, tmp_path: Path) -> None:
    columns, change, _ = TABLES[name]
    path = table_file(columns, tmp_path, "csv")
    lines = [f"{key} = {value!r}".replace("'", '"') for key, value in (HOW | change).items()]
    (tmp_path / "m.toml").write_text("\n".join(lines))
    done = run("analyse", path, "--mapping", tmp_path / "m.toml", "--output", "out", folder=tmp_path, code=2)
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(("mauvecl: file 'a.csv'", "mauvecl: a:")), line
    assert not (tmp_path / "out").exists()
