"""Columns of spectra: their roles by name, UCD and unit, the units that headers state, and the choice among columns.

Names are divided into words (``FluxErr``, ``STATERROR``, ``wave_lo``) with known meanings. A word such as "error" or
"sky" excludes a column from being the flux, regardless of the rest of its name. Other columns get a score for the match
of name and unit, and the best is chosen.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

from mauvecl.host.tables.names import by_word, key_of
from mauvecl.host.tables.units import NO_FLUX, SCALE, balance_brackets, is_stated, unit_of
from mauvecl.schema.errors import InputError, shortened

#: Kinds of flux units: per wavelength or frequency, per area only, per solid angle, or other.
FluxKind = Literal["density", "total", "surface brightness", "other"]
Kind = Literal[
    "wavelength", "lower edge", "upper edge", "flux", "model", "error", "quality", "continuum", "counts", "background",
    "width", "magnitude", "throughput", "luminosity", "unknown",
]  # fmt: skip

_WORDS = by_word({
    "wave": "wavelength wavelengths wave waves wavel lambda lambdas lam wl wlen wav wvl wln awav λ w",
    "other axis": "frequency freq nu ν energy wavenumber wavenum wn",
    "flux": "flux fluxes flx flam fnu fλ fν sflux irradiance photlam photnu jy",
    "weak flux": "intensity radiance brightness f value y sed spec spectrum spectra",
    "total": "lamflam nufnu wfw vfv",
    "logarithm": "log ln dex",
    "error": "err errs error errors e sig sigma unc uncert uncertainty uncertainties std stdev stddev sd rms var"
    " variance ivar invvar inverse weight weights noise stat sys syst snr sn eflux dflux ferr efl",
    "quality": "qual quality dq flag flags mask andmask ormask good bad valid pixmask",
    "continuum": "cont continuum baseline",
    "counts": "count counts cts ct adu dn electron electrons",
    "weak counts": "net gross gcounts rate photons",
    "background": "sky bkg bkgd bg background back airglow",
    "removed": "sub subtracted corrected removed",
    "width": "width widths fwhm dw dlam dlambda dwave delta d step disp wdisp dispersion res wres resolution resolving"
    " bandwidth binsize",
    "throughput": "throughput transmission transmittance trans efficiency eff qe response sensitivity sens reflectivity"
    " reflectance bandpass passband emissivity",
    "luminosity": "luminosity lum llambda lnu llam",
    "magnitude": "mag mags magnitude magnitudes abmag stmag ab st",
    "model": "model models mod template templates fit synthetic synth bestfit bestmodel",
    "low": "lo low lower min minimum left start begin",
    "high": "hi high higher upper max maximum right end stop",
    "bin": "bin edge edges",
    "vacuum": "vac vacuum",
    "air": "air",
    "neutral": "density densities dens spectral total data cal calibrated of the in",
    "label": "obs observed source dered dereddened corr rest norm normalized normalised bolo smooth smoothed raw star",
})  # fmt: skip
# Words of a name that may be joined: FLUXERR, loglam, wavehi.
_GLUED = sorted((w for w in _WORDS if len(w) > 2 or w in ("lo", "hi", "wl", "bg", "dq")), key=len, reverse=True)
_LAMBDA, _NU = "(?:lambda|lam|λ)", "(?:nu|ν)"
# Names of several words with a single meaning.
_PHRASES = tuple(
    (re.compile(rf"(?<![a-zλν])(?:{pattern})(?![a-zλν])"), word)
    for pattern, word in (
        (rf"{_LAMBDA}[\s_*.]*f(?:lux)?[\s_]*{_LAMBDA}|w[\s_*.]*f[\s_]*w", "lamflam"),
        (rf"{_NU}[\s_*.]*f(?:lux)?[\s_]*{_NU}|v[\s_*.]*f[\s_]*v", "nufnu"),
        (rf"(?:[sib]|f(?:lux)?(?:[\s_]*density)?)[\s_]*(?:{_LAMBDA}|wl|wave)", "flam"),
        (rf"(?:[sib]|f(?:lux)?(?:[\s_]*density)?)[\s_]*{_NU}", "fnu"),
        (rf"l[\s_]*(?:{_LAMBDA}|{_NU})", "luminosity"),
        (r"log_?10|lg", "log"),
        (r"spectral[\s_]*axis", "wavelength"),
        (r"s[_/]n", "snr"),
    )
)
# A word with one of these meanings determines the role, regardless of the rest of the name.
_DECIDING: tuple[Kind, ...] = (
    "error", "quality", "continuum", "background", "counts", "throughput", "luminosity",
)  # fmt: skip
#: Words in the name of a flux density that state that it is per frequency.
_PER_FREQUENCY = {"fnu", "fν", "photnu", "nu", "ν", "freq", "frequency", "hz", "hertz", "jy"}
_BRACKETS = re.compile(r"[\[(]((?:[^\[\]()]|\([^()]*\))*)[\])]\s*$")
#: Words in brackets for units that are not a flux density, or not a single unit.
_NO_DENSITY = re.compile(
    r"\b(?:cgs|SI|arb|arbitrary|relative|normali[sz]ed|counts?|adu|electrons?|a\.?u\.?)(?:\b|$)", re.IGNORECASE
)
_LOGARITHM_OF = re.compile(r"(log_?10|log|lg|ln)\s*[(\[](.*?)[)\]]\s*([(\[].*)?", re.IGNORECASE)
# Words of the IVOA's unified content descriptors (UCD1+ 1.5), by their first word.
_UCD: dict[str, Kind] = {"em.wl": "wavelength", "em.freq": "wavelength", "em.energy": "wavelength",
                         "phot.flux.density": "flux", "stat.error": "error", "meta.code": "quality",
                         "spect.continuum": "continuum", "instr.bandwidth": "width"}  # fmt: skip


@dataclass(frozen=True)
class Role:
    """Role of a column as inferred from its name, unit and UCD."""

    name: str
    kind: Kind
    score: int = 0  # score of the name for the kind, comparable among columns of one kind
    logarithm: str = ""  # base of the logarithm, "10" or "e", if the column contains logarithms; otherwise empty
    total: bool = False  # whether the flux is multiplied by its wavelength or frequency according to the name
    per_frequency: bool = False  # whether a flux is one per frequency according to its name
    unit: str | None = None  # stated unit, or the unit in the name, as in ``flux_W_m2_nm`` or ``wave [nm]``


@lru_cache(maxsize=1024)
def role_of(name: str, unit: str | None = None, ucd: str = "") -> Role:
    """Infer the role of a column."""
    base, unit_in_name = divide_name(name)
    words = words_of(base)
    kind, score = _kind_of(words)
    if kind == "magnitude" and (system := set(words) & {"ab", "abmag", "st", "stmag"}):
        # Only the zero points of AB and ST magnitudes are fluxes.
        kind, score, unit_in_name = "flux", 0, "ABmag" if system & {"ab", "abmag"} else "STmag"
    if not is_stated(unit) or (unit_in_name is not None and re.search("mag", str(unit), re.IGNORECASE)):
        unit = unit_in_name
    is_known, spectral, flux = _kinds_of_unit(unit)
    if kind == "magnitude" and flux == "density":
        kind = "flux"
    if kind == "unknown" and ucd:
        kind, score = next(((k, 3) for first, k in _UCD.items() if ucd.lower().startswith(first)), (kind, score))
    if kind == "unknown" and not words:
        # A name that is only a unit, as in a line "nm, flam".
        kind, score = ("wavelength", 3) if spectral else ("flux", 3) if flux != "other" else (kind, 0)
    if kind == "unknown" and flux == "density":
        kind, score = "flux", 1
    # A unit of another kind contradicts the name; an unknown unit raises InputError at conversion.
    if kind in ("flux", "model") and (is_known or (unit is not None and NO_FLUX.search(unit))):
        score += 1 if flux in ("density", "total") else -6
    if is_known and kind == "wavelength":
        score += 1 if spectral else -6
    logarithm = next(("e" if word == "ln" else "10" for word in words if _WORDS.get(word) == "logarithm"), "")
    if logarithm:
        score -= 1
    total = any(_WORDS.get(word) == "total" for word in words)
    per_frequency = kind in ("flux", "model") and not total and bool(_PER_FREQUENCY & set(words))
    # VOTable states it by the second word of a UCD, as in phot.flux.density;em.freq.
    per_frequency |= kind == "flux" and ucd.lower().startswith("phot.flux.density;em.freq")
    return Role(name, kind, score, logarithm, total, per_frequency, unit)


def _kind_of(words: Sequence[str]) -> tuple[Kind, int]:
    """Return the kind of column that the words of a name indicate, and their score."""
    if words == ("spectral",):
        # The axis of SSAP.
        return "wavelength", 1
    has = {_WORDS.get(word, "label") for word in words if _WORDS.get(word) != "logarithm"}
    if len(words) == 1 and len(words[0]) == 1:
        # An "e" may be an energy, a "d" a distance.
        has -= {"error", "width"}
    if {"background", "removed"} <= has:
        has -= {"background", "removed"}
    is_axis, is_flux = bool(has & {"wave", "other axis"}), bool(has & {"flux", "total"})
    for kind in _DECIDING:
        if kind in has:
            return kind, 0
    if "weak counts" in has and not is_flux:
        return "counts", 0
    if "width" in has:
        return "width", 0
    qualifiers = has - {"flux", "total", "wave", "other axis", "vacuum", "air", "neutral"}
    if is_flux or ("weak flux" in has and not is_axis):
        # Limits of a flux are those of its confidence interval.
        if has & {"low", "high"}:
            return "error", 0
        score = 3 if is_axis or qualifiers - {"weak flux"} else 5 if words in (("flux",), ("fluxes",)) else 4
        return "flux", score if is_flux else score - 2
    if has & {"low", "high"} and (is_axis or "bin" in has):
        return ("lower edge" if "low" in has else "upper edge"), 1
    if is_axis:
        score = (4 if "wave" in has else 2) - (2 if qualifiers else 0) - (1 if "air" in has else 0)
        # A "w" may be a weight.
        return "wavelength", 0 if words == ("w",) else score
    if "magnitude" in has and words != ("st",):
        return "magnitude", 0
    return ("model", 1) if "model" in has else ("unknown", 0)


@lru_cache(maxsize=1024)
def _kinds_of_unit(unit: str | None) -> tuple[bool, bool, FluxKind]:
    """Return whether a unit is known, whether it is one of wavelength, and its kind of flux."""
    try:
        parsed = None if unit is None else unit_of(unit)
    except InputError:
        parsed = None
    if parsed is None or str(parsed) == "dex":
        return False, False, "other"
    return True, is_spectral(parsed), flux_kind(parsed)


def linear(unit: Any) -> Any:
    """Return the linear unit of a logarithmic unit or magnitude; others unchanged."""
    return getattr(unit, "physical_unit", unit)


def is_spectral(unit: Any) -> bool:
    """Return whether a unit is one of wavelength, frequency, wavenumber or photon energy."""
    import astropy.units as u

    return bool(linear(unit).is_equivalent(u.m, u.spectral()))


def flux_kind(unit: Any) -> FluxKind:
    """Classify a unit of flux."""
    import astropy.units as u

    unit = linear(unit)
    per_area = (u.W / u.m**2, u.photon / (u.s * u.m**2))
    densities = tuple(flux / interval for flux in per_area for interval in (u.m, u.Hz))
    if unit.is_equivalent(densities):
        return "density"
    if unit.is_equivalent(per_area):
        return "total"
    return "surface brightness" if (unit * u.sr).is_equivalent(densities + per_area) else "other"


def divide_name(name: str) -> tuple[str, str | None]:
    """Divide a column's name into the quantity and its unit, if any."""
    name = " ".join(name.strip().strip("\"'").split())
    if is_unit(name, alone=True):
        return "", name
    if match := _LOGARITHM_OF.fullmatch(name):
        # log10(wave/AA), log(F) [erg/s/cm2/A]
        name = f"{match[1]} {match[2]} {match[3] or ''}".strip()
    base, unit = name, None
    if (match := _BRACKETS.search(name)) and match.start() > 0:
        inner = match[1].strip()
        if is_unit(inner) or re.search(r"\d|\^|/", inner) or _NO_DENSITY.search(inner):
            base, unit = name[: match.start()], inner
    elif division := _after_underscore(name.split("_")):
        base, unit = division
    elif (match := re.search(r"\s?/\s*(\S+)$|\sin\s+(\S+)$", name)) and is_unit(match[1] or match[2]):
        base, unit = name[: match.start()], match[1] or match[2]
    elif (match := SCALE.search(name)) and match.start() > 0:
        # A factor without a unit, as in "flux/10^-15", is not a unit.
        base, unit = re.sub(r"\s*[/*]\s*$|\s+x\s*$", "", name[: match.start()]), name[match.start() :]
    return base, unit if unit is None else balance_brackets(unit)


