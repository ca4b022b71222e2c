"""Reader of spectra in any supported file format, which is recognised by content instead of name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import parsing
from ..files.size_limits import read_bytes, unpacked

if TYPE_CHECKING:
    import astropy.units as u

    from .conversion import ReadSpectrum
    from .file_table import FileTable


def without_columns(path: str | Path) -> tuple[Path, tuple[str, ...]]:
    """Divide ``grid.fits[g45]`` into the file and the words in brackets, which select a part of it.

    If a file of this full name exists, it is returned.
    """
    text = str(path)
    match = re.fullmatch(r"(?s)(.+?)\[([^\[\]]*)\]", text)
    if match is None or Path(text).is_file():
        return Path(text), ()
    return Path(match[1]), tuple(one.strip() for one in match[2].split(",") if one.strip())


def read_spectrum(
    path: Path,
    *,
    wavelength_unit: str | u.UnitBase | None = None,
    flux_unit: str | u.UnitBase | None = None,
    ignore_checksum: bool = False,
) -> ReadSpectrum:
    """Read a spectrum from text, ECSV, VOTable or FITS, which may be compressed by gzip, bzip2 or xz.

    Parameters
    ----------
    path : Path
        May end in words that select one of several spectra: a column, ``grid.fits[g45]``, two columns, an extension,
        the identifier of a row, or ``row 3``. Text without stated units is in nm and erg s-1 cm-2 A-1 (the paper's
        rule), FITS in Angstrom and erg s-1 cm-2 A-1, which `ReadSpectrum.messages` reports. ECSV and VOTable must
        state their units.
    wavelength_unit, flux_unit : str or Unit, optional
        Units that override those of the file; a unit of wavelength may end in " air" or " vacuum".
    ignore_checksum : bool
        Whether a FITS file is read that its CHECKSUM or DATASUM contradicts.
    """
    import numpy as np

    from .conversion import converted
    from .selection import spectrum_in

    try:
        place, asked = without_columns(path)
    except (OSError, ValueError):
        # `read_bytes` reports what is wrong with the name.
        place, asked = Path(path), ()
    content = read_bytes(place, "spectrum file")
    shown = place.name if len(place.name) <= 80 else shortened(place.name)
    try:
        units = (wavelength_unit is None, flux_unit is None)
        with parsing("it", "a spectrum"):
            content, origin = unpacked(content, "it"), f"file {shown}"
            tables = _tables(content, _stem(place.name), origin, asked, units, not ignore_checksum)
        # Overflows become infinities, which the check of points rejects.
        with parsing("it", "a spectrum"), np.errstate(all="ignore"):
            return converted(spectrum_in(tables, asked), wavelength_unit, flux_unit)
    except InputError as error:
        raise error.within(shown) from error


def _stem(name: str) -> str:
    """Return a file's name without the extensions of compression and format."""
    return re.sub(r"\.(gz|bz2|xz)$", "", name, flags=re.I).rsplit(".", 1)[0][:80] or name


def _tables(
    content: bytes, name: str, origin: str, asked: Sequence[str], units: tuple[bool, bool], check: bool
) -> list[FileTable]:
    from ..tables.opening import form_of
    from ..tables.text_table import text_of
    from .fits_files import fits_tables
    from .table_files import ecsv_tables, votable_tables
    from .text import text_tables

    form = form_of(content[:4096])
    if form == "FITS":
        return fits_tables(content, name, origin, asked, check)
    if form == "VOTable":
        return votable_tables(content, name, origin)
    if form == "XML":
        start = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")[:20]
        raise InputError(
            f"is a page or XML that begins with {shortened(start.decode('ascii', 'replace'))}",
            "a spectrum", key="file", value=start,
        )  # fmt: skip
    text = text_of(content)
    if form == "ECSV":
        return ecsv_tables(text, name, origin)
    return text_tables(text, name, f"text {origin}", asked, *units)
