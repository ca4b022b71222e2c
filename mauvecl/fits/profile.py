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

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.flare_model import FlareModel, MeanSums, Ratio, ReducedSums, derived_values
from mauvecl.host.arrays import Float

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


#: Number of parabolas through three temperatures that refine the best node, and the factor by which they narrow.
REFINEMENTS, NARROWER = 3, 8.0
#: The search for the best temperature starts from every `COARSE`-th node of the model.
COARSE = 4
#: A best temperature that moves by more than this share of the last refinement's step has not settled.
SETTLED = 0.5
#: Distance in nodes at which the gain next to it is then tried, and smallest rise of the gain that counts.
TRIAL_DISTANCE, LEAST_RISE = 0.05, 1e-3
#: Number of grids, each with a quarter of the step of the last, on which temperatures with a rising gain are moved.
CLIMBS = 4
#: Amplitudes below minus this many standard errors are negative; smaller deviations are due to rounding.
ROUNDING = 1e-9
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


def _inverse(matrix: Float) -> Float:
    """Return the inverse of a matrix; most have one element or none, for which the general way takes far longer."""
    return 1.0 / matrix if len(matrix) <= 1 else np.asarray(np.linalg.inv(matrix))


def _product(matrix: Float, values: Float) -> Float:
    """Return the product of a matrix (k, k) with values (k, ...)."""
    return matrix[0] * values if len(matrix) == 1 else np.tensordot(matrix, values, 1) if len(matrix) else values


class FactorAt(NamedTuple):
    """Best factor on all light at temperatures, as a linear function of the amplitudes."""

    without: Float  # for amplitudes of zero, shape (n, ...)
    falls: Float  # its decrease per unit of each amplitude, shape (n_linear, n, ...)
    variance: float


@dataclass(frozen=True, eq=False)
class Face:
    """Unbounded fit of a subset of the components."""

    components: list[int]  # numbers of the fixed components that are fitted
    bounded: bool  # whether amplitudes of fixed components are at least zero
    covariance: Float  # of their amplitudes at a known blackbody, shape (n_component, n_component)
    precision: Float  # inverse of the variance of the blackbody's amplitude, shape (n or 1, ...)
    trade: Float  # decrease of their amplitudes per unit of the blackbody's, shape (n_component, n or 1, ...)
    has_blackbody: bool  # whether the blackbody is fitted as well
    fixed: Float  # amplitudes of the fixed components, shape (n_component, n, ...)
    gain: Float  # decrease of chi-squared by the components, shape (n, ...)
    amplitude: Float  # of the blackbody, shape (n, ...)

    @cached_property
    def rounding(self) -> Float:
        """Smallest amplitudes of the fixed components that count as zero despite rounding."""
        variance = np.diag(self.covariance).reshape(-1, *(1,) * (self.fixed.ndim - 1)) + self.trade**2 / self.precision
        return -ROUNDING * np.sqrt(variance)

    def positive(self, amplitude: Float, fixed: Float) -> NDArray[np.bool_]:
        """Return whether no amplitude is below its bound, shape (n, ...)."""
        positive = np.asarray(amplitude >= -ROUNDING / np.sqrt(self.precision))
        return positive & (fixed >= self.rounding).all(axis=0) if self.bounded else positive

    def value(self, factors: Float) -> Float:
        """Return a sum of the best amplitudes, with factors (n_linear, n, ...)."""
        return np.asarray(np.sum(factors[1:][self.components] * self.fixed, axis=0) + factors[0] * self.amplitude)

    def change(self, factors: Float) -> tuple[Float, Float, Float]:
        """Return the changes of amplitudes per change of a linear quantity, and the quantity's variance.

        The factors of the quantity have the shape (n_linear, n, ...).
        """
        of_fixed = factors[1:][self.components]
        fixed = _product(self.covariance, of_fixed)
        variance = np.sum(of_fixed * fixed, axis=0)
        if not self.has_blackbody:
            return np.zeros_like(variance), fixed, variance
        slope = factors[0] - np.sum(of_fixed * self.trade, axis=0)
        step = slope / self.precision
        return step, fixed - step * self.trade, variance + slope * step

    def ratio(self, factors: Float, factor_at: FactorAt | None) -> Ratio:
        """Return a sum of the amplitudes, with factors (n_linear, n, ...), over the factor on all light."""
        value, variance = self.value(factors), self.change(factors)[2]
        if factor_at is None:
            return Ratio(value, np.ones_like(value), variance, np.zeros_like(value), np.zeros_like(value))
        step, fixed, variance_of_factor = self.change(factor_at.falls)
        covariance = np.sum(factors[1:][self.components] * fixed, axis=0) + factors[0] * step
        bottom = factor_at.without - self.value(factor_at.falls)
        return Ratio(value, bottom, variance, variance_of_factor + factor_at.variance, -covariance)

    def reached(self, ratio: Ratio, end: Float, factors: Float, factor_at: FactorAt | None) -> tuple[Float, Float]:
        """Return the amplitudes at an end of a ratio; an open end is reached with any amplitudes of the face."""
        finite = np.isfinite(end)
        at = np.where(finite, end, 0.0)
        step, fixed, _ = self.change(factors if factor_at is None else factors + at * factor_at.falls)
        reach = np.where(finite, at * ratio.bottom - ratio.top, 0.0) / np.maximum(ratio.variance_at(at), 1e-300)
        return self.amplitude + reach * step, self.fixed + reach * fixed


