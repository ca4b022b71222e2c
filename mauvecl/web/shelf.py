"""Bounded memory of what the server keeps for its visitors."""

from __future__ import annotations

import gc
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

#: Bytes of closed forms, answers and files that the server keeps for all visitors together, and of their uploads.
MOST_RESULTS, MOST_UPLOADS = 256 * 2**20, 256 * 2**20
#: Objects that are counted of a value; arrays, which take most of the memory, are near its top.
MOST_OBJECTS = 20_000
#: Objects that belong to the program.
PROGRAM = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType)


class Shelf:
    """Values of all visitors, of which the least recently used are dropped if they take too much memory.

    Parameters
    ----------
    most : int
        Largest total size, bytes.
    """

    def __init__(self, most: int) -> None:
        self.most, self.size = most, 0
        self._held: OrderedDict[tuple[int, Hashable], tuple[int, Callable[[], object]]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, owner: object, key: Hashable, value: object, drop: Callable[[], object]) -> None:
        """Count a value that its owner keeps; `drop` is called if it must go."""
        size = size_of(value)
        with self._lock:
            self._remove((id(owner), key))
            self._held[id(owner), key] = size, drop
            self.size += size
            gone = []
            while self.size > self.most and len(self._held) > 1:
                oldest = next(iter(self._held))
                gone.append(self._held[oldest][1])
                self._remove(oldest)
        for one in gone:
            one()

    def used(self, owner: object, key: Hashable) -> None:
        """Note that a value was used."""
        with self._lock:
            if (id(owner), key) in self._held:
                self._held.move_to_end((id(owner), key))

    def leave(self, owner: object) -> None:
        """Forget the values of an owner."""
        with self._lock:
            for entry in [entry for entry in self._held if entry[0] == id(owner)]:
                self._remove(entry)

    def _remove(self, entry: tuple[int, Hashable]) -> None:
        self.size -= self._held.pop(entry, (0, None))[0]


#: Results and uploads of all visitors.
RESULTS, UPLOADED = Shelf(MOST_RESULTS), Shelf(MOST_UPLOADS)


def size_of(value: object) -> int:
    """Return the approximate size of a value and of what it refers to, bytes."""
    seen: set[int] = set()
    waiting: list[Any] = [value]
    size = 0
    while waiting and len(seen) < MOST_OBJECTS:
        # The oldest first, so that the top is counted before the details.
        level, waiting = waiting, []
        for one in level:
            if id(one) in seen or isinstance(one, PROGRAM):
                continue
            seen.add(id(one))
            size += sys.getsizeof(one, 0)
            waiting += gc.get_referents(one)
            if isinstance(one, np.ndarray) and one.base is not None:
                waiting.append(one.base)
    return size
