"""Completeness of injected flares by size and half-width, with intervals, and size limits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class InjectedCompleteness:
    """Detection of injected flares."""

    half_widths_s: tuple[float, ...]
    sizes: Float  # shape (n_size,)
    amplitudes: Float  # shape (n_half_width, n_size)
    critical: Float  # smallest size that is detected in each draw, shape (n_half_width, n_position, n_draw)

    @property
    def count(self) -> int:
        """Injections per cell."""
        return int(self.critical[0].size)

    @cached_property
    def _cells(self) -> tuple[Float, Float, Float]:
        cells = np.empty((3, len(self.half_widths_s), self.sizes.size))
        for d, critical in enumerate(self.critical):
            for s, size in enumerate(self.sizes):
                p = self._completeness(critical, float(size))
                cells[:, d, s] = p.value, p.low, p.high
        return cells[0], cells[1], cells[2]

    @property
    def completeness(self) -> Float:
        """Detected fraction, shape (n_half_width, n_size)."""
        return self._cells[0]

    @property
    def completeness_low(self) -> Float:
        """Lower limits of the 95 % intervals of `completeness`."""
        return self._cells[1]

    @property
    def completeness_high(self) -> Float:
        """Upper limits of the 95 % intervals of `completeness`."""
        return self._cells[2]

    def _completeness(self, critical: Float, size: float) -> Interval:
        """Return the detected fraction at a size, with an interval for the effective number of independent draws."""
        each = np.mean(critical <= size, axis=1)
        fraction, trials = float(each.mean()), self._independent(each, critical.size)
        around = clopper_pearson(round(fraction * trials), trials)
        return Interval(fraction, min(around.low, fraction), max(around.high, fraction))

    @staticmethod
    def _independent(each: Float, count: int) -> int:
        """Return the effective number of independent draws, reduced if positions differ (Kish's design effect)."""
        fraction = float(each.mean())
        binomial = fraction * (1 - fraction) / count
        if not binomial > 0 or each.size < 2:
            return count
        return max(1, int(count * min(1.0, binomial / max(float(each.var(ddof=1)) / each.size, 1e-300))))

    def limit(self, power: float, half_width: int | None) -> Interval:
        """Return the size at which the fraction `power` is detected, with a 95 % interval; infinite if never reached.

        Parameters
        ----------
        half_width : int, optional
            Index of a half-width; by default the average over all.
        """
        critical = self.critical if half_width is None else self.critical[half_width : half_width + 1]
        by_position = np.moveaxis(critical, 1, 0).reshape(critical.shape[1], -1)
        ordered = np.sort(by_position, axis=None)
        value = float(ordered[min(int(np.ceil(power * ordered.size)), ordered.size) - 1])
        trials = self._independent(np.mean(by_position <= value, axis=1), ordered.size)
        # Half-widths share draws and do not add independent ones.
        trials = max(1, min(trials, self.count))
        ranks = [int(k / trials * ordered.size) for k in central_counts(trials, power)]
        low, high = (float(ordered[min(max(k, 0), ordered.size - 1)]) for k in ranks)
        return Interval(value, min(low, value), max(high, value))

    def never(self, half_width: int | None) -> float:
        """Return the fraction that no template can detect because of gaps."""
        critical = self.critical if half_width is None else self.critical[half_width]
        return float(np.mean(np.isinf(critical)))
