"""Which false-alarm probabilities a number of realisations settles, and which a statistic can have."""

from __future__ import annotations

import math
from typing import Literal

from mauvecl.host.errors import InputError

#: A threshold needs this many realisations beyond it; a rarer tail is refused, never extrapolated.
FEWEST_IN_TAIL = 100

#: Thresholds with fewer than `FEWEST_IN_TAIL` beyond them: refused, or by importance sampling.
Tails = Literal["counted", "sampled"]


class NoThresholdError(InputError):
    """A false-alarm probability that no threshold of a statistic has."""


def check_atom(what: str, fap: float, beyond: float, at: float) -> None:
    """Refuse a false-alarm probability that lies within the probability of a single value.

    Parameters
    ----------
    what : str
        The statistic and the star.
    fap : float
    beyond, at : float
        Probabilities of larger values, and of the value at which the probability is passed.

    Raises
    ------
    NoThresholdError
        If that value alone is more probable than `fap`: as where saturation gives many exposures the same counts.
    """
    if at > fap:
        fewer = f"at most {rounded(beyond, up=False):g} or " if beyond > 0 else ""
        more = beyond + at
        exist = f"{fewer}{rounded(more, up=True):g} and more" if more < 1.0 else (fewer.removesuffix(" or ") or "none")
        raise NoThresholdError(
            f"no threshold of {what} has a false-alarm probability of {fap:g}: {100 * at:.3g} % of exposures without a "
            "flare give one and the same value, as saturated pixels do, and either all of them or none are alarms; "
            f"expected a false-alarm probability that a threshold has: {exist}"
        )


def rounded(value: float, *, up: bool) -> float:
    """Return a positive number with four digits, rounded up or down."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return (math.ceil if up else math.floor)(value / unit * (1 + (-1e-12 if up else 1e-12))) * unit


def countable(fap: float, realisations: int) -> bool:
    """Whether enough realisations lie beyond the threshold to count them."""
    return fap * realisations >= FEWEST_IN_TAIL * (1 - 1e-9)


def check_fap(fap: float, realisations: int, tails: Tails = "counted") -> None:
    """Refuse a false-alarm probability that this many realisations cannot settle.

    Raises
    ------
    InputError
        If it is none, or fewer than 100 realisations would lie beyond the threshold and tails are not sampled.
    """
    if not 0.0 < fap < 1.0:
        raise InputError(f"fap = {fap!r}, expected a probability between 0 and 1")
    if tails not in ("counted", "sampled"):
        raise InputError(f"tails = {tails!r}, expected 'counted' or 'sampled'")
    if tails == "counted" and not countable(fap, realisations):
        raise InputError(
            f"fap = {fap:g} leaves {fap * realisations:.3g} of {realisations} realisations beyond the threshold, "
            f"expected at least {FEWEST_IN_TAIL}: ask for {math.ceil(FEWEST_IN_TAIL / fap)} realisations, or for "
            "`tails='sampled'`"
        )
