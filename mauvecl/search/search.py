"""Search of stares for flares with matched filters, exact over gaps, and the survey of a star.

For sums y of a frame with unit covariance, a template s in time and c in the sums, and a baseline G a with unknown
amplitudes a in the window, the statistic is that of generalised least squares,

    rho = c . (s - P G)^T m y / sqrt((s - P G)^T m (s - P G)),   P = (G^T m G)^-1 G^T m s,

with m the inverse variance of a frame, zero in gaps. Without a flare it is normal with unit variance; with a flare, its
mean is the S/N. All sums over time are correlations, computed by FFT. (Matched filters: Turin 1960, doi
10.1109/TIT.1960.1057571.)

What unknowns do to the sums beyond first order, such as the bend of the dark current by a drifting temperature, is
fitted to the whole stare and subtracted (docs/completeness.md, "Beyond first order"): by the Gauss-Newton method on
means over half a minute, with the distribution of the unknowns as prior, and less weight for means with flares (Huber
1964, doi 10.1214/aoms/1177703732).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.flare_model import MeanSums
from mauvecl.flares.frames import STEADY, Components
from mauvecl.flares.stare import Stare, select_frames
from mauvecl.flares.stare_scene import StaresRequest, method_for
from mauvecl.host.arrays import Float
from mauvecl.noise.unknowns import NONE, Changing, Processes
from mauvecl.schema.errors import InputError
from mauvecl.search.templates import LEAST_SHARE, Bank, Template, Templates

#: Approximate number of values in an array of a batch of stares.
BATCH = 2**21
#: Relative regularisation for curves that are degenerate within a window.
RIDGE = 1e-11


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

    Only the times of the stare's frames are used. Curves, (n_curve, n_frame), have unknown amplitudes in each window,
    such as sine and cosine of the orbit or the detector's temperature; a bank whose baseline has `cycle` requires them.
    The variance, (n_frame,), is that of each frame's sums, 1 by default.
    """

    def __init__(self, bank: Bank, stare: Stare, curves: Float | None = None, variance: Float | None = None) -> None:
        if abs(stare.frame_s - bank.frame_s) > 1e-9 * bank.frame_s:
            raise InputError.of("frame_s", stare.frame_s, f"{bank.frame_s:g} s, as in the bank", unit="s")
        if bank.baseline.cycle != (curves is not None and len(curves) > 0):
            raise InputError(
                "curves and level.cycle must be given both or not at all, but only one is given", key="curves"
            )
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
                raise InputError("a baseline curve must vary over the stare, but is constant", key="curves")
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

    def largest(self, sums: NDArray[Any]) -> Float:
        """Return the largest value of each stare, shape (n_stare,).

        The sums, (n_stare, n_frame, n_sum), have unit covariance in each frame without a flare.
        """
        return largest_values(self.values, sums, self._size * self.bank.directions.shape[1])

    def values(self, sums: NDArray[Any]) -> Iterator[tuple[Row, NDArray[Any]]]:
        """Yield each row with rho, shape (n_stare, n_temperature, n_onset); minus infinity if not searched.

        Values have the precision of the sums. All stares are processed at once, which suits small numbers of stares.
        """
        expected = (self.stare.n_frames, self.bank.directions.shape[1])
        if sums.ndim != 3 or sums.shape[1:] != expected:
            raise InputError(
                f"sums must have the shape (n_stare, {expected[0]}, {expected[1]}), not {sums.shape}", key="sums"
            )
        for row, correlated in self.correlations(sums):
            tried = row.per_amplitude > 0
            rho = np.einsum("tk,skn->stn", self.bank.directions.astype(correlated.dtype), correlated, optimize=True)
            if not tried.all():
                rho[:, :, ~tried] = -np.inf
            yield row, rho

    def correlations(self, sums: NDArray[Any]) -> Iterator[tuple[Row, NDArray[Any]]]:
        """Yield each row with the values of all sums, shape (n_stare, n_sum, n_onset); zero if not searched.

        The bank's directions times these values are the values of rho. There may be any number of sums.
        """
        real = np.result_type(sums, np.float32)
        spectra = self._spectra(sums.astype(real, copy=False))
        window, level = (0, 0), []
        for row in self.grid:
            template, onsets = row.template, self._onsets(row.template)
            # Templates with the same window share the correlations of the baseline.
            if window != (template.first, template.time.size):
                window = template.first, template.time.size
                level = [
                    self._correlated(spectra[series], template.time**power, template.first)
                    for power, series in self._terms
                ]
            correlated = self._correlated(spectra[0], template.shapes[row.phase], template.first)[..., onsets]
            for projected, term in zip(row.project.astype(real), level, strict=True):
                correlated -= projected * term[..., onsets]
            size = row.per_amplitude
            correlated *= np.divide(1.0, size, out=np.zeros_like(size), where=size > 0).astype(real)
            yield row, correlated

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

    def peaks_s(self, row: Row) -> Float:
        """Return the times of the peaks of a row's templates, from the start of the stare, shape (n_onset,)."""
        return np.asarray((self._first + row.peaks + row.template.phases[row.phase]) * self.bank.frame_s)

    @property
    def variance(self) -> Float:
        """Variance of each frame's sums, shape (n_frame,)."""
        return np.asarray(1.0 / self._weight[self._at])

    def _spectra(self, sums: NDArray[Any]) -> list[NDArray[Any]]:
        """Return transforms of the weighted sums times each series, zero in gaps, (n_stare, n_sum, n_frequency)."""
        weighted = np.zeros((len(sums), sums.shape[2], self.n_grid), sums.dtype)
        levelled = np.moveaxis(sums, 2, 1)
        if self._terms:
            # The baseline fitted to the whole stare does not change rho, and without it rho is more precise.
            levelled = levelled - (levelled @ self._level_span) @ self._level_span.T
        weighted[:, :, self._at] = levelled * self._weight[self._at]
        return [scipy.fft.rfft(weighted * series.astype(sums.dtype), self._size) for series in self._series]

    @cached_property
    def _level_span(self) -> Float:
        """Orthonormal columns that span all baselines of the stare, (n_frame, n)."""
        time = (self._at - self._at.mean()) / max(self.n_grid, 1)
        columns = np.array([time**power * self._series[series][self._at] for power, series in self._terms])
        return np.asarray(scipy.linalg.orth(columns.T, rcond=1e-12))

    def _correlated(self, spectrum: NDArray[Any], kernel: Float, first: int) -> NDArray[Any]:
        """Return sum_t data(t) kernel(t - first - onset) at every frame, in the precision of the spectrum."""
        padded = np.zeros(self._size, spectrum.real.dtype)
        overlap = slice(max(0, 1 - self.n_grid - first), max(0, self.n_grid - first))
        padded[: kernel[overlap].size] = kernel[overlap]
        of_kernel = np.conj(scipy.fft.rfft(np.roll(padded, first + overlap.start)))
        values: NDArray[Any] = scipy.fft.irfft(spectrum * of_kernel, self._size)
        return values[..., : self.n_grid]

    def _onsets(self, template: Template) -> slice:
        """Return the frames at which a template is tried."""
        # Onsets are multiples of the stride from the start of the whole stare, even if only a part is searched.
        return slice(-self._first % template.stride, self.n_grid, template.stride)

    def _rows_of(self, template: Template) -> Iterator[Row]:
        """Yield the row of each phase of a template; where gaps leave little of it, it is not searched."""
        n = len(self._terms)
        peaks = np.arange(self.n_grid)[self._onsets(template)]
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
            shared = np.reshape([over(0, a, shape * time**p) for p, a in self._terms], (n, peaks.size)).T
            solved = np.linalg.solve(scaled, (shared / size)[:, :, None])[:, :, 0] / size
            power = over(0, 0, shape**2) - 2 * np.sum(solved * shared, axis=1)
            power += np.einsum("ni,nij,nj->n", solved, gram, solved)
            without_gaps = template.detrended(phase, self.bank.baseline.powers)
            tried = power >= LEAST_SHARE * float(without_gaps @ without_gaps) * float(np.median(self._weight[self._at]))
            yield Row(template, phase, peaks, np.sqrt(np.where(tried, power, 0.0)), solved.T)


