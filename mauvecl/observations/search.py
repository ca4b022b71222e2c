"""Observed light curves as they are searched: sums of frames, their noise and process, and the rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.flares.stare import Stare, select_frames
from mauvecl.observations.level import LevelGiven
from mauvecl.observations.process import UNREPORTED, Process, Steps, level_fit
from mauvecl.observations.process_search import ProcessSearch
from mauvecl.schema.physical import DAY_S
from mauvecl.search.templates import Bank, Baseline, Templates

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape
    from mauvecl.observations.frames import Frames

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Step between half-widths of a bank: the same as that of `flares.settings.HALF_WIDTHS_S`.
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
class DetectedEvent:
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
    templates: Templates  # sums of a flare of unit amplitude, whose light equals that of the quiescent star
    sums: Float  # shape (n_frame, n_sum); sums of spectra weighted for flares, or the flux of a light curve
    variance: Float  # shape (n_frame,); variance of the noise of each sum and of the flux, without their excess
    processes: tuple[Process, ...]  # of the sums, which are independent
    flux: Float  # shape (n_frame,); flux over `scale`, from which amplitudes and summed durations follow
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
        counts: float = 0.0, weighted: tuple[Templates, Float] | None = None,
    ) -> SeriesSurvey:  # fmt: skip
        """Prepare the frames that can be searched, `used`, without a process; see the attributes.

        What is searched is the flux, or sums of spectra, given `weighted` with their templates.
        """
        stare = stare_of(frames, used)
        scale = float(np.sqrt(np.median(variance[used])))
        typical = abs(level)
        net, part = flux[used] / scale, variance[used] / scale**2
        if weighted is None:
            size, noise, directions, sums = typical / scale, photon * typical / scale**2, np.ones((1, 1)), net[:, None]
            templates = Templates(
                (NO_COLOUR_K,), directions, np.full((1, 1), size), np.array([size]), np.full((1, 1, 1), noise)
            )
        else:
            templates, sums = weighted[0], weighted[1][used]
            directions = templates.directions[list(templates.chosen)]
        return cls(
            stare, bank_of(stare, directions, shape), templates, sums, part, (WHITE,) * sums.shape[1], net, WHITE,
            scale, typical, photon, frames.time_s[used], counts, weighted is not None,
        )  # fmt: skip

    @cached_property
    def search(self) -> ProcessSearch:
        """Search of the frames."""
        return ProcessSearch(self.bank, self.stare, self.processes, self.variance)

    def levels(self, quiet: Bool) -> Float:
        """Return the mean of the process of each sum given quiescent frames, shape (n_frame, n_sum)."""
        return np.column_stack([
            LevelGiven(process, self.stare.start_s, self.variance, quiet).of(column)
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
        return LevelGiven(self.flux_process, self.stare.start_s, self.variance, quiet).of(self.flux)

    def inverted(self) -> SeriesSurvey:
        """Return the survey upside down: losses of light become flares."""
        return replace(self, sums=-self.sums, flux=-self.flux)

    def frames(self, kept: Bool) -> SeriesSurvey:
        """Return the survey of some of the frames."""
        parts = {name: getattr(self, name)[kept] for name in ("sums", "variance", "flux", "time_s")}
        return replace(self, stare=select_frames(self.stare, kept), **parts)


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
    low = NARROWEST * stare.frame_s
    gaps = np.flatnonzero(np.diff(stare.numbers) * stare.frame_s > DAY_S) + 1
    longest = int(np.diff(np.concatenate([[0], gaps, [stare.n_frames]])).max())
    high = max(low, min(WIDEST * longest * stare.frame_s, WIDEST_S))
    steps = max(1, round(np.log(high / low) / np.log(WIDTH_STEP)) + 1)
    half_widths = tuple(float(w) for w in low * WIDTH_STEP ** np.arange(steps))
    window = max(WINDOW_S, WINDOW_FRAMES * stare.frame_s)
    return Bank(half_widths, directions, shape, stare.frame_s, Baseline(window_s=window))


#: Number of alarms from which a rate is estimated, and the smallest and largest number of simulated light curves.
MIN_ALARMS, MIN_SIMULATED, MAX_SIMULATED = 100, 200, 20_000
#: Largest number of values in all simulated light curves, which bounds the time, and in one of them.
MAX_VALUES, MAX_LENGTH = 2**23, 2**16
#: Values that are simulated at once.
BATCH = 2**20
#: Probability of the upper end of the rate that sets thresholds: one standard error above it.
UPPER = 0.8413447460685429
#: Probability of a dip as large as the largest from noise below which the noise of the light is not symmetric.
CHANCE_DIP = 1e-3
#: Second half of the generator's key, which makes the draws independent of others.
SIMULATION_KEY = 0x73696D75


@dataclass(frozen=True, eq=False)
class SimulatedRate:
    """False-alarm rate in simulated light curves."""

    largest: Float  # shape (n,); largest statistic of each light curve, ascending
    days: float  # star-days of each
    heavy: bool = False  # whether the tail may fall more slowly than that of normal noise

    @property
    def smallest(self) -> float:
        """Smallest rate that the light curves show."""
        return MIN_ALARMS / (self.largest.size * self.days)

    def rate(self, threshold: float) -> float:
        """Return the events per star-day above a threshold, at the upper end of its 68 % interval.

        Beyond the simulated values, it falls as the tail of normal noise does, or exponentially if that is not known.
        """
        return float(np.exp(self._log_rate(threshold)))

    def _log_rate(self, threshold: float) -> float:
        n = self.largest.size
        anchor = float(self.largest[-min(n, MIN_ALARMS)])
        above = int(np.count_nonzero(self.largest > min(threshold, anchor)))
        if above == n:
            return float(np.inf)
        rate = float(np.log(-np.log1p(-float(scipy.stats.beta.ppf(UPPER, above + 1, n - above))) / self.days))
        if threshold <= anchor:
            return rate
        fall = float(np.subtract(*scipy.special.log_ndtr([-anchor, -threshold])))
        if self.heavy and above:
            # The exponential that fits the largest values best (Pickands 1975, doi 10.1214/aos/1176343003), or a normal
            # tail if it falls more slowly.
            fall = min(fall, (threshold - anchor) / float((self.largest[-above:] - anchor).mean()))
        return rate - fall

    def threshold(self, rate: float) -> float:
        """Return the threshold above which the rate of events per star-day is at most `rate`."""
        low, goal = float(self.largest[0]), float(np.log(rate))
        if self._log_rate(low) <= goal:
            return low
        high = float(self.largest[-1]) + 1.0
        while self._log_rate(high) > goal:
            high += 2.0
        return float(scipy.optimize.brentq(lambda u: min(self._log_rate(u), 1e3) - goal, low, high, xtol=1e-4))


def simulated_rates(
    survey: SeriesSurvey, quiet: Bool, rate: float, seed: int, steps: Steps = UNREPORTED
) -> tuple[SimulatedRate, SimulatedRate]:
    """Return the false-alarm rates in light curves of the fitted process, and in those of measured residuals.

    The noise of the first is normal, or Poisson noise for counts; that of the second are blocks of the residuals of
    quiescent frames, drawn with replacement (Kuensch 1989, doi 10.1214/aos/1176347265). Enough are drawn for
    `MIN_ALARMS` at the smallest rate of interest, per star-day, up to a limit; `steps` reports each batch.
    """
    residual = innovations(survey, quiet)
    part = survey.frames(np.arange(survey.stare.n_frames) < MAX_LENGTH)
    n, n_sum = part.sums.shape
    days = part.stare.observed_s / DAY_S
    most = max(MIN_SIMULATED, MAX_VALUES // (n * n_sum))
    count = int(np.clip(MIN_ALARMS / (rate * days), MIN_SIMULATED, min(MAX_SIMULATED, most)))
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, SIMULATION_KEY]))
    length = max(block_length(column) for column in residual.T)
    covariances = part.search.covariances
    counts = np.maximum(survey.levels(quiet)[:n, 0] * survey.scale * survey.counts, 0.0) if survey.counts else None

    def coloured(white: Float) -> Float:
        return np.stack([one.coloured(white[:, :, k].T).T for k, one in enumerate(covariances)], axis=2)

    modelled, measured = list[Float](), list[Float]()
    batch = max(1, BATCH // (n * n_sum))
    for first in steps.each(range(0, count, batch), -(-count // batch)):
        size = min(batch, count - first)
        starts = rng.integers(0, len(residual), (size, -(-n // length)))
        rows = (starts[:, :, None] + np.arange(length)) % len(residual)
        drawn = rng.standard_normal((size, n, n_sum))
        if counts is None:
            drawn = coloured(drawn)
        else:
            drawn = rng.poisson(counts, (size, n))[:, :, None] / survey.counts / survey.scale
        modelled.append(part.search.largest(drawn))
        measured.append(part.search.largest(coloured(residual[rows.reshape(size, -1)[:, :n]])))
    of_model, of_residuals = (np.sort(np.concatenate(values)) for values in (modelled, measured))
    return SimulatedRate(of_model, days, bool(survey.counts)), SimulatedRate(of_residuals, days, True)


def largest_dip(survey: SeriesSurvey, quiet: Bool, least: float) -> float:
    """Return the largest statistic of sudden dips, and of slow ones that end suddenly; below `least` it may be missed.

    Quiescent frames are searched upside down, in both directions of time. Losses of light have larger dips than noise.
    """
    down = survey.frames(quiet).inverted()
    start = down.stare.start_s
    stare = replace(down.stare, start_s=start[-1] + start[0] - start[::-1])
    back = replace(down, stare=stare, sums=down.sums[::-1], variance=down.variance[::-1])
    values = (one.search.values(one.sums[None], least) for one in (down, back))
    return max(float(rho.max(initial=-np.inf)) for found in values for _, rho in found)


def innovations(survey: SeriesSurvey, quiet: Bool) -> Float:
    """Return the residuals of quiescent frames given those before them, in standard deviations, (n_quiet, n_sum).

    They are independent and of unit variance if the process describes the light.
    """
    columns = []
    for process, column in zip(survey.processes, survey.sums.T, strict=True):
        covariance = process.covariance(survey.stare.start_s[quiet], survey.variance[quiet] * process.excess**2)
        columns.append(level_fit(covariance, column[quiet])[2])
    return np.column_stack(columns)


def block_length(residual: Float) -> int:
    """Return the number of consecutive residuals to draw together: beyond the first insignificant correlation."""
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    limit = 2.0 / np.sqrt(n)
    for lag in range(1, n // 4):
        if float(centred[:-lag] @ centred[lag:]) / power < limit:
            # A block of the optimal order for a correlation of this length.
            return max(lag, round(n ** (1 / 3))) if lag > 1 else 1
    return max(1, n // 4)
