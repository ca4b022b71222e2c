"""Survey of a star: what the search of its stare assumes of the frames, and fits of flares to their sums.

*Beyond first order.* What unknowns do to the sums beyond first order, such as the bend of the dark current by a
drifting temperature, is fitted to the whole stare and subtracted before the search (docs/completeness.md, "Beyond first
order"): by the Gauss-Newton method on means over half a minute, with the distribution of the unknowns as prior, and
less weight for means with flares (Huber 1964, doi 10.1214/aoms/1177703732).

*Fits.* Overlapping flares are fitted together by non-linear least squares, with intervals from the profile likelihood.
A block is the unit of a fit: overlapping flares, over the union of their windows. The baseline is marginalised as in
the search: a straight line over the window of the widest flare, or a continuous piecewise line in longer blocks. Flux
of flares outside the block is subtracted. The noise of a frame includes the photon noise of the flares. Standard errors
are from the inverse of the information. Amplitudes near the threshold are biased high, because noise contributes to
detection; fits do not correct for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.flare_model import MeanSums
from mauvecl.fits.least_squares import interval_end, least_squares, parameter_covariance
from mauvecl.flares.frames import STEADY, Components
from mauvecl.flares.shapes import between, sides
from mauvecl.flares.stare import Stare, select_frames
from mauvecl.flares.stare_scene import StaresRequest, method_for
from mauvecl.host.arrays import Float
from mauvecl.noise.unknowns import NONE, Changing, Processes
from mauvecl.search.search import REACH, Bank, Search, Templates

#: Averaging time of the fit, s; the curvature within it is neglected.
BLOCK_S = 30.0
#: Residual in standard deviations above which a mean has less weight.
HUBER = 3.0
#: Number of Gauss-Newton steps, and difference of amplitudes from which derivatives follow.
STEPS, DIFFERENCE = 6, 1e-6
#: Standard deviations of an unknown at which its effect is evaluated, and smallest significant S/N of the effect.
FARTHEST, LEAST_SNR = 4.0, 0.01


@dataclass(frozen=True, eq=False)
class Trend:
    """Effect of a stare's unknowns on the sums of its frames."""

    of: tuple[Changing, ...]  # quantity that each unknown changes
    curves: Float  # change per standard deviation of each unknown, shape (n_unknown, n_frame)
    means: Float  # means of the components in `STEADY`, shape (4, n_frame, n_sum)
    slope_per_c: float  # relative change of the dark current per deg C

    @cached_property
    def extremes(self) -> Float:
        """Amplitudes of `FARTHEST` standard deviations, together and each alone, with both signs, (n, n_unknown)."""
        rows = np.vstack([np.eye(len(self.of)), np.ones(len(self.of))])
        return np.asarray(FARTHEST * np.vstack([rows, -rows]))

    def factors(self, amplitudes: Float) -> Float:
        """Return the factors on the components in `STEADY`, shape (4, n_stare, n_frame).

        Amplitudes of unknowns are in standard deviations, (n_stare, n_unknown).
        """
        of, names = np.array(self.of), ("star", "sky", "light", "temperature")
        star, sky, light, warmer = (amplitudes[:, of == name] @ self.curves[of == name] for name in names)
        light = 1 + light
        return np.stack([light * (1 + star), light * (1 + sky), np.exp(self.slope_per_c * warmer), light])

    def effect(self, amplitudes: Float) -> Float:
        """Return the effect of unknowns on the sums, (n_stare, n_frame, n_sum), for amplitudes as of `factors`."""
        return np.asarray(np.einsum("cnt,ctk->ntk", self.factors(amplitudes) - 1, self.means, optimize=True))

    def nonlinear_effect(self, amplitudes: Float) -> Float:
        """Return the `effect` of unknowns less its linear part, (n_stare, n_frame, n_sum)."""
        star, sky, dark, neighbours = self.means.mean(axis=1)
        slopes = {"star": star, "light": star + sky + neighbours, "sky": sky, "temperature": self.slope_per_c * dark}
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
        return np.array([stare - trend.nonlinear_effect(self._fitted(stare))[0] for stare in sums.astype(float)])

    def _fitted(self, sums: Float) -> Float:
        """Return the most likely amplitudes for the sums of a stare, in standard deviations, shape (1, n_unknown)."""
        first, weight, means = self._blocks
        y, n = np.add.reduceat(sums / self.variance[:, None], first) / weight[:, None], len(means.of)
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
            trend = self.unknowns if (power > LEAST_SNR**2).any() else None
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
        """Return the `effect` of unknowns that is not subtracted before the search, (n_stare, n_frame, n_sum)."""
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


