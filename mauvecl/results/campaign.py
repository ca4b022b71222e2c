"""From one test to a campaign of many: how often any of them raises a false alarm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from mauvecl.host.errors import InputError
from mauvecl.statistics.intervals import Interval, clopper_pearson

#: Campaigns drawn where stacks overlap.
DRAWN = 20_000
#: Tests of one simulated stretch of overlapping stacks; longer campaigns are made of such stretches.
STRETCH = 4_096


@dataclass(frozen=True)
class Campaign:
    """False alarms of a whole campaign.

    Attributes
    ----------
    tests : int
        Statistics compared with the threshold.
    fap : float
        Of one test.
    at_most : float
        Campaign false-alarm probability if all tests excluded each other (Bonferroni): no campaign exceeds it.
    independent : float
        If all tests were independent.
    overlapping : Interval or None
        With the correlation of overlapping stacks, for a normal statistic; None where stacks do not overlap.
    """

    tests: int
    fap: float
    at_most: float
    independent: float
    overlapping: Interval | None


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
    >>> from mauvecl.results.campaign import campaign
    >>> day = campaign(1e-5, 17_280)
    >>> day.tests, round(day.at_most, 4), round(day.independent, 4)
    (17280, 0.1728, 0.1587)
    """
    step = stack if step is None else step
    tests = count_tests(frames, stack, step)
    if not 0.0 < fap < 1.0:
        raise InputError(f"fap = {fap!r}, expected a probability between 0 and 1")
    overlapping = _overlapping(fap, tests, stack, step, seed) if step < stack and tests > 1 else None
    return Campaign(tests, fap, min(tests * fap, 1.0), float(-np.expm1(tests * np.log1p(-fap))), overlapping)


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
    generator = np.random.default_rng(seed)
    size, alarms = (stretch - 1) * step + stack, 0
    block = max(2**22 // size, 1)
    for start in range(0, DRAWN, block):
        sums = np.cumsum(generator.standard_normal((min(block, DRAWN - start), size)), axis=1)
        sums = np.pad(sums, ((0, 0), (1, 0)))
        moving = (sums[:, stack:] - sums[:, :-stack])[:, ::step]
        alarms += int((moving.max(axis=1) >= cut).sum())
    found = clopper_pearson(alarms, DRAWN)
    power = tests / stretch
    return Interval(
        *(float(-np.expm1(power * np.log1p(-min(p, 1 - 1e-16)))) for p in (found.value, found.low, found.high))
    )