@dataclass(frozen=True, eq=False)
class BestFit:
    """Best fits of n frames."""

    log_k: Float  # shape (n,)
    linear: Float  # shape (n, n_linear); amplitudes
    gain: Float  # shape (n,); chi-squared of the sums without a flare less that of the fit

    def replaced(self, rows: NDArray[np.intp], fits: BestFit) -> BestFit:
        """Return the fits with those of some frames replaced."""
        arrays = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, values in arrays.items():
            values[rows] = getattr(fits, name)
        return BestFit(**arrays)


class Profile:
    """Profile likelihood of the temperature for the sums of some frames.

    The blackbody's amplitude is at least zero; if it is `bounded`, so are those of the fixed components.
    """

    def __init__(
        self, reduction: ReducedSums, sums: Float, light: Float | None = None, *, bounded: bool = False
    ) -> None:  # fmt: skip
        """Take the sums of frames, (n, n_sum), and those of the factor on light, (n,), if it is unknown."""
        self.reduction, self.sums, self.light, self.bounded = reduction, sums, light, bounded
        self.nodes = reduction.log_k
        #: Sums less what the fixed components explain.
        self.body_sums = reduction.without_fixed(sums)

    def bounded_rows(self, rows: NDArray[np.intp], reduction: ReducedSums | None = None) -> Profile:
        """Return the bounded profile of some of the frames, optionally for another reduction to the same sums."""
        light = None if self.light is None else self.light[rows]
        return Profile(reduction or self.reduction, self.sums[rows], light, bounded=True)

    def faces(self, log_k: Float) -> Iterator[Face]:
        """Yield the unbounded fit of each face at temperatures (n, ...), or (1, ...) if common to all frames.

        Fits without the blackbody come before those with it, and the last one is that of all components.
        """
        hot, fixed = self.reduction.spline(log_k), self.reduction.fixed
        if log_k.shape[0] == 1:
            projection = np.tensordot(self.sums, hot[0], (1, -1))
        else:
            projection = np.einsum("n...k,nk->n...", hot, self.sums)
        power, cross = np.einsum("...k,...k->...", hot, hot), np.moveaxis(hot @ fixed.T, -1, 0)
        of_fixed = (fixed @ self.sums.T).reshape(len(fixed), len(self.sums), *(1,) * (log_k.ndim - 1))
        gram, numbers = fixed @ fixed.T, range(len(fixed))
        for size in range(0 if self.bounded else len(fixed), len(fixed) + 1):
            for components in map(list, combinations(numbers, size)):
                covariance = _inverse(gram[components][:, components])
                without_blackbody, trade = (_product(covariance, values[components]) for values in (of_fixed, cross))
                gain = np.sum(of_fixed[components] * without_blackbody, axis=0)
                precision = power - np.sum(cross[components] * trade, axis=0)
                cold = Face(
                    components, self.bounded, covariance, precision, trade, has_blackbody=False,
                    fixed=without_blackbody, gain=gain, amplitude=np.zeros_like(precision),
                )  # fmt: skip
                yield cold
                amplitude = (projection - np.sum(cross[components] * without_blackbody, axis=0)) / precision
                with_blackbody, gain = without_blackbody - amplitude * trade, gain + amplitude**2 * precision
                yield replace(cold, has_blackbody=True, fixed=with_blackbody, gain=gain, amplitude=amplitude)

    def gain(self, log_k: Float) -> Float:
        """Return the decrease of chi-squared by a flare of temperatures (n, ...)."""
        gain = np.zeros((len(self.sums), *log_k.shape[1:]))
        for face in self.faces(log_k):
            np.copyto(gain, face.gain, where=(face.gain > gain) & face.positive(face.amplitude, face.fixed))
        return gain

    def gain_at_nodes(self, stride: int = 1) -> Float:
        """Return `gain` at each `stride`-th temperature of the model, shape (n, n_node)."""
        return self.gain(self.nodes[None, ::stride])

    def factor_at(self, log_k: Float) -> FactorAt | None:
        """Return the best factor on all light at temperatures (n, ...) as a function of the amplitudes, if unknown."""
        light = self.reduction.light
        if light is None or self.light is None:
            return None
        estimate = self.light.reshape(-1, *(1,) * (log_k.ndim - 1)) / light.scale
        return FactorAt(light.expected + estimate, np.moveaxis(light.weights_of(log_k), -1, 0), light.scale**-2.0)

    def factor(self, best: BestFit) -> Float:
        """Return the factor on all light of best fits, shape (n,); 1 if it is known."""
        factor_at = self.factor_at(best.log_k)
        if factor_at is None:
            return np.ones(best.log_k.shape)
        return np.asarray(factor_at.without - np.sum(factor_at.falls * best.linear.T, axis=0))

    def best(self, at_nodes: Float | None = None) -> BestFit:
        """Return the best fit of each frame, from `gain_at_nodes` if it is known."""
        log_k = self._refined(at_nodes) if self.bounded else self._stationary(at_nodes)
        gain = np.zeros(len(self.sums))
        amplitudes = np.zeros((1 + len(self.reduction.fixed), gain.size))
        for face in self.faces(log_k):
            better = (face.gain > gain) & face.positive(face.amplitude, face.fixed)
            np.copyto(gain, face.gain, where=better)
            amplitudes[:, better] = 0.0
            for k, values in zip((0, *(1 + k for k in face.components)), (face.amplitude, *face.fixed), strict=True):
                # Rounding may leave an amplitude below its bound.
                positive = np.maximum(values, 0.0) if self.bounded or k == 0 else values
                np.copyto(amplitudes[k], positive, where=better)
        return BestFit(log_k, np.ascontiguousarray(amplitudes.T), gain)

    def bounded_best(self) -> BestFit:
        """Return the best fit of each frame with amplitudes of at least zero."""
        best = self.best()
        negative = np.flatnonzero((best.linear < 0.0).any(axis=1))
        return best.replaced(negative, self.bounded_rows(negative).best()) if negative.size else best

    def _stationary(self, at_nodes: Float | None) -> Float:
        """Return the best temperatures without bounds on fixed components, shape (n,).

        The gain is the squared product of the sums with a unit vector, which is a cubic polynomial of the temperature
        between two nodes, so that its maximum has a closed form.
        """
        units, cubics = self.reduction.directions
        node = np.argmax(np.maximum(self.body_sums @ units.T, 0.0) if at_nodes is None else at_nodes, axis=1)
        interval = np.minimum(node, self.nodes.size - 2)
        falling = np.vecdot(self.body_sums, cubics[interval, 2]) < 0.0
        interval = np.where(falling, np.maximum(node - 1, 0), interval)
        c = np.einsum("npk,nk->pn", cubics[interval], self.body_sums)
        span = self.nodes[interval + 1] - self.nodes[interval]
        with np.errstate(divide="ignore", invalid="ignore"):
            top = c[2] / (np.sqrt(c[1] ** 2 - 3 * c[0] * c[2]) - c[1])
        # Otherwise the best node is an end of the model's temperatures, or there is no light.
        best = np.where((top >= 0.0) & (top <= span), self.nodes[interval] + top, self.nodes[node])
        return np.asarray(best)

    def _refined(self, at_nodes: Float | None) -> Float:
        """Return the best temperatures with bounds on all components, shape (n,)."""
        stride = COARSE if at_nodes is None else 1
        at_nodes = self.gain_at_nodes(stride) if at_nodes is None else at_nodes
        low, high = self.nodes[0], self.nodes[-1]
        step = stride * float(self.nodes[1] - self.nodes[0])
        x = self.nodes[::stride][np.argmax(at_nodes, axis=1)]
        for _ in range(REFINEMENTS):
            tried = np.clip(x[:, None] + step * np.array([-1.0, 0.0, 1.0]), low, high)
            g = self.gain(tried)
            # The vertex of the parabola through three points, or the best point if there is no maximum.
            a, b = tried[:, 0] - tried[:, 1], tried[:, 2] - tried[:, 1]
            rise_left, rise_right = g[:, 0] - g[:, 1], g[:, 2] - g[:, 1]
            under = rise_right * a - rise_left * b
            over = rise_right * a**2 - rise_left * b**2
            inside = np.abs(under) > 1e-300
            vertex = tried[:, 1] + np.divide(over, 2 * under, out=np.zeros_like(over), where=inside)
            best = tried[np.arange(x.size), np.argmax(g, axis=1)]
            vertex = np.where(inside & (vertex >= tried[:, 0]) & (vertex <= tried[:, 2]), vertex, best)
            x = np.where(self.gain(vertex) >= g.max(axis=1), vertex, best)
            # A smooth maximum moves less and less; bounds may bend the gain sharply.
            moving = np.abs(x - tried[:, 1]) > SETTLED * step
            step /= NARROWER
        self._climb(x, np.flatnonzero(moving))
        return np.asarray(x)

    def _climb(self, x: Float, moving: NDArray[np.intp]) -> None:
        """Move the temperatures from which the gain still rises to its maximum nearby."""
        if not moving.size:
            return
        low, high = self.nodes[0], self.nodes[-1]
        step = float(self.nodes[1] - self.nodes[0])
        tried = np.clip(x[moving, None] + TRIAL_DISTANCE * step * np.array([-1.0, 0.0, 1.0]), low, high)
        gain = self.bounded_rows(moving).gain(tried)
        rising = moving[gain.max(axis=1) > gain[:, 1] + LEAST_RISE]
        if not rising.size:
            return
        profile = self.bounded_rows(rising)
        for _ in range(CLIMBS):
            tried = np.clip(x[rising, None] + step * np.linspace(-1.0, 1.0, 9), low, high)
            x[rising] = tried[np.arange(rising.size), np.argmax(profile.gain(tried), axis=1)]
            step /= 4.0

    def ends(self, best: BestFit, at_nodes: Float, allowed: float) -> tuple[Float, Float]:
        """Return the log temperatures at which chi-squared has risen by `allowed`, low and high, each (n,).

        An end is NaN if chi-squared does not rise that far within the model's temperatures.
        """
        inside, last, middle = best.gain[:, None] - at_nodes <= allowed, self.nodes.size - 1, best.log_k[:, None]
        # Outermost temperatures inside: nodes, or those of the fits.
        inner = self.nodes[np.column_stack([inside.argmax(axis=1), last - inside[:, ::-1].argmax(axis=1)])]
        inner = np.where(inside.any(axis=1, keepdims=True), inner, middle)
        inner[:, :1], inner[:, 1:] = np.minimum(inner[:, :1], middle), np.maximum(inner[:, 1:], middle)
        beyond = np.searchsorted(self.nodes, inner[:, 0]) - 1, np.searchsorted(self.nodes, inner[:, 1], side="right")
        node = np.column_stack(beyond)
        closed = (node >= 0) & (node <= last)

        def over(x: Float) -> Float:
            return np.asarray(np.sqrt(np.maximum(best.gain[:, None] - self.gain(x), 0.0)) - np.sqrt(allowed))

        # The Illinois method on the root of the rise.
        a, x = inner, np.where(closed, self.nodes[np.clip(node, 0, last)], inner)
        fa, fx = over(a), over(x)
        for _ in range(STEPS):
            b, fb, spread = x, fx, fx - fa
            x = np.where(np.abs(spread) > 1e-14, b - fb * (b - a) / np.where(spread == 0.0, 1.0, spread), b)
            fx = over(x)
            crossed = fx * fb < 0.0
            a, fa = np.where(crossed, b, a), np.where(crossed, fb, 0.5 * fa)
        low, high = np.where(closed, x, np.nan).T
        return low, high


