"""Parser of units of wavelength and flux in the spellings of archives and users, for all file formats."""

from __future__ import annotations

import re
import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

from mauvecl.host.tables.missing import MISSING_WORDS
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    import astropy.units as u

#: Longest text that is parsed as a unit.
MAX_UNIT_LENGTH = 100
#: Kinds of flux units: per wavelength or frequency, per area only, per solid angle, or other.
FluxKind = Literal["density", "total", "surface brightness", "other"]

_DENSITIES = {
    "flam": "erg / (s cm2 Angstrom)",
    "fnu": "erg / (s cm2 Hz)",
    "photlam": "photon / (s cm2 Angstrom)",
    "photnu": "photon / (s cm2 Hz)",
    "jy": "Jy",
    "jansky": "Jy",
    "janskys": "Jy",
}
# Lower-case spellings and astropy's names; astropy parses A as ampere.
_SPELLINGS = {
    "Angstrom": "a aa ang angs angstrom angstroms angstroem angstroems ångström ångströms å",
    "nm": "nm nanometer nanometers nanometre nanometres",
    "um": "um micron microns micrometer micrometers micrometre micrometres",
    "mm": "mm", "cm": "cm", "m": "m meter meters metre metres",
    "Hz": "hz hertz", "GHz": "ghz", "THz": "thz", "eV": "ev", "keV": "kev",
    "erg": "erg ergs", "J": "j joule joules", "W": "w watt watts",
    "s": "s sec secs second seconds", "photon": "photon photons ph phot",
    "sr": "sr ster sterad steradian steradians", "arcsec": "arcsec arcsecond arcseconds",
}  # fmt: skip
_WORDS = {spelling: name for name, spellings in _SPELLINGS.items() for spelling in spellings.split()}
_TYPOGRAPHY = str.maketrans("µμ−–⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹·⋅×Å", "uu---+0123456789..*Å")
SCALE = re.compile(
    r"(?:x\s*|\*\s*)?(?:10\s*(?:\^|\*\*)\s*\(?\s*([+-]?\d{1,3})\s*\)?|10([+-]\d{1,3})(?!\d)|(\d(?:\.\d*)?[eE][+-]?\d{1,3}))"
)
# Magnitudes with a defined zero point; nanomaggies are linear, 22.5 mag (AB) each (SDSS DR18, "magnitudes").
_AB = re.compile(r"(?:m(?:ag)?s?[_ (]*)?ab[) ]*(?:[_ ]?mag(?:nitude)?s?)?", re.IGNORECASE)
_ST = re.compile(r"(?:m(?:ag)?s?[_ (]*)?st[) ]*(?:[_ ]?mag(?:nitude)?s?)?", re.IGNORECASE)
_NANOMAGGIES = re.compile(r"n(?:ano)?m(?:ag)?g(?:y|ies|ys)", re.IGNORECASE)
_LOGARITHM = re.compile(r"(?:log(?:_?10)?|dex)(?:\s*[\s_(\[]\s*(.*?)\s*\]?)?", re.IGNORECASE)
_NO_FLUX = re.compile(r"mag|^(counts?|cts|adu|dn|fn|electrons?)\b", re.IGNORECASE)
# "na" is a nanoyear.
_NO_UNIT = {*MISSING_WORDS} - {"na"}


def is_stated(text: object) -> bool:
    """Return whether a unit field contains a unit, instead of an empty text or a word for none."""
    return text is not None and str(text).strip().strip("'\"").lower() not in _NO_UNIT


