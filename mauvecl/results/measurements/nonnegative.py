"""Fits with amplitudes of at least zero, for flares near that boundary.

Light of a blackbody, a Balmer continuum or a line only adds. At a given temperature the best fit with non-negative
amplitudes is the best fit of one face of the orthant, that is of some of the components, without bounds; and so are the
ends of a profile interval, because the likelihood is convex there. All faces are tried: those whose solution is
negative somewhere do not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mauvecl.results.measurements.profile import Best, Profile, extreme, temperature_samples

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

    from mauvecl.results.measurements.flare_model import FlareModel
    from mauvecl.results.measurements.reduction import Reduction

Float = NDArray[np.float64]

#: Amplitudes below minus this many of their standard errors are negative; rounding is not.
ROUNDING = 1e-9


class Face(NamedTuple):
    """Fits of some of the components, without bounds, at temperatures (...)."""

    components: tuple[int, ...]
    inverse: Float  # of the information, shape (..., size, size)
    amplitudes: Float  # shape (..., size)
    gain: Float  # what the components lower chi-squared by
    positive: NDArray[np.bool_]  # whether no amplitude is negative


class BoundedProfile(Profile):
    """The profile likelihood of some frames' sums over the temperature, with amplitudes of at least zero."""

    def components(self, log_k: Float) -> Float:
        """Return sums of all components for amplitudes of one, shape (*log_k.shape, n_linear, n_sum)."""
        fixed = np.broadcast_to(self.reduction.fixed, (*log_k.shape, *self.reduction.fixed.shape))
        return np.concatenate([self.hot(log_k)[..., None, :], fixed], axis=-2)

    def solutions(self, log_k: Float) -> Iterator[Face]:
        """Yield the fit without bounds of each face at temperatures (n, ...), or (1, ...) for all frames alike."""
        components = self.components(log_k)
        sums = self.sums.reshape(len(self.sums), *(1,) * (log_k.ndim - 1), -1)
        information = components @ np.swapaxes(components, -1, -2)
        along = np.einsum("...ik,...k->...i", components, sums)
        every = range(1 + len(self.reduction.fixed))
        for face in chain.from_iterable(combinations(every, size) for size in range(len(every) + 1)):
            some = list(face)
            inverse = np.asarray(np.linalg.inv(information[..., some, :][..., some]), np.float64)
            amplitudes = np.einsum("...ij,...j->...i", inverse, along[..., some])
            gain = np.einsum("...i,...i->...", along[..., some], amplitudes)
            yield Face(face, inverse, amplitudes, gain, _positive(amplitudes, inverse))

    def _best_of(self, log_k: Float) -> tuple[Float, Float]:
        """Return the largest gain (n, ...) and its amplitudes (n, ..., n_linear)."""
        shape = (len(self.sums), *log_k.shape[1:])
        gain, amplitudes = np.zeros(shape), np.zeros((*shape, 1 + len(self.reduction.fixed)))
        for face in self.solutions(log_k):
            better = face.positive & (face.gain > gain)
            gain = np.where(better, face.gain, gain)
            full = np.zeros(amplitudes.shape)
            full[..., list(face.components)] = np.maximum(face.amplitudes, 0.0)
            amplitudes = np.where(better[..., None], full, amplitudes)
        return gain, amplitudes

    def gain(self, log_k: Float) -> Float:
        """Return what a flare of temperatures (n, ...) lowers chi-squared by."""
        return self._best_of(log_k)[0]

    def gain_at_nodes(self, every: int = 1) -> Float:
        """Return `gain` at each `every`-th temperature of the model, shape (n, n_node)."""
        return self.gain(self.nodes[None, ::every])

    def amplitudes(self, log_k: Float) -> Float:
        """Return the best amplitudes at temperatures (n,), shape (n, n_linear)."""
        return self._best_of(log_k)[1]


def with_bounds(reduction: Reduction, sums: Float, best: Best) -> Best:
    """Return fits with amplitudes of at least zero, from fits without this bound."""
    negative = np.flatnonzero((best.linear < 0.0).any(axis=1))
    return best.replaced(negative, BoundedProfile(reduction, sums[negative]).best()) if negative.size else best


def _positive(amplitudes: Float, inverse: Float) -> NDArray[np.bool_]:
    spread = np.sqrt(np.einsum("...ii->...i", inverse))
    return np.asarray((amplitudes >= -ROUNDING * spread).all(axis=-1))


