"""Units of spectra in headers, wavelengths in air or vacuum, and ranges of wavelength."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from mauvecl.host.arrays import Bool, Float
from mauvecl.host.tables.units import balanced, is_spectral, unit_of
from mauvecl.schema.errors import InputError

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
_SCALE = rf"(?:10{_B}(?:\^|\*\*){_B}\(?[-+−]?\d+\)?|10[⁻⁺]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+|\d+(?:\.\d*)?[eEdD][-+]?\d+)"
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


def stated_units(header: str, *, wavelength: bool, flux: bool, is_named: bool) -> tuple[str | None, str | None]:
    """Return the requested units of wavelength and flux that a header states, as text.

    Without names of columns (`is_named`), a header that mentions counts or magnitudes implies that there is no flux.
    """
    text = header[:20_000]
    found = [_spelt(match[0].strip()) for match in _FLUX.finditer(text)]
    distinct = _distinct(found) if flux else []
    if len(distinct) > 1:
        next_to = re.search(r"flux\w*\W{0,4}(?:in\W+)?(" + _FLUX.pattern + ")", text, re.IGNORECASE)
        if next_to is None:
            fault = f"its header names several units of the flux: {', '.join(distinct)}"
            raise InputError(f"{fault}; use `flux_unit` to say which", key="flux_unit")
        distinct = [_spelt(next_to[1].strip())]
    if flux and not distinct and not is_named and (match := _NO_FLUX.search(text)):
        fault = f"its header speaks of {match[1] or match[2]!r}, but must speak of a flux density"
        raise InputError(f"{fault}: `flux_unit` names its unit", key="flux_unit")
    rest = re.sub(_FLUX.pattern, " FLUXUNIT ", text)
    lengths = _lengths(rest) if wavelength else []
    if len(lengths) > 1:
        fault = f"its header names several units of the wavelength: {', '.join(lengths)}"
        raise InputError(f"{fault}; use `wavelength_unit` to say which", key="wavelength_unit")
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


#: Range of the nominal instrument, nm (the paper's abstract).
NEEDED_NM = (200.0, 700.0)
#: The same, extended by the reach of the line spread function (the paper, section "Preparing the input spectrum").
SPAN_NM = (180.0, 750.0)
#: Fraction of `NEEDED_NM` that a spectrum must cover; with less, nearly all of the light would be another star's.
MIN_MEASURED = 1 / 3
#: Range of wavelengths, nm, outside which an assumed unit is unlikely.
PLAUSIBLE_NM = (50.0, 10_000.0)
#: A step between points is a gap if it exceeds this width, nm, and this multiple of the usual spacing.
GAP_NM, GAP_TIMES = 10.5, 10.0
#: Likely units of wavelengths without a stated unit, in nm.
_USUAL_UNITS = {"nm": 1.0, "Angstrom": 0.1, "um": 1000.0}


def measured_part(nm: Float) -> float:
    """Return the fraction of `NEEDED_NM` that wavelengths cover, without gaps."""
    if nm.size < 2:
        return 0.0
    steps = np.diff(np.clip(nm, *NEEDED_NM))[~is_gap(np.diff(nm))]
    return float(steps.sum() / (NEEDED_NM[1] - NEEDED_NM[0]))


def is_gap(steps: Float) -> Bool:
    """Return which of the steps between wavelengths, nm, are gaps."""
    wide: Bool = (steps > GAP_NM) & (steps > GAP_TIMES * np.median(steps))
    return wide


def _part(low: float, high: float) -> float:
    shared = min(high, NEEDED_NM[1]) - max(low, NEEDED_NM[0])
    return max(0.0, shared / (NEEDED_NM[1] - NEEDED_NM[0]))


def likely_unit(low: float, high: float, unit: str) -> str | None:
    """Return the only unit other than `unit` in which the numbers cover the required range, or None."""
    parts = {other: _part(low * factor, high * factor) for other, factor in _USUAL_UNITS.items() if other != unit}
    fitting = [other for other, part in parts.items() if part >= MIN_MEASURED and low > 0.0]
    # Short ultraviolet spectra cover part of the range in Angstrom, but would start in the infrared in nm.
    if not fitting and parts.get("Angstrom", 0.0) > 0.0 and low > 900.0:
        fitting = ["Angstrom"]
    return fitting[0] if len(fitting) == 1 else None


def check_assumed_unit(values: Float, unit: str) -> None:
    """Raise InputError if another unit of the wavelengths is as likely as the assumed one."""
    finite = values[np.isfinite(values)]
    factor = _USUAL_UNITS.get(unit)
    if not finite.size or factor is None:
        return
    low, high = float(finite.min()), float(finite.max())
    own, other = _part(low * factor, high * factor), likely_unit(low, high, unit)
    elsewhere = 0.0 if other is None else _part(low * _USUAL_UNITS[other], high * _USUAL_UNITS[other])
    fault = f"wavelengths from {low:g} to {high:g} without a stated unit"
    needed, remedy = f"of {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm", "give their unit: `wavelength_unit"
    if other is not None and (own < MIN_MEASURED or elsewhere >= max(own, 1.0 - 1e-9)):
        fault += f" look like {other}, in which they cover {elsewhere:.0%} {needed}, and {own:.0%} in {unit}"
        also = f" or `wavelength_unit={unit!r}`" if own >= MIN_MEASURED else ""
        raise InputError(f"{fault}; {remedy}={other!r}`{also}", key="wavelength_unit")
    if own < MIN_MEASURED:
        fault += f" cover {own:.0%} {needed}, not at least a third, in {unit}"
    elif low * factor < PLAUSIBLE_NM[0] or high * factor > PLAUSIBLE_NM[1]:
        fault += f" extend beyond {PLAUSIBLE_NM[0]:g}-{PLAUSIBLE_NM[1]:g} nm in {unit}"
    else:
        return
    raise InputError(f"{fault}; {remedy}` names it", key="wavelength_unit")


Medium = Literal["air", "vacuum"]

#: Names of keywords whose value is a medium: of IRAF (AIRORVAC), MAST, surveys and users, as in ``WAVSYS = 'air'``.
_NAMED = re.compile(r"WAV|LAM|WL|DISP|MEDI|REFFRAME|WCSNAME|SPECTRAL|AIR(?:_|OR)?VAC|VAC(?:_|OR)?AIR")
#: Names of keywords that are true or false, as in ``VACUUM = T``: those of a medium alone, and those of wavelengths.
_LOGICAL = re.compile(r"(?:IS|IN_?)?(AIR|VAC)(?:UUM)?|(?=.*(?:WAV|LAM|WL|SPEC|DISP)).*?(AIR|VAC)(?!RO).*")
_MEDIUM = re.compile(r"(?:in |standard )?(air|vac\w*)(?: wavelengths?)?(?:\s*[,;(].*)?")
_TRUE, _FALSE = ("true", "t", "yes", "y", "1", "1.0"), ("false", "f", "no", "n", "0", "0.0")

#: Words for air, including those of IVOA's UCD (em.wl;obs.atmos) and of FITS (AWAV).
_AIR = re.compile(
    r"\b(?:in|are|is|standard)\s+air\b|\bair\s+wavelengths?|wavelengths?\W{0,3}(?:\(|in\s+)?air\b|\bawav"
    r"|\bem\.wl;obs\.a|_air(?:\b|_)|\bair_|\(air\)",
    re.IGNORECASE,
)
_CONVERTED = tuple(
    (re.compile(rf"\b{one}\w*(?:\s+wavelengths?)?[\s_-]*(?:to|2|->|into)[\s_-]*{other}\w*", re.IGNORECASE), medium)
    for one, other, medium in (("vac", "air", "air"), ("air", "vac", "vacuum"))
)
_VACUUM = re.compile(r"(?:\b|_)vac(?:uum)?(?:\b|_)|\bvacuum", re.IGNORECASE)


def medium_of(headers: Sequence[Mapping[str, Any]]) -> Medium | None:
    """Return the medium of wavelengths that keywords of headers state, which must agree, or None."""
    from mauvecl.host.tables.fits_tables import text_at

    found: dict[str, Medium] = {}
    for header in headers:
        for key in map(str, header):
            name = re.sub(r"[\s-]+", "_", key.strip().upper())
            medium = _stated(name, text_at(header, key).lower())
            if medium is not None:
                found[name] = medium
    if len(set(found.values())) > 1:
        words = " and ".join(f"{key} says {medium}" for key, medium in sorted(found.items()))
        fault = f"its header contradicts itself: {words}; use `wavelength_unit='nm air'` to say which"
        raise InputError(fault, key="wavelength_unit")
    return next(iter(found.values()), None)


def _stated(name: str, text: str) -> Medium | None:
    """Return the medium that a keyword's value states; None for no value, and for words on something else."""
    if re.fullmatch(r"T?CTYPE?\d*|\d*CTYP\d+", name):
        # The standard's name of wavelengths in air (Greisen et al. 2006); in tables WAVE is a usual name as well.
        return "air" if text.startswith("awav") else None
    word, logical = _MEDIUM.fullmatch(text), _LOGICAL.fullmatch(name)
    if word and (logical or _NAMED.search(name)):
        return "air" if word[1] == "air" else "vacuum"
    if logical and text in (*_TRUE, *_FALSE):
        return "air" if ("AIR" in logical.groups()) == (text in _TRUE) else "vacuum"
    # Some observatories keep a pressure or a pump under AIR and VAC.
    if logical and logical[1] and text and name not in ("AIR", "VAC"):
        raise InputError.of(name, text, "true or false, or air or vacuum", where="its header")
    return None


