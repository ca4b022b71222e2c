"""Alias tables of Poisson counts, exact in integers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise.layout import WORD_BITS

#: Largest mean of a table, at which 17 index bits leave 15 bits for acceptance.
LARGEST_MEAN = 1e8

#: From this mean on, counts come from an expansion of the inverse distribution function (kernels/poisson.cl.mako). Its
#: difference from the exact distribution is undetectable in 1e13 draws.
SMALLEST_EXPANDED = 1000.0


@dataclass(frozen=True)
class AliasTable:
    """Distribution over integers as 2**bits columns of one packed word each."""

    low: int  # count of column 0
    bits: int  # base-2 logarithm of the number of columns
    entries: NDArray[np.uint32]  # alias << (32 - bits) | threshold, shape (2**bits,)

    def words_per_column(self) -> NDArray[np.int64]:
        """Return the number of the 2**32 words that give each column: its exact probability."""
        shift = WORD_BITS - self.bits
        threshold = self.entries.astype(np.int64) & ((1 << shift) - 1)
        alias = self.entries.astype(np.int64) >> shift
        words = threshold.copy()
        np.add.at(words, alias, (1 << shift) - threshold)
        return np.asarray(words)


def alias_table(mean: float) -> AliasTable:
    """Compute the alias table of a Poisson distribution with a mean of 0 to 1e8, to 2**-32 in each probability.

    Walker's method (1977, doi 10.1145/355744.355749) is applied to integers: the probabilities are rounded to multiples
    of 2**-32 that sum to one, which the table then represents exactly.
    """
    if not 0.0 <= mean <= LARGEST_MEAN:
        raise ValueError(f"Poisson mean = {mean!r}, expected 0 to {LARGEST_MEAN:g}")
    if mean == 0.0:
        return AliasTable(0, 1, _pack(np.array([2**WORD_BITS, 0]), 1))
    # All counts beyond this range have together less than half a word.
    reach = 6.5 * np.sqrt(mean) + 16.0
    low = max(int(mean - reach), 0)
    high = int(mean + reach + 0.5 * reach**2 / (mean + 1.0))
    counts = np.arange(low, high + 1)
    p = np.exp(special.xlogy(counts, mean) - mean - special.gammaln(counts + 1.0))
    inside = np.flatnonzero((np.cumsum(p) >= 2.0**-33) & (np.cumsum(p[::-1])[::-1] >= 2.0**-33))
    return table_of(p[inside[0] : inside[-1] + 1], low + int(inside[0]))


def table_of(probability: NDArray[np.float64], low: int = 0) -> AliasTable:
    """Compute the alias table of a distribution over the integers from `low` on.

    `probability` has up to 2**24 values, which need not sum to one.
    """
    bits = max(int(probability.size - 1).bit_length(), 1)
    padded = np.zeros(1 << bits)
    padded[: probability.size] = probability
    return AliasTable(low, bits, _pack(_whole_words(padded), bits))


def _whole_words(probability: NDArray[np.float64]) -> NDArray[np.int64]:
    """Convert probabilities to integers that sum to 2**32, by the method of largest remainders."""
    exact = probability / probability.sum() * 2.0**WORD_BITS
    words: NDArray[np.int64] = np.floor(exact).astype(np.int64)
    missing = int(2**WORD_BITS - words.sum())
    largest = np.argsort(words - exact, kind="stable")[:missing]
    words[largest] += 1
    return words


def _pack(words: NDArray[np.int64], bits: int) -> NDArray[np.uint32]:
    shift = WORD_BITS - bits
    share = 1 << shift
    left: list[int] = words.tolist()
    # A full column is its own alias, with threshold 0.
    entries = [column << shift for column in range(1 << bits)]
    small = [c for c, n in enumerate(left) if n < share]
    large = [c for c, n in enumerate(left) if n > share]
    while small:
        poor, rich = small.pop(), large[-1]
        entries[poor] = rich << shift | left[poor]
        left[rich] -= share - left[poor]
        if left[rich] <= share:
            large.pop()
            if left[rich] < share:
                small.append(rich)
    return np.array(entries, dtype=np.uint32)


def table_set(means: Iterable[float], tables: list[AliasTable]) -> tuple[list[AliasTable], list[int]]:
    """Append a table for each distinct mean.

    Parameters
    ----------
    tables : list of AliasTable
        Tables that are contiguous on the device; new ones are appended.

    Returns
    -------
    each : list of AliasTable
        Table of each mean.
    starts : list of int
        Start of each mean's table.
    """
    size = sum(table.entries.size for table in tables)
    distinct: dict[float, tuple[AliasTable, int]] = {}
    for mean in (means := list(means)):
        if mean not in distinct:
            table = alias_table(mean)
            distinct[mean] = (table, size)
            tables.append(table)
            size += table.entries.size
    return [distinct[mean][0] for mean in means], [distinct[mean][1] for mean in means]
