"""Units as the makers of spectra write them, in headers, in the names of columns, and in remarks."""

from __future__ import annotations

import re
import warnings
from typing import TYPE_CHECKING

from ..errors import InputError
from ..files.bounded import shortened

if TYPE_CHECKING:
    import astropy.units as u

#: Longest text that is looked at as a unit, and longest header whose remarks are.
MOST_UNIT, MOST_HEADER = 100, 20_000
#: Units of flux densities that are one word.
_NAMES = {
    "flam": "erg / (s cm2 Angstrom)",
    "fnu": "erg / (s cm2 Hz)",
    "photlam": "photon / (s cm2 Angstrom)",
    "photnu": "photon / (s cm2 Hz)",
    "jy": "Jy",
    "mjy": "mJy",
    "ujy": "uJy",
}
#: Words that archives use, in lower case, to astropy's; to astropy A alone is ampere.
_WORDS = {
    "a": "Angstrom", "aa": "Angstrom", "ang": "Angstrom", "angs": "Angstrom", "angstrom": "Angstrom",
    "angstroms": "Angstrom", "å": "Angstrom", "erg": "erg", "ergs": "erg", "s": "s", "sec": "s", "second": "s",
    "seconds": "s", "cm": "cm", "m": "m", "hz": "Hz", "ghz": "GHz", "thz": "THz", "nm": "nm", "um": "um",
    "micron": "um", "microns": "um", "micrometer": "um", "micrometers": "um", "micrometre": "um", "micrometres": "um",
    "nanometer": "nm", "nanometers": "nm", "nanometre": "nm", "nanometres": "nm", "w": "W", "watt": "W", "watts": "W",
    "j": "J", "ev": "eV", "kev": "keV", "photons": "photon", "photon": "photon", "ph": "photon",
}  # fmt: skip
_PLAIN = str.maketrans("µμ−⁻⁰¹²³⁴⁵⁶⁷⁸⁹·⋅×Å", "uu--0123456789..*Å")
_POWER = re.compile(
    r"^(?:x\s*)?(?:10\s*(?:\^|\*\*)\s*\(?([+-]?\d{1,3})\)?|(\d(?:\.\d*)?[eE][+-]?\d{1,3}))\s*[*. x]?\s*"
)
_NO_FLUX = re.compile(r"mag|^ab$|^(counts?|cts|adu|dn|fn|electrons?)\b|^(log|dex)", re.IGNORECASE)


def unit_of(text: str) -> u.UnitBase:
    """A unit as archives write it: in capitals, in the plural, with a power of ten, with A for Angstrom.

    Raises
    ------
    InputError
        If it is unknown, or of magnitudes, counts or logarithms.
    """
    import astropy.units as u

    name = text.translate(_PLAIN).strip().strip("[]'\"").strip()
    expected = "expected one such as Angstrom, nm or erg / (s cm2 Angstrom)"
    if _NO_FLUX.search(name):
        raise InputError(
            f"unit {shortened(text.strip())} is no flux density (magnitude, count or logarithm), {expected}"
        )
    if not name or len(name) > MOST_UNIT:
        raise InputError(f"unit {shortened(text.strip())} is unknown, {expected}")
    power = _POWER.match(name)
    scale = float(power[2] or f"1e{power[1]}") if power else 1.0
    rest = name[power.end() :] if power else name
    rest = _balanced(rest)
    rest = _NAMES.get(rest.lower(), rest)
    rest = re.sub(r"\bper\b", "/", rest, flags=re.IGNORECASE)
    plain = re.sub(r"[A-Za-zÅå]+", lambda word: _WORDS.get(word[0].lower(), word[0]), rest)
    for spelling in (plain, rest):
        try:
            with warnings.catch_warnings():
                # Several slashes are discouraged, and what archives write.
                warnings.simplefilter("ignore")
                return u.CompositeUnit(scale, [u.Unit(spelling)], [1]) if power else u.Unit(spelling)
        except (ValueError, TypeError, OverflowError, RecursionError):
            continue
    raise InputError(f"unit {shortened(text.strip())} is unknown, {expected}")


