"""Units, time systems and dates of the numbers in files, and wavelengths in air or vacuum."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.tables.names import MISSING_WORDS, by_word, divided_unit, in_brackets, is_missing, text_at
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    import astropy.units as u

_DENSITIES = {
    "flam": "erg / (s cm2 Angstrom)",
    "fnu": "erg / (s cm2 Hz)",
    "photlam": "photon / (s cm2 Angstrom)",
    "photnu": "photon / (s cm2 Hz)",
    # As in Spextool's documentation.
    "wm-2um-1": "W / (m2 um)",
} | {"jansky": "Jy", "janskys": "Jy", "jy": "Jy", "mjy": "mJy", "ujy": "uJy", "njy": "nJy"}
# Lower-case spellings and astropy's names; astropy parses A as ampere.
_WORDS = by_word({
    "Angstrom": "a aa ang angs angstrom angstroms angstroem angstroems ångström ångströms å",
    "nm": "nm nanometer nanometers nanometre nanometres",
    "um": "um micron microns micrometer micrometers micrometre micrometres",
    "mm": "mm", "cm": "cm", "m": "m meter meters metre metres",
    "Hz": "hz hertz", "GHz": "ghz", "THz": "thz", "eV": "ev", "keV": "kev",
    "erg": "erg ergs", "J": "j joule joules", "W": "w watt watts",
    "s": "s sec secs second seconds", "photon": "photon photons ph phot",
    "sr": "sr ster sterad steradian steradians", "arcsec": "arcsec arcsecond arcseconds",
})  # fmt: skip
_TYPOGRAPHY = str.maketrans("µμ−–⁻⁺⁰¹²³⁴⁵⁶⁷⁸⁹·⋅×Å", "uu---+0123456789..*Å")
#: Marks of LaTeX that say nothing of a unit.
_LATEX = re.compile(r"\$|\\(?:mathrm|rm|text|,|;|:|!|(?=AA))")
SCALE = re.compile(
    r"(?:x\s*|\*\s*)?(?:10\s*(?:\^|\*\*)\s*\(?\s*([+-]?\d{1,3})\s*\)?|10([+-]\d{1,3})(?!\d)|(\d+(?:\.\d*)?[eEdD][+-]?\d{1,3}))"
)
#: Wavenumbers in the denominator: W m-2 / cm-1, erg / (s cm2 cm-1), mW m-2 (cm-1)-1, W cm / m2.
_PER_WAVENUMBER = re.compile(r"/.*\bcm\s*(?:\^|\*\*)?\s*[({]?-1|\(cm\^?-1\)|\bc?m\^?-?2\s+cm$|\bcm\s*/\s*m\^?2$")
#: Ambiguous factors: 10e-16 may stand for 10^-16, and a factor after the unit may multiply or divide the numbers.
_AMBIGUOUS = re.compile(r"(10(?:\.0*)?)[eEdD]([+-]?\d+)|(?<=.)[*x]\s*10\s*(?:\^|\*\*)\s*\+?(\d+)")
# Magnitudes with a defined zero point; nanomaggies are linear, 22.5 mag (AB) each (SDSS DR18, "magnitudes").
_AB = re.compile(r"(?:m(?:ag)?s?[_ (]*)?ab[) ]*(?:[_ ]?mag(?:nitude)?s?)?", re.IGNORECASE)
_ST = re.compile(r"(?:m(?:ag)?s?[_ (]*)?st[) ]*(?:[_ ]?mag(?:nitude)?s?)?", re.IGNORECASE)
_NANOMAGGIES = re.compile(r"n(?:ano)?m(?:ag)?g(?:y|ies|ys)", re.IGNORECASE)
_LOGARITHM = re.compile(r"(?:log(?:_?10)?|dex)(?:\s*[\s_(\[]\s*(.*?)\s*\]?)?", re.IGNORECASE)
NO_FLUX = re.compile(r"mag|^(counts?|cts?|adu|dn|fn|electrons?)\b|^e-", re.IGNORECASE)
# "na" is a nanoyear.
_NO_UNIT = {*MISSING_WORDS} - {"na"}


def is_stated(text: object) -> bool:
    """Return whether a unit field contains a unit, instead of an empty text or a word for none."""
    return text is not None and str(text).strip().strip("'\"").lower() not in _NO_UNIT


@lru_cache(maxsize=1024)
def unit_of(text: str) -> u.UnitBase | u.function.FunctionUnitBase:
    """Parse a unit in any usual spelling.

    It may have capitals, plurals, leading powers of ten, ``A`` for Angstrom, ``FLAM``, typographic superscripts,
    ``log(...)``, and AB and ST magnitudes. Raises InputError for an unknown unit, other magnitudes, and counts.
    """
    import astropy.units as u

    name = in_brackets(re.sub("[{}]", "", _LATEX.sub(" ", text.translate(_TYPOGRAPHY))).strip().strip("'\""))
    if _AB.fullmatch(name):
        return u.ABmag
    if _ST.fullmatch(name):
        return u.STmag
    if _NANOMAGGIES.fullmatch(name):
        return u.CompositeUnit(1e-9, [u.AB], [1])
    expected = "a unit such as Angstrom, nm or erg / (s cm2 Angstrom)"
    if match := _LOGARITHM.fullmatch(name):
        return u.dex(_linear_unit(balance_brackets(match[1]), text, expected)) if match[1] else u.dex
    if NO_FLUX.search(name):
        raise InputError.of("unit", text.strip(), f"a flux density, not a magnitude or count: {expected}")
    return _linear_unit(name, text, expected)


#: Counts by astropy's names; DN and adu are the same. A minus before a digit is that of an exponent, as in 1e-3.
_COUNTS = {
    name: re.compile(rf"(?<![\w.])(?:{words})(?!\w)", re.IGNORECASE)
    for name, words in {"adu": "dn|adu", "electron": r"e\^?-|electrons?", "count": "counts?|cts?"}.items()
}


def counts_unit(text: str) -> u.UnitBase | None:
    """Return the unit in a text, if it is one of counts in any usual spelling, as ``e-/s`` or ``DN/sec``, or None."""
    name, n_found = in_brackets(text.translate(_TYPOGRAPHY)), 0
    for unit, words in _COUNTS.items():
        name, n = words.subn(unit, name)
        n_found += n
    try:
        return _linear_unit(name, text, "a unit of counts") if n_found else None
    except InputError:
        return None


def counts_in(text: str) -> tuple[float, bool] | None:
    """Return the number that is one DN, or one DN/s, in a unit of counts, and whether it is a rate.

    The unit is of adu or DN, in any usual spelling, such as ``DN/sec`` or ``adu.s-1``; None for another one.
    """
    import astropy.units as u

    unit = counts_unit(text) or u.one
    counts = next((counts for counts in (u.adu, u.adu / u.s) if counts.is_equivalent(unit)), None)
    return None if counts is None else (float(counts.to(unit)), counts != u.adu)


def _scale_and_name(name: str) -> tuple[float, str]:
    """Return the factor before or after the name of a unit, and the name."""
    if match := SCALE.match(name):
        scale = float((match[3] or f"1e{match[1] or match[2]}").lower().replace("d", "e"))
        return scale, re.sub(r"^\s*[*.x]?\s*", "", name[match.end() :])
    if match := re.search(rf"\s*[(\[]?\s*[*x]\s*({SCALE.pattern})[)\]]?$", name):
        return float(match[4] or f"1e{match[2] or match[3]}"), name[: match.start()]
    return 1.0, name


def _linear_unit(name: str, text: str, expected: str) -> u.UnitBase:
    """Parse the name of a unit that is no logarithm; messages quote the `text` and what was `expected` instead."""
    import astropy.units as u

    unknown = InputError.of("unit", text.strip(), f"a known unit: {expected}")
    # astropy takes a comma for a structure of two units, and long for a long text.
    if not name or len(name) > 100 or "," in name:
        raise unknown
    if match := _AMBIGUOUS.search(name):
        power = int(match[2] or match[3])
        alternative = f"1e{power + 1}" if match[2] else f"1e{-power}"
        fault = f"unit = {shortened(text.strip())}: its factor may be 1e{power} or {alternative}"
        usual = f"a unit such as '1e{-abs(power)} erg / (s cm2 Angstrom)': `flux_unit` names it"
        raise InputError(f"{fault}; give {usual}", key="unit")
    scale, name = _scale_and_name(name)
    name = balance_brackets(name.rstrip(". "))
    if name not in ("MJy", "MJY"):
        name = _DENSITIES.get(name.lower(), name)
    per_wavenumber = _PER_WAVENUMBER.search(name) is not None
    name = re.sub(r"\(\s*cm\^?-1\s*\)\s*(?:\^|\*\*)?\(?-1\)?", "cm", name)
    name = re.sub(r"\bper\b", "/", name, flags=re.IGNORECASE)
    # Exponents in brackets: s**(-1), cm^{-2}.
    name = re.sub(r"(?:\^|\*\*)\s*[({]\s*([+-]?\d+)\s*[)}]", r"**\1", name)
    respelled = re.sub(r"[A-Za-zÅåö]+", lambda word: _WORDS.get(word[0].lower(), word[0]), name)
    registry = u.get_current_unit_registry().registry
    for spelling in (respelled, name):
        # astropy takes 20 ms to fail, because it searches for similar names.
        if not all(word in registry for word in re.findall(r"[^\W\d_]+", spelling)):
            continue
        try:
            with warnings.catch_warnings():
                # Several slashes are discouraged but common.
                warnings.simplefilter("ignore")
                parsed = u.CompositeUnit(scale, [u.Unit(spelling)], [1]) if scale != 1.0 else u.Unit(spelling)
        except (ValueError, TypeError, OverflowError, RecursionError):
            continue
        if per_wavenumber and parsed.is_equivalent((u.W / u.m, u.photon / u.s / u.m)):
            # Per frequency, which is the wavenumber times the speed of light; astropy reduces cm-2 / cm-1 to cm-1.
            return parsed / u.CompositeUnit(299_792_458.0, [u.m, u.s], [1, -1])
        return parsed
    raise unknown


def balance_brackets(name: str) -> str:
    """Remove brackets that enclose the whole name or have no partner."""
    while name[:1] == "(" and (name.count("(") > name.count(")") or re.fullmatch(r"\([^()]*\)", name)):
        name = name[1:]
    while name[-1:] == ")" and name.count(")") > name.count("("):
        name = name[:-1]
    return name.strip()


#: Epochs by name, as modified Julian dates: of TESS and Kepler (their archive manuals), GPS and Unix seconds.
EPOCHS_MJD = {"mjd": 0.0, "rjd": -0.5, "jd": -2_400_000.5, "bjd": -2_400_000.5, "btjd": 56_999.5, "bkjd": 54_832.5,
              "gps": 44_244.0, "unix": 40_587.0}  # fmt: skip
#: Days of Julian dates by other names: heliocentric, barycentric, and those of CoRoT (N2 data description).
#: TJD is that of NASA (JD - 2440000.5) or of TESS.
_DAYS = EPOCHS_MJD | {"hjd": -2_400_000.5, "gjd": -2_400_000.5, "bmjd": 0.0, "mbjd": 0.0, "hmjd": 0.0, "mhjd": 0.0,
                      "tbjd": 56_999.5, "kbjd": 54_832.5, "corot julian day": 51_544.5}  # fmt: skip
#: Units of time in words, by the names of astropy.
_TIME_WORDS = by_word({
    "d": "d day days", "h": "h hr hrs hour hours", "min": "min mins minute minutes", "s": "s sec secs second seconds",
    "ms": "ms msec msecs millisecond milliseconds", "us": "us usec microsecond microseconds",
    "yr": "yr yrs year years",
})  # fmt: skip
_JULIAN = re.compile(
    rf"(?P<name>{'|'.join(sorted(set(_DAYS) - {'gps', 'unix'}, key=len, reverse=True))})"
    r"(?:[\s_(\[-]+(?P<scale>utc|tdb|tt|tai|tcb)[)\]]?)?"
    r"\s*(?:[-+]\s*(?P<less>\d+(?:\.\d*)?(?:e\d+)?)|[(\[]?(?P<plus>\d{4,}(?:\.\d*)?)\s*\+[)\]]?)?"
    r"\s*[,;:]?\s*(?:[(\[]?d(?:ays?)?[)\]]?)?(?:\s*[(\[](?P<end>utc|tdb|tt|tai|tcb)[)\]])?"
)
#: Words in the names of times that say nothing of their unit: ``time_bjd``, ``TMID_BJD``, ``mjd_obs``.
_TIME_OF = ("time", "t", "date", "tmid", "mid", "middle", "obs", "mean", "center", "centre")
_PLACES = {"barycentric": "BARYCENTER", "bary": "BARYCENTER", "heliocentric": "HELIOCENTER", "helio": "HELIOCENTER"}
_SINCE = re.compile(
    r"(?P<unit>[a-z]+)\s+(?:since|after|from)\s+(?P<date>\d{4}-\d\d-\d\d(?:[t ][\d:.]+)?)"
    r"\s*(?:z|\(?(?P<scale>utc|tdb|tt|tai)\)?)?"
)
#: Missions whose light curves count days from an epoch of their own, also where a file does not say so.
MISSIONS = {"KEPLER": "bkjd", "K2": "bkjd", "TESS": "btjd"}


def mission_of(header: Mapping[str, Any]) -> str:
    """Return the one of `MISSIONS` that a header names; empty if it names none."""
    keywords = {str(header.get(key, "") or "").strip().upper() for key in ("MISSION", "TELESCOP")}
    return next((mission for mission in MISSIONS if mission in keywords), "")


#: Scales that astropy knows, by the names of FITS (standard 4.0, table 30) and usual ones.
SCALES = {"utc": "utc", "ut": "utc", "gmt": "utc", "tai": "tai", "iat": "tai", "tt": "tt", "tdt": "tt", "et": "tt",
          "tdb": "tdb", "tcb": "tcb", "tcg": "tcg", "ut1": "ut1"}  # fmt: skip
#: Values of TREFPOS (standard 4.0, table 31) and of the older TIMEREF that mean the same place.
POSITIONS = {"SOLARSYSTEM": "BARYCENTER", "SSBARYCENTER": "BARYCENTER", "BARYCENTRE": "BARYCENTER",
             "GEOCENTRIC": "GEOCENTER", "HELIOCENTRIC": "HELIOCENTER", "LOCAL": "TOPOCENTER"}  # fmt: skip
#: Keywords of the reference time, and the modified Julian date of their zero; JD_REF is that of SuperWASP.
REFERENCES = {"MJDREF": 0.0, "BJDREF": -2_400_000.5, "JDREF": -2_400_000.5, "HJDREF": -2_400_000.5,
              "JD_REF": -2_400_000.5}  # fmt: skip
#: Keywords of a time that is added to all others, in TIMEUNIT: of the standard, and of OGIP (memo 93-003).
OFFSETS = ("TIMEOFFS", "TIMEZERO")


@dataclass(frozen=True)
class TimeSystem:
    """Unit, zero, scale and place of times, as a FITS header or the text of a unit states them."""

    unit: str = ""  # as astropy names it; of a header TIMEUNIT; empty if it is not stated
    epoch_mjd: float | None = None  # date of time zero
    scale: str = ""  # in lower case, as astropy names it where it knows it; empty if it is not stated
    position: str = ""  # TREFPOS; empty if unknown
    default_scale: str = ""  # the standard's for a header that states a reference time but no scale
    at: float = 0.5  # part of a frame that times refer to: 0 start, 0.5 middle, 1 end
    offset: float = 0.0  # to be added to times, in TIMEUNIT; see `OFFSETS`
    direction_deg: tuple[float, float] | None = None  # of TREFDIR; None if it is not stated

    @classmethod
    def of(cls, header: Mapping[str, Any], label: str) -> TimeSystem:
        """Read the time keywords of a header; raise InputError for one that violates the standard."""
        header = {str(key).upper(): value for key, value in header.items()}
        at = _number(header, "TIMEPIXR", label)
        if at is not None and not 0.0 <= at <= 1.0:
            raise InputError.of("TIMEPIXR", at, "between 0 and 1", where=label)
        scale = scale_of(str(header.get("TIMESYS", "")).strip())
        references = ((_split(header, name, label), zero) for name, zero in REFERENCES.items())
        epoch = next((value + zero for value, zero in references if value is not None), None)
        if epoch is None and (date := str(header.get("DATEREF", "") or "").strip()):
            epoch = float(mjd_of([date], scale if scale in SCALES.values() else "utc", "DATEREF", label)[0])
        # The standard's default is UTC; a header without a reference time does not follow it.
        is_standard = not scale and any(key.startswith(("MJDREF", "DATEREF")) for key in header)
        position = str(header.get("TREFPOS", "") or header.get("TIMEREF", "")).strip()
        offset = sum(_split(header, key, label) or 0.0 for key in OFFSETS)
        unit = str(header.get("TIMEUNIT", "") or "").strip()
        # TREFDIR names two keywords, of longitude and latitude.
        first, _, second = str(header.get("TREFDIR", "")).partition(",")
        ra, dec = (_number(header, key.strip(), label) for key in (first, second))
        return cls(unit, epoch, scale, position_of(position), "utc" if is_standard else "", 0.5 if at is None else at,
                   offset, None if ra is None or dec is None else (ra, dec))  # fmt: skip

    def offset_in(self, unit: Any, label: str) -> float:
        """Return the offset in the unit of the times; raise InputError if its own unit cannot be known."""
        import astropy.units as u

        if not self.offset:
            return 0.0
        system = time_unit(self.unit) if self.unit else None
        if system is None and not (unit == u.s and not self.unit):
            fault = f"{label}: TIMEOFFS or TIMEZERO is {self.offset:g}, and TIMEUNIT = {self.unit!r}"
            raise InputError(f"{fault} must be its unit, such as TIMEUNIT = 's'", key="TIMEUNIT")
        return float(u.Quantity(self.offset, "s" if system is None else system.unit).to_value(unit))


@lru_cache(maxsize=256)
def time_unit(text: str) -> TimeSystem | None:
    """Return the unit of times in a text such as "days", "BJD - 2457000, days", "btjd" or "s since 2026-03-01"."""
    word = re.sub(r"[−–]", "-", text.strip().strip("\"'")).lower()
    # BJD - 2,457,000
    word = re.sub(r"(?<=\d),(?=\d{3}(?:\D|$))", "", word)
    # Ms are megaseconds.
    if word in _TIME_WORDS and text.strip() != "Ms":
        return TimeSystem(_TIME_WORDS[word])
    if match := _JULIAN.fullmatch(word):
        name = match["name"]
        is_mission = name in ("btjd", "tbjd", "bkjd", "kbjd")
        scale = match["scale"] or match["end"] or ("tdb" if is_mission else "")
        place = "BARYCENTER" if "b" in name else "HELIOCENTER" if "h" in name else ""
        return TimeSystem("d", _DAYS[name] + float(match["less"] or match["plus"] or 0.0), scale, place)
    if (match := _SINCE.fullmatch(word)) and match["unit"] in _TIME_WORDS:
        scale = match["scale"] or "utc"
        epoch = mjd_of([match["date"].upper()], scale, "unit", "its unit")[0]
        return TimeSystem(_TIME_WORDS[match["unit"]], float(epoch), scale)
    return None


def time_in_name(name: str) -> TimeSystem | None:
    """Return the unit in the name of a column of times, as in ``BJD - 2454833``, ``time [d]`` or ``time_bjd``."""
    base, unit = divided_unit(name)
    is_long = len(name.strip()) > 2 or name.strip().lower() == "jd"
    if (times := time_unit(name) if is_long else None) or (times := time_unit(unit) if unit else None):
        return times
    words = re.split(r"[\s_.]+", base.strip().lower())
    # The scale follows the dates: time_utc_mjd.
    dates = sorted((word for word in words if word not in (*_TIME_OF, *_PLACES)), key=SCALES.__contains__)
    times = time_unit(" ".join(dates)) if dates and len(dates) < len(words) else None
    place = next((_PLACES[word] for word in words if word in _PLACES), "")
    return replace(times, position=place) if times is not None and place else times


def scale_of(text: str) -> str:
    """Return a time scale as astropy names it; an unknown one in lower case."""
    word = text.strip().lower().partition("(")[0]
    return SCALES.get(word, word)


def position_of(text: str) -> str:
    """Return a reference position as FITS names it."""
    word = text.strip().upper()
    return POSITIONS.get(word, word)


def _number(header: Mapping[str, Any], key: str, label: str) -> float | None:
    """Return a keyword as a number, or None without it; raises InputError for anything else."""
    value = header.get(key)
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not np.isfinite(number) or isinstance(value, bool):
        raise InputError.of(key, value, "a number", where=label)
    return number


def _split(header: Mapping[str, Any], name: str, label: str) -> float | None:
    """Return a number that may be divided into two keywords with I and F at their ends, which have precedence."""
    # Keywords have eight letters at most: TIMEZERO, TIMEZERI, TIMEZERF.
    halves = [_number(header, name[:7] + half, label) for half in ("I", "F")]
    if halves != [None, None]:
        return sum(half or 0.0 for half in halves)
    return _number(header, name, label)


@contextmanager
def offline() -> Iterator[None]:
    """Keep astropy from using the network and from warning of distant years."""
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        # This import reads leap seconds, which may download them, so it comes after the line above.
        from astropy.coordinates import solar_system_ephemeris

        # The ephemeris has a context manager of its own.
        with solar_system_ephemeris.set("builtin"), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*dubious year.*")
            warnings.filterwarnings("ignore", message=".*leap-second file is expired.*")
            yield


#: A date with the difference of its time zone from UTC.
_ZONE = re.compile(r"(.*:\d\d(?:\.\d*)?)\s*([+-])(\d\d):?(\d\d)")


def is_dated(cell: str) -> bool:
    """Return whether a text begins as an ISO 8601 date."""
    return len(cell) >= 8 and cell[:4].isdigit() and cell[4:5] in ("-", ":")


def with_mission_formats() -> None:
    """Register the formats of time of lightkurve's tables with astropy: days from the epochs of Kepler and TESS."""
    from astropy.time import Time, TimeFromEpoch

    for name in ("bkjd", "btjd"):
        if name not in Time.FORMATS:
            # The class registers itself by its name; lightkurve defines the same.
            type(f"Time{name.upper()}", (TimeFromEpoch,), {
                "name": name, "unit": 1.0, "epoch_val": EPOCHS_MJD[name] + 2_400_000.5, "epoch_val2": None,
                "epoch_scale": "tdb", "epoch_format": "jd",
            })  # fmt: skip


