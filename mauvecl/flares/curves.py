"""Slow changes during a stare: sinusoids, and values at times that are interpolated linearly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import model_validator

from mauvecl.flares.defaults import ORBIT_S
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Help, Range, Unit
from mauvecl.schema.physical import Duration
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Float = NDArray[np.float64]


@validated
class Curve(Section):
    """Slow change with time: a sinusoid, points, or a file with two columns, time in s and value.

    Between points the value is linear in time; before the first and after the last it is constant.
    """

    amplitude: Annotated[Annotated[float, Range()] | None, Help("Half the range of a sinusoid")] = None
    period_s: Annotated[Duration | None, Help("Period of the sinusoid", default="the orbit's")] = None
    phase: Annotated[float, Unit("rad"), Range(), Help("Phase of the sinusoid at the start of the stare")] = 0.0
    points: Annotated[tuple[tuple[float, float], ...] | None, Help("Times in s, and values")] = None
    file: Annotated[Path | None, Help("File with two columns, time in s and value")] = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.amplitude is not None) + (self.points is not None) + (self.file is not None) != 1:
            raise InputError(
                "a curve has none or several of amplitude, points and file",
                "one of them",
                key="amplitude",
                value=self.amplitude,
            )
        if self.amplitude is None and (self.period_s is not None or self.phase):
            raise InputError(
                "a curve without amplitude has period_s or phase", "them with an amplitude only", key="amplitude"
            )
        if self.points is not None:
            _check_points(self.points)
        return self

    @cached_property
    def _time_and_value(self) -> tuple[Float, Float]:
        import numpy as np

        from mauvecl.host.tables.text_lines import read_columns

        rows = np.array(self.points) if self.file is None else read_columns("curve", "values", self.file)
        if self.file is not None:
            _check_points(rows.tolist())
        return rows[:, 0], rows[:, 1]

    def mean_over(self, start_s: Annotated[Float, Unit("s")], frame_s: Duration, orbit_s: Duration = ORBIT_S) -> Float:
        """Return the exact mean over each frame, shape (n_frame,).

        Parameters
        ----------
        start_s : ndarray, shape (n_frame,)
        frame_s : float
        orbit_s : float
            Period of a sinusoid without a given period.
        """
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
        slope = np.diff(value) / np.diff(time)
        areas = np.concatenate([[0.0], np.cumsum(np.diff(time) * (value[1:] + value[:-1]) / 2)])
        k = np.clip(np.searchsorted(time, t, side="right") - 1, 0, time.size - 2)
        past = np.clip(t, time[0], time[-1]) - time[k]
        inside = areas[k] + past * (value[k] + slope[k] * past / 2)
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
        raise InputError("a curve holds a time or value that is not finite", "numbers", key="points")
    for (time, _), (following, _) in pairwise(points):
        if time >= following:
            raise InputError.of("points", (time, following), "ascending times", unit="s")
