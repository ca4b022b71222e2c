"""Names and usual values of flares, stares and searches, for whoever asks for some.

The modules beside have what is behind them, and take longer to load.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened

#: Shapes of flares: `flares.shapes.SHAPES`.
SHAPE_NAMES = ("davenport2014", "tovarmendoza2022", "fiducial")
#: What changes from frame to frame: the star's own level without its flares; the throughput for all light, of star,
#: flare and sky; the sky's brightness; the detector's temperature.
Changing = Literal["star", "light", "sky", "temperature"]
CHANGING: tuple[Changing, ...] = get_args(Changing)
#: Period of the flown orbit, s: 94.635 min, from the mean motion of 15.21638735 revolutions a day in the public
#: elements of NORAD 66756, epoch 2026 day 257.
ORBIT_S = 86_400.0 / 15.21638735
#: Half-widths that a search looks for unless told, s: a factor of 1.86 apart, so that flares of 10 to 1800 s lose at
#: most 1.3 % of S/N.
HALF_WIDTHS_S = (12.0, 22.0, 42.0, 77.0, 144.0, 267.0, 496.0, 923.0, 1720.0)
#: Time over which a level is taken for a straight line unless told, s: a third of an orbit; an assumption.
WINDOW_S = 1800.0
#: Sums of a frame that a search takes unless told.
RANK = 3
Per = Literal["day", "month", "year"]
#: Star-days in each: of the Julian year, a twelfth of it a month.
DAYS: dict[Per, float] = {"day": 1.0, "month": 365.25 / 12, "year": 365.25}


def check_shape(name: str) -> None:
    """Refuse what is no shape's name.

    Raises
    ------
    InputError
        With the names that there are.
    """
    if name not in SHAPE_NAMES:
        raise InputError(f"flare shape {shortened(name)} is unknown, expected one of {', '.join(SHAPE_NAMES)}")


def per_day(false_alarms: float, per: Per) -> float:
    """False alarms per star-day.

    Raises
    ------
    InputError
        For a number that is not above 0, or another unit.
    """
    if per not in DAYS:
        raise InputError(f"false alarms per {per!r}, expected per {', '.join(DAYS)}")
    if not (math.isfinite(false_alarms) and false_alarms > 0):
        raise InputError(f"false alarms = {false_alarms:g} per {per}, expected a number above 0")
    return false_alarms / DAYS[per]