def mjd_of(texts: Sequence[str], scale: str, name: str, label: str) -> Float:
    """Return ISO 8601 dates as modified Julian dates, NaN for empty ones; raise InputError for an invalid one."""
    from astropy.time import Time

    mjd = np.full(len(texts), np.nan)
    filled = [k for k, text in enumerate(texts) if not is_missing(text)]
    cleaned, hours = [], np.zeros(len(filled))
    for place, text in enumerate(texts[k] for k in filled):
        match = _ZONE.fullmatch(text)
        cleaned.append(match[1] if match else text.removesuffix("Z"))
        if match:
            # The time zone is ahead of UTC.
            hours[place] = float(f"{match[2]}1") * (int(match[3]) + int(match[4]) / 60)

    def parsed(dates: list[str]) -> Any:
        try:
            return Time(dates, scale=scale).mjd if dates else np.zeros(0)
        except ValueError:
            return None

    with offline():
        if (days := parsed(cleaned)) is None:
            row = next((k for k, text in zip(filled, cleaned, strict=True) if parsed([text]) is None), 0)
            expected = "a number or a date such as 2026-03-01T12:00:00"
            fault = f"{label}: {name!r} in row {row + 1} must be {expected}, not {shortened(texts[row], 40)}"
            raise InputError(fault, key=name)
    mjd[filled] = days - hours / 24
    return mjd


