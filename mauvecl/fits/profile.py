"""Fits of weighted sums by profile likelihoods, with amplitudes of any sign or of at least zero.

At a given temperature everything else is linear, so that the minimum of chi-squared over the amplitudes is a closed
form, and a function of one variable remains. It gives the profile likelihood of a quantity that is linear in the
amplitudes: if chi-squared may rise by c, of which the temperature alone takes delta, the quantity may lie within
sqrt(c - delta) standard deviations of its best value at that temperature. The interval is the hull over temperatures.
With an unknown factor on all light, the quantity is a ratio at that temperature; see `flare_model`.

Near the boundary of flares without light, amplitudes are at least zero. The light of a blackbody, a Balmer continuum or
a line is never negative. At a given temperature, the best fit with non-negative amplitudes is the unbounded fit of a
face of the orthant, a subset of the components. The same holds for the ends of a profile interval, because the
likelihood is convex. All faces are tried, and those with a negative amplitude are rejected. Only the blackbody depends
on the temperature, so each face has constant matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache, cached_property, lru_cache
from itertools import chain, combinations
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.flare_model import Ratio, derived_values

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

    from mauvecl.fits.flare_model import Derived, FlareModel, MeanSums, Reduction

Float = NDArray[np.float64]
T = TypeVar("T")

#: Steps of the search for the end of an interval.
STEPS = 12
#: Temperatures within an interval at which derived quantities are computed.
SAMPLES = 33
#: Second over first order of a quantity's change within the standard error of the temperature, above which Wilks'
#: thresholds are replaced: where it is 0.1, 95 % intervals with the thresholds as they are cover up to 96 %.
CURVED = 0.03
#: Number of ends that are simulated at once.
ENDS_AT_ONCE = 32
#: Steps of simulated sums along the gradient of a quantity, their reach beyond the threshold, and the width over which
#: ratios are smoothed, in standard errors.
ALONG, BEYOND, SMOOTH = 0.8, 2.0, 0.3
#: Number of temperatures that simulated fits try, and their reach in standard errors.
TRIED, REACH = 25, 6.0
#: Steps of Newton's method for a threshold.
NEWTON = 3


def remembering(function: Callable[[Float], T]) -> Callable[[Float], T]:
    """Return a function that keeps its last results, since fits ask for several at the same parameters in turn."""

    @lru_cache(maxsize=2)
    def of_bytes(parameters: bytes) -> T:
        return function(np.frombuffer(parameters))

    return lambda parameters: of_bytes(parameters.tobytes())


@dataclass(frozen=True, eq=False)
class BestFit:
    """Best fits of n frames."""

    log_k: Float  # shape (n,)
    linear: Float  # shape (n, n_linear); amplitudes
    gain: Float  # shape (n,); chi-squared of the sums without a flare less that of the fit

    def replaced(self, rows: NDArray[np.intp], others: BestFit) -> BestFit:
        """Return the fits with those of some frames replaced."""
        every = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, values in every.items():
            values[rows] = getattr(others, name)
        return BestFit(**every)


class Profile:
    """Profile likelihood of the temperature for the sums of some frames."""

    def __init__(self, reduction: MeanSums, sums: Float, light: Float | None = None) -> None:
        """Take the sums of frames, (n, n_sum), and those of the factor on light, (n,), if it is unknown."""
        self.reduction, self.sums, self.light = reduction, sums, light
        self._basis, self._inverse = reduction.basis
        self.along = sums @ self._basis.T
        self.rest = sums - self.along @ self._basis
        #: Decrease of chi-squared by the fixed components alone, shape (n,).
        self.base = np.vecdot(self.along, self.along)
        self.nodes = reduction.log_k
        self.hot = reduction.spline

    def rows(self, rows: NDArray[np.intp]) -> tuple[MeanSums, Float, Float | None]:
        """Return what makes a profile of some of the frames."""
        return self.reduction, self.sums[rows], None if self.light is None else self.light[rows]

    def parts(self, log_k: Float) -> tuple[Float, Float, Float]:
        """Return the blackbody's amplitude without bounds, its variance, and its sums, at temperatures (n, ...)."""
        hot = self.hot(log_k)
        free = self.free(hot)
        power = np.vecdot(free, free)
        return np.vecdot(free, _for_samples(self.rest, log_k)) / power, 1.0 / power, hot

    def products(self, log_k: Float) -> Products:
        """Return the inner products at temperatures (n, ...), or (1, ...) if common to all frames."""
        hot, fixed = self.hot(log_k), self.reduction.fixed
        if log_k.shape[0] == 1:
            along = np.tensordot(self.sums, hot[0], (1, -1))
        else:
            along = np.einsum("n...k,nk->n...", hot, self.sums)
        return Products(
            along,
            np.einsum("...k,...k->...", hot, hot),
            np.moveaxis(hot @ fixed.T, -1, 0),
            (fixed @ self.sums.T).reshape(len(fixed), len(self.sums), *(1,) * (log_k.ndim - 1)),
            fixed @ fixed.T,
        )

    def free(self, hot: Float) -> Float:
        """Return sums less their projections on the fixed components."""
        return np.asarray(hot - (hot @ self._basis.T) @ self._basis)

    def gain(self, log_k: Float) -> Float:
        """Return the decrease of chi-squared by a flare of temperatures (n, ...) with a positive blackbody."""
        amplitude, variance, _ = self.parts(log_k)
        return np.asarray(_for_samples(self.base, log_k) + np.maximum(amplitude, 0.0) ** 2 / variance)

    def gain_at_nodes(self) -> Float:
        """Return `gain` at the temperatures of the model, shape (n, n_node)."""
        product = self.rest @ self.reduction.directions[0].T
        return np.asarray(np.maximum(product, 0.0) ** 2 + self.base[:, None])

    def linear(self, log_k: Float, amplitude: Float, hot: Float) -> Float:
        """Return all amplitudes, shape (n, ..., n_linear), for a given amplitude of the blackbody."""
        if not len(self._basis):
            return amplitude[..., None]
        others = (_for_samples(self.along, log_k) - amplitude[..., None] * (hot @ self._basis.T)) @ self._inverse.T
        return np.concatenate([amplitude[..., None], others], axis=-1)

    def factor(self, log_k: Float, linear: Float) -> Float:
        """Return the best factor on all light, (n, ...), at temperatures and amplitudes; 1 if it is known."""
        if self.reduction.light is None or self.light is None:
            return np.ones(log_k.shape)
        return self.reduction.light.estimate(self.light, log_k, linear)

    def best(self, at_nodes: Float | None = None) -> BestFit:
        """Return the best fit of each frame.

        The gain is the squared product of the sums with a unit vector, which is a cubic polynomial of the temperature
        between two nodes, so that its maximum has a closed form.
        """
        units, cubics = self.reduction.directions
        node = np.argmax(np.maximum(self.rest @ units.T, 0.0) if at_nodes is None else at_nodes, axis=1)
        interval = np.minimum(node, self.nodes.size - 2)
        falling = np.vecdot(self.rest, cubics[interval, 2]) < 0.0
        interval = np.where(falling, np.maximum(node - 1, 0), interval)
        c = np.einsum("npk,nk->pn", cubics[interval], self.rest)
        span = self.nodes[interval + 1] - self.nodes[interval]
        with np.errstate(divide="ignore", invalid="ignore"):
            top = c[2] / (np.sqrt(c[1] ** 2 - 3 * c[0] * c[2]) - c[1])
        # Otherwise the best node is an end of the model's temperatures, or no light is found.
        return self.solution(np.where((top >= 0.0) & (top <= span), self.nodes[interval] + top, self.nodes[node]))

    def solution(self, log_k: Float) -> BestFit:
        """Return the best fits at temperatures (n,)."""
        amplitude, variance, hot = self.parts(log_k)
        positive = np.maximum(amplitude, 0.0)
        return BestFit(log_k, self.linear(log_k, positive, hot), self.base + positive**2 / variance)

    def ends(self, best: BestFit, at_nodes: Float, allowed: float) -> tuple[Float, Float]:
        """Return the log temperatures at which chi-squared has risen by `allowed`, low and high, each (n,).

        An end is NaN if chi-squared does not rise that far within the model's temperatures.
        """
        inside = best.gain[:, None] - at_nodes <= allowed
        number = np.arange(self.nodes.size)
        lowest = np.where(inside, number, self.nodes.size).min(axis=1)
        highest = np.where(inside, number, -1).max(axis=1)
        low, high = np.full((2, *best.log_k.shape), np.nan)
        for out, outermost, side in ((low, lowest, -1), (high, highest, 1)):
            known = (outermost >= 0) & (outermost < self.nodes.size)
            start = np.where(known, self.nodes[np.clip(outermost, 0, self.nodes.size - 1)], best.log_k)
            start = np.minimum(start, best.log_k) if side < 0 else np.maximum(start, best.log_k)
            beyond = (
                np.searchsorted(self.nodes, start, side="left") - 1
                if side < 0
                else np.searchsorted(self.nodes, start, side="right")
            )
            closed = (beyond >= 0) & (beyond < self.nodes.size)
            stop = self.nodes[np.clip(beyond, 0, self.nodes.size - 1)]
            crossing = self._crossing(best.gain, allowed, start, np.where(closed, stop, start))
            out[:] = np.where(closed, crossing, np.nan)
        return low, high

    def _crossing(self, gain: Float, allowed: float, inner: Float, outer: Float) -> Float:
        """Return where chi-squared has risen by `allowed` between two temperatures (Illinois method on its root)."""
        root = np.sqrt(allowed)

        def over(x: Float) -> Float:
            return np.asarray(np.sqrt(np.maximum(gain - self.gain(x), 0.0)) - root)

        a, b = inner, outer
        fa, fb = over(a), over(b)
        x = b
        for _ in range(STEPS):
            spread = fb - fa
            x = np.where(np.abs(spread) > 1e-14, b - fb * (b - a) / np.where(spread == 0.0, 1.0, spread), b)
            fx = over(x)
            crossed = fx * fb < 0.0
            fa = np.where(crossed, fb, 0.5 * fa)
            a = np.where(crossed, b, a)
            b, fb = x, fx
        return x


