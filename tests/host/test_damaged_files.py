"""Damaged headers, other libraries' exceptions, and suggestions that can be typed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from mauvecl.host.files.parsing import parsing
from mauvecl.host.spectra.column_choice import as_typed
from mauvecl.host.spectra.formats import read_spectrum
from mauvecl.schema.errors import InputError

NM = np.linspace(200.0, 1100.0, 100)


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