#: Share of the rise of chi-squared that the ends of a closed interval reach.
NEARLY = 0.9
#: Columns of a flare's parameters: log amplitude, peak time in s, log half-width in s, log temperature in K.
AMPLITUDE, PEAK, WIDTH, KELVIN = range(4)
#: Factor by which fitted half-widths may exceed the range of the bank.
BEYOND_BANK = 1.25
#: Half-widths before and after a peak within which flares overlap.
OVERLAP_BEFORE, OVERLAP_AFTER = 2.0, 10.0
#: Bounds of log amplitude.
LOG_AMPLITUDES = (-27.0, 14.0)
#: Relative change of chi-squared at which a fit has converged.
CONVERGED = 1e-6
#: No flares.
NO_FLARES = np.zeros((0, 4))

#: Logarithm of a factor in a profiled product as a function of log temperature, with its derivative.
Factor = Callable[[float], tuple[float, float]]


@dataclass(frozen=True, eq=False)
class BlendFit:
    """Fit of the flares of a block."""

    theta: Float  # shape (n_flare, 4); columns as `AMPLITUDE` and following
    chi2: float
    dof: int  # number of sums less the number of baseline terms and flare parameters
    converged: bool

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large."""
        return float(scipy.stats.chi2.sf(self.chi2, self.dof)) if self.dof > 0 else float("nan")


@dataclass(frozen=True)
class ProfiledQuantity:
    """Parameter of a flare or, with a factor, the logarithm of amplitude x half-width x factor."""

    column: int  # of the parameter that varies to hold the quantity: its own, or the amplitude
    factor: Factor | None = None

    def of(self, flare: Float) -> tuple[float, Float]:
        """Return the value for a flare's parameters, shape (4,), and its derivatives."""
        if self.factor is None:
            return float(flare[self.column]), np.eye(4)[self.column]
        value, slope = self.factor(float(flare[KELVIN]))
        return float(flare[AMPLITUDE] + flare[WIDTH] + value), np.array([1.0, 0.0, 1.0, slope])


