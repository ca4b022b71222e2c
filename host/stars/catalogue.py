"""Index and tables of the embedded library."""

from __future__ import annotations

import csv
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from mauvecl.schema.tables import Column

from ..tables.ecsv import Numbers, parse_numbers
from . import own_stars
from .well_known import name_key

if TYPE_CHECKING:
    from astropy.table import Table

_LIBRARY = files("mauvecl.host.stars") / "library"


@cache
def _index() -> dict[str, dict[str, str]]:
    # Read without astropy, which keeps the error for a misspelt name fast.
    text = _LIBRARY.joinpath("index.ecsv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return {entry["name"].casefold(): entry for entry in csv.DictReader(lines, delimiter=" ")}


@cache
def _keys() -> dict[str, str]:
    """Return the key of the index entry for every normalised name and alias."""
    keys: dict[str, str] = {}
    for key, entry in _index().items():
        keys[name_key(key)] = key
        for other in (entry["alias"], entry["star"]):
            keys.setdefault(name_key(other), key)
    keys.pop("", None)
    return keys


def entries() -> list[dict[str, str]]:
    """Return the index entries of all embedded spectra."""
    return list(_index().values())


def names() -> list[str]:
    """Return the distinct names of all embedded spectra: types, aliases and stars."""
    each = [entry[column] for entry in entries() for column in ("name", "alias", "star")]
    # A collection's name in front of a type says nothing that the type does not.
    return [name for name in dict.fromkeys(each) if name and not name.startswith("Pickles ")]


def _ratios(quality: str) -> str:
    """Return the ratios of an entry on the ultraviolet: "190-210: 0.1 (S/N 5), ...; ..." gives "0.1, ..."."""
    return ", ".join(part.split()[0] for part in quality.split("; ")[0].split(": ")[1].split(", "))


#: Columns of the table of embedded spectra as people read it.
COLUMNS = (
    Column("name", heading="name"),
    Column("alias", heading="also"),
    Column("spectral_type", heading="type"),
    Column("star", heading="star"),
    Column("temperature_k", heading="K"),
    Column("uv_quality", heading="UV at 190-210, 240-260, 290-310 nm", format=_ratios),
    Column("noisy_below_nm", heading="noisy below", format=lambda below: f"{below} nm" if below else ""),
    Column("licence", heading="licence"),
)
#: Columns of that of the user's own.
OWN_COLUMNS = (
    Column("name", heading="name"),
    Column("origin", heading="origin"),
    Column("treatment", heading="notes"),
)


def library_table() -> Table:
    """Return the embedded spectra, followed by the user's own.

    Returns
    -------
    astropy.table.Table
        Columns name, alias, spectral_type, star, origin, citation, licence, treatment, uv_quality and kept. All are
        text; the last is "embedded" or "yours".
    """
    from astropy.table import Table

    table = Table.read(_LIBRARY.joinpath("index.ecsv").read_text(encoding="utf-8"), format="ascii.ecsv")
    # The reader masks empty text.
    table = table.filled("")
    table.remove_columns(["file", "source_file"])
    table["kept"] = "embedded"
    for star in own_stars.kept():
        row = dict.fromkeys(table.colnames, "") | {"name": star.name, "star": star.name, "origin": star.origin}
        row |= {"treatment": "; ".join(star.notes), "kept": "yours"}
        for name in table.colnames:
            # A column of dtype str is only as wide as its longest entry.
            table[name] = table[name].astype(object)
        table.add_row(row)
    return table


def embedded(name: str) -> dict[str, str] | None:
    """Return the index entry of an embedded spectrum by name, alias or star in any case and spacing, or None.

    A type may lack its luminosity class: "M3" is M3V.
    """
    key = name_key(name)
    found = _keys().get(key) or _keys().get(f"{key}v")
    return None if found is None else _index()[found]


@lru_cache(8)
def spectrum_table(file: str) -> Numbers:
    """Read a library spectrum with the columns wavelength (nm) and flux (erg s-1 cm-2 A-1)."""
    return _numbers("spectra", file)


def band_table(file: str) -> Numbers:
    """Read a photometric band with the columns wavelength (nm) and throughput (per photon)."""
    return _numbers("bands", file)


def _numbers(folder: str, file: str) -> Numbers:
    return parse_numbers(_LIBRARY.joinpath(folder, file).read_text(encoding="utf-8"), f"library file {file}")
