"""Names of columns, and words for missing values, in a module that is fast to import."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from mauvecl.schema.errors import InputError, shortened

#: As archives and programs write them, in lower case; an empty cell has no value in any case.
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


def matched(name: str, names: Iterable[str], what: str = "") -> str | None:
    """Return the one of some names that is meant, or None.

    Raises InputError if several differ in case only and none is exactly the name.
    """
    held = list(names)
    if name in held:
        return name
    fitting = [one for one in held if one.strip() == name.strip()] or [
        one for one in held if one.strip().casefold() == name.strip().casefold()
    ]
    if len(fitting) > 1:
        place = f"{what}: " if what else ""
        raise InputError(
            f"{place}{len(fitting)} columns are called {shortened(name)} but for case ({', '.join(fitting)})",
            "the exact name of one", key="column"
        )  # fmt: skip
    return fitting[0] if fitting else None


def first_of(wanted: Sequence[str], names: Iterable[str], what: str = "") -> str | None:
    """Return the name that is the first of some wanted ones, in any spelling and with or without a unit in brackets.

    Raises InputError if several fit the same wanted name.
    """
    held = [(name, key_of(name), key_of(divided_unit(name)[0])) for name in names]
    for one in wanted:
        key = key_of(one)
        fitting = (
            [name for name, _, _ in held if name == one]
            or [name for name, plain, _ in held if plain == key]
            or [name for name, _, base in held if base == key]
        )
        if len(fitting) > 1:
            place = f"{what}: " if what else ""
            raise InputError(
                f"{place}several columns may be {one}: {', '.join(map(shortened, fitting))}",
                "one of them, or a mapping that names it", key=one
            )  # fmt: skip
        if fitting:
            return fitting[0]
    return None


def is_magnitude(name: str) -> bool:
    """Return whether the name of a column is that of magnitudes."""
    # Capitals divide words: VMag, instMag.
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return any(_MAGNITUDE.search(one.lower()) is not None for one in (name, spaced))