@dataclass(frozen=True, eq=False)
class SummedStare:
    """The sums of a stare to which flares are fitted."""

    survey: Survey
    net: Float  # sums less their known means, shape (n_frame, n_sum)

    @cached_property
    def edges(self) -> Float:
        """Start and end of each frame, s, shape (n_frame, 2)."""
        start = self.survey.stare.start_s
        return np.column_stack([start, start + self.survey.stare.frame_s])

    @cached_property
    def bounds(self) -> tuple[Float, Float]:
        """Bounds of a flare's parameters, from the stare, the bank and the templates, shape (4,) each."""
        widths, kelvin = self.survey.bank.half_widths_s, self.survey.mean_sums.log_k
        first, last = self.edges[0, 0], self.edges[-1, 1]
        narrow, wide = np.log(widths[0] / BEYOND_BANK), np.log(widths[-1] * BEYOND_BANK)
        low, high = LOG_AMPLITUDES
        return np.array([low, first, narrow, kelvin[0]]), np.array([high, last, wide, kelvin[-1]])

    def overlapping(self, first_s: Any, last_s: Any) -> tuple[Any, Any]:
        """Return the first frame that overlaps each time interval, and the first one after it."""
        start = self.survey.stare.start_s
        return np.searchsorted(start, first_s - self.survey.stare.frame_s), np.searchsorted(start, last_s)

    def light(self, theta: Float, frames: slice = slice(None)) -> Float:
        """Return the mean sums of flares in some frames, shape (n_frame, n_sum)."""
        total = np.zeros_like(self.net)[frames]
        for flare, inside, mean in self._shining(theta, frames):
            total[inside] += mean[:, None] * self.survey.mean_sums.spline(flare[KELVIN])
        return total

    def noise(self, theta: Float, light: Float, frames: slice = slice(None)) -> Float:
        """Return the covariance of frames' sums with flares, shape (n_frame, n_sum, n_sum)."""
        total = self.survey.covariance[frames].copy()
        for flare, inside, mean in self._shining(theta, frames):
            total[inside] += mean[:, None, None] * self.survey.photon_noise(flare[KELVIN])
        jitter = self.survey.stare.light_jitter
        if jitter and len(theta):
            # Star and flare light jitter together; the star's jitter is already in the covariance.
            star = self.survey.components.directions(self.survey.coefficients[frames])["light"]
            bright = star + light
            total += jitter**2 * (bright[:, :, None] * bright[:, None, :] - star[:, :, None] * star[:, None, :])
        return total

    def _shining(self, theta: Float, frames: slice) -> Iterator[tuple[Float, slice, Float]]:
        """Yield the flares that contribute to some frames, the affected frames, and their mean amplitudes."""
        first, last, _ = frames.indices(len(self.net))
        shape = self.survey.bank.shape
        peak, width = theta[:, PEAK], np.exp(theta[:, WIDTH])
        starts, stops = self.overlapping(peak - REACH[0] * width, peak + REACH[1] * width)
        for flare, start, stop in zip(theta, np.maximum(starts, first), np.minimum(stops, last), strict=True):
            if start < stop:
                mean = shape.mean_over(self.edges[start:stop], flare[PEAK], np.exp(flare[WIDTH]))
                mean = np.exp(flare[AMPLITUDE]) * (self.survey.stare.light[start:stop] * mean)
                yield flare, slice(start - first, stop - first), mean

    def window(self, flare: Float) -> tuple[float, float]:
        """Return start and end of a flare's window, s."""
        lead, tail = self.survey.bank.window(float(np.exp(flare[WIDTH])))
        frame_s = self.survey.stare.frame_s
        return flare[PEAK] - (lead + 1) * frame_s, flare[PEAK] + (tail + 1) * frame_s

    def overlap(self, flare: Float) -> tuple[float, float]:
        """Return start and end of the interval in which a flare overlaps others, s."""
        width = np.exp(flare[WIDTH])
        return flare[PEAK] - OVERLAP_BEFORE * width, flare[PEAK] + OVERLAP_AFTER * width

    def block(self, flares: Float, others: Float = NO_FLARES, per_group: int = 1) -> Block:
        """Build the block of flares next to others, whose light is subtracted; parameters have the shape (n, 4).

        The block averages groups of consecutive frames, `per_group` each; incomplete groups at gaps are dropped.
        """
        windows, survey = [self.window(flare) for flare in flares], self.survey
        used = np.zeros(len(self.net), np.bool_)
        for window in windows:
            used[slice(*self.overlapping(*window))] = True
        rows = np.flatnonzero(used)
        _, first, count = np.unique(survey.stare.numbers[rows] // per_group, return_index=True, return_counts=True)
        groups = rows[first[count == per_group][:, None] + np.arange(per_group)]
        span = slice(int(rows[0]), int(rows[-1]) + 1)
        other_light = self.light(others, span)
        noise = self.noise(np.vstack([others, flares]), other_light + self.light(flares, span), span)
        whiten = np.linalg.inv(np.linalg.cholesky(noise[groups - span.start].mean(axis=1) / per_group))
        net = (self.net[span] - other_light)[groups - span.start].mean(axis=1)
        data = np.einsum("tij,tj->ti", whiten, net)
        edges = np.column_stack([self.edges[groups[:, 0], 0], self.edges[groups[:, -1], 1]])
        longest = max(end - begin for begin, end in windows)
        terms = [*self._baseline(edges.mean(axis=1), longest), *survey.curves[:, groups].mean(axis=2)]
        design = np.reshape(terms, (len(terms), len(groups))).T
        columns = np.einsum("tij,tp->tijp", whiten, design).reshape(data.size, -1)
        basis = scipy.linalg.orth(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), rcond=1e-9)
        flat = data.ravel()
        light = survey.stare.light[groups].mean(axis=1)
        return Block(self, edges, light, whiten, basis, flat - basis @ (basis.T @ flat))

    def _baseline(self, time: Float, piece_s: float) -> Float:
        """Return the terms of a baseline in time, splines with pieces of about a length, shape (n_term, n_time)."""
        powers = self.survey.bank.baseline.powers
        if not powers:
            return np.zeros((0, time.size))
        length = float(time[-1] - time[0]) or 1.0
        pieces = max(1, round(length / piece_s))
        place = np.clip((time - time[0]) / length, 0.0, 1.0) * pieces
        degree = max(powers)
        knots = np.concatenate([np.zeros(degree), np.arange(pieces + 1.0), np.full(degree, float(pieces))])
        return np.asarray(scipy.interpolate.BSpline.design_matrix(place, knots, degree).toarray().T)