def intervals(
    model: FlareModel, profile: Profile, best: BestFit, at_nodes: Float, allowed: float
) -> tuple[Float, Float]:
    """Return the profile-likelihood intervals of a model's quantities, low and high, each (n, n_derived).

    An interval that reaches a bound ends there, and its other end is a one-sided limit. Ends are infinite if the data
    give no limit within the model's temperatures.
    """
    low, high = profile.ends(best, at_nodes, allowed)
    start, stop = np.where(np.isnan(low), profile.nodes[0], low), np.where(np.isnan(high), profile.nodes[-1], high)
    # Samples are even in the angle of a sine, because the remaining rise goes to zero at the ends like a root.
    angle = np.linspace(-np.pi / 2, np.pi / 2, SAMPLES)
    x = (start + stop)[:, None] / 2 + (stop - start)[:, None] / 2 * np.sin(angle)
    faces, factor_at, light = list(profile.faces(x)), profile.factor_at(x), profile.reduction.light
    least, factor = best.gain[:, None] - allowed, profile.factor(best)

    def ends_of_sum(spline: CubicSpline) -> tuple[Float, Float]:
        """Return the ends of a sum of amplitudes over the factor on all light."""
        factors, least_gain = np.moveaxis(spline(x), -1, 0), least
        tried = faces if profile.bounded else faces[-1:]
        ends = _linear_ends(tried, factors, least_gain, factor_at)
        if light is not None and light.prior.size:
            value = np.vecdot(spline(best.log_k), best.linear) / factor
            least_gain = least - light.change(value, factor, ends[1] - ends[0], allowed)[:, None]
            ends = _linear_ends(tried, factors, least_gain, factor_at)
        if not profile.bounded:
            ratio, closed = faces[-1].ratio(factors, factor_at), np.isfinite(high - low)
            _correct_curved_ends(ends, profile, spline, x, ratio, faces[-1].gain - least_gain, allowed, closed)
        return ends

    kelvin = np.where(np.isnan(low), -np.inf, np.exp(low)), np.where(np.isnan(high), np.inf, np.exp(high))
    columns: list[tuple[Float, Float]] = []
    ends_per_unit: dict[bytes, list[Float]] = {}
    for derived, spline in zip(model.derived, model.splines, strict=True):
        if spline is None:
            ends = kelvin if derived.held is None else (np.full(low.size, derived.held),) * 2
        elif derived.factors is not None:
            # A luminosity is a multiple of a flux, so that their intervals are computed once.
            size = float(derived.factors.max())
            key = (derived.factors / size).astype(np.float32).tobytes()
            if key not in ends_per_unit:
                ends_per_unit[key] = [end / size for end in ends_of_sum(spline)]
            ends = size * ends_per_unit[key][0], size * ends_per_unit[key][1]
        else:
            lowest, highest = _ratio_ends(faces, spline(x), len(model.linear), least)
            ends = derived.offset + lowest, derived.offset + highest
        # Light that contradicts every factor above zero limits nothing.
        empty = ends[0] > ends[1]
        columns.append((np.where(empty, -np.inf, ends[0]), np.where(empty, np.inf, ends[1])))
    lows, highs = (np.column_stack(side) for side in zip(*columns, strict=True))
    # A parabola through the outermost samples may exceed a bound.
    return np.maximum(lows, model.bounds) if profile.bounded else lows, highs


