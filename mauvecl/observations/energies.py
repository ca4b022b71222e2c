"""Equivalent durations of events, with intervals that include what is not known of level and shape.

The light near an event is the level, flares of a known shape, and noise:

    y = level + sum_j A_j s((t - p_j) / w_j) (1 + d(t)) + noise

The level has the covariance of the process of the star. The departure d of a flare from its shape is a Gaussian process
of standard deviation epsilon in the logarithm of the time from the peak (a model discrepancy as of Kennedy & O'Hagan
2001, doi 10.1111/1467-9868.00294). It makes the sum of the observed light decide where a flare is bright, and the
shape where it is not observed. Peak and half-width of a single flare are integrated on a grid, amplitudes, level and
departures in closed form; the shapes of `families` and epsilon are averaged with the weights of their marginal
likelihoods. Several flares of a published shape are fitted by least squares, and their errors are those of the
linearised model. Priors are flat in the peak and in the logarithms of half-width and amplitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.flares.shapes import Integrable, Shape, between, consecutive_integrals, sides
from mauvecl.observations.families import Family, WeightedSum, families
from mauvecl.observations.search import MIN_BASELINE

if TYPE_CHECKING:
    from mauvecl.observations.process import Process
    from mauvecl.observations.search import Detection, SeriesSurvey

Profile = Shape | WeightedSum
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Correlation of departures in the logarithm of 1 + time from the peak in half-widths (assumed).
LOG_TIME = 0.7
#: Light that departs where a shape has none, as a share of the amplitude at the peak (assumed); it falls by e in each
#: half-width.
FLOOR = 0.1
#: Largest number of bins in an event, and on each side of it; growth of the bins with the distance from the peak.
MAX_INSIDE, MAX_OUTSIDE, GROWTH = 160, 80, 6.0
#: Bins outside are shorter than this share of the shortest time scale of the process.
SHORT = 0.2
#: Nodes of the grid along peak and half-width for a shape and for many, and the fall of the log posterior beyond
#: which nodes are neglected.
NODES, NODES_OF_MANY, NEGLIGIBLE = 25, 17, 14.0
#: Logarithm of the largest amplitude in units of the range of the frames of the event, for a peak that is not seen.
MAX_LOG_AMPLITUDE = 5.0
#: Largest number of refinements of the grid.
REFINEMENTS = 6
#: First range of the peak, in half-widths of the template, and factor on the half-width.
PEAK_RANGE, WIDTH_RANGE = 2.5, 6.0
#: Half-widths of a shape before and after the peak beyond which it is neglected.
REACH = (5.0, 80.0)
#: Departure with which further flares of an event are searched, the fall of chi-squared that they need, and the
#: largest number.
FURTHER_EPSILON, FURTHER_GAIN, MAX_FLARES = 0.2, 36.0, 6
#: Fall of chi-squared by which a step must fit better than a flare.
STEP_GAIN = 9.0
#: Light of the fitted flares that the frames of an event may lack, in standard errors and as a share.
LACKING_ERRORS, LACKING_SHARE = 5.0, 0.5
#: Levels of the intervals.
LEVELS = (0.6826894921370859, 0.95)
#: Rounds in which the photon noise and the departures follow the fit, and the change of the logarithm of the equivalent
#: duration at which they end.
ROUNDS, SETTLED = 3, 0.02
#: Number of frames on each side of an event from which the error of its level follows.
NEARBY = 10_000
#: Number of frames on each side of an event that are fitted with it, and the same in lengths of the event: the level of
#: further ones would lower the variance of its sum by 1 % at most in independent noise, and less in that of a process.
WINDOW_FRAMES, WINDOW_LENGTHS = 2**15, 100


@dataclass(frozen=True)
class FittedFlare:
    """Flare fitted to an event."""

    peak_s: float  # in the stare
    amplitude: float  # relative to the level
    half_width_s: float
    equivalent_duration_s: float


@dataclass(frozen=True, eq=False)
class Energy:
    """Equivalent duration of an event."""

    summed_s: float  # sum of the light above the level over the frames of the event
    summed_error_s: float
    within_s: float  # light of the fitted flares in the same frames
    fitted_s: float  # of the whole flares; median of the posterior
    low_s: tuple[float, float]  # lower ends of the intervals of `LEVELS`
    high_s: tuple[float, float]
    flares: tuple[FittedFlare, ...]  # of the shape of the largest weight, the largest first
    shape: str
    chi2: float  # of these without departures from the shape
    dof: int
    departure: float  # mean of epsilon
    step: bool  # a step of the level fits better than a flare
    peak_observed: bool  # the peak lies in or next to an observed frame
    level: float  # of the star at the peak, in units of the survey's level

    @property
    def dips(self) -> bool:
        """Whether the frames of the event lack the light of its flares: the level falls in them, as by an eclipse."""
        error = np.hypot(self.summed_error_s, (self.high_s[0] - self.low_s[0]) / 2)
        lacking = self.within_s - self.summed_s
        return bool(lacking > LACKING_ERRORS * error and lacking > LACKING_SHARE * self.within_s)

    @property
    def unclear(self) -> bool:
        """Whether the frames of the event do not show its light: they are together not brighter than the level."""
        return self.summed_s <= 0

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large."""
        return float(scipy.stats.chi2.sf(self.chi2, self.dof)) if self.dof > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class Window:
    """Bins of frames around an event.

    Frames in a bin are consecutive. Values are those of the sum along the direction of the event's template.
    """

    survey: SeriesSurvey
    one: Detection
    edges: Float  # shape (n, 2); start and end of each bin
    values: Float  # shape (n,)
    noise: Float  # shape (n,); variance of the mean of each bin's frames
    frames: NDArray[np.int64]  # shape (n,); number of frames of each bin
    inside: Bool  # shape (n,); bins of the event
    scale: float  # value of unit amplitude
    photon: float  # rise of the variance of a frame with the amplitude
    quiet_level: float = 1.0  # of the star at the peak, by the frames without events, in units of the survey's level

    @classmethod
    def of(cls, survey: SeriesSurvey, taken: Bool, one: Detection, direction: int | None = None) -> Window:
        """Collect the frames of an event, and those around it that belong to no event."""
        direction = one.direction if direction is None else direction
        unit = survey.bank.directions[direction]
        row = survey.templates.chosen[direction]
        scale = float(np.linalg.norm(survey.templates.directions[row]))
        photon = float(unit @ survey.templates.noise[row] @ unit)
        excess = float(unit**2 @ np.array([p.excess for p in survey.processes]) ** 2)
        frame_s = survey.stare.frame_s
        peak = one.peak_s / frame_s
        # Only frames near the event, so that the time does not depend on the length of the light curve.
        reach = max(WINDOW_FRAMES, WINDOW_LENGTHS * (one.last - one.first + 1))
        low = max(0, one.first - reach)
        near = slice(low, one.last + 1 + reach)
        numbers, along, variance = survey.stare.numbers[near], survey.sums[near] @ unit, survey.variance[near]
        begin, end = one.first - low, one.last - low
        inside = np.zeros(along.size, np.bool_)
        inside[begin : end + 1] = True
        at = np.flatnonzero(inside | ~taken[near])
        distance = np.abs(numbers[at] - peak)
        size = np.ones(at.size)
        length = numbers[end] - numbers[begin] + 1
        size[inside[at]] = max(1, int(np.ceil(length / MAX_INSIDE)))
        shortest = min(process.shortest_s for process in survey.processes)
        ends = np.where(numbers[at] > peak, distance - (numbers[end] - peak), distance - (peak - numbers[begin]))
        outer = np.clip(np.maximum(ends, 0.0) / GROWTH, 1.0, max(1.0, SHORT * shortest / frame_s))
        size[~inside[at]] = np.maximum(np.floor(outer), size.min())[~inside[at]]
        bins = _bins(numbers[at], size, inside[at])
        first = np.flatnonzero(np.diff(bins, prepend=-1))
        count = np.diff(np.append(first, at.size))
        is_inside = inside[at][first]
        # As the start of the next frame, to the bit.
        start, stop = numbers[at[first]] * frame_s, (numbers[at[first + count - 1]] + 1) * frame_s
        mean = np.add.reduceat(along[at], first) / count
        noise = np.add.reduceat(variance[at] * excess, first) / count**2
        # The nearest bins on each side are kept.
        before = np.flatnonzero(~is_inside & (stop <= survey.stare.start_s[one.first] + frame_s / 2))
        after = np.flatnonzero(~is_inside & (start >= survey.stare.start_s[one.last] + frame_s / 2))
        kept = np.sort(np.concatenate([before[-MAX_OUTSIDE:], np.flatnonzero(is_inside), after[:MAX_OUTSIDE]]))
        return cls(
            survey, one, np.column_stack([start, stop])[kept], mean[kept], noise[kept], count[kept], is_inside[kept],
            scale, photon,
        )  # fmt: skip

    @cached_property
    def middle(self) -> Float:
        """Middle of each bin."""
        return np.asarray(self.edges.mean(axis=1))

    @cached_property
    def process(self) -> Float:
        """Covariance of the level in the bins, shape (n, n)."""
        unit = self.survey.bank.directions[self.one.direction]
        lags = self.middle[:, None] - self.middle
        total = np.zeros(lags.shape)
        for weight, process in zip(unit, self.survey.processes, strict=True):
            total += weight**2 * process.at(lags)
        return total

    def model(self, shape: Integrable, peak_s: Float, half_width_s: Float) -> Float:
        """Return the mean of shapes in the bins, in the unit of the values, (n_shape, n)."""
        times, place = self._times
        peak, width = (np.atleast_1d(one)[:, None] for one in (peak_s, half_width_s))
        both = sides(shape, (times - peak) / width)
        integral = between(both[..., place[0]], both[..., place[1]])
        return np.asarray(self.scale * integral * width / np.diff(self.edges)[:, 0])

    @cached_property
    def _times(self) -> tuple[Float, NDArray[np.intp]]:
        """Edges of bins, of which neighbours share one, and the places of each bin's start and end, shape (2, n)."""
        times, place = np.unique(self.edges.T.ravel(), return_inverse=True)
        return times, place.reshape(2, -1)