@dataclass(frozen=True, eq=False)
class Block:
    """Data and noise of flares that are fitted together, in frames or averages of frames."""

    sums: SummedStare
    edges: Float  # starts and ends, s, shape (n_frame, 2)
    light: Float  # known factors on all light, shape (n_frame,)
    whiten: Float  # whitening matrices, shape (n_frame, n_sum, n_sum)
    basis: Float  # orthonormal columns of the whitened baseline, shape (n_frame * n_sum, n_term)
    data: Float  # whitened sums less their projection on the baseline, shape (n_frame * n_sum,)

    @cached_property
    def _times(self) -> tuple[Float, NDArray[np.intp]]:
        """Distinct times at which frames start or end, s, and their indices for each frame, shape (2, n_frame)."""
        times, index = np.unique(self.edges, return_inverse=True)
        return times, index.reshape(self.edges.shape).T

    def model(self, theta: Float) -> tuple[Float, Float]:
        """Return the whitened flux less its projection on the baseline, (n_row,), and derivatives, (n_row, n, 4)."""
        times, (first, last) = self._times
        shape, spline = self.sums.survey.bank.shape, self.sums.survey.mean_sums.spline
        length = times[last] - times[first]
        width = np.exp(theta[:, WIDTH, None])
        tau = (times - theta[:, PEAK, None]) / width  # (n_flare, n_time)
        at, integrals, relative = shape.at(tau), sides(shape, tau), width / length
        mean = relative * between(integrals[..., first], integrals[..., last])
        later = (at[:, first] - at[:, last]) / length
        change = tau * at
        wider = mean - relative * (change[:, last] - change[:, first])
        time = np.exp(theta[:, AMPLITUDE, None]) * self.light * np.array([mean, later, wider])  # (3, n_flare, n_frame)
        whiten = self.whiten.reshape(self.data.size, -1).T
        colour, hotter = (
            (spline(theta[:, KELVIN], order) @ whiten).reshape(len(theta), *self.whiten.shape[:2]) for order in (0, 1)
        )
        derivatives = np.empty((4, *colour.shape))
        derivatives[:KELVIN] = time[..., None] * colour
        derivatives[KELVIN] = time[0][..., None] * hotter
        rows = derivatives.reshape(-1, self.data.size)
        rows -= (rows @ self.basis) @ self.basis.T
        derivatives = rows.reshape(4, len(theta), -1)
        return derivatives[AMPLITUDE].sum(axis=0), derivatives.T

    def residuals(self, x: Float) -> tuple[Float, Float]:
        """Return the residuals for all parameters, (4 n_flare,), and their derivatives, (n_row, 4 n_flare)."""
        model, derivatives = self.model(x.reshape(-1, 4))
        return self.data - model, -derivatives.reshape(self.data.size, -1)

    def fit(self, theta: Float) -> BlendFit:
        """Fit all flares from a starting point, shape (n_flare, 4)."""
        limits = self._limits(len(theta))
        best, chi2, converged = least_squares(self.residuals, theta.ravel(), limits, CONVERGED)
        n_free = theta.size if self.sums.survey.templates.coloured else theta[:, :KELVIN].size
        dof = self.data.size - self.basis.shape[1] - n_free
        return BlendFit(best.reshape(-1, 4), chi2, dof, converged)

    def _limits(self, n_flare: int) -> tuple[Float, Float]:
        """Return the smallest and largest parameters of flares, (4 n_flare,) each."""
        low, high = self.sums.bounds
        return np.tile(low, n_flare), np.tile(high, n_flare)

    def covariance(self, theta: Float) -> Float:
        """Return the covariance of all parameters, the inverse of the information, shape (n, 4, n, 4)."""
        return parameter_covariance(self.residuals(theta.ravel())[1]).reshape(theta.shape * 2)

    def interval(self, best: BlendFit, j: int, quantity: ProfiledQuantity, rise: float) -> tuple[float, float, bool]:
        """Return the interval of a flare's quantity from the profile likelihood, and whether the fit ends it.

        Chi-squared rises by `rise` at its ends.
        """

        def value_and_slope(x: Float) -> tuple[float, Float]:
            gradient = np.zeros(best.theta.shape)
            value, gradient[j] = quantity.of(x.reshape(-1, 4)[j])
            return value, gradient.ravel()

        limits = self._limits(len(best.theta))
        (low, low_share), (high, high_share) = (
            interval_end(self.residuals, value_and_slope, best.theta.ravel(), limits, best.chi2, sign * rise)
            for sign in (-1.0, 1.0)
        )
        return low, high, min(low_share, high_share) < NEARLY

    def without(self, blended: BlendFit, j: int) -> BlendFit:
        """Fit all flares except flare `j`."""
        others = np.delete(blended.theta, j, axis=0)
        if not len(others):
            chi2 = float(self.data @ self.data)
            return replace(blended, theta=others, chi2=chi2, dof=self.data.size - self.basis.shape[1])
        return self.fit(others)


