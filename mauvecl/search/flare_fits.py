"""Fits of single and of overlapping flares in stares.

Overlapping flares are fitted together by non-linear least squares, with intervals from the profile likelihood. A block
is the unit of a fit: overlapping flares, over the union of their windows. The baseline is marginalised as in the
search: a straight line over the window of the widest flare, or a continuous piecewise line in longer blocks. Flux of
flares outside the block is subtracted. The noise of a frame includes the photon noise of the flares.

Single flares are fitted many at a time, with standard errors from the inverse of the information. For a given peak and
half-width, the frames under the shape add up to one measurement of the flare's spectrum, of which `mauvecl.fits` finds
amplitude and temperature; peak and half-width follow by least squares from the template that detected the flare, with
the baseline of the search (Marquardt 1963, doi 10.1137/0111030; Golub & Pereyra 1973, doi 10.1137/0710036). Amplitudes
near the threshold are biased high, because noise contributes to detection; fits do not correct for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.profile import Profile
from mauvecl.flares.shapes import between, sides
from mauvecl.host.arrays import Float, array_cache
from mauvecl.search.templates import REACH, Bank, Templates

if TYPE_CHECKING:
    from mauvecl.search.search import SearchedFrames, Survey


#: Columns of a flare's parameters: log amplitude, peak time in s, log half-width in s, log temperature in K.
AMPLITUDE, PEAK, WIDTH, KELVIN = range(4)
#: Factor by which fitted half-widths may exceed the range of the bank.
BEYOND_BANK = 1.25
#: Half-widths before and after a peak within which flares overlap.
OVERLAP_BEFORE, OVERLAP_AFTER = 2.0, 10.0
#: Bounds of log amplitude.
LOG_AMPLITUDES = (-27.0, 14.0)
#: Relative change of chi-squared at which a fit has converged, and its largest number of evaluations.
CONVERGED, MAX_EVALUATIONS = 1e-7, 100
#: Relative tolerance of the root of the rise of chi-squared at an end of an interval, and largest number of refits.
CLOSE, MAX_REFITS = 0.02, 12
#: Distance from the fit, relative to that of an end of an interval, at which to look for other optima, and how often.
BEYOND, PROBES = 1.5, 3
#: Fall of chi-squared during profiling that indicates a better fit.
BETTER = 0.05

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
        widths, kelvin = self.survey.bank.half_widths_s, self.survey.templates.mean_sums.log_k
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
            total[inside] += mean[:, None] * self.survey.templates.mean_sums.spline(flare[KELVIN])
        return total

    def noise(self, theta: Float, light: Float, frames: slice = slice(None)) -> Float:
        """Return the covariance of frames' sums with flares, shape (n_frame, n_sum, n_sum)."""
        total, templates = self.survey.covariance[frames].copy(), self.survey.templates
        for flare, inside, mean in self._shining(theta, frames):
            total[inside] += mean[:, None, None] * templates.noise[templates.nearest(float(np.exp(flare[KELVIN])))]
        jitter = self.survey.stare.light_jitter
        if jitter and len(theta):
            # Star and flare light jitter together; the star's jitter is already in the covariance.
            star = self.survey.components.directions(self.survey.coefficients[frames])["light"]
            both = star + light
            total += jitter**2 * (both[:, :, None] * both[:, None, :] - star[:, :, None] * star[:, None, :])
        return total

    def _shining(self, theta: Float, frames: slice) -> Iterator[tuple[Float, slice, Float]]:
        """Yield the flares that contribute to some frames, the affected frames, and the mean amplitude in them."""
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

    def block(self, inside: Float, every: Float) -> Block:
        """Build the block of the flares `inside` among all flares `every`."""
        windows = [self.window(flare) for flare in inside]
        used = np.zeros(len(self.net), np.bool_)
        for first, last in windows:
            used[slice(*self.overlapping(first, last))] = True
        there = np.flatnonzero(used)
        span = slice(int(there[0]), int(there[-1]) + 1)
        light = self.light(every, span)
        others = light - self.light(inside, span)
        noise = self.noise(every, light, span)[used[span]]
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        data = np.einsum("tij,tj->ti", whiten, (self.net[span] - others)[used[span]])
        # Baseline terms, (n_frame, n_term): splines in time with pieces as long as the largest window, and curves.
        baseline, time, terms = self.survey.bank.baseline, self.edges[used].mean(axis=1), list[Float]()
        if baseline.powers:
            length = float(time[-1] - time[0]) or 1.0
            pieces = max(1, round(length / max(last - first for first, last in windows)))
            place = np.clip((time - time[0]) / length, 0.0, 1.0) * pieces
            degree = max(baseline.powers)
            knots = np.concatenate([np.zeros(degree), np.arange(pieces + 1.0), np.full(degree, float(pieces))])
            terms += list(scipy.interpolate.BSpline.design_matrix(place, knots, degree).toarray().T)
        terms += list(self.survey.curves[:, used])
        design = np.reshape(terms, (len(terms), time.size)).T
        columns = np.einsum("tij,tp->tijp", whiten, design).reshape(data.size, -1)
        basis = scipy.linalg.orth(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), rcond=1e-9)
        flat = data.ravel()
        return Block(self, used, whiten, basis, flat - basis @ (basis.T @ flat))