def _after_underscore(parts: Sequence[str]) -> tuple[str, str] | None:
    """Divide a name at an underscore before its unit, as in ``flux_W_m2_nm`` and ``f_1e-15_erg_s-1_cm-2_A-1``."""
    for k in range(1, len(parts)):
        base, tail = "_".join(parts[:k]), parts[k:]
        for spelt in ("/".join(tail), " ".join(tail)):
            if _NO_DENSITY.fullmatch(spelt):
                return base, spelt
            if _fits(parts[:k], spelt):
                # A factor between the name and the unit.
                match = SCALE.search(base)
                return (base, spelt) if match is None else (base[: match.start()], f"{base[match.start() :]} {spelt}")
    return None


def _fits(base: Sequence[str], unit: str) -> bool:
    """Return whether a unit at the end of a name matches the quantity: wavelength or flux."""
    _, spectral, flux = _kinds_of_unit(unit)
    if not spectral and flux == "other":
        return False
    kind, _ = _kind_of(words_of("_".join(base)))
    is_axis = kind in ("wavelength", "lower edge", "upper edge", "width")
    return spectral and len(unit) < 12 if is_axis else flux != "other" and unit.lower() not in ("ab", "st")


def is_unit(text: str, alone: bool = False) -> bool:
    """Return whether a text is a unit of wavelength or flux; if alone, one that is unlikely to be a word."""
    if alone and text not in ("A", "Å") and (len(text) < 2 or text.lower() in ("ab", "st", "erg")):
        return False
    _, spectral, flux = _kinds_of_unit(text)
    return spectral or flux != "other"


