"""Histograms and moments in integer arithmetic, independent of order and tiling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.results.counts.sparse_counts import UNIT_BITS, FarCounts, FarTally, SparseCounts, is_above
from mauvecl.schema.errors import InputError
from mauvecl.statistics.intervals import Interval, central_counts


@dataclass(frozen=True)
class Grid:
    """Bins of a histogram."""

    channel: int  # channel whose values are counted
    centre: float
    sigma: float  # standard deviation to which the bins are scaled

    @staticmethod
    def pack(grids: Sequence[Grid]) -> NDArray[np.void]:
        """Return the grids in the layout of the device, shape (n_grid,)."""
        packed = np.zeros(len(grids), layout.GRID)
        packed["channel"] = [grid.channel for grid in grids]
        with np.errstate(over="ignore", divide="ignore"):
            packed["centre"] = [grid.centre for grid in grids]
            packed["steps_per_unit"] = layout.STEPS_PER_SIGMA / np.array([grid.sigma for grid in grids], float)
        # If float32 cannot represent the steps, all values count as far.
        scale = packed["steps_per_unit"]
        bad = ~(np.isfinite(packed["centre"]) & np.isfinite(scale) & (scale >= np.finfo(np.float32).tiny))
        packed["centre"][bad], scale[bad] = 0.0, np.nan
        return packed


#: First and last fine bin, and their range of steps.
FIRST_BIN, LAST_BIN = 1, layout.BINS - 2
LOW_STEP, HIGH_STEP = ((n - layout.BINS // 2) * 2**layout.FINE_BITS for n in (FIRST_BIN, LAST_BIN + 1))


class Tally:
    """Accumulator of the histograms and sums of many channels."""

    def __init__(self, grids: Sequence[Grid]) -> None:
        self.grids = tuple(grids)
        self.packed = Grid.pack(self.grids)
        # Fine bins, by grid times BINS plus bin: few are filled. The first and the last of each grid stay empty.
        self.fine = SparseCounts()
        # Sums of steps in fine bins and of their squares; Python integers, since squares may exceed 64 bits.
        self.sums = np.zeros((len(grids), 2), object)
        self.far = [FarTally() for _ in grids]
        self.n = 0

    def add(self, histogram: NDArray[np.integer], sums: NDArray[np.generic], n: int) -> None:
        """Add the counts of one or more tiles in fine bins.

        `histogram` has the shape (n_grid, BINS). `sums`, shape (n_grid, 2), holds sums of fine steps and of their
        squares. `n` is the number of realisations, including those counted by `add_far`.
        """
        grid, inner = np.nonzero(histogram[:, FIRST_BIN : LAST_BIN + 1])
        counts = histogram[grid, FIRST_BIN + inner].astype(np.int64)
        self.merge(grid * layout.BINS + FIRST_BIN + inner, counts, sums, n)

    def merge(self, keys: NDArray[np.int64], counts: NDArray[np.int64], sums: NDArray[np.generic], n: int) -> None:
        """Add counts of fine bins by their keys, as in `fine`; other parameters as for `add`."""
        self.fine.add(keys, counts)
        self.sums += sums.astype(object)
        self.n += n

    def add_far(self, index: int, values: NDArray[np.float32]) -> int:
        """Count the values of a grid's channel that lie outside its fine bins, and return their number."""
        grid = self.packed[index]
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.rint((values - grid["centre"]) * grid["steps_per_unit"])
        above = steps >= HIGH_STEP
        # The complement counts NaN as below.
        below = ~(steps >= LOW_STEP)
        for there, side in ((above, True), (below, False)):
            if there.any():
                self.far[index].add(values if there.all() else values[there], above=side)
        return int(above.sum() + below.sum())

    def distribution(self, index: int) -> Distribution:
        """Return the distribution of a grid."""
        packed = self.packed[index]
        first, second = (int(value) for value in self.sums[index])
        mine = slice(*np.searchsorted(self.fine.keys, (index * layout.BINS, (index + 1) * layout.BINS)))
        return Distribution(
            centre=float(packed["centre"]),
            step=1.0 / float(packed["steps_per_unit"]),
            filled=self.fine.keys[mine] - index * layout.BINS,
            filled_counts=self.fine.counts[mine].copy(),
            first=first,
            second=second,
            n=self.n,
            far=self.far[index].frozen(),
        )


