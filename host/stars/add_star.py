"""Addition of a star to the user's own, from a file with its spectrum."""

from __future__ import annotations

import datetime
import hashlib
import io
import re
from pathlib import Path

from mauvecl.schema.errors import InputError

from ..files.atomic import write_whole
from ..files.size_limits import read_bytes
from ..spectra.coverage import check_covers
from ..spectra.formats import without_columns
from . import catalogue
from .own_stars import OwnStar, find, folder, kept, spectrum_digest
from .source import Source


def add(
    path: str | Path,
    name: str | None = None,
    *,
    origin: str | None = None,
    replace: bool = False,
    wavelength_unit: str | None = None,
    flux_unit: str | None = None,
    extend: str | None = None,
) -> OwnStar:
    """Keep a spectrum from a file under a name.

    Parameters
    ----------
    path : str or Path
        File of any format that `formats.read_spectrum` supports.
    name : str, optional
        Name of the star. The default is that of the file's header, or the file name.
    origin : str, optional
        Origin of the spectrum, for reports. The default is the file name.
    replace : bool
        Whether to replace a kept star of the same name.
    wavelength_unit, flux_unit, extend : str, optional
        As for `Source.read`.

    Raises
    ------
    InputError
        If the file holds no usable spectrum, the name is taken or invalid, or the folder cannot be written.
    """
    from astropy.table import Table

    given = path
    path, _ = without_columns(path)
    content = read_bytes(path, "spectrum file")
    source = Source.read(given, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
    check_covers(source.name, source.measured_nm or (source.wavelength_nm[0], source.wavelength_nm[-1]))
    name = (name or source.name).strip()
    if not re.fullmatch(r"[\w][\w .+\-*'()]{0,63}", name):
        raise InputError.of("name", name, "up to 64 letters, digits, spaces and . + - * ' ( )")
    if catalogue.embedded(name) is not None:
        raise InputError(
            f"star name {name!r} is one of the embedded library's",
            "another: give one with `name`",
            key="name",
            value=name,
        )
    there = find(name)
    if there is not None and not replace:
        raise InputError(f"star {name!r} is kept already", "another name, or `replace=True`", key="name", value=name)
    dereddened = any("dereddened" in note for note in source.notes)
    table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
    table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
    table.meta |= {
        "name": name,
        "origin": origin or f"file {path.name}",
        "file_sha256": hashlib.sha256(content).hexdigest(),
        "spectrum_sha256": spectrum_digest(source.wavelength_nm, source.flux_flam),
        "kept_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "dereddened": dereddened,
        "notes": list(source.notes),
        "told": list(source.messages),
        "unscaled": source.unscaled,
    }
    if source.measured_nm is not None:
        table.meta["measured_nm"] = list(source.measured_nm)
    place = folder() / f"{re.sub(r'[^A-Za-z0-9.+-]', '_', name)}.ecsv" if there is None else there.path
    alike = re.sub(r"[\s_]+", "_", name.casefold())
    if there is None and any(re.sub(r"[\s_]+", "_", star.name.casefold()) == alike for star in kept()):
        raise InputError(
            f"star name {name!r} is too much like another kept star's", "another name", key="name", value=name
        )
    if there is None and place.exists():
        # Letters that file names cannot have, such as Greek ones, are equal in them: the digest of the name differs.
        place = place.with_stem(f"{place.stem}-{hashlib.sha256(name.casefold().encode()).hexdigest()[:8]}")
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    try:
        write_whole(place, text.getvalue().encode(), shared=True)
    except InputError as error:
        raise error.within("star folder (MAUVECL_DATA_DIR sets another)") from error
    known = find(name)
    assert known is not None
    return known
