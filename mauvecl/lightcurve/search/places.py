"""Where a flare is injected: its half-width and time in a stare, and the templates that can find it there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.survey import part_of

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]
Single = NDArray[np.float32]

#: A template counts as finding a flare if it finds this share of the S/N that the best one does.
OVERLAP = 0.3
#: Filters are multiples of this.
STEP = 2.0**-18
#: Half-widths by which templates may differ from a flare's, and templates before and after its peak that are tried.
WIDEST, BEFORE, AFTER = 10.0, 3.0, 5.0


@dataclass(frozen=True, eq=False)
class Place:
    """A flare's half-width and time in a stare, and the templates that can find it.

    Attributes
    ----------
    half_width_s, peak_s : float
    first : int
        Frame of the stare from which on templates reach.
    filters : ndarray of float32, shape (n_filter, n_frame)
        What the value of each template weighs frames with: times a row of the bank's directions, summed.
    mean : ndarray of float32, shape (n_frame,)
        The flare's mean in these frames for an amplitude of one.
    widths_s, peaks_s : ndarray, shape (n_filter,)
        The templates' own.
    counts : ndarray of bool, shape (n_temperature, n_filter)
        Those that count as finding it.
    """

    half_width_s: float
    peak_s: float
    first: int
    filters: Single
    mean: Single
    widths_s: Float
    peaks_s: Float
    counts: NDArray[np.bool_]

    @property
    def frames(self) -> slice:
        """Of the stare, to which templates reach."""
        return slice(self.first, self.first + self.mean.size)

    def within(self, first: int) -> Place:
        """The same in the part of the stare that begins with a frame."""
        return replace(self, first=self.first - first)


def place_of(survey: Survey, width_s: float, peak_s: float, response: Float) -> Place:
    """A flare and what can find it.

    Parameters
    ----------
    survey : Survey
    width_s, peak_s : float
        Of the flare.
    response : ndarray, shape (n_sum,)
        Mean sums of a flare of one amplitude in a frame.
    """
    bank = survey.bank
    stare, frame_s = survey.stare, bank.frame_s
    near = [w for w in bank.half_widths_s if width_s / WIDEST <= w <= width_s * WIDEST]
    if not near:
        near = [min(bank.half_widths_s, key=lambda w: abs(np.log(w / width_s)))]
    bank = replace(bank, half_widths_s=tuple(near))
    widest = bank.templates[-1]
    reach = (BEFORE * near[-1] + width_s, AFTER * max(width_s, near[-1]))
    before = reach[0] - widest.first * frame_s
    after = reach[1] + (widest.first + widest.time.size) * frame_s
    first, last = (int(k) for k in np.searchsorted(stare.start_s, [peak_s - before, peak_s + after]))
    part = slice(first, last)
    curves = None if survey.curves is None else survey.curves[:, part]
    search = Search(bank, part_of(stare, part), curves, survey.variance[part])
    start = stare.start_s[part]
    edges = np.column_stack([start, start + frame_s])
    mean = stare.light[part] * bank.shape.mean_over(edges, peak_s, width_s)
    chosen: list[tuple[Any, int, float, Float]] = []
    sums = (mean[:, None] * response).astype(np.float32)
    for row, rho in search.values(sums[None]):
        times = (search.stare.numbers[0] + row.peaks + row.template.phases[row.phase]) * frame_s
        inside = (times >= peak_s - reach[0]) & (times <= peak_s + reach[1])
        values = np.where(inside, rho[0], -np.inf)
        chosen += [(row, int(k), float(times[k]), values[:, k]) for k in np.flatnonzero(values.max(axis=0) > 0)]
    values = np.array([v for *_, v in chosen]).reshape(len(chosen), len(bank.directions))
    counts = values >= OVERLAP * values.max() if len(chosen) else values > 0
    kept = np.flatnonzero(counts.any(axis=1))
    filters = np.array([search.in_time(*chosen[k][:2]) for k in kept]).reshape(len(kept), start.size)
    filters = (np.rint(filters / STEP) * STEP).astype(np.float32)
    used = np.flatnonzero(filters.any(axis=0))
    ends = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
    return Place(
        width_s,
        peak_s,
        first + ends.start,
        np.ascontiguousarray(filters[:, ends]),
        mean[ends].astype(np.float32),
        np.array([chosen[k][0].template.half_width_s for k in kept]),
        np.array([chosen[k][2] for k in kept]),
        counts[kept].T,
    )