def _for_samples(values: Float, log_k: Float) -> Float:
    """Return values of frames, shape (n, k) or (n,), with axes for samples of temperatures, (n, ...)."""
    return np.expand_dims(values, tuple(range(1, log_k.ndim)))


def intervals(
    model: FlareModel, profile: Profile, best: BestFit, at_nodes: Float, allowed: float
) -> tuple[Float, Float]:
    """Return the profile-likelihood intervals of a model's quantities, low and high, each (n, n_derived).

    Ends are infinite if the data give no limit within the model's temperatures.
    """
    low, high = profile.ends(best, at_nodes, allowed)
    x, closed = temperature_samples(profile, low, high), ~np.isnan(low) & ~np.isnan(high)
    amplitude, variance, hot = profile.parts(x)
    spent = (best.gain - profile.base)[:, None] - amplitude**2 / variance
    samples = _Samples(profile, x, profile.linear(x, amplitude, hot), variance, hot, allowed - spent, allowed, closed)

    def ends(derived: Derived, spline: CubicSpline) -> tuple[Float, Float]:
        if derived.ratio is None:
            return samples.interval(spline)
        return _ratio_interval(profile.products(x), spline(x), best.gain - allowed)

    return ends_of_quantities(model, low, high, ends)


def ends_of_quantities(
    model: FlareModel, log_low: Float, log_high: Float, ends: Callable[[Derived, CubicSpline], tuple[Float, Float]]
) -> tuple[Float, Float]:
    """Return the ends of intervals of a model's quantities, low and high, (n, n_derived); multiples share theirs.

    `log_low` and `log_high` are the ends of the log temperature, NaN without a limit; `ends` returns those of others.
    """
    kelvin = (
        np.where(np.isnan(log_low), -np.inf, np.exp(log_low)),
        np.where(np.isnan(log_high), np.inf, np.exp(log_high)),
    )
    columns: list[tuple[Float, Float]] = []
    for derived, spline, (first, times) in zip(model.derived, model.splines, model.multiples, strict=True):
        if first < len(columns):
            low, high = columns[first]
        elif spline is not None:
            low, high = ends(derived, spline)
        else:
            low, high = kelvin if derived.held is None else np.full((2, log_low.size), derived.held)
        # Light that contradicts every factor above zero limits nothing.
        none = low > high
        low, high = np.where(none, -np.inf, low), np.where(none, np.inf, high)
        columns.append((times * low, times * high))
    return np.column_stack([low for low, _ in columns]), np.column_stack([high for _, high in columns])


