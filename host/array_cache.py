"""Cache decorator for functions of arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


class _Arguments:
    """Arguments that compare by the digest of their bytes; the values are released after the call."""

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
        return isinstance(other, _Arguments) and self.digest == other.digest


def array_cache(maxsize: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Cache the latest results of a function of arrays and plain values.

    Arrays among the results are read-only, since callers share them. Exceptions are not cached.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @lru_cache(maxsize=maxsize)
        def computed(given: _Arguments) -> R:
            (arguments, named), given.values = given.values, ()
            value = function(*arguments, **named)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            return value

        @wraps(function)
        def wrapper(*arguments: P.args, **named: P.kwargs) -> R:
            given = _Arguments((*arguments, *sorted(named.items())))
            given.values = arguments, named
            return computed(given)

        return wrapper

    return decorate
