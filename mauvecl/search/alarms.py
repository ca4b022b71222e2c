"""Iterative detection and fitting of the flares in one stare.

Each pass searches the residuals of the fits. A template raises an alarm if its value exceeds the threshold by more than
the share of the fitted flux that a wrong shape may leave in the residuals. Flares that overlap are fitted together
(`survey`) from several starting points, and each must improve chi-squared by the square of the threshold. The
passes end when there are no more alarms.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arrays import Float, true_runs
from mauvecl.search.search import LEAD, TAIL
from mauvecl.search.survey import AMPLITUDE, KELVIN, PEAK, WIDTH, FittedFlares, ProfiledQuantity, SummedStare

if TYPE_CHECKING:
    from mauvecl.search.search import Row
    from mauvecl.search.survey import BlendFit, Block, Factor, Survey


#: Values of a fit without a measurement.
UNMEASURED = FittedFlares(**{field.name: np.full(1, np.nan) for field in fields(FittedFlares)})
#: Share of a flare's S/N that may remain in nearby residuals without an alarm, because its shape or temperature differs
#: from that of the fit.
LEFT_BEHIND = 0.05
#: The same as a share of a template's response to the fitted flux, when a block is tested for a further flare.
LEFT_UNSEEN = 0.15
#: Largest number of flares per fit; longer chains of overlapping flares are fitted in parts, alternately.
MAX_FLARES_PER_FIT = 6
#: Iterations over parts and their neighbours after each pass.
TURNS = 2
#: Starting points for a further flare in each block.
SPLITS = 3
#: Distance from a bound, as a share of the parameter's range, at which a parameter counts as at the bound.
AT_BOUND = 1e-3
#: Largest S/N for which intervals are from the profile likelihood; above it, intervals from the curvature agree.
MAX_PROFILED_SNR = 40.0
#: The rise of chi-squared that 68 % of the true values stay within is 1 + this / (S/N of the fit)^2: a correction of
#: the likelihood ratio as Bartlett's (1937, doi 10.1098/rspa.1937.0109), counted by `bench/blends.py`.
BARTLETT = 14.0
#: Quantities with intervals by their names in `FittedFlares`; the duration is that of a shape of unit area.
QUANTITIES = {
    "peak_s": ProfiledQuantity(PEAK),
    "amplitude": ProfiledQuantity(AMPLITUDE),
    "half_width_s": ProfiledQuantity(WIDTH),
    "temperature_k": ProfiledQuantity(KELVIN),
    "equivalent_duration_s": ProfiledQuantity(AMPLITUDE, lambda _: (0.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Alarm:
    """A detected flare."""

    rho: float  # statistic at detection; root of the fall of chi-squared if a fitted flare was split in two
    recovered: FittedFlares  # fitted values, arrays of shape (1,); NaN if not measured
    intervals: dict[str, tuple[float, float]]  # 68 % intervals of `QUANTITIES` and "energy"; NaN if not available
    note: str  # explanation of an unusual fit
    block: int  # number of the block in which it was fitted, from 1
    flares: int  # number of flares in the block
    chi2: float  # goodness of fit of the block
    dof: int
    p_value: float

    @property
    def measured(self) -> bool:
        """True if the fit has values."""
        return bool(np.isfinite(self.recovered.peak_s[0]))


@dataclass(eq=False)
class Candidate:
    """A flare during the search."""

    theta: Float  # fitted parameters
    rho: float  # statistic at detection
    template: tuple[float, float]  # peak time and half-width of the template, s


def _thetas(candidates: Iterable[Candidate]) -> Float:
    """Return the parameters of flares, shape (n_flare, 4)."""
    return np.array([candidate.theta for candidate in candidates]).reshape(-1, 4)


def alarms(survey: Survey, sums: NDArray[Any], threshold: float, energy: Factor | None = None) -> list[Alarm]:
    """Detect and fit all flares of a stare in its simulated sums, (n_frame, n_sum), largest statistic first.

    `energy` returns the logarithm of the energy per second of equivalent duration, and its derivative, for the
    logarithm of the temperature.
    """
    net = np.asarray(survey.frames.net(sums[None])[0], np.float64)
    search, found = _StareSearch(SummedStare(survey, net), threshold), []
    # Until there are no alarms, and no block improves with a further flare.
    while new := search.searched() or search.split():
        search.found += new
        changed = set(new)
        for _ in range(TURNS):
            changed = search.fitted(changed)
    for number, group in enumerate(search.blocks(), 1):
        theta = _thetas(group)
        block = search.sums.block(theta, search.others(group))
        best = block.fit(theta)
        for j, candidate in enumerate(group):
            measured = _measured(block, best, j, energy)
            found.append(Alarm(candidate.rho, *measured, number, len(group), best.chi2, best.dof, best.p_value))
    return sorted(found, key=lambda alarm: -alarm.rho)


@dataclass(eq=False)
class _StareSearch:
    """State of the search of one stare."""

    sums: SummedStare
    threshold: float
    found: list[Candidate] = field(default_factory=list)
    refused: list[tuple[float, float]] = field(default_factory=list)
    complete: set[tuple[float, ...]] = field(default_factory=set)  # blocks that no further flare improves

    def blocks(self) -> list[list[Candidate]]:
        """Group overlapping flares in order of time, with at most `MAX_FLARES_PER_FIT` flares per group."""
        spans = sorted(((*self.sums.overlap(candidate.theta), k) for k, candidate in enumerate(self.found)))
        blocks: list[list[Candidate]] = []
        reach = -np.inf
        for first, last, k in spans:
            if first > reach:
                blocks.append([])
            blocks[-1].append(self.found[k])
            reach = max(reach, last)
        n = MAX_FLARES_PER_FIT
        return [block[k : k + n] for block in blocks for k in range(0, len(block), n)]

    def others(self, group: Collection[Candidate]) -> Float:
        """Return the parameters of the found flares outside of a group."""
        return _thetas(candidate for candidate in self.found if candidate not in group)

    def _values(self, near_share: float = 0.0) -> Iterator[tuple[Float, Float, Callable[[int], Candidate]]]:
        """Yield per row the largest excess over fit residuals and the peak time of each onset, and its candidate."""
        theta, (low, high) = _thetas(self.found), self.sums.bounds
        light = self.sums.light(theta)
        # Flares at the bounds of the fit may remain in the residuals entirely.
        at_end = np.minimum(theta - low, high - theta) <= AT_BOUND * (high - low)
        wrong = self.sums.light(theta[at_end[:, [PEAK, WIDTH]].any(axis=1)])
        residuals = np.stack([self._evened(self.sums.net - light, light), LEFT_UNSEEN * light + wrong])
        search = self.sums.survey.search
        for row, rho in search.values(residuals.astype(np.float32)):
            peaks = search.peaks_s(row)
            rests = np.abs(np.where(np.isfinite(rho[1]), rho[1], 0.0))
            # Statistics of flares within reach of the templates.
            near = np.zeros(peaks.shape)
            for candidate in self.found if near_share else ():
                reach = TAIL * np.exp(candidate.theta[WIDTH]) + LEAD * row.template.half_width_s
                near += np.where(np.abs(peaks - candidate.theta[PEAK]) < reach, candidate.rho, 0.0)
            excess = rho[0] - np.maximum(rests, near_share * near)
            yield excess.max(axis=0), peaks, partial(self._candidate, row, rho[0], excess.argmax(axis=0))

    def _candidate(self, row: Row, values: Float, directions: NDArray[np.int64], onset: int) -> Candidate:
        """Return a candidate with the parameters of the best template at an onset."""
        templates, width, direction = self.sums.survey.templates, row.template.half_width_s, int(directions[onset])
        rho, peak = float(values[direction, onset]), float(self.sums.survey.search.peaks_s(row)[onset])
        size = float(np.linalg.norm(templates.directions[templates.chosen[direction]]))
        amplitude = max(rho / float(row.per_amplitude[onset]), 1e-3) / size
        kelvin = templates.temperatures_k[templates.chosen[direction]]
        theta = np.array([np.log(amplitude), peak, np.log(width), np.log(kelvin)])
        return Candidate(theta, rho, (peak, width))

    def searched(self) -> list[Candidate]:
        """Return new candidates from the residuals, at most one within the window of another."""
        sums, bank, candidates = self.sums, self.sums.survey.bank, list[tuple[float, Candidate]]()
        for excess, _, candidate_at in self._values(LEFT_BEHIND):
            candidates += [(float(excess[k]), candidate_at(int(k))) for k in np.flatnonzero(excess >= self.threshold)]
        candidates.sort(key=lambda pair: -pair[0])
        # An alarm near a larger one may be caused by it and waits for the next pass, as do the alarms near it.
        waiting = np.zeros(len(sums.net), np.bool_)
        new = []
        for _, candidate in candidates:
            peak, width = candidate.template
            if self._was_refused(peak, width):
                continue
            lead, tail = (frames * bank.frame_s for frames in bank.window(width))
            window = slice(*sums.overlapping(peak - lead, peak + tail))
            waits = waiting[window].any()
            waiting[window] = True
            if not waits:
                new.append(candidate)
        return new

    def split(self) -> list[Candidate]:
        """Return a further flare that improves the fit of a block as much as an alarm, if there is one."""
        blocks = [block for block in self.blocks() if self._key(block) not in self.complete]
        if not blocks:
            return []
        overlaps = [[self.sums.overlap(candidate.theta) for candidate in block] for block in blocks]
        spans = [(min(a for a, _ in ends), max(b for _, b in ends)) for ends in overlaps]
        best: list[list[tuple[float, Candidate]]] = [[] for _ in blocks]
        for excess, peaks, candidate_at in self._values():
            for several, (first, last) in zip(best, spans, strict=True):
                inside = np.flatnonzero((peaks >= first) & (peaks <= last) & np.isfinite(excess))
                if inside.size:
                    k = int(inside[np.argmax(excess[inside])])
                    several.append((float(excess[k]), candidate_at(k)))
        for block, several in zip(blocks, best, strict=True):
            several.sort(key=lambda pair: -pair[0])
            for _, candidate in several[:SPLITS]:
                if not self._was_refused(*candidate.template) and self._improves(block, candidate):
                    return [candidate]
            self.complete.add(self._key(block))
        return []

    def _improves(self, block: list[Candidate], candidate: Candidate) -> bool:
        """Return whether a further flare improves a block significantly, and update the flares to the better fit."""
        before, with_it = _thetas(block), [*block, candidate]
        rows = self.sums.block(_thetas(with_it), self.others(block))
        best = self._best(rows, with_it, [candidate])
        # The other flares alone may fit better from their new parameters.
        alone = min((rows.fit(before), rows.without(best, len(block))), key=lambda fit: fit.chi2)
        fall = alone.chi2 - best.chi2
        # The other flares may have another shape, which changes their overlap with this one.
        light, other_light = rows.model(best.theta[-1:])[0], rows.model(best.theta[:-1])[0]
        response = abs(float(light @ other_light)) / max(float(np.linalg.norm(light)), 1e-300)
        allowed = max(LEFT_UNSEEN * response, LEFT_BEHIND * max(flare.rho for flare in block))
        improves = bool(fall >= (self.threshold + allowed) ** 2)
        if improves:
            candidate.rho = float(np.sqrt(fall))
        flares, better = (with_it, best) if improves else (block, alone)
        for flare, theta in zip(flares, better.theta, strict=True):
            flare.theta = theta
        return improves

    @staticmethod
    def _key(block: list[Candidate]) -> tuple[float, ...]:
        return tuple(np.round(_thetas(block), 2).ravel().tolist())

    def _was_refused(self, peak: float, width: float) -> bool:
        return any(
            abs(peak - refused_peak) <= max(width, refused_width) and 1 / 3 < width / refused_width < 3
            for refused_peak, refused_width in self.refused
        )

    def _evened(self, residuals: Float, light: Float) -> Float:
        """Scale residuals under flares down to the noise of frames without a flare."""
        if not self.found:
            return residuals
        noise = self.sums.noise(_thetas(self.found), light)
        base = self.sums.survey.covariance
        excess = np.einsum("tkk->t", np.linalg.solve(base, noise)) / base.shape[1]
        loud, evened = excess > 1.01, residuals.copy()
        # The baseline under a flare is the median of the surrounding frames without excess noise.
        times = self.sums.edges[:, 0]
        for first, end in true_runs(loud):
            rows, middle = slice(first, end), times[(first + end) // 2]
            near = ~loud & (np.abs(times - middle) < self.sums.survey.bank.baseline.window_s / 2 + 1)
            level = np.median(residuals[near], axis=0) if near.any() else np.zeros(residuals.shape[1])
            evened[rows] = level + (residuals[rows] - level) / np.sqrt(excess[rows])[:, None]
        return evened

    def fitted(self, changed: set[Candidate]) -> set[Candidate]:
        """Fit all blocks that have changed or adjoin changed ones, and return the flares whose parameters changed."""
        moved: set[Candidate] = set()
        spans = [self.sums.window(candidate.theta) for candidate in changed]
        for block in self.blocks():
            windows = [self.sums.window(candidate.theta) for candidate in block]
            if any(a < d and c < b for a, b in windows for c, d in spans):
                moved |= self._fit(block, changed)
        return moved

    def _fit(self, block: list[Candidate], new: Collection[Candidate]) -> set[Candidate]:
        """Fit the flares of a block together, drop those that are not needed, and return those that moved."""
        others = self.others(block)
        best = self._best(self.sums.block(_thetas(block), others), block, new)
        # The noise depends on the fitted flares.
        rows = self.sums.block(best.theta, others)
        best, flares = rows.fit(best.theta), list(block)
        while len(flares) > 1:
            reduced = [rows.without(best, j) for j in range(len(flares))]
            j = int(np.argmin([fit.chi2 for fit in reduced]))
            if reduced[j].chi2 - best.chi2 >= self.threshold**2:
                break
            self.refused.append(flares[j].template)
            self.found.remove(flares.pop(j))
            best = reduced[j]
        moved = set()
        for candidate, theta in zip(flares, best.theta, strict=True):
            if np.abs(theta - candidate.theta).max() > 1e-4:
                moved.add(candidate)
            candidate.theta = theta
        return moved

    def _best(self, rows: Block, block: list[Candidate], new: Collection[Candidate]) -> BlendFit:
        """Return the best of several fits with different starting points for blends with a new flare."""
        start = _thetas(block)
        fits = [rows.fit(start)]
        for k in (k for k, candidate in enumerate(block) if candidate in new):
            # A flare that was fitted alone may be too wide because it includes another.
            for j in np.flatnonzero(start[:, WIDTH] > start[k, WIDTH]):
                narrower = start.copy()
                narrower[j, WIDTH] = start[k, WIDTH]
                fits.append(rows.fit(narrower))
        return min(fits, key=lambda fit: fit.chi2)


#: Values, intervals and note of a flare.
Measured = tuple[FittedFlares, dict[str, tuple[float, float]], str]


def _measured(rows: Block, best: BlendFit, j: int, energy: Factor | None) -> Measured:
    """Measure a flare of a block."""
    sums, theta, (low, high) = rows.sums, best.theta[j], rows.sums.bounds
    snr = float(np.sqrt(max(rows.without(best, j).chi2 - best.chi2, 0.0)))
    at_low, at_high = (np.abs(theta - end) <= AT_BOUND * (high - low) for end in (low, high))
    missing = "" if best.converged else "its fit did not converge"
    if at_low[WIDTH] or at_high[WIDTH]:
        missing = f"its best fit is {'wider' if at_high[WIDTH] else 'narrower'} than the half-widths of the bank"
    if at_low[PEAK] or at_high[PEAK]:
        missing = "its best fit peaks outside the stare"
    if missing:
        nowhere = dict.fromkeys((*QUANTITIES, "energy"), (np.nan, np.nan))
        return replace(UNMEASURED, snr=np.array([snr])), nowhere, f"detected but not measured: {missing}"
    covariance = np.asarray(rows.covariance(best.theta)[j, :, j, :])
    fitted = FittedFlares.of(theta[None], covariance[None], sums.survey, np.array([snr]))
    return fitted, *_intervals(rows, best, j, snr, covariance, energy)


def _intervals(
    rows: Block, best: BlendFit, j: int, snr: float, covariance: Float, energy: Factor | None
) -> tuple[dict[str, tuple[float, float]], str]:
    """Return the intervals of a flare's values, and a note."""
    area = np.log(rows.sums.survey.bank.shape.equivalent_duration)
    quantities = QUANTITIES | ({} if energy is None else {"energy": ProfiledQuantity(AMPLITUDE, energy)})
    intervals, notes = dict.fromkeys((*QUANTITIES, "energy"), (np.nan, np.nan)), []
    if not rows.sums.survey.templates.coloured:
        del quantities["temperature_k"]
    for name, quantity in quantities.items():
        middle, slope = quantity.of(best.theta[j])
        sd = float(np.sqrt(slope @ covariance @ slope))
        low, high, is_open = middle - sd, middle + sd, False
        if snr <= MAX_PROFILED_SNR:
            low, high, is_open = rows.interval(best, j, quantity, 1.0 + BARTLETT / max(snr, 1.0) ** 2)
        ends = np.array([low, high])
        if quantity.column != PEAK:
            ends = np.exp(ends if quantity.factor is None else ends + area)
        intervals[name] = (float(ends[0]), float(ends[1]))
        if is_open:
            notes.append(name.rsplit("_", 1)[0].replace("_", " "))
    return intervals, f"the interval of its {' and its '.join(notes)} ends where the fit does" if notes else ""