def temperature_samples(profile: Profile, low: Float, high: Float) -> Float:
    """Return log temperatures between the ends of intervals, or those of the model if undefined, (n, n_sample)."""
    first = np.where(np.isnan(low), profile.nodes[0], low)
    last = np.where(np.isnan(high), profile.nodes[-1], high)
    # Samples are even in the angle of a sine, because the remaining rise goes to zero at the ends like a root.
    angle = np.linspace(-np.pi / 2, np.pi / 2, SAMPLES)
    return (first + last)[:, None] / 2 + (last - first)[:, None] / 2 * np.sin(angle)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Fits without bounds at temperatures within intervals, arrays of shape (n, n_sample, ...)."""

    profile: Profile
    log_k: Float
    linear: Float  # all amplitudes
    variance: Float  # of the blackbody's amplitude
    hot: Float  # its sums
    left: Float  # rise of chi-squared that the temperature leaves to amplitudes
    allowed: float  # rise of chi-squared at the ends
    closed: NDArray[np.bool_]  # whether the temperature has two ends, shape (n,)

    def interval(self, spline: CubicSpline) -> tuple[Float, Float]:
        """Return the ends of a sum of amplitudes, of which `spline` holds the factors."""
        ratio = ratio_at(self.profile, spline, self.log_k, self.linear, self.variance, self.hot)
        half, light, left = SAMPLES // 2, self.profile.reduction.light, self.left
        # The ratio is straight where the recorded quantity less the ratio times the factor is.
        estimate = ratio.top if light is None else ratio.top - ratio.value[:, half, None] * ratio.bottom
        outside = left < 0.0
        outside[:, [0, -1]] = False  # rounding decides at the ends themselves
        ends = [_hull(ratio.end(left, sign), outside, sign)[0] for sign in (-1.0, 1.0)]
        if light is not None and light.prior.size:
            change = light.change(ratio.value[:, half], ratio.bottom[:, half], ends[1] - ends[0], self.allowed)
            left = left + change[:, None]
            outside |= left < 0.0
            ends = [_hull(ratio.end(left, sign), outside, sign)[0] for sign in (-1.0, 1.0)]
        bend = np.abs(estimate[:, 0] + estimate[:, -1] - 2 * estimate[:, half])
        # Simulated fits need the error of the temperature, which its interval gives if it has both ends.
        wide = (ends[1] - ends[0]) * ratio.bottom[:, half]
        bent = np.flatnonzero(self.closed & np.isfinite(wide) & (bend > CURVED * np.sqrt(self.allowed) * wide))
        if bent.size:
            for end, sign in zip(ends, (-1.0, 1.0), strict=True):
                end[bent] = self._bent_end(spline, ratio.rows(bent), left[bent], sign, bent)
        return ends[0], ends[1]

    def _bent_end(self, spline: CubicSpline, ratio: Ratio, left: Float, sign: float, rows: NDArray[np.intp]) -> Float:
        """Return the ends in some rows, whose quantity bends, by simulated thresholds."""
        light, allowed, x = self.profile.reduction.light, self.allowed, self.log_k[rows]
        which = _hull(ratio.end(left, sign), left < 0.0, sign)[1]
        place = np.arange(rows.size), which
        # Share of the variance that is not the factor's; the factor is straight.
        share = np.ones(rows.size)
        if light is not None:
            middle, nodes = ratio.value[:, SAMPLES // 2], self.profile.nodes
            factors = spline(nodes) + float(np.median(middle)) * light.weights_of(nodes)
            spline = scipy.interpolate.CubicSpline(nodes, factors)
            total = ratio.variance_at(middle[:, None])[place]
            share = np.clip(1.0 - light.scale**-2.0 * middle**2 / total, 0.0, 1.0)
        moved = sign * np.sqrt(np.maximum(left[place], 0.0) * share)
        error = (x[:, -1] - x[:, 0]) / np.sqrt(4 * allowed)
        simulated = _Thresholds(self.profile, spline).at(rows, x[place], moved, error, allowed)
        left = left + (share * (simulated - allowed))[:, None]
        return _hull(ratio.end(left, sign), left < 0.0, sign)[0]


def ratio_at(profile: Profile, spline: CubicSpline, log_k: Float, linear: Float, variance: Float, hot: Float) -> Ratio:
    """Return a sum of the amplitudes at temperatures (n, n_sample), over the factor on all light.

    `spline` holds the factors of the amplitudes over log temperature; `variance` and `hot` are those of
    `Profile.parts`.
    """
    basis, inverse = profile.reduction.basis

    def parts(factors: Float) -> tuple[Float, Float]:
        """Return the independent parts of a sum of amplitudes: those of the blackbody and of the others."""
        if not len(basis):
            return factors[..., 0], factors[..., 1:]
        others = factors[..., 1:] @ inverse
        return factors[..., 0] - np.vecdot(others, hot @ basis.T), others

    def covariance(slopes: tuple[Float, Float], other: tuple[Float, Float]) -> Float:
        return np.asarray(slopes[0] * other[0] * variance + np.vecdot(slopes[1], other[1]))

    factors = spline(log_k)
    value, own = np.vecdot(factors, linear), parts(factors)
    light = profile.reduction.light
    if light is None:
        return Ratio(value, np.ones_like(value), covariance(own, own), np.zeros_like(value), np.zeros_like(value))
    dims = parts(light.weights_of(log_k))
    bottom_variance = covariance(dims, dims) + light.scale**-2.0
    return Ratio(value, profile.factor(log_k, linear), covariance(own, own), bottom_variance, -covariance(own, dims))


def _hull(reached: Float, outside: NDArray[np.bool_], sign: float) -> tuple[Float, NDArray[np.intp]]:
    """Return the lowest or highest value that samples (n, n_sample) reach inside, and the sample."""
    reached = np.where(outside, sign * -np.inf, reached)
    which = np.maximum if sign > 0 else np.minimum
    return extreme(reached, which), np.argmax(sign * reached, axis=1)


class _Thresholds:
    """Thresholds of the likelihood ratio of a quantity that bends within the error of the temperature.

    The ratio has one degree of freedom only where the quantity is straight. Elsewhere a threshold is the quantile of
    the ratio in fits to simulated sums, with the quantity held at an end of its interval and free.
    """

    def __init__(self, profile: Profile, spline: CubicSpline) -> None:
        self._profile, self._spline = profile, spline
        self._units = profile.reduction.directions[0]
        there = _held_direction(profile.reduction, spline, profile.nodes)
        length = np.linalg.norm(there, axis=1)
        self._held, self._scale = there / length[:, None], 1.0 / length

    def at(self, rows: NDArray[np.intp], x: Float, moved: Float, error: Float, allowed: float) -> Float:
        """Return the thresholds at ends, (n,), below which ratios are as probable as below Wilks' `allowed`.

        Simulated sums have even distances along the gradient of the quantity, weighted by their probability, and the
        same noise for all ends in the other directions in which the mean sums change. `x` is the log temperature at the
        end, `moved` the distance from the best value there in standard errors, and `error` the standard error of the
        log temperature.
        """
        profile, reduction = self._profile, self._profile.reduction
        there, (basis, inverse) = _held_direction(reduction, self._spline, x), reduction.basis
        # The fitted sums at the end, with the quantity moved there.
        hot = profile.hot(x)
        body = profile.free(hot)
        body /= np.linalg.norm(body, axis=1)[:, None]
        mean = profile.along[rows] @ basis + np.vecdot(profile.rest[rows], body)[:, None] * body
        mean += (moved / np.linalg.norm(there, axis=1))[:, None] * there
        amplitude = np.vecdot(mean, body) / np.vecdot(hot, body)
        others = (mean @ basis.T - amplitude[:, None] * (hot @ basis.T)) @ inverse.T
        # The gradient of the quantity: that at this temperature, and along the change of the mean with temperature.
        slope = reduction.spline(x, 1)
        change = profile.free(slope)
        change -= np.vecdot(change, body)[:, None] * body
        steeper = np.vecdot(self._spline(x, 1), np.column_stack([amplitude, others]))
        steeper -= amplitude * np.vecdot(there, slope)
        power = amplitude * np.vecdot(change, change)
        normal = there + np.divide(steeper, power, out=np.zeros_like(power), where=power > 0.0)[:, None] * change
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        value = np.vecdot(mean, there)
        fixed = np.broadcast_to(reduction.fixed[:, None], (len(reduction.fixed), *there.shape))
        changes = np.linalg.qr(np.dstack([slope, hot, *fixed, reduction.spline(x, 2)]))[0]
        changes = _orthogonal_to(normal, changes)
        sums = np.concatenate([mean[:, None], normal[:, None], changes.transpose(0, 2, 1)], axis=1)
        noise, z = _noise(changes.shape[2]), np.sqrt(allowed)
        distances = ALONG * np.arange(0.5, (z + BEYOND) / ALONG)
        distances = np.concatenate([-distances, distances])
        out = np.repeat(distances, len(noise))
        draws = np.column_stack([np.ones(out.size), out, np.tile(noise, (distances.size, 1))])
        tried = _nodes_around(profile.nodes, x, error)
        root = np.empty((rows.size, out.size))
        for start in range(0, rows.size, ENDS_AT_ONCE):
            some = slice(start, start + ENDS_AT_ONCE)
            own, node = sums[some], tried[some]
            light = np.maximum(draws @ (own @ self._units[node].transpose(0, 2, 1)), 0.0)
            away = own @ self._held[node].transpose(0, 2, 1)
            away[:, 0] -= value[some, None] * self._scale[node]
            root[some] = np.sqrt(_likelihood_ratio(light, draws @ away))
        return _as_probable(root, out, z) ** 2


def _orthogonal_to(normal: Float, directions: Float) -> Float:
    """Return orthonormal directions of a space, (n, k, n_direction), less a unit vector in it, (n, k)."""
    along = normal[:, None] @ directions
    # The largest component comes first, so that rounding does not decide on the sign of the reflection.
    order = (np.abs(along).argmax(axis=2)[:, :, None] + np.arange(along.shape[2])) % along.shape[2]
    along, directions = (np.take_along_axis(values, order, axis=2) for values in (along, directions))
    return np.asarray(directions @ np.linalg.qr(along.transpose(0, 2, 1), mode="complete")[0][:, :, 1:])


def _nodes_around(nodes: Float, x: Float, error: Float) -> NDArray[np.intp]:
    """Return the numbers of evenly spaced nodes around log temperatures with some errors, shape (n, TRIED)."""
    last = nodes.size - 1
    step = (nodes[-1] - nodes[0]) / last
    stride = np.clip(2 * REACH * error / step / (TRIED - 1), 1, last // (TRIED - 1)).astype(np.intp)
    first = np.rint((x - nodes[0]) / step).astype(np.intp) - stride * (TRIED // 2)
    return np.asarray(np.clip(first, 0, last - stride * (TRIED - 1))[:, None] + stride[:, None] * np.arange(TRIED))


def _as_probable(root: Float, out: Float, z: float) -> Float:
    """Return the values, (n,), below which roots of ratios are as probable as |distance| is below `z`.

    Shares of fits with a smaller ratio are smoothed alike for the simulated fits and where the quantity is straight.
    `root`, (n, n_fit), holds the roots of the likelihood ratios of simulated fits, and `out`, (n_fit,), their distances
    along the gradient of the quantity in standard errors.
    """
    weights = np.exp(-(out**2) / 2)
    level = weights @ scipy.special.ndtr((z - np.abs(out)) / SMOOTH)
    end = np.full(len(root), z)
    for _ in range(NEWTON):
        below = (end[:, None] - root) / SMOOTH
        density = np.exp(-(below**2) / 2) @ weights / (SMOOTH * np.sqrt(2 * np.pi))
        missing = level - scipy.special.ndtr(below) @ weights
        # Without a ratio nearby the value moves by the longest step.
        far = SMOOTH * np.sign(missing)
        end += np.clip(np.divide(missing, density, out=far, where=density > 1e-9), -SMOOTH, SMOOTH)
    return end


def _parabola(samples: Float, middle: NDArray[np.intp]) -> tuple[Float, Float, Float]:
    """Return value, slope and second derivative of a parabola through three samples, per step, at the middle one."""
    before, here, after = (samples.ravel().take(middle + side) for side in (-1, 0, 1))
    return here, (after - before) / 2, before + after - 2 * here


def _likelihood_ratio(light: Float, away: Float) -> Float:
    """Return the maximum of light^2 less that of light^2 - away^2 over samples (..., n_sample)."""
    n = light.shape[-1]
    first = np.arange(0, light.size, n).reshape(light.shape[:-1])
    at_best, held = (np.clip(peak.argmax(axis=-1), 1, n - 2) + first for peak in (light, light**2 - away**2))
    value, slope, bend = _parabola(light, at_best)
    t = np.clip(np.divide(-slope, bend, out=np.zeros_like(slope), where=bend < 0.0), -1.0, 1.0)
    free = value + t * (slope + t * bend / 2)
    # One step of Newton's method from the best sample.
    (p0, p1, p2), (h0, h1, h2) = _parabola(light, held), _parabola(away, held)
    bend = h1**2 + h0 * h2 - p1**2 - p0 * p2
    t = np.clip(np.divide(p0 * p1 - h0 * h1, bend, out=np.zeros_like(bend), where=bend > 0.0), -1.0, 1.0)
    p0, h0 = p0 + t * (p1 + t * p2 / 2), h0 + t * (h1 + t * h2 / 2)
    return np.asarray(np.maximum(free**2 - p0**2 + h0**2, 0.0))


def _held_direction(reduction: MeanSums, spline: CubicSpline, log_k: Float) -> Float:
    """Return directions at temperatures (n,) whose product with the sums is a quantity's best value, (n, n_sum)."""
    (basis, inverse), hot, factors = reduction.basis, reduction.spline(log_k), spline(log_k)
    along = hot @ basis.T
    body = hot - along @ basis
    others = factors[:, 1:] @ inverse
    slope = factors[:, 0] - np.vecdot(others, along)
    return np.asarray((slope / np.vecdot(body, body))[:, None] * body + others @ basis)