Medium = Literal["air", "vacuum"]

#: Names of keywords whose value is a medium: of IRAF (AIRORVAC), MAST, surveys and users, as in ``WAVSYS = 'air'``.
_NAMED = re.compile(r"WAV|LAM|WL|DISP|MEDI|REFFRAME|WCSNAME|SPECTRAL|AIR(?:_|OR)?VAC|VAC(?:_|OR)?AIR")
#: Names of keywords that are true or false, as in ``VACUUM = T``: those of a medium alone, and those of wavelengths.
_LOGICAL = re.compile(r"(?:IS|IN_?)?(AIR|VAC)(?:UUM)?|(?=.*(?:WAV|LAM|WL|SPEC|DISP)).*?(AIR|VAC)(?!RO).*")
_MEDIUM = re.compile(r"(?:in |standard )?(air|vac\w*)(?: wavelengths?)?(?:\s*[,;(].*)?")
_TRUE, _FALSE = ("true", "t", "yes", "y", "1", "1.0"), ("false", "f", "no", "n", "0", "0.0")

#: Words for a medium; those for air include IVOA's UCD (em.wl;obs.atmos) and FITS's AWAV.
_SPOKEN: dict[Medium, re.Pattern[str]] = {
    "air": re.compile(
        r"\b(?:in|are|is|standard)\s+air\b|\bair\s+wavelengths?|wavelengths?\W{0,3}(?:\(|in\s+)?air\b|\bawav"
        r"|\bem\.wl;obs\.a|_air(?:\b|_)|\bair_|\(air\)",
        re.IGNORECASE,
    ),
    "vacuum": re.compile(r"(?:\b|_)vac(?:uum)?(?:\b|_)|\bvacuum", re.IGNORECASE),
}
_CONVERTED = tuple(
    (re.compile(rf"\b{before}\w*(?:\s+wavelengths?)?[\s_-]*(?:to|2|->|into)[\s_-]*{after}\w*", re.IGNORECASE), medium)
    for before, after, medium in (("vac", "air", "air"), ("air", "vac", "vacuum"))
)


