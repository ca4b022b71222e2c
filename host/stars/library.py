"""Stars by name: the embedded library, the user's own stars, formulas, spectral types and well-known stars.

The user's own stars supplement the embedded library. Each is an ECSV file in the user's data folder, with its origin
and the digest of its spectrum, which is verified at every reading.
"""

from __future__ import annotations

import contextlib
import csv
import difflib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mauvecl.host.tables.files import Numbers, parse_numbers, read_ecsv
from mauvecl.schema.calls import checked
from mauvecl.schema.columns import Column
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Temperature

if TYPE_CHECKING:
    from astropy.table import Table


#: Examples of formulas, by name.
EXAMPLES = ("blackbody 9000 K", "power law -2")
#: Accepted indices of power laws; steeper spectra are no approximation of stars (assumed).
Index = Annotated[float, Range(-10, 10)]
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_NAME = re.compile(
    rf"\s*(?:(?P<body>black[ -]?body|planck)\s+(?P<kelvin>{_NUMBER})\s*K?|power[ -]?law\s+(?P<index>{_NUMBER}))\s*",
    flags=re.IGNORECASE,
)


@dataclass(frozen=True)
class ModelStar:
    """Blackbody of a temperature, or else power law of an index."""

    name: str  # by which the star is found again
    origin: str  # formula of the spectrum
    temperature_k: float | None
    index: float = 0.0


@dataclass(frozen=True, eq=False)
class OwnStar:
    """A kept star; fields as in `Source`, and the table of its file."""

    name: str
    origin: str
    notes: tuple[str, ...]
    messages: tuple[str, ...]
    measured_nm: tuple[float, float] | None
    unscaled: str
    table: Table
    path: Path


def folder() -> Path:
    """Return the folder of kept stars, below ``MAUVECL_DATA_DIR`` or the user's data folder."""
    import platformdirs

    directory = os.environ.get("MAUVECL_DATA_DIR")
    return (Path(directory) if directory else platformdirs.user_data_path("mauvecl")) / "stars"


def user_stars() -> list[OwnStar]:
    """Return all kept stars, sorted by file name."""
    return [star for path in sorted(folder().glob("*.ecsv")) if (star := _described(path)) is not None]


def find(name: str) -> OwnStar | None:
    """Return a kept star by name in any case, or None."""
    key = name.strip().casefold()
    return next((star for star in user_stars() if star.name.casefold() == key), None)


def _described(path: Path) -> OwnStar | None:
    """Return the star in a file of the folder, or None for another table; raise InputError for a damaged file."""
    table = read_ecsv(path, "kept star", "use `mauvecl library remove` to take it away")
    meta = table.meta
    if not {"name", "origin", "spectrum_sha256"} <= set(meta):
        return None
    name, origin, unscaled = (str(meta.get(key, "")) for key in ("name", "origin", "unscaled"))
    notes, messages = (tuple(map(str, meta.get(key, ()))) for key in ("notes", "told"))
    measured = None if (ends := meta.get("measured_nm")) is None else (float(ends[0]), float(ends[1]))
    return OwnStar(name, origin, notes, messages, measured, unscaled, table, path)


def remove(name: str) -> None:
    """Delete a kept star; raises InputError for an unknown name."""
    key = name.strip().casefold()
    named: list[Path] = []
    damaged: list[Path] = []
    for path in sorted(folder().glob("*.ecsv")):
        star = None
        with contextlib.suppress(InputError):
            star = _described(path)
        if star is not None:
            named += [path] if star.name.casefold() == key else []
        elif path.stem.casefold() == re.sub(r"[^a-z0-9.+-]", "_", key):
            # A damaged file has no name but that of the file.
            damaged.append(path)
    if not (named or damaged):
        names = ", ".join(star.name for star in user_stars())
        raise InputError.of("name", name, f"one of: {names or 'no star is kept'}")
    (named or damaged)[0].unlink()


