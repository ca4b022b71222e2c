"""Thresholds of false-alarm probabilities too small to count, by importance sampling of the engine's noise model.

The normals behind each pixel are drawn from a distribution under which an alarm is common, and each realisation counts
with the ratio of the two densities (exponential tilting; Siegmund 1976, doi 10.1214/aos/1176343541). Everything after
the normals (skew of the dark, rounding, clipping, the statistic itself) is the engine's. Unknowns that are drawn come
from their priors in one half of the realisations and from where alarms come from in the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.errors import InputError
from mauvecl.noise import layout
from mauvecl.noise.drawn import at_score
from mauvecl.results.requests.fap import check_atom
from mauvecl.statistics.distributions import Form, Mixture, QuadraticForm
from mauvecl.statistics.intervals import CONFIDENCE, Interval
from mauvecl.statistics.statistic import Differences

if TYPE_CHECKING:
    from mauvecl.noise.scene import Scene
    from mauvecl.results.detection.detection import Detection

Float = NDArray[np.float64]

#: Realisations to begin with, and at most; each step doubles them.
FEWEST, MOST = 8_000, 512_000
#: Relative standard error of the false-alarm probability that is aimed at.
WANTED_ERROR = 0.02
#: Realisations drawn at once, from one run of counters.
BLOCK = 500
#: Second half of the generator's key: draws of tails are no draws of the engine.
TAIL_KEY = 0x7461696C
#: Quiescent exposures averaged at most: each is drawn on the host.
MOST_AVERAGED = 30
#: Smaller ones lie beyond what the polynomial of the draw was tested for.
SMALLEST_FAP = 1e-10


@dataclass(frozen=True)
class Tail:
    """A threshold from tilted draws.

    Attributes
    ----------
    threshold : Interval
    fap : float
    relative_error : float
        Standard error of the false-alarm probability at the threshold, over that probability.
    realisations : int
        Tilted draws.
    """

    threshold: Interval
    fap: float
    relative_error: float
    realisations: int


def tail(detection: Detection, fap: float, statistic: str, *, template: int = 0, seed: int) -> Tail:
    """The threshold that a statistic's null exceeds with a small probability.

    Parameters
    ----------
    detection : Detection
        Of which only the scene and the quiescent star matter.
    fap : float
        1e-10 to 0.1.
    statistic : str
    template : int
        For ``matched``: the flare whose shape is looked for.
    seed : int

    Raises
    ------
    NoThresholdError
        If no threshold has the probability.
    InputError
        If the noise is not drawn jointly and as stacks, cosmic rays act, priors are drawn that the statistics are not
        marginalised over, more than 30 quiescent exposures are averaged, or the error stays too large.
    """
    if not SMALLEST_FAP <= fap <= 0.1:
        raise InputError(f"fap = {fap:g}, expected {SMALLEST_FAP:g} to 0.1 for importance sampling")
    _check(detection)
    how = _Tilt.towards(fap, detection, statistic, template)
    values, logs = np.empty(0), np.empty(0)
    goal = FEWEST
    while True:
        more = _tilted(detection, statistic, template, how, seed, values.size, goal)
        values, logs = (np.concatenate(pair) for pair in zip((values, logs), more, strict=True))
        cut, low, high, error = _threshold(values, logs, fap)
        beyond, at = _around(values, logs, cut)
        check_atom(f"{statistic} of {detection.quiet.name}", fap, beyond, at)
        if error <= WANTED_ERROR:
            return Tail(Interval(cut, low, high), fap, error, values.size)
        if goal >= MOST:
            raise InputError(
                f"the threshold of {statistic} at fap = {fap:g} has a relative error of {error:.2g} after {goal} "
                f"tilted draws, expected {WANTED_ERROR:g}"
            )
        goal *= 2


def _check(detection: Detection) -> None:
    scene, setting = detection.scene, detection.setting
    reasons = {
        "noise drawn apart": not scene.joint,
        "frames drawn one by one": scene.frames,
        "cosmic rays": scene.cosmic,
        "priors that statistics are not marginalised over": bool(scene.modulations) and not setting.integrates,
        f"{scene.comparison.exposures} averaged exposures": scene.comparison.exposures > MOST_AVERAGED,
    }
    for reason, holds in reasons.items():
        if holds:
            raise InputError(
                f"importance sampling with {reason}, expected stacks of joint draws and at most {MOST_AVERAGED} "
                "averaged exposures: draw enough realisations"
            )


def _threshold(values: Float, logs: Float, fap: float) -> tuple[float, float, float, float]:
    """The value with a weighted fraction `fap` at or above it, its interval, and that fraction's relative error."""
    order = np.argsort(-values, kind="stable")
    ordered, weight = values[order], np.exp(logs[order])
    above = np.cumsum(weight) / values.size
    # The variance of a mean of weights, over the draws that exceed each value.
    variance = np.maximum(np.cumsum(weight**2) / values.size - above**2, 0.0) / values.size
    error = np.sqrt(variance)
    if above[-1] < fap:
        return float("nan"), float("nan"), float("nan"), float("inf")
    at = int(np.searchsorted(above, fap))
    relative = float(error[at] / above[at])
    # The ends are where the fraction is off by its own error at the threshold.
    reach = float(special.ndtri(0.5 + CONFIDENCE / 2)) * relative
    ends = np.searchsorted(above, (fap * (1.0 + reach), fap * (1.0 - reach)))
    low, high = (float(ordered[min(int(end), values.size - 1)]) for end in ends)
    return float(ordered[at]), low, high, relative


