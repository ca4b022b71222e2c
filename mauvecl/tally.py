"""Histograms and moments made of whole numbers, so that neither order nor tiling can change them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl import layout
from mauvecl.host.errors import InputError
from mauvecl.statistics import Interval, central_counts


@dataclass(frozen=True)
class Grid:
    """Where one histogram lies: the channel it reads, its centre, and the spread it is scaled to."""

    channel: int
    centre: float
    sigma: float

    @staticmethod
    def pack(grids: Sequence[Grid]) -> NDArray[np.void]:
        """The grids as the device reads them, shape (n_grid,)."""
        packed = np.zeros(len(grids), layout.GRID)
        packed["channel"] = [grid.channel for grid in grids]
        packed["centre"] = [grid.centre for grid in grids]
        packed["steps_per_unit"] = [layout.STEPS_PER_SIGMA / grid.sigma for grid in grids]
        return packed


class Tally:
    """Counts and sums of many channels, added up tile by tile.

    Parameters
    ----------
    grids : sequence of Grid
    """

    def __init__(self, grids: Sequence[Grid]) -> None:
        self.grids = tuple(grids)
        self.counts = np.zeros((len(grids), layout.BINS), np.int64)
        # Python integers: squares outgrow 64 bits in long runs.
        self.sums = np.zeros((len(grids), 2), object)
        self.n = 0

    def add(self, histogram: NDArray[np.integer], sums: NDArray[np.generic], n: int) -> None:
        """Add what one or more tiles counted.

        Parameters
        ----------
        histogram : ndarray of uint32 or int64, shape (n_grid, BINS)
        sums : ndarray of int64 or Python integers, shape (n_grid, 2)
            Sums of fine steps and of their squares.
        n : int
            Realisations counted.
        """
        self.counts += histogram
        self.sums += sums.astype(object)
        self.n += n

    def distribution(self, index: int) -> Distribution:
        """The distribution of one grid."""
        packed = Grid.pack([self.grids[index]])[0]
        first, second = (int(value) for value in self.sums[index])
        return Distribution(
            centre=float(packed["centre"]),
            step=1.0 / float(packed["steps_per_unit"]),
            counts=self.counts[index].copy(),
            first=first,
            second=second,
            n=self.n,
        )


@dataclass(frozen=True, eq=False)
class Distribution:
    """A histogram with exact integer moments.

    Attributes
    ----------
    centre, step : float
        The statistic's value at step 0, and the size of a fine step.
    counts : ndarray of int64, shape (bins,)
        The first and last bins also hold everything beyond them.
    first, second : int
        Sums of fine steps and of their squares.
    n : int
        Realisations.
    """

    centre: float
    step: float
    counts: NDArray[np.int64]
    first: int
    second: int
    n: int

    @property
    def mean(self) -> float:
        """Mean of the statistic."""
        return self.centre + self.step * (self.first / self.n)

    @property
    def std(self) -> float:
        """Standard deviation of the statistic."""
        # In whole numbers, so that a narrow distribution far from the centre keeps its digits.
        variance = (self.second * self.n - self.first**2) / self.n**2
        return self.step * float(np.sqrt(variance))

    @property
    def beyond(self) -> int:
        """Realisations in the first and last bins, whose values are only known to lie there or further out."""
        return int(self.counts[0] + self.counts[-1])

    def edge(self, index: int | NDArray[np.intp]) -> float | NDArray[np.float64]:
        """Lower edge of a bin."""
        steps = (np.asarray(index) - self.counts.size // 2) * 2.0**layout.FINE_BITS - 0.5
        edges: NDArray[np.float64] = self.centre + self.step * steps
        return edges if np.ndim(index) else float(edges)

    def above(self, index: int) -> int:
        """Realisations at or above the lower edge of a bin."""
        return int(self.counts[index:].sum())

    def first_bin_with_at_most(self, n_above: int) -> int:
        """The lowest bin whose lower edge has at most `n_above` realisations at or above it."""
        above = self.counts[::-1].cumsum()[::-1]
        below = np.flatnonzero(above <= n_above)
        return int(below[0]) if below.size else self.counts.size

    def quantile(self, probability: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Quantiles, linear within a bin; exact to a bin's width."""
        cumulative = np.concatenate([[0], self.counts.cumsum()]) / self.n
        filled = np.flatnonzero(self.counts)
        span = np.arange(filled[0], filled[-1] + 2)
        edges = np.asarray(self.edge(span))
        return np.asarray(np.interp(probability, cumulative[span], edges))

    def quantile_interval(self, probability: float) -> Interval:
        """One quantile with the 95 % interval of order statistics, its ends rounded outwards to edges of bins."""
        if not 0.0 < probability < 1.0:
            raise InputError(f"quantile at {probability!r}, expected a probability between 0 and 1")
        # As many values lie below the quantile as a binomial variable counts: between these ranks with 95 %.
        low, high = central_counts(self.n, probability)
        cumulative = self.counts.cumsum()
        first, last = (int(np.searchsorted(cumulative, rank)) for rank in (low, high + 1))
        ends = (
            float(self.edge(first)) if low else -np.inf,
            float(self.edge(last + 1)) if high < self.n else np.inf,
        )
        return Interval(float(self.quantile(probability)), *ends)

    def histogram(self, bins: int = 200) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Edges and counts over the filled range, in at most `bins` equal bins, for pictures.

        Returns
        -------
        edges : ndarray, shape (m + 1,)
        counts : ndarray of int64, shape (m,)
        """
        filled = np.flatnonzero(self.counts)
        low, high = int(filled[0]), int(filled[-1]) + 1
        group = -(-(high - low) // bins)
        high = low + -(-(high - low) // group) * group
        counts = np.zeros(high - low, np.int64)
        part = self.counts[low:high]
        counts[: part.size] = part
        edges = np.asarray(self.edge(np.arange(low, high + 1, group)))
        return edges, counts.reshape(-1, group).sum(axis=1)


#: Values of each tail that are kept as they are, with their realisations.
TAIL_SAMPLES = 1000


class TailSamples:
    """The most extreme values of a channel and the realisations they came from.

    Parameters
    ----------
    largest : bool
        The largest values, or the smallest.
    """

    def __init__(self, *, largest: bool) -> None:
        self._sign = np.float32(1.0 if largest else -1.0)
        self.values = np.empty(0, np.float32)
        self.realisations = np.empty(0, np.int64)

    def add(self, values: NDArray[np.float32], first: int) -> None:
        """Look through the values of realisations `first` and on; of equal ones the earlier realisation stays."""
        signed = self._sign * values
        if self.values.size == TAIL_SAMPLES:
            found = np.flatnonzero(signed > self._sign * self.values[-1])
        elif values.size > TAIL_SAMPLES:
            # None below the thousandth can be kept, and sorting few is fast.
            found = np.flatnonzero(signed >= np.partition(signed, -TAIL_SAMPLES)[-TAIL_SAMPLES])
        else:
            found = np.arange(values.size)
        if not found.size:
            return
        merged = np.concatenate([self.values, values[found]])
        realisations = np.concatenate([self.realisations, first + found])
        self._keep(merged, realisations)

    def merge(self, values: NDArray[np.float32], realisations: NDArray[np.int64]) -> None:
        """Add what was found in other realisations, in any order."""
        self._keep(np.concatenate([self.values, values]), np.concatenate([self.realisations, realisations]))

    def _keep(self, values: NDArray[np.float32], realisations: NDArray[np.int64]) -> None:
        order = np.lexsort((realisations, -self._sign * values))[:TAIL_SAMPLES]
        self.values, self.realisations = values[order], realisations[order]