def unit_and_medium(unit: str) -> tuple[str | None, Medium | None]:
    """Divide ``nm air`` or ``Angstrom (vacuum)`` into unit and medium."""
    match = re.fullmatch(r"\s*(.*?)[\s,;(\[_]*(?<![a-z])(?:in )?(air|vac(?:uum)?)[)\].]?\s*", unit, re.IGNORECASE)
    if match is None:
        return unit or None, None
    return match[1] or None, "air" if match[2].lower() == "air" else "vacuum"


def vacuum_wavelengths(
    nm: Float, column: str, remarks: str, given: Medium | None, headers: Sequence[Mapping[str, Any]]
) -> tuple[Float, tuple[str, ...]]:
    """Return vacuum wavelengths, nm, and messages about them.

    The medium is the given one, else that in the name of the column, in keywords of headers, or in remarks.
    """
    messages: tuple[str, ...] = ()
    named, said = _words(column), _words(remarks)
    medium = given or (named if named != "both" else None) or medium_of(headers) or (said if said != "both" else None)
    if medium is None and "both" in (named, said):
        messages = ("its header speaks of air and of vacuum: ASSUMED vacuum; `wavelength_unit='nm air'` says air",)
    if medium != "air":
        return nm, messages
    return vacuum_from_air(nm), ("its wavelengths are in air, converted to vacuum (Ciddor 1996, above 200 nm)",)


