"""Coordinates in text and in columns: right ascension and declination, ICRS, degrees."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from mauvecl.host.tables.names import divided_unit
from mauvecl.schema.errors import InputError, shortened

#: Signs, quotes and blanks of typeset text, which are read as those of a keyboard.
_TYPESET = str.maketrans("−–—‐‑‒﹣－＋º˚′’ʹ″”ʺ，；：ʰᵐˢᵈ", "--------+°°'''\"\"\",;:hmsd", "\u200b\u200e\u200f\ufeff")
_NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
_PLAIN = re.compile(_NUMBER)
_LABEL = re.compile(r"\b(?:ra|dec|de|icrs|j2000(?:\.0)?)\b\s*[=:]?", re.IGNORECASE)
#: Units of angles by the words of tables and users; sexagesimal forms as VizieR names them.
ANGLES = {
    word: unit
    for unit, words in {
        "deg": "deg degs degree degrees d ° d:m:s dms",
        "hourangle": "h hr hrs hour hours hourangle h:m:s hms",
        "rad": "rad rads radian radians",
        "arcmin": "arcmin arcmins arcminute arcminutes '",
        "arcsec": 'arcsec arcsecs arcsecond arcseconds as "',
        "mas": "mas milliarcsec milliarcsecond milliarcseconds",
    }.items()
    for word in words.split()
}
EXPECTED = "right ascension and declination such as '290.0 -11.2' (degrees) or '19h22m00s -11d12m00s'"


def angle_unit(text: str) -> str | None:
    """Return the unit of an angle as astropy names it, or None for another unit."""
    import astropy.units as u

    # Of old files of the Gaia archive.
    text = re.sub(r"^Angle\[(.*)\]$", r"\1", text)
    found = ANGLES.get(text.strip().strip("\"'" if len(text.strip()) > 1 else "").lower())
    if found is not None:
        return found
    try:
        unit = u.Unit(text)
    except (ValueError, TypeError):
        return None
    # VOTable writes hours as "15 deg".
    return "hourangle" if unit == u.hourangle else str(unit) if unit.is_equivalent(u.deg) else None


def angle_unit_in_name(name: str) -> str:
    """Return the unit in the name of a column, as in ``ra_hours`` or ``dec [rad]``; empty if there is none."""
    base, unit = divided_unit(name)
    tail = re.split(r"[\s_.]+", base)[1:]
    return next((found for text in (unit, *tail[-1:]) if text and (found := angle_unit(text))), "")


def position(text: str) -> tuple[float, float]:
    """Return right ascension and declination in degrees.

    Hours need an ``h``, colons, or three numbers for each coordinate; two plain numbers are degrees.
    Raises InputError for any other text, and for angles out of range.
    """
    plain = " ".join(_LABEL.sub(" ", text.translate(_TYPESET)).strip().strip("()[]").split())
    unknown = InputError.of("target", text, EXPECTED)
    if plain.count(",") + plain.count(";") == 1:
        parts = re.split(r"\s*[,;]\s*", plain)
    elif match := re.fullmatch(r"([^-+\s][^-+]*(?:[eE][-+]\d[^-+]*)?)\s*((?<![eE])[-+].*)", plain):
        parts = [match[1].strip(), match[2].strip()]
    else:
        words = plain.split()
        half = len(words) // 2
        parts = [" ".join(words[:half]), " ".join(words[half:])] if len(words) in (2, 6) else []
    if len(parts) != 2:
        raise unknown
    try:
        ra, dec = (angle(part, right_ascension=k == 0, pair=len(parts[1 - k].split())) for k, part in enumerate(parts))
    except InputError as error:
        raise InputError(f"target = {shortened(text)}: {error}", EXPECTED, key="target") from error
    except ValueError:
        raise unknown from None
    return ra, dec


def angle(text: str, unit: str = "", *, right_ascension: bool, pair: int = 3) -> float:
    """Return an angle in degrees; raises ValueError if the text is no angle, and InputError if it is out of range.

    Plain numbers are in a unit that astropy names, by default degrees. Numbers with colons are hours for a right
    ascension, as are three plain numbers next to a coordinate of three words, `pair`.
    """
    from astropy.coordinates import Angle

    plain = " ".join(text.translate(_TYPESET).strip().split())
    sexagesimal = "hourangle" if right_ascension else "deg"
    if re.match(r"[+-]?0\d{3}", plain):
        # Hours or degrees and minutes without a mark between them, as in J0042-0300.
        raise ValueError(text)
    if _PLAIN.fullmatch(plain):
        # Astropy's angles take 50 us each.
        value = float(plain) if unit in ("", "deg") else _degrees(Angle(float(plain), unit))
    elif match := re.fullmatch(rf"({_NUMBER})\s*([a-zA-Z°'\"]+)", plain):
        stated = angle_unit(match[2])
        if stated is None:
            raise ValueError(text)
        value = _degrees(Angle(float(match[1]), stated))
    elif re.fullmatch(r"[+-]?\d+(?::\d+){0,1}:\d+(?:\.\d*)?", plain) or (
        re.fullmatch(r"[+-]?\d+ \d+ \d+(?:\.\d*)?", plain) and pair == 3
    ):
        value = _degrees(Angle(plain, unit or sexagesimal))
    elif re.fullmatch(r"[+-]?\d+\s*(?:h|d|deg|°)[\d\s.ms'\"]*", plain):
        value = _degrees(Angle(plain.replace("deg", "d")))
    else:
        raise ValueError(text)
    name, low, high = ("right ascension", 0.0, 360.0) if right_ascension else ("declination", -90.0, 90.0)
    if not (np.isfinite(value) and low <= value <= high):
        expected = f"{low:g} to {high:g} degrees"
        raise InputError(f"{shortened(text)} is a {name} of {value:g}", expected, key="target")
    return value


def _degrees(angle: Any) -> float:
    """Return an angle in degrees; hours are multiplied by 15 without rounding errors of radians."""
    return float(angle.value) * 15.0 if angle.unit == "hourangle" else float(angle.deg)
