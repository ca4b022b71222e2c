"""False-alarm probabilities of campaigns of many tests, and of a single test in a campaign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.schema.errors import InputError
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

#: Number of simulated campaigns with overlapping stacks.
SIMULATIONS = 20_000
#: Tests per simulated stretch of overlapping stacks; longer campaigns consist of several stretches.
STRETCH = 4_096
#: Smallest number of simulated maxima beyond a threshold.
MIN_BEYOND = 100


@dataclass(frozen=True)
class Campaign:
    """False alarms of a whole campaign."""

    tests: int
    fap: float  # of one test
    expected: float  # expected number of false alarms, for any dependence of the tests
    at_most: float  # upper limit of the campaign's false-alarm probability (Bonferroni)
    independent: float  # campaign's false-alarm probability for independent tests
    overlapping: Interval | None  # the same for a normal statistic of overlapping stacks; None without overlap


@dataclass(frozen=True)
class PerTest:
    """False-alarm probability of one test that gives a campaign a wanted false-alarm probability."""

    tests: int
    wanted: float  # probability of any false alarm in the campaign
    at_least: float  # sufficient for any dependence of the tests (Bonferroni)
    independent: float  # for independent tests; sufficient too for overlapping stacks of a linear statistic
    # For a normal statistic of overlapping stacks; None without overlap or with too few simulated maxima beyond.
    overlapping: Interval | None


def per_test(wanted: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> PerTest:
    """Return the false-alarm probability per test for a wanted one of the campaign; the inverse of `campaign`.

    Parameters
    ----------
    wanted : float
        Probability of any false alarm in the whole campaign.
    frames, stack, step, seed
        As for `campaign`.

    Examples
    --------
    >>> from mauvecl.results.detection.campaign import campaign, per_test
    >>> one = per_test(0.01, 17_280)
    >>> f"{one.at_least:.3g} {one.independent:.3g}"
    '5.79e-07 5.82e-07'
    >>> round(campaign(one.independent, 17_280).independent, 6)
    0.01
    """
    step = stack if step is None else step
    tests = count_tests(frames, stack, step)
    _check("wanted campaign fap", wanted)
    overlapping = None
    if step < stack and tests > 1:
        stretch = min(tests, STRETCH)
        share = float(-np.expm1(stretch / tests * np.log1p(-wanted)))
        if share * SIMULATIONS >= MIN_BEYOND:
            maxima = np.sort(_maxima(stretch, stack, step, seed)) / np.sqrt(stack)
            low, high = central_counts(SIMULATIONS, share)
            counts = (round(share * SIMULATIONS), low, high)
            overlapping = Interval(*(float(special.ndtr(-maxima[SIMULATIONS - k])) for k in counts))
    return PerTest(tests, wanted, wanted / tests, float(-np.expm1(np.log1p(-wanted) / tests)), overlapping)


def campaign(fap: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> Campaign:
    """Return the false-alarm probability of a search through consecutive frames.

    Parameters
    ----------
    fap : float
        False-alarm probability of one test.
    frames : int
        Number of searched frames; a day of 5 s frames has 17 280.
    stack : int
        Frames summed in one test.
    step : int, optional
        Frames from one stack to the next. The default is `stack`. Smaller steps make stacks overlap, so that
        neighbouring tests are correlated by their fraction of common frames.
    seed : int
        Seed of the simulation of overlapping stacks.

    Notes
    -----
    Sums of frames are nearly normal, so a linear statistic of overlapping stacks is a moving average of independent
    normals. The probability that its maximum exceeds the threshold is simulated. The correlation of chi-squared
    statistics is the square of this one, so their probability lies between `overlapping` and `independent`.

    Examples
    --------
    >>> from mauvecl.results.detection.campaign import campaign
    >>> day = campaign(1e-5, 17_280)
    >>> day.tests, round(day.at_most, 4), round(day.independent, 4)
    (17280, 0.1728, 0.1587)
    """
    step = stack if step is None else step
    tests = count_tests(frames, stack, step)
    _check("fap", fap)
    overlapping = _overlapping(fap, tests, stack, step, seed) if step < stack and tests > 1 else None
    return Campaign(
        tests, fap, tests * fap, min(tests * fap, 1.0), float(-np.expm1(tests * np.log1p(-fap))), overlapping
    )


def _check(what: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise InputError.of(what, value, "a probability between 0 and 1")


def count_tests(frames: int, stack: int, step: int) -> int:
    """Return the number of stacks in a campaign."""
    if not (1 <= stack <= frames and 1 <= step <= stack):
        raise InputError(
            f"a campaign of {frames} frames in stacks of {stack}, {step} apart",
            "1 <= step <= stack <= frames",
            key="step",
            value=(frames, stack, step),
        )
    return (frames - stack) // step + 1


def _overlapping(fap: float, tests: int, stack: int, step: int, seed: int) -> Interval:
    """Simulate the probability of an alarm in a stretch, and combine stretches as if they were independent."""
    stretch = min(tests, STRETCH)
    cut = -special.ndtri(fap) * np.sqrt(stack)
    alarms = int((_maxima(stretch, stack, step, seed) >= cut).sum())
    chance = clopper_pearson(alarms, SIMULATIONS)
    power = tests / stretch
    return Interval(
        *(float(-np.expm1(power * np.log1p(-min(p, 1 - 1e-16)))) for p in (chance.value, chance.low, chance.high))
    )


def _maxima(stretch: int, stack: int, step: int, seed: int) -> NDArray[np.float64]:
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
