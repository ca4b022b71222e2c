"""Words of tables: names of columns, missing values, and coordinates, in a module that is fast to import."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mauvecl.schema.errors import InputError, shortened

#: Words for missing values as archives and programs write them, in lower case; an empty cell has no value either.
MISSING_WORDS = ("", "null", "none", "n/a", "na", "--", "---", "-", "...", "masked", "indef", "<na>")
_NO_VALUE = {*MISSING_WORDS, "nan", "nat"}
#: Errors of spreadsheets (``#N/A``, ``#DIV/0!``), of C (``1.#QNAN``), and numbers too long for Fortran (``*****``).
_ERROR = re.compile(r"#[a-z/0]+[!?]?|[-+]?1\.#[a-z]+\d*|[-+]?nan(?:\(\w*\))?|\*+")


def is_missing(cell: str) -> bool:
    """Return whether a cell has no value: it is empty, one of the words for that, or an error of a program."""
    word = cell.strip().lower()
    return word in _NO_VALUE or _ERROR.fullmatch(word) is not None


def is_missing_position(text: str) -> bool:
    """Return whether a text is a pair of missing values, such as "nan nan" or "--, --"."""
    words = re.split(r"\s*[,;]\s*|\s+", text.strip().strip("()[]").strip())
    return len(words) == 2 and all(map(is_missing, words))


def by_word(words: Mapping[str, str]) -> dict[str, str]:
    """Return the meaning of each word from lists of words by their meaning."""
    return {word: meaning for meaning, text in words.items() for word in text.split()}


#: Names of columns of stars: of the Gaia archive, SIMBAD, astroquery, VizieR, MAST and CDS X-Match, and plain ones.
STARS = ("name", "designation", "source_id", "source", "main_id", "id", "dr3name", "target", "target_name", "targname",
         "object", "star", "tic", "tic_id", "kic", "kepid", "epic", "hip", "star_name", "object_name", "identifier",
         "star_id", "epic_number", "sourceid", "kelt_sourceid", "tid")  # fmt: skip
#: Right ascensions and declinations, by precedence: plain ones and those of ObsCore; of Gaia, TIC and KIC; of VizieR,
#: CDS, Hipparcos, 2MASS and SExtractor; with a unit; of SIMBAD, of headers of Kepler and TESS, and of other epochs.
_COORDINATES = """
    ra dec, _ra _de, ra de, ra decl, s_ra s_dec, r.a. decl., ra. dec., right_ascension declination, alpha delta,
    rightascension decl, gaia_ra gaia_dec, tic_ra tic_dec, kic_degree_ra kic_dec,
    ra_deg dec_deg, radeg dedeg, ra_icrs de_icrs, ra_icrs dec_icrs, raicrs deicrs, _ra.icrs _de.icrs,
    _ra_icrs _de_icrs, raj2000 dej2000, raj2000 decj2000, _raj2000 _dej2000, ra_j2000 de_j2000, ra_j2000 dec_j2000,
    alpha_j2000 delta_j2000, ra_hours dec_degrees, ra_hour dec_deg, ra_h dec_d, ra_rad dec_rad, ra_degrees dec_degrees,
    ra_d dec_d, ra_hms dec_dms, ra_obj dec_obj, ra2000 dec2000, ra2000 de2000, ra_2000 dec_2000,
    ra_epoch2000 dec_epoch2000, ra_fk5 dec_fk5, ra_j2016_deg de_j2016_deg, ra_j2016 dec_j2016