def largest_values(
    values: Callable[[NDArray[Any]], Iterator[tuple[Any, NDArray[Any]]]], sums: NDArray[Any], size: int
) -> Float:
    """Return the largest of the values that a search yields for each stare of `size` values, shape (n_stare,)."""
    batch = max(1, BATCH // size)
    best = np.full(len(sums), -np.inf)
    for first in range(0, len(sums), batch):
        part = slice(first, first + batch)
        for _, rho in values(sums[part]):
            best[part] = np.maximum(best[part], rho.max(axis=(1, 2)))
    return best


#: Averaging time of the fit, s; the curvature within it is neglected.
BLOCK_S = 30.0
#: Residual in standard deviations above which a mean has less weight.
HUBER = 3.0
#: Number of Gauss-Newton steps, and difference of amplitudes from which derivatives follow.
STEPS, DIFFERENCE = 6, 1e-6
#: Standard deviations of an unknown at which its effect is evaluated, and smallest significant S/N of the effect.
REACH, LEAST = 4.0, 0.01


@dataclass(frozen=True, eq=False)
class Trend:
    """Effect of a stare's unknowns on the sums of its frames."""

    of: tuple[Changing, ...]  # quantity that each unknown changes
    curves: Float  # change per standard deviation of each unknown, shape (n_unknown, n_frame)
    means: Float  # means of the components in `STEADY`, shape (4, n_frame, n_sum)
    slope_per_c: float  # relative change of the dark current per deg C

    @cached_property
    def extremes(self) -> Float:
        """Amplitudes of `REACH` standard deviations, together and each alone, with both signs, (n, n_unknown)."""
        rows = np.vstack([np.eye(len(self.of)), np.ones(len(self.of))])
        return np.asarray(REACH * np.vstack([rows, -rows]))

    def factors(self, amplitudes: Float) -> Float:
        """Return the factors on `STEADY`, (4, n_stare, n_frame), for amplitudes in standard deviations."""
        of, names = np.array(self.of), ("star", "sky", "light", "temperature")
        star, sky, light, warmer = (amplitudes[:, of == name] @ self.curves[of == name] for name in names)
        light = 1 + light
        return np.stack([light * (1 + star), light * (1 + sky), np.exp(self.slope_per_c * warmer), light])

    def effect(self, amplitudes: Float) -> Float:
        """Return the effect of unknowns on the sums, (n_stare, n_frame, n_sum), for amplitudes as of `factors`."""
        return np.asarray(np.einsum("cnt,ctk->ntk", self.factors(amplitudes) - 1, self.means, optimize=True))

    def nonlinear_effect(self, amplitudes: Float) -> Float:
        """Return the `effect` of unknowns less its linear part, (n_stare, n_frame, n_sum)."""
        star, sky, dark, near = self.means.mean(axis=1)
        slopes = {"star": star, "light": star + sky + near, "sky": sky, "temperature": self.slope_per_c * dark}
        linear = np.reshape([slopes[of] for of in self.of], (len(self.of), star.size))
        first = np.einsum("nu,ut,uk->ntk", amplitudes, self.curves, linear, optimize=True)
        return np.asarray(self.effect(amplitudes) - first)


#: Norm of curves of unit norm less their straight lines, below which they are linear combinations of others.
MIN_CURVE = 1e-6


@dataclass(frozen=True, eq=False)
class SearchedFrames:
    """Frames of a stare, and the mean, noise and unknown changes that their search assumes."""

    stare: Stare
    mean: NDArray[Any]  # of each frame's sums without a flare, shape (n_frame, n_sum)
    variance: Float  # of each frame's sums, shape (n_frame,)
    curves: Float  # of unknown amplitude, shape (n_curve, n_frame)
    trend: Trend | None  # effect of the stare's unknowns if it is significant beyond first order

    def part(self, window: slice) -> SearchedFrames:
        """Return consecutive frames of these."""
        stare, trend = select_frames(self.stare, window), self.trend
        if trend is not None:
            trend = replace(trend, curves=trend.curves[:, window], means=trend.means[:, window])
        return SearchedFrames(stare, self.mean[window], self.variance[window], self.curves[:, window], trend)

    def search(self, bank: Bank) -> Search:
        """Return the search of the frames with a bank."""
        return Search(bank, self.stare, self.curves, self.variance)

    def net(self, sums: NDArray[Any]) -> NDArray[np.float32]:
        """Subtract from simulated sums their known mean and the fitted trend, shape (n_stare, n_frame, n_sum)."""
        return np.asarray(self.subtracted(sums - self.mean), np.float32)

    def subtracted(self, sums: NDArray[Any]) -> NDArray[Any]:
        """Fit the trend, if there is one, to sums less their known mean, and subtract it beyond first order."""
        if (trend := self.trend) is None:
            return sums
        return np.array([stare - trend.nonlinear_effect(self._fitted(trend, stare))[0] for stare in sums.astype(float)])

    def _fitted(self, trend: Trend, sums: Float) -> Float:
        """Return the most likely amplitudes for the sums of a stare, in standard deviations, shape (1, n_unknown)."""
        first, weight, means = self._blocks
        y, n = np.add.reduceat(sums / self.variance[:, None], first) / weight[:, None], len(trend.of)
        amplitudes, steps = np.zeros((1, n)), DIFFERENCE * np.eye(n + 1, n, -1)
        for _ in range(STEPS):
            effect = means.effect(amplitudes + steps)
            residuals, gradient = y - effect[0], (effect[1:] - effect[0]) / DIFFERENCE
            size = np.sqrt(np.sum(residuals**2, axis=1) * weight)
            trusted = weight * np.minimum(1.0, HUBER / np.maximum(size, 1e-300))
            weighted = (gradient * trusted[:, None]).reshape(n, -1)
            information = weighted @ gradient.reshape(n, -1).T + np.eye(n)
            amplitudes = amplitudes + np.linalg.solve(information, weighted @ residuals.ravel() - amplitudes[0])
        return amplitudes

    @cached_property
    def _blocks(self) -> tuple[NDArray[np.intp], Float, Trend]:
        """The first frame of each block, its weight, and the trend of the blocks' means."""
        assert self.trend is not None
        number = self.stare.numbers // max(1, round(BLOCK_S / self.stare.frame_s))
        first = np.flatnonzero(np.diff(number, prepend=-1))
        weight = np.add.reduceat(1.0 / self.variance, first)
        curves = np.add.reduceat(self.trend.curves / self.variance, first, axis=1) / weight
        means = np.add.reduceat(self.trend.means / self.variance[:, None], first, axis=1) / weight[:, None]
        return first, weight, replace(self.trend, curves=curves, means=means)


@dataclass(frozen=True, eq=False)
class Survey:
    """Stare at a star and its search."""

    components: Components  # with the weights of the templates
    stare: Stare
    bank: Bank
    templates: Templates  # from which bank and components are made

    @cached_property
    def coefficients(self) -> Float:
        """Known coefficients of each frame's components without a flare, shape (n_frame, 4 + n_flare)."""
        return self.components.coefficients(self.stare)

    @cached_property
    def response(self) -> Float:
        """Mean sums of a frame for the first flare component at unit amplitude, shape (n_sum,)."""
        return np.asarray(self.components.component_means[len(STEADY)])

    @cached_property
    def mean_sums(self) -> MeanSums:
        """Mean sums of a flare of unit amplitude over log temperature; of the first component if they tell none."""
        log_k, values = np.log(self.templates.temperatures_k), self.templates.directions
        if not self.templates.coloured:
            values = np.tile(self.response, (log_k.size, 1))
        return MeanSums(values, np.zeros((0, values.shape[1])), log_k)

    @cached_property
    def response_noise(self) -> Float:
        """Covariance that the first flare component adds to a frame's sums at unit amplitude, (n_sum, n_sum)."""
        return np.asarray(self.components.sum_cumulants(2)[1][len(STEADY)])

    def photon_noise(self, log_k: float) -> Float:
        """Return the covariance of a frame's sums that a flare of unit amplitude adds, (n_sum, n_sum)."""
        if self.templates.coloured:
            return np.asarray(self.templates.noise[self.templates.nearest(float(np.exp(log_k)))])
        return self.response_noise

    @property
    def unit_snr(self) -> float:
        """S/N of one frame for the first flare component at constant unit amplitude and known baseline."""
        return float(np.linalg.norm(self.response))

    @cached_property
    def covariance(self) -> Float:
        """Covariance of each frame's sums without a flare, shape (n_frame, n_sum, n_sum)."""
        return self.components.jittered_covariance(self.coefficients, self.stare)

    @cached_property
    def variance(self) -> Float:
        """Variance of each frame's sums that the search assumes, averaged over sums, shape (n_frame,)."""
        return np.asarray(np.einsum("tkk->t", self.covariance) / self.covariance.shape[1])

    @cached_property
    def curves(self) -> Float:
        """Independent curves of the baseline: the unknowns less straight lines, shape (n_curve, n_frame)."""
        if not self.bank.baseline.cycle:
            return np.zeros((0, self.stare.n_frames))
        of_unit_norm = [unknown.curve / (np.linalg.norm(unknown.curve) or 1.0) for unknown in self.stare.unknowns]
        rows = np.reshape(of_unit_norm, (len(of_unit_norm), self.stare.n_frames))
        line = np.linalg.qr(np.vander(self.stare.start_s / max(self.stare.duration_s, 1.0), 2))[0]
        curves, size, _ = np.linalg.svd((rows - rows @ line @ line.T).T, full_matrices=False)
        return np.asarray(curves[:, size > MIN_CURVE].T)

    @cached_property
    def frames(self) -> SearchedFrames:
        """Frames of the stare, and what the search assumes of them."""
        mean, trend = self.components.means(self.coefficients), None
        if self.stare.unknowns:
            effect = self.unknowns.nonlinear_effect(self.unknowns.extremes)
            power = np.sum(effect**2 / self.variance[:, None], axis=(1, 2))
            trend = self.unknowns if (power > LEAST**2).any() else None
        return SearchedFrames(self.stare, mean, self.variance, self.curves, trend)

    @cached_property
    def search(self) -> Search:
        """Search of the stare's frames."""
        return self.frames.search(self.bank)

    @cached_property
    def unknowns(self) -> Trend:
        """Effect of the stare's unknowns."""
        steady = len(STEADY)
        means = self.coefficients.T[:steady, :, None] * self.components.component_means[:steady, None]
        unknowns, slope = self.stare.unknowns, self.components.quiet.conditions["dark_slope_per_c"]
        curves = np.reshape([unknown.sd * unknown.curve for unknown in unknowns], (len(unknowns), self.stare.n_frames))
        return Trend(tuple(unknown.of for unknown in unknowns), curves, means, slope)

    def unsubtracted(self, amplitudes: Float) -> Float:
        """Return the `effect` of unknowns on the sums that is not subtracted before the search."""
        return self.frames.subtracted(self.unknowns.effect(amplitudes))

    def largest_value_request(self, count: int, seed: int, processes: Processes = NONE) -> StaresRequest:
        """Return the request for the largest values of stares without a flare."""
        method, largest = method_for(self.components, self.stare, processes), LargestValues(self.bank, self.frames)
        return StaresRequest(
            self.components, self.stare, count, seed, method=method, processes=processes, reduction=largest
        )


@dataclass(frozen=True, eq=False)
class LargestValues:
    """Reduction of simulated stares to their largest values."""

    adds: ClassVar[bool] = False

    bank: Bank
    frames: SearchedFrames

    @cached_property
    def search(self) -> Search:
        """Search of the frames, made once for all launches."""
        return self.frames.search(self.bank)

    def __call__(self, values: NDArray[np.float32], first: int) -> dict[str, NDArray[Any]]:
        """Return the largest values as ``maximum``, shape (n_stare,)."""
        return {"maximum": self.search.largest(self.frames.net(values))}
