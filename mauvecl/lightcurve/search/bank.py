"""Template bank of a search: flares of several half-widths and temperatures on an unknown baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.defaults import WINDOW_S
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.lightcurve.flares.shapes import Shape

Float = NDArray[np.float64]

#: Shortest window before and after a peak, in half-widths of the template.
LEAD, TAIL = 5.0, 10.0
#: Smallest number of onsets per half-width.
ONSETS = 10
#: Half-width in frames below which two onsets per frame are searched.
SUB_FRAME = 6.0
#: Smallest share of a template's power outside gaps for which it is searched.
LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Baseline:
    """Baseline under a flare: the terms that are marginalised over in each window.

    Attributes
    ----------
    offset, slope : bool
    cycle : bool
        Curves of unknown amplitude, such as the orbital thermal cycle.
    window_s : float
        Smallest window. Windows also include at least 5 half-widths before the peak and 10 after it.
    """

    offset: bool = True
    slope: bool = True
    cycle: bool = False
    window_s: float = WINDOW_S

    def __post_init__(self) -> None:
        if self.slope and not self.offset:
            raise InputError.of("slope", self.slope, "no slope without an offset")
        if not (np.isfinite(self.window_s) and self.window_s >= 0):
            raise InputError.of("window_s", self.window_s, "a time of at least 0", unit="s")

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of time in the baseline."""
        return (*((0,) if self.offset else ()), *((1,) if self.slope else ()))


@dataclass(frozen=True, eq=False)
class Template:
    """Flare shapes of one half-width on a grid of frames."""

    half_width_s: float
    first: int  # first frame of the window relative to the frame of the peak
    phases: tuple[float, ...]  # positions of the peak within its frame, in frames
    shapes: Float  # mean flux per frame for a peak of 1, shape (n_phase, n)
    stride: int  # frames between onsets

    @cached_property
    def time(self) -> Float:
        """Time of each frame of the window, from -1 to 1 about its middle, shape (n,)."""
        n = self.shapes.shape[1]
        return np.asarray((np.arange(n) - (n - 1) / 2) / max((n - 1) / 2, 1.0))

    @cached_property
    def power(self) -> Float:
        """Sum of squares without gaps and with a known baseline, shape (n_phase,)."""
        return np.asarray(np.sum(self.shapes**2, axis=1))


@dataclass(frozen=True, eq=False)
class Bank:
    """Template bank of a search.

    Attributes
    ----------
    half_widths_s : tuple of float
        Ascending.
    directions : ndarray, shape (n_temperature, n_sum)
        Unit vectors of the change of a frame's sums for each temperature: rows of `Templates.directions`, or one row of
        ones for a single light curve.
    shape : Shape
    frame_s : float
    baseline : Baseline
    """

    half_widths_s: tuple[float, ...]
    directions: Float
    shape: Shape
    frame_s: float
    baseline: Baseline = Baseline()

    def __post_init__(self) -> None:
        widths = self.half_widths_s
        if not widths or any(not (np.isfinite(w) and w > 0) for w in widths) or sorted(set(widths)) != list(widths):
            raise InputError.of("half_widths_s", list(widths), "ascending times above 0")
        if not (np.isfinite(self.frame_s) and self.frame_s > 0):
            raise InputError.of("frame_s", self.frame_s, "a time above 0")
        kept = np.atleast_2d(np.array(self.directions, np.float64))
        length = np.linalg.norm(kept, axis=1, keepdims=True)
        if not (length > 0).all():
            raise InputError("a direction of the bank is zero", "flares that change a sum of a frame", key="directions")
        kept = kept / length
        kept.setflags(write=False)
        object.__setattr__(self, "directions", kept)

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """Templates of all half-widths."""
        return tuple(self.template(w) for w in self.half_widths_s)

    def template(self, half_width_s: float, phases: Sequence[float] | None = None) -> Template:
        """Compute the template of a half-width.

        Parameters
        ----------
        phases : sequence of float, optional
            Positions of peaks within their frames; by default one or two, depending on the half-width.
        """
        frames = half_width_s / self.frame_s
        if phases is None:
            phases = (0.25, 0.75) if frames < SUB_FRAME else (0.5,)
        lead, tail = self.window(half_width_s)
        edges = np.arange(-lead, tail + 2) * self.frame_s
        shapes = np.array([self.shape.mean_over(edges, p * self.frame_s, half_width_s) for p in phases])
        return Template(half_width_s, -lead, tuple(phases), shapes, max(1, int(frames / ONSETS)))

    def window(self, half_width_s: float) -> tuple[int, int]:
        """Return the number of frames of the window before and after the peak."""
        half = self.baseline.window_s / 2
        lead, tail = (max(reach * half_width_s, half) / self.frame_s for reach in (LEAD, TAIL))
        return int(np.ceil(lead)), int(np.ceil(tail))


@lru_cache(maxsize=8)
def white_bank(half_widths_s: tuple[float, ...], shape: Shape, frame_s: float, baseline: Baseline = Baseline()) -> Bank:
    """Return the bank of a single light curve with white noise; the same one for the same arguments."""
    return Bank(half_widths_s, np.ones((1, 1)), shape, frame_s, baseline)