@dataclass(frozen=True, eq=False)
class FittedFlares:
    """Fitted flares and standard errors; arrays of shape (n,)."""

    peak_s: Float
    peak_error_s: Float
    amplitude: Float  # relative rise of the photons in the band
    amplitude_error: Float
    half_width_s: Float
    half_width_error_s: Float
    temperature_k: Float  # NaN if the sums do not depend on it
    temperature_error_k: Float
    equivalent_duration_s: Float  # proportional to the energy
    equivalent_duration_error_s: Float
    snr: Float

    @classmethod
    def of(cls, theta: Float, covariance: Float, survey: Survey, snr: Float) -> Self:
        """Return the values and errors of parameters, (n, 4), with covariances (n, 4, 4)."""
        sd = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
        gradient = np.array([1.0, 0.0, 1.0, 0.0])
        sd_duration = np.sqrt(np.maximum(np.einsum("i,nij,j->n", gradient, covariance, gradient), 0.0))
        amplitude, width, kelvin = np.exp(theta[:, [AMPLITUDE, WIDTH, KELVIN]]).T
        kelvin = kelvin if survey.templates.coloured else np.full(len(theta), np.nan)
        duration = amplitude * width * survey.bank.shape.equivalent_duration
        return cls(
            theta[:, PEAK], sd[:, PEAK], amplitude, amplitude * sd[:, AMPLITUDE], width, width * sd[:, WIDTH],
            kelvin, kelvin * sd[:, KELVIN], duration, duration * sd_duration, snr,
        )  # fmt: skip