def medium_of(headers: Sequence[Mapping[str, Any]]) -> Medium | None:
    """Return the medium of wavelengths that keywords of headers state, which must agree, or None."""
    media: dict[str, Medium] = {}
    for header in headers:
        for key in map(str, header):
            name = re.sub(r"[\s-]+", "_", key.strip().upper())
            if (medium := _medium_at(name, text_at(header, key).lower())) is not None:
                media[name] = medium
    if len(set(media.values())) > 1:
        words = " and ".join(f"{key} says {medium}" for key, medium in sorted(media.items()))
        fault = f"its header contradicts itself: {words}; use `wavelength_unit='nm air'` to say which"
        raise InputError(fault, key="wavelength_unit")
    return next(iter(media.values()), None)


def _medium_at(name: str, text: str) -> Medium | None:
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
    nm: Float, column: str, remarks: str, medium: Medium | None, headers: Sequence[Mapping[str, Any]]
) -> tuple[Float, tuple[str, ...]]:
    """Return vacuum wavelengths, nm, and messages about them.

    The medium is the stated one, else that in the name of the column, in keywords of headers, or in remarks.
    """
    in_name, in_remarks = _media_in(column), _media_in(remarks)
    named, remarked = (media[0] if len(media) == 1 else None for media in (in_name, in_remarks))
    medium = medium or named or medium_of(headers) or remarked
    if medium is None and (in_name or in_remarks):
        return nm, ("its header speaks of air and of vacuum: ASSUMED vacuum; `wavelength_unit='nm air'` says air",)
    if medium != "air":
        return nm, ()
    return vacuum_from_air(nm), ("its wavelengths are in air, converted to vacuum (Ciddor 1996, above 200 nm)",)


