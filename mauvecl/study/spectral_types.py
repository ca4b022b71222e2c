"""Which spectrum of the library stands for a star of a spectral type."""

from __future__ import annotations

import re

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.stars.catalogue import library_table

#: Classes by falling temperature.
CLASSES = "OBAFGKM"
_TYPE = re.compile(rf"\s*(?:d)?([{CLASSES}])\s*(\d(?:\.\d+)?)?")


def subtype(spectral_type: str) -> float:
    """A type as a number: ten to a class, so that K5 is 55 and M0 60; a class alone is its middle.

    Raises
    ------
    InputError
        If it does not begin with a class from O to M.
    """
    matched = _TYPE.match(spectral_type)
    if not matched:
        raise InputError(f"spectral type {shortened(spectral_type)}, expected one from O to M, such as M3V")
    return 10.0 * CLASSES.index(matched[1]) + (5.0 if matched[2] is None else float(matched[2]))


def nearest_spectrum(spectral_type: str) -> str:
    """Name of the embedded spectrum of the nearest type; of the same distance the one that comes first.

    Raises
    ------
    InputError
        As `subtype`.
    """
    wanted = subtype(spectral_type)
    table = library_table()
    names = [
        (str(row["name"]), str(row["spectral_type"]))
        for row in table
        if str(row["kept"]) == "embedded" and _TYPE.match(str(row["spectral_type"]))
    ]
    return min(names, key=lambda one: abs(subtype(one[1]) - wanted))[0]
