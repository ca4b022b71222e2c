"""Rare false alarms: thresholds by importance sampling, and probabilities of campaigns of many tests.

Probabilities too small to count follow from importance sampling of the engine's noise model. The normals behind each
pixel are drawn from a distribution under which an alarm is common, and each realisation counts with the ratio of the
two densities (exponential tilting; Siegmund 1976, doi 10.1214/aos/1176343541). Everything after the normals (skew of
the dark, rounding, clipping, the statistic itself) is the engine's. Drawn unknowns follow their priors in one half of
the realisations, and their distribution in alarms in the other half.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from mauvecl.detection import check_atom, check_probability, least_countable
from mauvecl.detection.distributions import (
    CONFIDENCE_SD,
    Interval,
    Mixture,
    QuadraticForm,
    central_counts,
    clopper_pearson,
)
from mauvecl.detection.statistics import Differences
from mauvecl.host.arrays import Float
from mauvecl.noise import layout, reference
from mauvecl.noise.disturbances import ADDITIVE
from mauvecl.noise.scene import Scene, factor_nodes, quantile_at_score
from mauvecl.noise.unknowns import PROCESSES, SIGNAL_PARTS
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.detection.requests import Hypotheses

#: Number of simulated campaigns with overlapping stacks.
SIMULATIONS = 20_000
#: Tests per simulated stretch of overlapping stacks; longer campaigns consist of several stretches.
STRETCH = 4_096
#: Smallest number of simulated maxima beyond a threshold.
MIN_BEYOND = 100


@dataclass(frozen=True)
class CampaignRisk:
    """Probability of any false alarm in a campaign, or that per test for a wanted probability of the campaign."""

    tests: int
    bound: float  # for any dependence of the tests (Bonferroni)
    independent: float  # for independent tests
    overlapping: Interval | None  # for a normal statistic of overlapping stacks; None without overlap


def per_test(wanted: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> CampaignRisk:
    """Return the false-alarm probability per test that gives the wanted one of a campaign; the inverse of `campaign`.

    The bound suffices for any dependence of the tests, and the probability for independent tests also for overlapping
    stacks of a linear statistic. `overlapping` is None if too few simulated maxima lie beyond the threshold.

    Examples
    --------
    >>> from mauvecl.detection.tails import campaign, per_test
    >>> one = per_test(0.01, 17_280)
    >>> f"{one.bound:.3g} {one.independent:.3g}"
    '5.79e-07 5.82e-07'
    >>> round(campaign(one.independent, 17_280).independent, 6)
    0.01
    """
    step = stack if step is None else step
    tests = count_tests(frames, stack, step)
    check_probability("wanted campaign fap", wanted)
    overlapping = None
    if step < stack and tests > 1:
        stretch = min(tests, STRETCH)
        share = float(-np.expm1(stretch / tests * np.log1p(-wanted)))
        if share * SIMULATIONS >= MIN_BEYOND:
            maxima = np.sort(_maxima(stretch, stack, step, seed)) / np.sqrt(stack)
            low, high = central_counts(SIMULATIONS, share)
            counts = (round(share * SIMULATIONS), low, high)
            overlapping = Interval(*(float(special.ndtr(-maxima[SIMULATIONS - k])) for k in counts))
    return CampaignRisk(tests, wanted / tests, float(-np.expm1(np.log1p(-wanted) / tests)), overlapping)


def campaign(fap: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> CampaignRisk:
    """Return the false-alarm probability of a search through consecutive frames.

    `fap` is that of one test, `stack` the number of frames summed in a test, and `step` that from one stack to the
    next, by default `stack`. Smaller steps make stacks overlap, so that neighbouring tests are correlated by their
    fraction of common frames. Sums of frames are nearly normal, so a linear statistic of overlapping stacks is a moving
    average of independent normals, whose maximum is simulated. The correlation of chi-squared statistics is the square
    of this one, so their probability lies between `overlapping` and `independent`.

    Examples
    --------
    >>> from mauvecl.detection.tails import campaign
    >>> day = campaign(1e-5, 17_280)
    >>> day.tests, round(day.bound, 4), round(day.independent, 4)
    (17280, 0.1728, 0.1587)
    """
    step = stack if step is None else step
    tests = count_tests(frames, stack, step)
    check_probability("fap", fap)
    independent, overlapping = float(-np.expm1(tests * np.log1p(-fap))), None
    if step < stack and tests > 1:
        # The probability of an alarm in a stretch; stretches are combined as if they were independent.
        stretch = min(tests, STRETCH)
        alarms = int((_maxima(stretch, stack, step, seed) >= -special.ndtri(fap) * np.sqrt(stack)).sum())
        fraction = clopper_pearson(alarms, SIMULATIONS)
        chances = np.minimum([fraction.value, fraction.low, fraction.high], 1 - 1e-16)
        overlapping = Interval(*(-np.expm1(tests / stretch * np.log1p(-chances))).tolist())
    return CampaignRisk(tests, min(tests * fap, 1.0), independent, overlapping)


def count_tests(frames: int, stack: int, step: int) -> int:
    """Return the number of stacks in a campaign."""
    if not (1 <= stack <= frames and 1 <= step <= stack):
        raise InputError(
            f"a campaign of {frames} frames in stacks of {stack}, {step} apart, must have 1 <= step <= stack <= frames",
            key="step",
        )
    return (frames - stack) // step + 1


def _maxima(stretch: int, stack: int, step: int, seed: int) -> Float:
    """Draw the largest sum of normals over a stretch of overlapping stacks, shape (SIMULATIONS,)."""
    generator = np.random.default_rng(seed)
    size = (stretch - 1) * step + stack
    block = max(2**22 // size, 1)
    parts = []
    for start in range(0, SIMULATIONS, block):
        sums = np.cumsum(generator.standard_normal((min(block, SIMULATIONS - start), size)), axis=1)
        sums = np.pad(sums, ((0, 0), (1, 0)))
        parts.append((sums[:, stack:] - sums[:, :-stack])[:, ::step].max(axis=1))
    return np.concatenate(parts)


#: Initial and largest number of realisations, which is doubled in each step.
FIRST_REALISATIONS, MAX_REALISATIONS = 8_000, 512_000
#: Target relative standard error of the false-alarm probability.
WANTED_ERROR = 0.02
#: Realisations drawn at once, from one range of counters.
BLOCK = 500
#: Second half of the generator's key, which separates these draws from the engine's.
TAIL_KEY = 0x7461696C
#: Largest number of averaged quiescent exposures, since each is drawn on the host.
MAX_AVERAGED = 30
#: Smallest false-alarm probability for which the polynomial of the draw was tested.
SMALLEST_FAP = 1e-10


@dataclass(frozen=True)
class Tail:
    """A threshold from importance sampling."""

    threshold: Interval
    fap: float
    relative_error: float  # of the false-alarm probability at the threshold
    realisations: int  # number of tilted draws


def tail(hypotheses: Hypotheses, fap: float, statistic: str, *, template: int = 0, seed: int) -> Tail:
    """Find the threshold of a false-alarm probability from 1e-10 to 0.1 by importance sampling.

    `template` is the index of the flare that shaped statistics use as template. Raises NoThresholdError if no threshold
    has the probability. Raises InputError if noise is not drawn jointly and in stacks, additive processes are drawn,
    priors are drawn that the statistics are not marginalised over, more than 30 quiescent exposures are averaged, or
    the error remains too large.
    """
    if not SMALLEST_FAP <= fap <= 0.1:
        raise InputError.of("fap", fap, f"between {SMALLEST_FAP:g} and 0.1 for importance sampling")
    _check(hypotheses, fap)
    tilt = _Tilt.for_alarms(fap, hypotheses, statistic, template)
    blocks: list[tuple[Float, Float]] = []
    goal = FIRST_REALISATIONS
    while True:
        for number in range(len(blocks), goal // BLOCK):
            blocks.append(_block(hypotheses, statistic, template, tilt, seed, number))
        values, logs = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        weight, n = np.exp(logs), values.size
        cut, error = _threshold(values, weight, fap)
        above = float(weight[values > cut.value].sum() / n)
        # The threshold's own probability is estimated from few draws, so it is an atom only if its lower limit is.
        own = weight[values == cut.value]
        chance = float(own.sum() / n)
        lower_limit = chance - 4.0 * math.sqrt(max(float(own @ own) / n - chance**2, 0.0) / n)
        check_atom(f"{statistic} of {hypotheses.quiet.name}", fap, above, lower_limit)
        if error <= WANTED_ERROR:
            return Tail(cut, fap, error, values.size)
        if goal >= MAX_REALISATIONS:
            raise InputError(
                f"the threshold of {statistic} at fap = {fap:g} must have a relative error of at most "
                f"{WANTED_ERROR:g}, but has {error:.2g} after {goal} tilted draws",
                key="fap",
            )
        goal *= 2


def _check(hypotheses: Hypotheses, fap: float) -> None:
    """Raise InputError if a threshold cannot be sampled, with the realisations from which it can be counted."""
    scene, setting = hypotheses.scene, hypotheses.setting
    reasons = {
        "noise drawn apart": not scene.joint,
        "frames drawn one by one": scene.frames,
        **{ADDITIVE[name].label: True for name in scene.additive},
        "priors that statistics are not marginalised over": bool(scene.modulations) and not setting.integrates,
        f"{scene.comparison.exposures} averaged exposures": scene.comparison.exposures > MAX_AVERAGED,
    }
    for reason, holds in reasons.items():
        if holds:
            raise InputError(
                f"thresholds cannot be sampled with {reason}; use at least {least_countable(fap)} realisations, so "
                f"that they are counted at fap = {fap:g}",
                key="tails",
            )


def _threshold(values: Float, weights: Float, fap: float) -> tuple[Interval, float]:
    """Return the value with a weighted fraction `fap` at or above, and the fraction's relative error."""
    order, n = np.argsort(-values, kind="stable"), values.size
    ordered, weight = values[order], weights[order]
    above = np.cumsum(weight) / n
    if above[-1] < fap:
        return Interval(math.nan, math.nan, math.nan), math.inf
    at = int(np.searchsorted(above, fap))
    # Relative standard error of the mean weight of the draws that exceed the value.
    variance = np.maximum(np.cumsum(weight**2)[at] / n - above[at] ** 2, 0.0) / n
    relative = float(np.sqrt(variance) / above[at])
    # The fraction at the ends differs by its error at the threshold.
    reach = CONFIDENCE_SD * relative
    ends = np.searchsorted(above, (fap * (1.0 + reach), fap * (1.0 - reach)))
    low, high = (float(ordered[min(int(end), n - 1)]) for end in ends)
    return Interval(float(ordered[at]), low, high), relative


