"""Evenly spaced times of a plan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..sky.helioecliptic import moment_of, offline

if TYPE_CHECKING:
    from astropy.time import Time

DAY_S = 86_400.0
#: Steps of one plan: eight years of minutes.
MOST_STEPS = 4_300_000


@dataclass(frozen=True)
class Moments:
    """Times from a start, in steps of the same length; UTC, taken as UT1 (they differ by less than a second).

    Attributes
    ----------
    start : str
        ISO 8601, UTC.
    days : float
        How long.
    step_s : float
        Seconds from one time to the next; the middles of the steps are looked at.

    Raises
    ------
    InputError
        If the start is no time in 1990-2100, or days and step give no number of steps from 1 to `MOST_STEPS`.
    """

    start: str
    days: float
    step_s: float = 60.0

    def __post_init__(self) -> None:
        for name in ("days", "step_s"):
            if not (np.isfinite(value := getattr(self, name)) and value > 0):
                raise InputError(f"{name} = {value}, expected a number > 0")
        if not 1 <= self.n <= MOST_STEPS:
            raise InputError(
                f"{self.days:g} days in steps of {self.step_s:g} s are {self.days * DAY_S / self.step_s:.3g} steps, "
                f"expected 1 to {MOST_STEPS}"
            )
        _ = self.first  # a start that is no time is refused here

    @property
    def n(self) -> int:
        """Steps; the last may be shorter than the others."""
        return int(np.ceil(self.days * DAY_S / self.step_s - 1e-9))

    @cached_property
    def first(self) -> tuple[float, float]:
        """Julian date of the start, UTC: the midnight before, and the fraction of the day."""
        with offline():
            time = moment_of(self.start)
            day, rest = float(time.utc.jd1), float(time.utc.jd2)
        midnight = np.floor(day - 0.5) + 0.5
        fraction = (day - midnight) + rest
        # The second part may be half a day, on either side.
        midnight += np.floor(fraction)
        return float(midnight), float(fraction - np.floor(fraction))

    @cached_property
    def seconds(self) -> NDArray[np.float64]:
        """Middles of the steps since the start, s, (n,)."""
        middles = np.asarray((np.arange(self.n, dtype=np.float64) + 0.5) * float(self.step_s))
        middles.setflags(write=False)
        return middles

    @property
    def julian(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Julian dates, UTC, (n,) each: midnight before the start, and days since."""
        midnight, fraction = self.first
        return np.full(self.n, midnight, np.float64), np.asarray(fraction + self.seconds / DAY_S)

    def iso(self, seconds: float, digits: int = 0) -> str:
        """A time since the start as text, UTC."""
        return utc_text(sum(self.first) + seconds / DAY_S, digits)

    @property
    def mjd(self) -> float:
        """Modified Julian date of the start, UTC."""
        return self.first[0] - 2_400_000.5 + self.first[1]


def as_time(midnight: float, days: NDArray[np.float64]) -> Time:
    """Astropy's times; to be called inside `offline`."""
    from astropy.time import Time

    return Time(np.full(days.shape, midnight), days, format="jd", scale="utc")


def utc_text(julian: float, digits: int = 0) -> str:
    """A Julian date as ISO 8601, UTC; good to a tenth of a millisecond."""
    # numpy's calendar: days without leap seconds, as here.
    micro = round((julian - 2_440_587.5) * DAY_S * 10**digits) * 10 ** (6 - digits)
    text = str(np.datetime64(micro, "us"))
    return text[:19] if digits == 0 else text[: 20 + digits]