def _media_in(text: str) -> tuple[Medium, ...]:
    """Return the media that a text speaks of."""
    for pattern, medium in _CONVERTED:
        # Wavelengths that were converted are in the second medium.
        text = pattern.sub(f" in {medium} ", text)
    return tuple(medium for medium, pattern in _SPOKEN.items() if pattern.search(text))


def vacuum_from_air(air_nm: Float) -> Float:
    """Return vacuum wavelengths, nm, of wavelengths in standard air (15 C, 101325 Pa, dry, 450 ppm CO2).

    Ciddor 1996, Applied Optics 35, 1566, equation 1, doi 10.1364/AO.35.001566. Wavelengths below 200 nm are vacuum
    wavelengths by convention and remain unchanged (Morton 1991, ApJS 77, 119).
    """
    vacuum = air_nm.copy()
    in_air = np.isfinite(air_nm) & (air_nm >= 200.0)
    for _ in range(4):
        # Squared wavenumber, um-2. The index hardly changes over the shift, so the iteration converges at once.
        wavenumber2 = (1000.0 / vacuum[in_air]) ** 2
        index = 1.0 + 0.05792105 / (238.0185 - wavenumber2) + 0.00167917 / (57.362 - wavenumber2)
        vacuum[in_air] = air_nm[in_air] * index
    return vacuum