@cache
def _noise(n: int) -> Float:
    """Return a cubature of normal noise in n dimensions, shape (2 n, n), exact for polynomials of third degree."""
    half = np.sqrt(n) * scipy.stats.ortho_group.rvs(n, random_state=28)
    return np.concatenate([half, -half])


def extreme(values: Float, which: Callable[..., Float]) -> Float:
    """Return the smallest or largest of samples (n, n_sample), by a parabola through the three outermost."""
    sign = 1.0 if which is np.maximum else -1.0
    signed = sign * values
    k = np.argmax(signed, axis=1)
    rows = np.arange(len(values))
    middle = signed[rows, k]
    inner = (k > 0) & (k < values.shape[1] - 1)
    before, after = signed[rows, np.maximum(k - 1, 0)], signed[rows, np.minimum(k + 1, values.shape[1] - 1)]
    usable = inner & np.isfinite(before) & np.isfinite(after)
    with np.errstate(invalid="ignore"):
        bend = np.where(usable, 2 * middle - before - after, 1.0)
        rise = np.where(usable & (bend > 0), (after - before) ** 2 / (8 * np.where(bend > 0, bend, 1.0)), 0.0)
    return np.asarray(sign * (middle + rise))


def _ratio_interval(products: Products, per: Float, least_gain: Float) -> tuple[Float, Float]:
    """Return the interval of 1 + per x (amplitude 1) / (amplitude 0): Fieller's at each temperature, then the hull."""
    yt, yf, tt, tf, ff, explained, _ = products.less_lines(list(range(1, len(products.gram))), per)
    least = least_gain[:, None] - explained
    # (yt + r yf)^2 >= least |t + r f|^2, where r is the jump less one and the blackbody is positive.
    a, b, c = yf**2 - least * ff, yt * yf - least * tf, yt**2 - least * tt
    inside = b**2 - a * c
    root = np.sqrt(np.maximum(inside, 0.0))
    bounded = (a < 0.0) & (inside >= -1e-9 * b**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-b + root) / a, (-b - root) / a
    smaller, larger = np.fmin(first, second), np.fmax(first, second)
    # Without a bound, all light may be recombination, and every jump above the larger root is allowed.
    open_low = (a >= 0.0) & (inside < 0.0)
    low = np.where(bounded, smaller, np.where(a >= 0.0, np.where(open_low, -np.inf, larger), np.inf))
    high = np.where(bounded, larger, np.where(a >= 0.0, np.inf, -np.inf))
    return 1.0 + extreme(low, np.minimum), 1.0 + extreme(high, np.maximum)


