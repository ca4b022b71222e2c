"""The bank of a search: flares of some half-widths and temperatures, filters in time over a level that is not known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.usual import WINDOW_S

if TYPE_CHECKING:
    from mauvecl.lightcurve.flares.shapes import Shape

Float = NDArray[np.float64]

#: Half-widths of a template before and after its peak that a window holds at least.
LEAD, TAIL = 5.0, 10.0
#: Onsets are tried at least so many to a half-width, and in each half of a frame where that is not fine enough.
ONSETS = 10
#: Frames to a half-width below which onsets within a frame are told apart.
SUB_FRAME = 6.0
#: Share of a template's power, of that without gaps, below which it is not looked for.
LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Level:
    """What is not known of the level under a flare, inside the window that is looked at.

    Attributes
    ----------
    offset, slope : bool
    cycle : bool
        Amplitudes of the curves that a search is given, such as those of the orbit's thermal cycle.
    window_s : float
        Time over which the level is taken for a straight line (and the curves); windows are no shorter, and hold at
        least 5 half-widths before a flare's peak and 10 after it.
    """

    offset: bool = True
    slope: bool = True
    cycle: bool = False
    window_s: float = WINDOW_S

    def __post_init__(self) -> None:
        if self.slope and not self.offset:
            raise InputError("a search marginalises over a slope without an offset, expected both or the offset alone")
        if not (np.isfinite(self.window_s) and self.window_s >= 0):
            raise InputError(f"the window of a search = {self.window_s:g} s, expected a time of at least 0")

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of time that are marginalised over."""
        return (*((0,) if self.offset else ()), *((1,) if self.slope else ()))


@dataclass(frozen=True, eq=False)
class Template:
    """One half-width of a bank on a grid of frames.

    Attributes
    ----------
    half_width_s : float
    first : int
        Frame of the first value, counted from the one in which the peak is.
    phases : tuple of float
        Where in its frame the peak is, in frames.
    shapes : ndarray, shape (n_phase, n)
        Mean excess in each frame of the window, for a peak of one.
    stride : int
        Frames from one onset that is tried to the next.
    """

    half_width_s: float
    first: int
    phases: tuple[float, ...]
    shapes: Float
    stride: int

    @cached_property
    def time(self) -> Float:
        """Time of each frame of the window, from -1 to 1 about its middle, shape (n,)."""
        n = self.shapes.shape[1]
        return np.asarray((np.arange(n) - (n - 1) / 2) / max((n - 1) / 2, 1.0))

    @cached_property
    def power(self) -> Float:
        """Sum of squares without gaps and with a known level, shape (n_phase,)."""
        return np.asarray(np.sum(self.shapes**2, axis=1))


@dataclass(frozen=True, eq=False)
class Bank:
    """What a search looks for.

    Attributes
    ----------
    half_widths_s : tuple of float
        Ascending.
    directions : ndarray, shape (n_temperature, n_sum)
        What a flare of each temperature does to the sums of a frame, of unit length: rows of `Templates.directions`, or
        one row of ones for a single light curve.
    shape : Shape
    frame_s : float
    level : Level
    """

    half_widths_s: tuple[float, ...]
    directions: Float
    shape: Shape
    frame_s: float
    level: Level = Level()

    def __post_init__(self) -> None:
        widths = self.half_widths_s
        if not widths or any(not (np.isfinite(w) and w > 0) for w in widths) or sorted(set(widths)) != list(widths):
            raise InputError(f"half-widths of a bank {list(widths)} s, expected ascending times above 0")
        if not (np.isfinite(self.frame_s) and self.frame_s > 0):
            raise InputError(f"frame_s = {self.frame_s:g}, expected a time above 0")
        kept = np.atleast_2d(np.array(self.directions, np.float64))
        length = np.linalg.norm(kept, axis=1, keepdims=True)
        if not (length > 0).all():
            raise InputError("a bank looks for flares that change no sum of a frame, expected ones that do")
        kept = kept / length
        kept.setflags(write=False)
        object.__setattr__(self, "directions", kept)

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """One to a half-width."""
        return tuple(self.template(w) for w in self.half_widths_s)

    def template(self, half_width_s: float, phases: Sequence[float] | None = None) -> Template:
        """One half-width on the grid of frames.

        Parameters
        ----------
        half_width_s : float
        phases : sequence of float, optional
            Where in their frames peaks are; as the bank has it by default.
        """
        frames = half_width_s / self.frame_s
        if phases is None:
            phases = (0.25, 0.75) if frames < SUB_FRAME else (0.5,)
        lead, tail = self.window(half_width_s)
        edges = np.arange(-lead, tail + 2) * self.frame_s
        shapes = np.array([self.shape.mean_over(edges, p * self.frame_s, half_width_s) for p in phases])
        return Template(half_width_s, -lead, tuple(phases), shapes, max(1, int(frames / ONSETS)))

    def window(self, half_width_s: float) -> tuple[int, int]:
        """Frames before and after the one of the peak over which the level is taken for what `Level` says."""
        half = self.level.window_s / 2
        lead, tail = (max(reach * half_width_s, half) / self.frame_s for reach in (LEAD, TAIL))
        return int(np.ceil(lead)), int(np.ceil(tail))
