"""Computations with arrays: copies that no caller can modify, cached results, equality by content, work in threads."""

from __future__ import annotations

import hashlib
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from functools import lru_cache, wraps
from itertools import chain
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Arrays of doubles and of truth values.
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
#: Standard deviation of a normal distribution in units of its median absolute deviation, 1 / ndtri(0.75).
PER_MAD = 1.482602218505602
#: Arrays by name, as workers send and checkpoints keep them.
Arrays = dict[str, NDArray[Any]]

P = ParamSpec("P")
R = TypeVar("R")


def set_read_only(owner: object, **arrays: ArrayLike) -> None:
    """Set fields of a frozen dataclass to private copies of arrays, which no caller can modify."""
    for name, values in arrays.items():
        private = np.array(values, np.float64)
        private.setflags(write=False)
        object.__setattr__(owner, name, private)


def true_runs(flags: Bool) -> NDArray[np.intp]:
    """Return the first index of each run of true values and one past its last, shape (n_run, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]))).reshape(-1, 2)


def array_cache(maxsize: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Cache the latest results of a function of arrays and plain values.

    Arrays among the results are read-only, since callers share them. Exceptions are not cached.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        thread = threading.local()

        @lru_cache(maxsize=maxsize)
        def computed(digest: bytes) -> R:
            arguments, keywords = thread.call
            value = function(*arguments, **keywords)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            return value

        @wraps(function)
        def wrapper(*arguments: P.args, **keywords: P.kwargs) -> R:
            hashed = hashlib.sha256()
            for value in (*arguments, *chain.from_iterable(sorted(keywords.items()))):
                if isinstance(value, np.ndarray):
                    hashed.update(f"{value.dtype.str}{value.shape}".encode())
                    hashed.update(np.ascontiguousarray(value).data)
                else:
                    hashed.update(repr(value).encode())
            thread.call = arguments, keywords
            try:
                return computed(hashed.digest())
            finally:
                # The arguments may be large, and are not needed any more.
                thread.call = None

        return wrapper

    return decorate


class ContentEquality:
    """Mixin with equality and hash by fields, arrays included, and a one-line repr from `_line`."""

    def __init_subclass__(cls, **words: Any) -> None:
        super().__init_subclass__(**words)
        # Set on the subclass, since a dataclass adds its own methods unless the class defines them.
        for name in ("__repr__", "__eq__", "__hash__"):
            if name not in vars(cls):
                setattr(cls, name, vars(ContentEquality)[name])

    def __eq__(self, other: object) -> bool:
        return NotImplemented if type(other) is not type(self) else equal_content(_attributes(self), _attributes(other))

    def __hash__(self) -> int:
        plain = (value for value in _attributes(self).values() if isinstance(value, str | int | float))
        return hash((type(self).__name__, *plain))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._line()}>"

    def _line(self) -> str:
        return ", ".join(str(value) for value in _attributes(self).values() if isinstance(value, str | int | float))


def equal_content(first: Any, second: Any) -> bool:
    """Return whether two objects have equal content, comparing arrays by bytes and plain objects by attributes."""
    if first is second:
        return True
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        first, second = np.asarray(first), np.asarray(second)
        if first.dtype == object:
            return equal_content(first.tolist(), second.tolist())
        return bool(first.shape == second.shape and first.dtype == second.dtype and first.tobytes() == second.tobytes())
    if type(first) is not type(second):
        return bool(first == second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal_content(value, second[key]) for key, value in first.items())
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal_content, first, second))
    if hasattr(first, "colnames"):
        # An astropy table: compare columns, units and metadata.
        units = [[str(getattr(table[name], "unit", "")) for name in table.colnames] for table in (first, second)]
        columns = [{name: np.asarray(table[name]) for name in table.colnames} for table in (first, second)]
        return units[0] == units[1] and equal_content(*columns) and equal_content(dict(first.meta), dict(second.meta))
    if isinstance(first, float):
        return first == second or (first != first and second != second)
    # The own equality of a dataclass would find undefined numbers unequal to themselves.
    if is_dataclass(first) or not any("__eq__" in vars(kind) for kind in type(first).__mro__[:-1]):
        return equal_content(_attributes(first), _attributes(second))
    return bool(first == second)


def _attributes(value: Any) -> dict[str, Any]:
    """Return the compared fields of a dataclass, or all attributes of another object."""
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value) if field.compare}
    return dict(vars(value))


Item = TypeVar("Item")
Answer = TypeVar("Answer")

#: Largest number of threads that work at the same time; each may hold large arrays.
MAX_THREADS = 4


def map_in_threads(
    work: Callable[[Item], Answer],
    items: Iterable[Item],
    number: int | None = None,
    stop: Callable[[], object] | None = None,
) -> Generator[Answer]:
    """Apply a function to items in several threads and yield the results in order; one per thread may wait in memory.

    The number of threads is by default that of the cores, up to `MAX_THREADS`; one works in the caller's thread.
    `stop` ends work in progress if it fails or no more results are needed; without it, that work is awaited.
    """
    number = number or min(os.cpu_count() or 1, MAX_THREADS)
    if number == 1:
        yield from map(work, items)
        return
    ahead: deque[Future[Answer]] = deque()
    with ThreadPoolExecutor(number) as threads:
        try:
            for item in items:
                ahead.append(threads.submit(work, item))
                if len(ahead) > number:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        except BaseException:
            for future in ahead:
                future.cancel()
            if stop is not None:
                stop()
            raise