def _bins(numbers: NDArray[np.int64], size: Float, inside: Bool) -> NDArray[np.int64]:
    """Return the bin of each frame: consecutive frames, at most as many as the smallest size that they allow."""
    breaks = np.diff(numbers, prepend=numbers[:1] - 2) != 1
    breaks |= np.diff(inside, prepend=inside[:1])
    bins = []
    bin_number, held, limit = -1, 0, 0.0
    for breaks_here, most in zip(breaks.tolist(), size.tolist(), strict=True):
        limit = most if breaks_here or held >= limit else min(limit, most)
        if breaks_here or held >= limit:
            bin_number, held, limit = bin_number + 1, 0, most
        held += 1
        bins.append(bin_number)
    return np.array(bins, np.int64)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Inverse covariance of the values of a window, with the constant level integrated out."""

    window: Window
    inverse: Float  # shape (n, n)
    log_factor: float  # of the likelihood, without the constant
    # Integral of the departures of the flares from their shape, in amplitude x s: its covariance with the values, and
    # its variance.
    departure: Float  # shape (n,)
    variance: float
    # Weights of the values in the level of the star at the peak, and its variance with a known flare, relative to the
    # level; zero where the values are not its light.
    level: Float  # shape (n,)
    level_variance: float

    @classmethod
    def of(cls, window: Window, flares: Sequence[FittedFlare], shape: Profile, epsilon: float) -> Likelihood:
        """Compute the likelihood for the photon noise of some flares and departures from their shape."""
        n = window.values.size
        covariance = window.process + np.diag(window.noise)
        shared, variance = np.zeros(n), 0.0
        for one in flares:
            light = one.amplitude * window.model(shape, np.array([one.peak_s]), np.array([one.half_width_s]))[0]
            covariance += np.diag(window.photon * light / window.scale / window.frames)
            if epsilon:
                light = light + _floor(window.middle, one) * window.scale
                cells, cell_light = _unobserved(window, one, shape)
                place = _log_time(window.middle, one)
                elsewhere = _log_time(cells, one)
                near = np.exp(-np.abs(place[:, None] - place) / LOG_TIME)
                covariance += epsilon**2 * light[:, None] * light * near
                lengths = window.edges[:, 1] - window.edges[:, 0]
                whole = np.concatenate([light / window.scale * lengths, cell_light])
                every = np.concatenate([place, elsewhere])
                shared += epsilon**2 * light * (np.exp(-np.abs(place[:, None] - every) / LOG_TIME) @ whole)
                variance += epsilon**2 * float(whole @ np.exp(-np.abs(every[:, None] - every) / LOG_TIME) @ whole)
        factor = scipy.linalg.cho_factor(covariance, lower=True)
        inverse = scipy.linalg.cho_solve(factor, np.eye(n))
        ones = inverse.sum(axis=1)
        total = float(ones.sum())
        level, level_variance = np.zeros(n), 0.0
        if len(window.survey.bank.directions) == 1:
            at = int(np.argmin(np.abs(window.middle - window.one.peak_s)))
            toward = inverse @ window.process[at]
            rest = 1.0 - float(window.process[at] @ ones)
            level = (toward + rest * ones / total) / window.scale
            known = float(window.process[at, at] - window.process[at] @ toward) + rest**2 / total
            level_variance = max(known, 0.0) / window.scale**2
        inverse = inverse - ones[:, None] * ones / total
        log_factor = -float(np.log(np.diag(factor[0])).sum()) - 0.5 * float(np.log(total))
        return cls(window, inverse, log_factor, shared, variance, level, level_variance)

    def matched(self, parts: Float, weights: Float, values: Float) -> tuple[Float, Float]:
        """Return the products of models and values, and of models with themselves, shape (n_shape, n_node).

        Models are sums of parts, shape (n_part, n_node, n), with weights, shape (n_shape, n_part). The first product is
        zero for models that are constant but for rounding errors, as bright in all bins as the level.
        """

        # A shape has few of the parts.
        pairs = scipy.sparse.csr_array((weights[:, :, None] * weights[:, None]).reshape(len(weights), -1))

        def norms(weighted: Float) -> Float:
            gram = weighted.transpose(1, 0, 2) @ parts.transpose(1, 2, 0)
            return np.asarray(pairs @ gram.reshape(len(gram), -1).T)

        information = norms((parts.reshape(-1, values.size) @ self.inverse).reshape(parts.shape))
        least = np.maximum(1e-9 * norms(parts * np.diag(self.inverse)), 1e-300)
        slope = np.where(information > least, weights @ (parts @ (self.inverse @ values)), 0.0)
        return slope, np.maximum(information, least)

    def level_without(self, light: Float) -> Float:
        """Return the level of the star at the peak once the light of flares, shape (n,) or (k, n), is subtracted.

        The tail of a bright flare raises the level of the frames without events. That level is returned only where the
        values are not the star's light, or where the fitted level is not above zero.
        """
        fitted = (self.window.values - light) @ self.level
        return np.where(fitted > 0, fitted, self.window.quiet_level)

    def chi2(self, model: Float) -> Float:
        """Return chi-squared of the values with models, of shape (n,) or (k, n), added to the level."""
        left = self.window.values - model
        return np.asarray(np.einsum("...i,...i->...", left @ self.inverse, left))


def _log_time(time_s: Float, one: FittedFlare) -> Float:
    tau = (time_s - one.peak_s) / one.half_width_s
    return np.asarray(np.sign(tau) * np.log1p(np.abs(tau)))


def _floor(time_s: Float, one: FittedFlare) -> Float:
    """Return the light of a flare that may be where its shape has none."""
    return np.asarray(FLOOR * one.amplitude * np.exp(-np.abs(time_s - one.peak_s) / one.half_width_s))


def _unobserved(window: Window, one: FittedFlare, shape: Profile) -> tuple[Float, Float]:
    """Return middles of intervals without bins near a flare, and the light of the flare in them, in amplitude x s."""
    tau = np.concatenate([-np.geomspace(REACH[0], 0.05, 12), [0.0], np.geomspace(0.05, REACH[1], 24)])
    edges = np.unique(np.concatenate([one.peak_s + tau * one.half_width_s, window.edges.ravel()]))
    edges = edges[(edges >= one.peak_s - REACH[0] * one.half_width_s)
                  & (edges <= one.peak_s + REACH[1] * one.half_width_s)]  # fmt: skip
    if edges.size < 2:
        return np.zeros(0), np.zeros(0)
    middle = (edges[:-1] + edges[1:]) / 2
    place = np.searchsorted(window.edges[:, 0], middle, side="right") - 1
    seen = (place >= 0) & (middle < window.edges[np.maximum(place, 0), 1])
    integrals = consecutive_integrals(shape, (edges - one.peak_s) / one.half_width_s)
    light = one.amplitude * one.half_width_s * integrals + _floor(middle, one) * np.diff(edges)
    return middle[~seen], light[~seen]


@dataclass(frozen=True, eq=False)
class Mixture:
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
        weight = np.exp(self.log_weight - self.log_weight.max())
        kept = weight > 1e-8
        weight, mean, sd = weight[kept] / weight[kept].sum(), self.mean[kept], np.maximum(self.sd[kept], 1e-300)
        below = float(weight @ scipy.special.ndtr(-mean / sd))
        goal = below + probability * (1.0 - below)
        low, high = max(0.0, float((mean - 10 * sd).min())), float((mean + 10 * sd).max())
        return float(
            scipy.optimize.brentq(
                lambda x: float(weight @ scipy.special.ndtr((x - mean) / sd)) - goal, low, high, xtol=1e-9 * abs(high)
            )
        ) if high > low else low  # fmt: skip


def _joined(parts: Sequence[Mixture]) -> Mixture:
    """Return the mixture of several."""
    names = ("log_weight", "mean", "sd")
    return Mixture(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of an event by flares of a family with some departure from their shape."""

    mixture: Mixture
    shape: Profile  # the best of the family
    flares: list[FittedFlare]  # the best, of that shape
    epsilon: float