"""
_PAIRS = [pair.split() for pair in _COORDINATES.split(",")]
RIGHT_ASCENSIONS = tuple(dict.fromkeys(ra for ra, _ in _PAIRS))
DECLINATIONS = tuple(dict.fromkeys(dec for _, dec in _PAIRS))
#: Sexagesimal right ascensions in tables that have them in numbers as well.
SEXAGESIMAL = ("ra_string", "rastr", "ra_str", "ra_hms", "ra_sexa")
SPECTRAL_TYPES = ("spectral_type", "sptype", "sp_type", "spt", "spectype", "st_spectype", "spec._type", "sp._type",
                  "sp.type")  # fmt: skip
_UNIT = re.compile(r"(?s)(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*")
#: Units of light after an underscore, as in ``flux_jy`` and ``flux_e_s``, and words for them.
_LIGHT = re.compile(
    r"(.*[a-z\d])_((?:e-?|electrons?|cts?|counts?|adu|dn)(?:_per_|_|/)s(?:ec(?:ond)?)?"
    r"|[mun]?jy|adu|counts|electrons|pp[mtb]|percent)", re.IGNORECASE,
)  # fmt: skip
_LIGHT_WORDS = {"e": "electron", "e-": "electron", "electrons": "electron", "counts": "ct", "count": "ct", "cts": "ct",
                "sec": "s", "second": "s", "jy": "Jy", "ujy": "uJy", "njy": "nJy", "mjy": "mJy"}  # fmt: skip
#: Columns of magnitudes: ``mag``, ``Vmag``, ``mag_err``, ``INST_MAG1``, ``delta magnitude``.
_MAGNITUDE = re.compile(r"(?:^|[^a-z])[a-z]{0,5}(?:mag|mags|magnitude|magnitudes)(?:$|[^a-z])")


def divided_unit(name: str) -> tuple[str, str]:
    """Divide ``flux (ct/s)``, ``time [d]`` or ``flux_jy`` into name and unit, which is empty if there is none."""
    name = name.strip()
    if match := _UNIT.fullmatch(name):
        return match[1], (match[2] or match[3] or "").strip()
    # MJY may be a million or a thousandth.
    if (match := _LIGHT.fullmatch(name)) and match[2] not in ("MJy", "MJY"):
        words = [word for word in re.split(r"_per_|_|/", match[2].lower()) if word]
        return match[1], "/".join(_LIGHT_WORDS.get(word, word) for word in words)
    return name, ""


#: Columns of the band of the magnitudes in a column that names none.
BANDS = ("band", "filter", "passband", "filt")


def band_in_name(name: str) -> str:
    """Return the band in brackets after a magnitude, as in ``mag (Ks)``; empty if there is a unit or nothing."""
    base, bracket = divided_unit(name)
    is_unit = re.fullmatch(r"(?:mag(?:nitude)?s?)?", bracket, re.IGNORECASE) is not None
    return "" if is_unit or key_of(base) not in ("mag", "magnitude") else bracket


def in_brackets(text: str) -> str:
    """Return the text without brackets around all of it, as in ``[s]`` or ``(ct/s)``."""
    match = re.fullmatch(r"\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))\s*", text)
    return text.strip() if match is None else (match[1] or match[2] or "").strip()


def key_of(name: str) -> str:
    """Normalise a name: lower case, one underscore for blanks and underscores, no quotes."""
    return re.sub(r"[\s_]+", "_", name.strip().strip("\"'").casefold())


def match_name(name: str, names: Iterable[str], label: str = "") -> str | None:
    """Return the name that a text means, in any case, or None; raise InputError if several differ in case only."""
    fitting = [title for title in names if title.strip().casefold() == name.strip().casefold()]
    if name in fitting:
        return name
    fitting = [title for title in fitting if title.strip() == name.strip()] or fitting
    if len(fitting) > 1:
        place = f"{label}: " if label else ""
        fault = f"{place}{len(fitting)} columns are called {shortened(name)} but for case ({', '.join(fitting)})"
        raise InputError(f"{fault}; give the exact name of one", key="column")
    return fitting[0] if fitting else None


def text_at(header: Any, key: str) -> str:
    """Return a keyword's value as text; empty if it is missing or cannot be parsed."""
    try:
        value = header.get(key, "")
    except Exception:  # unparsable cards
        return ""
    return "" if value is None else str(value).strip()


def header_text(text: str) -> str:
    """Return a text as FITS headers admit it: printable ASCII, other characters as escapes of Python."""
    return text.encode("unicode_escape").decode()


def first_of(candidates: Sequence[str], names: Iterable[str], label: str = "") -> str | None:
    """Return the name of the first candidate among some names, in any spelling, with or without a unit in brackets."""
    keys = [(name, key_of(name), key_of(divided_unit(name)[0])) for name in names]
    for candidate in candidates:
        key = key_of(candidate)
        fitting = (
            [name for name, _, _ in keys if name == candidate]
            or [name for name, plain, _ in keys if plain == key]
            or [name for name, _, base in keys if base == key]
        )
        if len(fitting) > 1:
            place = f"{label}: " if label else ""
            fault = f"{place}several columns may be {candidate}: {', '.join(map(shortened, fitting))}"
            raise InputError(f"{fault}; give one of them, or a mapping that names it", key=candidate)
        if fitting:
            return fitting[0]
    return None


def is_magnitude(name: str) -> bool:
    """Return whether a column has the name of magnitudes."""
    # Capitals divide words: VMag, instMag.
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return any(_MAGNITUDE.search(text.lower()) is not None for text in (name, spaced))