#: Abbreviations of Greek letters in catalogues.
_GREEK = {"alpha": "alp", "beta": "bet", "gamma": "gam", "delta": "del", "epsilon": "eps", "zeta": "zet", "iota": "iot",
          "kappa": "kap", "sigma": "sig", "omicron": "omi"}  # fmt: skip


@dataclass(frozen=True)
class WellKnown:
    """Star of the embedded list."""

    name: str
    other_names: tuple[str, ...]
    ra_deg: float  # ICRS, as the declination
    dec_deg: float
    distance_pc: float
    magnitude: float  # in V
    spectral_type: str
    source: str

    @property
    def about(self) -> str:
        """Its type, distance and magnitude with their source, in words."""
        return f"{self.spectral_type}, {self.distance_pc:g} pc, V = {self.magnitude:g}; {self.source.partition(',')[0]}"


_LIBRARY = resources.files(__package__) / "library"


def library_text(*path: str) -> str:
    """Return a file of the library."""
    return _LIBRARY.joinpath(*path).read_text(encoding="utf-8")


@cache
def _rows(file: str) -> list[dict[str, str]]:
    """Read a table of the library without astropy, which keeps the error for a misspelt name fast."""
    lines = [line for line in library_text(file).splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines, delimiter=" "))


@cache
def well_known_stars() -> tuple[WellKnown, ...]:
    """Return the stars of the list."""
    stars = []
    for row in _rows("well_known.ecsv"):
        other_names = tuple(name.strip() for name in row["other_names"].split(","))
        ra, dec, distance, v = (float(row[key]) for key in ("ra", "dec", "distance", "V"))
        stars.append(WellKnown(row["name"], other_names, ra, dec, distance, v, row["spectral_type"], row["source"]))
    return tuple(stars)


@cache
def by_key() -> Mapping[str, WellKnown]:
    """Return every star by each of its normalised names."""
    return {name_key(name): star for star in well_known_stars() for name in (star.name, *star.other_names)}


def name_key(name: str) -> str:
    """Normalise a name: lower case, no separators but decimal points, abbreviated Greek letters."""
    key = re.sub(r"[\s_*']+|(?<!\d)\.|\.(?!\d)", "", name).casefold()
    for long, short in _GREEK.items():
        if key.startswith(long):
            return short + key.removeprefix(long)
    return key


@cache
def _entries() -> dict[str, dict[str, str]]:
    """Return the entry of the library's index for every normalised name and alias."""
    entries: dict[str, dict[str, str]] = {}
    for entry in _rows("index.ecsv"):
        entries[name_key(entry["name"])] = entry
        for alias in (entry["alias"], entry["star"]):
            entries.setdefault(name_key(alias), entry)
    entries.pop("", None)
    return entries


def library_names() -> list[str]:
    """Return the distinct names of all embedded spectra: types, aliases and stars."""
    names = [entry[column] for entry in _rows("index.ecsv") for column in ("name", "alias", "star")]
    # The name of the collection before a type adds no information.
    return [name for name in dict.fromkeys(names) if name and not name.startswith("Pickles ")]


#: Columns of the printed table of embedded spectra.
COLUMNS = (
    Column("name", heading="name"),
    Column("alias", heading="also"),
    Column("spectral_type", heading="type"),
    Column("star", heading="star"),
    Column("temperature_k", heading="K"),
    Column(
        "uv_quality",
        heading="UV at 190-210, 240-260, 290-310 nm",
        # The ratios in "190-210: 0.1 (S/N 5), ...; ...".
        format=lambda text: ", ".join(ratio.split()[0] for ratio in text.split("; ")[0].split(": ")[1].split(", ")),
    ),
    Column("noisy_below_nm", heading="noisy below", format=lambda below: f"{below} nm" if below else ""),
    Column("licence", heading="licence"),
)
#: Columns of the table of the user's own stars.
OWN_COLUMNS = (
    Column("name", heading="name"),
    Column("origin", heading="origin"),
    Column("treatment", heading="notes"),
)


