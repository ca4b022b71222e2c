"""Which false-alarm probabilities so many realisations can settle."""

from __future__ import annotations

import math
from typing import Literal

from mauvecl.host.errors import InputError

#: A threshold needs this many realisations beyond it; a rarer tail is refused, never extrapolated.
FEWEST_IN_TAIL = 100

#: Thresholds with fewer than `FEWEST_IN_TAIL` beyond them: refused, or by importance sampling.
Tails = Literal["counted", "sampled"]


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
            "sampled tails"
        )
