"""Values outside a fine histogram: bins of equal relative width over every float32, kept where something fell.

A bin is a run of the float's ordered integer image (sign, exponent, leading bits of the mantissa), so that no value
lies beyond the last one. Sums are exact whole numbers, which neither order nor tiling can change.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

#: Bits of a float32's integer image that a bin does not tell apart: what is left is 2**-13 of the value, or finer.
DROPPED_BITS = 10
#: Added to the keys of bins above the fine ones: a bin may reach from below them to above.
ABOVE = 1 << (32 - DROPPED_BITS)
#: Sums are of whole multiples of the smallest float32, and of its square.
UNIT_BITS = 149
#: Squares of so many mantissas sum to less than 2**64.
CHUNK = 2**15
#: Keys closer together than this are counted in an array, others are sorted.
CLOSE = 2**16


class Sparse:
    """Counts by whole-number keys, of which few occur; merged now and then."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        self._waits = 0

    @property
    def keys(self) -> NDArray[np.int64]:
        """Those that occurred, rising."""
        self._merge()
        return self._keys

    @property
    def counts(self) -> NDArray[np.int64]:
        """How often each occurred."""
        self._merge()
        return self._counts

    def add(self, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Add counts of keys, each rising."""
        if keys.size:
            self._waiting.append((keys, counts))
            self._waits += keys.size
            if self._waits > max(CLOSE, self._keys.size):
                self._merge()

    def count(self, keys: NDArray[np.int64]) -> None:
        """Add one for each key, in any order."""
        self.add(*counted(keys))

    def _merge(self) -> None:
        if not self._waiting:
            return
        keys, counts = (np.concatenate(parts) for parts in zip((self._keys, self._counts), *self._waiting, strict=True))
        self._keys, place = np.unique(keys, return_inverse=True)
        self._counts = np.zeros(self._keys.size, np.int64)
        np.add.at(self._counts, place, counts)
        self._waiting, self._waits = [], 0


def counted(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys that occur, rising, and how often each does."""
    if not keys.size:
        return keys, keys
    low = int(keys.min())
    if int(keys.max()) - low < CLOSE:
        counts = np.bincount(keys - low)
        where = np.flatnonzero(counts)
        return where + low, counts[where]
    return np.unique_counts(keys)


def keys_of(values: NDArray[np.float32], *, above: bool) -> NDArray[np.int64]:
    """The bin of each finite value, in the order of values; those above the fine bins after all below."""
    # Adding zero makes the negative zero positive.
    image = (values + np.float32(0.0)).view(np.int32)
    keys = (_ordered(image) >> DROPPED_BITS).astype(np.int64)
    return keys + ABOVE if above else keys


def _ordered(image: NDArray[np.int32]) -> NDArray[np.int32]:
    """Whole numbers in the order of the floats they are the images of; its own inverse."""
    return image ^ ((image >> 31) & np.int32(0x7FFFFFFF))


def edges_of(keys: NDArray[np.int64]) -> NDArray[np.float64]:
    """Lower edges of bins: the smallest value in each."""
    ordered = ((keys - np.where(is_above(keys), ABOVE, 0)) << DROPPED_BITS).astype(np.int32)
    edges = _ordered(ordered).view(np.float32).astype(np.float64)
    # One past the largest float32.
    return np.where(np.isinf(edges), 2.0**128, edges)


def is_above(keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether bins lie above the fine ones."""
    return np.asarray(keys >= ABOVE // 2)


def sums_of(values: NDArray[np.float32]) -> tuple[int, int]:
    """Exact sums of finite values and of their squares, in 2**-149 and 2**-298."""
    image = values.view(np.int32)
    exponent = (image >> 23) & 0xFF
    # Without the first bit, which is zero in the smallest numbers, and with the sign.
    mantissa = image & 0x7FFFFF
    mantissa |= 0x800000
    mantissa[exponent == 0] ^= 0x800000
    mantissa = (mantissa ^ (image >> 31)) - (image >> 31)
    first = second = 0
    low, high = int(exponent.min(initial=255)), int(exponent.max(initial=0))
    for one in range(low, high + 1):
        mine = mantissa if low == high else mantissa[exponent == one]
        shift = max(one, 1) - 1
        first += int(mine.sum(dtype=np.int64)) << shift
        for begin in range(0, mine.size, CHUNK):
            part = mine[begin : begin + CHUNK].astype(np.int64).view(np.uint64)
            # Those of negative numbers agree modulo 2**64.
            second += int((part * part).sum()) << 2 * shift
    return first, second


@dataclass(frozen=True, eq=False)
class FarCounts:
    """What one distribution has outside its fine bins.

    Attributes
    ----------
    keys, counts : ndarray of int64, shape (m,)
        Bins in which something fell, rising, and how much.
    first, second : int
        Sums of values and of their squares, in units of 2**-149 and 2**-298.
    undefined : int
        Values that are infinite or no numbers.
    """

    keys: NDArray[np.int64]
    counts: NDArray[np.int64]
    first: int = 0
    second: int = 0
    undefined: int = 0

    @cached_property
    def n(self) -> int:
        """Finite values."""
        return int(self.counts.sum())

    def edges(self, low: float, high: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper edges of the bins, those of the fine bins being `low` and `high`."""
        above = is_above(self.keys)
        lower = np.where(above, np.maximum(edges_of(self.keys), high), edges_of(self.keys))
        upper = np.where(above, edges_of(self.keys + 1), np.minimum(edges_of(self.keys + 1), low))
        # The grid rounds in float32: a value next to its end may lie inside by its edges in float64.
        return np.where(above, lower, np.minimum(lower, upper)), np.where(above, np.maximum(lower, upper), upper)

    def equals(self, other: FarCounts) -> bool:
        """Whether every count and sum is the same."""
        mine, theirs = ((x.first, x.second, x.undefined, x.keys.tolist(), x.counts.tolist()) for x in (self, other))
        return mine == theirs


class Far:
    """`FarCounts` while it grows."""

    def __init__(self) -> None:
        self.bins = Sparse()
        self.first = self.second = self.undefined = 0

    def add(self, values: NDArray[np.float32], *, above: bool) -> None:
        """Count values outside the fine bins, all above or all below them."""
        finite = np.isfinite(values)
        if not finite.all():
            self.undefined += int(values.size - finite.sum())
            values = values[finite]
        if values.size:
            self.bins.count(keys_of(values, above=above))
            first, second = sums_of(values)
            self.first += first
            self.second += second

    def merge(self, other: FarCounts) -> None:
        """Add what was counted elsewhere."""
        self.bins.add(other.keys, other.counts)
        self.first += other.first
        self.second += other.second
        self.undefined += other.undefined

    def frozen(self) -> FarCounts:
        """All of it."""
        return FarCounts(self.bins.keys, self.bins.counts, self.first, self.second, self.undefined)
