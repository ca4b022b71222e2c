"""Thresholds of false-alarm probabilities too small to count, by importance sampling of the engine's noise model.

The normals behind each pixel are drawn from a distribution under which an alarm is common, and each realisation counts
with the ratio of the two densities (exponential tilting; Siegmund 1976, doi 10.1214/aos/1176343541). Everything after
the normals (skew of the dark, rounding, clipping, the statistic itself) is the engine's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl import layout
from mauvecl.host.errors import InputError
from mauvecl.statistics import CONFIDENCE, Interval

if TYPE_CHECKING:
    from mauvecl.detection import Detection
    from mauvecl.scene import Scene

Float = NDArray[np.float64]

#: Realisations to begin with, and at most; each step doubles them.
FEWEST, MOST = 8_000, 512_000
#: Relative standard error of the false-alarm probability that is aimed at.
WANTED_ERROR = 0.02
#: Realisations drawn at once, from one run of counters.
BLOCK = 500
#: Second half of the generator's key: draws of tails are no draws of the engine.
TAIL_KEY = 0x7461696C
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


def tail(found: Detection, fap: float, statistic: str, *, template: int = 0, seed: int) -> Tail:
    """The threshold that a statistic's null exceeds with a small probability.

    Parameters
    ----------
    found : Detection
        Of which only the scene and the quiescent star matter.
    fap : float
        1e-10 to 0.1.
    statistic : str
    template : int
        For ``matched``: the flare whose shape is looked for.
    seed : int

    Raises
    ------
    InputError
        If the noise is not drawn jointly and as stacks, processes act, or the error stays too large.
    """
    if not SMALLEST_FAP <= fap <= 0.1:
        raise InputError(f"fap = {fap:g}, expected {SMALLEST_FAP:g} to 0.1 for importance sampling")
    _check(found.scene)
    null = found.closed_form(statistic, template=template)
    values, logs = np.empty(0), np.empty(0)
    goal = FEWEST
    while True:
        more = _tilted(found, statistic, template, null.isf(fap), seed, values.size, goal)
        values, logs = (np.concatenate(pair) for pair in zip((values, logs), more, strict=True))
        cut, low, high, error = _threshold(values, logs, fap)
        if error <= WANTED_ERROR:
            return Tail(Interval(cut, low, high), fap, error, values.size)
        if goal >= MOST:
            raise InputError(
                f"the threshold of {statistic} at fap = {fap:g} has a relative error of {error:.2g} after {goal} "
                f"tilted draws, expected {WANTED_ERROR:g}"
            )
        goal *= 2


def _check(scene: Scene) -> None:
    reasons = {
        "noise drawn apart": not scene.joint,
        "frames drawn one by one": scene.frames,
        "cosmic rays": scene.cosmic,
        "priors": bool(scene.modulations),
    }
    for reason, holds in reasons.items():
        if holds:
            raise InputError(
                f"importance sampling with {reason}, expected stacks of joint draws: draw enough realisations"
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


def _tilted(
    found: Detection, statistic: str, template: int, goal: float, seed: int, start: int, stop: int
) -> tuple[Float, Float]:
    """Values of tilted draws number start to stop - 1, whole blocks, and the logarithms of their weights."""
    parts = [_block(found, statistic, template, goal, seed, b) for b in range(start // BLOCK, stop // BLOCK)]
    values, logs = (np.concatenate(part) for part in zip(*parts, strict=True))
    return values, logs


def _block(found: Detection, statistic: str, template: int, goal: float, seed: int, block: int) -> tuple[Float, Float]:
    scene, used = found.scene, found.scene.used
    sd = np.sqrt(found.quiet.variance_dn2) * used
    z = _normals(scene.n_pixel, seed, block, 0)
    weights = found.weights(statistic, template)
    if weights is not None:
        # Linear: the mean moves along the statistic's own direction.
        length = float(np.linalg.norm(weights * sd))
        direction, shift = weights * sd / length, goal / length
        z += shift * direction
        return _excess(scene, z) @ weights, shift**2 / 2 - shift * (z @ direction)
    if statistic == "chi2":
        # Quadratic: the spread grows, in every pixel alike...
        stretch = np.sqrt(goal / used.sum())
        z[:, used] *= stretch
        return _excess(scene, z) ** 2 @ _inverse_variance(scene), _log_weight(z[:, used], stretch)
    if statistic == "chi2_pair":
        # ... of the difference of both exposures...
        other = _normals(scene.n_pixel, seed, block, 1)
        stretch = np.sqrt(goal / used.sum())
        difference = np.where(used, (z - other) / np.sqrt(2.0), 0.0)
        move = (stretch - 1.0) * difference / np.sqrt(2.0)
        x = _excess(scene, z + move) - _excess(scene, other - move)
        return 0.5 * x**2 @ _inverse_variance(scene), _log_weight(stretch * difference[:, used], stretch)
    # ... and of each element's sum.
    starts = np.flatnonzero(np.append(True, np.diff(found.quiet.element) > 0))
    size = np.diff(np.append(starts, scene.n_pixel))
    variance = np.add.reduceat(sd**2, starts)
    counts = variance > 0
    scale = np.sqrt(np.where(counts, variance, 1.0))
    direction = sd / np.repeat(scale, size)
    along = np.add.reduceat(z * direction, starts, axis=1)
    stretch = np.sqrt(goal / counts.sum())
    z += direction * np.repeat((stretch - 1.0) * along, size, axis=1)
    sums = np.add.reduceat(_excess(scene, z) * used, starts, axis=1)
    value = np.sum((sums[:, counts] / scale[counts]) ** 2, axis=1)
    return value, _log_weight(stretch * along[:, counts], stretch)


def _log_weight(stretched: Float, stretch: float) -> Float:
    """Log ratio of standard normal densities to those of spread `stretch`, summed over the last axis."""
    share = 0.5 * (1.0 - 1.0 / stretch**2)
    return np.asarray(stretched.shape[1] * np.log(stretch) - share * np.sum(stretched**2, axis=1))


def _normals(n_pixel: int, seed: int, block: int, exposure: int) -> Float:
    """Normals of a block of draws, shape (BLOCK, n_pixel), from counters of their own (Philox4x64, Box-Muller)."""
    words = np.random.Philox(key=[seed, TAIL_KEY], counter=[0, 0, exposure, block]).random_raw(BLOCK * (n_pixel + 1))
    uniform = ((words >> np.uint64(11)) + 0.5) * 2.0**-53
    half = uniform.size // 2
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:half])), 2.0 * np.pi * uniform[half : 2 * half]
    both = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
    return np.asarray(both[: BLOCK * n_pixel].reshape(BLOCK, n_pixel))


def _excess(scene: Scene, z: Float) -> Float:
    """Observed less template, DN, for the quiescent scenario."""
    n = scene.n_pixel
    level, edge = scene.levels[0, :n], scene.edges[0, :n]
    drawn = level["c4"].astype(np.float64) if scene.quartic else np.zeros(n)
    for name in ("c3", "c2", "c1", "c0"):
        drawn = drawn * z + level[name]
    counts = np.rint(drawn)
    if scene.clip:
        counts = np.clip(counts, edge["low"] - layout.MAGIC, edge["high"] - layout.MAGIC)
    return np.asarray(counts + edge["whole"] + scene.fraction[0, :n])


def _inverse_variance(scene: Scene) -> Float:
    return scene.levels[0, : scene.n_pixel]["inverse_variance"].astype(np.float64)
