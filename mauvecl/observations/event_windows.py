"""Frames around an event, families of flare shapes, and the likelihood of flares that depart from their shape.

Energies are averaged over families of shapes. A shape is a weighted sum of a few parts, so that the fits of all shapes
of a family follow from those of its parts. The general family has flares with other rises and decays than the published
shapes.

The light near an event is the level, flares of a known shape, and noise:

    y = level + sum_j A_j s((t - p_j) / w_j) (1 + d(t)) + noise

The level has the covariance of the process of the star. The departure d of a flare from its shape is a Gaussian process
of standard deviation epsilon in the logarithm of the time from the peak (a model discrepancy as of Kennedy & O'Hagan
2001, doi 10.1111/1467-9868.00294). It makes the sum of the observed light decide where a flare is bright, and the
shape where it is not observed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial

import numpy as np
import scipy
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from mauvecl.flares.shapes import SHAPES, Davenport2014, Shape, TimeProfile, consecutive_integrals
from mauvecl.host.arrays import Bool, Float
from mauvecl.observations.search import DetectedEvent, SeriesSurvey
from mauvecl.search.search import REACH

#: Departures from a shape that are averaged (assumed); a flare of the general family is never exactly of its shapes.
EPSILON, GENERAL_EPSILON = (0.0, 0.02, 0.06, 0.2), (0.04, 0.1, 0.2)
#: Widths of the Gaussian rises and decays of the general family from half maximum to maximum, in half-widths (assumed).
GAUSSIAN_RISES, GAUSSIAN_DECAY = (0.15, 0.5, 1.5), 0.5
#: Shares of slow exponentials in the decay, and their rates, per half-width (assumed; Davenport's are 0.30 and 0.28).
SLOW_SHARES, SLOW_RATES = (0.08, 0.16, 0.3, 0.45), np.geomspace(0.1, 0.9, 24)
#: Number of exponentials from which those of all rates are interpolated, to 1e-5 of their peak.
EXPONENTIALS = 10
#: Light of a part in a bin, relative to the largest of all parts and bins, below which it is neglected in all nodes.
DARK = 1e-13
#: Name of the general family.
GENERAL = "general"
#: Prior weight of the general family (assumed); published shapes share the rest.
GENERAL_WEIGHT = 0.5


@dataclass(frozen=True)
class HalfProfile(TimeProfile):
    """Rise of a flare that ends at the peak, or decay that begins there."""

    #: Integral of a rise up to a time before the peak, or of a decay from a time after it, which callers need alone.
    integral: Callable[[Float], Float]
    decays: bool = False

    def before(self, tau: ArrayLike) -> Float:
        return np.zeros(np.shape(tau)) if self.decays else self.integral(np.asarray(tau))

    def after(self, tau: ArrayLike) -> Float:
        return self.integral(np.asarray(tau)) if self.decays else np.zeros(np.shape(tau))


def _exponential(rate: float) -> HalfProfile:
    """Return an exponential decay with a rate per half-width."""
    return HalfProfile(lambda tau: np.asarray(np.exp(-rate * tau) / rate), decays=True)


def _gaussian(tau: Float, width: float) -> Float:
    """Return the integral of a Gaussian beyond tau; its half-width at half maximum is negative for a rise."""
    root = float(np.sqrt(np.log(2)))
    return np.asarray(np.sqrt(np.pi) / 2 * abs(width) / root * scipy.special.erfc(tau * root / width))


@dataclass(frozen=True)
class WeightedSum(TimeProfile):
    """Shape of a family: a weighted sum of its parts."""

    name: str
    parts: tuple[tuple[float, TimeProfile], ...]

    def before(self, tau: ArrayLike) -> Float:
        return np.asarray(sum(weight * part.before(tau) for weight, part in self.parts))

    def after(self, tau: ArrayLike) -> Float:
        return np.asarray(sum(weight * part.after(tau) for weight, part in self.parts))


@dataclass(frozen=True, eq=False)
class Family:
    """Shapes that are weighted sums of the same parts."""

    name: str
    parts: tuple[TimeProfile, ...]
    weights: Float  # shape (n_shape, n_part)
    log_prior: Float  # shape (n_shape,); logarithm of the prior weight of each shape in the family
    epsilon: tuple[float, ...]  # departures from the shapes that are averaged
    prior: float  # weight of the family

    @classmethod
    def of(cls, shape: Shape, prior: float) -> Family:
        """Return the family of a single shape."""
        return cls(shape.name, (shape,), np.ones((1, 1)), np.zeros(1), EPSILON, prior)

    @classmethod
    @cache
    def general(cls) -> Family:
        """Return the general family, the same object in all calls: rises and decays in all combinations."""
        rises = [HalfProfile(SHAPES["davenport2014"].before)]
        rises += [HalfProfile(partial(_gaussian, width=-width)) for width in GAUSSIAN_RISES]
        gaussian = HalfProfile(partial(_gaussian, width=GAUSSIAN_DECAY), decays=True)
        fast = [_exponential(Davenport2014.DECAY[0][1]), gaussian]
        # An exponential is a smooth function of the logarithm of its rate: it is interpolated between Chebyshev points.
        low, high = np.log(SLOW_RATES[[0, -1]])
        points, degree = chebyshev.chebpts2(EXPONENTIALS), EXPONENTIALS - 1
        slow = [_exponential(rate) for rate in np.exp(low + (high - low) * (points + 1) / 2).tolist()]
        places = 2 * (np.log(SLOW_RATES) - low) / (high - low) - 1
        interpolated = chebyshev.chebvander(places, degree) @ np.linalg.inv(chebyshev.chebvander(points, degree))
        # Each share has the same weight: without a slow decay, its rate does not matter.
        share = np.append(0.0, np.repeat(SLOW_SHARES, SLOW_RATES.size))
        rates = np.where(share == 0, 1.0, 1 / SLOW_RATES.size)
        decays = np.vstack([np.zeros((1, EXPONENTIALS)), *(share * interpolated for share in SLOW_SHARES)])
        rise, start, decay = np.indices((len(rises), len(fast), share.size)).reshape(3, -1)
        starts = np.eye(len(fast))[start] * (1.0 - share[decay, None])
        weights = np.hstack([np.eye(len(rises))[rise], starts, decays[decay]])
        prior = (rates / rates.sum())[decay] / (len(rises) * len(fast))
        return cls(GENERAL, (*rises, *fast, *slow), weights, np.log(prior), GENERAL_EPSILON, GENERAL_WEIGHT)

    def shape(self, k: int) -> WeightedSum:
        """Return one of the shapes."""
        pairs = zip(self.weights[k].tolist(), self.parts, strict=True)
        return WeightedSum(self.name, tuple((weight, part) for weight, part in pairs if weight))


Profile = Shape | WeightedSum

#: Correlation of departures in the logarithm of 1 + time from the peak in half-widths (assumed).
LOG_TIME = 0.7
#: Light that departs where a shape has none, over the amplitude, at the peak (assumed); it falls by e per half-width.
FLOOR = 0.1
#: Largest number of bins in an event, and on each side of it; growth of the bins with the distance from the peak.
MAX_INSIDE, MAX_OUTSIDE, GROWTH = 160, 80, 6.0
#: Bins outside are shorter than this share of the shortest time scale of the process.
SHORT = 0.2
#: First range of the peak, in half-widths of the template, and factor on the half-width.
PEAK_RANGE, WIDTH_RANGE = 2.5, 6.0
#: Number of frames on each side of an event that are fitted with it, at least, and the same in lengths of the event.
#: More would lower the variance of the event's sum, by a better level, by 1 % at most in independent noise.
WINDOW_FRAMES, WINDOW_LENGTHS = 2**15, 100


@dataclass(frozen=True)
class FittedFlare:
    """Flare fitted to an event."""

    peak_s: float  # in the stare
    amplitude: float  # relative to the level
    half_width_s: float
    equivalent_duration_s: float


@dataclass(frozen=True, eq=False)
class Window:
    """Bins of consecutive frames around an event, with sums along the direction of its template."""

    survey: SeriesSurvey
    event: DetectedEvent
    edges: Float  # shape (n, 2); start and end of each bin
    values: Float  # shape (n,)
    noise: Float  # shape (n,); variance of the mean of each bin's frames
    n_frames: NDArray[np.int64]  # shape (n,); of each bin
    inside: Bool  # shape (n,); bins of the event
    scale: float  # value of unit amplitude
    photon: float  # rise of the variance of a frame with the amplitude
    quiet_level: float = 1.0  # of the star at the peak, by the frames without events, in units of the survey's level

    @classmethod
    def of(cls, survey: SeriesSurvey, in_events: Bool, event: DetectedEvent) -> Window:
        """Collect the frames of an event, and those around it that belong to no event."""
        unit = survey.bank.directions[event.direction]
        row = survey.templates.chosen[event.direction]
        scale = float(np.linalg.norm(survey.templates.directions[row]))
        photon = float(unit @ survey.templates.noise[row] @ unit)
        excess = float(unit**2 @ np.array([process.excess for process in survey.processes]) ** 2)
        frame_s = survey.stare.frame_s
        # Only frames near the event, so that the time does not depend on the length of the light curve.
        reach = max(WINDOW_FRAMES, WINDOW_LENGTHS * (event.last - event.first + 1))
        frames = np.arange(max(0, event.first - reach), min(event.last + 1 + reach, in_events.size))
        inside = (frames >= event.first) & (frames <= event.last)
        chosen = inside | ~in_events[frames]
        frames, inside = frames[chosen], inside[chosen]
        numbers, (begin, end) = survey.stare.numbers[frames], survey.stare.numbers[[event.first, event.last]]
        # Distance from the event in frames; its peak may be outside of it.
        peak = event.peak_s / frame_s
        distance = np.abs(numbers - peak) - np.where(numbers > peak, end - peak, peak - begin)
        shortest = min(process.shortest_s for process in survey.processes)
        outer = np.clip(np.maximum(distance, 0.0) / GROWTH, 1.0, max(1.0, SHORT * shortest / frame_s))
        size = np.where(inside, np.ceil((end - begin + 1) / MAX_INSIDE), np.floor(outer))
        first = _bins(numbers, size, inside)
        count = np.diff(np.append(first, frames.size))
        is_inside = inside[first]
        # As the start of the next frame, to the bit.
        start, stop = numbers[first] * frame_s, (numbers[first + count - 1] + 1) * frame_s
        mean = np.add.reduceat(survey.sums[frames] @ unit, first) / count
        noise = np.add.reduceat(survey.variance[frames] * excess, first) / count**2
        rows = np.flatnonzero(is_inside)
        nearest = slice(max(rows[0] - MAX_OUTSIDE, 0), rows[-1] + 1 + MAX_OUTSIDE)
        return cls(
            survey, event, np.column_stack([start, stop])[nearest], mean[nearest], noise[nearest], count[nearest],
            is_inside[nearest], scale, photon,
        )  # fmt: skip

    @cached_property
    def middle(self) -> Float:
        """Middle of each bin."""
        return np.asarray(self.edges.mean(axis=1))

    @cached_property
    def level_covariance(self) -> Float:
        """Covariance of the level in the bins, shape (n, n)."""
        unit = self.survey.bank.directions[self.event.direction]
        lags = self.middle[:, None] - self.middle
        pairs = zip(unit, self.survey.processes, strict=True)
        return np.asarray(sum(weight**2 * process.at(lags) for weight, process in pairs))

    def model(self, shape: TimeProfile, peak_s: ArrayLike, half_width_s: ArrayLike) -> Float:
        """Return the mean of shapes in the bins, in the unit of the values, (n_shape, n)."""
        return np.asarray(self.models((shape,), peak_s, half_width_s)[0])

    def models(self, parts: Sequence[TimeProfile], peak_s: ArrayLike, half_width_s: ArrayLike) -> Float:
        """Return the mean of several parts of shapes in the bins, in the unit of the values, (n_part, n_shape, n)."""
        times, place = self._times
        peak, width = (np.atleast_1d(values)[:, None] for values in (peak_s, half_width_s))
        tau = (times - peak) / width
        # Integrals from the peak. Each side is computed separately: this dominates the time of a fit.
        early = tau < 0
        before, after = tau[early], tau[~early]
        per_amplitude = self.scale * width / np.diff(self.edges)[:, 0]
        integral = np.empty(tau.shape)
        light = np.empty((len(parts), *per_amplitude.shape))
        for mean, part in zip(light, parts, strict=True):
            integral[early] = part.before(before) - part.before(0.0)
            integral[~early] = part.after(0.0) - part.after(after)
            np.maximum(integral[:, place[1]] - integral[:, place[0]], 0.0, out=mean)
            mean *= per_amplitude
        return light

    @cached_property
    def ranges(self) -> Float:
        """Largest ranges of the peak and of the logarithm of the half-width of a single flare, shape (2, 2).

        A gap before the event may hold the peak, at most as long before as the event lasts.
        """
        event, survey = self.event, self.survey
        frame_s = survey.stare.frame_s
        first_s, last_s = survey.stare.start_s[event.first], survey.stare.start_s[event.last] + frame_s
        low, high = event.peak_s - PEAK_RANGE * event.half_width_s, event.peak_s + PEAK_RANGE * event.half_width_s
        before_s = float(survey.stare.start_s[event.first - 1]) + frame_s if event.first else -np.inf
        low = min(low, max(first_s - max(4 * event.half_width_s, last_s - first_s), before_s))
        high = min(max(high, low + frame_s), last_s)
        widest = max(survey.bank.half_widths_s[-1], event.half_width_s) * 3
        if low < first_s - frame_s:
            widest = max(widest, last_s - first_s)
        width = (max(event.half_width_s / WIDTH_RANGE, 0.2 * frame_s), min(event.half_width_s * WIDTH_RANGE, widest))
        return np.array([[low, high], np.log(width)])

    @cached_property
    def _times(self) -> tuple[Float, NDArray[np.intp]]:
        """Edges of bins, of which neighbours share one, and the places of each bin's start and end, shape (2, n)."""
        times, place = np.unique(self.edges.T.ravel(), return_inverse=True)
        return times, place.reshape(2, -1)


