"""The user's own stars, which supplement the embedded library.

Each star is an ECSV file in the user's data folder, with its origin and the digest of its spectrum, which is verified
at every reading.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError

from ..files.atomic import write_whole
from ..files.ecsv import read_ecsv
from ..files.size_limits import read_bytes
from ..spectra.formats import without_columns

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table

    from .source import Source


@dataclass(frozen=True)
class OwnStar:
    """Metadata of a kept star; fields as in `Source`."""

    name: str
    origin: str
    notes: tuple[str, ...]
    dereddened: bool
    path: Path
    messages: tuple[str, ...] = ()
    measured_nm: tuple[float, float] | None = None
    unscaled: str = ""


def folder() -> Path:
    """Return the folder of kept stars, below ``MAUVECL_DATA_DIR`` or the user's data folder."""
    import platformdirs

    given = os.environ.get("MAUVECL_DATA_DIR")
    return (Path(given) if given else platformdirs.user_data_path("mauvecl")) / "stars"


def kept() -> list[OwnStar]:
    """Return all kept stars, sorted by file name."""
    return [star for path in sorted(folder().glob("*.ecsv")) if (star := _described(path)) is not None]


def find(name: str) -> OwnStar | None:
    """Return a kept star by name in any case, or None."""
    wanted = name.strip().casefold()
    return next((star for star in kept() if star.name.casefold() == wanted), None)


def _described(path: Path) -> OwnStar | None:
    meta = _read(path).meta
    if not {"name", "origin", "spectrum_sha256"} <= set(meta):
        return None
    notes = tuple(str(note) for note in meta.get("notes", ()))
    messages = tuple(str(text) for text in meta.get("told", ()))
    measured = meta.get("measured_nm")
    return OwnStar(
        str(meta["name"]), str(meta["origin"]), notes, bool(meta.get("dereddened")), path, messages,
        None if measured is None else (float(measured[0]), float(measured[1])), str(meta.get("unscaled", "")),
    )  # fmt: skip


def _read(path: Path) -> Table:
    return read_ecsv(path, "kept star", "the file as it was kept: `mauvecl library remove` takes it away")


def spectrum(star: OwnStar) -> tuple[np.ndarray, np.ndarray]:
    """Return wavelengths, nm, and fluxes, erg s-1 cm-2 A-1; raises InputError if the file was changed."""
    import numpy as np

    table = _read(star.path)
    wavelength, flux = (np.asarray(table[name], float) for name in ("wavelength", "flux"))
    if _digest(wavelength, flux) != table.meta["spectrum_sha256"]:
        raise InputError(
            f"kept star {star.name!r} was changed after it was kept (its digest differs)",
            "the unchanged file: add or fetch it again",
            key="name",
            value=star.name,
        )
    return wavelength, flux


def _digest(wavelength: np.ndarray, flux: np.ndarray) -> str:
    return hashlib.sha256(wavelength.tobytes() + flux.tobytes()).hexdigest()


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

    from ..spectra.coverage import check_covers
    from . import catalogue
    from .source import Source

    given = path
    path, _ = without_columns(path)
    content = read_bytes(path, "spectrum file")
    source: Source = Source.read(given, wavelength_unit=wavelength_unit, flux_unit=flux_unit, extend=extend)
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
        "spectrum_sha256": _digest(source.wavelength_nm, source.flux_flam),
        "kept_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "dereddened": dereddened,
        "notes": list(source.notes),
        "told": list(source.messages),
        "unscaled": source.unscaled,
    }
    if source.measured_nm is not None:
        table.meta["measured_nm"] = list(source.measured_nm)
    place = there.path if there is not None else folder() / f"{re.sub(r'[^A-Za-z0-9.+-]', '_', name)}.ecsv"
    if there is None and place.exists():
        raise InputError(
            f"star name {name!r} is too much like another kept star's", "another name", key="name", value=name
        )
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    try:
        write_whole(place, text.getvalue().encode(), shared=True)
    except InputError as error:
        raise error.within("star folder (MAUVECL_DATA_DIR sets another)") from error
    known = find(name)
    assert known is not None
    return known


def remove(name: str) -> None:
    """Delete a kept star; raises InputError for an unknown name."""
    wanted = name.strip().casefold()
    for path in sorted(folder().glob("*.ecsv")):
        if path.stem.casefold() == re.sub(r"[^a-z0-9.+-]", "_", wanted) or _named(path) == wanted:
            path.unlink()
            return
    names = ", ".join(star.name for star in kept()) or "no star is kept"
    raise InputError.of("name", name, f"one of: {names}")


def _named(path: Path) -> str | None:
    try:
        described = _described(path)
    except InputError:
        return None
    return None if described is None else described.name.casefold()
