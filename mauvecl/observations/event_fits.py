"""Fits of flares to an event: posteriors of the equivalent duration for shapes, and departures from them.

Peak and half-width of a single flare are integrated on a grid, amplitudes, level and departures in closed form; the
families of shapes and departures are averaged with the weights of their marginal likelihoods. Several flares of a
published shape are fitted by least squares, and their errors are those of the linearised model. Priors are flat in the
peak and in the logarithms of half-width and amplitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.flares.shapes import SHAPES, Shape
from mauvecl.host.arrays import Bool, Float
from mauvecl.observations.event_windows import GENERAL_WEIGHT, Family, FittedFlare, Likelihood, Profile, Window
from mauvecl.observations.search import DetectedEvent, SeriesSurvey

#: Published shapes that are averaged, besides that of the search.
AVERAGED = ("davenport2014", "tovarmendoza2022")
#: Logarithm of the weight of a part of a mixture that is neglected.
LEAST_LOG_WEIGHT = -18.5
#: Least standard deviation of a part, as a share of the largest mean.
LEAST_ERROR = 1e-9
#: Nodes along peak and half-width for a shape and for many; fall of the log posterior beyond which they are neglected.
NODES, NODES_OF_MANY, NEGLIGIBLE = 25, 17, 14.0
#: Logarithm of the largest amplitude in units of the range of the frames of the event, for a peak between frames.
MAX_LOG_AMPLITUDE = 5.0
#: Largest number of refinements of the grid.
REFINEMENTS = 6
#: Departure from the shape with which further flares of an event are searched, the fall of chi-squared that each needs,
#: and the largest number of flares.
FURTHER_EPSILON, FURTHER_GAIN, MAX_FLARES = 0.2, 36.0, 6
#: Rounds in which noise and departures follow the fit, and the change of the log duration at which they end.
ROUNDS, SETTLED = 3, 0.02


@dataclass(frozen=True, eq=False)
class NormalMixture:
    """Mixture of normal distributions of the equivalent duration."""

    log_weight: Float  # shape (n,)
    mean: Float
    sd: Float

    @property
    def log_total(self) -> float:
        """Logarithm of the sum of the weights."""
        return float(scipy.special.logsumexp(self.log_weight))

    def quantile(self, probability: float) -> float:
        """Return a quantile of the part above zero."""
        weight, mean, sd = self._significant
        goal = _probability_above(0.0, weight, mean, sd, 0.0) * (1.0 - probability)
        high = max(float((mean + 10 * sd).max()), float(sd.max()))
        if np.isinf(high):
            # Frames without weight do not limit it.
            return high
        # `brentq` keeps its function until the next collection of garbage, but not the arrays.
        given = (weight, mean, sd, goal)
        return float(scipy.optimize.brentq(_probability_above, 0.0, high, args=given, xtol=1e-9 * high))

    @cached_property
    def _significant(self) -> tuple[Float, Float, Float]:
        """Weight, mean and standard deviation of the parts that are not negligible, shape (n_part,)."""
        log = self.log_weight - self.log_total
        rows = log > LEAST_LOG_WEIGHT
        mean = self.mean[rows]
        return np.exp(log[rows]), mean, np.maximum(self.sd[rows], max(LEAST_ERROR * float(np.abs(mean).max()), 1e-300))


def _probability_above(x: float, weight: Float, mean: Float, sd: Float, goal: float) -> float:
    """Return the probability of a mixture above x, less a goal."""
    return float(weight @ scipy.special.ndtr((mean - x) / sd)) - goal


def join(mixtures: Sequence[NormalMixture]) -> NormalMixture:
    """Return the mixture of several."""
    return NormalMixture(*np.hstack([(mixture.log_weight, mixture.mean, mixture.sd) for mixture in mixtures]))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of an event by flares of a family with some departure from their shape."""

    window: Window
    mixture: NormalMixture
    shape: Profile  # the best of the family
    flares: list[FittedFlare]  # the best, of that shape

    @cached_property
    def light(self) -> Float:
        """Light of the flares in the bins, shape (n,)."""
        return light_of(self.window, self.shape, self.flares)

    @cached_property
    def plain(self) -> Likelihood:
        """Likelihood of flares without departures from their shape."""
        return Likelihood.of(self.window, self.flares, self.shape, 0.0)


