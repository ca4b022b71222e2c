"""The embedded library: which spectra there are, and their tables."""

from __future__ import annotations

import csv
import difflib
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from ..errors import InputError
from ..files.ecsv import Numbers, parse_numbers

if TYPE_CHECKING:
    from astropy.table import Table

_LIBRARY = files("mauvecl.host.stars") / "library"


@cache
def _index() -> dict[str, dict[str, str]]:
    # All text, one row a line: read without astropy, so that a misspelt name is told at once.
    text = _LIBRARY.joinpath("index.ecsv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return {entry["name"].casefold(): entry for entry in csv.DictReader(lines, delimiter=" ")}


@cache
def _names() -> dict[str, str]:
    """Every name and alias, in lower case, to its entry's name."""
    names = {}
    for key, entry in _index().items():
        names[key] = key
        for other in (entry["alias"], entry["star"]):
            names.setdefault(other.casefold(), key)
    names.pop("", None)
    return names


def library_table() -> Table:
    """The embedded spectra, and those of one's own behind them.

    Returns
    -------
    astropy.table.Table
        Columns name, alias, spectral_type, star, origin, citation, licence, treatment, uv_quality, kept (all text; the
        last is "embedded" or "yours").
    """
    from astropy.table import Table

    from . import own_stars

    table = Table.read(_LIBRARY.joinpath("index.ecsv").read_text(encoding="utf-8"), format="ascii.ecsv")
    # Empty text comes back masked.
    table = table.filled("")
    table.remove_columns(["file", "source_file"])
    table["kept"] = "embedded"
    for star in own_stars.kept():
        row = dict.fromkeys(table.colnames, "") | {"name": star.name, "star": star.name, "origin": star.origin}
        row |= {"treatment": "; ".join(star.notes), "kept": "yours"}
        for name in table.colnames:
            # Columns of text are as wide as their longest entry.
            table[name] = table[name].astype(object)
        table.add_row(row)
    return table


def embedded(name: str) -> dict[str, str] | None:
    """The index entry of an embedded spectrum by name, alias or star, in any case, or None."""
    key = _names().get(name.strip().casefold())
    return None if key is None else _index()[key]


def find(name: str) -> dict[str, str]:
    """The index entry of an embedded spectrum.

    Parameters
    ----------
    name : str
        Name, alias or star, in any case.

    Raises
    ------
    InputError
        If there is none; the message holds the nearest names, kept stars' among them.
    """
    from . import own_stars

    entry = embedded(name)
    if entry is not None:
        return entry
    known = {key: _index()[value]["name"] for key, value in _names().items()}
    known |= {star.name.casefold(): star.name for star in own_stars.kept()}
    near = difflib.get_close_matches(name.strip().casefold(), known, n=4, cutoff=0.3)
    names = [known[one] for one in near] or [entry["name"] for entry in _index().values()]
    raise InputError(f"library spectrum {name!r} is unknown, expected a name such as {', '.join(dict.fromkeys(names))}")


@lru_cache(8)
def spectrum_table(file: str) -> Numbers:
    """A library spectrum: columns wavelength (nm) and flux (erg s-1 cm-2 A-1)."""
    return _numbers("spectra", file)


def band_table(file: str) -> Numbers:
    """A photometric band: columns wavelength (nm) and throughput (per photon)."""
    return _numbers("bands", file)


def _numbers(folder: str, file: str) -> Numbers:
    return parse_numbers(_LIBRARY.joinpath(folder, file).read_text(encoding="utf-8"), f"library file {file}")
