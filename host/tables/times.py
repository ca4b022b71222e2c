"""Times of tables: units and epochs in units and names of columns, keywords of headers (FITS 4.0, section 9), dates."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.tables.missing import is_missing
from mauvecl.host.tables.names import divided_unit
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]

#: Epochs by name, as modified Julian dates: of TESS and Kepler (their archive manuals), GPS and Unix seconds.
EPOCHS_MJD = {
    "mjd": 0.0,
    "rjd": -0.5,
    "jd": -2_400_000.5,
    "bjd": -2_400_000.5,
    "btjd": 56_999.5,
    "bkjd": 54_832.5,
    "gps": 44_244.0,
    "unix": 40_587.0,
}
#: Days of Julian dates by other names: heliocentric, barycentric, truncated (JD - 2440000.5).
_DAYS = EPOCHS_MJD | {"hjd": -2_400_000.5, "gjd": -2_400_000.5, "bmjd": 0.0, "mbjd": 0.0, "hmjd": 0.0, "mhjd": 0.0,
                      "tjd": 40_000.0, "tbjd": 56_999.5, "kbjd": 54_832.5}  # fmt: skip
#: Scale and position of the missions' own dates.
_MISSION_DAYS = ("btjd", "tbjd", "bkjd", "kbjd")
#: Units of time in words, by the names of astropy.
_TIME_WORDS = {
    word: name
    for name, words in {
        "d": "d day days", "h": "h hr hrs hour hours", "min": "min mins minute minutes",
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millisecond milliseconds", "us": "us usec microsecond microseconds",
        "yr": "yr yrs year years",
    }.items()
    for word in words.split()
}  # fmt: skip
_JULIAN = re.compile(
    rf"(?P<name>{'|'.join(sorted(set(_DAYS) - {'gps', 'unix'}, key=len, reverse=True))})"
    r"(?:[\s_(\[]+(?P<scale>utc|tdb|tt|tai|tcb)[)\]]?)?\s*(?:[-+]\s*(?P<less>\d+(?:\.\d*)?))?\s*[,;:]?\s*(?:[(\[]?d(?:ays?)?[)\]]?)?"
)
#: Words in the names of times that say nothing of their unit: ``time_bjd``, ``TMID_BJD``, ``mjd_obs``.
_TIME_OF = ("time", "t", "date", "tmid", "mid", "middle", "obs", "mean", "center", "centre")
_SINCE = re.compile(
    r"(?P<unit>[a-z]+)\s+(?:since|after|from)\s+(?P<date>\d{4}-\d\d-\d\d(?:[t ][\d:.]+)?)"
    r"\s*(?:z|\(?(?P<scale>utc|tdb|tt|tai)\)?)?"
)
#: Missions whose light curves count days from an epoch of their own, also where a file does not say so.
MISSIONS = {"KEPLER": "bkjd", "K2": "bkjd", "TESS": "btjd"}

#: Scales that astropy knows, by the names of FITS (standard 4.0, table 30) and usual ones.
SCALES = {"utc": "utc", "ut": "utc", "gmt": "utc", "tai": "tai", "iat": "tai", "tt": "tt", "tdt": "tt", "et": "tt",
          "tdb": "tdb", "tcb": "tcb", "tcg": "tcg", "ut1": "ut1"}  # fmt: skip
#: Values of TREFPOS (standard 4.0, table 31) and of the older TIMEREF that mean the same place.
POSITIONS = {"SOLARSYSTEM": "BARYCENTER", "SSBARYCENTER": "BARYCENTER", "BARYCENTRE": "BARYCENTER",
             "GEOCENTRIC": "GEOCENTER", "HELIOCENTRIC": "HELIOCENTER", "LOCAL": "TOPOCENTER"}  # fmt: skip
#: Keywords of the reference time, and the modified Julian date of their zero.
REFERENCES = {"MJDREF": 0.0, "BJDREF": -2_400_000.5, "JDREF": -2_400_000.5, "HJDREF": -2_400_000.5}
#: Keywords of a time that is added to all others, in TIMEUNIT: of the standard, and of OGIP (memo 93-003).
OFFSETS = ("TIMEOFFS", "TIMEZERO")


@dataclass(frozen=True)
class TimeUnit:
    """Unit of times, and what its text says of their zero."""

    unit: str  # as astropy names it
    epoch_mjd: float | None = None
    scale: str = ""
    position: str = ""


@lru_cache(maxsize=256)
def time_unit(text: str) -> TimeUnit | None:
    """Return the unit of times in a text such as "days", "BJD - 2457000, days", "btjd" or "s since 2026-03-01"."""
    word = re.sub(r"[−–]", "-", text.strip().strip("\"'")).lower()
    if word in _TIME_WORDS:
        return TimeUnit(_TIME_WORDS[word])
    if match := _JULIAN.fullmatch(word):
        name = match["name"]
        mission = name in _MISSION_DAYS
        scale = match["scale"] or ("tdb" if mission else "")
        place = "BARYCENTER" if "b" in name else "HELIOCENTER" if name.startswith("h") else ""
        return TimeUnit("d", _DAYS[name] + float(match["less"] or 0.0), scale, place)
    if (match := _SINCE.fullmatch(word)) and match["unit"] in _TIME_WORDS:
        scale = match["scale"] or "utc"
        epoch = mjd_of([match["date"].upper()], scale, "unit", "its unit")[0]
        return TimeUnit(_TIME_WORDS[match["unit"]], float(epoch), scale)
    return None


def time_in_name(name: str) -> TimeUnit | None:
    """Return the unit in the name of a column of times, as in ``BJD - 2454833``, ``time [d]`` or ``time_bjd``."""
    base, unit = divided_unit(name)
    if (found := time_unit(name) if len(name.strip()) > 2 else None) or (found := time_unit(unit) if unit else None):
        return found
    words = [word for word in re.split(r"[\s_.]+", base.strip()) if word.lower() not in _TIME_OF]
    return time_unit(" ".join(words)) if words and len(words) < len(re.split(r"[\s_.]+", base.strip())) else None


@dataclass(frozen=True)
class TimeSystem:
    """Time system of a FITS header."""

    epoch_mjd: float | None  # date of time zero
    scale: str  # in lower case, as astropy names it where it knows it; empty if it is not stated
    default_scale: str  # the standard's for a header that states a reference time but no scale
    position: str  # TREFPOS; empty if unknown
    unit: str  # TIMEUNIT; empty if it is not stated
    at: float  # part of a frame that times refer to: 0 start, 0.5 middle, 1 end
    offset: float  # to be added to times, in TIMEUNIT; see `OFFSETS`
    direction_deg: tuple[float, float] | None  # of TREFDIR; None if it is not stated

    @classmethod
    def of(cls, header: Mapping[str, Any], what: str) -> TimeSystem:
        """Read the time keywords of a header; raise InputError for one that violates the standard."""
        header = {str(key).upper(): value for key, value in header.items()}
        at = _number(header, "TIMEPIXR", what)
        if at is not None and not 0.0 <= at <= 1.0:
            raise InputError.of("TIMEPIXR", at, "0 to 1", where=what)
        stated = scale_of(str(header.get("TIMESYS", "")).strip())
        epoch = _reference(header, stated if stated in SCALES.values() else "utc", what)
        # The standard's default is UTC; a header without a reference time does not follow it.
        default = "utc" if any(key.startswith(("MJDREF", "DATEREF")) for key in header) else ""
        position = str(header.get("TREFPOS", "") or header.get("TIMEREF", "")).strip()
        offset = sum(_split(header, key, what) or 0.0 for key in OFFSETS)
        unit = str(header.get("TIMEUNIT", "") or "").strip()
        return cls(epoch, stated, "" if stated else default, position_of(position), unit, 0.5 if at is None else at,
                   offset, _direction(header, what))  # fmt: skip

    def offset_in(self, unit: Any, what: str) -> float:
        """Return the offset in the unit of the times; raise InputError if its own unit cannot be known."""
        import astropy.units as u

        if not self.offset:
            return 0.0
        stated = time_unit(self.unit) if self.unit else None
        if stated is None and not (unit == u.s and not self.unit):
            raise InputError(f"{what}: TIMEOFFS or TIMEZERO is {self.offset:g}, and TIMEUNIT = {self.unit!r}",
                             "the unit of this offset, such as TIMEUNIT = 's'", key="TIMEUNIT")  # fmt: skip
        return float(u.Quantity(self.offset, "s" if stated is None else stated.unit).to_value(unit))


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


def _split(header: Mapping[str, Any], name: str, what: str) -> float | None:
    """Return a number that may be divided into two keywords with I and F at their ends, which have precedence."""
    # Keywords have eight letters at most: TIMEZERO, TIMEZERI, TIMEZERF.
    parts = [_number(header, name[:7] + part, what) for part in ("I", "F")]
    if parts != [None, None]:
        return sum(part or 0.0 for part in parts)
    return _number(header, name, what)


def _reference(header: Mapping[str, Any], scale: str, what: str) -> float | None:
    for name, zero in REFERENCES.items():
        value = _split(header, name, what)
        if value is not None:
            return value + zero
    date = str(header.get("DATEREF", "") or "").strip()
    return float(mjd_of([date], scale, "DATEREF", what)[0]) if date else None


def _direction(header: Mapping[str, Any], what: str) -> tuple[float, float] | None:
    """Return the direction that TREFDIR names by two keywords, of longitude and latitude."""
    first, _, second = (part.strip() for part in str(header.get("TREFDIR", "")).partition(","))
    ra, dec = (_number(header, key, what) for key in (first, second))
    return None if ra is None or dec is None else (ra, dec)


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


def is_dated(cell: str) -> bool:
    """Return whether a text begins as an ISO 8601 date."""
    return len(cell) >= 8 and cell[:4].isdigit() and cell[4:5] in ("-", ":")


def with_mission_formats() -> None:
    """Make astropy know the formats of time of lightkurve's tables: days from the epochs of Kepler and TESS."""
    from astropy.time import Time, TimeFromEpoch

    for name in ("bkjd", "btjd"):
        if name not in Time.FORMATS:
            # The class registers itself by its name; lightkurve defines the same.
            type(f"Time{name.upper()}", (TimeFromEpoch,), {
                "name": name, "unit": 1.0, "epoch_val": EPOCHS_MJD[name] + 2_400_000.5, "epoch_val2": None,
                "epoch_scale": "tdb", "epoch_format": "jd",
            })  # fmt: skip


def mjd_of(texts: Sequence[str], scale: str, name: str, what: str) -> Float:
    """Return ISO 8601 dates as modified Julian dates, NaN for empty ones; raise InputError for an invalid one."""
    from astropy.time import Time

    found = np.full(len(texts), np.nan)
    filled = [k for k, text in enumerate(texts) if not is_missing(text)]
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