def fit_event(window: Window, searched: Shape) -> list[Fit]:
    """Fit an event by a single flare of each family, and by several flares of each published shape that needs them."""
    shapes = {shape.name: shape for shape in (searched, *(SHAPES[name] for name in AVERAGED))}
    published = [Family.of(shape, (1 - GENERAL_WEIGHT) / len(shapes)) for shape in shapes.values()]
    first = [_first_fit(window, family) for family in published]
    fits = []
    for family, grid in zip(published, first, strict=True):
        shape, flare = grid.best
        fits += _fit_single(window, family, shape, flare, grid.box, grid.parts)
        several = _add_flares(window, shape, [flare])
        if len(several) > 1:
            fits += _fit_several(window, family, several)
    best = max(first, key=lambda grid: float(scipy.special.logsumexp(grid.log)))
    boxes = np.array([grid.box for grid in first])
    low, high = boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0)
    # The range contains all of these, and half as much on each side.
    wide = np.clip([low - (high - low) / 2, high + (high - low) / 2], *window.ranges.T).T
    return fits + _fit_single(window, Family.general(), *best.best, wide)


def flares_of(survey: SeriesSurvey, in_events: Bool, event: DetectedEvent) -> tuple[list[FittedFlare], float, float]:
    """Return the flares of the bank's shape that fit an event best, and scale and photon noise of its `Window`."""
    window, shape = Window.of(survey, in_events, event), survey.bank.shape
    return _add_flares(window, shape, [_first_fit(window, Family.of(shape, 1.0)).best[1]]), window.scale, window.photon


def _flare(shape: Profile, peak: float, width: float, amplitude: float) -> FittedFlare:
    return FittedFlare(*map(float, (peak, amplitude, width, amplitude * width * shape.equivalent_duration)))


@dataclass(frozen=True, eq=False)
class PosteriorGrid:
    """Posterior of a single flare of a family at nodes of peak and half-width that are not negligible."""

    family: Family
    parts: Float  # means of the parts of the family in the bins at all nodes, shape (n_part, n_node, n)
    # Shape and node, peak, half-width, log posterior, amplitude and its information, shape (n,).
    shape: NDArray[np.intp]
    node: NDArray[np.intp]
    peaks_s: Float
    half_widths_s: Float
    log: Float
    amplitude: Float
    information: Float
    box: Float  # range of the peak and of the logarithm of the half-width outside which it is negligible, (2, 2)

    @property
    def best(self) -> tuple[Profile, FittedFlare]:
        """Shape and flare of the largest posterior."""
        k = int(np.argmax(self.log))
        shape = self.family.shape(int(self.shape[k]))
        return shape, _flare(shape, self.peaks_s[k], self.half_widths_s[k], max(self.amplitude[k], 1e-12))

    def along(self, weights: Float) -> Float:
        """Return the sums of the means over the bins with weights, for unit amplitude, shape (n,)."""
        return np.asarray((self.family.weights @ (self.parts @ weights))[self.shape, self.node])

    @classmethod
    def of(cls, likelihood: Likelihood, family: Family, box: Float, parts: Float | None = None) -> PosteriorGrid:
        """Compute the posterior on a grid that is refined or widened until it covers all that is not negligible.

        `box` is the first range of the peak and of the logarithm of the half-width, and `parts` are the means of the
        family at its nodes, if they are known, as they take most of the time.
        """
        window = likelihood.window
        n_node = NODES if len(family.weights) == 1 else NODES_OF_MANY
        # The values of an event of one bin have no range.
        inside = window.inside
        light = max(float(np.ptp(window.values[inside])), float(np.sqrt(window.noise[inside].max())))
        brightest = np.exp(MAX_LOG_AMPLITUDE) * light / window.scale
        for _ in range(REFINEMENTS):
            axes = [np.linspace(low, high, n_node) for low, high in box]
            p, w = (nodes.ravel() for nodes in np.meshgrid(*axes, indexing="ij"))
            if parts is None:
                parts = window.models(family.parts, p, np.exp(w))
            slope, information = likelihood.matched(parts, family.weights, window.values)
            amplitude = slope / information
            step = (box[:, 1] - box[:, 0]) / (n_node - 1)
            # The integral over the logarithm of the amplitude divides by the S/N.
            snr = np.maximum(slope / np.sqrt(information), 1.0)
            log = 0.5 * slope**2 / information - np.log(snr) + float(np.log(step).sum()) + family.log_prior[:, None]
            log[(slope <= 0) | (amplitude > max(brightest, 1e-12))] = -1e300
            rows, node = np.nonzero(log >= log.max() - NEGLIGIBLE)
            grid = cls(
                family, parts, rows, node, p[node], np.exp(w[node]), log[rows, node], amplitude[rows, node],
                information[rows, node], box,
            )  # fmt: skip
            ends = np.array([[p[node].min(), p[node].max()], [w[node].min(), w[node].max()]])
            low, high = ends[:, 0] - step, ends[:, 1] + step
            # Where the posterior reaches an end, the grid is widened.
            wide = np.diff(box)[:, 0]
            low = np.where(ends[:, 0] <= box[:, 0] + step / 2, box[:, 0] - wide / 2, low)
            high = np.where(ends[:, 1] >= box[:, 1] - step / 2, box[:, 1] + wide / 2, high)
            new = np.clip([low, high], *window.ranges.T).T
            size = np.diff(new)[:, 0] / wide
            if ((size > 0.6) & (size < 1.1)).all():
                break
            box, parts = new, None
        return grid