@dataclass(frozen=True, eq=False)
class _Tilt:
    """Change of the distribution of draws that makes alarms common: a shift along one direction, or a stretch."""

    # Orthonormal in standard deviations of each pixel's difference, dense or sparse, shape (n_direction, n_pixel).
    directions: Any
    stretch: Float  # factor on the spread along each direction, shape (n_direction,)
    shift: float = 0.0  # along the first direction
    # Mean and standard deviation of the normal scores of factors on light, sky and dark in alarms.
    scores: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def for_alarms(cls, fap: float, hypotheses: Hypotheses, statistic: str, template: int) -> _Tilt:
        """Choose a tilt that makes alarms of a given probability common."""
        kind, setting = hypotheses.statistic(statistic), hypotheses.setting
        flare = hypotheses.shape(statistic, template)
        directions, square = kind.tilt(setting, flare)
        nothing = Differences(np.zeros(setting.used.size), kind.variance(setting), setting.comparison.estimated)
        # Nuisance parameters that are not drawn do not scatter.
        null = kind.integrate_drawn(setting, hypotheses.quiet, nothing, flare, priors=False)
        goal = null.isf(fap)
        parts, chance, scores = null.parts if isinstance(null, Mixture) else (null,), np.ones(1), {}
        if isinstance(null, Mixture):
            # Posterior probability of the factors given an alarm.
            chance = null.weights * [part.sf(goal) for part in parts]
            chance = chance / chance.sum()
            nodes = factor_nodes(setting.drawn, hypotheses.quiet, weighted=square is None)
            for name, score in nodes.scores.items():
                mean = float(chance @ score)
                scores[name] = mean, max(float(np.sqrt(chance @ (score - mean) ** 2)), 1.0)
        if square is None:
            # Linear statistic: shift the mean along its direction, by the mean in alarms.
            z = np.array([(goal - part.mean) / part.std for part in parts])
            moves = np.exp(-(z**2) / 2 - special.log_ndtr(-z)) / np.sqrt(2 * np.pi)
            return cls(directions, np.ones(1), float(chance @ moves), scores)
        # Quadratic statistic: exponential tilting of each independent square increases the spread, by the growth, at
        # least one, of the central squares that makes the mean of each sum of squares equal to the goal. The sums have
        # fewer squares if marginalisation subtracts some, and more if factors add some.
        squares = [part for part in parts if isinstance(part, QuadraticForm)]
        growth = [(goal - float(part.weight @ part.shift**2)) / float(part.weight.sum()) for part in squares]
        goal = float(square.sum() * (chance @ np.maximum(growth, 1.0)))
        return cls(directions, _stretch(square, goal), scores=scores)

    def apply(self, difference: Float) -> tuple[Float, Float]:
        """Return the change of differences, shape (n, n_pixel), and the logarithms of the draws' weights."""
        along = difference @ self.directions.T
        if self.shift:
            shifted = along + self.shift
            return self.shift * self.directions[0], self.shift**2 / 2 - self.shift * shifted[:, 0]
        stretched = along * self.stretch
        # Ratio of standard normal densities to those of spread `stretch`.
        logs = np.log(self.stretch).sum() - 0.5 * stretched**2 @ (1.0 - 1.0 / self.stretch**2)
        return (stretched - along) @ self.directions, np.asarray(logs)


