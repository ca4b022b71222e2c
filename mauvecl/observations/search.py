"""Search of observed light curves with a bank of matched filters, and its rate of false alarms.

For a light curve y with covariance C, a constant level of unknown size and a template s, the statistic is that of
generalised least squares,

    rho = s^T C^-1 (y - level) / sqrt(s^T C^-1 s - (s^T C^-1 1)^2 / (1^T C^-1 1)),

which is normal with unit variance without a flare, and the S/N of the template with one. Numerators of all onsets are
correlations of the template with C^-1 (y - level), zero in missing frames, and exact over gaps. Denominators are exact
near gaps, ends and large changes of the noise; elsewhere they follow from one solution, to first order in changes of
the noise and in single missing frames, to some per cent. Those near gaps take long to solve, and a search above a
threshold solves only those that can exceed it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from mauvecl.flares.shapes import Shape
from mauvecl.flares.stare import Stare, select_frames
from mauvecl.host.arrays import Bool, Float, array_cache, map_in_threads
from mauvecl.observations.frames import Frames
from mauvecl.observations.level import ConditionalLevel
from mauvecl.observations.process import UNREPORTED, Covariance, Process, Steps, level_fit
from mauvecl.schema.fields import DAY_S
from mauvecl.search.search import LEAST_SHARE, Bank, Baseline, Template, Templates, largest_values

#: Flux of a template, relative to its peak, below which it is neglected.
NEGLECTED = 1e-4
#: Frames around a template from which its denominator follows: a multiple of its length, smallest and largest number.
MARGIN, LEAST_MARGIN, MOST_MARGIN = 4, 1024, 4096
#: Share of a denominator in frames next to gaps or with other noise from which it is solved exactly.
IRREGULAR = 1e-4
#: Relative change of the variance of a frame that is treated exactly.
OTHER_NOISE = 0.5
#: Largest numbers of frames (unless a template is longer) and of templates that are solved together.
CHUNK_FRAMES, CHUNK_TEMPLATES = 256, 512


@dataclass(frozen=True, eq=False)
class Filter:
    """Templates of one half-width and phase at all onsets, with the norm s^T C^-1 s of each sum."""

    template: Template
    phase: int
    shape: Float  # flux of the template above `NEGLECTED`, shape (n,)
    first: int  # its first frame, relative to the frame of the peak
    peaks: NDArray[np.int64]  # frame of the peak at each onset, from the first frame of the stare, including gaps
    norms: Float  # shape (n_sum, n_onset)
    unsolved: Bool  # shape (n_sum, n_onset); whether a norm must be solved exactly before it is used
    lost: Float  # shape (n_sum, n_onset); part of the norms that is lost because the level is fitted
    weights: Float  # shape (n_direction, n_sum); squared directions of the bank
    without_gaps: Float  # shape (n_direction, 1); squared denominator without gaps and with constant noise

    @property
    def per_amplitude(self) -> Float:
        """Mean of rho for a flare with unit peak along each direction, shape (n_direction, n_onset).

        It is zero where the template is not searched, and where its norm is not solved.
        """
        squared = self.weights @ np.maximum(self.norms - self.lost, 0.0)
        searched = (squared >= LEAST_SHARE * self.without_gaps) & ~self.unsolved.any(axis=0)
        return np.sqrt(np.where(searched, squared, 0.0))


@dataclass(frozen=True, eq=False)
class ProcessSearch:
    """Search of light curves for flares; each frame has independent sums, with a process each."""

    bank: Bank
    stare: Stare
    processes: tuple[Process, ...]  # of each sum
    variance: Float  # shape (n_frame,); of the noise of each frame's sums

    @cached_property
    def reach(self) -> int:
        """Number of frames on each side of a peak beyond which no template reaches."""
        return int(max(abs(template.first) + template.shapes.shape[1] for template in self.bank.templates))

    @cached_property
    def at(self) -> NDArray[np.int64]:
        """Place of each frame on the grid of the search, from 0, shape (n_frame,).

        Gaps of the grid are no longer than two templates: none reaches over a longer one, which would only take memory.
        """
        return np.concatenate([[0], np.cumsum(np.minimum(np.diff(self.stare.numbers), 2 * self.reach))])

    @property
    def n_grid(self) -> int:
        """Number of places on the grid."""
        return int(self.at[-1]) + 1

    @cached_property
    def covariances(self) -> tuple[Covariance, ...]:
        """Covariance of each sum."""
        start_s, variance = self.stare.start_s, self.variance
        return tuple(process.covariance(start_s, variance * process.excess**2) for process in self.processes)

    @cached_property
    def _level_weights(self) -> tuple[Float, ...]:
        """Weights of the frames in the constant level of each sum, C^-1 1, not normalised, shape (n_frame,)."""
        return tuple(covariance.solve(np.ones(self.stare.n_frames)) for covariance in self.covariances)

    @cached_property
    def filters(self) -> list[Filter]:
        """Templates with the denominators that were solved by now."""
        # All threads need the weights: they are computed once, before these start.
        _ = self._level_weights
        pairs = [(template, phase) for template in self.bank.templates for phase in range(len(template.phases))]
        return list(map_in_threads(lambda pair: self._prepare_filter(*pair), pairs))

    @cached_property
    def rows(self) -> list[Filter]:
        """Templates of which all denominators are solved."""
        for row in self.filters:
            self._solve(row, np.ones(row.peaks.size, np.bool_))
        return self.filters

    def values(self, sums: NDArray[Any], above: float | None = None) -> Iterator[tuple[Filter, Float]]:
        """Yield each template with rho, shape (n_stare, n_direction, n_onset); minus infinity if not searched.

        The shape of sums is (n_stare, n_frame, n_sum). Onsets next to gaps are not searched where rho of the first
        light curve cannot exceed a positive threshold `above`.
        """
        filters = self.rows if above is None else self.filters
        # C^-1 (sums - level) on the grid of frames with gaps.
        scores = np.zeros((len(sums), sums.shape[2], self.n_grid))
        for k, (covariance, weights) in enumerate(zip(self.covariances, self._level_weights, strict=True)):
            values = np.asarray(sums[:, :, k], np.float64)
            level = (values @ weights) / weights.sum()
            scores[:, k, self.at] = covariance.solve(values.T).T - level[:, None] * weights
        correlate = _correlator(scores, max(max(row.shape.size, abs(row.first)) for row in filters))

        def search_row(row: Filter) -> tuple[Filter, Float]:
            rho = np.einsum("dk,sko->sdo", self.bank.directions, correlate(row.shape, row.first)[..., row.peaks])
            if above is not None:
                # A template of which a smaller share lies in frames is not searched.
                self._solve(row, (rho[0] > above * np.sqrt(LEAST_SHARE * row.without_gaps)).any(axis=0))
            per_amplitude = row.per_amplitude
            searched = per_amplitude > 0
            np.divide(rho, per_amplitude, out=rho, where=searched)
            rho[:, ~searched] = -np.inf
            return row, rho

        yield from map_in_threads(search_row, filters)

    def largest(self, sums: NDArray[Any]) -> Float:
        """Return the largest value of each light curve, shape (n_stare,)."""
        return largest_values(self.values, sums, self.n_grid * sums.shape[2])

    def peaks_s(self, row: Filter) -> Float:
        """Return the times of the peaks of a row's templates, from the start of the stare, shape (n_onset,)."""
        # In a gap, each half belongs to the frames next to it.
        frame = np.searchsorted(self.at, row.peaks - self.reach, side="right")
        numbers = row.peaks + (self.stare.numbers - self.at)[frame]
        return np.asarray((numbers + row.template.phases[row.phase]) * self.bank.frame_s)

    def _prepare_filter(self, template: Template, phase: int) -> Filter:
        """Prepare the templates of a half-width and phase, with norms that are not solved next to gaps and ends."""
        flux = template.shapes[phase]
        bright = np.flatnonzero(flux > NEGLECTED * flux.max())
        shape = flux[bright[0] : bright[-1] + 1]
        first = template.first + int(bright[0])
        peaks = np.arange(-int(self.stare.numbers[0]) % template.stride, self.n_grid, template.stride)
        norms, lost = np.zeros((2, len(self.processes), peaks.size))
        unsolved, units = np.zeros(norms.shape, np.bool_), np.zeros((len(self.processes), 1))
        on_grid = np.zeros(self.n_grid)
        for k, (process, level_weights) in enumerate(zip(self.processes, self._level_weights, strict=True)):
            if process.terms:
                norms[k], unsolved[k], units[k] = self._approximate_norms(process, shape, first, peaks)
            else:
                variance = self.variance * process.excess**2
                on_grid[self.at] = 1.0 / variance
                norms[k] = _correlate(on_grid, shape**2, first)[peaks]
                units[k] = (shape**2).sum() / np.median(variance)
            on_grid[self.at] = level_weights
            lost[k] = _correlate(on_grid, shape, first)[peaks] ** 2 / level_weights.sum()
        weights = self.bank.directions**2
        return Filter(template, phase, shape, first, peaks, norms, unsolved, lost, weights, weights @ units)

    def _approximate_norms(
        self, process: Process, shape: Float, first: int, peaks: NDArray[np.int64]
    ) -> tuple[Float, Bool, float]:
        """Return s^T C^-1 s of a sum at peaks, whether it must be solved there, and its value without gaps."""
        variance = self.variance * process.excess**2
        margin = int(np.clip(MARGIN * shape.size, LEAST_MARGIN, MOST_MARGIN))
        typical, size = float(np.median(variance)), shape.size + 2 * margin
        response, inverse = _regular_solution(process, typical, self.bank.frame_s, np.pad(shape, margin)).T
        # The norm and the diagonal of C^-1, without gaps and with constant noise.
        unit, diagonal = float(response[margin : margin + shape.size] @ shape), float(inverse[size // 2])
        # Frames at which the solution differs: gaps and ends, other noise; single missing frames are exact.
        present = np.zeros(self.n_grid + 2, np.bool_)
        present[1 + self.at] = True
        single = ~present[1:-1] & present[:-2] & present[2:]
        irregular = ~present[1:-1] & ~single
        change = variance / typical - 1.0
        irregular[self.at[np.abs(change) > OTHER_NOISE]] = True
        moved = np.zeros(self.n_grid)
        moved[self.at] = np.where(np.abs(change) > OTHER_NOISE, 0.0, change * typical)
        signals = np.pad([irregular, single, moved], [(0, 0), (size, size)])
        # The frames beyond the ends are irregular.
        signals[0, :size] = signals[0, -size:] = 1.0
        share, missing, noise = _correlate(signals, response**2, first - margin)[:, size + peaks]
        norm = np.maximum(unit - missing / diagonal, 0.0) / np.maximum(1.0 + noise / unit, 0.1)
        # A single frame contributes its squared response over the diagonal of C^-1.
        return norm, share > IRREGULAR * diagonal * np.maximum(norm, IRREGULAR * unit), unit

    def _solve(self, row: Filter, chosen: Bool) -> None:
        """Replace the norms of all sums by exact ones at chosen onsets, if they are not solved.

        Innovations of a template are neglected `MOST_MARGIN` frames after it.
        """
        padded, size = np.pad(row.shape, 1), row.shape.size
        for covariance, norms, unsolved in zip(self.covariances, row.norms, row.unsolved, strict=True):
            onsets = np.flatnonzero(unsolved & chosen)
            unsolved[onsets] = False
            starts = row.peaks[onsets] + row.first
            while onsets.size:
                stop = int(np.searchsorted(starts, starts[0] + max(CHUNK_FRAMES, size), side="right"))
                stop = min(stop, CHUNK_TEMPLATES)
                begin, end = np.searchsorted(self.at, [starts[0], starts[stop - 1] + size])
                norms[onsets[:stop]] = 0.0
                if end > begin:
                    place = self.at[begin:end, None] - starts[:stop] + 1
                    columns = padded[np.clip(place, 0, size + 1, out=place)]
                    norms[onsets[:stop]] = covariance.squared_norms(columns, int(begin), MOST_MARGIN)
                onsets, starts = onsets[stop:], starts[stop:]


@array_cache(maxsize=64)
def _regular_solution(process: Process, variance: float, frame_s: float, shape: Float) -> Float:
    """Return C^-1 times a shape and a single frame in the middle, without gaps and with constant noise, shape (n, 2).

    Searches of a light curve after each event ask for the same solutions.
    """
    single = np.zeros(shape.size)
    single[shape.size // 2] = 1.0
    covariance = process.covariance(np.arange(float(shape.size)) * frame_s, np.full(shape.size, variance))
    return covariance.solve(np.column_stack([shape, single]))


def _correlator(values: Float, reach: int) -> Callable[[Float, int], Float]:
    """Return a function that correlates light curves with kernels up to a reach, which share their transform.

    Of a kernel and its first frame it returns sum_k values[o + first + k] kernel[k] for every frame o of the last axis;
    values beyond the ends of this axis are zero.
    """
    size = next_fast_len(values.shape[-1] + 2 * reach, real=True)
    spectrum = rfft(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach, 0)]), size)

    def correlate(kernel: Float, first: int) -> Float:
        correlated = irfft(spectrum * rfft(kernel, size).conj(), size)
        return correlated[..., reach + first : reach + first + values.shape[-1]]

    return correlate