def _ratio_ends(faces: list[Face], per: Float, n_linear: int, least: Float) -> tuple[Float, Float]:
    """Return the ends of `per` times the ratio of the first fixed component to the blackbody."""
    factors, falls = np.zeros((2, n_linear, *per.shape))
    factors[1], falls[0] = per, -1.0
    return _linear_ends(faces, factors, least, FactorAt(np.zeros(()), falls, 0.0))


def _linear_ends(faces: list[Face], factors: Float, least: Float, factor_at: FactorAt | None) -> tuple[Float, Float]:
    """Return the ends of a quantity that is linear in the amplitudes, with factors (n_linear, n, n_sample).

    It is divided by the factor on all light, or by another linear function of the amplitudes, if there is one.
    """
    lows, highs = np.full(factors.shape[1:], np.inf), np.full(factors.shape[1:], -np.inf)
    for face in faces:
        room = face.gain - least
        inside = room >= -1e-9 * (1.0 + np.abs(least))
        if not inside.any():
            continue
        ratio = face.ratio(factors, factor_at)
        for sign, bounds, outermost in ((-1.0, lows, np.fmin), (1.0, highs, np.fmax)):
            end = ratio.end(room, sign)
            is_end = inside & face.positive(*face.reached(ratio, end, factors, factor_at)) if face.bounded else inside
            outermost(bounds, end, out=bounds, where=is_end)
    return _extreme(lows, -1.0), _extreme(highs, 1.0)