@dataclass(frozen=True, eq=False)
class Slopes:
    """Derivatives with respect to a parameter of n fits."""

    sums: Float  # shape (n, n_sum)
    quantities: Float  # shape (n, n_derived), as they are recorded
    light: Float  # shape (n,); of the sum of the factor on light


def covariance(
    model: FlareModel, reduction: MeanSums, best: BestFit, factor: Float, other: Slopes | None = None
) -> Float:
    """Return the covariance of quantities from the Fisher information at the fit, (n, n_derived, n_derived).

    The parameters are the amplitudes as they are recorded, the log temperature, an `other` one, and the factor on all
    light if it is unknown. The result is NaN if a flare adds no light, or if its parameters are degenerate.
    """
    log_k, linear, light = best.log_k, best.linear, reduction.light
    fixed = np.broadcast_to(reduction.fixed, (log_k.size, *reduction.fixed.shape))
    columns = [reduction.spline(log_k)[:, None], fixed, (linear[:, :1] * reduction.spline(log_k, 1))[:, None]]
    gradients = [gradient_of(model, log_k, linear)]
    if other is not None:
        columns.append(other.sums[:, None])
        gradients.append(other.quantities[:, :, None])
    jacobian, gradient = np.concatenate(columns, axis=1), np.concatenate(gradients, axis=2)
    information = jacobian @ jacobian.transpose(0, 2, 1)
    scale = np.sqrt(np.einsum("nii->ni", information))
    good = (scale > 0.0).all(axis=1)
    scale[~good] = 1.0
    normal = information / scale[:, :, None] / scale[:, None, :]
    good &= np.linalg.eigvalsh(normal)[:, 0] > 1e-13
    normal[~good] = np.eye(normal.shape[1])
    inverse = np.linalg.inv(normal) / scale[:, :, None] / scale[:, None, :]
    inverse[~good] = np.nan
    if light is None:
        return np.asarray(gradient @ inverse @ gradient.transpose(0, 2, 1))
    over = np.where(factor > 0.0, factor, np.nan)
    which, _ = model.sums
    gradient[:, which] /= over[:, None, None]
    # The best factor follows the amplitudes and the temperature, and scatters about that.
    by_factor = np.where(which, -derived_values(model, log_k, linear, over) / over[:, None], 0.0)
    slopes = [linear[:, 0] * light.spline(log_k, 1)] + ([] if other is None else [other.light])
    follows = -np.column_stack([light.weights_of(log_k), *(slope / light.scale for slope in slopes)])
    gradient += by_factor[:, :, None] * follows[:, None, :]
    own = by_factor[:, :, None] * by_factor[:, None, :] / light.scale**2
    return np.asarray(gradient @ inverse @ gradient.transpose(0, 2, 1) + own)


