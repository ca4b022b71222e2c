"""Values remembered by what they were computed from: a change of one thing computes no other again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


class _Given:
    """Arguments, equal where their bytes are; they are let go once the value is there, only their digest stays."""

    __slots__ = ("digest", "values")

    def __init__(self, values: tuple[Any, ...]) -> None:
        hashed = hashlib.sha256()
        for value in values:
            if isinstance(value, np.ndarray):
                hashed.update(f"{value.dtype.str}{value.shape}".encode())
                hashed.update(np.ascontiguousarray(value).data)
            else:
                hashed.update(repr(value).encode())
        self.values, self.digest = values, hashed.digest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Given) and self.digest == other.digest


def remembered(most: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function of arrays and plain values that remembers its last values.

    Parameters
    ----------
    most : int
        How many. Arrays among them cannot be written to, for they are shared. What raises is not remembered.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @lru_cache(maxsize=most)
        def computed(given: _Given) -> R:
            (arguments, named), given.values = given.values, ()
            value = function(*arguments, **named)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            return value

        @wraps(function)
        def wrapper(*arguments: P.args, **named: P.kwargs) -> R:
            given = _Given((*arguments, *sorted(named.items())))
            given.values = arguments, named
            return computed(given)

        return wrapper

    return decorate
