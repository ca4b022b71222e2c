"""Reader of spectra in any supported file format, which is recognised by content instead of name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.host.files.parsing import parsing
from mauvecl.host.files.size_limits import read_bytes, unpacked
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

if TYPE_CHECKING:
    import astropy.units as u

    from mauvecl.host.spectra.conversion import ReadSpectrum
    from mauvecl.host.spectra.spectrum_table import SpectrumTable
    from mauvecl.host.tables.table import MemoryTable

#: Largest number and length of messages in the table of a kept star, and length of the remarks on columns.
MAX_NOTES, MAX_NOTE_LENGTH, MAX_REMARKS = 20, 400, 20_000


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

    from mauvecl.host.spectra.conversion import converted
    from mauvecl.host.spectra.selection import spectrum_in

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
) -> list[SpectrumTable]:
    from mauvecl.host.spectra.fits_files import fits_tables
    from mauvecl.host.spectra.text import table_of_text
    from mauvecl.host.tables.ecsv import parse_ecsv
    from mauvecl.host.tables.opening import check_no_page, form_of, votables
    from mauvecl.host.tables.table import MemoryTable
    from mauvecl.host.tables.text_table import text_of

    form = form_of(content[:4096])
    if form == "FITS":
        return fits_tables(content, name, origin, asked, check)
    if form == "VOTable":
        tables = enumerate(votables(content, "it", "a spectrum"), 1)
        return [_in_memory(one, name, origin, str(one.header.get("name") or one.header.get("ID") or number))
                for number, one in tables]  # fmt: skip
    check_no_page(content, form, "it", "a spectrum")
    text = text_of(content)
    if form == "ECSV":
        table = MemoryTable(parse_ecsv(text, "it"), "it")
        own = table.header.get("name")
        return [_in_memory(table, own.strip()[:80] if isinstance(own, str) and own.strip() else name, origin)]
    return [table_of_text(text, name, f"text {origin}", asked, *units)]


def _in_memory(file: MemoryTable, name: str, origin: str, label: str = "") -> SpectrumTable:
    """Return the table of an ECSV file or a VOTable."""
    from mauvecl.host.spectra.spectrum_table import SpectrumTable
    from mauvecl.host.tables.medium import medium_of

    columns = [file.find(one) for one in file.names]
    said = [f"{one.ucd} {one.description}" for one in columns]
    return SpectrumTable(
        columns, name, origin, label, remarks="\n".join((*_texts(file.header.get("comments")), *said))[:MAX_REMARKS],
        medium=partial(medium_of, file.header), messages=_texts(file.header.get("told")),
    )  # fmt: skip


def _texts(given: Any) -> tuple[str, ...]:
    """Return the short texts of a list; an empty tuple for anything else."""
    if not isinstance(given, list):
        return ()
    return tuple(one for one in given[:MAX_NOTES] if isinstance(one, str) and len(one) <= MAX_NOTE_LENGTH)
