"""The user's own stars, which supplement the embedded library.

Each star is an ECSV file in the user's data folder, with its origin and the digest of its spectrum, which is verified
at every reading.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError

from ..tables.ecsv import read_ecsv

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table


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
    if spectrum_digest(wavelength, flux) != table.meta["spectrum_sha256"]:
        raise InputError(
            f"kept star {star.name!r} was changed after it was kept (its digest differs)",
            "the unchanged file: add or fetch it again",
            key="name",
            value=star.name,
        )
    return wavelength, flux


def spectrum_digest(wavelength: np.ndarray, flux: np.ndarray) -> str:
    """Return the SHA-256 of wavelengths and fluxes, in hexadecimal."""
    return hashlib.sha256(wavelength.tobytes() + flux.tobytes()).hexdigest()


def remove(name: str) -> None:
    """Delete a kept star; raises InputError for an unknown name."""
    wanted = name.strip().casefold()
    paths = sorted(folder().glob("*.ecsv"))
    # A damaged file has no name but that of the file.
    stem = re.sub(r"[^a-z0-9.+-]", "_", wanted)
    found = [path for path in paths if _named(path) == wanted] or [
        path for path in paths if path.stem.casefold() == stem and _named(path) is None
    ]
    if found:
        found[0].unlink()
        return
    names = ", ".join(star.name for star in kept()) or "no star is kept"
    raise InputError.of("name", name, f"one of: {names}")


def _named(path: Path) -> str | None:
    try:
        described = _described(path)
    except InputError:
        return None
    return None if described is None else described.name.casefold()
