"""Read a spectrum from the files that users bring: what they are is seen from their content, not from their names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..files.bounded import read_bytes, shortened, unpacked

if TYPE_CHECKING:
    import astropy.units as u

    from .columns import Columns, ReadSpectrum


def without_columns(path: str | Path) -> tuple[Path, tuple[str, ...]]:
    """A file, and the columns named behind it in brackets, as in ``grid.fits[g45]``.

    A file whose own name ends so is that file.
    """
    text = str(path)
    match = re.fullmatch(r"(?s)(.+?)\[([^\[\]]*)\]", text)
    if match is None or Path(text).is_file():
        return Path(text), ()
    return Path(match[1]), tuple(one.strip() for one in match[2].split(",") if one.strip())


def read_spectrum(
    path: Path, *, wavelength_unit: str | u.UnitBase | None = None, flux_unit: str | u.UnitBase | None = None
) -> ReadSpectrum:
    """Read text, ECSV, VOTable or FITS, packed by gzip, bzip2 or xz or not.

    Parameters
    ----------
    path : Path
        May end in columns, ``grid.fits[g45]``, where several fit; or in an extension or a row likewise. Text without a
        stated unit is in nm and erg s-1 cm-2 A-1 (the paper's rule), FITS in Angstrom and erg s-1 cm-2 A-1, which
        `ReadSpectrum.told` says; ECSV and VOTable must name their units.
    wavelength_unit, flux_unit : str or Unit, optional
        Stand above what the file states; a wavelength's may end in " air" or " vacuum".

    Raises
    ------
    InputError
        If there is no such file, or it holds no spectrum, or several.
    """
    import numpy as np

    from .columns import spectrum_of

    try:
        place, asked = without_columns(path)
    except (OSError, ValueError):
        # Names that are none: `read_bytes` says what is wrong.
        place, asked = Path(path), ()
    content = read_bytes(place, "spectrum file")
    shown = place.name if len(place.name) <= 80 else shortened(place.name)
    try:
        columns = _columns(
            unpacked(content, "it"), _stem(place.name), f"file {shown}", asked, wavelength_unit, flux_unit
        )
        # Numbers beyond floats end in a sentence where points are checked.
        with np.errstate(all="ignore"):
            return spectrum_of(columns, wavelength_unit, flux_unit)
    except InputError as error:
        raise InputError(f"{shown}: {error}") from error


def _stem(name: str) -> str:
    return (
        re.sub(r"(\.(gz|bz2|xz))?$", "", re.sub(r"\.(gz|bz2|xz)$", "", name, flags=re.I)).rsplit(".", 1)[0][:80] or name
    )


def _columns(
    content: bytes, name: str, origin: str, asked: tuple[str, ...], wavelength_unit: object, flux_unit: object
) -> Columns:
    from .fits_files import read_fits
    from .tables import read_ecsv, read_votable
    from .text import read_text, text_of

    if content[:9] == b"SIMPLE  =":
        return read_fits(content, name, origin, asked)
    start = content[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if re.match(rb"<(\?xml|votable|vot:)", start, re.IGNORECASE) and b"VOTABLE" in content[:4096].upper():
        return read_votable(content, name, origin, asked)
    if start[:1] == b"<":
        raise InputError(
            f"is a page or XML that begins with {shortened(start[:20].decode('ascii', 'replace'))}, expected a spectrum"
        )
    text = text_of(content)
    if re.match(r"#\s*%ECSV", text):
        return read_ecsv(text, name, origin, asked)
    return read_text(text, name, f"text {origin}", asked, wavelength_unit is None, flux_unit is None)