def _extreme(values: Float, sign: float) -> Float:
    """Return the largest of samples (n, n_sample), or for a negative sign the smallest, by a parabola through three."""
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


def _correct_curved_ends(
    ends: tuple[Float, Float], profile: Profile, spline: CubicSpline, x: Float, ratio: Ratio, room: Float,
    allowed: float, closed: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Move the ends of a quantity that bends within the error of the temperature to those of simulated thresholds."""
    half, light = SAMPLES // 2, profile.reduction.light
    # The ratio is straight where the recorded quantity less the ratio times the factor is.
    estimate = ratio.top - ratio.value[:, half, None] * ratio.bottom
    bend = np.abs(estimate[:, 0] + estimate[:, -1] - 2 * estimate[:, half])
    wide = (ends[1] - ends[0]) * ratio.bottom[:, half]
    # Simulated fits need the error of the temperature, which its interval gives if it has both ends.
    rows = np.flatnonzero(closed & np.isfinite(wide) & (bend > CURVED * np.sqrt(allowed) * wide))
    if not rows.size:
        return
    # Rounding does not exclude the ends of the temperature's interval.
    x, room, ratio = x[rows], np.where(room > -1e-6, np.maximum(room, 0.0), room)[rows], ratio.rows(rows)
    middle, share, error = ratio.value[:, half], np.ones(rows.size), (x[:, -1] - x[:, 0]) / np.sqrt(4 * allowed)
    if light is not None:
        factors = spline(profile.nodes) + float(np.median(middle)) * light.weights_of(profile.nodes)
        spline = scipy.interpolate.CubicSpline(profile.nodes, factors)
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        reached = np.where(room < 0.0, -np.inf, sign * ratio.end(room, sign))
        place = np.arange(rows.size), reached.argmax(axis=1)
        if light is not None:
            # Share of the variance that is not the factor's; the factor is straight.
            total = ratio.variance_at(middle[:, None])[place]
            share = np.clip(1.0 - light.scale**-2.0 * middle**2 / total, 0.0, 1.0)
        moved = sign * np.sqrt(np.maximum(room[place], 0.0) * share)
        simulated = _simulated_thresholds(profile, spline, rows, x[place], moved, error, allowed)
        corrected = room + (share * (simulated - allowed))[:, None]
        end[rows] = _extreme(np.where(corrected < 0.0, sign * -np.inf, ratio.end(corrected, sign)), sign)


def _simulated_thresholds(
    profile: Profile, spline: CubicSpline, rows: NDArray[np.intp], x: Float, moved: Float, error: Float, allowed: float
) -> Float:
    """Return thresholds at ends, (n,), below which likelihood ratios are as probable as below Wilks' `allowed`.

    The ratio has one degree of freedom only where the quantity is straight. Elsewhere a threshold is the quantile of
    the ratio in fits to simulated sums, with the quantity held at an end of its interval and free. These have even
    distances along the gradient of the quantity, weighted by their probability, and the same noise for all ends in the
    other directions in which the mean sums change. `x` is the log temperature at the end, `moved` the distance from the
    best value there in standard errors, and `error` the standard error of the log temperature.
    """
    units, nodes = profile.reduction.directions[0], profile.nodes
    directions = _quantity_direction(profile.reduction, spline, nodes)
    length = np.linalg.norm(directions, axis=1)[:, None]
    sums, value = _sums_at_end(profile, spline, rows, x, moved)
    # A cubature of normal noise, exact for polynomials of third degree.
    n, z = sums.shape[1] - 2, np.sqrt(allowed)
    noise = np.sqrt(n) * np.concatenate([np.eye(n), -np.eye(n)])
    distances = ALONG * np.arange(0.5, (z + BEYOND) / ALONG)
    distances = np.concatenate([-distances, distances])
    along = np.repeat(distances, len(noise))
    draws = np.column_stack([np.ones(along.size), along, np.tile(noise, (distances.size, 1))])
    # Evenly spaced nodes around the temperatures, (n, TRIED).
    last = nodes.size - 1
    step = (nodes[-1] - nodes[0]) / last
    stride = np.clip(2 * REACH * error / step / (TRIED - 1), 1, last // (TRIED - 1)).astype(np.intp)
    first = np.rint((x - nodes[0]) / step).astype(np.intp) - stride * (TRIED // 2)
    tried = np.clip(first, 0, last - stride * (TRIED - 1))[:, None] + stride[:, None] * np.arange(TRIED)
    root = np.empty((rows.size, along.size))
    for start in range(0, rows.size, ENDS_AT_ONCE):
        chunk = slice(start, start + ENDS_AT_ONCE)
        chunk_sums, node = sums[chunk], tried[chunk]
        light = np.maximum(draws @ (chunk_sums @ units[node].transpose(0, 2, 1)), 0.0)
        away = chunk_sums @ (directions / length)[node].transpose(0, 2, 1)
        away[:, 0] -= value[chunk, None] / length[node, 0]
        root[chunk] = np.sqrt(_likelihood_ratio(light, draws @ away))
    return _equally_probable(root, along, z) ** 2


def _sums_at_end(
    profile: Profile, spline: CubicSpline, rows: NDArray[np.intp], x: Float, moved: Float
) -> tuple[Float, Float]:
    """Return the mean sums with a quantity at an end of its interval, and directions from it; and the quantity there.

    The directions, (n, 2 + k, n_sum) with the mean, are the quantity's gradient, and those in which the mean changes
    otherwise.
    """
    reduction = profile.reduction
    direction, (basis, inverse) = _quantity_direction(reduction, spline, x), reduction.basis
    # The fitted sums at the end, with the quantity moved there.
    hot = reduction.spline(x)
    body = reduction.without_fixed(hot)
    body /= np.linalg.norm(body, axis=1)[:, None]
    mean = profile.sums[rows] - profile.body_sums[rows] + np.vecdot(profile.body_sums[rows], body)[:, None] * body
    mean += (moved / np.linalg.norm(direction, axis=1))[:, None] * direction
    amplitude = np.vecdot(mean, body) / np.vecdot(hot, body)
    fixed_amplitudes = (mean @ basis.T - amplitude[:, None] * (hot @ basis.T)) @ inverse.T
    # The gradient of the quantity: that at this temperature, and along the change of the mean with temperature.
    slope = reduction.spline(x, 1)
    change = reduction.without_fixed(slope)
    change -= np.vecdot(change, body)[:, None] * body
    steeper = np.vecdot(spline(x, 1), np.column_stack([amplitude, fixed_amplitudes]))
    steeper -= amplitude * np.vecdot(direction, slope)
    power = amplitude * np.vecdot(change, change)
    normal = direction + np.divide(steeper, power, out=np.zeros_like(power), where=power > 0.0)[:, None] * change
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    fixed = np.broadcast_to(reduction.fixed[:, None], (len(reduction.fixed), *direction.shape))
    changes = np.linalg.qr(np.dstack([slope, hot, *fixed]))[0].transpose(0, 2, 1)
    across = changes - (changes @ normal[:, :, None]) * normal[:, None]
    return np.concatenate([mean[:, None], normal[:, None], across], axis=1), np.vecdot(mean, direction)


def _equally_probable(root: Float, along: Float, z: float) -> Float:
    """Return the values, (n,), below which roots of ratios are as probable as |distance| is below `z`.

    Shares of fits with a smaller ratio are smoothed alike for the simulated fits and where the quantity is straight.
    `root`, (n, n_fit), holds the roots of the likelihood ratios of simulated fits, and `along`, (n_fit,), their
    distances along the gradient of the quantity in standard errors.
    """
    weights = np.exp(-(along**2) / 2)
    level = weights @ scipy.special.ndtr((z - np.abs(along)) / SMOOTH)
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
    before, middle_value, after = (samples.ravel().take(middle + side) for side in (-1, 0, 1))
    return middle_value, (after - before) / 2, before + after - 2 * middle_value


def _likelihood_ratio(light: Float, away: Float) -> Float:
    """Return the maximum of light^2 less that of light^2 - away^2 over samples (..., n_sample)."""
    n = light.shape[-1]
    first = np.arange(0, light.size, n).reshape(light.shape[:-1])
    at_best, at_best_held = (np.clip(peak.argmax(axis=-1), 1, n - 2) + first for peak in (light, light**2 - away**2))
    value, slope, bend = _parabola(light, at_best)
    t = np.clip(np.divide(-slope, bend, out=np.zeros_like(slope), where=bend < 0.0), -1.0, 1.0)
    free = value + t * (slope + t * bend / 2)
    # One step of Newton's method from the best sample.
    (p0, p1, p2), (h0, h1, h2) = _parabola(light, at_best_held), _parabola(away, at_best_held)
    bend = h1**2 + h0 * h2 - p1**2 - p0 * p2
    t = np.clip(np.divide(p0 * p1 - h0 * h1, bend, out=np.zeros_like(bend), where=bend > 0.0), -1.0, 1.0)
    p0, h0 = p0 + t * (p1 + t * p2 / 2), h0 + t * (h1 + t * h2 / 2)
    return np.asarray(np.maximum(free**2 - p0**2 + h0**2, 0.0))


def _quantity_direction(reduction: MeanSums, spline: CubicSpline, log_k: Float) -> Float:
    """Return directions at temperatures (n,) whose product with the sums is a quantity's best value, (n, n_sum)."""
    (basis, inverse), hot, factors = reduction.basis, reduction.spline(log_k), spline(log_k)
    projection = hot @ basis.T
    body = hot - projection @ basis
    fixed_weights = factors[:, 1:] @ inverse
    slope = factors[:, 0] - np.vecdot(fixed_weights, projection)
    return np.asarray((slope / np.vecdot(body, body))[:, None] * body + fixed_weights @ basis)


#: Derivatives of n fits with respect to a parameter: of the sums, (n, n_sum), of the quantities as they are recorded,
#: (n, n_derived), and of the sum of the factor on light, (n,).
Slopes = tuple[Float, Float, Float]


def covariance(
    model: FlareModel, reduction: MeanSums, best: BestFit, factor: Float, second: Slopes | None = None
) -> Float:
    """Return the covariance of quantities from the Fisher information at the fit, (n, n_derived, n_derived).

    The parameters are the amplitudes as they are recorded, the log temperature, that of a `second` blackbody if there
    is one, and the factor on all light if it is unknown. The result is NaN if a flare adds no light, or if its
    parameters are degenerate.
    """
    log_k, linear, light = best.log_k, best.linear, reduction.light
    fixed = np.broadcast_to(reduction.fixed, (log_k.size, *reduction.fixed.shape))
    columns = [reduction.spline(log_k)[:, None], fixed, (linear[:, :1] * reduction.spline(log_k, 1))[:, None]]
    gradients = [_gradient(model, log_k, linear)]
    if second is not None:
        columns.append(second[0][:, None])
        gradients.append(second[1][:, :, None])
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
    is_sum, _ = model.amplitude_sums
    gradient[:, is_sum] /= over[:, None, None]
    # The best factor follows the amplitudes and the temperature, and scatters about that.
    by_factor = np.where(is_sum, -derived_values(model, log_k, linear, over) / over[:, None], 0.0)
    slopes = [linear[:, 0] * light.spline(log_k, 1)[:, 0]] + ([] if second is None else [second[2]])
    follows = -np.column_stack([light.weights_of(log_k), *(slope / light.scale for slope in slopes)])
    gradient += by_factor[:, :, None] * follows[:, None, :]
    from_factor = by_factor[:, :, None] * by_factor[:, None, :] / light.scale**2
    return np.asarray(gradient @ inverse @ gradient.transpose(0, 2, 1) + from_factor)


def _gradient(model: FlareModel, log_k: Float, linear: Float) -> Float:
    """Return derivatives with respect to amplitudes and log temperature, (n, n_derived, n_linear + 1)."""
    n, m = linear.shape
    gradient = np.zeros((n, len(model.derived), m + 1))
    is_sum, spline = model.amplitude_sums
    gradient[:, is_sum, :m] = spline(log_k)
    gradient[:, is_sum, m] = np.einsum("nql,nl->nq", spline(log_k, 1), linear)
    for q in np.flatnonzero(~is_sum):
        ratio = model.splines[q]
        if ratio is None:
            gradient[:, q, m] = np.exp(log_k) if model.derived[q].held is None else 0.0
            continue
        amplitude = np.where(linear[:, 0] > 0, linear[:, 0], np.nan)
        gradient[:, q, 0] = -ratio(log_k) * linear[:, 1] / amplitude**2
        gradient[:, q, 1] = ratio(log_k) / amplitude
        gradient[:, q, m] = ratio(log_k, 1) * linear[:, 1] / amplitude
    return gradient