def _stretch(square: Float, goal: float) -> Float:
    """Return the spreads of normals whose weighted squares have a sum of mean `goal`."""
    from scipy.optimize import brentq

    most = float(square.max())

    def excess(x: float) -> float:
        return float(np.sum(square / (1.0 - x * square / most))) - goal

    x = 0.0 if excess(0.0) >= 0 else float(brentq(excess, 0.0, 1.0 - 1e-12))
    return np.asarray(1.0 / np.sqrt(1.0 - x * square / most))


def _block(
    hypotheses: Hypotheses, statistic: str, template: int, tilt: _Tilt, seed: int, block: int
) -> tuple[Float, Float]:
    """Return the values of a block of tilted draws, and the logarithms of their weights."""
    scene = hypotheses.scene
    kind = hypotheses.statistic(statistic)
    exposures = 1 if kind.paired else scene.comparison.exposures
    z, *z_references = (_normals(scene.n_pixel, seed, block, exposure) for exposure in range(1 + exposures))
    added = kind.added_variance(hypotheses.setting)
    # Only the difference is tilted; orthogonal combinations remain as drawn.
    root = np.sqrt(1.0 + added)
    difference = (z - added * sum(z_references)) / root
    move, logs = tilt.apply(difference)
    factors, log_ratios = _factors(scene, tilt.scores, seed, block)
    excess, logs = _excess(scene, z + move / root, factors), logs + log_ratios
    # Exposures are subtracted only if no factors are drawn.
    subtracted = [_excess(scene, z_reference - added * move / root, factors) for z_reference in z_references]
    mean = added * np.sum(subtracted, axis=0) if subtracted else np.zeros_like(excess)
    variance = np.broadcast_to(kind.variance(hypotheses.setting), excess.shape)
    if scene.comparison.estimated:
        # The variances that an observer estimates of both exposures.
        estimate = scene.estimates[0, : scene.n_pixel]
        nets = (dn - scene.fraction[0, : scene.n_pixel] + estimate["net_offset"] for dn in (excess, mean))
        of_exposure, of_reference = (np.maximum(net, 0.0) * estimate["gain"] + estimate["variance"] for net in nets)
        variance = of_exposure + added * of_reference
    shape = hypotheses.shape(statistic, template)
    return kind.values(hypotheses.setting, excess - mean, variance, shape), logs