def _fits(window: Window, searched: Shape) -> list[Fit]:
    """Fit an event by a single flare of each family, and by several flares of each published shape that needs them."""
    *published, general = families(searched)
    first = {family.name: _first_fit(window, family) for family in published}
    fits = []
    for family in published:
        grid = first[family.name]
        shape, flare = grid.best
        fits += _single(window, family, shape, flare, grid.box)
        several = _further(window, shape, [flare])
        if len(several) > 1:
            fits += _several(window, family, several)
    best = max(first.values(), key=lambda grid: float(scipy.special.logsumexp(grid.log)))
    boxes = np.array([grid.box for grid in first.values()])
    return fits + _single(window, general, *best.best, _wider(boxes))


def measure_energy(survey: SeriesSurvey, taken: Bool, flux_level: Float, one: Detection) -> Energy:
    """Measure the equivalent duration of an event.

    Parameters
    ----------
    survey, taken, flux_level, one
        As for `measure_event`.
    """
    peak = int(np.clip(np.searchsorted(survey.stare.middle_s, one.peak_s), 0, survey.stare.n_frames - 1))
    level = float(flux_level[peak]) * survey.scale / survey.level
    window = replace(Window.of(survey, taken, one), quiet_level=level if level > 0 else 1.0)
    directions = _directions(survey, taken, one)
    fits = _fits(window, survey.bank.shape)
    mixture = _joined([fit.mixture for fit in fits])
    totals = np.array([fit.mixture.log_total for fit in fits])
    share = np.exp(totals - mixture.log_total)
    best = fits[int(np.argmax(totals))]
    shape, flares = best.shape, best.flares
    if len(directions) > 1:
        # Flares of other temperatures have another light for the same sum.
        mixture = _joined([Mixture(mixture.log_weight + weight, factor * mixture.mean, factor * mixture.sd)
                           for weight, factor in directions])  # fmt: skip
    plain = Likelihood.of(window, flares, shape, 0.0)
    model = _light(window, shape, flares)
    level = float(plain.level_without(model))
    summed, error = _summed(survey, taken, flux_level, one)
    frame_s = survey.stare.frame_s
    start = survey.stare.start_s[one.first : one.last + 1]
    within = sum(f.amplitude * f.half_width_s * float(between(
        sides(shape, (start - f.peak_s) / f.half_width_s), sides(shape, (start + frame_s - f.peak_s) / f.half_width_s)
    ).sum()) for f in flares)  # fmt: skip
    ends = [[mixture.quantile(0.5 + sign * width / 2) for width in LEVELS] for sign in (-1, 1)]
    apart_s = np.abs(survey.stare.middle_s[one.first : one.last + 1] - flares[0].peak_s)
    observed = bool((apart_s <= 1.5 * frame_s).any())
    return Energy(
        summed / level, error / level, within / level, mixture.quantile(0.5), (ends[0][0], ends[0][1]),
        (ends[1][0], ends[1][1]),
        tuple(replace(f, amplitude=f.amplitude / level, equivalent_duration_s=f.equivalent_duration_s / level)
              for f in flares), shape.name, float(plain.chi2(model)), window.values.size - 1 - 3 * len(flares),
        float(share @ np.array([fit.epsilon for fit in fits])),
        _is_step(window, plain, float(plain.chi2(model)), len(flares)), observed, level,
    )  # fmt: skip