#: Signs, quotes and blanks of typeset text, which are read as those of a keyboard.
_TYPESET = str.maketrans("−–—‐‑‒﹣－＋º˚′’ʹ″”ʺ，；：ʰᵐˢᵈ", "--------+°°'''\"\"\",;:hmsd", "\u200b\u200e\u200f\ufeff")
_NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_LABEL = re.compile(r"\b(?:ra|dec|de|icrs|j2000(?:\.0)?)\b\s*[=:]?", re.IGNORECASE)
#: Units of angles by the words of tables and users; sexagesimal forms as VizieR names them.
ANGLES = by_word({
    "deg": "deg degs degree degrees d ° d:m:s dms",
    "hourangle": "h hr hrs hour hours hourangle h:m:s hms",
    "rad": "rad rads radian radians",
    "arcmin": "arcmin arcmins arcminute arcminutes '",
    "arcsec": 'arcsec arcsecs arcsecond arcseconds as "',
    "mas": "mas milliarcsec milliarcsecond milliarcseconds",
})  # fmt: skip
EXPECTED_POSITION = "right ascension and declination such as '290.0 -11.2' (degrees) or '19h22m00s -11d12m00s'"


def angle_unit(text: str) -> str | None:
    """Return the unit of an angle as astropy names it, or None for another unit."""
    import astropy.units as u

    # Old files of the Gaia archive write Angle[deg].
    text = re.sub(r"^Angle\[(.*)\]$", r"\1", text)
    word = text.strip().strip("\"'" if len(text.strip()) > 1 else "").lower()
    if word in ANGLES:
        return ANGLES[word]
    try:
        unit = u.Unit(text)
    except (ValueError, TypeError):
        return None
    # VOTable writes hours as "15 deg".
    return "hourangle" if unit == u.hourangle else str(unit) if unit.is_equivalent(u.deg) else None


def position(text: str) -> tuple[float, float]:
    """Return right ascension and declination in degrees.

    Hours need an ``h``, colons, or three numbers for each coordinate; two plain numbers are degrees.
    """
    plain = " ".join(_LABEL.sub(" ", text.translate(_TYPESET)).strip().strip("()[]").split())
    if plain.count(",") + plain.count(";") == 1:
        pair = re.split(r"\s*[,;]\s*", plain)
    elif match := re.fullmatch(r"([^-+\s][^-+]*(?:[eE][-+]\d[^-+]*)?)\s*((?<![eE])[-+].*)", plain):
        pair = [match[1].strip(), match[2].strip()]
    else:
        words = plain.split()
        half = len(words) // 2
        pair = [" ".join(words[:half]), " ".join(words[half:])] if len(words) in (2, 6) else []
    try:
        ra, dec = (angle(text, right_ascension=k == 0, pair=len(pair[1 - k].split())) for k, text in enumerate(pair))
    except InputError as error:
        raise error.within(f"target = {shortened(text)}, read as right ascension and declination") from error
    except ValueError:
        raise InputError.of("target", text, EXPECTED_POSITION) from None
    return ra, dec


def angle(text: str, unit: str = "", *, right_ascension: bool, pair: int = 3) -> float:
    """Return an angle in degrees; raise ValueError if the text is not an angle, and InputError if it is out of range.

    Plain numbers are in a unit that astropy names, by default degrees. Numbers with colons are hours for a right
    ascension, as are three plain numbers next to a coordinate of three words, `pair`.
    """
    from astropy.coordinates import Angle

    plain = " ".join(text.translate(_TYPESET).strip().split())
    sexagesimal = "hourangle" if right_ascension else "deg"
    if re.match(r"[+-]?0\d{3}", plain):
        # Hours or degrees and minutes without a mark between them, as in J0042-0300.
        raise ValueError(text)
    if match := re.fullmatch(rf"({_NUMBER})\s*([a-zA-Z°'\"]*)", plain):
        named_unit = angle_unit(match[2]) if match[2] else unit or "deg"
        if named_unit is None:
            raise ValueError(text)
        # Astropy's angles take 50 us each.
        value = float(match[1]) if named_unit == "deg" else _degrees(Angle(float(match[1]), named_unit))
    elif re.fullmatch(r"[+-]?\d+(?::\d+){0,1}:\d+(?:\.\d*)?", plain) or (
        re.fullmatch(r"[+-]?\d+ \d+ \d+(?:\.\d*)?", plain) and pair == 3
    ):
        value = _degrees(Angle(plain, unit or sexagesimal))
    elif re.fullmatch(r"[+-]?\d+\s*(?:h|d|deg|°)[\d\s.ms'\"]*", plain):
        value = _degrees(Angle(plain.replace("deg", "d")))
    else:
        raise ValueError(text)
    name, low, high = ("right ascension", 0.0, 360.0) if right_ascension else ("declination", -90.0, 90.0)
    if not (math.isfinite(value) and low <= value <= high):
        fault = f"{shortened(text)} is a {name} of {value:g}, but must be {low:g} to {high:g} degrees"
        raise InputError(fault, key="target")
    return value


def _degrees(angle: Any) -> float:
    """Return an angle in degrees; hours are multiplied by 15 without rounding errors of radians."""
    return float(angle.value) * 15.0 if angle.unit == "hourangle" else float(angle.deg)