def _first_fit(window: Window, family: Family) -> PosteriorGrid:
    """Return the posterior of a single flare without departures from a shape."""
    grid = PosteriorGrid.of(Likelihood.of(window, [], family.shape(0), 0.0), family, window.ranges)
    shape, flare = grid.best
    return PosteriorGrid.of(Likelihood.of(window, [flare], shape, 0.0), family, grid.box, grid.parts)


def _add_flares(window: Window, shape: Profile, flares: list[FittedFlare]) -> list[FittedFlare]:
    """Add flares to an event as long as they improve the fit, even if each departs from its shape."""
    frame_s = window.survey.stare.frame_s
    inside = window.middle[window.inside]
    if inside.size < 8:
        return flares
    widths = np.geomspace(max(frame_s, 0.1 * flares[0].half_width_s), max(2 * frame_s, 3 * flares[0].half_width_s), 8)
    step = max(frame_s / 2, float(np.ptp(inside)) / 200)
    p, w = (grid.ravel() for grid in np.meshgrid(np.arange(inside[0], inside[-1], step), widths, indexing="ij"))
    models = window.model(shape, p, w)[None]
    while len(flares) < MAX_FLARES:
        likelihood = Likelihood.of(window, flares, shape, FURTHER_EPSILON)
        light = light_of(window, shape, flares)
        slope, information = likelihood.matched(models, np.ones((1, 1)), window.values - light)
        gain = np.where(slope > 0, slope**2 / information, 0.0)[0]
        k = int(np.argmax(gain))
        if gain[k] < FURTHER_GAIN:
            break
        refined = _refine(likelihood, shape, [*flares, _flare(shape, p[k], w[k], slope[0, k] / information[0, k])])
        if likelihood.chi2(light) - likelihood.chi2(light_of(window, shape, refined)) < FURTHER_GAIN:
            break
        flares = sorted(refined, key=lambda flare: -flare.equivalent_duration_s)
    return _drop_flares(window, shape, flares) if len(flares) > 2 else flares


def _drop_flares(window: Window, shape: Profile, flares: list[FittedFlare]) -> list[FittedFlare]:
    """Leave out flares that would not be added to the others: they stood for flares that were added later."""
    while len(flares) > 1:
        light, options = light_of(window, shape, flares), []
        for k in range(len(flares)):
            fewer = flares[:k] + flares[k + 1 :]
            fewer = _refine(Likelihood.of(window, fewer, shape, FURTHER_EPSILON), shape, fewer)
            likelihood = Likelihood.of(window, fewer, shape, FURTHER_EPSILON)
            options.append((float(likelihood.chi2(light_of(window, shape, fewer)) - likelihood.chi2(light)), fewer))
        fall, fewer = min(options, key=itemgetter(0))
        if fall >= FURTHER_GAIN:
            break
        flares = fewer
    return sorted(flares, key=lambda flare: -flare.equivalent_duration_s)


