"""Where values may lie that a user types, for whoever looks at them before anything large is loaded."""

from __future__ import annotations

import math

from mauvecl.schema.errors import InputError

#: Magnitudes of a star.
MAGNITUDES = (-30.0, 40.0)
#: Brightness temperatures that a flare may have, in K.
FLARE_TEMPERATURES_K = (1_000.0, 200_000.0)
#: Seconds of the longest exposure.
DAY_S = 86_400.0
EXPOSURES = "a time above 0 and up to one day (86400 s)"


def check_magnitude(value: float) -> None:
    """Refuse a star's magnitude outside -30 to 40.

    Raises
    ------
    InputError
    """
    low, high = MAGNITUDES
    if not low <= value <= high:
        raise InputError.of("magnitude", value, f"{low:g} to {high:g}")


def check_amplitude(value: float) -> None:
    """Refuse what is no flare amplitude.

    Raises
    ------
    InputError
    """
    if not (math.isfinite(value) and value >= 0.0):
        raise InputError.of("flare amplitude", value, "a finite number of at least 0")


def check_temperature(what: str, value: float) -> None:
    """Refuse a flare's temperature, or a photosphere's, beyond 1000 to 200 000 K.

    Raises
    ------
    InputError
    """
    low, high = FLARE_TEMPERATURES_K
    if not low <= value <= high:
        raise InputError.of(what, value, f"{low:g} to {high:g} K", unit="K")


def check_exposure(seconds: float) -> None:
    """Refuse an exposure of no time, or of more than a day.

    Raises
    ------
    InputError
    """
    if not 0 < seconds <= DAY_S:
        raise InputError.of("exposure", seconds, EXPOSURES, unit="s")