def _correlate(values: Float, kernel: Float, first: int) -> Float:
    """Return the correlation of values with a single kernel; see `_correlator`."""
    return _correlator(values, max(abs(first), kernel.size))(kernel, first)


#: Step between half-widths of a bank: the same as that of `flares.HALF_WIDTHS_S`.
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
        """Prepare the search of the `used` frames, without a process yet.

        Flux and its variance have the shape (n_frame,), of all frames; for the others see the attributes. The flux
        itself is searched, or else the sums of spectra in `weighted`, shape (n_frame, n_sum), with their templates.
        """
        stare, scale, typical = stare_of(frames, used), float(np.sqrt(np.median(variance[used]))), abs(level)
        net, relative_variance = flux[used] / scale, variance[used] / scale**2
        if weighted is None:
            directions, sums, size = np.ones((1, 1)), net[:, None], np.full((1, 1), typical / scale)
            noise = np.full((1, 1, 1), photon * typical / scale**2)
            templates = Templates((NO_COLOUR_K,), directions, size, size[0], noise)
        else:
            templates, sums = weighted[0], weighted[1][used]
            directions = templates.directions[list(templates.chosen)]
        return cls(
            stare, bank_of(stare, directions, shape), templates, sums,
            variance=relative_variance, processes=(WHITE,) * sums.shape[1], flux=net, flux_process=WHITE, scale=scale,
            level=typical, photon=photon, time_s=frames.time_s[used], counts=counts, weighted=weighted is not None,
        )  # fmt: skip

    @cached_property
    def search(self) -> ProcessSearch:
        """Search of the frames."""
        return ProcessSearch(self.bank, self.stare, self.processes, self.variance)

    def levels(self, quiet: Bool) -> Float:
        """Return the mean of the process of each sum given quiescent frames, shape (n_frame, n_sum)."""
        pairs = zip(self.processes, self.sums.T, strict=True)
        return np.column_stack([self._level_of(process, column, quiet) for process, column in pairs])

    def _level_of(self, process: Process, column: Float, quiet: Bool) -> Float:
        return ConditionalLevel(process, self.stare.start_s, self.variance, quiet).of(column)

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
        return self._level_of(self.flux_process, self.flux, quiet)

    def inverted(self) -> SeriesSurvey:
        """Return the survey upside down: losses of light become flares."""
        return replace(self, sums=-self.sums, flux=-self.flux)

    def fitted(self, other: SeriesSurvey) -> SeriesSurvey:
        """Return the survey with the processes of another one."""
        return replace(self, processes=other.processes, flux_process=other.flux_process)

    def frames(self, chosen: Bool | slice) -> SeriesSurvey:
        """Return the survey of some of the frames."""
        arrays = {name: getattr(self, name)[chosen] for name in ("sums", "variance", "flux", "time_s")}
        return replace(self, stare=select_frames(self.stare, chosen), **arrays)


