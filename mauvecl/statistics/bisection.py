"""Bisection of whole numbers."""

from __future__ import annotations

from collections.abc import Callable


def smallest_integer(reached: Callable[[int], bool], low: int, high: int) -> int:
    """Return the smallest whole number for which a monotone predicate holds: not for `low`, but for `high`."""
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high