@dataclass(frozen=True, eq=False)
class Block:
    """Frames and noise of flares that are fitted together."""

    sums: SummedStare
    used: NDArray[np.bool_]  # frames of the stare, shape (n_frame,)
    whiten: Float  # whitening matrices, shape (n_used, n_sum, n_sum)
    basis: Float  # orthonormal columns of the whitened baseline, shape (n_used * n_sum, n_term)
    data: Float  # whitened sums less their projection on the baseline, shape (n_used * n_sum,)

    @cached_property
    def _times(self) -> tuple[Float, NDArray[np.intp]]:
        """Distinct times at which frames start or end, s, and their indices for each frame, shape (2, n_used)."""
        edges = self.sums.edges[self.used]
        times, index = np.unique(edges, return_inverse=True)
        return times, index.reshape(edges.shape).T

    def model(self, theta: Float) -> tuple[Float, Float]:
        """Return the whitened flux less its projection on the baseline, (n_row,), and derivatives, (n_row, n, 4)."""
        times, (first, last) = self._times
        shape, spline = self.sums.survey.bank.shape, self.sums.survey.templates.mean_sums.spline
        light, length = self.sums.survey.stare.light[self.used], times[last] - times[first]
        width = np.exp(theta[:, WIDTH, None])
        tau = (times - theta[:, PEAK, None]) / width  # (n_flare, n_time)
        at, integrals, relative = shape.at(tau), sides(shape, tau), width / length
        mean = relative * between(integrals[..., first], integrals[..., last])
        later = (at[:, first] - at[:, last]) / length
        change = tau * at
        wider = mean - relative * (change[:, last] - change[:, first])
        time = np.exp(theta[:, AMPLITUDE, None]) * light * np.array([mean, later, wider])  # (3, n_flare, n_used)
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

    def fit(self, theta: Float, held: tuple[int, ProfiledQuantity, float] | None = None) -> BlendFit:
        """Fit all flares from a starting point, shape (n_flare, 4), with a quantity of a flare held at a value."""
        low, high = (np.tile(end, (len(theta), 1)) for end in self.sums.bounds)
        moved = np.ones(theta.shape, np.bool_)
        flare, quantity, value = held or (0, None, 0.0)
        if quantity is not None:
            moved[flare, quantity.column] = False
        margin = 1e-9 * (high - low)
        start = np.clip(theta, low + margin, high - margin)

        def whole(x: Float) -> Float:
            every = start.copy()
            every[moved] = x
            if quantity is not None:
                # This parameter follows from the others.
                every[flare, quantity.column] += value - quantity.of(every[flare])[0]
            return every

        @array_cache(2)
        def triangle(x: Float) -> Float:
            """Return the triangular factor of derivatives and residuals as columns.

            Its columns have the same scalar products, on which alone the fit depends. It has few rows.
            """
            every = whole(x)
            model, derivatives = self.model(every)
            if quantity is not None:
                # The other parameters have an effect through the one that follows from them.
                own = derivatives[:, flare]
                own -= own[:, quantity.column, None] * quantity.of(every[flare])[1]
            columns = np.column_stack([-derivatives[:, moved], self.data - model])
            return np.asarray(np.linalg.qr(columns, mode="r"))

        def residual(x: Float) -> Float:
            return triangle(x)[:, -1]

        def jacobian(x: Float) -> Float:
            return triangle(x)[:, :-1]

        scale = np.ones(theta.shape)
        scale[:, PEAK] = np.exp(start[:, WIDTH])
        dof = self.data.size - self.basis.shape[1] - theta.size
        solution = scipy.optimize.least_squares(
            residual, start[moved], jacobian, bounds=(low[moved], high[moved]), x_scale=scale[moved],
            ftol=CONVERGED, xtol=1e-9, gtol=None, max_nfev=MAX_EVALUATIONS,
        )  # fmt: skip
        return BlendFit(whole(solution.x), 2 * float(solution.cost), dof, bool(solution.status > 0))

    def covariance(self, theta: Float) -> Float:
        """Return the covariance of all parameters, the inverse of the information, shape (n, 4, n, 4)."""
        jacobian = self.model(theta)[1]
        rows = jacobian.reshape(len(jacobian), -1)
        scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        inverse = np.linalg.pinv((rows / scale).T @ (rows / scale), hermitian=True) / np.outer(scale, scale)
        return np.asarray(inverse.reshape(theta.shape * 2))

    def interval(self, best: BlendFit, j: int, quantity: ProfiledQuantity, rises: float) -> tuple[float, float, bool]:
        """Return the interval of a flare's quantity from the profile likelihood, and whether the fit ends it.

        Chi-squared rises by `rises` at its ends. Raises BetterFitError if profiling finds a better fit.
        """
        covariance, theta = self.covariance(best.theta), best.theta
        weights, bounds = np.zeros(theta.shape), (-np.inf, np.inf)
        middle, weights[j] = quantity.of(theta[j])
        if quantity.factor is None:
            bounds = self.sums.bounds[0][quantity.column], self.sums.bounds[1][quantity.column]
        along = np.einsum("iajb,jb->ia", covariance, weights)
        variance = float(np.sum(weights * along))
        sd = np.sqrt(variance) if variance > 0 else 1e-3
        ends, is_open = [], False
        for sign, bound in zip((-1.0, 1.0), bounds, strict=True):
            furthest = abs(bound - middle)

            def refit(step: float, start: Float | None, sign: float = sign) -> BlendFit:
                straight = theta + along * sign * step / variance if variance > 0 else theta
                return self.fit(straight if start is None else start, (j, quantity, float(middle + sign * step)))

            step, short, there = _interval_end(refit, best.chi2, rises, sd * np.sqrt(rises), furthest)
            for _ in range(PROBES):
                if step >= furthest:
                    break
                # Another optimum may follow beyond a rise.
                probe = min(BEYOND * step, furthest)
                one = min((refit(probe, start) for start in (None, there, theta)), key=lambda fit: fit.chi2)
                if one.chi2 - best.chi2 < rises * (1.0 - CLOSE) ** 2:
                    step, short, there = _interval_end(refit, best.chi2, rises, probe, furthest, one.theta)
            ends.append(float(middle + sign * step))
            is_open |= short
        return ends[0], ends[1], is_open

    def without(self, blended: BlendFit, j: int) -> BlendFit:
        """Fit all flares except flare `j`."""
        rest = np.delete(blended.theta, j, axis=0)
        if not len(rest):
            left = float(self.data @ self.data)
            return replace(blended, theta=rest, chi2=left, dof=self.data.size - self.basis.shape[1])
        return self.fit(rest)


