"""Search of stares for flares with a bank of matched filters, exact over gaps.

For sums y of a frame with unit covariance, a template s in time and c in the sums, and a baseline G a with unknown
amplitudes a in the window, the statistic is that of generalised least squares,

    rho = c . (s - P G)^T m y / sqrt((s - P G)^T m (s - P G)),   P = (G^T m G)^-1 G^T m s,

with m the inverse variance of a frame, zero in gaps. Without a flare it is normal with unit variance; with a flare, its
mean is the S/N. All sums over time are correlations, computed by FFT. (Matched filters: Turin 1960, doi
10.1109/TIT.1960.1057571.)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import LEAST_SHARE, Bank, Template
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]

#: Approximate number of values in an array of a batch of stares.
BATCH = 2**21
#: Relative regularisation for curves that are degenerate within a window.
RIDGE = 1e-11


@dataclass(frozen=True, eq=False)
class LargestValue:
    """The largest value of each stare and its template; arrays of shape (n_stare,)."""

    maximum: Float  # largest rho
    peak_s: Float  # from the start of the stare
    half_width_s: Float
    temperature: NDArray[np.int64]  # row of the bank's directions
    amplitude: Float  # of the template's peak, in standard deviations of a frame's sum


@dataclass(frozen=True, eq=False)
class Row:
    """One half-width and phase at all onsets; `Search.values` yields the statistics of each row."""

    template: Template
    phase: int
    peaks: NDArray[np.int64]  # frame of the peak at each onset, from the first frame of the stare, including gaps
    per_amplitude: Float  # mean of rho for a flare with unit peak, zero if not searched, shape (n_onset,)
    project: Float  # P of the module's formula, shape (n_term, n_onset)


class Search:
    """Search of stares with a template bank.

    Parameters
    ----------
    bank : Bank
    stare : Stare
        Only the times of its frames are used.
    curves : ndarray, shape (n_curve, n_frame), optional
        Curves with unknown amplitudes in each window, such as sine and cosine of the orbit or the detector's
        temperature; required if the bank's baseline has `cycle`.
    variance : ndarray, shape (n_frame,), optional
        Variance of each frame's sums; 1 by default.
    """

    def __init__(self, bank: Bank, stare: Stare, curves: Float | None = None, variance: Float | None = None) -> None:
        if abs(stare.frame_s - bank.frame_s) > 1e-9 * bank.frame_s:
            raise InputError.of("frame_s", stare.frame_s, f"{bank.frame_s:g} s, as in the bank", unit="s")
        if bank.baseline.cycle != (curves is not None and len(curves) > 0):
            raise InputError("only one of curves and level.cycle is given", "both or neither", key="curves")
        self.bank, self.stare = bank, stare
        self._first = int(stare.numbers[0])
        self._at = stare.numbers - self._first
        self.n_grid = int(self._at[-1]) + 1
        self._weight = np.zeros(self.n_grid)
        self._weight[self._at] = 1.0 if variance is None else 1.0 / variance
        series = [np.ones(stare.n_frames)]
        for curve in np.zeros((0, stare.n_frames)) if curves is None else curves:
            scale = float(np.std(curve))
            if not scale > 0:
                raise InputError("a baseline curve is constant over the stare", "one that varies", key="curves")
            series.append((curve - np.mean(curve)) / scale)
        # Terms of the baseline: a power of time in the window, and the index of a series in the stare.
        self._terms = [(power, 0) for power in bank.baseline.powers] + [(0, 1 + k) for k in range(len(series) - 1)]
        self._series = np.zeros((len(series), self.n_grid))
        self._series[:, self._at] = series
        # Only the part of a long template within a stare's length of the onset overlaps data.
        reach = min(max(t.shapes.shape[1] for t in bank.templates), self.n_grid)
        self._size = int(scipy.fft.next_fast_len(self.n_grid + reach, real=True))

    @cached_property
    def grid(self) -> list[Row]:
        """Rows of all half-widths and phases, with everything that does not depend on data."""
        return [row for template in self.bank.templates for row in self._rows_of(template)]

    @property
    def n_filters(self) -> int:
        """Number of searched templates: half-widths, phases, onsets and temperatures."""
        return len(self.bank.directions) * int(sum(np.count_nonzero(row.per_amplitude) for row in self.grid))

    def largest(self, sums: NDArray[Any]) -> LargestValue:
        """Return the largest value of each stare and its template.

        Parameters
        ----------
        sums : ndarray, shape (n_stare, n_frame, n_sum)
            Sums with unit covariance in each frame without a flare.
        """
        sums = self._checked(sums)
        parts = [self._largest(sums[batch]) for batch in self._batches(len(sums))]
        return LargestValue(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in LargestValue.__annotations__)
        )

    def values(self, sums: NDArray[Any]) -> Iterator[tuple[Row, NDArray[Any]]]:
        """Yield each row with rho, shape (n_stare, n_temperature, n_onset); minus infinity if not searched.

        Values have the precision of the sums. All stares are processed at once, which suits small numbers of stares.
        """
        yield from self._values(self._checked(sums))

    def correlations(self, sums: NDArray[Any]) -> Iterator[tuple[Row, NDArray[Any]]]:
        """Yield each row with the values of all sums, shape (n_stare, n_sum, n_onset); zero if not searched.

        The bank's directions times these values are the values of rho. There may be any number of sums.
        """
        spectra = self._spectra(sums)
        real = _precision(sums)
        window, level = (0, 0), []
        for template in self.bank.templates:
            onsets = self._onsets(template)
            # Templates with the same window share the correlations of the baseline.
            if window != (template.first, template.time.size):
                window = template.first, template.time.size
                level = [
                    self._correlated(spectra[series], template.time**power, template.first)
                    for power, series in self._terms
                ]
            for row in self.grid:
                if row.template is not template:
                    continue
                correlated = self._correlated(spectra[0], template.shapes[row.phase], template.first)[..., onsets]
                for projected, term in zip(row.project.astype(real), level, strict=True):
                    correlated -= projected * term[..., onsets]
                scale = np.divide(
                    1.0, row.per_amplitude, out=np.zeros_like(row.per_amplitude), where=row.per_amplitude > 0
                )
                correlated *= scale.astype(real)
                yield row, correlated

    def template(self, row: Row, onset: int, direction: int) -> Float:
        """Return the weights of each sum in rho of a template, shape (n_frame, n_sum): rho = sum(weights * sums)."""
        return np.asarray(self.in_time(row, np.array([onset]))[0][:, None] * self.bank.directions[direction])

    def in_time(self, row: Row, onsets: NDArray[np.int64]) -> Float:
        """Return the weights of frames in templates of a row, without their direction, shape (n_onset, n_frame)."""
        size, first = row.template.time.size, row.peaks[onsets] + row.template.first
        templates = np.zeros((onsets.size, self.stare.n_frames))
        if not onsets.size:
            return templates
        reached = slice(*np.searchsorted(self._at, [first.min(), first.max() + size]))
        grid = self._at[reached]
        at = grid - first[:, None]
        inside = (at >= 0) & (at < size)
        at = np.where(inside, at, 0)
        shape = row.template.shapes[row.phase][at]
        for (power, series), amplitude in zip(self._terms, row.project[:, onsets], strict=True):
            shape -= amplitude[:, None] * (row.template.time**power)[at] * self._series[series][grid]
        shape *= self._weight[grid]
        shape /= row.per_amplitude[onsets][:, None]
        templates[:, reached] = np.where(inside, shape, 0.0)
        return templates

    @property
    def variance(self) -> Float:
        """Variance of each frame's sums, shape (n_frame,)."""
        return np.asarray(1.0 / self._weight[self._at])

    def _checked(self, sums: NDArray[Any]) -> NDArray[Any]:
        expected = (self.stare.n_frames, self.bank.directions.shape[1])
        if sums.ndim != 3 or sums.shape[1:] != expected:
            raise InputError(
                f"sums have the shape {sums.shape}",
                f"(n_stare, {expected[0]}, {expected[1]})",
                key="sums",
                value=sums.shape,
            )
        return sums

    def _batches(self, count: int) -> list[slice]:
        size = max(1, BATCH // (self._size * self.bank.directions.shape[1]))
        return [slice(i, i + size) for i in range(0, count, size)]

    def _largest(self, sums: NDArray[Any]) -> LargestValue:
        n = len(sums)
        every = np.arange(n)
        best = np.full(n, -np.inf)
        peak, width, amplitude = (np.zeros(n) for _ in range(3))
        temperature = np.zeros(n, np.int64)
        for row, rho in self._values(sums):
            which = rho.reshape(n, -1).argmax(axis=1)
            value = rho.reshape(n, -1)[every, which]
            better = value > best
            direction, onset = np.divmod(which[better], rho.shape[2])
            best[better] = value[better]
            peak[better] = (self._first + row.peaks[onset] + row.template.phases[row.phase]) * self.bank.frame_s
            width[better] = row.template.half_width_s
            temperature[better] = direction
            amplitude[better] = value[better] / row.per_amplitude[onset]
        return LargestValue(best, peak, width, temperature, amplitude)

    def _values(self, sums: NDArray[Any]) -> Iterator[tuple[Row, NDArray[Any]]]:
        directions = self.bank.directions.astype(_precision(sums))
        for row, correlated in self.correlations(sums):
            tried = row.per_amplitude > 0
            rho = np.einsum("tk,skn->stn", directions, correlated, optimize=True)
            if not tried.all():
                rho[:, :, ~tried] = -np.inf
            yield row, rho

    def _spectra(self, sums: NDArray[Any]) -> list[NDArray[Any]]:
        """Return transforms of the weighted sums times each series, zero in gaps, (n_stare, n_sum, n_frequency)."""
        real = _precision(sums)
        held = np.zeros((len(sums), sums.shape[2], self.n_grid), real)
        held[:, :, self._at] = self._levelled(sums) * self._weight[self._at]
        used = {series for _, series in self._terms} | {0}
        return [
            scipy.fft.rfft(held * self._series[k].astype(real), self._size) if k in used else held[:0]
            for k in range(len(self._series))
        ]

    def _levelled(self, sums: NDArray[Any]) -> NDArray[Any]:
        """Subtract the baseline fitted to the whole stare, which does not change rho but improves its precision."""
        y = np.moveaxis(sums, 2, 1)
        return np.asarray(y - (y @ self._level_span) @ self._level_span.T) if self._terms else y

    @cached_property
    def _level_span(self) -> Float:
        """Orthonormal columns that span all baselines of the stare, (n_frame, n)."""
        time = (self._at - self._at.mean()) / max(self.n_grid, 1)
        columns = np.array([time**power * self._series[series][self._at] for power, series in self._terms])
        span, size, _ = np.linalg.svd(columns.T, full_matrices=False)
        return np.asarray(span[:, size > 1e-12 * size[0]])

    def _correlated(self, spectrum: NDArray[Any], kernel: Float, first: int) -> NDArray[Any]:
        """Return sum_t data(t) kernel(t - first - onset) at every frame, in the precision of the spectrum."""
        real = np.float32 if spectrum.dtype == np.complex64 else np.float64
        held = np.zeros(self._size, real)
        met = slice(max(0, 1 - self.n_grid - first), max(0, self.n_grid - first))
        held[: kernel[met].size] = kernel[met]
        other = np.conj(scipy.fft.rfft(np.roll(held, first + met.start)))
        values: NDArray[Any] = scipy.fft.irfft(spectrum * other, self._size)
        return values[..., : self.n_grid]

    def _onsets(self, template: Template) -> slice:
        """Return the frames at which a template is tried."""
        return slice(self._start(template), self.n_grid, template.stride)

    def _start(self, template: Template) -> int:
        return -self._first % template.stride

    def _rows_of(self, template: Template) -> Iterator[Row]:
        n = len(self._terms)
        # Onsets are multiples of the stride from the start of the whole stare, even if only a part is searched.
        peaks = np.arange(self._start(template), self.n_grid, template.stride)
        time = template.time
        spectra: dict[tuple[int, int], Any] = {}

        def over(a: int, b: int, kernel: Float) -> Float:
            """Correlate the weighted product of two series with a kernel."""
            if (a, b) not in spectra:
                spectra[a, b] = scipy.fft.rfft(self._weight * self._series[a] * self._series[b], self._size)
            return np.asarray(self._correlated(spectra[a, b], kernel, template.first)[self._onsets(template)])

        gram = np.zeros((peaks.size, n, n))
        for i, (p, a) in enumerate(self._terms):
            for j, (q, b) in enumerate(self._terms[: i + 1]):
                gram[:, i, j] = gram[:, j, i] = over(a, b, time ** (p + q))
        size = np.sqrt(np.maximum(np.einsum("nii->ni", gram), 1e-9))
        scaled = gram / (size[:, :, None] * size[:, None, :]) + RIDGE * np.eye(n)
        scaled += np.where(np.einsum("nii->ni", gram) > 1e-9, 0.0, 1.0)[:, :, None] * np.eye(n)
        for phase, shape in enumerate(template.shapes):
            power = over(0, 0, shape**2)
            project = np.zeros((n, peaks.size))
            left = power
            if n:
                shared = np.stack([over(0, a, shape * time**p) for p, a in self._terms], axis=1)
                solved = np.linalg.solve(scaled, (shared / size)[:, :, None])[:, :, 0] / size
                project = solved.T
                left = power - 2 * np.sum(solved * shared, 1) + np.einsum("ni,nij,nj->n", solved, gram, solved)
            tried = left >= LEAST_SHARE * self._without_gaps(template, phase)
            yield Row(template, phase, peaks, np.sqrt(np.where(tried, left, 0.0)), project)

    def _without_gaps(self, template: Template, phase: int) -> float:
        """Return a template's power without gaps, marginalised over powers of time only."""
        shape = template.shapes[phase]
        columns = np.array([template.time**power for power in self.bank.baseline.powers])
        if columns.size:
            level, *_ = np.linalg.lstsq(columns.T, shape, rcond=None)
            shape = shape - level @ columns
        return float(shape @ shape) * float(np.median(self._weight[self._at]))


def _precision(sums: NDArray[Any]) -> type[np.floating[Any]]:
    """Return the type of computations: double precision for sums in double precision, else single."""
    return np.float64 if sums.dtype == np.float64 else np.float32