@lru_cache(maxsize=1024)
def unit_of(text: str) -> u.UnitBase | u.function.FunctionUnitBase:
    """Parse a unit in any usual spelling.

    Accepted are capitals, plurals, leading powers of ten, ``A`` for Angstrom, ``FLAM``, typographic superscripts,
    ``log(...)``, and AB and ST magnitudes. Raises InputError for an unknown unit, other magnitudes, and counts.
    """
    import astropy.units as u

    name = text.translate(_TYPOGRAPHY).strip().strip("'\"").strip()
    if name[:1] == "[" and name[-1:] == "]":
        name = name[1:-1].strip()
    if _AB.fullmatch(name):
        return u.ABmag
    if _ST.fullmatch(name):
        return u.STmag
    if _NANOMAGGIES.fullmatch(name):
        return u.CompositeUnit(1e-9, [u.AB], [1])
    expected = "a unit such as Angstrom, nm or erg / (s cm2 Angstrom)"
    if match := _LOGARITHM.fullmatch(name):
        return u.dex(_linear_unit(balanced(match[1]), text, expected)) if match[1] else u.dex
    if _NO_FLUX.search(name):
        raise InputError.of("unit", text.strip(), f"a flux density, not a magnitude or count: {expected}")
    return _linear_unit(name, text, expected)


def _linear_unit(name: str, text: str, expected: str) -> u.UnitBase:
    import astropy.units as u

    unknown = InputError.of("unit", text.strip(), f"a known unit: {expected}")
    # astropy takes a comma for a structure of two units.
    if not name or len(name) > MAX_UNIT_LENGTH or "," in name:
        raise unknown
    scale = 1.0
    if match := SCALE.match(name):
        scale = float(match[3] or f"1e{match[1] or match[2]}")
        name = re.sub(r"^\s*[*.x]?\s*", "", name[match.end() :])
    elif match := re.search(rf"\s*[*x]\s*({SCALE.pattern})\)?$", name):
        scale = float(match[4] or f"1e{match[2] or match[3]}")
        name = name[: match.start()]
    name = balanced(name)
    name = _DENSITIES.get(name.lower(), name)
    name = re.sub(r"\bper\b", "/", name, flags=re.IGNORECASE)
    # Exponents in brackets: s**(-1), cm^{-2}.
    name = re.sub(r"(?:\^|\*\*)\s*[({]\s*([+-]?\d+)\s*[)}]", r"**\1", name)
    respelled = re.sub(r"[A-Za-zÅåö]+", lambda word: _WORDS.get(word[0].lower(), word[0]), name)
    known = u.get_current_unit_registry().registry
    for spelling in (respelled, name):
        # astropy takes 20 ms to fail, because it searches for similar names.
        if not all(word in known for word in re.findall(r"[^\W\d_]+", spelling)):
            continue
        try:
            with warnings.catch_warnings():
                # Several slashes are discouraged but common.
                warnings.simplefilter("ignore")
                return u.CompositeUnit(scale, [u.Unit(spelling)], [1]) if scale != 1.0 else u.Unit(spelling)
        except (ValueError, TypeError, OverflowError, RecursionError):
            continue
    raise unknown


def balanced(name: str) -> str:
    """Remove brackets that enclose the whole name or have no partner."""
    while name[:1] == "(" and (name.count("(") > name.count(")") or re.fullmatch(r"\([^()]*\)", name)):
        name = name[1:]
    while name[-1:] == ")" and name.count(")") > name.count("("):
        name = name[:-1]
    return name.strip()


def linear(unit: Any) -> u.UnitBase:
    """Return the linear unit of a logarithmic unit or magnitude; others unchanged."""
    physical: u.UnitBase = getattr(unit, "physical_unit", unit)
    return physical


def is_spectral(unit: Any) -> bool:
    """Return whether a unit is one of wavelength, frequency, wavenumber or photon energy."""
    import astropy.units as u

    return bool(linear(unit).is_equivalent(u.m, u.spectral()))


def flux_kind(unit: Any) -> FluxKind:
    """Classify a unit of flux."""
    import astropy.units as u

    unit = linear(unit)
    area = u.m**2
    per_area = (u.W / area, u.photon / u.s / area)
    densities = [one / per for one in per_area for per in (u.m, u.Hz)]
    if any(unit.is_equivalent(one) for one in densities):
        return "density"
    if any(unit.is_equivalent(one) for one in per_area):
        return "total"
    if any((unit * u.sr).is_equivalent(one) for one in (*densities, *per_area)):
        return "surface brightness"
    return "other"
