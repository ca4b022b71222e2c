"""Spectra as text: two columns among others, with or without names and units."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.bounded import shortened
from .columns import Columns, chosen, listed, numbers, plain, row_of, step_among
from .units import stated_units

#: Units of a text file without a word about them: the paper's rule.
USUAL = ("nm", "erg / (s cm2 Angstrom)")
#: Gaia DR3's sampled mean spectra: 343 fluxes at 336 + 2 i nm (documentation of gaiadr3.xp_sampled_mean_spectrum).
GAIA_START_NM, GAIA_STEP_NM, GAIA_POINTS = 336.0, 2.0, 343
GAIA_FLUX = "W m-2 nm-1"
_REMARK = re.compile(r"^\s*(#|%|!|;|//|\\|\|)")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eEdD][+-]?\d+)?")
_MISSING = {"", "--", "-", "null", "none", "indef", "n/a", "na", "...", "masked"}


def text_of(content: bytes) -> str:
    """Text from bytes.

    Raises
    ------
    InputError
        If they are none.
    """
    # Editors on Windows start a file with a byte-order mark.
    code = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(code)
    except UnicodeDecodeError as error:
        if b"\0" in content[:4096]:
            raise InputError("is not text (it holds null bytes), expected two columns of numbers") from error
        line = content[: error.start].count(b"\n") + 1
        raise InputError(
            f"is not text in UTF-8 (byte 0x{content[error.start]:02x} in line {line}), expected UTF-8: save it so"
        ) from error
    if "\0" in text:
        raise InputError("is not text (it holds null bytes), expected two columns of numbers")
    return text


def read_text(text: str, name: str, origin: str, asked: Sequence[str], wavelength: bool, flux: bool) -> Columns:
    """Two columns of a text file.

    Parameters
    ----------
    text, name, origin : str
    asked : sequence of str
        Names or numbers of columns that the user gave.
    wavelength, flux : bool
        Whether the units of wavelength and flux are to be found in the header.

    Raises
    ------
    InputError
        If there are no two such columns; it names the line.
    """
    header, lines = _divided(text.splitlines())
    if not lines:
        raise InputError("holds no numbers, expected two columns: wavelength and flux")
    split, told = _splitter([line for _, line in lines])
    first = split(lines[0][1])
    names, units = _named(header, len(first), split)
    if any(cell.strip()[:1] in ("(", "[") for cell in first):
        return _from_arrays(names, [split(line) for _, line in lines], name, origin, asked, header)
    wave, value = _places(names, len(first), asked, told)
    values = np.array([_row(split(line), wave, value, number, line) for number, line in lines])
    words = "\n".join(header)
    stated: list[str | None] = [None, None]
    for source in (_own_units(names, units, wave, value), words):
        more = stated_units(source, wavelength=wavelength and not stated[0], flux=flux and not stated[1])
        stated = [old or new for old, new in zip(stated, more, strict=True)]
    return Columns(
        numbers(values[:, 0], "wavelength"),
        numbers(values[:, 1], "flux"),
        name,
        origin,
        stated[0],
        stated[1],
        USUAL,
        names[wave] if names else "1",
        names[value] if names else "2",
        words,
        told=tuple(told),
    )


def _divided(lines: list[str]) -> tuple[list[str], list[tuple[int, str]]]:
    """The header, with all remarks, and the numbered lines of data."""
    header: list[str] = []
    data: list[tuple[int, str]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        if _REMARK.match(line) and not (line.lstrip()[0] == "|" and data):
            header.append(line.strip().lstrip("#%!;/\\| "))
            continue
        kept = line.split("#", 1)[0].strip()
        if not data and not _starts_with_number(kept):
            header.append(kept)
            continue
        data.append((number, kept))
    return header, data


def _starts_with_number(line: str) -> bool:
    cell = re.split(r"[\s;|]+|,\s|,(?=[^\d])", line.strip().strip("|").strip())[0].strip("\"'(")
    return bool(re.match(r"[+-]?(\d|\.\d)", cell)) or cell.lower() in ("nan", "inf", "-inf")


def _splitter(lines: list[str]) -> tuple[Any, list[str]]:
    """How lines are divided into cells; decimal commas become points, which is told."""
    sample = lines[:50] + lines[-5:]
    told: list[str] = []
    commas = any("," in line for line in sample)
    points = any("." in line for line in sample)
    for mark in (";", "\t", "|"):
        if all(mark in line for line in sample):
            decimal = commas and not points
            if decimal:
                told.append("its decimal commas are read as points")
            return partial(_cells, mark=mark, decimal=decimal), told
    if any('"' in line for line in sample):
        return (lambda line: next(csv.reader([line], skipinitialspace=True))), told
    if not commas:
        return str.split, told
    blanks = [line.split() for line in sample]
    if all(len(cells) > 1 for cells in blanks) and not any(c.endswith(",") for cells in blanks for c in cells[:-1]):
        if points or not all(_DECIMAL_COMMA.fullmatch(c) or "," not in c for cells in blanks for c in cells):
            raise InputError(
                f"line {shortened(sample[0], 60)} mixes commas, points and blanks, expected decimal points and one "
                "kind of mark between columns"
            )
        told.append("its decimal commas are read as points")
        return partial(_cells, mark=None, decimal=True), told
    cells = [line.split(",") for line in sample]
    if not points and all(len(row) > 1 and re.fullmatch(r"\s*\d+\s*", row[1]) for row in cells) and len(cells) > 1:
        raise InputError(f"line {shortened(sample[0], 60)} may hold decimal commas or columns, expected decimal points")
    return (
        lambda line: line.replace(",", " , ").split(" , ") if ",," in line else re.split(r"\s*,\s*|\s+", line)
    ), told


def _cells(line: str, mark: str | None, decimal: bool) -> list[str]:
    cells = (line.strip("|") if mark == "|" else line).split(mark)
    return [cell.strip().replace(",", ".") if decimal else cell.strip() for cell in cells]


def _named(header: list[str], n: int, split: Any) -> tuple[list[str], list[str]]:
    """Names of the columns, and the units that stand under them, where the header has them."""
    rows = []
    for line in header:
        for how in (split, str.split, lambda text: text.split(",")):
            cells = [cell.strip().strip("\"'") for cell in how(line)]
            if len(cells) == n and all(cells):
                rows.append(cells)
                break
    for k, cells in enumerate(rows):
        try:
            chosen(cells, ())
        except InputError as error:
            if "may be" not in str(error):
                continue
        return cells, rows[k + 1] if k + 1 < len(rows) else []
    return [], []


def _places(names: list[str], n: int, asked: Sequence[str], told: list[str]) -> tuple[int, int]:
    if n < 2:
        return 0, 1
    if names:
        return chosen(names, asked)
    if asked:
        places = [int(one) - 1 for one in asked if one.isascii() and one.isdigit() and 1 <= int(one[:6]) <= n]
        if len(places) != len(asked) or len(places) > 2:
            raise InputError(f"columns {listed(asked)} of {n} without names, expected their numbers, 1 to {n}")
        return (places[0], places[1]) if len(places) == 2 else (0, places[0])
    if n > 2:
        told.append(f"the first two of its {n} columns are taken, which have no names")
    return 0, 1


def _row(cells: list[str], wave: int, value: int, number: int, line: str) -> tuple[float, float]:
    if len(cells) <= max(wave, value):
        what = "one column" if len(cells) == 1 else f"{len(cells)} columns"
        raise InputError(f"line {number}: {shortened(line, 60)} has {what}, expected wavelength and flux")
    try:
        return _number(cells[wave]), _number(cells[value])
    except ValueError as error:
        raise InputError(
            f"line {number}: {shortened(line, 60)} is not numeric, expected wavelength and flux"
        ) from error


def _number(cell: str) -> float:
    cell = cell.strip().strip("\"'")
    if "_" in cell:
        raise ValueError(cell)
    try:
        return float(cell)
    except ValueError:
        if cell.lower() in _MISSING:
            return float("nan")
        # Fortran's double precision.
        return float(re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", cell))


def _own_units(names: list[str], units: list[str], wave: int, value: int) -> str:
    """The chosen columns' names, and units under them, as if they were all of the header."""
    if not names:
        return ""
    below = (units[wave], units[value]) if units else ("", "")
    return f"wavelength {names[wave]} ({below[0]})\nflux {names[value]} ({below[1]})"


