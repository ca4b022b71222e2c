"""Time keywords of FITS headers (standard 4.0, section 9), dates, and times at the Solar System's barycentre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.sky.helioecliptic import offline
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]

#: Scales that astropy knows, by the names of FITS (standard 4.0, table 30) and usual ones.
SCALES = {"utc": "utc", "ut": "utc", "gmt": "utc", "tai": "tai", "iat": "tai", "tt": "tt", "tdt": "tt", "et": "tt",
          "tdb": "tdb", "tcb": "tcb", "tcg": "tcg", "ut1": "ut1"}  # fmt: skip
#: Values of TREFPOS (standard 4.0, table 31) and of the older TIMEREF that mean the same place.
POSITIONS = {"SOLARSYSTEM": "BARYCENTER", "SSBARYCENTER": "BARYCENTER", "BARYCENTRE": "BARYCENTER",
             "GEOCENTRIC": "GEOCENTER", "HELIOCENTRIC": "HELIOCENTER", "LOCAL": "TOPOCENTER"}  # fmt: skip
#: Keywords of the reference time, and the modified Julian date of their zero.
REFERENCES = {"MJDREF": 0.0, "BJDREF": -2_400_000.5, "JDREF": -2_400_000.5}


@dataclass(frozen=True)
class TimeSystem:
    """Time system of a FITS header."""

    epoch_mjd: float | None  # date of time zero
    scale: str  # in lower case, as astropy names it where it knows it; empty if unknown
    position: str  # TREFPOS; empty if unknown
    unit: str  # TIMEUNIT; empty if it is not stated
    at: float  # part of a frame that times refer to: 0 start, 0.5 middle, 1 end
    offset: float  # TIMEOFFS, to be added to times, in their unit
    direction_deg: tuple[float, float] | None  # of TREFDIR; None if it is not stated

    @classmethod
    def of(cls, header: Mapping[str, Any], what: str) -> TimeSystem:
        """Read the time keywords of a header; raise InputError for one that violates the standard."""
        at = _number(header, "TIMEPIXR", what)
        if at is not None and not 0.0 <= at <= 1.0:
            raise InputError.of("TIMEPIXR", at, "0 to 1", where=what)
        epoch = _reference(header, what)
        stated = str(header.get("TIMESYS", "")).strip()
        # The standard's default is UTC; a header without a reference time does not follow it.
        default = "utc" if any(key.startswith("MJDREF") for key in header) else ""
        position = str(header.get("TREFPOS", "") or header.get("TIMEREF", "")).strip()
        return cls(epoch, scale_of(stated) or default, position_of(position), str(header.get("TIMEUNIT", "")).strip(),
                   0.5 if at is None else at, _number(header, "TIMEOFFS", what) or 0.0,
                   _direction(header, what))  # fmt: skip


def scale_of(text: str) -> str:
    """Return a time scale as astropy names it; an unknown one in lower case."""
    word = text.strip().lower().partition("(")[0]
    return SCALES.get(word, word)


def position_of(text: str) -> str:
    """Return a reference position as FITS names it."""
    word = text.strip().upper()
    return POSITIONS.get(word, word)


def _number(header: Mapping[str, Any], key: str, what: str) -> float | None:
    value = header.get(key)
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not np.isfinite(number) or isinstance(value, bool):
        raise InputError.of(key, value, "a number", where=what)
    return number


def _reference(header: Mapping[str, Any], what: str) -> float | None:
    for name, zero in REFERENCES.items():
        parts = [_number(header, name + part, what) for part in ("I", "F")]
        if parts[0] is not None:
            return parts[0] + (parts[1] or 0.0) + zero
        whole = _number(header, name, what)
        if whole is not None:
            return whole + zero
    return None


def _direction(header: Mapping[str, Any], what: str) -> tuple[float, float] | None:
    """Return the direction that TREFDIR names by two keywords, of longitude and latitude."""
    first, _, second = (part.strip() for part in str(header.get("TREFDIR", "")).partition(","))
    ra, dec = (_number(header, key, what) for key in (first, second))
    return None if ra is None or dec is None else (ra, dec)


def mjd_of(texts: Sequence[str], scale: str, name: str, what: str) -> Float:
    """Return ISO 8601 dates as modified Julian dates, NaN for empty ones; raise InputError for an invalid one."""
    from astropy.time import Time

    found = np.full(len(texts), np.nan)
    filled = [k for k, text in enumerate(texts) if text and text not in ("--", "nan", "NaT")]
    cleaned = [texts[k].removesuffix("Z") for k in filled]
    with offline():
        try:
            if cleaned:
                found[filled] = Time(cleaned, scale=scale).mjd
        except ValueError:
            row = next((k for k, text in zip(filled, cleaned, strict=True) if not _is_date(text, scale)), 0)
            fault = f"{what}: {name!r} = {shortened(texts[row], 40)} in row {row + 1}"
            expected = "a number or a date such as 2026-03-01T12:00:00"
            raise InputError(fault, expected, key=name, value=texts[row]) from None
    return found


def _is_date(text: str, scale: str) -> bool:
    from astropy.time import Time

    try:
        Time(text, scale=scale)
    except ValueError:
        return False
    return True


def seconds_from_first(time: Float, unit: Any) -> tuple[Float, float]:
    """Return times in seconds from the first, and the first in days from time zero."""
    import astropy.units as u

    finite = time[np.isfinite(time)]
    first = float(finite.min()) if finite.size else 0.0
    # Days since a date far in the past lose digits as seconds: subtract before the unit is changed.
    return np.asarray(((time - first) * unit).to_value(u.s)), float((first * unit).to_value(u.s)) / DAY_S