def flares_of(survey: SeriesSurvey, taken: Bool, one: Detection) -> tuple[list[FittedFlare], float, float]:
    """Return the flares of the shape of the bank that fit an event best.

    Returns
    -------
    flares : list of FittedFlare
    scale : float
        Light of unit amplitude in the sum along the direction of the event.
    photon : float
        Rise of the variance of that sum with the amplitude.
    """
    window = Window.of(survey, taken, one)
    shape = survey.bank.shape
    return _further(window, shape, [_first_fit(window, Family.of(shape, 1.0)).best[1]]), window.scale, window.photon


def _directions(survey: SeriesSurvey, taken: Bool, one: Detection) -> list[tuple[float, float]]:
    """Return the log weight of each direction of the bank, and its light relative to that of the event's direction."""
    if len(survey.bank.directions) == 1:
        return [(0.0, 1.0)]
    scores = []
    for direction in range(len(survey.bank.directions)):
        window = Window.of(survey, taken, one, direction)
        noise = np.diag(window.process) + window.noise
        model = window.model(survey.bank.shape, np.array([one.peak_s]), np.array([one.half_width_s]))[0]
        weight = model / noise
        level = window.values[~window.inside]
        level_mean = (
            float(level @ (1 / noise)[~window.inside] / (1 / noise)[~window.inside].sum()) if level.size else 0.0
        )
        value = float(weight @ (window.values - level_mean)) / np.sqrt(float(weight @ model))
        scores.append((value, window.scale))
    mine = scores[one.direction]
    return [(0.5 * np.sign(value) * value**2 - 0.5 * mine[0] ** 2, mine[1] / scale * value / mine[0])
            for value, scale in scores if value > 0]  # fmt: skip