def _normals(n_pixel: int, seed: int, block: int, exposure: int, purpose: int = 0) -> Float:
    """Return the normals of a block of draws, shape (BLOCK, n_pixel), addressed by counter (Philox4x64, Box-Muller)."""
    counter = [0, purpose, exposure, block]
    words = np.random.Philox(key=[seed, TAIL_KEY], counter=counter).random_raw(BLOCK * (n_pixel + 1))
    uniform = ((words >> np.uint64(11)) + 0.5) * 2.0**-53
    half = uniform.size // 2
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:half])), 2.0 * np.pi * uniform[half : 2 * half]
    normals = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
    return np.asarray(normals[: BLOCK * n_pixel].reshape(BLOCK, n_pixel))


def _factors(
    scene: Scene, towards: dict[str, tuple[float, float]], seed: int, block: int
) -> tuple[dict[str, Float], Float]:
    """Draw factors on light, dark and sky, each minus one, shape (BLOCK,), and the logarithms of their weights."""
    factors = {str(name): np.ones(BLOCK) for name in SIGNAL_PARTS}
    kinds = [factor for _, factor in scene.modulations]
    # The scores of every second realisation are moved, which limits weights to two.
    moved = np.arange(BLOCK)[:, None] % 2 == 1
    ratio = np.zeros(BLOCK)
    for row, ((name, factor), table) in enumerate(zip(scene.modulations, scene.priors, strict=True)):
        each_frame = PROCESSES[name].when == "frame"
        score = _normals(scene.n_frames if each_frame else 1, seed, block, row, purpose=1)
        if not each_frame and kinds.count(factor) == 1 and factor in towards:
            mean, sd = towards[factor]
            score = np.where(moved, mean + sd * score, score)
            # Ratio of the moved density to the prior's.
            ratio += (score[:, 0] ** 2 - ((score[:, 0] - mean) / sd) ** 2) / 2 - np.log(sd)
        factors[factor] *= 1.0 + quantile_at_score(table, score).mean(axis=1)
    return {name: values - 1.0 for name, values in factors.items()}, np.log(2.0) - np.logaddexp(0.0, ratio)


def _excess(scene: Scene, z: Float, factors: dict[str, Float]) -> Float:
    """Return the observed counts minus the reference, DN, of quiescent draws from normals, both (n, n_pixel)."""
    n = scene.n_pixel
    # The kernels' expansion in double precision.
    v = reference.analogue(scene, reference.Draws(z.T), 0, **factors, fma=lambda a, b, c: a * b + c)
    edge, counts = scene.edges[0, :n], np.rint(v.T)
    if scene.clip:
        counts = np.clip(counts, edge["low"] - layout.MAGIC, edge["high"] - layout.MAGIC)
    return np.asarray(counts + edge["whole"] + scene.fraction[0, :n])