def library_table() -> Table:
    """Return the embedded spectra, followed by the user's own.

    The columns are name, alias, spectral_type, star, origin, citation, licence, treatment, uv_quality and kept. All are
    text; the last is "embedded" or "yours".
    """
    from astropy.table import Table, vstack

    table = Table.read(library_text("index.ecsv"), format="ascii.ecsv")
    table.remove_columns(["file", "source_file"])
    table["kept"] = "embedded"
    rows = [
        {"name": star.name, "star": star.name, "origin": star.origin, "treatment": "; ".join(star.notes),
         "kept": "yours"} for star in user_stars()
    ]  # fmt: skip
    # Empty texts of the file, and unknown values of the user's stars, are masked.
    return vstack([table, Table(rows)] if rows else [table]).filled("")


def embedded(name: str) -> dict[str, str] | None:
    """Return the index entry of a spectrum by name (of a type also as "M3" for M3V), alias or star, or None."""
    key = name_key(name)
    return _entries().get(key) or _entries().get(f"{key}v")


@lru_cache(8)
def spectrum_table(file: str, folder: str = "spectra") -> Numbers:
    """Read wavelength (nm) and flux (erg s-1 cm-2 A-1), in the folder ``bands`` the throughput per photon."""
    return parse_numbers(library_text(folder, file), f"library file {file}")


#: Spectral classes in order of decreasing temperature.
CLASSES = "OBAFGKM"
_TYPE = re.compile(rf"\s*(?:d)?([{CLASSES}])\s*(\d(?:\.\d+)?)?")


def subtype(spectral_type: str) -> float:
    """Convert a spectral type to a number, ten per class: K5 is 55, M0 is 60, and a class without subtype is x5."""
    matched = _TYPE.match(spectral_type)
    if not matched:
        raise InputError.of("spectral type", spectral_type, "one from O to M, such as M3V")
    return 10.0 * CLASSES.index(matched[1]) + (5.0 if matched[2] is None else float(matched[2]))


def nearest_spectrum(spectral_type: str) -> str:
    """Return the name of the embedded spectrum of the nearest type; the first in the library if there are several."""
    number = subtype(spectral_type)
    typed = [entry for entry in _rows("index.ecsv") if _TYPE.match(entry["spectral_type"])]
    return min(typed, key=lambda entry: abs(subtype(entry["spectral_type"]) - number))["name"]


@dataclass(frozen=True)
class NamedStar:
    """Star or spectral type that was found by name."""

    name: str
    entry: WellKnown | None = None  # its entry in the list of well-known stars
    # Its spectrum, if it has one: a formula, a star of the user, or an entry of the library's index.
    light: ModelStar | OwnStar | Mapping[str, str] | None = None

    @property
    def nearest(self) -> str:
        """Name of its own spectrum, or of that of the nearest type in the library."""
        if self.light is not None:
            return self.light["name"] if isinstance(self.light, Mapping) else self.light.name
        return nearest_spectrum(self.name if self.entry is None else self.entry.spectral_type)


def resolve(text: str, *, own: bool = True) -> NamedStar | None:
    """Find a star or spectral type by any name, in any case and spacing, or return None.

    A text is a name of the library ("M3V", short "M3"), a star ("GJ 581", "Proxima", "HD 1835"), any other spectral
    type, or a formula ("blackbody 9000 K", "power law -2"). The user's own stars are searched if `own` is true.
    """
    if formula := _NAME.fullmatch(text):
        if formula["body"] is not None:
            kelvin = checked(Temperature, "temperature of the blackbody", float(formula["kelvin"]))
            model = ModelStar(f"blackbody {kelvin:.15g} K", "Planck's law", kelvin)
        else:
            index = checked(Index, "index of the power law", float(formula["index"]))
            origin = f"flux per wavelength proportional to its power {index:g}"
            model = ModelStar(f"power law {index:.15g}", origin, None, index)
        return NamedStar(model.name, light=model)
    star = by_key().get(name_key(text))
    # The library may list the star under another of its names.
    entries = map(embedded, (text,) if star is None else (text, star.name, *star.other_names))
    light = next(filter(None, entries), None) or (find(text) if own else None)
    if star is not None:
        return NamedStar(star.name, star, light)
    if light is not None:
        return NamedStar(light["name"] if isinstance(light, Mapping) else light.name, light=light)
    # Types of dwarfs and subgiants, such as "m3.5" for M3.5V.
    match = re.fullmatch(rf"d?([{CLASSES}])(\d(?:\.\d+)?)(IV|V)?", "".join(text.split()), flags=re.IGNORECASE)
    return None if match is None else NamedStar(f"{match[1]}{match[2]}{match[3] or 'V'}".upper())


