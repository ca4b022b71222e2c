"""Sparse histogram of values outside the fine bins, with bins of equal relative width over all of float32.

A bin is a range of the float's ordered integer representation (sign, exponent, leading bits of the mantissa), so no
value lies beyond the last bin. Sums are exact integers, independent of order and tiling.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

#: Low bits of the integer representation that a bin ignores, which makes bins 2**-13 of the value wide, or less.
DROPPED_BITS = 10
#: Offset of the keys of bins above the fine ones, since a single bin may reach from below them to above.
ABOVE = 1 << (32 - DROPPED_BITS)
#: Sums are integer multiples of 2**-UNIT_BITS, the smallest float32, and of its square.
UNIT_BITS = 149
#: Number of squared mantissas whose sum is below 2**64.
CHUNK = 2**15
#: Range of keys up to which an array counts them; wider ranges are sorted.
MAX_DENSE_KEYS = 2**16


class SparseCounts:
    """Counts by integer key, merged from time to time."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._counts = np.zeros(0, np.int64)
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        self._waits = 0

    @property
    def keys(self) -> NDArray[np.int64]:
        """Keys with counts, ascending."""
        self._merge()
        return self._keys

    @property
    def counts(self) -> NDArray[np.int64]:
        """Count of each key."""
        self._merge()
        return self._counts

    def add(self, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Add counts of ascending keys."""
        if keys.size:
            self._waiting.append((keys, counts))
            self._waits += keys.size
            if self._waits > max(MAX_DENSE_KEYS, self._keys.size):
                self._merge()

    def count(self, keys: NDArray[np.int64]) -> None:
        """Add one for each key, in any order."""
        self.add(*unique_counts(keys))

    def _merge(self) -> None:
        if not self._waiting:
            return
        keys, counts = (np.concatenate(parts) for parts in zip((self._keys, self._counts), *self._waiting, strict=True))
        self._keys, place = np.unique(keys, return_inverse=True)
        self._counts = np.zeros(self._keys.size, np.int64)
        np.add.at(self._counts, place, counts)
        self._waiting, self._waits = [], 0


def unique_counts(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct keys, ascending, and their counts."""
    if not keys.size:
        return keys, keys
    low = int(keys.min())
    if int(keys.max()) - low < MAX_DENSE_KEYS:
        counts = np.bincount(keys - low)
        where = np.flatnonzero(counts)
        return where + low, counts[where]
    return np.unique_counts(keys)


def keys_of(values: NDArray[np.float32], *, above: bool) -> NDArray[np.int64]:
    """Return the key of each finite value's bin; keys are ordered as values, with those above the fine bins last."""
    # Adding zero turns negative zero into positive zero.
    image = (values + np.float32(0.0)).view(np.int32)
    keys = (_ordered(image) >> DROPPED_BITS).astype(np.int64)
    return keys + ABOVE if above else keys


def _ordered(image: NDArray[np.int32]) -> NDArray[np.int32]:
    """Map representations of floats to integers in the order of the floats; the map is its own inverse."""
    return image ^ ((image >> 31) & np.int32(0x7FFFFFFF))


def edges_of(keys: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the lower edges of bins: the smallest value in each."""
    ordered = ((keys - np.where(is_above(keys), ABOVE, 0)) << DROPPED_BITS).astype(np.int32)
    edges = _ordered(ordered).view(np.float32).astype(np.float64)
    # The value after the largest float32.
    return np.where(np.isinf(edges), 2.0**128, edges)


def is_above(keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether bins lie above the fine ones."""
    return np.asarray(keys >= ABOVE // 2)


def sums_of(values: NDArray[np.float32]) -> tuple[int, int]:
    """Return the exact sums of finite values and of their squares, in units of 2**-149 and 2**-298."""
    image = values.view(np.int32)
    exponent = (image >> 23) & 0xFF
    # Signed mantissas; subnormal numbers have no implicit leading bit.
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
            # Squares of negative numbers agree modulo 2**64.
            second += int((part * part).sum()) << 2 * shift
    return first, second


@dataclass(frozen=True, eq=False)
class FarCounts:
    """Values of a distribution outside its fine bins."""

    keys: NDArray[np.int64]  # filled bins, ascending, shape (m,)
    counts: NDArray[np.int64]  # shape (m,)
    first: int = 0  # sum of values, in units of 2**-149
    second: int = 0  # sum of squares, in units of 2**-298
    undefined: int = 0  # number of infinite values and NaN

    @cached_property
    def n(self) -> int:
        """Number of finite values."""
        return int(self.counts.sum())

    def edges(self, low: float, high: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and upper edges of the bins, limited by the range `low` to `high` of the fine bins."""
        above = is_above(self.keys)
        lower = np.where(above, np.maximum(edges_of(self.keys), high), edges_of(self.keys))
        upper = np.where(above, edges_of(self.keys + 1), np.minimum(edges_of(self.keys + 1), low))
        # The grid rounds in float32, so a value at its end may lie inside the float64 edges.
        return np.where(above, lower, np.minimum(lower, upper)), np.where(above, np.maximum(lower, upper), upper)

    def equals(self, other: FarCounts) -> bool:
        """Return whether all counts and sums are equal."""
        mine, theirs = ((x.first, x.second, x.undefined, x.keys.tolist(), x.counts.tolist()) for x in (self, other))
        return mine == theirs


class FarTally:
    """Accumulator of `FarCounts`."""

    def __init__(self) -> None:
        self.bins = SparseCounts()
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
        """Add counts of other realisations."""
        self.bins.add(other.keys, other.counts)
        self.first += other.first
        self.second += other.second
        self.undefined += other.undefined

    def frozen(self) -> FarCounts:
        """Return the counts so far."""
        return FarCounts(self.bins.keys, self.bins.counts, self.first, self.second, self.undefined)
