"""Search of stares for flares with a bank of matched filters, exact over gaps.

Weights in wavelength reduce a frame to a few sums for flares of any temperature. The optimal weights for a flare with
spectrum d are C^-1 d, where C is the covariance of a frame including nuisance parameters (METHODS section 7). Spectra
of flares of 6000-30 000 K are similar, so that two or three singular vectors of the whitened spectra are enough.

For sums y of a frame with unit covariance, a template s in time and c in the sums, and a baseline G a with unknown
amplitudes a in the window, the statistic is that of generalised least squares,

    rho = c . (s - P G)^T m y / sqrt((s - P G)^T m (s - P G)),   P = (G^T m G)^-1 G^T m s,

with m the inverse variance of a frame, zero in gaps. Without a flare it is normal with unit variance; with a flare, its
mean is the S/N. All sums over time are correlations, computed by FFT. (Matched filters: Turin 1960, doi
10.1109/TIT.1960.1057571.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.flare_model import spanning_weights
from mauvecl.flares import RANK, WINDOW_S
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.noise.unknowns import CHANGED_PART
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape
    from mauvecl.flares.stare import Stare
    from mauvecl.host.exposure.expectation import Expectation


#: Shortest window before and after a peak, in half-widths of the template.
LEAD, TAIL = 5.0, 10.0
#: Half-widths before and after a peak beyond which the light of a flare is neglected.
REACH = (5.0, 80.0)
#: Smallest number of onsets per half-width.
ONSETS = 10
#: Half-width in frames below which two onsets per frame are searched.
SUB_FRAME = 6.0
#: Smallest share of a template's power outside gaps for which it is searched.
LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Baseline:
    """Baseline under a flare: the terms that are marginalised over in each window."""

    offset: bool = True
    slope: bool = True
    cycle: bool = False  #: curves of unknown amplitude, such as the orbital thermal cycle
    window_s: float = WINDOW_S  #: of the smallest window; windows hold 5 half-widths before the peak and 10 after

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

    def detrended(self, phase: int, powers: tuple[int, ...]) -> Float:
        """Return a shape less its projection on powers of time, shape (n,)."""
        columns = np.array([self.time**power for power in powers]).reshape(len(powers), self.time.size).T
        level, *_ = np.linalg.lstsq(columns, self.shapes[phase])
        return np.asarray(self.shapes[phase] - columns @ level)


@dataclass(frozen=True, eq=False)
class Bank:
    """Template bank of a search."""

    half_widths_s: tuple[float, ...]  #: ascending
    #: Unit vectors of the change of a frame's sums for each temperature: rows of `Templates.directions`, or one row of
    #: ones for a single light curve; shape (n_temperature, n_sum).
    directions: Float
    shape: Shape
    frame_s: float
    baseline: Baseline = Baseline()

    def __post_init__(self) -> None:
        directions = np.atleast_2d(np.array(self.directions, np.float64))
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        if not (length > 0).all():
            raise InputError("every direction of the bank must change a sum of a frame", key="directions")
        set_read_only(self, directions=directions / length)

    @cached_property
    def templates(self) -> tuple[Template, ...]:
        """Templates of all half-widths, with two phases of narrow ones and one of others."""
        templates = []
        for width in self.half_widths_s:
            frames, (lead, tail) = width / self.frame_s, self.window(width)
            phases = (0.25, 0.75) if frames < SUB_FRAME else (0.5,)
            edges = np.arange(-lead, tail + 2) * self.frame_s
            shapes = np.array([self.shape.mean_over(edges, p * self.frame_s, width) for p in phases])
            templates.append(Template(width, -lead, phases, shapes, max(1, int(frames / ONSETS))))
        return tuple(templates)

    def window(self, half_width_s: float) -> tuple[int, int]:
        """Return the number of frames of the window before and after the peak."""
        half = self.baseline.window_s / 2
        lead, tail = (max(reach * half_width_s, half) / self.frame_s for reach in (LEAD, TAIL))
        return int(np.ceil(lead)), int(np.ceil(tail))


@lru_cache(maxsize=8)
def white_bank(half_widths_s: tuple[float, ...], shape: Shape, frame_s: float, baseline: Baseline = Baseline()) -> Bank:
    """Return the bank of a single light curve with white noise; the same one for the same arguments."""
    return Bank(half_widths_s, np.ones((1, 1)), shape, frame_s, baseline)


#: Default temperatures of templates, K, in steps of a factor of 1.034.
TEMPERATURES_K = tuple(float(t) for t in np.geomspace(6_000.0, 30_000.0, 49).round(-1))
#: Angle between neighbouring directions of a bank in the space of whitened sums. A flare halfway between them loses
#: 1 - cos(ANGLE / 2) = 0.3 % of its S/N.
ANGLE = 0.15
#: Smallest singular value relative to the largest; smaller ones are rounding errors.
MIN_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class Templates:
    """Weights of a frame's sums, and the effect of flares of unit amplitude on these sums."""

    temperatures_k: tuple[float, ...]  #: ascending
    #: Per DN; sums of a quiescent frame have unit covariance, including nuisance parameters; shape (n_sum, n_pixel).
    weights: Float
    directions: Float  #: mean sums, shape (n_temperature, n_sum)
    best: Float  #: S/N in a frame with optimal weights: the norm of `directions` without loss, shape (n_temperature,)
    noise: Float  #: covariance that photon noise of the flare adds to the sums, shape (n_temperature, n_sum, n_sum)

    @classmethod
    def of(
        cls,
        variance: Float,
        flares: Float,
        photon_variance: Float,
        temperatures_k: Sequence[float],
        *,
        nuisances: Nuisances | None = None,
        rank: int = RANK,
    ) -> Self:
        """Compute weights from the noise of a quiescent frame and flare spectra, all in one unit.

        `variance` and `flares`, (n_temperature, n_pixel), are zero in unused pixels; `photon_variance` is the
        rise of the variance with the flux. Flares have unit amplitude and ascending temperatures, in steps small enough
        for `chosen`. `nuisances` are independent in each frame, such as jitter; `rank` is the largest number of sums.
        """
        rows = nuisances.rows(variance, nuisances.spectra * (variance > 0)) if nuisances else None
        plain = np.divide(flares, variance, out=np.zeros_like(flares), where=variance > 0)
        weights, length = spanning_weights(flares, plain, nuisances, rows, MIN_SINGULAR**2)
        weights = weights[::-1][:rank]
        # Signs are arbitrary; choose them so that the hottest flare increases each sum.
        weights *= np.where(weights @ flares[-1] < 0, -1.0, 1.0)[:, None]
        photons = flares * photon_variance
        noise = np.einsum("kp,lp,tp->tkl", weights, weights, photons, optimize=True)
        return cls(tuple(temperatures_k), weights, flares @ weights.T, length, noise)

    def mixed(self, matrix: Float) -> Self:
        """Return the templates of linear combinations of the sums, with `matrix` of shape (n_sum, n_sum)."""
        return replace(
            self,
            weights=matrix @ self.weights,
            directions=self.directions @ matrix.T,
            noise=np.einsum("kl,tlm,nm->tkn", matrix, self.noise, matrix),
        )

    @cached_property
    def chosen(self) -> tuple[int, ...]:
        """Rows of `directions` for a bank, spaced by at most about `ANGLE`."""
        unit = self.directions / np.linalg.norm(self.directions, axis=1, keepdims=True)
        steps = np.arccos(np.clip(np.sum(unit[1:] * unit[:-1], axis=1), -1.0, 1.0))
        along = np.concatenate([[0.0], np.cumsum(steps)])
        # The outermost directions may be half a step from the ends.
        n = max(1, int(np.ceil(along[-1] / ANGLE)))
        angles = (np.arange(n) + 0.5) / n * along[-1]
        return tuple(dict.fromkeys(int(np.argmin(np.abs(along - angle))) for angle in angles))

    @property
    def coloured(self) -> bool:
        """True if the sums of a flare depend on its temperature by more than a factor."""
        return len(self.temperatures_k) > 1 and self.directions.shape[1] > 1

    @property
    def loss(self) -> Float:
        """Share of the S/N that is lost by reducing frames to sums, shape (n_temperature,)."""
        return np.asarray(1.0 - np.linalg.norm(self.directions, axis=1) / self.best)

    def nearest(self, kelvin: float) -> int:
        """Return the row of the temperature that is nearest to another one."""
        return int(np.argmin(np.abs(np.log(np.array(self.temperatures_k) / kelvin))))


