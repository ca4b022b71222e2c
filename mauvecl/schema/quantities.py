"""Conversion of Quantities and plain values to numbers, arrays and counts.

Plain numbers are checked without NumPy, so that wrong ones are reported immediately.
"""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Words for units in messages.
WORDS = {
    "": "a number",
    "K": "kelvin",
    "deg_C": "degrees Celsius",
    "mag": "magnitudes",
    "mag / arcsec2": "mag/arcsec2",
    "s": "seconds",
    "h": "hours",
    "d": "days",
    "deg": "degrees",
    "1 / h": "a number per hour",
    "1 / d": "a number per day",
}


def is_quantity(value: Any) -> bool:
    """Return whether a value is an astropy Quantity."""
    return hasattr(value, "to_value") and hasattr(value, "unit")


def number(
    what: str, value: Any, unit: str = "", *, low: float = -math.inf, high: float = math.inf, expected: str = ""
) -> float:
    """Return one finite number in a unit.

    Raises InputError if the value is not a finite number in the range and unit.

    Parameters
    ----------
    what : str
        Name of the value, for messages.
    unit : str
        As astropy reads it. Wavelengths may come as frequencies or energies, temperatures on any scale.
    low, high : float
        Closed range of accepted values.
    expected : str
        Accepted values, for messages; from unit and range by default.
    """
    wanted = expected or _expected(unit, low, high)
    if type(value) is float:
        plain = value
    else:
        one = _plain(what, value, unit, wanted)
        plain = float(one) if not one.ndim else math.nan
    if not (math.isfinite(plain) and low <= plain <= high):
        raise InputError.of(what, value, wanted)
    return plain


def numbers(
    what: str, values: Any, unit: str = "", *, low: float = -math.inf, high: float = math.inf
) -> NDArray[np.float64]:
    """Return finite numbers in a unit, in the shape of `values`; parameters and errors as for `number`."""
    import numpy as np

    wanted = _expected(unit, low, high)
    plain = _plain(what, values, unit, wanted)
    bad = ~(np.isfinite(plain) & (plain >= low) & (plain <= high))
    if bad.any():
        first = plain[np.unravel_index(int(np.argmax(bad)), plain.shape)]
        raise InputError.of(what, float(first), wanted, unit=unit)
    return plain


def count(what: str, value: Any, *, low: int = 0, high: int = 2**63 - 1) -> int:
    """Return a whole number, given as an int, a float such as 1e5 or a dimensionless Quantity.

    Raises InputError if the value is not a whole number from `low` to `high`.
    """
    wanted = f"a whole number from {low} to {high}" if high < 2**63 - 1 else f"a whole number of at least {low}"
    try:
        # Whole numbers beyond 2**53 are no floats.
        whole = operator.index(_no_truth(value))
    except TypeError:
        plain = number(what, value, expected=wanted)
        if not plain.is_integer():
            raise InputError.of(what, value, wanted) from None
        whole = int(plain)
    if not low <= whole <= high:
        raise InputError.of(what, whole, wanted)
    return whole


def _plain(what: str, value: Any, unit: str, wanted: str) -> NDArray[np.float64]:
    import numpy as np

    try:
        if is_quantity(value):
            value = without_unit(value, unit)
        if isinstance(value, str | bytes) or np.asarray(value).dtype.kind not in "iuf":
            raise TypeError("no number")
        return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError.of(what, value, wanted) from error


def without_unit(value: Any, unit: str) -> Any:
    """Return a Quantity as plain numbers: a float, or an array of its shape.

    Raises ValueError if its unit has no equivalent in `unit`. Wavelengths may be frequencies or energies, and
    temperatures may be on any scale.
    """
    import astropy.units as u

    # Detector counts are called DN here and adu elsewhere.
    equivalent: Any = [(u.adu, u.DN)]
    wanted = u.Unit(unit)
    if wanted.is_equivalent(u.nm):
        equivalent = u.spectral()
    elif wanted.is_equivalent(u.K) or wanted == u.deg_C:
        equivalent = u.temperature()
    try:
        converted = value.to_value(wanted, equivalent)
    except u.UnitsError as error:
        raise ValueError(str(error)) from error
    return converted if getattr(converted, "ndim", 0) else float(converted)


def _no_truth(value: Any) -> Any:
    if isinstance(value, bool):
        raise TypeError("true or false is no number")
    return value


def word_of(unit: str) -> str:
    """Return the words for a unit in a message."""
    return WORDS.get(unit, unit)


def _expected(unit: str, low: float, high: float) -> str:
    word = WORDS.get(unit, unit)
    if math.isfinite(low) and math.isfinite(high):
        return f"{low:g} to {high:g}{f' {unit}' if unit else ''}"
    return f"{word} of at least {low:g}" if math.isfinite(low) else word