def gradient_of(model: FlareModel, log_k: Float, linear: Float) -> Float:
    """Return derivatives with respect to amplitudes and log temperature, (n, n_derived, n_linear + 1)."""
    n, m = linear.shape
    gradient = np.zeros((n, len(model.derived), m + 1))
    which, spline = model.sums
    gradient[:, which, :m] = spline(log_k)
    gradient[:, which, m] = np.einsum("nql,nl->nq", spline(log_k, 1), linear)
    for q in np.flatnonzero(~which):
        ratio = model.splines[q]
        if ratio is None:
            gradient[:, q, m] = np.exp(log_k) if model.derived[q].held is None else 0.0
            continue
        amplitude = np.where(linear[:, 0] > 0, linear[:, 0], np.nan)
        gradient[:, q, 0] = -ratio(log_k) * linear[:, 1] / amplitude**2
        gradient[:, q, 1] = ratio(log_k) / amplitude
        gradient[:, q, m] = ratio(log_k, 1) * linear[:, 1] / amplitude
    return gradient


#: Number of parabolas through three temperatures that refine the best node, and the factor by which they narrow.
REFINEMENTS, NARROWER = 3, 8.0
#: The search for the best temperature starts from every `COARSE`-th node of the model.
COARSE = 4
#: Share of a refinement's step above which a best temperature still moves; distance in nodes at which the gain beside
#: it is then tried, its least rise that counts, and the number of narrowing grids that follow it.
SETTLED, BESIDE, LEAST_RISE, CLIMBS = 0.5, 0.05, 1e-3, 4
#: Amplitudes below minus this many standard errors are negative; smaller deviations are due to rounding.
ROUNDING = 1e-9


def _inverse(matrix: Float) -> Float:
    """Return the inverse of a matrix; most have one element, for which the general way takes ten times as long."""
    return 1.0 / matrix if len(matrix) == 1 else np.asarray(np.linalg.inv(matrix))


def _product(matrix: Float, values: Float) -> Float:
    """Return the product of a matrix (k, k) with values (k, ...)."""
    return matrix[0, 0] * values if len(matrix) == 1 else np.tensordot(matrix, values, 1)


