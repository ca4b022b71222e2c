"""Injection sites: half-width and time of a flare in a stare, and the templates that can detect it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.survey import select_frames

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.lightcurve.search.bank import Bank
    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]
Single = NDArray[np.float32]

#: Smallest share of the best template's S/N for which a template counts as a detection.
OVERLAP = 0.3
#: Filters are multiples of this, so that sums are exact.
STEP = 2.0**-18
#: Largest ratio of half-widths of template and flare, and half-widths before and after the peak with templates.
WIDEST, BEFORE, AFTER = 10.0, 3.0, 5.0
#: Number of frames up to which the whole stare is searched; its search exists, and a part would hardly be smaller.
WHOLE = 20_000


@dataclass(frozen=True, eq=False)
class InjectionSite:
    """Half-width and time of a flare in a stare, and the templates that can detect it."""

    half_width_s: float
    peak_s: float
    first: int  # first frame of the stare that a template covers
    filters: Single  # weights of frames in the statistic of each template, shape (n_filter, n_frame)
    mean: Single  # mean of the flare in these frames at unit amplitude, shape (n_frame,)
    widths_s: Float  # half-widths of the templates, shape (n_filter,)
    peaks_s: Float  # peak times of the templates, shape (n_filter,)
    counts: NDArray[np.bool_]  # templates that count as a detection, shape (n_temperature, n_filter)

    @property
    def frames(self) -> slice:
        """Frames of the stare that templates cover."""
        return slice(self.first, self.first + self.mean.size)

    @cached_property
    def weights(self) -> Float:
        """Transposed filters in double precision, shape (n_frame, n_filter)."""
        return np.ascontiguousarray(self.filters.T, np.float64)

    def within(self, first: int) -> InjectionSite:
        """Return the site in the part of the stare that starts with frame `first`."""
        return replace(self, first=self.first - first)


def sites_of(survey: Survey, widths_s: Sequence[float], peak_s: float, response: Float) -> tuple[InjectionSite, ...]:
    """Return the sites of flares of several half-widths that peak at one time.

    Parameters
    ----------
    widths_s : sequence of float
        Half-widths of the flares.
    response : ndarray, shape (n_sum,)
        Mean sums of a frame for a flare of unit amplitude.
    """
    bank = survey.bank
    reaches = [_Reach.of(bank, width, peak_s) for width in widths_s]
    search, first = _search_near(survey, reaches)
    stare = search.stare
    edges = np.column_stack([stare.start_s, stare.start_s + bank.frame_s])
    means = np.array([stare.light * bank.shape.mean_over(edges, peak_s, width) for width in widths_s])
    # A flare's sums are the product of its shape and the response, so that one correlation serves all temperatures.
    along = (bank.directions @ response)[:, None]
    seen: list[list[_NearbyTemplates]] = [[] for _ in reaches]
    for number, (row, correlated) in enumerate(search.correlations(means[:, :, None])):
        times = (stare.numbers[0] + row.peaks + row.template.phases[row.phase]) * bank.frame_s
        for found, reach, value in zip(seen, reaches, correlated[:, 0], strict=True):
            if row.template.half_width_s in reach.half_widths_s:
                inside = (times >= reach.first_s) & (times <= reach.last_s) & (row.per_amplitude > 0)
                onsets = np.flatnonzero(inside)
                onsets = onsets[(along * value[onsets]).max(axis=0, initial=0) > 0]
                found.append(_NearbyTemplates(number, onsets, times[onsets], along * value[onsets]))
    for found in seen:
        largest = max((float(one.values.max(initial=0)) for one in found), default=0.0)
        found[:] = [one.above(OVERLAP * largest) for one in found]
    filters = _filters(search, [one for found in seen for one in found])
    return tuple(
        _site(search, first, width, peak_s, mean, found, filters)
        for width, mean, found in zip(widths_s, means, seen, strict=True)
    )


@dataclass(frozen=True)
class _Reach:
    """Templates that are tried for a flare, and the frames that they cover."""

    half_widths_s: tuple[float, ...]
    first_s: float  # earliest and latest peak of a template
    last_s: float
    begin_s: float  # start and end of the frames
    end_s: float

    @classmethod
    def of(cls, bank: Bank, width_s: float, peak_s: float) -> _Reach:
        near = [w for w in bank.half_widths_s if width_s / WIDEST <= w <= width_s * WIDEST]
        if not near:
            near = [min(bank.half_widths_s, key=lambda w: abs(np.log(w / width_s)))]
        first, last = peak_s - (BEFORE * near[-1] + width_s), peak_s + AFTER * max(width_s, near[-1])
        lead, tail = (frames * bank.frame_s for frames in bank.window(near[-1]))
        return cls(tuple(near), first, last, first - lead, last + tail + bank.frame_s)


@dataclass(frozen=True, eq=False)
class _NearbyTemplates:
    """Templates of one row of a search near a flare."""

    row: int
    onsets: NDArray[np.int64]  # shape (n,)
    times_s: Float  # peak times, shape (n,)
    values: NDArray[Any]  # values, or whether they exceed a limit, shape (n_temperature, n)

    def above(self, least: float) -> _NearbyTemplates:
        """Return the templates that reach a value at any temperature, with `values` true where they reach it."""
        counts = self.values >= least
        kept = counts.any(axis=0)
        return _NearbyTemplates(self.row, self.onsets[kept], self.times_s[kept], counts[:, kept])


def _search_near(survey: Survey, reaches: Sequence[_Reach]) -> tuple[Search, int]:
    """Return a search of the frames that templates cover, and the first of these frames."""
    stare = survey.stare
    if stare.n_frames <= WHOLE:
        return survey.search, 0
    ends = min(reach.begin_s for reach in reaches), max(reach.end_s for reach in reaches)
    part = slice(*(int(k) for k in np.searchsorted(stare.start_s, ends)))
    near = {width for reach in reaches for width in reach.half_widths_s}
    bank = replace(survey.bank, half_widths_s=tuple(sorted(near)))
    curves = None if survey.curves is None else survey.curves[:, part]
    return Search(bank, select_frames(stare, part), curves, survey.variance[part]), part.start


def _filters(search: Search, seen: Sequence[_NearbyTemplates]) -> dict[int, tuple[NDArray[np.int64], Single]]:
    """Return for each row the onsets of templates near any flare, ascending, and their filters."""
    filters = {}
    for number in sorted({one.row for one in seen}):
        onsets = np.unique(np.concatenate([one.onsets for one in seen if one.row == number]))
        in_time = search.in_time(search.grid[number], onsets)
        filters[number] = onsets, (np.rint(in_time / STEP) * STEP).astype(np.float32)
    return filters


def _site(
    search: Search, first: int, width_s: float, peak_s: float, mean: Float, seen: Sequence[_NearbyTemplates],
    filters: dict[int, tuple[NDArray[np.int64], Single]],
) -> InjectionSite:  # fmt: skip
    none = np.zeros((0, mean.size), np.float32)
    own = [filters[one.row][1][np.searchsorted(filters[one.row][0], one.onsets)] for one in seen]
    weights = np.concatenate([none, *own])
    used = np.flatnonzero(weights.any(axis=0))
    ends = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
    widths = [np.full(one.onsets.size, search.grid[one.row].template.half_width_s) for one in seen]
    no_counts = np.zeros((len(search.bank.directions), 0), np.bool_)
    return InjectionSite(
        width_s,
        peak_s,
        first + ends.start,
        np.ascontiguousarray(weights[:, ends]),
        mean[ends].astype(np.float32),
        np.concatenate([np.zeros(0), *widths]),
        np.concatenate([np.zeros(0), *(one.times_s for one in seen)]),
        np.concatenate([no_counts, *(one.values for one in seen)], axis=1),
    )
