"""From one test to a campaign of many and back: false alarms expected, the chance of any, what a test may have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.errors import InputError
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

#: Campaigns drawn where stacks overlap.
DRAWN = 20_000
#: Tests of one simulated stretch of overlapping stacks; longer campaigns are made of such stretches.
STRETCH = 4_096
#: A per-test probability is read off simulated maxima only where so many lie beyond.
FEWEST = 100


@dataclass(frozen=True)
class Campaign:
    """False alarms of a whole campaign.

    Attributes
    ----------
    tests : int
        Statistics compared with the threshold.
    fap : float
        Of one test.
    expected : float
        Tests with a false alarm to be expected, whatever their dependence.
    at_most : float
        Campaign false-alarm probability if all tests excluded each other (Bonferroni): no campaign exceeds it.
    independent : float
        If all tests were independent.
    overlapping : Interval or None
        With the correlation of overlapping stacks, for a normal statistic; None where stacks do not overlap.
    """

    tests: int
    fap: float
    expected: float
    at_most: float
    independent: float
    overlapping: Interval | None


@dataclass(frozen=True)
class PerTest:
    """What one test's false-alarm probability may be for a wanted value of the campaign.

    Attributes
    ----------
    tests : int
    wanted : float
        Probability of any false alarm in the campaign.
    at_least : float
        Enough whatever the tests' dependence (Bonferroni).
    independent : float
        For independent tests; enough for overlapping stacks of a linear statistic too, whose tests alarm together.
    overlapping : Interval or None
        With the correlation of overlapping stacks, for a normal statistic; None where stacks do not overlap, or too few
        of the simulated campaigns lie beyond.
    """

    tests: int
    wanted: float
    at_least: float
    independent: float
    overlapping: Interval | None


def per_test(wanted: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> PerTest:
    """The false-alarm probability that each test may have: the inverse of `campaign`.

    Parameters
    ----------
    wanted : float
        Probability of any false alarm in the whole campaign.
    frames, stack, step, seed
        As for `campaign`.

    Raises
    ------
    InputError
        For numbers that cannot be.

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
        if share * DRAWN >= FEWEST:
            maxima = np.sort(_maxima(stretch, stack, step, seed)) / np.sqrt(stack)
            low, high = central_counts(DRAWN, share)
            counts = (round(share * DRAWN), low, high)
            overlapping = Interval(*(float(special.ndtr(-maxima[DRAWN - k])) for k in counts))
    return PerTest(tests, wanted, wanted / tests, float(-np.expm1(np.log1p(-wanted) / tests)), overlapping)


def campaign(fap: float, frames: int, stack: int = 1, *, step: int | None = None, seed: int = 1) -> Campaign:
    """Campaign false-alarm probability of a search through consecutive frames.

    Parameters
    ----------
    fap : float
        Of one test.
    frames : int
        Searched; a day of 5 s frames has 17 280.
    stack : int
        Frames summed in one test.
    step : int, optional
        Frames from one stack to the next; a whole stack by default. Fewer make stacks overlap, which correlates
        neighbouring tests by the share of frames that they have in common.
    seed : int
        Of the simulation where stacks overlap.

    Notes
    -----
    Sums of frames are nearly normal, so a linear statistic over overlapping stacks is a moving average of independent
    normals; the chance that its maximum exceeds the threshold is simulated. For chi-squared statistics the correlation
    is the square of that, nearer to independence: between the two numbers given.

    Raises
    ------
    InputError
        For numbers that cannot be.

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
        raise InputError(f"{what} = {value!r}, expected a probability between 0 and 1")


def count_tests(frames: int, stack: int, step: int) -> int:
    """Stacks of so many frames, so many apart, that fit into a campaign.

    Raises
    ------
    InputError
        For numbers that cannot be.
    """
    if not (1 <= stack <= frames and 1 <= step <= stack):
        raise InputError(
            f"a campaign of {frames} frames in stacks of {stack}, {step} apart, expected 1 <= step <= stack <= frames"
        )
    return (frames - stack) // step + 1


def _overlapping(fap: float, tests: int, stack: int, step: int, seed: int) -> Interval:
    """Simulated, stretch by stretch; stretches are joined as if independent."""
    stretch = min(tests, STRETCH)
    cut = -special.ndtri(fap) * np.sqrt(stack)
    alarms = int((_maxima(stretch, stack, step, seed) >= cut).sum())
    chance = clopper_pearson(alarms, DRAWN)
    power = tests / stretch
    return Interval(
        *(float(-np.expm1(power * np.log1p(-min(p, 1 - 1e-16)))) for p in (chance.value, chance.low, chance.high))
    )


def _maxima(stretch: int, stack: int, step: int, seed: int) -> NDArray[np.float64]:
    """Largest sum of normals over a stretch of overlapping stacks, shape (DRAWN,)."""
    generator = np.random.default_rng(seed)
    size = (stretch - 1) * step + stack
    block = max(2**22 // size, 1)
    parts = []
    for start in range(0, DRAWN, block):
        sums = np.cumsum(generator.standard_normal((min(block, DRAWN - start), size)), axis=1)
        sums = np.pad(sums, ((0, 0), (1, 0)))
        parts.append((sums[:, stack:] - sums[:, :-stack])[:, ::step].max(axis=1))
    return np.concatenate(parts)