@dataclass(frozen=True, eq=False)
class Products:
    """Inner products of components and sums at temperatures (n, ...), or (1, ...) if common to all frames."""

    along: Float  # of the blackbody with the sums, shape (n, ...)
    power: Float  # of the blackbody with itself, shape (n or 1, ...)
    cross: Float  # of the blackbody with the fixed components, shape (n_fixed, n or 1, ...)
    fixed: Float  # of the fixed components with the sums, shape (n_fixed, n, 1, ...)
    gram: Float  # of the fixed components with each other, shape (n_fixed, n_fixed)

    def face(self, some: tuple[int, ...], hot: bool) -> Face:
        """Fit some of the fixed components and, if `hot`, the blackbody, without bounds."""
        which = list(some)
        inverse = _inverse(self.gram[which][:, which])
        alone, share = (_product(inverse, each[which]) for each in (self.fixed, self.cross))
        gain = np.sum(self.fixed[which] * alone, axis=0)
        power = self.power - np.sum(self.cross[which] * share, axis=0)
        if not hot:
            return Face(some, inverse, alone, gain, None, power, share)
        amplitude = (self.along - np.sum(self.cross[which] * alone, axis=0)) / power
        return Face(some, inverse, alone - amplitude * share, gain + amplitude**2 * power, amplitude, power, share)

    def less_lines(self, lines: list[int], per: Float) -> tuple[Float, Float, Float, Float, Float, Float, list[Float]]:
        """Return products of sums y, blackbody t and recombination f less their projections on some lines.

        Recombination, the fixed component 0, is divided by `per`. After yt, yf, tt, tf and ff follow the decrease of
        chi-squared by the lines, and the lines' amplitudes in each of y, t and f.
        """
        inverse = np.linalg.inv(self.gram[np.ix_(lines, lines)])
        y, t, f = self.fixed[lines], self.cross[lines], self.gram[lines, 0].reshape(-1, 1, 1) / per
        by = [np.tensordot(inverse, each, 1) for each in (y, t, f)]

        def less(whole: Float, one: Float, other: Float) -> Float:
            return np.asarray(whole - np.sum(one * other, axis=0))

        return (
            less(self.along, t, by[0]), less(self.fixed[0] / per, f, by[0]), less(self.power, t, by[1]),
            less(self.cross[0] / per, f, by[1]), less(self.gram[0, 0] / per**2, f, by[2]),
            np.sum(y * by[0], axis=0), by,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Face:
    """Unbounded fit of a subset of the components."""

    some: tuple[int, ...]  # fixed components
    inverse: Float  # of their information, shape (n_some, n_some)
    others: Float  # their amplitudes, shape (n_some, n, ...)
    gain: Float  # decrease of chi-squared by the components, shape (n, ...)
    amplitude: Float | None  # of the blackbody, shape (n, ...); None without it
    power: Float  # inverse of its variance, shape (n or 1, ...)
    share: Float  # decrease of the others per unit of the blackbody's, shape (n_some, n or 1, ...)

    @cached_property
    def rounding(self) -> tuple[Float, Float]:
        """Smallest amplitudes of the blackbody and of the others that count as zero despite rounding."""
        variance = np.diag(self.inverse).reshape(-1, *(1,) * (self.others.ndim - 1))
        if self.amplitude is not None:
            variance = variance + self.share**2 / self.power
        return -ROUNDING / np.sqrt(self.power), -ROUNDING * np.sqrt(variance)

    def positive(self, amplitude: Float | None, others: Float) -> NDArray[np.bool_]:
        """Return whether no amplitude is negative, shape (n, ...)."""
        least, other_least = self.rounding
        positive = np.asarray((others >= other_least).all(axis=0))
        return positive if amplitude is None else positive & (amplitude >= least)

    def value(self, factors: Float) -> Float:
        """Return a sum of the best amplitudes, with factors (n_linear, n, ...)."""
        total = np.sum(factors[1:][list(self.some)] * self.others, axis=0)
        return np.asarray(total if self.amplitude is None else total + factors[0] * self.amplitude)

    def product(self, factors: Float, change: tuple[Float | None, Float, Float]) -> Float:
        """Return the covariance of a sum of amplitudes with the quantity of a `change`."""
        total = np.sum(factors[1:][list(self.some)] * change[1], axis=0)
        return np.asarray(total if change[0] is None else total + factors[0] * change[0])

    def change(self, factors: Float) -> tuple[Float | None, Float, Float]:
        """Return the changes of amplitudes per change of a linear quantity, and the quantity's variance.

        The factors of the quantity have the shape (n_linear, n, ...).
        """
        own = factors[1:][list(self.some)]
        others = _product(self.inverse, own)
        variance = np.sum(own * others, axis=0)
        if self.amplitude is None:
            return None, others, variance
        slope = factors[0] - np.sum(own * self.share, axis=0)
        step = slope / self.power
        return step, others - step * self.share, variance + slope * step


class BoundedProfile(Profile):
    """Profile likelihood of the temperature for the sums of some frames, with amplitudes of at least zero."""

    def solutions(self, log_k: Float) -> Iterator[Face]:
        """Yield the unbounded fit of each face at temperatures (n, ...), or (1, ...) if common to all frames."""
        products, every = self.products(log_k), range(len(self.reduction.fixed))
        for some in chain.from_iterable(combinations(every, size) for size in range(len(every) + 1)):
            yield products.face(some, False)
            yield products.face(some, True)

    def _best_of(self, log_k: Float) -> tuple[Float, Float]:
        """Return the largest gain (n, ...) and its amplitudes (n_linear, n, ...)."""
        shape = (len(self.sums), *log_k.shape[1:])
        gain, amplitudes = np.zeros(shape), np.zeros((1 + len(self.reduction.fixed), *shape))
        for face in self.solutions(log_k):
            better = (face.gain > gain) & face.positive(face.amplitude, face.others)
            np.copyto(gain, face.gain, where=better)
            amplitudes[:, better] = 0.0
            if face.amplitude is not None:
                np.copyto(amplitudes[0], np.maximum(face.amplitude, 0.0), where=better)
            for k, other in zip(face.some, face.others, strict=True):
                np.copyto(amplitudes[1 + k], np.maximum(other, 0.0), where=better)
        return gain, amplitudes

    def gain(self, log_k: Float) -> Float:
        """Return the decrease of chi-squared by a flare of temperatures (n, ...)."""
        gain = np.zeros((len(self.sums), *log_k.shape[1:]))
        for face in self.solutions(log_k):
            np.copyto(gain, face.gain, where=(face.gain > gain) & face.positive(face.amplitude, face.others))
        return gain

    def gain_at_nodes(self, every: int = 1) -> Float:
        """Return `gain` at each `every`-th temperature of the model, shape (n, n_node)."""
        return self.gain(self.nodes[None, ::every])

    def best(self, at_nodes: Float | None = None) -> BestFit:
        """Return the best fit of each frame."""
        every = COARSE if at_nodes is None else 1
        at_nodes = self.gain_at_nodes(every) if at_nodes is None else at_nodes
        low, high = self.nodes[0], self.nodes[-1]
        step = every * float(self.nodes[1] - self.nodes[0])
        x = self.nodes[::every][np.argmax(at_nodes, axis=1)]
        for _ in range(REFINEMENTS):
            there = np.clip(x[:, None] + step * np.array([-1.0, 0.0, 1.0]), low, high)
            g = self.gain(there)
            # The vertex of the parabola through three points, or the best point if there is no maximum.
            a, b = there[:, 0] - there[:, 1], there[:, 2] - there[:, 1]
            left, right = g[:, 0] - g[:, 1], g[:, 2] - g[:, 1]
            under = right * a - left * b
            over = right * a**2 - left * b**2
            inside = np.abs(under) > 1e-300
            vertex = there[:, 1] + np.divide(over, 2 * under, out=np.zeros_like(over), where=inside)
            three = there[np.arange(x.size), np.argmax(g, axis=1)]
            good = inside & (vertex >= there[:, 0]) & (vertex <= there[:, 2])
            vertex = np.where(good, vertex, three)
            reached = self.gain(vertex)
            x = np.where(reached >= g.max(axis=1), vertex, three)
            # A smooth maximum moves less and less; bounds may bend the gain sharply.
            moving = np.abs(x - there[:, 1]) > SETTLED * step
            step /= NARROWER
        return self.solution(self._climbed(x, np.flatnonzero(moving)))

    def _climbed(self, x: Float, moving: NDArray[np.intp]) -> Float:
        """Return the temperatures; those from which the gain still rises are moved to its maximum nearby."""
        if not moving.size:
            return x
        low, high = self.nodes[0], self.nodes[-1]
        step = float(self.nodes[1] - self.nodes[0])
        beside = np.clip(x[moving, None] + BESIDE * step * np.array([-1.0, 0.0, 1.0]), low, high)
        gain = BoundedProfile(*self.rows(moving)).gain(beside)
        rising = moving[gain.max(axis=1) > gain[:, 1] + LEAST_RISE]
        if not rising.size:
            return x
        own, best = BoundedProfile(*self.rows(rising)), x[rising]
        for _ in range(CLIMBS):
            there = np.clip(best[:, None] + step * np.linspace(-1.0, 1.0, 9), low, high)
            best = there[np.arange(best.size), np.argmax(own.gain(there), axis=1)]
            step /= 4.0
        climbed = x.copy()
        climbed[rising] = best
        return climbed

    def solution(self, log_k: Float) -> BestFit:
        """Return the best fits at temperatures (n,)."""
        gain, amplitudes = self._best_of(log_k)
        return BestFit(log_k, np.ascontiguousarray(amplitudes.T), gain)


def with_bounds(reduction: Reduction, sums: Float, best: BestFit) -> BestFit:
    """Return fits with amplitudes of at least zero, from fits without this bound."""
    negative = np.flatnonzero((best.linear < 0.0).any(axis=1))
    return best.replaced(negative, BoundedProfile(reduction, sums[negative]).best()) if negative.size else best


def bounded_intervals(
    model: FlareModel, profile: BoundedProfile, best: BestFit, at_nodes: Float, allowed: float
) -> tuple[Float, Float]:
    """Return the profile-likelihood intervals of a model's quantities, low and high, each (n, n_derived).

    An interval that reaches a bound ends there, and its other end is a one-sided limit; it is infinite without a limit.
    """
    low, high = profile.ends(best, at_nodes, allowed)
    x = temperature_samples(profile, low, high)
    products, faces = profile.products(x), list(profile.solutions(x))
    least = best.gain[:, None] - allowed
    light, of_light = profile.reduction.light, None
    if light is not None and profile.light is not None:
        without = profile.factor(x, np.zeros((*x.shape, len(model.linear))))
        of_light = without, np.moveaxis(light.weights_of(x), -1, 0), light.scale**-2.0

    def ends(derived: Derived, spline: CubicSpline) -> tuple[Float, Float]:
        if derived.ratio is None:
            factors = np.moveaxis(spline(x), -1, 0)
            linear_ends = _linear_ends(faces, factors, least, of_light)
            if light is None or not light.prior.size:
                return linear_ends
            factor = profile.factor(best.log_k, best.linear)
            value = np.vecdot(spline(best.log_k), best.linear) / factor
            moved = light.change(value, factor, linear_ends[1] - linear_ends[0], allowed)
            return _linear_ends(faces, factors, least - moved[:, None], of_light)
        lowest, highest = _ratio_ends(products, faces, spline(x), least)
        return derived.offset + lowest, derived.offset + highest

    lows, highs = ends_of_quantities(model, low, high, ends)
    # A parabola through the outermost samples may exceed a bound.
    return np.maximum(lows, model.bounds), highs


def _linear_ends(
    faces: list[Face],
    factors: Float,
    least: Float,
    of_light: tuple[Float, Float, float] | None,
) -> tuple[Float, Float]:
    """Return the ends of a quantity that is linear in the amplitudes, with factors (n_linear, n, n_sample).

    `of_light` is the best factor on all light without a flare, its decrease per unit of each amplitude, and its
    variance, if it is unknown.
    """
    lows, highs = np.full(factors.shape[1:], np.inf), np.full(factors.shape[1:], -np.inf)
    for face in faces:
        left = face.gain - least + 1e-9 * np.abs(least)
        inside = left >= 0.0
        if not inside.any():
            continue
        left = np.maximum(face.gain - least, 0.0)
        middle = face.value(factors)
        change = face.change(factors)
        variance = change[2]
        if of_light is not None and (face.some or face.amplitude is not None):
            dims = face.change(of_light[1])
            covariance = face.product(factors, dims)
            ratio = Ratio(middle, of_light[0] - face.value(of_light[1]), variance, dims[2] + of_light[2], -covariance)
        else:
            dims, ratio = change, None
        for sign, bounds, which in ((-1.0, lows, np.minimum), (1.0, highs, np.maximum)):
            if ratio is None:
                end = middle + sign * np.sqrt(left * variance)
                reach = sign * np.sqrt(left / np.where(variance > 0, variance, np.inf))
                step, steps = change[:2]
            else:
                end = ratio.end(left, sign)
                at = np.where(np.isfinite(end), end, 0.0)
                reach = (at * ratio.bottom - middle) / np.maximum(ratio.variance_at(at), 1e-300)
                step = None if change[0] is None or dims[0] is None else change[0] + at * dims[0]
                steps = change[1] + at * dims[1]
                # An open end is reached with any amplitudes that the face allows.
                reach = np.where(np.isfinite(end), reach, 0.0)
            moved = None if face.amplitude is None or step is None else face.amplitude + reach * step
            there = inside & face.positive(moved, face.others + reach * steps)
            which(bounds, end, out=bounds, where=there)
    return extreme(lows, np.minimum), extreme(highs, np.maximum)


def _ratio_ends(products: Products, faces: list[Face], per: Float, least: Float) -> tuple[Float, Float]:
    """Return the ends of per x (fixed component 0) / (blackbody); see `_ratio_interval`."""
    lows, highs = np.full(per.shape, np.inf), np.full(per.shape, -np.inf)
    for face in faces:
        if 0 not in face.some or face.amplitude is None:
            allowed = (face.gain >= least) & face.positive(face.amplitude, face.others)
            if 0 not in face.some:
                np.copyto(lows, 0.0, where=allowed)
                np.maximum(highs, 0.0, out=highs, where=allowed)
            if face.amplitude is None:
                # Without a blackbody the light is recombination, or there is none, which every ratio allows.
                np.copyto(highs, np.inf, where=allowed)
            continue
        yt, yf, tt, tf, ff, explained, (by_y, by_t, by_f) = products.less_lines(list(face.some[1:]), per)
        rest = least - explained
        # (yt + r yf)^2 = rest |t + r f|^2 at the ends r.
        a, b, c = yf**2 - rest * ff, yt * yf - rest * tf, yt**2 - rest * tt
        root = np.sqrt(np.where(b**2 >= a * c, b**2 - a * c, np.nan))
        for sign in (-1.0, 1.0):
            with np.errstate(divide="ignore", invalid="ignore"):
                r = (-b + sign * root) / a
                amplitude = (yt + r * yf) / (tt + 2 * r * tf + r**2 * ff)
                there = (r >= 0) & (amplitude >= 0) & (by_y - amplitude * (by_t + r * by_f) >= 0).all(axis=0)
            np.minimum(lows, r, out=lows, where=there)
            np.maximum(highs, r, out=highs, where=there)
    return extreme(lows, np.minimum), extreme(highs, np.maximum)