def frame_nuisances(quiet: Expectation, stare: Stare, more: Mapping[str, float] | None = None) -> Nuisances | None:
    """Return the nuisance parameters of each frame: the stare's jitters, and `more`.

    Standard deviations by name in `more` replace jitters of the same kind; an infinite one is projected out.
    """
    jitters: dict[str, float] = {CHANGED_PART[of]: sd for of, sd in stare.jitters.items() if sd > 0}
    # Drifts and re-acquisitions change all light alike, by any amount and at any time.
    drifting = {} if stare.pointing is None else {"light": np.inf}
    spreads = jitters | drifting | dict(more or {}) | drifting
    return Nuisances.of(quiet, spreads) if spreads else None


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
        # The grid has every frame from the first to the last, those in gaps included, with a weight of zero.
        self._first = int(stare.numbers[0])
        self._places = stare.numbers - self._first
        self.n_grid = int(self._places[-1]) + 1
        self._weight = np.zeros(self.n_grid)
        self._weight[self._places] = 1.0 if variance is None else 1.0 / variance
        series = [np.ones(stare.n_frames)]
        for curve in np.zeros((0, stare.n_frames)) if curves is None else curves:
            scale = float(np.std(curve))
            if not scale > 0:
                raise InputError("a baseline curve must vary over the stare, but is constant", key="curves")
            series.append((curve - np.mean(curve)) / scale)
        # Terms of the baseline: a power of time in the window, and the index of a series in the stare.
        self._terms = [(power, 0) for power in bank.baseline.powers] + [(0, 1 + k) for k in range(len(series) - 1)]
        self._series = np.zeros((len(series), self.n_grid))
        self._series[:, self._places] = series
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
        reached = slice(*np.searchsorted(self._places, [first.min(), first.max() + size]))
        grid = self._places[reached]
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
        return np.asarray(1.0 / self._weight[self._places])

    def _spectra(self, sums: NDArray[Any]) -> list[NDArray[Any]]:
        """Return transforms of the weighted sums times each series, zero in gaps, (n_stare, n_sum, n_frequency)."""
        weighted = np.zeros((len(sums), sums.shape[2], self.n_grid), sums.dtype)
        levelled = np.moveaxis(sums, 2, 1)
        if self._terms:
            # The baseline fitted to the whole stare does not change rho, and without it rho is more precise.
            levelled = levelled - (levelled @ self._level_span) @ self._level_span.T
        weighted[:, :, self._places] = levelled * self._weight[self._places]
        return [scipy.fft.rfft(weighted * series.astype(sums.dtype), self._size) for series in self._series]

    @cached_property
    def _level_span(self) -> Float:
        """Orthonormal columns that span all baselines of the stare, (n_frame, n)."""
        time = (self._places - self._places.mean()) / max(self.n_grid, 1)
        columns = np.array([time**power * self._series[series][self._places] for power, series in self._terms])
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
            least = LEAST_SHARE * float(without_gaps @ without_gaps)
            tried = power >= least * float(np.median(self._weight[self._places]))
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
