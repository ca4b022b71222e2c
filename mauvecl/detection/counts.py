"""Histograms and moments of statistics, independent of order and tiling.

Values outside the fine bins are counted in bins of equal relative width over all of float32. Such a bin is a range of
the float's ordered integer representation (sign, exponent, leading bits of the mantissa), so no value lies beyond the
last bin. Sums of values and of their squares are exact integers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection import check_probability
from mauvecl.detection.distributions import Interval, central_counts
from mauvecl.host.arrays import Arrays, Float, equal_content
from mauvecl.noise import layout
from mauvecl.schema.errors import InputError

#: Low bits of the integer representation that a bin ignores, which makes bins 2**-13 of the value wide, or less.
DROPPED_BITS = 10
#: The number of a far bin is the ordered integer without these bits, less `FAR` below the fine bins, plus `FAR` above.
FAR = 1 << (32 - DROPPED_BITS)
#: Number that stands for infinite values and NaN.
UNDEFINED = -2 * FAR
#: Bits of all numbers.
NUMBER_BITS = 34 - DROPPED_BITS
#: Sums of far values are integer multiples of 2**-UNIT_BITS, the smallest float32, and of its square.
UNIT_BITS = 149
#: Number of squares below 2**48 whose sum has no more than 63 bits.
CHUNK = 2**14
#: Largest range of numbers that are counted in an array; numbers of a wider range are sorted.
MAX_DENSE = 2**16


class RowCounts:
    """Counts of whole numbers in several rows.

    Numbers have `bits` bits, sign included. A key combines the row and the number.
    """

    def __init__(self, bits: int = 32) -> None:
        self._span, self._half = 1 << bits, 1 << (bits - 1)
        # Keys and counts: first those merged so far, whose keys ascend, then later ones.
        self._parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
        self._n_unmerged = 0

    def __eq__(self, other: object) -> bool:
        """Compare counts, merged or not."""
        if not isinstance(other, RowCounts):
            return NotImplemented
        return equal_content((self._span, self.totals()), (other._span, other.totals()))

    __hash__ = None  # type: ignore[assignment]

    def totals(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keys with counts, ascending, and the count of each."""
        if len(self._parts) > 1:
            keys, counts = (np.concatenate(arrays) for arrays in zip(*self._parts, strict=True))
            keys, place = np.unique(keys, return_inverse=True)
            total = np.zeros(keys.size, np.int64)
            np.add.at(total, place, counts)
            self._parts, self._n_unmerged = [(keys, total)], 0
        return self._parts[0]

    def rows(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the row, number and count of each key."""
        keys, counts = self.totals()
        rows, numbers = np.divmod(keys, self._span)
        return rows, numbers - self._half, counts

    def in_row(self, row: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the numbers of a row, ascending, and their counts."""
        keys, counts = self.totals()
        first = row * self._span
        places = slice(*np.searchsorted(keys, (first, first + self._span)))
        return keys[places] - first - self._half, counts[places].copy()

    def add(self, rows: NDArray[np.int64] | int, numbers: NDArray[np.int64], counts: NDArray[np.integer]) -> None:
        """Add counts of different numbers."""
        self._add(rows * self._span + self._half + numbers, counts.astype(np.int64))

    def count(self, row: int, numbers: NDArray[np.int64]) -> None:
        """Add one for each number of a row."""
        if not numbers.size:
            return
        low = int(numbers.min())
        if int(numbers.max()) - low < MAX_DENSE:
            counts = np.bincount(numbers - low)
            filled = np.flatnonzero(counts)
            self.add(row, filled + low, counts[filled])
        else:
            self.add(row, *np.unique_counts(numbers))

    def _add(self, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        if keys.size:
            self._parts.append((keys, counts))
            self._n_unmerged += keys.size
            if self._n_unmerged > max(MAX_DENSE, self._parts[0][0].size):
                self.totals()

    def pack(self, name: str) -> Arrays:
        """Return the counts as arrays: the first key, and differences of keys and counts in the smallest types."""
        keys, counts = self.totals()
        packed = {f"{name}-first": keys[:1]}
        for key, array in ((f"{name}-steps", np.diff(keys)), (name, counts)):
            packed[key] = array.astype(np.min_scalar_type(int(array.max(initial=0))))
        return packed

    def merge(self, name: str, arrays: Arrays) -> None:
        """Add packed counts."""
        steps = np.concatenate([arrays[f"{name}-first"], arrays[f"{name}-steps"].astype(np.int64)])
        self._add(np.cumsum(steps, dtype=np.int64), arrays[name].astype(np.int64))


def far_numbers(values: NDArray[np.float32], above: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of each value's far bin above or below the fine ones, ordered as values; or `UNDEFINED`."""
    # Adding zero turns negative zero into positive zero.
    image = (values + np.float32(0.0)).view(np.int32)
    numbers = (_ordered(image) >> DROPPED_BITS) + np.where(above, FAR, -FAR)
    return np.where(np.isfinite(values), numbers, UNDEFINED)


def _ordered(image: NDArray[np.int32]) -> NDArray[np.int32]:
    """Map representations of floats to integers in the order of the floats; the map is its own inverse."""
    return image ^ ((image >> 31) & np.int32(0x7FFFFFFF))


def _far_edges(numbers: NDArray[np.int64]) -> Float:
    """Return the lower edges of far bins, the smallest value in each, from their numbers without `FAR`."""
    edges = _ordered((numbers << DROPPED_BITS).astype(np.int32)).view(np.float32).astype(np.float64)
    # The value after the largest float32.
    return np.where(np.isinf(edges), 2.0**128, edges)


def sums_of(values: NDArray[np.float32]) -> tuple[int, int]:
    """Return the exact sums of finite values and of their squares, in units of 2**-149 and 2**-298."""
    # Values are whole multiples of 2**(power - 149), below 2**24 of them; subnormal numbers have the smallest power.
    powers = np.maximum(np.frexp(values)[1] + (UNIT_BITS - 24), 0)
    first = second = 0
    for power in np.flatnonzero(np.bincount(powers)).tolist():
        multiples = np.ldexp(values[powers == power].astype(np.float64), UNIT_BITS - power).astype(np.int64)
        first += int(multiples.sum()) << power
        for chunk in np.split(multiples, range(CHUNK, multiples.size, CHUNK)):
            second += int(chunk @ chunk) << 2 * power
    return first, second


def grids_of(channel: Sequence[int], centre: Sequence[float], sigma: Sequence[float]) -> NDArray[np.void]:
    """Return the histograms of channels, `layout.GRID`, with bins scaled to a standard deviation, shape (n_grid,)."""
    grids = np.zeros(len(channel), layout.GRID)
    grids["channel"] = channel
    with np.errstate(over="ignore", divide="ignore"):
        grids["centre"], grids["steps_per_unit"] = centre, layout.STEPS_PER_SIGMA / np.asarray(sigma, float)
    # If float32 cannot represent the steps, all values count as far.
    scale = grids["steps_per_unit"]
    bad = ~(np.isfinite(grids["centre"]) & np.isfinite(scale) & (scale >= np.finfo(np.float32).tiny))
    grids["centre"][bad], scale[bad] = 0.0, np.nan
    return grids


#: First and last fine bin, and their range of steps.
FIRST_BIN, LAST_BIN = 1, layout.BINS - 2
LOW_STEP, HIGH_STEP = ((n - layout.BINS // 2) * 2**layout.FINE_BITS for n in (FIRST_BIN, LAST_BIN + 1))


class Tally:
    """Accumulator of the histograms and sums of many channels, on grids as `grids_of` returns them.

    `tails` holds accumulators of the extremes of some of them, by the index of the grid.
    """

    def __init__(self, grids: NDArray[np.void], tails: Mapping[int, TailSamples] | None = None) -> None:
        self.grids, self.tails = grids, tails or {}
        # Bins of each grid, of which few are filled.
        self.counts = RowCounts(NUMBER_BITS)
        # Sums of steps in fine bins and of their squares, and those of `sums_of` of the values in far bins; Python
        # integers, since squares may exceed 64 bits.
        self.sums = np.zeros((len(grids), 4), object)
        self.n = 0

    def add(self, histogram: NDArray[np.integer], sums: NDArray[np.integer], n: int) -> None:
        """Add the counts of n realisations in fine bins, (n_grid, BINS), and sums of their steps, and squares."""
        grid, inner = np.nonzero(histogram[:, FIRST_BIN : LAST_BIN + 1])
        self.counts.add(grid, FIRST_BIN + inner, histogram[grid, FIRST_BIN + inner])
        self.sums[:, :2] += sums.astype(object)
        self.n += n

    def add_far(self, index: int, values: NDArray[np.float32]) -> int:
        """Count the values of a grid's channel that lie outside its fine bins, and return their number."""
        grid = self.grids[index]
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.rint((values - grid["centre"]) * grid["steps_per_unit"])
        above = steps >= HIGH_STEP
        # The complement counts NaN as below.
        outside = above | ~(steps >= LOW_STEP)
        self.sums[index, 2:] += sums_of(values[outside & np.isfinite(values)])
        self.counts.count(index, far_numbers(values[outside], above[outside]))
        return int(outside.sum())

    def pack(self) -> Arrays:
        """Return the counts, sums and extremes of a shard as arrays."""
        packed = self.counts.pack("counts") | {"sums": self.sums.astype(str), "n": np.array(self.n)}
        for index, tail in self.tails.items():
            packed[f"values-{index}"], packed[f"realisations-{index}"] = tail.values, tail.realisations
        return packed

    def merge(self, packed: Arrays) -> None:
        """Add a packed shard of other realisations."""
        self.counts.merge("counts", packed)
        self.sums += np.vectorize(int, otypes=[object])(packed["sums"])
        self.n += int(packed["n"])
        for index, tail in self.tails.items():
            tail.merge(packed[f"values-{index}"], packed[f"realisations-{index}"])

    def distribution(self, index: int) -> Distribution:
        """Return the distribution of a grid."""
        grid, (numbers, counts) = self.grids[index], self.counts.in_row(index)
        defined = numbers != UNDEFINED
        return Distribution(
            float(grid["centre"]), 1.0 / float(grid["steps_per_unit"]), numbers[defined], counts[defined],
            tuple(self.sums[index].tolist()), self.n, int(counts[~defined].sum()),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Distribution:
    """A histogram of unlimited range with exact integer moments.

    Fine bins are 1/512 of a standard deviation wide within 32 standard deviations of the centre; far bins are 2**-13 of
    the value wide beyond.
    """

    centre: float  # value of the statistic at step 0
    step: float  # size of a fine step
    numbers: NDArray[np.int64]  # of bins with counts, ascending; negative or above BINS for far ones, shape (m,)
    filled: NDArray[np.int64]  # counts in these bins, shape (m,)
    sums: tuple[int, ...]  # as of `Tally`
    n: int  # number of realisations
    undefined: int  # number of infinite values and NaN

    @property
    def is_fine(self) -> NDArray[np.bool_]:
        """Mask of the filled bins that are fine ones, shape (m,)."""
        return (self.numbers >= 0) & (self.numbers < layout.BINS)

    @property
    def counts(self) -> NDArray[np.int64]:
        """Counts of all fine bins, shape (BINS,)."""
        counts = np.zeros(layout.BINS, np.int64)
        counts[self.numbers[self.is_fine]] = self.filled[self.is_fine]
        return counts

    @property
    def n_far(self) -> int:
        """Number of values in far bins."""
        return int(self.filled[~self.is_fine].sum())

    @cached_property
    def _moments(self) -> tuple[Fraction, Fraction]:
        """Exact mean and variance of all values."""
        self.refuse_undefined()
        first, second, *far = self.sums
        total, squares = Fraction(far[0], 2**UNIT_BITS), Fraction(far[1], 2 ** (2 * UNIT_BITS))
        if inside := self.n - self.n_far:
            centre, step = Fraction(self.centre), Fraction(self.step)
            total += inside * centre + step * first
            squares += inside * centre**2 + 2 * centre * step * first + step**2 * second
        mean = total / self.n
        return mean, squares / self.n - mean**2

    def refuse_undefined(self, name: str = "the statistic") -> None:
        """Raise InputError if values are not finite."""
        if self.undefined:
            raise InputError(
                f"{name} must be finite, but is infinite or no number in {self.undefined} of {self.n} realisations",
                key="statistic",
            )

    @property
    def mean(self) -> float:
        return float(self._moments[0])

    @property
    def std(self) -> float:
        return math.sqrt(self._moments[1])

    def edge(self, number: NDArray[np.integer]) -> Float:
        """Return the lower edges of fine bins."""
        steps = (number - layout.BINS // 2) * 2.0**layout.FINE_BITS - 0.5
        return np.asarray(self.centre + self.step * steps)

    # Computed when needed: a detection of hundreds of flares has thousands of distributions.
    @property
    def bins(self) -> tuple[Float, Float, NDArray[np.int64]]:
        """Lower edges, upper edges and counts of all filled bins, ascending; each shape (m,)."""
        self.refuse_undefined()
        numbers = np.array([self.numbers, self.numbers + 1])
        edges, below, above = self.edge(numbers), self.numbers < 0, self.numbers >= layout.BINS
        # Far bins end where fine ones begin; these have no ends if all values count as far.
        low, high = self.edge(np.array([FIRST_BIN, LAST_BIN + 1]))
        edges[:, below] = np.fmin(_far_edges(numbers[:, below] + FAR), low)
        edges[:, above] = np.fmax(_far_edges(numbers[:, above] - FAR), high)
        return edges[0], edges[1], self.filled

    def above(self, value: float) -> float:
        """Return the number of realisations at or above a value: exact at edges of bins, interpolated between."""
        lower, upper, counts = self.bins
        # The first bin with an upper edge above the value.
        index = int(np.searchsorted(upper, value, side="right"))
        if index == counts.size:
            return 0.0
        share = 1.0 if value <= lower[index] else (upper[index] - value) / (upper[index] - lower[index])
        return float(counts[index + 1 :].sum() + share * counts[index])

    def edge_with_at_most(self, n_above: int) -> float:
        """Return the lowest edge of a bin with at most `n_above` realisations at or above it, or minus infinity."""
        _, upper, counts = self.bins
        more = np.flatnonzero(np.cumsum(counts[::-1])[::-1] > n_above)
        return float(upper[more[-1]]) if more.size else -math.inf

    def counts_around(self, edge: float) -> tuple[int, int]:
        """Return the counts at or above the lower edge of a bin, and in the filled bin below that edge."""
        _, upper, counts = self.bins
        at = int(np.searchsorted(upper, edge, side="right"))
        return int(counts[at:].sum()), int(counts[at - 1]) if at else 0

    def quantile_interval(self, probability: float) -> Interval:
        """Return a quantile, interpolated linearly within a bin, with the 95 % interval of order statistics.

        The interval is rounded outwards to edges of bins.
        """
        check_probability("probability", probability)
        lower, upper, counts = self.bins
        edges = np.column_stack([lower, upper]).ravel()
        # The number of values below the quantile is binomial, so it lies between these ranks with 95 %.
        low, high = central_counts(self.n, probability)
        first, last = (int(np.searchsorted(counts.cumsum(), rank)) for rank in (low, high + 1))
        ends = float(lower[first]) if low else -np.inf, float(upper[last]) if high < self.n else np.inf
        return Interval(float(np.interp(probability, steps_of(counts) / self.n, edges)), *ends)

    def histogram(self, bins: int = 200) -> tuple[Float, NDArray[np.int64]]:
        """Return edges, shape (m + 1,), and counts, shape (m,), in at most `bins` equal bins, for plots."""
        lower, upper, _ = self.bins
        if self.n_far:
            # No bin is narrower than the widest bin of the counts.
            span = upper[-1] - lower[0]
            edges = np.linspace(lower[0], upper[-1], max(min(bins, int(span / (upper - lower).max())), 1) + 1)
        else:
            low, high = int(self.numbers[0]), int(self.numbers[-1]) + 1
            group = -(-(high - low) // bins)
            edges = self.edge(np.arange(low, high + group, group))
        above = [self.above(edge) for edge in edges]
        return edges, -np.diff(np.rint(above)).astype(np.int64)


def steps_of(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of realisations below the lower and the upper edge of each bin, alternating, shape (2 m,)."""
    above = np.cumsum(counts)
    return np.column_stack([above - counts, above]).ravel()


#: Number of extreme values of each tail that are kept with their realisations.
TAIL_SAMPLES = 1000


class TailSamples:
    """The largest (or smallest) values of a channel and their realisations."""

    def __init__(self, *, largest: bool) -> None:
        self._sign = np.float32(1.0 if largest else -1.0)
        self.values = np.empty(0, np.float32)
        self.realisations = np.empty(0, np.int64)

    def add(self, values: NDArray[np.float32], first: int) -> None:
        """Add the values of realisations from `first` on; among equal values the earlier realisation is kept."""
        signed = self._sign * values
        if self.values.size == TAIL_SAMPLES:
            beyond = np.flatnonzero(signed > self._sign * self.values[-1])
        elif values.size > TAIL_SAMPLES:
            # Partitioning before sorting is faster.
            beyond = np.flatnonzero(signed >= np.partition(signed, -TAIL_SAMPLES)[-TAIL_SAMPLES])
        else:
            beyond = np.arange(values.size)
        if beyond.size:
            self.merge(values[beyond], first + beyond)

    def merge(self, values: NDArray[np.float32], realisations: NDArray[np.int64]) -> None:
        """Add the extreme values of other realisations, in any order."""
        values = np.concatenate([self.values, values])
        realisations = np.concatenate([self.realisations, realisations])
        order = np.lexsort((realisations, -self._sign * values))[:TAIL_SAMPLES]
        self.values, self.realisations = values[order], realisations[order]