def _around(values: Float, logs: Float, cut: float) -> tuple[float, float]:
    """Return the probability of larger values than a threshold, and what the one at it has for certain."""
    weight, n = np.exp(logs), values.size
    same = weight[values == cut]
    mean = float(same.sum() / n)
    error = math.sqrt(max(float(same @ same) / n - mean**2, 0.0) / n)
    return float(weight[values > cut].sum() / n), mean - 4.0 * error


@dataclass(frozen=True, eq=False)
class _Tilt:
    """How draws are moved towards an alarm: by `shift` along the first direction, or `stretch`ed along all of them.

    Attributes
    ----------
    directions : ndarray or sparse array, shape (n_direction, n_pixel)
        Orthonormal, in standard deviations of each pixel's difference.
    stretch : ndarray, shape (n_direction,)
    shift : float
    scores : dict of str to (float, float)
        Mean and standard deviation of the normal scores that factors on light, sky and dark have in alarms.
    """

    directions: Any
    stretch: Float
    shift: float = 0.0
    scores: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def towards(cls, fap: float, detection: Detection, statistic: str, template: int) -> _Tilt:
        """Such that alarms of this probability are common."""
        one, setting, flare = detection.statistic(statistic), detection.setting, detection.shape(statistic, template)
        tilt = one.tilt(setting, flare)
        nothing = Differences(np.zeros(setting.used.size), one.variance(setting), setting.comparison.estimated)
        # What is marginalised over and not drawn does not scatter.
        null = one.as_drawn(setting, detection.quiet, nothing, flare, priors=False)
        goal = null.isf(fap)
        parts, chance, scores = null.parts if isinstance(null, Mixture) else (null,), np.ones(1), {}
        if isinstance(null, Mixture):
            assert setting.drawn
            # Which factors an alarm has: Bayes's theorem.
            chance = null.weights * [part.sf(goal) for part in parts]
            chance = chance / chance.sum()
            nodes = setting.drawn.nodes(detection.quiet, weighted=tilt.square is None)[0]
            for name in nodes[0].scores:
                score = np.array([node.scores[name] for node in nodes])
                mean = float(chance @ score)
                scores[name] = mean, max(float(np.sqrt(chance @ (score - mean) ** 2)), 1.0)
        if tilt.square is None:
            # Linear: the mean moves along the statistic's own direction, by what it has in alarms.
            moves = [_hazard((goal - part.mean) / part.std) for part in parts] if scores else [goal / tilt.per_sigma]
            return cls(tilt.directions, np.ones(1), float(chance @ moves), scores)
        if setting.nuisances:
            # Squares that are taken away, and those that factors bring.
            goal = float(tilt.square.sum() * (chance @ [_growth(part, goal) for part in parts]))
        # Quadratic: the spread grows, by exponential tilting of each independent square.
        return cls(tilt.directions, _stretch(tilt.square, goal), scores=scores)

    def moved(self, difference: Float) -> tuple[Float, Float]:
        """What is added to differences, shape (n, n_pixel), and the logarithms of the draws' weights."""
        along = difference @ self.directions.T
        if self.shift:
            there = along + self.shift
            return self.shift * self.directions[0], self.shift**2 / 2 - self.shift * there[:, 0]
        there = along * self.stretch
        # The ratio of standard normal densities to those of spread `stretch`.
        logs = np.log(self.stretch).sum() - 0.5 * there**2 @ (1.0 - 1.0 / self.stretch**2)
        return (there - along) @ self.directions, np.asarray(logs)


