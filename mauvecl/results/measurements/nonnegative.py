"""Fits with amplitudes of at least zero, for flares near that boundary.

The light of a blackbody, a Balmer continuum or a line is never negative. At a given temperature, the best fit with
non-negative amplitudes is the unbounded fit of a face of the orthant, a subset of the components. The same holds for
the ends of a profile interval, because the likelihood is convex. All faces are tried, and those with a negative
amplitude are rejected. Only the blackbody depends on the temperature, so each face has constant matrices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.results.measurements.light_factor import Ratio
from mauvecl.results.measurements.profile import BestFit, Profile, ends_of_quantities, extreme, temperature_samples

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

    from mauvecl.results.measurements.flare_model import Derived, FlareModel
    from mauvecl.results.measurements.reduction import Reduction

Float = NDArray[np.float64]

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
        found = np.sum(factors[1:][list(self.some)] * self.others, axis=0)
        return np.asarray(found if self.amplitude is None else found + factors[0] * self.amplitude)

    def product(self, factors: Float, change: tuple[Float | None, Float, Float]) -> Float:
        """Return the covariance of a sum of amplitudes with the quantity of a `change`."""
        found = np.sum(factors[1:][list(self.some)] * change[1], axis=0)
        return np.asarray(found if change[0] is None else found + factors[0] * change[0])

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

    def products(self, log_k: Float) -> Products:
        """Return the inner products at temperatures (n, ...), or (1, ...) if common to all frames."""
        hot, fixed = self.hot(log_k), self.reduction.fixed
        one = (1,) * (log_k.ndim - 1)
        if log_k.shape[0] == 1:
            along = np.tensordot(self.sums, hot[0], (1, -1))
        else:
            along = np.einsum("n...k,nk->n...", hot, self.sums)
        return Products(
            along,
            np.einsum("...k,...k->...", hot, hot),
            np.moveaxis(hot @ fixed.T, -1, 0),
            (fixed @ self.sums.T).reshape(len(fixed), len(self.sums), *one),
            fixed @ fixed.T,
        )

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
        """Return temperatures of which some, where gain rises beside them, are moved to the highest gain nearby."""
        if not moving.size:
            return x
        low, high = self.nodes[0], self.nodes[-1]
        step = float(self.nodes[1] - self.nodes[0])
        beside = np.clip(x[moving, None] + BESIDE * step * np.array([-1.0, 0.0, 1.0]), low, high)
        gain = BoundedProfile(self.reduction, self.sums[moving]).gain(beside)
        rising = moving[gain.max(axis=1) > gain[:, 1] + LEAST_RISE]
        if not rising.size:
            return x
        own, best = BoundedProfile(self.reduction, self.sums[rising]), x[rising]
        for _ in range(CLIMBS):
            there = np.clip(best[:, None] + step * np.linspace(-1.0, 1.0, 9), low, high)
            best = there[np.arange(best.size), np.argmax(own.gain(there), axis=1)]
            step /= 4.0
        found = x.copy()
        found[rising] = best
        return found

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

    def ends(one: Derived, spline: CubicSpline | None) -> tuple[Float, Float]:
        if spline is None:
            return np.where(np.isnan(low), -np.inf, np.exp(low)), np.where(np.isnan(high), np.inf, np.exp(high))
        if one.ratio is None:
            factors = np.moveaxis(spline(x), -1, 0)
            found = _linear_ends(faces, factors, least, of_light)
            if light is None or not light.prior.size:
                return found
            factor = profile.factor(best.log_k, best.linear)
            value = np.einsum("nl,nl->n", spline(best.log_k), best.linear) / factor
            moved = light.change(value, factor, found[1] - found[0], allowed)
            return _linear_ends(faces, factors, least - moved[:, None], of_light)
        lowest, highest = _ratio_ends(products, faces, spline(x), least)
        return one.offset + lowest, one.offset + highest

    lows, highs = ends_of_quantities(model, ends)
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
        for sign, found, which in ((-1.0, lows, np.minimum), (1.0, highs, np.maximum)):
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
            which(found, end, out=found, where=there)
    return extreme(lows, np.minimum), extreme(highs, np.maximum)


def _ratio_ends(products: Products, faces: list[Face], per: Float, least: Float) -> tuple[Float, Float]:
    """Return the ends of per x (fixed component 0) / (blackbody); see `profile._ratio_interval`."""
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
        lines = list(face.some[1:])
        inverse = np.linalg.inv(products.gram[np.ix_(lines, lines)])
        y, t = products.fixed[lines], products.cross[lines]
        f = products.gram[lines, 0].reshape(-1, 1, 1) / per
        # Products of sums, blackbody and recombination less their projections on the lines.
        by_y, by_t, by_f = (np.tensordot(inverse, each, 1) for each in (y, t, f))
        yt, tt = products.along - np.sum(t * by_y, axis=0), products.power - np.sum(t * by_t, axis=0)
        yf = products.fixed[0] / per - np.sum(f * by_y, axis=0)
        tf, ff = (
            products.cross[0] / per - np.sum(f * by_t, axis=0),
            products.gram[0, 0] / per**2 - np.sum(f * by_f, axis=0),
        )
        rest = least - np.sum(y * by_y, axis=0)
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