def _bins(numbers: NDArray[np.int64], size: Float, inside: Bool) -> NDArray[np.int64]:
    """Return the first frame of each bin of consecutive frames, which are added up to their own size."""
    breaks = np.diff(numbers, prepend=numbers[:1] - 2) != 1
    breaks |= np.diff(inside, prepend=inside[:1])
    firsts = list[int]()
    for frame, (begins, most) in enumerate(zip(breaks.tolist(), size.tolist(), strict=True)):
        if begins or frame - firsts[-1] >= most:
            firsts.append(frame)
    return np.array(firsts, np.int64)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Inverse covariance of the values of a window, with the constant level integrated out."""

    window: Window
    inverse: Float  # shape (n, n)
    root: Float  # shape (n, n); the inverse is root^T root
    log_factor: float  # of the likelihood, without the constant
    # Of the integral of the departures of the flares from their shape, in amplitude x s.
    departure: Float  # shape (n,); weights of the values in it
    departure_variance: float  # its variance given the values
    # Weights of the values in the level of the star at the peak, and its variance with a known flare, relative to the
    # level; zero where the values are not its light.
    level: Float  # shape (n,)
    level_variance: float

    @classmethod
    def of(cls, window: Window, flares: Sequence[FittedFlare], shape: Profile, epsilon: float) -> Likelihood:
        """Compute the likelihood for the photon noise of some flares and departures from their shape."""
        n = window.values.size
        covariance = window.level_covariance + np.diag(window.noise)
        shared, variance = np.zeros(n), 0.0
        lengths = np.diff(window.edges)[:, 0]
        for flare in flares:
            light = flare.amplitude * window.model(shape, flare.peak_s, flare.half_width_s)[0]
            covariance += np.diag(window.photon * light / window.scale / window.n_frames)
            if epsilon:
                light = light + _floor(window.middle, flare) * window.scale
                unobserved, unobserved_light = _unobserved(window, flare, shape)
                place = log_time(window.middle, flare)
                places = np.concatenate([place, log_time(unobserved, flare)])
                integrals = np.concatenate([light / window.scale * lengths, unobserved_light])
                correlation = epsilon**2 * np.exp(-np.abs(places[:, None] - places) / LOG_TIME)
                covariance += correlation[:n, :n] * light[:, None] * light
                shared += light * (correlation[:n] @ integrals)
                variance += float(integrals @ correlation @ integrals)
        factor = scipy.linalg.cholesky(covariance, lower=True)
        root = scipy.linalg.lapack.dtrtri(factor, lower=True)[0]
        inverse = root.T @ root
        sums = inverse.sum(axis=1)
        total = float(sums.sum())
        level, level_variance = np.zeros(n), 0.0
        if len(window.survey.bank.directions) == 1:
            peak_bin = int(np.argmin(np.abs(window.middle - window.event.peak_s)))
            at_peak = window.level_covariance[peak_bin]
            weights = inverse @ at_peak
            constant = 1.0 - float(at_peak @ sums)
            level = (weights + constant * sums / total) / window.scale
            level_variance = float(at_peak[peak_bin] - at_peak @ weights) + constant**2 / total
            level_variance = max(level_variance, 0.0) / window.scale**2
        inverse = inverse - sums[:, None] * sums / total
        root = root - root.sum(axis=1)[:, None] * sums / total
        log_factor = -float(np.log(np.diag(factor)).sum()) - 0.5 * float(np.log(total))
        departure = inverse @ shared
        departure_variance = max(variance - float(departure @ shared), 0.0)
        return cls(window, inverse, root, log_factor, departure, departure_variance, level, level_variance)

    def matched(self, parts: Float, weights: Float, values: Float) -> tuple[Float, Float]:
        """Return the products of models and values, and of models with themselves, shape (n_shape, n_node) each.

        Models are sums of parts, shape (n_part, n_node, n), with weights, shape (n_shape, n_part). A model that is as
        bright in all bins is no more than a level: its product with the values, which would be a rounding error, is 0.
        """
        pairs = (weights[:, :, None] * weights[:, None]).reshape(len(weights), -1)
        # Long before the peak nothing is bright.
        largest = parts.max(axis=(0, 1))
        bright = largest >= DARK * largest.max()
        parts, inverse = parts[:, :, bright], self.inverse[bright]
        weighted_values, inverse = inverse @ values, inverse[:, bright]
        weighted = (parts.reshape(-1, len(inverse)) @ inverse).reshape(parts.shape)
        gram = weighted.transpose(1, 0, 2) @ parts.transpose(1, 2, 0)
        information = pairs @ gram.reshape(len(gram), -1).T
        # At least the sum without the level, by the triangle inequality.
        without_level = (np.abs(weights) @ np.sqrt(parts**2 @ np.diag(inverse))) ** 2
        least = np.maximum(1e-9 * without_level, 1e-300)
        slope = np.where(information > least, weights @ (parts @ weighted_values), 0.0)
        return slope, np.maximum(information, least)

    def level_without(self, light: Float) -> Float:
        """Return the level of the star at the peak without the light of flares, whose tails raise the fitted level.

        Where the values are not the star's light, or the fitted level is not above zero, it is the level of the frames
        without events.
        """
        fitted = (self.window.values - light) @ self.level
        return np.where(fitted > 0, fitted, self.window.quiet_level)

    def log_of(self, model: Float) -> float:
        """Return the logarithm of the likelihood of a model of shape (n,), without the constant."""
        return self.log_factor - 0.5 * float(self.chi2(model))

    def chi2(self, model: Float) -> Float:
        """Return chi-squared of the values with models, of shape (n,) or (k, n), added to the level."""
        residual = self.window.values - model
        return np.asarray(np.einsum("...i,...i->...", residual @ self.inverse, residual))


def log_time(time_s: Float, flare: FittedFlare) -> Float:
    """Return the logarithm of the time from the peak, in which departures of a flare are correlated."""
    tau = (time_s - flare.peak_s) / flare.half_width_s
    return np.asarray(np.sign(tau) * np.log1p(np.abs(tau)))


def _floor(time_s: Float, flare: FittedFlare) -> Float:
    """Return the light of a flare that may be where its shape has none."""
    return np.asarray(FLOOR * flare.amplitude * np.exp(-np.abs(time_s - flare.peak_s) / flare.half_width_s))


def _unobserved(window: Window, flare: FittedFlare, shape: Profile) -> tuple[Float, Float]:
    """Return middles of intervals without bins near a flare, and the light of the flare in them, in amplitude x s."""
    tau = np.concatenate([-np.geomspace(REACH[0], 0.05, 12), [0.0], np.geomspace(0.05, REACH[1], 24)])
    start, stop = flare.peak_s + tau[[0, -1]] * flare.half_width_s
    edges = np.unique(np.concatenate([flare.peak_s + tau * flare.half_width_s, window.edges.ravel()]))
    edges = edges[(edges >= start) & (edges <= stop)]
    middle = (edges[:-1] + edges[1:]) / 2
    place = np.searchsorted(window.edges[:, 0], middle, side="right") - 1
    observed = (place >= 0) & (middle < window.edges[np.maximum(place, 0), 1])
    integrals = consecutive_integrals(shape, (edges - flare.peak_s) / flare.half_width_s)
    light = flare.amplitude * flare.half_width_s * integrals + _floor(middle, flare) * np.diff(edges)
    return middle[~observed], light[~observed]