def _words(text: str) -> Medium | Literal["both"] | None:
    """Return the medium that a text speaks of."""
    for pattern, medium in _CONVERTED:
        # Wavelengths that were converted are in the second medium.
        text = pattern.sub(f" in {medium} ", text)
    air, vacuum = _AIR.search(text), _VACUUM.search(text)
    return "both" if air and vacuum else "air" if air else "vacuum" if vacuum else None


def vacuum_from_air(air_nm: Float) -> Float:
    """Return vacuum wavelengths, nm, of wavelengths in standard air (15 C, 101325 Pa, dry, 450 ppm CO2).

    Ciddor 1996, Applied Optics 35, 1566, equation 1, doi 10.1364/AO.35.001566. Wavelengths below 200 nm are vacuum
    wavelengths by convention and remain unchanged (Morton 1991, ApJS 77, 119).
    """
    vacuum = air_nm.copy()
    there = np.isfinite(air_nm) & (air_nm >= 200.0)
    for _ in range(4):
        # Squared wavenumber, um-2. The index hardly changes over the shift, so the iteration converges at once.
        wavenumber2 = (1000.0 / vacuum[there]) ** 2
        index = 1.0 + 0.05792105 / (238.0185 - wavenumber2) + 0.00167917 / (57.362 - wavenumber2)
        vacuum[there] = air_nm[there] * index
    return vacuum