def _hazard(z: float) -> float:
    """The mean of a standard normal that exceeds z."""
    return float(np.exp(-(z**2) / 2 - special.log_ndtr(-z)) / np.sqrt(2 * np.pi))


def _growth(form: Form, goal: float) -> float:
    """By how much central squares must grow for a sum of squares to reach a value on average, at least one."""
    assert isinstance(form, QuadraticForm)
    return max((goal - float(form.weight @ form.shift**2)) / float(form.weight.sum()), 1.0)


def _stretch(square: Float, goal: float) -> Float:
    """Spreads of normals whose weighted squares then sum to `goal` on average."""
    from scipy.optimize import brentq

    most = float(square.max())

    def excess(x: float) -> float:
        return float(np.sum(square / (1.0 - x * square / most))) - goal

    x = 0.0 if excess(0.0) >= 0 else float(brentq(excess, 0.0, 1.0 - 1e-12))
    return np.asarray(1.0 / np.sqrt(1.0 - x * square / most))


def _tilted(
    detection: Detection, statistic: str, template: int, tilt: _Tilt, seed: int, start: int, stop: int
) -> tuple[Float, Float]:
    """Values of tilted draws number start to stop - 1, whole blocks, and the logarithms of their weights."""
    parts = [_block(detection, statistic, template, tilt, seed, b) for b in range(start // BLOCK, stop // BLOCK)]
    values, logs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return values, logs


def _block(
    detection: Detection, statistic: str, template: int, tilt: _Tilt, seed: int, block: int
) -> tuple[Float, Float]:
    scene = detection.scene
    one = detection.statistic(statistic)
    exposures = 1 if one.paired else scene.comparison.exposures
    z, *others = (_normals(scene.n_pixel, seed, block, exposure) for exposure in range(1 + exposures))
    added = one.added_variance(detection.setting)
    # Only the difference is tilted; what it does not see stays as drawn.
    root = np.sqrt(1.0 + added)
    difference = (z - added * sum(others)) / root
    move, logs = tilt.moved(difference)
    if scene.modulations:
        factors, more = _factors(scene, tilt.scores, seed, block)
        excess, logs = _responding(scene, z + move / root, factors), logs + more
    else:
        excess = _excess(scene, z + move / root)
    subtracted = [_excess(scene, other - added * move / root) for other in others]
    mean = added * np.sum(subtracted, axis=0) if subtracted else np.zeros_like(excess)
    return _value(detection, statistic, template, excess, mean), logs


def _value(detection: Detection, statistic: str, template: int, excess: Float, mean: Float) -> Float:
    """The statistic of each draw, from observed less reference and subtracted less reference, DN, (n, n_pixel)."""
    scene, one = detection.scene, detection.statistic(statistic)
    x, added = excess - mean, one.added_variance(detection.setting)
    variance = np.broadcast_to(one.variance(detection.setting), x.shape)
    if scene.comparison.estimated:
        variance = _estimated(scene, excess) + added * _estimated(scene, mean)
    return one.values(detection.setting, x, variance, detection.shape(statistic, template))


def _estimated(scene: Scene, excess: Float) -> Float:
    """Variances as an observer estimates them, DN^2, shape (n, n_pixel)."""
    estimate = scene.estimates[0, : scene.n_pixel]
    net = excess - scene.fraction[0, : scene.n_pixel] + estimate["net_offset"]
    return np.asarray(np.maximum(net, 0.0) * estimate["gain"] + estimate["variance"])


def _normals(n_pixel: int, seed: int, block: int, exposure: int, purpose: int = 0) -> Float:
    """Normals of a block of draws, shape (BLOCK, n_pixel), from counters of their own (Philox4x64, Box-Muller)."""
    counter = [0, purpose, exposure, block]
    words = np.random.Philox(key=[seed, TAIL_KEY], counter=counter).random_raw(BLOCK * (n_pixel + 1))
    uniform = ((words >> np.uint64(11)) + 0.5) * 2.0**-53
    half = uniform.size // 2
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:half])), 2.0 * np.pi * uniform[half : 2 * half]
    both = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
    return np.asarray(both[: BLOCK * n_pixel].reshape(BLOCK, n_pixel))