def named_star(text: str, key: str = "star", *, own: bool = True) -> NamedStar:
    """Return what `resolve` finds; raise InputError, with this key and similar names, for an unknown star."""
    star = resolve(text, own=own)
    if star is None:
        raise InputError(f"star {text.strip()!r} is unknown; try a name such as {', '.join(near_names(text))}", key=key)
    return star


def listed_values(name: str) -> dict[str, float]:
    """Return V and distance of a listed star, as keys of a study; none for others, or if its spectrum has a level."""
    star, entry = by_key().get(name_key(name)), embedded(name)
    if star is None or (entry is not None and entry["level"] == "as seen"):
        return {}
    return {"magnitude": star.magnitude, "distance_pc": star.distance_pc}


def listed_note(name: str, **used: float | None) -> str:
    """Describe what the library supplies for a star, and V (mag) and distance (pc) that are `used` from the list."""
    star = resolve(name)
    if star is None:
        return ""
    texts = []
    if star.light is None:
        kind = star.name if star.entry is None else star.entry.spectral_type
        exact = star.nearest == kind
        texts.append(f"spectrum of {f'type {kind}' if exact else f'{star.nearest}, the nearest to type {kind}'}")
    elif star.entry is not None:
        texts.append(f"as {star.name}")
    listed = {key: value for key, value in listed_values(name).items() if used.get(key) == value}
    texts += [f"V = {value:g}" if key == "magnitude" else f"{value:g} pc" for key, value in listed.items()]
    source = f", from {star.entry.source.partition(',')[0]}" if star.entry is not None and listed else ""
    return ", ".join(texts) + source if listed or star.light is None else ""


def all_names() -> list[str]:
    """Return the names of all embedded spectra and well-known stars, without designations, and of two formulas."""
    return list(dict.fromkeys([*library_names(), *EXAMPLES, *(star.name for star in well_known_stars())]))


def near_names(text: str, *, stars_only: bool = False) -> list[str]:
    """Return up to four known names that resemble a text, or a few examples; on request only stars with coordinates."""
    names = {key: star.name for key, star in by_key().items()}
    if not stars_only:
        names |= {name_key(name): name for name in library_names()}
        names |= {name_key(star.name): star.name for star in user_stars()}
    near = difflib.get_close_matches(name_key(text), names, n=4, cutoff=0.5)
    return list(dict.fromkeys(names[key] for key in near)) or ["eps Eri", "AU Mic"] + ["G2V"] * (not stars_only)


#: Aliases by band name.
ALIASES = {
    "B": ("Johnson B",),
    "V": ("Johnson V",),
    "Kepler": ("Kp", "Kepler Kp"),
    "TESS": ("T",),
    "Gaia G": ("G", "Gaia DR2 G"),
    "Gaia BP": ("BP", "Gaia DR2 BP"),
    "Gaia RP": ("RP", "Gaia DR2 RP"),
    "GALEX NUV": ("NUV",),
    "GALEX NUV Vega": ("NUV Vega",),
}


def known_band(name: str) -> str:
    """Return the name of a band, given its name or alias in any case."""
    key = name.strip().casefold()
    for band, aliases in ALIASES.items():
        if key in map(str.casefold, (band, *aliases)):
            return band
    raise InputError.of("band", name, f"one of {', '.join(ALIASES)}")
