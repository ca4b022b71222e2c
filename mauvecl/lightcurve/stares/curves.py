"""Slow changes during a stare: sinusoids and linearly interpolated tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.defaults import ORBIT_S
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import Duration

Float = NDArray[np.float64]


@validated
@dataclass(frozen=True)
class Sinusoid:
    """The curve amplitude * sin(2 pi t / period + phase)."""

    amplitude: Annotated[float, Range()]  # half of the range
    period_s: Duration = ORBIT_S
    phase: Annotated[float, Range()] = 0.0  # radians, at the start of the stare

    def mean_over(self, start_s: Annotated[Float, Unit("s")], frame_s: Duration) -> Float:
        """Return the mean over each frame, shape (n_frame,)."""
        angle = 2 * np.pi * (start_s + frame_s / 2) / self.period_s + self.phase
        return np.asarray(self.amplitude * np.sinc(frame_s / self.period_s) * np.sin(angle))


@dataclass(frozen=True, eq=False)
class Table:
    """Values at times, interpolated linearly, and constant before the first and after the last time."""

    time_s: Float  # ascending, shape (n,)
    values: Float  # shape (n,)

    def __post_init__(self) -> None:
        for name in ("time_s", "values"):
            kept = np.array(getattr(self, name), np.float64)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)
        if self.time_s.ndim != 1 or self.time_s.shape != self.values.shape or self.time_s.size < 2:
            raise InputError.of("values", self.values.size, f"one for each of {self.time_s.size} times, at least 2")
        if not (np.isfinite(self.time_s).all() and np.isfinite(self.values).all()):
            raise InputError("a curve holds a time or value that is not finite", "numbers", key="values")
        steps = np.diff(self.time_s)
        if not (steps > 0).all():
            place = int(np.argmin(steps > 0))
            raise InputError.of(
                "time_s", (float(self.time_s[place]), float(self.time_s[place + 1])), "ascending", unit="s"
            )

    def mean_over(self, start_s: Float, frame_s: float) -> Float:
        """Return the exact mean over each frame, shape (n_frame,)."""
        return np.asarray((self._until(start_s + frame_s) - self._until(start_s)) / frame_s)

    def _until(self, t: Float) -> Float:
        """Return the integral from the first point to a time, shape of t."""
        time, value = self.time_s, self.values
        slope = np.diff(value) / np.diff(time)
        areas = np.concatenate([[0.0], np.cumsum(np.diff(time) * (value[1:] + value[:-1]) / 2)])
        k = np.clip(np.searchsorted(time, t, side="right") - 1, 0, time.size - 2)
        past = np.clip(t, time[0], time[-1]) - time[k]
        inside = areas[k] + past * (value[k] + slope[k] * past / 2)
        return np.asarray(inside + np.minimum(t - time[0], 0) * value[0] + np.maximum(t - time[-1], 0) * value[-1])


Curve = Sinusoid | Table