def light_of(window: Window, shape: Profile, flares: Sequence[FittedFlare]) -> Float:
    """Return the mean light of flares in the bins, in the unit of the values."""
    return np.asarray(_light_of_each(window, shape, _parameters(flares)).sum(axis=0))


def _light_of_each(window: Window, shape: Profile, parameters: Float) -> Float:
    """Return the light of each flare, shape (n_flare, n), for the parameters of `_parameters`."""
    amplitude, peak, width = parameters.reshape(-1, 3).T
    return np.asarray(np.exp(amplitude)[:, None] * window.model(shape, peak, np.exp(width)))


def _derivatives(window: Window, shape: Profile, parameters: Float) -> Float:
    """Return the derivatives of the light with the parameters of `_parameters`, shape (n_parameter, n)."""
    rows = parameters.reshape(-1, 3)
    steps = 1e-4 * np.column_stack([np.ones(len(rows)), np.exp(rows[:, 2]), np.ones(len(rows))])
    signs = np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    light = _light_of_each(window, shape, rows[:, None] + signs * steps[:, None]).reshape(len(rows), 4, -1)
    along = (light[:, 0::2] - light[:, 1::2]) / (2 * steps[:, 1:, None])
    unmoved = _light_of_each(window, shape, parameters)[:, None]
    return np.concatenate([unmoved, along], axis=1).reshape(parameters.size, -1)


def _parameters(flares: Sequence[FittedFlare]) -> Float:
    """Return the logarithm of the amplitude, the peak and the logarithm of the half-width of each flare."""
    return np.array([[np.log(f.amplitude), f.peak_s, np.log(f.half_width_s)] for f in flares]).ravel()


def _refine(likelihood: Likelihood, shape: Profile, flares: Sequence[FittedFlare]) -> list[FittedFlare]:
    """Return the flares that fit best, by least squares from a starting point."""
    window, root, start = likelihood.window, likelihood.root, _parameters(flares)
    scale = np.tile([0.3, 1.0, 0.3], len(flares))
    scale[1::3] = [0.3 * f.half_width_s for f in flares]
    span = window.edges[window.inside]
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[0::3], high[0::3] = start[0::3] - 8.0, start[0::3] + 8.0
    reach = max(f.half_width_s for f in flares)
    low[1::3], high[1::3] = span[0, 0] - 4 * reach, span[-1, 1]
    # A flare that is much longer than its event is no more than a level.
    low[2::3], high[2::3] = start[2::3] - 3.0, np.minimum(start[2::3] + 3.0, max(window.ranges[1, 1], np.log(reach)))

    def residual(x: Float) -> Float:
        return np.asarray(root @ (window.values - _light_of_each(window, shape, x).sum(axis=0)))

    def jacobian(x: Float) -> Float:
        return np.asarray(-root @ _derivatives(window, shape, x).T)

    result = scipy.optimize.least_squares(
        residual, np.clip(start, low, high), jac=jacobian, bounds=(low, high), x_scale=scale,
        ftol=1e-6, xtol=1e-6, max_nfev=60,
    )  # fmt: skip
    return [_flare(shape, p, np.exp(w), np.exp(a)) for a, p, w in result.x.reshape(-1, 3)]


