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
#: The same as a share of a template's response to the fitted flux, when a group is tested for a further flare.
LEFT_UNSEEN = 0.15
#: Largest number of flares per fit; longer chains of overlapping flares are fitted in parts, alternately.
MAX_FLARES_PER_FIT = 6
#: Iterations over parts and their neighbours after each pass.
TURNS = 2
#: Starting points for a further flare in each group.
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
    search, detected = _StareSearch(SummedStare(survey, net), threshold), []
    # Until there are no alarms, and no group improves with a further flare.
    while new := search.alarms() or search.split():
        search.flares += new
        changed = set(new)
        for _ in range(TURNS):
            changed = search.refit(changed)
    for number, group in enumerate(search.groups(), 1):
        theta = _thetas(group)
        block = search.sums.block(theta, search.others(group))
        best = block.fit(theta)
        for j, flare in enumerate(group):
            measured = _measured(block, best, j, energy)
            detected.append(Alarm(flare.rho, *measured, number, len(group), best.chi2, best.dof, best.p_value))
    return sorted(detected, key=lambda alarm: -alarm.rho)


@dataclass(eq=False)
class _StareSearch:
    """State of the search of one stare."""

    sums: SummedStare
    threshold: float
    flares: list[Candidate] = field(default_factory=list)  # detected so far
    refused: list[tuple[float, float]] = field(default_factory=list)  # templates of flares that fits do not need
    complete: set[tuple[float, ...]] = field(default_factory=set)  # groups that no further flare improves

    def groups(self) -> list[list[Candidate]]:
        """Return groups of overlapping flares in order of time, of at most `MAX_FLARES_PER_FIT` flares each."""
        spans = sorted(((*self.sums.overlap(flare.theta), k) for k, flare in enumerate(self.flares)))
        chains: list[list[Candidate]] = []
        reach = -np.inf
        for first, last, k in spans:
            if first > reach:
                chains.append([])
            chains[-1].append(self.flares[k])
            reach = max(reach, last)
        n = MAX_FLARES_PER_FIT
        return [chain[k : k + n] for chain in chains for k in range(0, len(chain), n)]

    def others(self, group: Collection[Candidate]) -> Float:
        """Return the parameters of the flares outside of a group, shape (n_flare, 4)."""
        return _thetas(flare for flare in self.flares if flare not in group)

    def _values(self, near_share: float = 0.0) -> Iterator[tuple[Float, Float, Callable[[int], Candidate]]]:
        """Yield the excess over fit residuals and the peak times, s, (n_onset,) each, for each row of the search.

        The third value is a function of the onset that returns its candidate.
        """
        theta, (low, high) = _thetas(self.flares), self.sums.bounds
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
            for flare in self.flares if near_share else ():
                reach = TAIL * np.exp(flare.theta[WIDTH]) + LEAD * row.template.half_width_s
                near += np.where(np.abs(peaks - flare.theta[PEAK]) < reach, flare.rho, 0.0)
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

    def alarms(self) -> list[Candidate]:
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
        """Return a further flare that improves the fit of a group as much as an alarm, if there is one."""
        groups = [group for group in self.groups() if self._key(group) not in self.complete]
        if not groups:
            return []
        overlaps = [[self.sums.overlap(flare.theta) for flare in group] for group in groups]
        spans = [(min(a for a, _ in ends), max(b for _, b in ends)) for ends in overlaps]
        best: list[list[tuple[float, Candidate]]] = [[] for _ in groups]
        for excess, peaks, candidate_at in self._values():
            for several, (first, last) in zip(best, spans, strict=True):
                inside = np.flatnonzero((peaks >= first) & (peaks <= last) & np.isfinite(excess))
                if inside.size:
                    k = int(inside[np.argmax(excess[inside])])
                    several.append((float(excess[k]), candidate_at(k)))
        for group, several in zip(groups, best, strict=True):
            several.sort(key=lambda pair: -pair[0])
            for _, candidate in several[:SPLITS]:
                if not self._was_refused(*candidate.template) and self._improves(group, candidate):
                    return [candidate]
            self.complete.add(self._key(group))
        return []

    def _improves(self, group: list[Candidate], candidate: Candidate) -> bool:
        """Return whether a further flare improves a group significantly, and update the flares to the better fit."""
        before, extended = _thetas(group), [*group, candidate]
        block = self.sums.block(_thetas(extended), self.others(group))
        best = self._best(block, extended, [candidate])
        # The other flares alone may fit better from their new parameters.
        alone = min((block.fit(before), block.without(best, len(group))), key=lambda fit: fit.chi2)
        fall = alone.chi2 - best.chi2
        # The other flares may have another shape, which changes their overlap with this one.
        light, other_light = block.model(best.theta[-1:])[0], block.model(best.theta[:-1])[0]
        response = abs(float(light @ other_light)) / max(float(np.linalg.norm(light)), 1e-300)
        allowed = max(LEFT_UNSEEN * response, LEFT_BEHIND * max(flare.rho for flare in group))
        improves = bool(fall >= (self.threshold + allowed) ** 2)
        if improves:
            candidate.rho = float(np.sqrt(fall))
        flares, better = (extended, best) if improves else (group, alone)
        for flare, theta in zip(flares, better.theta, strict=True):
            flare.theta = theta
        return improves

    @staticmethod
    def _key(group: list[Candidate]) -> tuple[float, ...]:
        """Return the rounded parameters of a group, by which it is recognised."""
        return tuple(np.round(_thetas(group), 2).ravel().tolist())

    def _was_refused(self, peak: float, width: float) -> bool:
        """Return whether a flare of a similar template was not needed in a fit."""
        return any(
            abs(peak - refused_peak) <= max(width, refused_width) and 1 / 3 < width / refused_width < 3
            for refused_peak, refused_width in self.refused
        )

    def _evened(self, residuals: Float, light: Float) -> Float:
        """Return residuals, (n_frame, n_sum), scaled down under flares to the noise of frames without a flare."""
        if not self.flares:
            return residuals
        noise = self.sums.noise(_thetas(self.flares), light)
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

    def refit(self, changed: set[Candidate]) -> set[Candidate]:
        """Fit all groups that have changed or adjoin changed ones, and return the flares whose parameters changed."""
        moved: set[Candidate] = set()
        spans = [self.sums.window(flare.theta) for flare in changed]
        for group in self.groups():
            windows = [self.sums.window(flare.theta) for flare in group]
            if any(a < d and c < b for a, b in windows for c, d in spans):
                moved |= self._fit(group, changed)
        return moved

    def _fit(self, group: list[Candidate], new: Collection[Candidate]) -> set[Candidate]:
        """Fit the flares of a group together, drop those that are not needed, and return those that moved."""
        others = self.others(group)
        best = self._best(self.sums.block(_thetas(group), others), group, new)
        # The noise depends on the fitted flares.
        block = self.sums.block(best.theta, others)
        best, flares = block.fit(best.theta), list(group)
        while len(flares) > 1:
            reduced = [block.without(best, j) for j in range(len(flares))]
            j = int(np.argmin([fit.chi2 for fit in reduced]))
            if reduced[j].chi2 - best.chi2 >= self.threshold**2:
                break
            self.refused.append(flares[j].template)
            self.flares.remove(flares.pop(j))
            best = reduced[j]
        moved = set()
        for flare, theta in zip(flares, best.theta, strict=True):
            if np.abs(theta - flare.theta).max() > 1e-4:
                moved.add(flare)
            flare.theta = theta
        return moved

    @staticmethod
    def _best(block: Block, group: list[Candidate], new: Collection[Candidate]) -> BlendFit:
        """Return the best of several fits with different starting points for blends with a new flare."""
        start = _thetas(group)
        fits = [block.fit(start)]
        for k in (k for k, flare in enumerate(group) if flare in new):
            # A flare that was fitted alone may be too wide because it includes another.
            for j in np.flatnonzero(start[:, WIDTH] > start[k, WIDTH]):
                narrower = start.copy()
                narrower[j, WIDTH] = start[k, WIDTH]
                fits.append(block.fit(narrower))
        return min(fits, key=lambda fit: fit.chi2)