@lru_cache(maxsize=1024)
def words_of(name: str) -> tuple[str, ...]:
    """Divide a name into lower-case words: at punctuation, capitals and digits, and between known words."""
    name = re.sub(r"(?<=[a-zµλν])(?=[A-Z])", " ", name.strip())
    lower = name.lower()
    for pattern, word in _PHRASES:
        lower = pattern.sub(word, lower)
    words: list[str] = []
    for chunk in re.findall(r"[^\W\d_]+|\d+", lower):
        words += _unglued(chunk) or [chunk]
    return tuple(words)


def _unglued(chunk: str) -> list[str] | None:
    """Divide letters into known words, or return None."""
    if chunk in _WORDS or chunk.isdigit():
        return [chunk]
    for word in _GLUED:
        if chunk.startswith(word):
            remainder = chunk[len(word) :]
            if (remainder in _WORDS or len(remainder) > 1) and (words := _unglued(remainder)):
                return [word, *words]
    # wmin, efluxes
    if chunk[:1] == "w" and _WORDS.get(chunk[1:]) in ("low", "high"):
        return ["w", chunk[1:]]
    return None


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

    If the columns have no names (`is_named` is false), counts or magnitudes in a header mean that there is no flux.
    """
    text = header[:20_000]
    distinct = _distinct_units([_spelt(match[0].strip()) for match in _FLUX.finditer(text)]) if flux else []
    next_to = re.search(r"flux\w*\W{0,4}(?:in\W+)?(" + _FLUX.pattern + ")", text, re.IGNORECASE)
    if len(distinct) > 1 and next_to is not None:
        distinct = [_spelt(next_to[1].strip())]
    if flux and not distinct and not is_named and (match := _NO_FLUX.search(text)):
        fault = f"its header mentions {match[1] or match[2]!r}, but must state a flux density"
        raise InputError(f"{fault}: `flux_unit` names its unit", key="flux_unit")
    lengths = _lengths(_FLUX.sub(" FLUXUNIT ", text)) if wavelength else []
    for quantity, units in (("flux", distinct), ("wavelength", lengths)):
        if len(units) > 1:
            fault = f"its header names several units of the {quantity}: {', '.join(units)}"
            raise InputError(f"{fault}; use `{quantity}_unit` to say which", key=f"{quantity}_unit")
    return next(iter(lengths), None), next(iter(distinct), None)


def _lengths(text: str) -> list[str]:
    """Return the distinct units of wavelength in a text, without those within units of flux."""
    in_lists = [match[1] for line in text.splitlines() if (match := _LIST.match(line.strip().lstrip("#!%;").strip()))]
    if lengths := _distinct_units([match[1] for match in _NEXT_TO.finditer(text)]) or _distinct_units(in_lists):
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
    return _distinct_units(_ANYWHERE.findall(text))


def _spelt(name: str) -> str:
    """Convert a unit in the name of a column to the form of a unit: erg_s_cm2_A is erg/s/cm2/A."""
    name = balance_brackets(name)
    return name.replace("_", "/") if "_" in name and not re.search(r"[/\-−]|per", name) else name.replace("_", " ")


def _distinct_units(names: list[str]) -> list[str]:
    """Return distinct units regardless of spelling; "W s" in prose is an energy and dropped."""
    units: dict[object, str] = {}
    for name in names:
        unit = unit_of(name)
        if not unit.is_equivalent("J"):
            units.setdefault(unit, name)
    return list(units.values())


#: Largest number of names in a message.
MAX_LISTED = 12
#: Names that can be typed between the brackets of ``FILE[name]``.
TYPED = re.compile(r"[^\[\],\"'\s](?:[^\[\],\"'\n\r\t]{0,38}[^\[\],\"'\s])?")
AXES = ("wavelength", "lower edge", "upper edge")


def index_of(kind: str, word: str, n: int) -> int | None:
    """Return the index in a word such as ``row 3``, or None; raise InputError if there are fewer than that, `n`."""
    match = re.fullmatch(rf"{kind}\s+(\d{{1,9}})", word.strip(), re.IGNORECASE)
    if match is None or int(match[1]) == 0:
        return None
    if int(match[1]) > n:
        raise InputError.of(kind, int(match[1]), f"between 1 and {n}")
    return int(match[1]) - 1


def join(names: Sequence[str]) -> str:
    """Join names for a message; a long list ends with the number of omitted names."""
    shown = [name.strip()[:40] for name in names]
    return ", ".join(shown[:MAX_LISTED]) + (f" and {len(shown) - MAX_LISTED} more" if len(shown) > MAX_LISTED else "")


def selector(name: str, kind: str, index: int, names: Sequence[str]) -> str:
    """Return ``FILE[name]`` for a message, or ``FILE[row 3]`` where the name cannot be typed or is not the only one."""
    word = name.strip()
    typed = TYPED.fullmatch(word) is not None and word.isprintable()
    is_unique = sum(key_of(other) == key_of(word) for other in names) < 2
    return f"FILE[{word}]" if typed and is_unique else f"FILE[{kind} {index + 1}]"


def choose(roles: Sequence[Role], words: Sequence[str]) -> tuple[tuple[int, ...], int]:
    """Choose the columns of wavelength, or of both edges of each bin, and of flux; the user's words may name some."""
    names = [role.name for role in roles]
    selected = [_named(word, names) for word in words]
    axes = [i for i in selected if roles[i].kind in AXES] or (selected[:1] if len(selected) == 2 else [])
    best, low, high = (_best(kind, roles) for kind in AXES)
    wavelength: tuple[int, ...] = tuple(axes[:1])
    if not axes and (best or not (low or high)):
        wavelength = (_only("wavelength", names, best),)
    elif not axes:
        wavelength = _only("lower edge of the bins", names, low), _only("upper edge of the bins", names, high)
    fluxes = [i for i in selected if i not in wavelength]
    if len(fluxes) > 1:
        raise InputError.of("columns", words, "one flux, and one wavelength at most")
    return wavelength, fluxes[0] if fluxes else _flux(roles, names, wavelength)