class BetterFitError(Exception):
    """Profiling finds a better fit, near the parameters `theta`."""

    def __init__(self, theta: Float) -> None:
        self.theta = theta


def _interval_end(
    refit: Callable[[float, Float | None], BlendFit], chi2: float, rises: float, step: float, furthest: float,
    start: Float | None = None,
) -> tuple[float, bool, Float]:  # fmt: skip
    """Find the end of an interval on one side of the best fit, at which chi-squared has risen by `rises`.

    Returns its distance from the best fit, whether chi-squared does not rise enough within the range of the fit, and
    the parameters there. `refit` returns the best fit at a distance from the best one, from given or extrapolated
    starting parameters. `step` is the first guess of the distance, `furthest` that to the bound of the fit, and `start`
    the first starting parameters.
    """
    inner, outer, root_inner, root_outer = 0.0, np.inf, 0.0, np.inf
    for _ in range(MAX_REFITS):
        at_end = step >= furthest
        step = min(step, furthest)
        fit = refit(step, start)
        if fit.chi2 - chi2 < -BETTER:
            raise BetterFitError(fit.theta)
        root = float(np.sqrt(max(fit.chi2 - chi2, 0.0) / rises))
        if abs(root - 1.0) < CLOSE or (at_end and root < 1.0):
            return step, at_end and root < 1.0 - CLOSE, fit.theta
        start = fit.theta
        if root < 1.0:
            inner, root_inner = step, root
        else:
            outer, root_outer = step, root
        if np.isinf(outer):
            step *= min(1.0 / max(root, 0.25), 4.0) * 1.02
        else:
            # The root of the rise is nearly linear: use regula falsi, but keep away from both ends.
            share = (1.0 - root_inner) / (root_outer - root_inner)
            step = inner + (outer - inner) * float(np.clip(share, 0.08, 0.92))
    return step, root < 1.0 - CLOSE, fit.theta