def _flare(shape: Profile, peak: float, width: float, amplitude: float) -> FittedFlare:
    return FittedFlare(
        float(peak), float(amplitude), float(width), float(amplitude * width * shape.equivalent_duration)
    )


@dataclass(frozen=True, eq=False)
class Grid:
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
    def of(cls, likelihood: Likelihood, family: Family, box: Float, outer: Float) -> Grid:
        """Compute the posterior on a grid that is refined or widened until it covers all that is not negligible.

        Parameters
        ----------
        box, outer : ndarray, shape (2, 2)
            First and largest range of the peak and of the logarithm of the half-width.
        """
        window = likelihood.window
        n_node = NODES if len(family.weights) == 1 else NODES_OF_MANY
        brightest = np.exp(MAX_LOG_AMPLITUDE) * float(np.ptp(window.values[window.inside])) / window.scale
        for _ in range(REFINEMENTS):
            axes = [np.linspace(low, high, n_node) for low, high in box]
            p, w = (each.ravel() for each in np.meshgrid(axes[0], axes[1], indexing="ij"))
            parts = np.array([window.model(part, p, np.exp(w)) for part in family.parts])
            slope, information = likelihood.matched(parts, family.weights, window.values)
            amplitude = slope / information
            step = (box[:, 1] - box[:, 0]) / (n_node - 1)
            # The integral over the logarithm of the amplitude divides by the S/N.
            snr = np.maximum(slope / np.sqrt(information), 1.0)
            log = 0.5 * slope**2 / information - np.log(snr) + float(np.log(step).sum() - np.log(len(family.weights)))
            log[(slope <= 0) | (amplitude > max(brightest, 1e-12))] = -1e300
            which, node = np.nonzero(log >= log.max() - NEGLIGIBLE)
            found = cls(
                family, parts, which, node, p[node], np.exp(w[node]), log[which, node], amplitude[which, node],
                information[which, node], box,
            )  # fmt: skip
            ends = np.array([[p[node].min(), p[node].max()], [w[node].min(), w[node].max()]])
            low, high = ends[:, 0] - step, ends[:, 1] + step
            # Where the posterior reaches an end, the grid is widened.
            wide = np.diff(box)[:, 0]
            low = np.where(ends[:, 0] <= box[:, 0] + step / 2, box[:, 0] - wide / 2, low)
            high = np.where(ends[:, 1] >= box[:, 1] - step / 2, box[:, 1] + wide / 2, high)
            new = np.column_stack([np.maximum(low, outer[:, 0]), np.minimum(high, outer[:, 1])])
            size = np.diff(new)[:, 0] / wide
            if ((size > 0.6) & (size < 1.1)).all():
                break
            box = new
        return found


