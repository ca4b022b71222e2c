"""Search for flares with a bank of matched filters under the covariance of the quiescent light.

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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from mauvecl.host.arrays import map_in_threads
from mauvecl.search.search import largest_values
from mauvecl.search.templates import LEAST_SHARE, Bank, Template

if TYPE_CHECKING:
    from mauvecl.flares.stare import Stare
    from mauvecl.observations.process import Covariance, Process

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Flux of a template relative to its peak below which it is neglected.
NEGLECTED = 1e-4
#: Frames around a template from which its denominator follows: a multiple of its length, smallest and largest number.
MARGIN, LEAST_MARGIN, MOST_MARGIN = 4, 1024, 4096
#: Share of a denominator in frames next to gaps or with other noise from which it is solved exactly.
IRREGULAR = 1e-4
#: The same for frames that are taken away, next to ends and gaps, too, where they matter more than `squares` say.
CHANGED = 1e-2
#: Relative change of the variance of a frame that is treated exactly.
OTHER_NOISE = 0.5
#: Number of frames, unless a template is longer, and largest number of templates in one solution.
CHUNK_FRAMES, CHUNK_TEMPLATES = 256, 512
#: Number of values of light curves below which templates are searched one after another.
FEW_VALUES = 2**15


@dataclass(frozen=True, eq=False)
class SolvedNorms:
    """Values of s^T C^-1 s of a template at all onsets."""

    norm: Float  # shape (n_onset,)
    unit: float  # without gaps and with constant noise
    diagonal: float  # of C^-1 without gaps and with constant noise
    squares: Float  # squared solution C^-1 s without gaps, from `margin` frames before the template to as many after it
    margin: int
    unsolved: Bool  # shape (n_onset,); whether the norm of an onset is still that without gaps

    @property
    def irregular(self) -> Float:
        """Sum of `squares` in irregular frames above which a norm is solved exactly, shape (n_onset,).

        A single frame contributes its square over the diagonal of C^-1.
        """
        return IRREGULAR * self.diagonal * np.maximum(self.norm, IRREGULAR * self.unit)


@dataclass(frozen=True, eq=False)
class Filter:
    """Templates of one half-width and phase at all onsets, with the norms of each sum."""

    template: Template
    phase: int
    shape: Float  # flux of the template above `NEGLECTED`, shape (n,)
    first: int  # its first frame, relative to the frame of the peak
    peaks: NDArray[np.int64]  # frame of the peak at each onset, from the first frame of the stare, including gaps
    norms: tuple[SolvedNorms, ...]  # of each sum; they are solved when they are needed
    lost: Float  # shape (n_sum, n_onset); what the unknown level takes from the norms
    weights: Float  # shape (n_direction, n_sum); squared directions of the bank

    @property
    def without_gaps(self) -> Float:
        """Squared denominator along each direction without gaps, shape (n_direction, 1)."""
        return np.asarray(self.weights @ np.array([[one.unit] for one in self.norms]))

    @property
    def per_amplitude(self) -> Float:
        """Mean of rho for a flare with unit peak along each direction, shape (n_direction, n_onset).

        It is zero where the template is not searched, and where its norm is not solved.
        """
        norm = self.weights @ np.maximum(np.array([one.norm for one in self.norms]) - self.lost, 0.0)
        tried = (norm >= LEAST_SHARE * self.without_gaps) & ~np.any([one.unsolved for one in self.norms], axis=0)
        return np.sqrt(np.where(tried, norm, 0.0))


class ProcessSearch:
    """Search of light curves for flares; each frame has independent sums, with a process each.

    The variance is that of the noise of each frame's sums. `before` is a search of the same frames and further ones:
    denominators are solved anew only where the further frames contribute to them.
    """

    def __init__(
        self, bank: Bank, stare: Stare, processes: tuple[Process, ...], variance: Float,
        before: ProcessSearch | None = None,
    ) -> None:  # fmt: skip
        self.bank, self.stare, self.processes, self.variance = bank, stare, processes, variance
        numbers = stare.numbers
        if before is None:
            # Gaps are no longer than two templates, since none reaches over them and their frames only take memory.
            longest = 2 * max(abs(one.first) + one.shapes.shape[1] for one in bank.templates)
            steps = np.diff(numbers)
            long = np.flatnonzero(steps > longest)
            lacking = np.concatenate([[0], np.cumsum(steps[long] - longest)])
            # Middles of shortened gaps, shape (n_gap,), and frames that all gaps before each part of the grid lack.
            gaps = numbers[long] + longest // 2 - lacking[:-1], lacking
        else:
            gaps = before._gaps
        self._gaps: tuple[NDArray[np.int64], NDArray[np.int64]] = gaps
        middle, lacking = gaps
        self.frames = numbers - lacking[np.searchsorted(middle + lacking[:-1], numbers, side="right")]
        self.at = self.frames - self.frames[0]
        self.n_grid = int(self.at[-1]) + 1
        self._before = before

    @cached_property
    def covariances(self) -> tuple[Covariance, ...]:
        """Covariance of each sum."""
        return tuple(
            process.covariance(self.stare.start_s, self.variance * process.excess**2) for process in self.processes
        )

    @cached_property
    def _levels(self) -> tuple[Float, ...]:
        """C^-1 1 of each sum, shape (n_frame,)."""
        return tuple(one.solve(np.ones(self.stare.n_frames)) for one in self.covariances)

    @cached_property
    def filters(self) -> list[Filter]:
        """Templates with the denominators that were solved by now."""
        _ = self._levels
        templates = [(template, phase) for template in self.bank.templates for phase in range(len(template.phases))]
        earlier = self._before.filters if self._before is not None else [None] * len(templates)
        pairs = list(zip(templates, earlier, strict=True))
        threads = 1 if self.n_grid < FEW_VALUES else None
        filters = list(map_in_threads(lambda pair: self._filter(*pair[0], pair[1]), pairs, threads))
        self._before = None
        return filters

    @cached_property
    def rows(self) -> list[Filter]:
        """Templates of which all denominators are solved."""
        for one in self.filters:
            self._solve(one, np.ones(one.peaks.size, np.bool_))
        return self.filters

    def values(self, sums: NDArray[Any], above: float | None = None) -> Iterator[tuple[Filter, Float]]:
        """Yield each template with rho, shape (n_stare, n_direction, n_onset); minus infinity if not searched.

        The shape of sums is (n_stare, n_frame, n_sum). Onsets next to gaps are not searched where rho of the first
        light curve cannot exceed a positive threshold `above`.
        """
        filters = self.rows if above is None else self.filters
        # C^-1 (sums - level) on the grid of frames with gaps.
        scores = np.zeros((len(sums), sums.shape[2], self.n_grid))
        for k, (covariance, level) in enumerate(zip(self.covariances, self._levels, strict=True)):
            values = np.asarray(sums[:, :, k], np.float64)
            mean = (values @ level) / level.sum()
            scores[:, k, self.at] = covariance.solve(values.T).T - mean[:, None] * level
        correlations = Correlations(scores, max(max(one.shape.size, abs(one.first)) for one in filters))

        def searched(one: Filter) -> tuple[Filter, Float]:
            correlated = correlations.of(one.shape, one.first)[..., one.peaks]
            rho = np.einsum("dk,sko->sdo", self.bank.directions, correlated)
            if above is not None:
                # A template of which a smaller share lies in frames is not searched.
                least = np.sqrt(LEAST_SHARE * one.without_gaps)
                self._solve(one, (rho[0] > above * least).any(axis=0))
            per_amplitude = one.per_amplitude
            tried = per_amplitude > 0
            np.divide(rho, per_amplitude, out=rho, where=tried)
            rho[:, ~tried] = -np.inf
            return one, rho

        yield from map_in_threads(searched, filters, 1 if scores.size < FEW_VALUES else None)

    def largest(self, sums: NDArray[Any]) -> Float:
        """Return the largest value of each light curve, shape (n_stare,)."""
        return largest_values(self.values, sums, self.n_grid * sums.shape[2])

    def peaks_s(self, row: Filter) -> Float:
        """Return the times of the peaks of a row's templates, from the start of the stare, shape (n_onset,)."""
        (middle, lacking), places = self._gaps, self.frames[0] + row.peaks
        # A gap belongs to the frames next to each of its halves.
        numbers = places + lacking[np.searchsorted(middle, places, side="right")]
        return np.asarray((numbers + row.template.phases[row.phase]) * self.bank.frame_s)

    def _filter(self, template: Template, phase: int, earlier: Filter | None) -> Filter:
        """Prepare the templates of a half-width and phase, from those of the search `before`, if there is one."""
        whole = template.shapes[phase]
        bright = np.flatnonzero(whole > NEGLECTED * whole.max())
        shape = whole[bright[0] : bright[-1] + 1]
        first = template.first + int(bright[0])
        peaks = np.arange(-int(self.frames[0]) % template.stride, self.n_grid, template.stride)
        norms, lost = list[SolvedNorms](), np.zeros((len(self.processes), peaks.size))
        held = np.zeros(self.n_grid)
        for k, level in enumerate(self._levels):
            if not self.processes[k].terms:
                # Independent noise.
                variance = self.variance * self.processes[k].excess ** 2
                held[self.at] = 1.0 / variance
                norm, typical = _correlated(held, shape**2, first)[peaks], float(np.median(variance))
                unit, solved = float((shape**2).sum() / typical), np.zeros(peaks.size, np.bool_)
                norms.append(SolvedNorms(norm, unit, 1.0 / typical, (shape / typical) ** 2, 0, solved))
            elif self._before is None or earlier is None:
                norms.append(self._norms(k, shape, first, peaks))
            else:
                norms.append(self._updated(self._before, earlier, k, peaks))
            held[self.at] = level
            lost[k] = _correlated(held, shape, first)[peaks] ** 2 / level.sum()
        return Filter(template, phase, shape, first, peaks, tuple(norms), lost, self.bank.directions**2)

    def _norms(self, k: int, shape: Float, first: int, peaks: NDArray[np.int64]) -> SolvedNorms:
        """Compute s^T C^-1 s of a sum at peaks that are not next to gaps or ends."""
        process = self.processes[k]
        variance = self.variance * process.excess**2
        margin = int(np.clip(MARGIN * shape.size, LEAST_MARGIN, MOST_MARGIN))
        typical, frame_s = float(np.median(variance)), self.bank.frame_s
        size = shape.size + 2 * margin
        whole = process.covariance(np.arange(size, dtype=np.float64) * frame_s, np.full(size, typical))
        both = np.zeros((size, 2))
        both[margin : margin + shape.size, 0] = shape
        both[size // 2, 1] = 1.0
        solved = whole.solve(both)
        response, unit = solved[:, 0], float(solved[margin : margin + shape.size, 0] @ shape)
        centre = float(solved[size // 2, 1])
        squares = response**2
        # Frames at which the solution differs: gaps and ends, other noise; single missing frames are exact.
        present = np.zeros(self.n_grid + 2, np.bool_)
        present[1 + self.at] = True
        single = ~present[1:-1] & present[:-2] & present[2:]
        bad = ~present[1:-1] & ~single
        change = variance / typical - 1.0
        bad[self.at[np.abs(change) > OTHER_NOISE]] = True
        moved = np.zeros(self.n_grid)
        moved[self.at] = np.where(np.abs(change) > OTHER_NOISE, 0.0, change * typical)
        start = first - margin
        share = _correlated(np.pad(bad, size, constant_values=True).astype(np.float64), squares, start)
        missing = _correlated(single.astype(np.float64), squares, start)[peaks] / centre
        norm = np.maximum(unit - missing, 0.0)
        norm = norm / np.maximum(1.0 + _correlated(moved, squares, start)[peaks] / unit, 0.1)
        one = SolvedNorms(norm, unit, centre, squares, margin, np.zeros(peaks.size, np.bool_))
        return replace(one, unsolved=share[size + peaks] > one.irregular)

    def _updated(self, before: ProcessSearch, earlier: Filter, k: int, peaks: NDArray[np.int64]) -> SolvedNorms:
        """Return earlier norms at peaks, to be solved anew where frames that are missing now contribute to them."""
        gone = np.zeros(before.n_grid)
        gone[before.at] = 1.0
        origin, norms = int(self.frames[0] - before.frames[0]), earlier.norms[k]
        gone[origin + self.at] = 0.0
        part = np.searchsorted(earlier.peaks, origin + peaks)
        one = replace(norms, norm=norms.norm[part], unsolved=norms.unsolved[part])
        share = _correlated(gone, norms.squares, earlier.first - norms.margin)[origin + peaks]
        return replace(one, unsolved=one.unsolved | (share > CHANGED * one.irregular))

    def _solve(self, one: Filter, chosen: Bool) -> None:
        """Replace the norms of all sums by exact ones at chosen onsets, if they are not solved.

        Innovations of a template are neglected `MOST_MARGIN` frames after it.
        """
        padded = np.pad(one.shape, 1)
        for k, norms in enumerate(one.norms):
            left = np.flatnonzero(chosen & norms.unsolved)
            norms.unsolved[left] = False
            starts = one.peaks[left] + one.first
            while left.size:
                stop = int(np.searchsorted(starts, starts[0] + max(CHUNK_FRAMES, one.shape.size), side="right"))
                stop = min(stop, CHUNK_TEMPLATES)
                begin, end = np.searchsorted(self.at, [starts[0], starts[stop - 1] + one.shape.size])
                norms.norm[left[:stop]] = 0.0
                if end > begin:
                    # Many shapes end before the same frame, so that what follows it is solved once.
                    end = min(-(-end // CHUNK_FRAMES) * CHUNK_FRAMES, self.at.size)
                    place = self.at[begin:end, None] - starts[:stop] + 1
                    columns = padded[np.clip(place, 0, one.shape.size + 1, out=place)]
                    norms.norm[left[:stop]] = self.covariances[k].squared_norms(columns, int(begin), MOST_MARGIN)
                left, starts = left[stop:], starts[stop:]


class Correlations:
    """Correlations of light curves with kernels of some largest reach, which share the transform of the light curves.

    Values beyond the ends of the last axis are zero.
    """

    def __init__(self, values: Float, reach: int) -> None:
        self.values, self._reach = values, reach
        self._size = next_fast_len(values.shape[-1] + 2 * reach, real=True)
        self._spectrum = rfft(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach, 0)]), self._size)

    def of(self, kernel: Float, first: int) -> Float:
        """Return sum_k values[o + first + k] kernel[k] for every frame o of the last axis."""
        start = self._reach + first
        found = irfft(self._spectrum * rfft(kernel, self._size).conj(), self._size)
        return found[..., start : start + self.values.shape[-1]]


def _correlated(values: Float, kernel: Float, first: int) -> Float:
    """Return the correlation of values with a single kernel; see `Correlations`."""
    return Correlations(values, max(abs(first), kernel.size)).of(kernel, first)
