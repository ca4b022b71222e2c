"""Evenly spaced times of an observing plan."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import DAY_S, Duration

from ..sky.helioecliptic import parse_time
from ..tables.times import offline

if TYPE_CHECKING:
    from astropy.time import Time

#: Largest number of steps of a plan: eight years of minutes.
MAX_STEPS = 4_300_000


@validated
@dataclass(frozen=True)
class TimeGrid:
    """Evenly spaced times in UTC, which stands in for UT1 (they differ by less than a second).

    Raises InputError if the start is outside 1990-2100 or the number of steps is outside 1 to `MAX_STEPS`.
    """

    start: str  # ISO 8601, UTC
    days: Annotated[float, Unit("d"), Range(0, open_low=True)]  # length of the plan
    step_s: Duration = 60.0  # length of a step; conditions are evaluated at its middle

    def __post_init__(self) -> None:
        if not 1 <= self.n <= MAX_STEPS:
            raise InputError(
                f"{self.days:g} days in steps of {self.step_s:g} s are {self.days * DAY_S / self.step_s:.3g} steps",
                f"1 to {MAX_STEPS}",
                key="step_s",
                value=self.step_s,
            )
        _ = self.first  # raises InputError for an invalid start

    @property
    def n(self) -> int:
        """Number of steps; the last may be shorter than the others."""
        return int(np.ceil(self.days * DAY_S / self.step_s - 1e-9))

    @cached_property
    def first(self) -> tuple[float, float]:
        """Julian date of the start, UTC: the preceding midnight and the fraction of the day."""
        with offline():
            time = parse_time(self.start)
            day, rest = float(time.utc.jd1), float(time.utc.jd2)
        midnight = np.floor(day - 0.5) + 0.5
        fraction = (day - midnight) + rest
        # Astropy's second part lies within half a day on either side.
        midnight += np.floor(fraction)
        return float(midnight), float(fraction - np.floor(fraction))

    @cached_property
    def seconds(self) -> NDArray[np.float64]:
        """Middles of the steps, s since the start, shape (n,)."""
        middles = np.asarray((np.arange(self.n, dtype=np.float64) + 0.5) * float(self.step_s))
        middles.setflags(write=False)
        return middles

    @property
    def julian(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Julian dates, UTC: the midnight before the start and the days since, shape (n,) each."""
        midnight, fraction = self.first
        return np.full(self.n, midnight, np.float64), np.asarray(fraction + self.seconds / DAY_S)

    def iso(self, seconds: float, digits: int = 0) -> str:
        """Return a time since the start in ISO 8601, UTC."""
        return utc_text(sum(self.first) + seconds / DAY_S, digits)

    @property
    def mjd(self) -> float:
        """Modified Julian date of the start, UTC."""
        return self.first[0] - 2_400_000.5 + self.first[1]


def as_time(midnight: float, days: NDArray[np.float64]) -> Time:
    """Return the times as astropy's; call inside `offline`."""
    from astropy.time import Time

    return Time(np.full(days.shape, midnight), days, format="jd", scale="utc")


def utc_text(julian: float, digits: int = 0) -> str:
    """Return a Julian date in ISO 8601, UTC, accurate to a tenth of a millisecond."""
    # Neither numpy's calendar nor these Julian dates count leap seconds.
    micro = round((julian - 2_440_587.5) * DAY_S * 10**digits) * 10 ** (6 - digits)
    text = str(np.datetime64(micro, "us"))
    return text[:19] if digits == 0 else text[: 20 + digits]