def _from_arrays(
    names: list[str], rows: list[list[str]], name: str, origin: str, asked: Sequence[str], header: list[str]
) -> Columns:
    """A row whose cells hold arrays: Gaia's sampled spectra, and such."""
    if not names:
        # Gaia's has no column of wavelengths.
        names = next((cells for line in header if len(cells := line.split(",")) == len(rows[0])), [])
    if not names:
        raise InputError("holds arrays in its cells and no names of columns, expected names in its first line")
    rows, asked = row_asked(rows, asked)
    by_name = dict(zip([plain(one) for one in names], rows[0], strict=False))
    flux = _array(by_name.get("flux", ""))
    if "source_id" in by_name and "wavelength" not in by_name and flux.size == GAIA_POINTS:
        wavelength = GAIA_START_NM + GAIA_STEP_NM * np.arange(GAIA_POINTS, dtype=np.float64)
        return Columns(
            wavelength,
            flux,
            f"Gaia DR3 {by_name['source_id'].strip()[:30]}",
            f"{origin}, Gaia DR3 sampled XP spectrum",
            "nm",
            GAIA_FLUX,
            notes=("wavelengths 336 + 2 i nm, W m-2 nm-1: Gaia DR3's documentation",),
        )
    wave, value = chosen(names, asked)
    step = step_among(names)
    columns = row_of(
        _array(rows[0][wave]), _array(rows[0][value]), None if step is None else _array(rows[0][step]), "its row"
    )
    units = stated_units(_own_units(names, [], wave, value))
    return Columns(columns[0], columns[1], name, origin, *units, USUAL, names[wave], names[value], "\n".join(header))


def row_asked(rows: Sequence[Any], asked: Sequence[str]) -> tuple[list[Any], list[str]]:
    """The one row that is meant, and what else is asked for; a row is named by any of its short cells.

    Raises
    ------
    InputError
        If several rows remain.
    """
    left = list(asked)
    fitting = list(rows)
    for one in asked:
        fits = [row for row in rows if any(str(cell).strip() == one for cell in row if np.size(cell) == 1)]
        if fits:
            fitting = fits
            left.remove(one)
            break
    if len(fitting) != 1:
        labels = [next((str(c).strip()[:30] for c in row if np.size(c) == 1 and str(c).strip()), "") for row in fitting]
        raise InputError(
            f"{len(fitting)} spectra stand in it, one a row ({listed(labels)}), expected one: name it as in "
            f"FILE[{labels[0]}]"
        )
    return fitting, left


def _array(cell: str) -> Any:
    try:
        return np.array([_number(one) for one in cell.strip().strip("()[]").split(",")])
    except ValueError as error:
        raise InputError(f"cell {shortened(cell, 40)} is not numeric, expected an array of numbers") from error