def _wider(boxes: Float) -> Float:
    """Return a range that contains others, and half as much on each side."""
    low, high = boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0)
    return np.column_stack([low - (high - low) / 2, high + (high - low) / 2])


def _ranges(window: Window) -> Float:
    """Return the largest ranges of the peak and of the logarithm of the half-width of a single flare, shape (2, 2).

    A gap before the event may hold the peak.
    """
    one, survey = window.one, window.survey
    frame_s = survey.stare.frame_s
    first_s, last_s = survey.stare.start_s[one.first], survey.stare.start_s[one.last] + frame_s
    low, high = one.peak_s - PEAK_RANGE * one.half_width_s, one.peak_s + PEAK_RANGE * one.half_width_s
    earlier = survey.stare.start_s[: one.first]
    low = min(low, max(first_s - 4 * one.half_width_s, (float(earlier[-1]) + frame_s) if earlier.size else -np.inf))
    high = min(max(high, low + frame_s), last_s)
    widest = max(survey.bank.half_widths_s[-1], one.half_width_s) * 3
    width = (max(one.half_width_s / WIDTH_RANGE, 0.2 * frame_s), min(one.half_width_s * WIDTH_RANGE, widest))
    return np.array([[low, high], np.log(width)])


def _first_fit(window: Window, family: Family) -> Grid:
    """Return the posterior of a single flare without departures from a shape."""
    outer = _ranges(window)
    grid = Grid.of(Likelihood.of(window, [], family.shape(0), 0.0), family, outer, outer)
    shape, flare = grid.best
    return Grid.of(Likelihood.of(window, [flare], shape, 0.0), family, grid.box, outer)


def _further(window: Window, shape: Profile, flares: list[FittedFlare]) -> list[FittedFlare]:
    """Add flares to an event as long as they improve the fit, even if each departs from its shape."""
    frame_s = window.survey.stare.frame_s
    inside = window.middle[window.inside]
    if inside.size < 8:
        return flares
    widths = np.geomspace(max(frame_s, 0.1 * flares[0].half_width_s), max(2 * frame_s, 3 * flares[0].half_width_s), 8)
    step = max(frame_s / 2, float(np.ptp(inside)) / 200)
    p, w = (grid.ravel() for grid in np.meshgrid(np.arange(inside[0], inside[-1], step), widths, indexing="ij"))
    every = window.model(shape, p, w)[None]
    while len(flares) < MAX_FLARES:
        likelihood = Likelihood.of(window, flares, shape, FURTHER_EPSILON)
        light = _light(window, shape, flares)
        slope, information = likelihood.matched(every, np.ones((1, 1)), window.values - light)
        gain = np.where(slope > 0, slope**2 / information, 0.0)[0]
        k = int(np.argmax(gain))
        if gain[k] < FURTHER_GAIN:
            break
        more = [*flares, _flare(shape, p[k], w[k], slope[0, k] / information[0, k])]
        refined = _refined(likelihood, shape, more)
        fall = float(likelihood.chi2(light) - likelihood.chi2(_light(window, shape, refined)))
        if fall < FURTHER_GAIN:
            break
        flares = sorted(refined, key=lambda one: -one.equivalent_duration_s)
    return flares


def _light(window: Window, shape: Profile, flares: Sequence[FittedFlare]) -> Float:
    """Return the mean light of flares in the bins, in the unit of the values."""
    return np.asarray(_lights(window, shape, _parameters(flares)).sum(axis=0))


def _lights(window: Window, shape: Profile, parameters: Float) -> Float:
    """Return the light of each flare, shape (n_flare, n), for the parameters of `_parameters`."""
    amplitude, peak, width = parameters.reshape(-1, 3).T
    return np.asarray(np.exp(amplitude)[:, None] * window.model(shape, peak, np.exp(width)))


def _slopes(window: Window, shape: Profile, parameters: Float) -> Float:
    """Return the derivatives of the light with the parameters of `_parameters`, shape (n_parameter, n)."""
    rows = parameters.reshape(-1, 3)
    steps = 1e-4 * np.column_stack([np.exp(rows[:, 2]), np.ones(len(rows))])
    moved = np.repeat(rows[:, None], 4, axis=1)
    moved[:, 0, 1] += steps[:, 0]
    moved[:, 1, 1] -= steps[:, 0]
    moved[:, 2, 2] += steps[:, 1]
    moved[:, 3, 2] -= steps[:, 1]
    light = _lights(window, shape, moved).reshape(len(rows), 4, -1)
    along = (light[:, 0::2] - light[:, 1::2]) / (2 * steps[:, :, None])
    return np.concatenate([_lights(window, shape, parameters)[:, None], along], axis=1).reshape(parameters.size, -1)