_LENGTH = (
    r"Angstroms?|ANGSTROMS?|angstroms?|Angs?|ang|AA|Å|nm|NM|[Nn]anomet(?:er|re)s?|um|[µμ]m|[Mm]icrons?"
    r"|[Mm]icromet(?:er|re)s?|[GT]?Hz|k?eV"
)
_EXPONENT = r"(?:\s?(?:\^|\*\*)?\s?\(?[-+−]?\d\)?|[⁻⁺]?[¹²³])?"
_ATOM = rf"(?:[Ee][Rr][Gg][Ss]?|m?W|[Ww]atts?|J|s|S|[Ss]ec(?:onds?)?|SEC|[cC]?[mM]|A|(?<=/)a|{_LENGTH})\b{_EXPONENT}"
_ATOM_OR_A = _ATOM.replace(r"\b", r"(?![A-Za-z])")
_FLUX = re.compile(
    r"(?:(?:10\s?(?:\^|\*\*)\s?\(?[-+−]?\d+\)?|10[⁻⁺]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+|\d(?:\.\d*)?[eE][-+]?\d+)\s?[*x×.]?\s?)?"
    r"(?<![A-Za-z])(?:[Ee][Rr][Gg][Ss]?|m?W|[Ww]atts?|[Pp]hotons?|ph)(?![A-Za-z])" + _EXPONENT
    + rf"(?:(?:\s?(?:/|\*|\.|·|per\b)\s?|\s|_)[(\s]*{_ATOM_OR_A}\)?)+"
    r"|(?<![A-Za-z])(?:FLAM|flam|FNU|fnu|PHOTLAM|photlam|[mu]?Jy)(?![A-Za-z])"
)  # fmt: skip
_BESIDE = re.compile(
    r"(?:wavelengths?|waves?|wav|lambda|lam|wl|wlen|λ|frequency|freq)[\s_:=,]*(?:\(?(?:air|vac\w*)\)?)?[\s_:=,]*"
    rf"(?:is|are)?\s*(?:in|units?)?\s*[\[(<]?\s*({_LENGTH}|A)(?![A-Za-z])",
    re.IGNORECASE,
)
_ANYWHERE = re.compile(rf"(?<![\w.])(?<!\d )(?:{_LENGTH})(?![\w/])")
_LIST = re.compile(rf"^\W*(?:units?\W+)?({_LENGTH}|A)[\s,;|]+(?=$|\W*FLUXUNIT)")


_NO_FLUX_HERE = re.compile(
    r"\b((?:AB|ST)[\s_]?mag\w*)|(?:wave|lambda|\bwl\b)[^\n]*?(?<![A-Za-z])(mag(?:nitude)?s?(?![a-z])|counts?\b|ADU\b|log\w*\W*flux)",
    re.IGNORECASE,
)


def stated_units(header: str, *, wavelength: bool = True, flux: bool = True) -> tuple[str | None, str | None]:
    """Units of wavelength and of flux that the header of a text file states, where they are asked for.

    Raises
    ------
    InputError
        If it states several, and does not say which is meant, or that there is no flux.
    """
    text = header[:MOST_HEADER]
    fluxes = [_unlined(match[0].strip()) for match in _FLUX.finditer(text)]
    distinct = _distinct(fluxes)
    if flux and len(distinct) > 1:
        beside = re.search(r"flux\w*\W{0,4}(?:in\W+)?(" + _FLUX.pattern + ")", text, re.IGNORECASE)
        if beside is None:
            raise InputError(f"its header names the units {', '.join(distinct)}, expected one: --flux-unit says which")
        distinct = [_unlined(beside[1].strip())]
    if flux and not distinct and (match := _NO_FLUX_HERE.search(text)):
        raise InputError(
            f"its header speaks of {(match[1] or match[2])!r}, expected a flux density: --flux-unit names its unit"
        )
    rest = re.sub(_FLUX.pattern, " FLUXUNIT ", text)
    adjacent = _distinct([match[1] for match in _BESIDE.finditer(rest)])
    listed = [match[1] for line in rest.splitlines() if (match := _LIST.match(line.strip().lstrip("#!%;").strip()))]
    lengths = adjacent or _distinct(listed) or _distinct(_ANYWHERE.findall(rest))
    if wavelength and len(lengths) > 1:
        raise InputError(f"its header names the units {', '.join(lengths)}, expected one: --wavelength-unit says which")
    return (lengths[0] if lengths else None), (distinct[0] if distinct else None)


def _balanced(name: str) -> str:
    """Without the brackets that stand around it, or were left of them."""
    while name[:1] == "(" and (name.count("(") > name.count(")") or re.fullmatch(r"\([^()]*\)", name)):
        name = name[1:]
    while name[-1:] == ")" and name.count(")") > name.count("("):
        name = name[:-1]
    return name


def _unlined(name: str) -> str:
    """Units in names of columns: erg_s_cm2_A means erg/s/cm2/A."""
    name = _balanced(name)
    return name.replace("_", "/") if "_" in name and not re.search(r"[/\-−]|per", name) else name.replace("_", " ")


def _distinct(names: list[str]) -> list[str]:
    """Each unit once, however it is spelt; what is none falls out."""
    units: dict[object, str] = {}
    for name in names:
        try:
            units.setdefault(unit_of(name), name)
        except InputError:
            continue
    return list(units.values())