def _fit_single(
    window: Window, family: Family, shape: Profile, flare: FittedFlare, box: Float, parts: Float | None = None
) -> list[Fit]:
    """Fit a single flare with each departure of a family, which follows from a first fit, `shape` and `flare`.

    The grid begins from the range `box`; `parts` are the means of the family at its nodes, if they are known.
    """
    durations = family.weights @ [part.equivalent_duration for part in family.parts]
    fits = []
    for epsilon in family.epsilon:
        likelihood = Likelihood.of(window, [flare], shape, epsilon)
        grid = PosteriorGrid.of(likelihood, family, box, parts)
        for _ in range(ROUNDS - 1 if epsilon else 0):
            # The departures are those of a flare, and the likelihood may fall as they follow the fit.
            (best_shape, best), member = grid.best, shape.name == family.name
            updated = Likelihood.of(window, [best], best_shape, epsilon)
            before = likelihood.log_of(light_of(window, shape, [flare]))
            if member and updated.log_of(light_of(window, best_shape, [best])) <= before:
                break
            change = abs(np.log(best.equivalent_duration_s / flare.equivalent_duration_s))
            shape, flare, likelihood = best_shape, best, updated
            grid = PosteriorGrid.of(likelihood, family, grid.box, grid.parts)
            if member and change < SETTLED:
                break
        box, parts = grid.box, grid.parts
        shape, flare = grid.best
        per_amplitude = grid.half_widths_s * durations[grid.shape] - grid.along(likelihood.departure)
        in_level = grid.along(likelihood.level)
        level = float(window.values @ likelihood.level) - grid.amplitude * in_level
        level = np.where(level > 0, level, window.quiet_level)
        mean = (grid.amplitude * per_amplitude + float(likelihood.departure @ window.values)) / level
        # Durations are relative to the level, which is lower where the flare is brighter.
        along = per_amplitude + mean * in_level
        unknown = likelihood.departure_variance + mean**2 * likelihood.level_variance
        sd = np.sqrt(along**2 / grid.information + unknown) / level
        constant = likelihood.log_factor - 0.5 * float(window.values @ likelihood.inverse @ window.values)
        prior = float(np.log(family.prior / len(family.epsilon)))
        fits.append(Fit(window, NormalMixture(grid.log + constant + prior, mean, sd), shape, [flare]))
    return fits


def _fit_several(window: Window, family: Family, flares: list[FittedFlare]) -> list[Fit]:
    """Fit several flares of a published shape with each departure from it, by the linearised model."""
    shape, n = family.shape(0), len(flares)
    # Each further flare may have any peak in the event, half-width and amplitude, in any order.
    span = window.edges[window.inside]
    volume = np.log(span[-1, 1] - span[0, 0]) + np.log(np.ptp(window.ranges[1])) + np.log(MAX_LOG_AMPLITUDE)
    prior = float(np.log(family.prior / len(family.epsilon)) - (n - 1) * (volume + 1.0) + scipy.special.gammaln(n + 1))
    fits = []
    for epsilon in family.epsilon:
        for _ in range(ROUNDS if epsilon else 1):
            likelihood = Likelihood.of(window, flares, shape, epsilon)
            before = sum(f.equivalent_duration_s for f in flares)
            flares = _refine(likelihood, shape, flares)
            if abs(np.log(sum(f.equivalent_duration_s for f in flares) / before)) < SETTLED:
                break
        likelihood = Likelihood.of(window, flares, shape, epsilon)
        parameters = _parameters(flares)
        light, slopes = light_of(window, shape, flares), _derivatives(window, shape, parameters)
        # Priors as wide as the parameters can be: a factor of e^2 in amplitude and half-width, two half-widths in peak.
        wide = np.tile([2.0, 1.0, 2.0], n)
        wide[1::3] = [2 * f.half_width_s for f in flares]
        covariance = np.linalg.inv(slopes @ likelihood.inverse @ slopes.T + np.diag(wide**-2.0))
        total = np.array([f.equivalent_duration_s for f in flares])
        level = float(likelihood.level_without(light))
        mean = float(total.sum() + likelihood.departure @ (window.values - light)) / level
        # Durations are relative to the level, which is lower where the flares are brighter.
        along = slopes @ (mean * likelihood.level - likelihood.departure)
        along[0::3] += total
        along[2::3] += total
        variance = float(along @ covariance @ along) + likelihood.departure_variance
        variance += mean**2 * likelihood.level_variance
        # As the grid of a single flare, without the factor of one amplitude.
        log = likelihood.log_of(light) + prior
        log += 0.5 * float(np.linalg.slogdet(covariance)[1]) + (3 * n - 1) / 2 * np.log(2 * np.pi)
        fits.append(Fit(window, NormalMixture(*np.array([[log], [mean], [np.sqrt(variance) / level]])), shape, flares))
    return fits
