"""Choice of a library spectrum by spectral type."""

from __future__ import annotations

import re

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from .catalogue import entries

#: Spectral classes in order of decreasing temperature.
CLASSES = "OBAFGKM"
_TYPE = re.compile(rf"\s*(?:d)?([{CLASSES}])\s*(\d(?:\.\d+)?)?")


def subtype(spectral_type: str) -> float:
    """Convert a spectral type to a number, ten per class: K5 is 55, M0 is 60, and a class without subtype is x5."""
    matched = _TYPE.match(spectral_type)
    if not matched:
        raise InputError(
            f"spectral type {shortened(spectral_type)} is unknown",
            "one from O to M, such as M3V",
            key="spectral_type",
            value=spectral_type,
        )
    return 10.0 * CLASSES.index(matched[1]) + (5.0 if matched[2] is None else float(matched[2]))


def as_type(text: str) -> str | None:
    """Return the spectral type of a dwarf or subgiant that a text names, as in "M3.5V" for "m3.5", or None."""
    found = re.fullmatch(rf"d?([{CLASSES}])(\d(?:\.\d+)?)(IV|V)?", "".join(text.split()), flags=re.IGNORECASE)
    return None if found is None else f"{found[1]}{found[2]}{found[3] or 'V'}".upper()


def nearest_spectrum(spectral_type: str) -> str:
    """Return the name of the embedded spectrum of the nearest type; the first in the library if there are several."""
    wanted = subtype(spectral_type)
    names = [(one["name"], one["spectral_type"]) for one in entries() if _TYPE.match(one["spectral_type"])]
    return min(names, key=lambda one: abs(subtype(one[1]) - wanted))[0]
