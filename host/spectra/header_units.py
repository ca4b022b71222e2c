"""Search for units of wavelength and flux in the free text of a header."""

from __future__ import annotations

import re

from mauvecl.host.tables.units import balanced, is_spectral, unit_of
from mauvecl.schema.errors import InputError

#: Length of the longest header that is searched.
MAX_HEADER = 20_000

_LENGTH = (
    r"Angstroe?ms?|ANGSTROMS?|angstroe?ms?|Å[Nn]gstr[öo]ms?|Angs?|ang|AA|Å|nm|NM|[Nn]anomet(?:er|re)s?|um|[µμ]m|[Mm]icrons?"
    r"|[Mm]icromet(?:er|re)s?|[GT]?Hz|k?eV|cm\s?\^?\s?[-−⁻][1¹]|1/cm"
)
# An optional blank on the same line.
_B = r"[^\S\n]?"
_EXPONENT = rf"(?:{_B}(?:\^|\*\*)?{_B}\(?[-+−]?\d\)?|[⁻⁺]?[¹²³])?"
_PER = r"sr|ster(?:adian)?s?|arcsec(?:ond)?s?|pix(?:el)?s?|beam"
_ATOM = (
    rf"(?:[Ee][Rr][Gg][Ss]?|m?W|[Ww]atts?|J|s|S|[Ss]ec(?:onds?)?|SEC|[cC]?[mM]|A|(?<=/)a|{_PER}|{_LENGTH})"
    rf"(?![A-Za-z]){_EXPONENT}"
)
_SCALE = rf"(?:10{_B}(?:\^|\*\*){_B}\(?[-+−]?\d+\)?|10[⁻⁺]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+|\d(?:\.\d*)?[eE][-+]?\d+)"
_FLUX = re.compile(
    rf"(?:{_SCALE}{_B}[*x×.]?{_B})?"
    rf"(?<![A-Za-z])(?:[Ee][Rr][Gg][Ss]?|m?W|[Ww]atts?|[Pp]hotons?|ph)(?![A-Za-z]){_EXPONENT}"
    rf"(?:(?:{_B}(?:/|\*|\.|·|per\b){_B}|[^\S\n]|_)(?:[^\S\n]|\()*{_ATOM}\)?)+"
    rf"(?:{_B}/{_B}[A-Za-z]\w*)*(?:{_B}[*x×]{_B}{_SCALE})?"
    rf"|(?<![A-Za-z])(?:FLAM|flam|FNU|fnu|PHOTLAM|photlam|[mun]?Jy)(?![A-Za-z])(?:{_B}/{_B}[A-Za-z]\w*)*"
)
_WAVE_WORD = r"(?:wavelengths?|waves?|wav|lambda|lam|wl|wlen|λ|frequency|freq|wavenumbers?)"
# A unit after a word for wavelength.
_NEXT_TO = re.compile(
    rf"{_WAVE_WORD}[\s_:=,]*(?:\(?\b(?:air|vac(?:uum)?)\b\)?)?[\s_:=,]*(?:is|are)?\s*(?:in|units?)?\s*[\[(<:=]?\s*({_LENGTH}|A)"
    r"(?![A-Za-z])",
    re.IGNORECASE,
)
_ANYWHERE = re.compile(rf"(?<![\w.])(?<!\d )(?:{_LENGTH})(?![\w/])")
_LIST = re.compile(rf"^\W*(?:units?\W+)?({_LENGTH}|A)[\s,;|]+(?=$|\W*FLUXUNIT)")
# "wavelength (pc)", "wavelengths in furlongs": an unknown unit.
_STATED = re.compile(
    rf"(?:{_WAVE_WORD}\s*[\[(]\s*|{_WAVE_WORD}(?:\s+units?)?\s*(?:\bin\b|:|=)\s*)([A-Za-zÅµ][\w/^*-]*)(?=\s*(?:[\])\n.,;|&]|and\b|$))",
    re.IGNORECASE,
)
_QUALIFIERS = re.compile(
    r"(?:in|the|air|vac\w*|rest|observed|obs|helio\w*|bary\w*|standard|frame|true|false|log\w*|none|linear|increasing|decreasing"
    r"|first|column|nm_?vac|yes|no)$",
    re.IGNORECASE,
)
_NO_FLUX = re.compile(
    r"\b((?:AB|ST)[\s_]?mag\w*)|(?:wave|lambda|\bwl\b)[^\n]*?(?<![A-Za-z])(mag(?:nitude)?s?(?![a-z])|counts?\b|ADU\b|log\w*\W*flux)",
    re.IGNORECASE,
)


def stated_units(
    header: str, *, wavelength: bool = True, flux: bool = True, is_named: bool = False
) -> tuple[str | None, str | None]:
    """Return the requested units of wavelength and flux that a header states, as text.

    Without names of columns (`is_named`), a header that mentions counts or magnitudes implies that there is no flux.
    Raises InputError if it states several units, an unknown unit, or implies that there is no flux.
    """
    text = header[:MAX_HEADER]
    found = [_spelt(match[0].strip()) for match in _FLUX.finditer(text)]
    distinct = _distinct(found) if flux else []
    if len(distinct) > 1:
        next_to = re.search(r"flux\w*\W{0,4}(?:in\W+)?(" + _FLUX.pattern + ")", text, re.IGNORECASE)
        if next_to is None:
            raise InputError.of("flux_unit", distinct, "one: `flux_unit` says which", where="its header")
        distinct = [_spelt(next_to[1].strip())]
    if flux and not distinct and not is_named and (match := _NO_FLUX.search(text)):
        fault = f"its header speaks of {match[1] or match[2]!r}"
        raise InputError(
            fault, "a flux density: `flux_unit` names its unit", key="flux_unit", value=match[1] or match[2]
        )
    rest = re.sub(_FLUX.pattern, " FLUXUNIT ", text)
    lengths = _lengths(rest) if wavelength else []
    if len(lengths) > 1:
        raise InputError.of("wavelength_unit", lengths, "one: `wavelength_unit` says which", where="its header")
    return (lengths[0] if lengths else None), (distinct[0] if distinct else None)


def _lengths(text: str) -> list[str]:
    """Return the distinct units of wavelength in a text, without those within units of flux."""
    listed = [match[1] for line in text.splitlines() if (match := _LIST.match(line.strip().lstrip("#!%;").strip()))]
    if lengths := _distinct([match[1] for match in _NEXT_TO.finditer(text)]) or _distinct(listed):
        return lengths
    for match in _STATED.finditer(text):
        if not _QUALIFIERS.match(match[1]) and match[1] != "FLUXUNIT":
            try:
                unit = unit_of(match[1])
            except InputError as error:
                raise error.within("its header, wavelengths") from error
            if not is_spectral(unit):
                raise InputError.of("wavelength_unit", unit, "a length or a frequency", where="its header")
            return [match[1]]
    return _distinct(_ANYWHERE.findall(text))


def _spelt(name: str) -> str:
    """Convert a unit in the name of a column to the form of a unit: erg_s_cm2_A is erg/s/cm2/A."""
    name = balanced(name)
    return name.replace("_", "/") if "_" in name and not re.search(r"[/\-−]|per", name) else name.replace("_", " ")


def _distinct(names: list[str]) -> list[str]:
    """Return distinct units regardless of spelling; "W s" in prose is an energy and dropped."""
    units: dict[object, str] = {}
    for name in names:
        unit = unit_of(name)
        if not unit.is_equivalent("J"):
            units.setdefault(unit, name)
    return list(units.values())