def stare_of(frames: Frames, used: Bool) -> Stare:
    """Return the searched frames as a stare on the regular grid of the cadence."""
    numbers, frame_s = frames.numbers[used], frames.cadence_s
    unit = np.ones(numbers.size)
    return Stare(np.asarray((numbers - numbers[0]) * frame_s), frame_s, unit, unit, unit, np.zeros(numbers.size))


def bank_of(stare: Stare, directions: Float, shape: Shape) -> Bank:
    """Return the template bank for a stare, with half-widths from its cadence to a share of its longest part."""
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
        """Return the logarithm of an upper limit of the rate of alarms above a threshold, per day."""
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
            # The exponential that fits the largest values best (Pickands 1975, doi 10.1214/aos/1176343003), if slower.
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

    The noise of the first is normal, or Poisson noise for counts; that of the second consists of blocks of the
    residuals of `quiet` frames, drawn with replacement (Kuensch 1989, doi 10.1214/aos/1176347265). Enough light curves
    are drawn for `MIN_ALARMS` at the smallest rate of interest, per star-day, within limits. `steps` reports batches.
    """
    residual, beginning = innovations(survey, quiet), survey.frames(slice(MAX_LENGTH))
    n, n_sum = beginning.sums.shape
    days = beginning.stare.observed_s / DAY_S
    most = max(MIN_SIMULATED, MAX_VALUES // (n * n_sum))
    count = int(np.clip(MIN_ALARMS / (rate * days), MIN_SIMULATED, min(MAX_SIMULATED, most)))
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, SIMULATION_KEY]))
    length = max(block_length(column) for column in residual.T)
    search = beginning.search
    counts = np.maximum(survey.levels(quiet)[:n, 0] * survey.scale * survey.counts, 0.0) if survey.counts else None

    def coloured(white: Float) -> Float:
        columns = [covariance.coloured(white[:, :, k].T).T for k, covariance in enumerate(search.covariances)]
        return np.stack(columns, axis=2)

    modelled, measured = list[Float](), list[Float]()
    batch = max(1, BATCH // (n * n_sum))
    for first in steps.track(range(0, count, batch), -(-count // batch)):
        size = min(batch, count - first)
        starts = rng.integers(0, len(residual), (size, -(-n // length)))
        rows = (starts[:, :, None] + np.arange(length)) % len(residual)
        drawn = rng.standard_normal((size, n, n_sum))
        if counts is None:
            drawn = coloured(drawn)
        else:
            drawn = rng.poisson(counts, (size, n))[:, :, None] / survey.counts / survey.scale
        modelled.append(search.largest(drawn))
        measured.append(search.largest(coloured(residual[rows.reshape(size, -1)[:, :n]])))
    of_model, of_residuals = (np.sort(np.concatenate(values)) for values in (modelled, measured))
    return SimulatedRate(of_model, days, bool(survey.counts)), SimulatedRate(of_residuals, days, True)


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
    """Return the number of consecutive residuals that are drawn together, beyond the lags at which they correlate."""
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    for lag in range(1, n // 4):
        if float(centred[:-lag] @ centred[lag:]) / power < 2.0 / np.sqrt(n):
            # A block of the optimal order for a correlation of this length.
            return max(lag, round(n ** (1 / 3))) if lag > 1 else 1
    return max(1, n // 4)