def _parameters(flares: Sequence[FittedFlare]) -> Float:
    """Return the logarithm of the amplitude, the peak and the logarithm of the half-width of each flare."""
    return np.array([[np.log(f.amplitude), f.peak_s, np.log(f.half_width_s)] for f in flares]).ravel()


def _refined(likelihood: Likelihood, shape: Profile, flares: Sequence[FittedFlare]) -> list[FittedFlare]:
    """Return the flares that fit best, by least squares from a starting point."""
    window = likelihood.window
    # The inverse has rank n - 1; its root is that of its eigenvalues.
    value, vector = np.linalg.eigh(likelihood.inverse)
    root = np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T
    start = _parameters(flares)
    scale = np.tile([0.3, 1.0, 0.3], len(flares))
    scale[1::3] = [0.3 * f.half_width_s for f in flares]
    span = window.edges[window.inside]
    low, high = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    low[0::3], high[0::3] = start[0::3] - 8.0, start[0::3] + 8.0
    reach = max(f.half_width_s for f in flares)
    low[1::3], high[1::3] = span[0, 0] - 4 * reach, span[-1, 1]
    low[2::3], high[2::3] = start[2::3] - 3.0, start[2::3] + 3.0

    def residual(x: Float) -> Float:
        return np.asarray(root @ (window.values - _lights(window, shape, x).sum(axis=0)))

    def jacobian(x: Float) -> Float:
        return np.asarray(-root @ _slopes(window, shape, x).T)

    found = scipy.optimize.least_squares(
        residual, np.clip(start, low, high), jac=jacobian, bounds=(low, high), x_scale=scale,
        ftol=1e-6, xtol=1e-6, max_nfev=60,
    )  # fmt: skip
    return [_flare(shape, p, np.exp(w), np.exp(a)) for a, p, w in found.x.reshape(-1, 3)]


def _single(window: Window, family: Family, shape: Profile, flare: FittedFlare, box: Float) -> list[Fit]:
    """Fit a single flare with each departure of a family from its shapes.

    Parameters
    ----------
    shape, flare
        A first fit, from which the departures follow.
    box : ndarray, shape (2, 2)
        Range of the peak and of the logarithm of the half-width from which the grid begins.
    """
    outer = _ranges(window)
    box = np.column_stack([np.maximum(box[:, 0], outer[:, 0]), np.minimum(box[:, 1], outer[:, 1])])
    fits = []
    for epsilon in family.epsilon:
        for _ in range(ROUNDS if epsilon else 1):
            likelihood = Likelihood.of(window, [flare], shape, epsilon)
            grid = Grid.of(likelihood, family, box, outer)
            before, box = flare.equivalent_duration_s, grid.box
            shape, flare = grid.best
            if abs(np.log(flare.equivalent_duration_s / before)) < SETTLED:
                break
        toward = likelihood.inverse @ likelihood.departure
        per_amplitude = grid.half_widths_s * family.durations[grid.shape] - grid.along(toward)
        in_level = grid.along(likelihood.level)
        level = float(window.values @ likelihood.level) - grid.amplitude * in_level
        level = np.where(level > 0, level, window.quiet_level)
        mean = (grid.amplitude * per_amplitude + float(toward @ window.values)) / level
        left = max(likelihood.variance - float(toward @ likelihood.departure), 0.0)
        # Durations are relative to the level, which is lower where the flare is brighter.
        along = per_amplitude + mean * in_level
        sd = np.sqrt(along**2 / grid.information + left + mean**2 * likelihood.level_variance) / level
        constant = likelihood.log_factor - 0.5 * float(window.values @ likelihood.inverse @ window.values)
        prior = float(np.log(family.prior / len(family.epsilon)))
        fits.append(Fit(Mixture(grid.log + constant + prior, mean, sd), shape, [flare], epsilon))
    return fits


