"""Damaged headers, other libraries' exceptions, and suggestions that can be typed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from refusals import refused

from mauvecl.host.files.parsing import parsing
from mauvecl.host.spectra.column_choice import as_typed
from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.observations.frames import Reason
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import read_frames
from mauvecl.schema.errors import InputError

NM = np.linspace(200.0, 1100.0, 100)
N = 40
HOW = FrameMapping(time="T", time_unit="s", flux="F", flux_unit="adu/s", quality="Q")


def spectrum(path: Path) -> None:
    table = Table({"WAVELENGTH": NM * 10, "FLUX": np.ones(NM.size)})
    table["WAVELENGTH"].unit, table["FLUX"].unit = "Angstrom", "erg / (s cm2 Angstrom)"
    table.write(path)


def frames(path: Path, quality: Any = None, **how: Any) -> None:
    columns = [fits.Column("T", "D", array=np.arange(N) * 20.0), fits.Column("F", "D", array=1e3 + np.arange(N) % 7)]
    columns.append(fits.Column("Q", **({"format": "J", "array": np.zeros(N)} | how)))
    fits.BinTableHDU.from_columns(columns).writeto(path)


def second_primary(content: bytes) -> bytes:
    """Repeat the primary header before the extension."""
    return content[:2880] + content


def no_standard(content: bytes) -> bytes:
    """Say that the file does not conform to FITS."""
    return content.replace(b"SIMPLE  =                    T", b"SIMPLE  =                    F", 1)


@pytest.mark.parametrize("damage", [second_primary, no_standard])
@pytest.mark.parametrize("kind", ["spectrum", "frames"])
def test_damaged_extension_headers_are_refused(damage: Any, kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    (spectrum if kind == "spectrum" else frames)(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=r"damaged header in extension \d|cannot be read") as error:
        read_spectrum(path) if kind == "spectrum" else read_frames(path, HOW)
    assert "HDU" not in str(error.value)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("'NoneType' object has no attribute 'ndim'"), "x cannot be read, expected y"),
        (KeyError("sequence item 0: expected str"), "x cannot be read, expected y"),
        (ValueError("Number of columns (2) in line 13, column 4"), "x cannot be read (line 13, column 4), expected y"),
        (RecursionError("maximum depth"), "x is nested too deeply, expected y"),
        (OSError(5, "filter returned failure"), "x cannot be read, expected y"),
        (SystemError(""), "x cannot be read, expected y"),
    ],
)  # fmt: skip
def test_messages_hold_no_text_of_another_library(error: Exception, said: str) -> None:
    with pytest.raises(InputError) as caught, parsing("x", "y"):
        raise error
    assert str(caught.value) == said
    assert caught.value.__cause__ is error


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a, b", "FILE[row 2]"), ("a[1]", "FILE[row 2]"), ('"q"', "FILE[row 2]"), (" ", "FILE[row 2]"),
        ("x" * 41, "FILE[row 2]"), ("two words", "FILE[two words]"), ("twice", "FILE[row 2]"),
    ],
)  # fmt: skip
def test_suggested_part_can_be_typed(name: str, said: str) -> None:
    assert as_typed(name, "row", 1, ["twice", "twice", "two words"]) == said


def rows_named(names: list[str]) -> Any:
    """Return a writer of a table with a spectrum in each row, named by a column."""

    def write(path: Path) -> None:
        flux = np.ones((len(names), NM.size)) * np.arange(1, len(names) + 1)[:, None]
        table = Table({"name": names, "wavelength": np.tile(NM, (len(names), 1)), "flux": flux})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        table.write(path)

    return write


def tables_named(names: list[str]) -> Any:
    """Return a writer of several tables."""

    def write(path: Path) -> None:
        table = Table({"wavelength": NM, "flux": np.ones(NM.size)})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        hdus = [fits.BinTableHDU(table, name=name) for name in names]
        fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)

    return write


@pytest.mark.parametrize(
    "write",
    [
        rows_named(["a, b", "c"]),
        rows_named(["GJ 65 [A]", "GJ 65 [B]"]),
        rows_named(["x" * 60, "y" * 60]),
        tables_named(["A,B", "C"]),
        tables_named(["A", "B"]),
    ],
)
def test_suggestion_of_a_message_is_accepted(write: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    write(path)
    with pytest.raises(InputError) as error:
        read_spectrum(path)
    suggested = re.search(r"FILE(\[[^\]]*\])", str(error.value))
    assert suggested is not None, error.value
    assert read_spectrum(Path(f"{path}{suggested[1]}")).flux_flam.size == NM.size


def test_bits_of_quality_flags_are_read(tmp_path: Path) -> None:
    """Give each frame sixteen flags as a bit array (FITS standard 4.0, section 7.3.3.1)."""
    bits = np.zeros((N, 16), bool)
    bits[7, 0] = bits[9, 15] = bits[11, 3] = True
    frames(tmp_path / "a.fits", format="16X", array=bits)
    read = read_frames(tmp_path / "a.fits", HOW)
    assert np.flatnonzero(read.faults == Reason.QUALITY).tolist() == [7, 9, 11]


def test_image_that_claims_other_sizes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    spectrum(path)
    content = path.read_bytes()
    for old, new in (
        (b"TFORM1  = 'D", b"TFORM1  = '9"),
        (b"TFORM2  = 'D  ", b"TFORM2  = 'PD("),
        (b"NAXIS1  =                   16", b"NAXIS1  =                    3"),
    ):
        assert old in content
        path.write_bytes(content.replace(old, new))
        with pytest.raises(InputError):
            read_spectrum(path)


@pytest.mark.parametrize(("name", "said"), [(b"          ", "TTYPE3 is empty"), (b"'T       '", "columns named 'T'")])
@pytest.mark.parametrize("kind", ["spectrum", "frames"])
def test_columns_without_a_name_of_their_own_are_refused(name: bytes, said: str, kind: str, tmp_path: Path) -> None:
    """Leave out a name, or give one twice, with which astropy cannot read the table."""
    path = tmp_path / "a.fits"
    frames(path)
    content = path.read_bytes()
    old = b"TTYPE3  = 'Q       '"
    assert old in content
    path.write_bytes(content.replace(old, b"TTYPE3  = " + name))
    with refused("columns", said):
        read_spectrum(path) if kind == "spectrum" else read_frames(path, HOW)