#: Intervals of a flare without a measurement.
NO_INTERVALS = dict.fromkeys((*QUANTITIES, "energy"), (np.nan, np.nan))
#: Values, intervals and note of a flare.
Measured = tuple[FittedFlares, dict[str, tuple[float, float]], str]


def _measured(block: Block, best: BlendFit, j: int, energy: Factor | None) -> Measured:
    """Measure flare `j` of a block, whose best fit is given; its values are NaN if the fit ends at a bound."""
    sums, theta, (low, high) = block.sums, best.theta[j], block.sums.bounds
    snr = float(np.sqrt(max(block.without(best, j).chi2 - best.chi2, 0.0)))
    at_low, at_high = (np.abs(theta - end) <= AT_BOUND * (high - low) for end in (low, high))
    missing = "" if best.converged else "its fit did not converge"
    if at_low[WIDTH] or at_high[WIDTH]:
        missing = f"its best fit is {'wider' if at_high[WIDTH] else 'narrower'} than the half-widths of the bank"
    if at_low[PEAK] or at_high[PEAK]:
        missing = "its best fit peaks outside the stare"
    if missing:
        return replace(UNMEASURED, snr=np.array([snr])), NO_INTERVALS, f"detected but not measured: {missing}"
    covariance = np.asarray(block.covariance(best.theta)[j, :, j, :])
    fitted = FittedFlares.of(theta[None], covariance[None], sums.survey, np.array([snr]))
    return fitted, *_intervals(block, best, j, snr, covariance, energy)


def _intervals(
    block: Block, best: BlendFit, j: int, snr: float, covariance: Float, energy: Factor | None
) -> tuple[dict[str, tuple[float, float]], str]:
    """Return the intervals of a flare's values, and a note."""
    area = np.log(block.sums.survey.bank.shape.equivalent_duration)
    quantities = QUANTITIES | ({} if energy is None else {"energy": ProfiledQuantity(AMPLITUDE, energy)})
    intervals, notes = dict(NO_INTERVALS), []
    if not block.sums.survey.templates.coloured:
        del quantities["temperature_k"]
    for name, quantity in quantities.items():
        middle, slope = quantity.of(best.theta[j])
        sd = float(np.sqrt(slope @ covariance @ slope))
        low, high, is_open = middle - sd, middle + sd, False
        if snr <= MAX_PROFILED_SNR:
            low, high, is_open = block.interval(best, j, quantity, 1.0 + BARTLETT / max(snr, 1.0) ** 2)
        ends = np.array([low, high])
        if quantity.column != PEAK:
            ends = np.exp(ends if quantity.factor is None else ends + area)
        intervals[name] = (float(ends[0]), float(ends[1]))
        if is_open:
            notes.append(name.rsplit("_", 1)[0].replace("_", " "))
    return intervals, f"the interval of its {' and its '.join(notes)} ends where the fit does" if notes else ""