def _factors(
    scene: Scene, towards: dict[str, tuple[float, float]], seed: int, block: int
) -> tuple[dict[str, Float], Float]:
    """Factors on light, sky and dark, each less one and of shape (BLOCK, 1), and the logarithms of their weights."""
    factors = {name: np.ones((BLOCK, 1)) for name in ("light", "sky", "dark")}
    kinds = [factor for _, factor in scene.modulations]
    # Every second realisation has its scores moved: no weight exceeds two.
    moved = np.arange(BLOCK)[:, None] % 2 == 1
    ratio = np.zeros(BLOCK)
    for row, ((name, factor), table) in enumerate(zip(scene.modulations, scene.priors, strict=True)):
        score = _normals(scene.n_frames if name == "jitter" else 1, seed, block, row, purpose=1)
        if name != "jitter" and kinds.count(factor) == 1 and factor in towards:
            mean, sd = towards[factor]
            score = np.where(moved, mean + sd * score, score)
            # Of the density that it is moved to and the prior's.
            ratio += (score[:, 0] ** 2 - ((score[:, 0] - mean) / sd) ** 2) / 2 - np.log(sd)
        factors[factor] *= 1.0 + at_score(table, score).mean(axis=1, keepdims=True)
    return {name: values - 1.0 for name, values in factors.items()}, np.log(2.0) - np.logaddexp(0.0, ratio)


def _responding(scene: Scene, z: Float, factors: dict[str, Float]) -> Float:
    """`_excess` where factors are drawn: the expansion of `analogue` in kernels/detector.cl.mako."""
    n = scene.n_pixel
    r = {name: scene.responses[name][0, :n].astype(np.float64) for name in scene.responses.dtype.names or ()}
    sky = factors["sky"] * r["sky_share"]
    more, warmer = factors["light"] + sky + factors["light"] * sky, factors["dark"]
    light, dark = more + 1.0, warmer + 1.0
    variance = light * r["light_variance"] + dark * r["dark_variance"] + r["other_variance"]
    third, fourth, fifth = (light * r[f"light_{k}"] + dark * r[f"dark_{k}"] for k in ("third", "fourth", "fifth"))
    sd, skew = np.sqrt(variance), third / variance
    v = z * sd + skew * (z**2 - 1) / 6 + (fourth * (z**3 - 3 * z) / 24 - third * skew * (2 * z**3 - 5 * z) / 36) / sd**3
    if scene.quartic:
        even = fifth * (z**4 - 6 * z**2 + 3) / 120 - skew * fourth * (z**4 - 5 * z**2 + 2) / 24
        v += (even + skew**2 * third * (12 * z**4 - 53 * z**2 + 17) / 324) / variance**2
    return _counted(scene, v + scene.levels["c0"][0, :n] + more * r["light"] + warmer * r["dark"])


def _excess(scene: Scene, z: Float) -> Float:
    """Observed less reference, DN, for the quiescent scenario."""
    n = scene.n_pixel
    level = scene.levels[0, :n]
    drawn = level["c4"].astype(np.float64) if scene.quartic else np.zeros(n)
    for name in ("c3", "c2", "c1", "c0"):
        drawn = drawn * z + level[name]
    return _counted(scene, drawn)


def _counted(scene: Scene, drawn: Float) -> Float:
    """What the ADC makes of counts above the base, less the reference."""
    n, edge = scene.n_pixel, scene.edges[0, : scene.n_pixel]
    counts = np.rint(drawn)
    if scene.clip:
        counts = np.clip(counts, edge["low"] - layout.MAGIC, edge["high"] - layout.MAGIC)
    return np.asarray(counts + edge["whole"] + scene.fraction[0, :n])
