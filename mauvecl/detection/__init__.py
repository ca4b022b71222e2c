"""Detection: names of statistics and checks of false-alarm probabilities, which are fast to import."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

from mauvecl.schema.errors import InputError

#: All statistics in the order of tables and plots.
STATISTIC_NAMES = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Recommended statistic, of which answers are given by default; it has the most power where its template is right.
RECOMMENDED = "matched"
#: Statistics computed by default.
DEFAULT_STATISTICS = ("chi2", "chi2_element", "matched")


def check_statistic(name: str) -> None:
    """Raise InputError for an unknown statistic."""
    if name not in STATISTIC_NAMES:
        raise InputError.of("statistic", name, f"one of {', '.join(STATISTIC_NAMES)}")


#: Smallest number of realisations beyond a threshold; rarer tails raise InputError and are never extrapolated.
MIN_IN_TAIL = 100

#: Treatment of thresholds with fewer than `MIN_IN_TAIL` realisations beyond: InputError, or importance sampling.
Tails = Literal["counted", "sampled"]


class NoThresholdError(InputError):
    """A false-alarm probability that no threshold of a statistic has."""


def check_atom(subject: str, fap: float, above: float, at_threshold: float) -> None:
    """Raise NoThresholdError if a single value of a statistic is more probable than a false-alarm probability.

    This happens if saturation gives many exposures the same counts. `subject` names the statistic and the star;
    `above` is the probability of values above the threshold, and `at_threshold` that of the threshold itself.
    """
    if at_threshold <= fap:
        return
    possible = [f"at most {_rounded(above, math.floor):g}"] if above > 0 else []
    if above + at_threshold < 1.0:
        possible.append(f"{_rounded(above + at_threshold, math.ceil):g} and more")
    raise NoThresholdError(
        f"no threshold of {subject} has a false-alarm probability of {fap:g}: {100 * at_threshold:.3g} % of exposures "
        "without a flare give one and the same value, as saturated pixels do, and either all of them or none are "
        f"alarms; use a false-alarm probability that a threshold has: {' or '.join(possible) or 'none'}",
        key="fap",
    )


def _rounded(value: float, to_whole: Callable[[float], int]) -> float:
    """Return a positive number with four digits, rounded up or down."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return to_whole(value / unit * (1 + (-1e-12 if to_whole is math.ceil else 1e-12))) * unit


def countable(fap: float, realisations: int) -> bool:
    """Return whether at least `MIN_IN_TAIL` realisations lie beyond the threshold."""
    return fap * realisations >= MIN_IN_TAIL * (1 - 1e-9)


def least_countable(fap: float) -> int:
    """Return the smallest number of realisations that is `countable`."""
    return math.ceil(MIN_IN_TAIL / fap)


def check_probability(key: str, value: float) -> None:
    """Raise InputError if a value is no probability between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise InputError.of(key, value, "a probability between 0 and 1")


def check_fap(fap: float, realisations: int, tails: Tails = "counted") -> None:
    """Raise InputError if `fap` is not a probability, or is too small for counted tails."""
    check_probability("fap", fap)
    if tails == "counted" and not countable(fap, realisations):
        raise InputError(
            f"fap = {fap:g} leaves {fap * realisations:.3g} of {realisations} realisations beyond the threshold, but "
            f"needs at least {MIN_IN_TAIL}: ask for {least_countable(fap)} realisations, or for `tails='sampled'`",
            key="fap",
        )
