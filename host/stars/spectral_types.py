"""Choice of a library spectrum by spectral type."""

from __future__ import annotations

import re

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from .catalogue import library_table

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


def nearest_spectrum(spectral_type: str) -> str:
    """Return the name of the embedded spectrum of the nearest type; of several, the first in the library."""
    wanted = subtype(spectral_type)
    table = library_table()
    names = [
        (str(row["name"]), str(row["spectral_type"]))
        for row in table
        if str(row["kept"]) == "embedded" and _TYPE.match(str(row["spectral_type"]))
    ]
    return min(names, key=lambda one: abs(subtype(one[1]) - wanted))[0]