@dataclass(frozen=True, eq=False)
class Distribution:
    """A histogram of unlimited range with exact integer moments.

    Bins are 1/512 of a standard deviation wide within 32 standard deviations of the centre, and 2**-13 of the value
    beyond.
    """

    centre: float  # value of the statistic at step 0
    step: float  # size of a fine step
    filled: NDArray[np.int64]  # fine bins with counts, ascending, shape (m,)
    filled_counts: NDArray[np.int64]  # shape (m,)
    first: int  # sum of the fine steps
    second: int  # sum of their squares
    n: int  # number of realisations
    far: FarCounts  # values outside the fine bins

    @property
    def counts(self) -> NDArray[np.int64]:
        """Counts of all fine bins, shape (BINS,)."""
        counts = np.zeros(layout.BINS, np.int64)
        counts[self.filled] = self.filled_counts
        return counts

    @cached_property
    def _moments(self) -> tuple[Fraction, Fraction]:
        """Exact mean and variance of all values."""
        total, squares = Fraction(self.far.first, 2**UNIT_BITS), Fraction(self.far.second, 2 ** (2 * UNIT_BITS))
        inside = self.n - self.far.n
        if inside:
            centre, step = Fraction(self.centre), Fraction(self.step)
            total += inside * centre + step * self.first
            squares += inside * centre**2 + 2 * centre * step * self.first + step**2 * self.second
        mean = total / self.n
        return mean, squares / self.n - mean**2

    def refuse_undefined(self, what: str = "the statistic") -> None:
        """Raise InputError if values are not finite."""
        if self.far.undefined:
            raise InputError(
                f"{what} is infinite or no number in {self.far.undefined} of {self.n} realisations",
                "finite values of float32",
                key="statistic",
                value=self.far.undefined,
            )

    @property
    def mean(self) -> float:
        """Mean of the statistic."""
        self.refuse_undefined()
        if self.far.n:
            return float(self._moments[0])
        return self.centre + self.step * (self.first / self.n)

    @property
    def std(self) -> float:
        """Standard deviation of the statistic."""
        self.refuse_undefined()
        if self.far.n:
            return math.sqrt(self._moments[1])
        # Integer arithmetic keeps the precision of a narrow distribution far from the centre.
        variance = (self.second * self.n - self.first**2) / self.n**2
        return self.step * float(np.sqrt(variance))

    def edge(self, index: int | NDArray[np.intp]) -> float | NDArray[np.float64]:
        """Return the lower edge of a fine bin."""
        steps = (np.asarray(index) - layout.BINS // 2) * 2.0**layout.FINE_BITS - 0.5
        edges: NDArray[np.float64] = self.centre + self.step * steps
        return edges if np.ndim(index) else float(edges)

    # Computed when needed: a detection of hundreds of flares has thousands of distributions.
    @property
    def bins(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Lower edges, upper edges and counts of all filled bins, ascending; each shape (m,)."""
        self.refuse_undefined()
        filled, counts = self.filled, self.filled_counts
        lower, upper = np.asarray(self.edge(filled)), np.asarray(self.edge(filled + 1))
        if not self.far.n:
            return lower, upper, counts
        ends = (
            (float(self.edge(FIRST_BIN)), float(self.edge(LAST_BIN + 1)))
            if math.isfinite(self.step)
            else (math.inf,) * 2
        )
        far_lower, far_upper = self.far.edges(*ends)
        place = int(np.count_nonzero(~is_above(self.far.keys)))
        return (
            np.insert(far_lower, place, lower),
            np.insert(far_upper, place, upper),
            np.insert(self.far.counts, place, counts),
        )

    def above(self, value: float) -> float:
        """Return the number of realisations at or above a value: exact at edges of bins, interpolated between."""
        lower, upper, counts = self.bins
        below = _below(counts)
        # The first bin with an upper edge above the value.
        index = int(np.searchsorted(upper, value, side="right"))
        if index == counts.size:
            return 0.0
        if value <= lower[index]:
            return float(below[-1] - below[index])
        share = (upper[index] - value) / (upper[index] - lower[index])
        return float(below[-1] - below[index + 1] + share * counts[index])

    def edge_with_at_most(self, n_above: int) -> float:
        """Return the lowest edge of a bin with at most `n_above` realisations at or above it, or minus infinity."""
        _, upper, counts = self.bins
        below = _below(counts)
        more = np.flatnonzero(below[-1] - below[:-1] > n_above)
        return float(upper[more[-1]]) if more.size else -math.inf

    def around(self, edge: float) -> tuple[int, int]:
        """Return the counts at or above the lower edge of a bin, and in the filled bin below that edge."""
        _, upper, counts = self.bins
        at = int(np.searchsorted(upper, edge, side="right"))
        return int(counts[at:].sum()), int(counts[at - 1]) if at else 0

    def quantile(self, probability: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return quantiles, interpolated linearly within bins."""
        lower, upper, counts = self.bins
        below = _below(counts)
        edges = np.column_stack([lower, upper]).ravel()
        cumulative = np.column_stack([below[:-1], below[1:]]).ravel() / self.n
        return np.asarray(np.interp(probability, cumulative, edges))

    def quantile_interval(self, probability: float) -> Interval:
        """Return a quantile with the 95 % interval of order statistics, rounded outwards to edges of bins."""
        if not 0.0 < probability < 1.0:
            raise InputError.of("probability", probability, "a probability between 0 and 1")
        # The number of values below the quantile is binomial, so it lies between these ranks with 95 %.
        low, high = central_counts(self.n, probability)
        lower, upper, counts = self.bins
        first, last = (int(np.searchsorted(counts.cumsum(), rank)) for rank in (low, high + 1))
        ends = float(lower[first]) if low else -np.inf, float(upper[last]) if high < self.n else np.inf
        return Interval(float(self.quantile(probability)), *ends)

    def histogram(self, bins: int = 200) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return edges, shape (m + 1,), and counts, shape (m,), in at most `bins` equal bins, for plots."""
        lower, upper, _ = self.bins
        if self.far.n:
            # No bin is narrower than the widest bin of the counts.
            span = upper[-1] - lower[0]
            edges = np.linspace(lower[0], upper[-1], max(min(bins, int(span / (upper - lower).max())), 1) + 1)
        else:
            low, high = int(self.filled[0]), int(self.filled[-1]) + 1
            group = -(-(high - low) // bins)
            edges = np.asarray(self.edge(np.arange(low, high + group, group)))
        above = [self.above(edge) for edge in edges]
        return edges, -np.diff(np.rint(above)).astype(np.int64)


def _below(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of realisations below each filled bin, and in total; shape (m + 1,)."""
    return np.concatenate([[0], np.cumsum(counts)])


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
        if not beyond.size:
            return
        merged = np.concatenate([self.values, values[beyond]])
        realisations = np.concatenate([self.realisations, first + beyond])
        self._keep(merged, realisations)

    def merge(self, values: NDArray[np.float32], realisations: NDArray[np.int64]) -> None:
        """Add the extreme values of other realisations, in any order."""
        self._keep(np.concatenate([self.values, values]), np.concatenate([self.realisations, realisations]))

    def _keep(self, values: NDArray[np.float32], realisations: NDArray[np.int64]) -> None:
        order = np.lexsort((realisations, -self._sign * values))[:TAIL_SAMPLES]
        self.values, self.realisations = values[order], realisations[order]
