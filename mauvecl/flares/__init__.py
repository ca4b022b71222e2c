"""Flares in time: names, defaults, cooling and slow changes, which are fast to import."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Duration, Help, Number, Range, Temperature, Unit
from mauvecl.schema.section import Section, setting

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    Float = NDArray[np.float64]

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
#: Largest number of temperatures, and thus of spectra, of a stare's flares.
MOST_TEMPERATURES = 8
Per = Literal["day", "month", "year"]
#: Star-days per unit; a month is a twelfth of a Julian year.
DAYS: dict[Per, float] = {"day": 1.0, "month": 365.25 / 12, "year": 365.25}


def check_shape(name: str) -> str:
    """Return the name of a flare shape; raises InputError if no shape has it."""
    if name not in SHAPE_NAMES:
        raise InputError.of("shape", name, f"one of {', '.join(SHAPE_NAMES)}")
    return name


#: Name of a flare shape in a study.
ShapeName = Annotated[str, AfterValidator(check_shape)]

#: Temperatures that differ by less are treated as equal, K.
SAME_K = 0.5


class CoolingLaw(Section):
    """Exponential cooling of a flare from the temperature of its peak."""

    end_k: Annotated[Temperature, Help("Final temperature")]
    fold_s: Annotated[Duration, Help("Time in which the temperature excess falls by a factor of e")]


@validated
class Cooling(CoolingLaw):
    """Temperature that is constant before the peak, and end + (peak - end) exp(-(t - t_peak) / fold) after it."""

    peak_k: Temperature

    def __init__(self, peak_k: Temperature, end_k: Temperature, fold_s: Duration) -> None:
        super().__init__(peak_k=peak_k, end_k=end_k, fold_s=fold_s)  # type: ignore[call-arg]
        if end_k > peak_k:
            raise InputError.of("end_k", end_k, f"at most the temperature of the peak, {peak_k:g} K", unit="K")

    def at(self, since_peak_s: Annotated[ArrayLike, Unit("s")]) -> NDArray[np.float64]:
        """Return the temperature at times since the peak, K, shape of the time."""
        import numpy as np

        cooled = np.exp(-np.maximum(since_peak_s, 0.0) / self.fold_s)
        return np.asarray(self.end_k + (self.peak_k - self.end_k) * cooled)

    @property
    def steady(self) -> bool:
        """True if the temperature hardly changes."""
        return self.peak_k - self.end_k < SAME_K


def integral_between_points(x: Float, y: Float, t: Float) -> Float:
    """Return the integral from the first point to t of what is linear between points, and zero outside them."""
    import numpy as np

    slope = np.diff(y) / np.diff(x)
    areas = np.concatenate([[0.0], np.cumsum(np.diff(x) * (y[1:] + y[:-1]) / 2)])
    k = np.clip(np.searchsorted(x, t, side="right") - 1, 0, x.size - 2)
    past = np.clip(t, x[0], x[-1]) - x[k]
    return np.asarray(areas[k] + past * (y[k] + slope[k] * past / 2))


@validated
class Curve(Section):
    """Slow change with time: a sinusoid, points, or a file with two columns, time in s and value.

    Between points the value is linear in time; before the first and after the last it is constant.
    """

    amplitude: Annotated[float, Range()] | None = setting(None, "Half the range of a sinusoid")
    period_s: Duration | None = setting(None, "Period of the sinusoid", usual="the orbit's")
    phase: Annotated[float, Unit("rad"), Range()] = setting(0.0, "Phase of the sinusoid at the start of the stare")
    points: tuple[tuple[Number, Number], ...] | None = setting(None, "Times in s, and values")
    file: Path | None = setting(None, "File with two columns, time in s and value")

    def _check_values(self) -> None:
        if (self.amplitude is not None) + (self.points is not None) + (self.file is not None) != 1:
            raise InputError(
                "a curve needs one of amplitude, points and file, but has none or several", key="amplitude"
            )
        if self.amplitude is None and (self.period_s is not None or self.phase):
            raise InputError("a curve has period_s or phase, which need an amplitude as well", key="amplitude")
        if self.points is not None:
            _check_points(self.points)

    @cached_property
    def _time_and_value(self) -> tuple[Float, Float]:
        """Times and values of the points, or of the file's rows."""
        import numpy as np

        from mauvecl.host.tables.text_tables import read_columns

        rows = np.array(self.points) if self.file is None else read_columns("curve", "values", self.file, "s")
        if self.file is not None:
            _check_points(rows.tolist())
        return rows[:, 0], rows[:, 1]

    def mean_over(
        self, start_s: Annotated[NDArray[np.float64], Unit("s")], frame_s: Duration, orbit_s: Duration = ORBIT_S
    ) -> Float:
        """Return the exact mean over each frame, shape (n_frame,); a sinusoid has the orbit's period by default."""
        import numpy as np

        if self.amplitude is None:
            return np.asarray((self._integral(start_s + frame_s) - self._integral(start_s)) / frame_s)
        period_s = orbit_s if self.period_s is None else self.period_s
        angle = 2 * np.pi * (start_s + frame_s / 2) / period_s + self.phase
        return np.asarray(self.amplitude * np.sinc(frame_s / period_s) * np.sin(angle))

    def _integral(self, t: Float) -> Float:
        """Return the integral from the first point to a time, shape of t."""
        import numpy as np

        time, value = self._time_and_value
        inside = integral_between_points(time, value, t)
        return np.asarray(inside + np.minimum(t - time[0], 0) * value[0] + np.maximum(t - time[-1], 0) * value[-1])


@validated
class Sinusoid(Curve):
    """The curve amplitude * sin(2 pi t / period + phase); by default with the period of the orbit."""

    def __init__(
        self,
        amplitude: Annotated[float, Range()],
        period_s: Duration | None = None,
        phase: Annotated[float, Unit("rad"), Range()] = 0.0,
    ) -> None:
        super().__init__(amplitude=amplitude, period_s=period_s, phase=phase)


def _check_points(points: Sequence[Sequence[float]]) -> None:
    """Raise InputError unless there are two or more points of finite values at ascending times."""
    if len(points) < 2:
        raise InputError.of("points", len(points), "at least 2 points")
    if not all(math.isfinite(number) for point in points for number in point):
        raise InputError("the times and values of a curve must be finite", key="points")
    for (time, _), (following, _) in pairwise(points):
        if time >= following:
            raise InputError.of("points", (time, following), "ascending times", unit="s")