def _named(name: str, names: Sequence[str]) -> int:
    """Return the place of the column that a user names; raises InputError unless it is one."""
    indices = [i for i, column in enumerate(names) if column.strip() == name]
    if not indices and (index := index_of("column", name, len(names))) is not None:
        return index
    indices = indices or [i for i, column in enumerate(names) if key_of(column) == key_of(name)]
    if len(indices) != 1:
        fault = f"{'several columns are' if indices else 'no column is'} named {shortened(name)}"
        raise InputError(f"{fault}; give one of {join(names)}", key="columns")
    return indices[0]


def _flux(roles: Sequence[Role], names: Sequence[str], wavelength: tuple[int, ...]) -> int:
    """Return the place of the column of flux; raises InputError if none is recognised."""
    if best := _best("flux", roles, wavelength) or _best("model", roles, wavelength):
        return _only("flux", names, best)
    candidates = [i for i in range(len(names)) if i not in wavelength]
    unknown = [i for i in candidates if roles[i].kind == "unknown"]
    if len(candidates) == len(unknown) == 1:
        return unknown[0]
    shown = (unknown or candidates or [0])[0]
    descriptions = [f"{names[i].strip()[:40]} ({roles[i].kind})" for i in candidates]
    fault = f"no column is recognised as a star's flux, only {join(descriptions) or 'the wavelength'}"
    raise InputError(f"{fault}; give the column as in {selector(names[shown], 'column', shown, names)}", key="columns")


def _best(kind: str, roles: Sequence[Role], without: Sequence[int] = ()) -> list[int]:
    """Return the columns of a kind that have the highest score."""
    columns = [i for i, role in enumerate(roles) if role.kind == kind and i not in without]
    highest = max((roles[i].score for i in columns), default=0)
    return [i for i in columns if roles[i].score == highest]


def _only(quantity: str, names: Sequence[str], indices: Sequence[int]) -> int:
    """Return the place of the only column of a quantity; raises InputError if there are several."""
    if len(indices) == 1:
        return indices[0]
    if not indices:
        fault = f"no column is recognised as the {quantity} among {join(names) or 'none'}"
        raise InputError(f"{fault}; give two columns as in FILE[wavelength,flux]", key="columns")
    several = [names[i].strip() for i in indices]
    fault = f"{len(several)} columns may be the {quantity}: {join(several)}"
    raise InputError(f"{fault}; give one as in {selector(several[-1], 'column', indices[-1], names)}", key="columns")