def bounded_intervals(
    model: FlareModel, profile: BoundedProfile, best: Best, at_nodes: Float, allowed: float
) -> tuple[Float, Float]:
    """Return the profile-likelihood intervals of a model's quantities, low and high, each (n, n_derived).

    An interval that reaches a bound ends there; the other end is a one-sided limit. Infinite where there is no limit.
    """
    low, high = profile.ends(best, at_nodes, allowed)
    x = temperature_samples(profile, low, high)
    faces = list(profile.solutions(x))
    least = best.gain[:, None] - allowed
    columns = []
    for one, spline in zip(model.derived, model.splines, strict=True):
        if spline is None:
            ends = np.where(np.isnan(low), -np.inf, np.exp(low)), np.where(np.isnan(high), np.inf, np.exp(high))
        elif one.ratio is None:
            ends = _linear_ends(faces, spline(x), least)
        else:
            ends = _ratio_ends(profile, faces, spline, x, least)
            ends = one.offset + ends[0], one.offset + ends[1]
        columns.append(ends)
    # A parabola through the outermost samples may pass a bound.
    lows = np.maximum(np.column_stack([c[0] for c in columns]), model.bounds)
    return lows, np.column_stack([c[1] for c in columns])


def _linear_ends(faces: list[Face], factors: Float, least: Float) -> tuple[Float, Float]:
    """Return the ends of a quantity that is linear in the amplitudes, with factors (n, n_sample, n_linear)."""
    lows, highs = np.full(factors.shape[:2], np.inf), np.full(factors.shape[:2], -np.inf)
    for face, inverse, amplitudes, gain, _ in faces:
        inside = gain >= least - 1e-9 * np.abs(least)
        some = factors[..., list(face)]
        step = np.einsum("...ij,...j->...i", inverse, some)
        variance = np.einsum("...i,...i->...", some, step)
        middle = np.einsum("...i,...i->...", some, amplitudes)
        reach = np.sqrt(np.maximum(gain - least, 0.0) / np.where(variance > 0, variance, np.inf))
        for sign, found, which in ((-1.0, lows, np.minimum), (1.0, highs, np.maximum)):
            there = inside & _positive(amplitudes + sign * reach[..., None] * step, inverse)
            value = middle + sign * reach * variance
            found[...] = np.where(there, which(found, value), found)
    return extreme(lows, np.minimum), extreme(highs, np.maximum)


def _ratio_ends(
    profile: BoundedProfile,
    faces: list[Face],
    spline: CubicSpline,
    x: Float,
    least: Float,
) -> tuple[Float, Float]:
    """Return the ends of per x (amplitude 1) / (amplitude 0); see `profile.ratio_roots`."""
    components, per = profile.components(x), spline(x)
    lows, highs = np.full(x.shape, np.inf), np.full(x.shape, -np.inf)
    for face, _, _, gain, positive in faces:
        allowed = positive & (gain >= least)
        if 1 not in face:
            lows[allowed] = 0.0
            highs[allowed] = np.maximum(highs, 0.0)[allowed]
        elif 0 not in face:
            highs[allowed] = np.inf
        else:
            lines = components[..., [k for k in face if k > 1], :]
            t, f = components[..., 0, :], components[..., 1, :] / per[..., None]
            y = np.broadcast_to(profile.sums[:, None], t.shape)
            basis = np.linalg.qr(np.swapaxes(lines, -1, -2))[0]

            def less(values: Float, basis: Float = basis) -> Float:
                along = np.einsum("...kj,...k->...j", basis, values)
                return np.asarray(values - np.einsum("...kj,...j->...k", basis, along))

            y0, t0, f0 = less(y), less(t), less(f)
            yt, yf, tt, tf, ff = (
                np.einsum("...k,...k->...", a, b) for a, b in ((y0, t0), (y0, f0), (t0, t0), (t0, f0), (f0, f0))
            )
            rest = least - np.einsum("...k,...k->...", y, y) + np.einsum("...k,...k->...", y0, y0)
            # (yt + r yf)^2 = rest |t + r f|^2 at the ends r.
            a, b, c = yf**2 - rest * ff, yt * yf - rest * tf, yt**2 - rest * tt
            root = np.sqrt(np.where(b**2 >= a * c, b**2 - a * c, np.nan))
            for sign in (-1.0, 1.0):
                with np.errstate(divide="ignore", invalid="ignore"):
                    r = (-b + sign * root) / a
                amplitude = (yt + r * yf) / (tt + 2 * r * tf + r**2 * ff)
                left = y - amplitude[..., None] * (t + r[..., None] * f)
                there = (r >= 0) & (amplitude >= 0)
                if lines.shape[-2]:
                    weights = np.einsum("...jk,...k->...j", np.linalg.pinv(np.swapaxes(lines, -1, -2)), left)
                    there &= (weights >= 0).all(axis=-1)
                lows[there], highs[there] = np.minimum(lows, r)[there], np.maximum(highs, r)[there]
    return extreme(lows, np.minimum), extreme(highs, np.maximum)