def _several(window: Window, family: Family, flares: list[FittedFlare]) -> list[Fit]:
    """Fit several flares of a published shape with each departure from it, by the linearised model."""
    shape, n = family.shape(0), len(flares)
    # Each further flare may have any peak in the event, half-width and amplitude, in any order.
    outer = _ranges(window)
    span = window.edges[window.inside]
    each = np.log(span[-1, 1] - span[0, 0]) + np.log(np.ptp(outer[1])) + np.log(MAX_LOG_AMPLITUDE)
    prior = float(np.log(family.prior / len(family.epsilon)) - (n - 1) * (each + 1.0) + scipy.special.gammaln(n + 1))
    fits = []
    for epsilon in family.epsilon:
        for _ in range(ROUNDS if epsilon else 1):
            likelihood = Likelihood.of(window, flares, shape, epsilon)
            before = sum(f.equivalent_duration_s for f in flares)
            flares = _refined(likelihood, shape, flares)
            if abs(np.log(sum(f.equivalent_duration_s for f in flares) / before)) < SETTLED:
                break
        likelihood = Likelihood.of(window, flares, shape, epsilon)
        parameters = _parameters(flares)
        light, slopes = _light(window, shape, flares), _slopes(window, shape, parameters)
        # Priors as wide as the parameters can be: a factor of e^2 in amplitude and half-width, two half-widths in peak.
        wide = np.tile([2.0, 1.0, 2.0], n)
        wide[1::3] = [2 * f.half_width_s for f in flares]
        covariance = np.linalg.inv(slopes @ likelihood.inverse @ slopes.T + np.diag(wide**-2.0))
        total = np.array([f.equivalent_duration_s for f in flares])
        gradient = np.zeros(parameters.size)
        gradient[0::3] = gradient[2::3] = total
        toward = likelihood.inverse @ likelihood.departure
        along = gradient - slopes @ toward
        level = float(likelihood.level_without(light))
        mean = float(total.sum() + toward @ (window.values - light)) / level
        # Durations are relative to the level, which is lower where the flares are brighter.
        along += mean * (slopes @ likelihood.level)
        left = max(likelihood.variance - float(toward @ likelihood.departure), 0.0)
        variance = float(along @ covariance @ along) + left + mean**2 * likelihood.level_variance
        # As the grid of a single flare, without the factor of one amplitude.
        log = likelihood.log_factor - 0.5 * float(likelihood.chi2(light)) + prior
        log += 0.5 * float(np.linalg.slogdet(covariance)[1]) + (3 * n - 1) / 2 * np.log(2 * np.pi)
        fits.append(Fit(Mixture(*np.array([[log], [mean], [np.sqrt(variance) / level]])), shape, flares, epsilon))
    return fits


def _summed(survey: SeriesSurvey, taken: Bool, level: Float, one: Detection) -> tuple[float, float]:
    """Return the sum of the light above the level over the frames of an event, amplitude x s, and its error.

    Missing frames are interpolated. The error includes that of the level given the quiescent frames.
    """
    rows = slice(one.first, one.last + 1)
    flux, numbers = survey.flux[rows] - level[rows], survey.stare.numbers[rows]
    every = np.arange(numbers[0], numbers[-1] + 1)
    factor = survey.stare.frame_s * survey.scale / survey.level
    total = float(np.interp(every, numbers, flux).sum()) * factor
    # Each frame counts for itself and for the missing frames next to it.
    counts = np.bincount(np.rint(np.interp(every, numbers, np.arange(numbers.size))).astype(np.int64),
                         minlength=numbers.size)  # fmt: skip
    process = survey.flux_process
    begin = max(0, one.first - NEARBY)
    part = slice(begin, one.last + 1 + NEARBY)
    time, noise = survey.stare.start_s[part], survey.flux_variance[part] * process.excess**2
    event = slice(one.first - begin, one.last + 1 - begin)
    photon = survey.photon / survey.scale * np.maximum(flux, 0.0)
    variance = float(counts**2 @ (noise[event] + photon))
    quiet = ~taken[part]
    if quiet.sum() >= MIN_BASELINE:
        # Variance of the sum of the level given quiescent frames: w^T K w less what they say of it.
        near = np.zeros(quiet.size)
        near[event] = counts
        # Durations are relative to the level at the peak.
        middle = time[event] + survey.stare.frame_s / 2
        peak = event.start + min(int(np.searchsorted(middle, one.peak_s)), numbers.size - 1)
        near[peak] += total / factor / max(float(level[begin + peak]), 1e-12)
        variance += _level_variance(process, time, noise, quiet, near)
    return total, float(np.sqrt(max(variance, 0.0))) * factor


def _level_variance(process: Process, time: Float, noise: Float, quiet: Bool, weights: Float) -> float:
    """Return the variance of a weighted sum of the level given quiescent frames."""
    one = process.covariance(time[quiet], noise[quiet])
    level = one.solve(np.ones(int(quiet.sum())))
    constant = 1.0 / float(level.sum())
    if not process.terms:
        return float(weights.sum()) ** 2 * constant
    # K w at all times.
    shared = process.times(time, weights)
    towards = shared[quiet]
    solved = one.solve(towards)
    # The constant level is known to 1 / (1^T C^-1 1).
    rest = float(weights.sum() - level @ towards)
    return float(weights @ shared - towards @ solved) + rest**2 * constant


def _is_step(window: Window, plain: Likelihood, chi2: float, n_flares: int) -> bool:
    """Return whether a step of the level fits an event better than its flares do."""
    inside = window.middle[window.inside]
    if inside.size < 3:
        return False
    starts = window.edges[(window.middle > inside[0] - np.ptp(inside)) & (window.middle < inside[-1]), 0]
    if not starts.size:
        return False
    models = (window.middle >= starts[:, None]).astype(np.float64)
    slope = models @ (plain.inverse @ window.values)
    information = np.einsum("ki,ki->k", models @ plain.inverse, models)
    fine = information > 1e-12
    gain = np.where(fine & (slope > 0), slope**2 / np.where(fine, information, 1.0), 0.0)
    whole = float(plain.chi2(np.zeros(window.values.size)))
    # Each further flare has three parameters more (Schwarz 1978).
    further = 3 * (n_flares - 1) * float(np.log(window.values.size))
    return whole - float(gain.max()) < chi2 + further - STEP_GAIN