#: Largest number of steps of a fit, and the change of chi-squared at which it has converged.
STEPS, ENOUGH = 30, 1e-3
#: Frames are averaged if at least this many averages remain per half-width.
FINE = 25
#: Initial damping, and its divisor and factor after successful and failed steps.
DAMPING, EASIER, HARDER = 1e-2, 5.0, 4.0
#: Relative step of numerical derivatives.
DIFFERENCE = 1e-3
#: Largest change of peak, in half-widths, and of log half-width in one step.
LARGEST_STEP = 0.5


@dataclass(frozen=True, eq=False)
class FittedFlares:
    """Fitted flares and standard errors; arrays of shape (n,)."""

    peak_s: Float
    peak_error_s: Float
    amplitude: Float  # relative rise of the photons in the band
    amplitude_error: Float
    half_width_s: Float
    half_width_error_s: Float
    temperature_k: Float  # NaN if the templates have only one temperature
    temperature_error_k: Float
    equivalent_duration_s: Float  # proportional to the energy
    equivalent_duration_error_s: Float
    snr: Float

    @classmethod
    def of(cls, theta: Float, covariance: Float, area: float, snr: Float, *, coloured: bool) -> Self:
        """Return the values and errors of parameters, (n, 4), with covariances (n, 4, 4).

        `area` is the equivalent duration of the shape; flares have a temperature if they are `coloured`.
        """
        sd = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
        both = np.array([1.0, 0.0, 1.0, 0.0])
        sd_duration = np.sqrt(np.maximum(np.einsum("i,nij,j->n", both, covariance, both), 0.0))
        amplitude, width, kelvin = np.exp(theta[:, [AMPLITUDE, WIDTH, KELVIN]]).T
        kelvin = kelvin if coloured else np.full(len(theta), np.nan)
        duration = amplitude * width * area
        return cls(
            theta[:, PEAK], sd[:, PEAK], amplitude, amplitude * sd[:, AMPLITUDE], width, width * sd[:, WIDTH],
            kelvin, kelvin * sd[:, KELVIN], duration, duration * sd_duration, snr,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SingleFlareFit:
    """Least-squares fit of single flares."""

    bank: Bank  # bank of the search, which defines shape, baseline and windows
    templates: Templates  # effect of flares on the sums of a frame

    def run(self, sums: NDArray[Any], frames: SearchedFrames, peak: Float, half_width_s: Float) -> FittedFlares:
        """Fit one flare to each of several light curves: sums of some frames less their mean, (n, n_frame, n_sum).

        Starting points are the peak in s and half-width of the template that detected each flare, (n,).
        """
        log_width = np.log(half_width_s)
        several = max(1, int(np.exp(log_width.min()) / self.bank.frame_s / FINE))
        sums, start_s, variance, curves = self._averaged(several, sums, frames)
        weight, level = self._windows(start_s, peak, np.exp(log_width), variance, curves)
        used = weight.any(axis=0)
        weight, level, start_s = weight[:, used], level[:, used], start_s[used]
        edges = np.column_stack([start_s, start_s + several * self.bank.frame_s])
        y = _remove_baseline(np.asarray(sums[:, used], np.float64), weight, level)

        def inner_products(peak: Float, log_width: Float) -> Float:
            """Return products of shape and derivatives with each other and with the sums, shape (n, 3, 3 + n_sum)."""
            width = np.exp(log_width)
            step = DIFFERENCE * width
            here, later, wider = (
                self.bank.shape.mean_over(edges, p[:, None], w[:, None])
                for p, w in ((peak, width), (peak + step, width), (peak, width * np.exp(DIFFERENCE)))
            )
            three = _remove_baseline(
                np.stack([here, (later - here) / DIFFERENCE, (wider - here) / DIFFERENCE], 2), weight, level
            )
            weighted = three * weight[:, :, None]
            both = np.einsum("nti,ntj->nij", weighted, three), np.einsum("nti,ntk->nik", weighted, y)
            return np.concatenate(both, axis=2)

        return self._climbed(inner_products, peak, log_width)

    def _climbed(self, inner_products: Callable[[Float, Float], Float], peak: Float, log_width: Float) -> FittedFlares:
        """Climb to the largest gains from starting points, by damped Newton steps (Marquardt 1963)."""
        n = peak.size
        products = inner_products(peak, log_width)
        state = np.array([peak, log_width, *self._brightest(products)])
        damping, going = np.full(n, DAMPING), np.ones(n, np.bool_)
        for _ in range(STEPS):
            peak, log_width, log_kelvin, amplitude, gain = state
            information, pull = self._normal(products, amplitude, log_kelvin)
            diagonal = np.einsum("nii->ni", information)
            damped = information + (damping[:, None] * diagonal + 1e-12)[:, :, None] * np.eye(4)
            move = np.linalg.solve(damped, pull[:, :, None])[:, :, 0]
            move = np.where(going[:, None], np.clip(move, -LARGEST_STEP, LARGEST_STEP), 0.0)
            there = peak + move[:, 1] * np.exp(log_width), log_width + move[:, 2]
            tried = inner_products(*there)
            reached = np.array([*there, *self._brightest(tried)])
            better, small = going & (reached[4] > gain), np.abs(reached[4] - gain) < ENOUGH
            state = np.where(better, reached, state)
            products = np.where(better[:, None, None], tried, products)
            damping = np.where(better, damping / EASIER, damping * HARDER)
            going &= ~(small & better) & (damping < 1e6)
            if not going.any():
                break
        peak, log_width, log_kelvin, amplitude, gain = state
        information, _ = self._normal(products, amplitude, log_kelvin)
        covariance, n_free = np.zeros((n, 4, 4)), 4 if self.templates.coloured else 3
        covariance[:, :n_free, :n_free] = np.linalg.pinv(information[:, :n_free, :n_free], hermitian=True)
        # The peak is in half-widths.
        scale = np.where(np.arange(4) == PEAK, np.exp(log_width)[:, None], 1.0)
        covariance *= scale[:, :, None] * scale[:, None, :]
        theta = np.column_stack([np.log(amplitude), peak, log_width, log_kelvin])
        area, snr = self.bank.shape.equivalent_duration, np.sqrt(np.maximum(gain, 0.0))
        return FittedFlares.of(theta, covariance, area, snr, coloured=self.templates.coloured)

    def _brightest(self, products: Float) -> tuple[Float, Float, Float]:
        """Return log temperature, amplitude and fall of chi-squared of the best fits of given shapes."""
        shapes, data = np.split(products, [3], axis=2)
        length = np.sqrt(np.maximum(shapes[:, 0, 0], 1e-300))
        sums = data[:, 0] / length[:, None]
        profile = Profile(self.templates.mean_sums, sums)
        given = np.log(self.templates.temperatures_k[self.templates.chosen[0]])
        x = profile.best().log_k if self.templates.coloured else np.full(len(sums), given)
        *_, face = profile.faces(x)
        best = np.maximum(face.amplitude, 1e-12 * length)
        return x, best / length, (2 * face.amplitude - best) * best * face.power

    def _averaged(
        self, several: int, sums: NDArray[Any], frames: SearchedFrames
    ) -> tuple[NDArray[Any], Float, Float, Float]:
        """Average groups of consecutive frames; incomplete groups at gaps are dropped."""
        start_s, variance, curves = frames.stare.start_s, frames.variance, frames.curves
        if several == 1:
            return sums, start_s, variance, curves
        number = np.rint(start_s / self.bank.frame_s).astype(np.int64)
        _, first, count = np.unique(number // several, return_index=True, return_counts=True)
        rows = first[count == several][:, None] + np.arange(several)
        mean = np.stack([values[rows].mean(axis=1) for values in sums])
        return mean, start_s[rows[:, 0]], variance[rows].mean(axis=1) / several, curves[:, rows].mean(axis=2)

    def _windows(
        self, start_s: Float, peak: Float, width: Float, variance: Float, curves: Float
    ) -> tuple[Float, Float]:
        """Return weights of frames, zero outside the windows, (n, n_frame), and baseline terms, (n, n_frame, p)."""
        lead, tail = np.transpose([self.bank.window(float(one)) for one in width])[:, :, None]
        since = (start_s - peak[:, None]) / self.bank.frame_s
        weight = np.where((since >= -lead - 1) & (since <= tail), 1.0 / variance, 0.0)
        rows = [(since / (lead + tail)) ** power for power in self.bank.baseline.powers]
        rows += [np.broadcast_to(curve, since.shape) for curve in curves]
        # Orthonormal in each window, so that a projection is a sum of products.
        root = np.sqrt(weight)[:, :, None]
        basis = np.linalg.qr(root * np.reshape(rows, (len(rows), *since.shape)).transpose(1, 2, 0))[0]
        return weight, np.divide(basis, root, out=np.zeros_like(basis), where=root > 0)

    def _normal(self, products: Float, amplitude: Float, log_kelvin: Float) -> tuple[Float, Float]:
        """Return information and gradient for log amplitude, peak in half-widths, log half-width, log temperature."""
        shapes, data = np.split(products, [3], axis=2)
        spline = self.templates.mean_sums.spline
        r, dr = spline(log_kelvin), spline(log_kelvin, 1) * self.templates.coloured
        # Each derivative is a product of one in time and one in the sums.
        time, sums = np.array([0, 1, 2, 0]), np.stack([r, r, r, dr], axis=1)
        inner = np.einsum("nik,njk->nij", sums, sums)
        information = amplitude[:, None, None] ** 2 * shapes[:, time][:, :, time] * inner
        left = data[:, time] - amplitude[:, None, None] * shapes[:, time, 0][:, :, None] * r[:, None]
        pull = amplitude[:, None] * np.einsum("nik,nik->ni", left, sums)
        # Parameters without information keep their values.
        blind = np.einsum("nii->ni", information) <= 0
        information[blind] = 0
        np.einsum("nii->ni", information)[blind] = 1.0
        return information, pull


def _remove_baseline(values: Float, weight: Float, level: Float) -> Float:
    """Subtract from values (n, n_frame, k) their weighted projection on orthonormal terms (n, n_frame, p)."""
    amounts = np.einsum("ntp,ntk->npk", level * weight[:, :, None], values, optimize=True)
    return np.asarray(values - np.einsum("ntp,npk->ntk", level, amounts, optimize=True))
