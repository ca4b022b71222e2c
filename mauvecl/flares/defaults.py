"""Names and default values of flares, stares and searches, in a module that is fast to import."""

from __future__ import annotations

import math
from typing import Literal

from mauvecl.schema.errors import InputError

#: Shapes of flares: `flares.shapes.SHAPES`.
SHAPE_NAMES = ("davenport2014", "tovarmendoza2022", "fiducial")
#: Period of the flown orbit, s: 94.635 min, from the mean motion of 15.21638735 revolutions a day in the public
#: elements of NORAD 66756, epoch 2026 day 257.
ORBIT_S = 86_400.0 / 15.21638735
#: Default half-widths of a bank, s, in steps of a factor of 1.86, so that flares of 10 to 1800 s lose at most 1.3 % of
#: their S/N.
HALF_WIDTHS_S = (12.0, 22.0, 42.0, 77.0, 144.0, 267.0, 496.0, 923.0, 1720.0)
#: Default time over which the baseline is a straight line, s: a third of an orbit (assumed).
WINDOW_S = 1800.0
#: Default number of sums per frame in a search.
RANK = 3
Per = Literal["day", "month", "year"]
#: Star-days per unit; a month is a twelfth of a Julian year.
DAYS: dict[Per, float] = {"day": 1.0, "month": 365.25 / 12, "year": 365.25}


def check_shape(name: str) -> None:
    """Raise InputError if no flare shape has this name."""
    if name not in SHAPE_NAMES:
        raise InputError.of("shape", name, f"one of {', '.join(SHAPE_NAMES)}")


def per_day(false_alarms: float, per: Per) -> float:
    """Convert a number of false alarms per unit of time to false alarms per star-day."""
    if per not in DAYS:
        raise InputError.of("per", per, f"per {', '.join(DAYS)}")
    if not (math.isfinite(false_alarms) and false_alarms > 0):
        raise InputError.of("false_alarms", false_alarms, "a number above 0")
    return false_alarms / DAYS[per]
