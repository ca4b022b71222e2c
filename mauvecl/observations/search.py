"""Observed light curves as they are searched: sums of frames, their noise, and the process of the quiescent light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares.stare import Stare, select_frames
from mauvecl.observations.level import process_level
from mauvecl.observations.process import Process
from mauvecl.observations.process_search import ProcessSearch
from mauvecl.schema.physical import DAY_S
from mauvecl.search.templates import Bank, Baseline, Templates

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape
    from mauvecl.observations.frames import Frames

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Step between half-widths of a bank: the same as that of `lightcurve.defaults.HALF_WIDTHS_S`.
WIDTH_STEP = 1.86
#: Narrowest template in frames, and widest as a share of the time in frames without gaps of a day, and in seconds.
NARROWEST, WIDEST, WIDEST_S = 1.5, 0.15, 7200.0
#: Smallest window around an event, in cadences and seconds.
WINDOW_FRAMES, WINDOW_S = 120, 1800.0
#: Smallest number of quiescent frames from which the level of the star follows.
MIN_BASELINE = 10
#: Temperature assumed for flares in a light curve without colour, K.
NO_COLOUR_K = 10_000.0
#: Process of independent frames whose noise is as stated.
WHITE = Process((), 1.0)


@dataclass(frozen=True)
class Detection:
    """Event above the threshold of the search, before it is measured."""

    value: float  # statistic of the best template
    half_width_s: float
    peak_s: float  # in the stare
    direction: int  # row of the bank's directions
    amplitude: float  # of the template, in the unit of the sums along the direction
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class SeriesSurvey:
    """Observed frames that are searched: sums in units of the quiescent noise."""

    stare: Stare  # times of the searched frames
    bank: Bank
    # Sums of a flare of unit amplitude, whose light equals that of the quiescent star.
    templates: Templates
    # Shape (n_frame, n_sum); searched sums: for spectra, sums weighted for flares; for a light curve, its flux.
    sums: Float
    variance: Float  # shape (n_frame,); variance of the noise of each sum, without the excess of its process
    processes: tuple[Process, ...]  # of the sums, which are independent
    # Shape (n_frame,); flux over `scale`, from which amplitudes and summed durations follow.
    flux: Float
    flux_variance: Float  # shape (n_frame,); variance of the noise of the flux, without the excess of its process
    flux_process: Process
    scale: float  # typical standard deviation of the flux of a frame, in the unit of the flux
    level: float  # typical quiescent level, in the unit of the flux, to which amplitudes are relative
    photon: float  # rise of the variance with the flux, in the unit of the flux
    time_s: Float  # shape (n_frame,); times of the frames as observed, against those of the stare's regular grid
    counts: float = 0.0  # counts in a unit of the flux, if frames hold few; else zero
    weighted: bool = False  # whether the sums are weighted ones of spectra, and not the flux itself

    @classmethod
    def of(
        cls, frames: Frames, flux: Float, variance: Float, used: Bool, level: float, photon: float, shape: Shape,
        counts: float = 0.0,
    ) -> SeriesSurvey:  # fmt: skip
        """Prepare the frames of a light curve that can be searched, `used`, without a process; see the attributes."""
        stare = stare_of(frames, used)
        scale = float(np.sqrt(np.median(variance[used])))
        typical = abs(level)
        size, noise = typical / scale, photon * typical / scale**2
        templates = Templates(
            (NO_COLOUR_K,), np.ones((1, 1)), np.full((1, 1), size), np.array([size]), np.full((1, 1, 1), noise)
        )
        net, part = flux[used] / scale, variance[used] / scale**2
        return cls(
            stare, bank_of(stare, np.ones((1, 1)), shape), templates, net[:, None], part, (WHITE,), net, part, WHITE,
            scale, typical, photon, frames.time_s[used], counts,
        )  # fmt: skip

    @cached_property
    def search(self) -> ProcessSearch:
        """Search of the frames."""
        return ProcessSearch(self.bank, self.stare, self.processes, self.variance)

    def levels(self, quiet: Bool) -> Float:
        """Return the mean of the process of each sum given quiescent frames, shape (n_frame, n_sum)."""
        return np.column_stack([
            process_level(process, self.stare.start_s, column, self.variance, quiet)
            for process, column in zip(self.processes, self.sums.T, strict=True)
        ])  # fmt: skip

    def along(self, direction: int, quiet: Bool) -> Float:
        """Return the sum along a direction of the bank less its level, in standard deviations, shape (n_frame,)."""
        unit = self.bank.directions[direction]
        excess = np.array([process.excess for process in self.processes])
        return np.asarray((self.sums - self.levels(quiet)) @ unit / np.sqrt(self.variance * (unit**2 @ excess**2)))

    def flux_level(self, quiet: Bool) -> Float:
        """Return the quiescent level of the flux given quiescent frames, in units of `scale`, shape (n_frame,).

        With fewer than `MIN_BASELINE` of these, it is the typical level.
        """
        if quiet.sum() < MIN_BASELINE:
            return np.full(quiet.size, self.level / self.scale)
        return process_level(self.flux_process, self.stare.start_s, self.flux, self.flux_variance, quiet)

    def inverted(self) -> SeriesSurvey:
        """Return the survey upside down: losses of light become flares."""
        return replace(self, sums=-self.sums, flux=-self.flux)

    def backwards(self) -> SeriesSurvey:
        """Return the survey in the other direction of time."""
        start = self.stare.start_s
        names = ("sums", "variance", "flux", "flux_variance", "time_s")
        return replace(
            self, stare=replace(self.stare, start_s=start[-1] + start[0] - start[::-1]),
            **{name: getattr(self, name)[::-1] for name in names},
        )  # fmt: skip

    def frames(self, kept: Bool) -> SeriesSurvey:
        """Return the survey of some of the frames."""
        part = select_frames(self.stare, kept)
        names = ("sums", "variance", "flux", "flux_variance", "time_s")
        return replace(self, stare=part, **{name: getattr(self, name)[kept] for name in names})


def stare_of(frames: Frames, used: Bool) -> Stare:
    """Return the frames that are searched as a stare on the regular grid of the cadence."""
    numbers = frames.numbers[used]
    ones = np.ones(numbers.size)
    return Stare(
        np.asarray((numbers - numbers[0]) * frames.cadence_s, np.float64), frames.cadence_s, ones, ones, ones,
        np.zeros(numbers.size),
    )  # fmt: skip


def bank_of(stare: Stare, directions: Float, shape: Shape) -> Bank:
    """Return the template bank for a stare."""
    window = max(WINDOW_S, WINDOW_FRAMES * stare.frame_s)
    return Bank(half_widths(stare), directions, shape, stare.frame_s, Baseline(window_s=window))


def half_widths(stare: Stare) -> tuple[float, ...]:
    """Return the half-widths of a bank for a light curve, s."""
    low = NARROWEST * stare.frame_s
    gaps = np.flatnonzero(np.diff(stare.numbers) * stare.frame_s > DAY_S) + 1
    longest = int(np.diff(np.concatenate([[0], gaps, [stare.n_frames]])).max())
    high = max(low, min(WIDEST * longest * stare.frame_s, WIDEST_S))
    steps = max(1, round(np.log(high / low) / np.log(WIDTH_STEP)) + 1)
    return tuple(float(w) for w in low * WIDTH_STEP ** np.arange(steps))
