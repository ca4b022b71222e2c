"""The flares that a search finds in one stare: searched, fitted together where they overlap, and searched again.

Each pass searches what the fits have left. A template alarms where its value is above the threshold by more than the
share of the fitted light that a wrong shape may leave behind. Flares whose light overlaps are fitted together
(`blends`), from several starts; of those, each must improve chi-squared by the square of the threshold. Passes end when
nothing alarms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import LEAD, TAIL
from mauvecl.lightcurve.search.blends import AMPLITUDE, KELVIN, PEAK, WIDTH, Blended, Block, Factor, Interval, Sums
from mauvecl.lightcurve.search.recovery import Recovered

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.search import Row
    from mauvecl.lightcurve.search.survey import Survey
    from mauvecl.lightcurve.search.templates import Templates

Float = NDArray[np.float64]

#: A fit that measures nothing.
NOTHING = Recovered(**{each.name: np.full(1, np.nan) for each in fields(Recovered)})
#: Share of a flare's S/N that its fit may leave behind anywhere within its reach, and that is no alarm of its own:
#: shapes and temperatures that the fit does not have.
LEFT_BEHIND = 0.05
#: The same for what a template sees of the fitted light itself, where a flare may be two.
LEFT_UNSEEN = 0.15
#: Flares that are fitted at once, at most: more that overlap are fitted in parts, in turns.
TOGETHER = 6
#: Turns of fitting parts and their neighbours after each pass.
TURNS = 2
#: Half-widths from the peak of a flare at an end of what is fitted, and factors between half-widths, within which
#: further alarms are taken for the rest of this flare.
NEAR, WIDER = 5.0, 8.0
#: Starts of a further flare that are tried in each block.
SPLITS = 3
#: Parameters this close to an end of what is fitted, as a share of its range, are at it.
AT_END = 1e-3
#: S/N of a fit up to which intervals are by profile likelihood; above it they are by curvature, which agrees there.
PROFILED_SNR = 40.0
#: The rise of chi-squared that 68 % of the true values stay within is 1 + this / (S/N of the fit)^2: a correction of
#: the likelihood ratio as Bartlett's (1937, doi 10.1098/rspa.1937.0109), counted by `bench/blends.py`.
BARTLETT = 14.0
#: Quantities with intervals, by their names in `Recovered`.
QUANTITIES = ("peak_s", "amplitude", "half_width_s", "temperature_k", "equivalent_duration_s")


@dataclass(frozen=True, eq=False)
class Alarm:
    """One flare that was found.

    Attributes
    ----------
    rho : float
        The search's statistic when it was found; for one of two that a first fit took for one, the root of what
        chi-squared fell by.
    recovered : Recovered
        What it was, by a fit; arrays of one value, NaN where the fit does not measure it.
    intervals : dict
        68 % interval of each of `QUANTITIES`, and of "energy"; NaN where there is no factor for it.
    note : str
        What is wrong or special with the fit; empty in most cases.
    block : int
        Number of the block that it was fitted in, from 1 on.
    flares : int
        Flares in this block.
    chi2, p_value : float
    dof : int
        Goodness of fit of the block.
    """

    rho: float
    recovered: Recovered
    intervals: dict[str, tuple[float, float]]
    note: str
    block: int
    flares: int
    chi2: float
    dof: int
    p_value: float

    @property
    def measured(self) -> bool:
        """Whether the fit gives values."""
        return bool(np.isfinite(self.recovered.peak_s[0]))


@dataclass(eq=False)
class Found:
    """A flare during the search: its parameters, the statistic that found it, and the blend that it is in."""

    theta: Float
    rho: float
    #: Templates' peaks, s, and half-widths, s, that found it.
    template: tuple[float, float]


def alarms(
    survey: Survey, templates: Templates, sums: NDArray[Any], threshold: float, energy: Factor | None = None
) -> list[Alarm]:
    """Find and fit every flare of one stare, the largest first.

    Parameters
    ----------
    survey : Survey
    templates : Templates
        That the survey's bank and components are made of.
    sums : ndarray, shape (n_frame, n_sum)
        As drawn; what is known is taken off here.
    threshold : float
    energy : callable, optional
        Logarithm of the energy of a second of equivalent duration over the logarithm of the temperature, with its
        derivative.
    """
    hunt = _Hunt(Sums(survey, templates, np.asarray(survey.net(sums[None])[0], np.float64)), threshold)
    hunt.run()
    return sorted(_told(hunt, energy), key=lambda alarm: -alarm.rho)


@dataclass(eq=False)
class _Hunt:
    """The state of a search of one stare."""

    sums: Sums
    threshold: float
    found: list[Found] = field(default_factory=list)
    refused: list[tuple[float, float]] = field(default_factory=list)
    #: Blocks that no further flare improves.
    whole: set[tuple[float, ...]] = field(default_factory=set)

    def run(self) -> None:
        """Search and fit until nothing alarms and no flare is better fitted as two."""
        while new := self._searched() or self._split():
            self.found += new
            changed = {id(one) for one in new}
            for _ in range(TURNS):
                changed = self._fitted(changed)

    @cached_property
    def _whole(self) -> Any:
        return self.sums.survey.search

    @property
    def thetas(self) -> Float:
        """Parameters of all flares, shape (n_flare, 4)."""
        return np.array([one.theta for one in self.found]).reshape(len(self.found), 4)

    def blocks(self) -> list[list[Found]]:
        """Flares that overlap, by their times; in parts of `TOGETHER` where more do."""
        spans = sorted(((*self.sums.overlap(one.theta), k) for k, one in enumerate(self.found)))
        blocks: list[list[Found]] = []
        reach = -np.inf
        for first, last, k in spans:
            if first > reach:
                blocks.append([])
            blocks[-1].append(self.found[k])
            reach = max(reach, last)
        return [block[k : k + TOGETHER] for block in blocks for k in range(0, len(block), TOGETHER)]

    def _near(self, peaks: Float, width_s: float) -> Float:
        """Sum of the values of flares within the reach of templates, shape of the templates' peaks."""
        total = np.zeros(peaks.shape)
        for one in self.found:
            reach = TAIL * np.exp(one.theta[WIDTH]) + LEAD * width_s
            total += np.where(np.abs(peaks - one.theta[PEAK]) < reach, one.rho, 0.0)
        return total

    def _values(self, near_share: float = 0.0) -> Iterator[tuple[Float, Float, Float, NDArray[np.int64], Row]]:
        """Values in the residuals, those above what fits leave behind, peaks, temperatures: the best of each onset."""
        light = self.sums.light(self.thetas)
        # Of what no flare of the bank fits, all may be left.
        wrong = self.sums.light(self.thetas[self._at_end(self.thetas)])
        both = np.stack([self._evened(self.sums.net - light, light), LEFT_UNSEEN * light + wrong])
        for row, rho in self._whole.values(both.astype(np.float32)):
            peaks = self._whole.stare.numbers[0] + row.peaks + row.template.phases[row.phase]
            peaks = peaks * self.sums.survey.bank.frame_s
            rests = np.abs(np.where(np.isfinite(rho[1]), rho[1], 0.0))
            excess = rho[0] - np.maximum(rests, near_share * self._near(peaks, row.template.half_width_s))
            which = excess.argmax(axis=0)
            onsets = np.arange(excess.shape[1])
            yield rho[0, which, onsets], excess[which, onsets], peaks, which, row

    def _candidate(self, rho: float, peak: float, row: Row, onset: int, direction: int) -> Found:
        """A flare as its template has it."""
        templates, width = self.sums.templates, row.template.half_width_s
        size = float(np.linalg.norm(templates.directions[templates.chosen[direction]]))
        amplitude = max(rho / float(row.per_amplitude[onset]), 1e-3) / size
        kelvin = templates.temperatures_k[templates.chosen[direction]]
        theta = np.array([np.log(amplitude), peak, np.log(width), np.log(kelvin)])
        return Found(theta, rho, (peak, width))

    def _searched(self) -> list[Found]:
        """What alarms in the residuals: at most one flare within the reach of another."""
        sums, bank = self.sums, self.sums.survey.bank
        candidates = []
        for rho, excess, peaks, which, row in self._values(LEFT_BEHIND):
            for k in np.flatnonzero(excess >= self.threshold):
                one = self._candidate(float(rho[k]), float(peaks[k]), row, int(k), int(which[k]))
                candidates.append((float(excess[k]), one))
        candidates.sort(key=lambda pair: -pair[0])
        # What is near something larger may be its light: it waits for the next pass, and keeps others waiting.
        waiting = np.zeros(len(sums.net), np.bool_)
        new = []
        for _, one in candidates:
            peak, width = one.template
            if self._was_refused(peak, width):
                continue
            lead, tail = (frames * bank.frame_s for frames in bank.window(width))
            window = sums.frames(peak - lead, peak + tail)
            waits = waiting[window].any()
            waiting[window] = True
            if not waits:
                new.append(one)
        return new

    def _split(self) -> list[Found]:
        """One more flare that improves the fit of a block as much as an alarm does, where a first fit has hidden it."""
        blocks = [block for block in self.blocks() if self._key(block) not in self.whole]
        if not blocks:
            return []
        spans = [(min(a for a, _ in each), max(b for _, b in each)) for each in self._overlaps(blocks)]
        best: list[list[tuple[float, Found]]] = [[] for _ in blocks]
        for rho, excess, peaks, which, row in self._values():
            for several, (first, last) in zip(best, spans, strict=True):
                inside = np.flatnonzero((peaks >= first) & (peaks <= last) & np.isfinite(excess))
                if inside.size:
                    k = int(inside[np.argmax(excess[inside])])
                    one = self._candidate(float(rho[k]), float(peaks[k]), row, k, int(which[k]))
                    several.append((float(excess[k]), one))
        for block, several in zip(blocks, best, strict=True):
            several.sort(key=lambda pair: -pair[0])
            for _, one in several[:SPLITS]:
                if not self._was_refused(*one.template) and self._improves(block, one):
                    return [one]
            self.whole.add(self._key(block))
        return []

    def _improves(self, block: list[Found], one: Found) -> bool:
        """Whether a further flare is worth its parameters; it and the others are moved to where they then are."""
        before = np.array([each.theta for each in block])
        with_it = [*block, one]
        rows = self.sums.block(np.array([each.theta for each in with_it]), np.vstack([self.thetas, one.theta]))
        best = self._best(rows, with_it, {id(one)})
        # The others may themselves fit better from where they are now.
        alone = min((rows.fit(before), rows.without(best, len(block))), key=lambda fit: fit.chi2)
        fall = alone.chi2 - best.chi2
        # The light of the others, as this flare sees it, may be of another shape.
        mine, others = rows.model(best.theta[-1:])[0], rows.model(best.theta[:-1])[0]
        seen = abs(float(mine @ others)) / max(float(np.linalg.norm(mine)), 1e-300)
        rests = max(LEFT_UNSEEN * seen, LEFT_BEHIND * max(each.rho for each in block))
        if fall < (self.threshold + rests) ** 2:
            for each, theta in zip(block, alone.theta, strict=True):
                each.theta = theta
            return False
        for each, theta in zip(with_it, best.theta, strict=True):
            each.theta = theta
        one.rho = float(np.sqrt(fall))
        return True

    def _overlaps(self, blocks: list[list[Found]]) -> list[list[tuple[float, float]]]:
        return [[self.sums.overlap(one.theta) for one in block] for block in blocks]

    @staticmethod
    def _key(block: list[Found]) -> tuple[float, ...]:
        return tuple(np.round([one.theta for one in block], 2).ravel().tolist())

    def _at_end(self, theta: Float) -> NDArray[np.bool_]:
        """Which flares peak at an end of the stare or are at an end of the bank, shape (n_flare,)."""
        low, high = self.sums.bounds
        at_end: NDArray[np.bool_] = np.minimum(theta - low, high - theta) <= AT_END * (high - low)
        return np.asarray(at_end[:, [PEAK, WIDTH]].any(axis=1))

    def _was_refused(self, peak: float, width: float) -> bool:
        return any(abs(peak - other) <= max(width, wide) and 1 / 3 < width / wide < 3 for other, wide in self.refused)

    def _evened(self, left: Float, light: Float) -> Float:
        """Residuals with the noise of frames without a flare: what is above the level is scaled down under flares."""
        if not self.found:
            return left
        noise = self.sums.noise(self.thetas, light)
        base = self.sums.covariance
        excess = np.einsum("tkk->t", np.linalg.solve(base, noise)) / base.shape[1]
        loud = excess > 1.01
        if not loud.any():
            return left
        evened = left.copy()
        # The level under a flare is about that around it: a running median of the frames that are not loud.
        times = self.sums.edges[:, 0]
        for start, stop in _runs(loud):
            near = ~loud & (np.abs(times - times[(start + stop) // 2]) < self.sums.survey.bank.level.window_s / 2 + 1)
            level = np.median(left[near], axis=0) if near.any() else np.zeros(left.shape[1])
            rows = slice(start, stop)
            evened[rows] = level + (left[rows] - level) / np.sqrt(excess[rows])[:, None]
        return evened

    def _fitted(self, changed: set[int]) -> set[int]:
        """Fit every block that has changed or borders on one that has; the flares that moved."""
        moved: set[int] = set()
        spans = [self.sums.window(one.theta) for one in self.found if id(one) in changed]
        for block in self.blocks():
            mine = [self.sums.window(one.theta) for one in block]
            if any(a < d and c < b for a, b in mine for c, d in spans):
                moved |= self._fit(block, {id(one) for one in block} & changed)
        return moved

    def _fit(self, block: list[Found], new: set[int]) -> set[int]:
        sums = self.sums
        before = np.array([one.theta for one in block])
        rows = sums.block(before, self.thetas)
        best = self._best(rows, block, new)
        # Noise follows the flares as fitted.
        inside = {id(one) for one in block}
        others = np.array([one.theta for one in self.found if id(one) not in inside]).reshape(-1, 4)
        rows = sums.block(best.theta, np.vstack([others, best.theta]))
        best = rows.fit(best.theta)
        kept = list(block)
        while len(kept) > 1:
            falls = [rows.without(best, j) for j in range(len(kept))]
            j = int(np.argmin([one.chi2 for one in falls]))
            if falls[j].chi2 - best.chi2 >= self.threshold**2:
                break
            self.refused.append(kept[j].template)
            self.found.remove(kept[j])
            best = falls[j]
            del kept[j]
        moved = set()
        for one, theta in zip(kept, best.theta, strict=True):
            if np.abs(theta - one.theta).max() > 1e-4:
                moved.add(id(one))
            one.theta = theta
        return moved

    def _best(self, rows: Block, block: list[Found], new: set[int]) -> Blended:
        """The best of fits from several starts, where a flare is new in a blend."""
        start = np.array([one.theta for one in block])
        fits = [rows.fit(start)]
        if len(block) > 1:
            for k, one in enumerate(block):
                if id(one) not in new:
                    continue
                # What was fitted alone is wider than it is where it has swallowed another.
                for j in range(len(block)):
                    if j != k and start[j, WIDTH] > start[k, WIDTH]:
                        other = start.copy()
                        other[j, WIDTH] = start[k, WIDTH]
                        fits.append(rows.fit(other))
        return min(fits, key=lambda one: one.chi2)


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last + 1 of each run of true values."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in steps.reshape(-1, 2)]


def _told(hunt: _Hunt, energy: Factor | None) -> list[Alarm]:
    told = []
    for number, block in enumerate(hunt.blocks(), 1):
        theta = np.array([one.theta for one in block])
        rows = hunt.sums.block(theta, hunt.thetas)
        better: Blended | None = rows.fit(theta)
        while better is not None:
            # Profiling looks far around: where it finds a better fit, everything begins again from there.
            best, measured = better, []
            for j in range(len(block)):
                gain = rows.without(best, j).chi2 - best.chi2
                values, better = _measured(rows, best, j, gain, energy)
                if better is not None:
                    break
                measured.append(values)
        for one, values in zip(block, measured, strict=True):
            told.append(Alarm(one.rho, *values, number, len(block), best.chi2, best.dof, best.p_value))
    return told


def _measured(
    rows: Block, best: Blended, j: int, gain: float, energy: Factor | None
) -> tuple[tuple[Recovered, dict[str, tuple[float, float]], str], Blended | None]:
    """A flare's values, intervals and note; or a better fit of its block that profiling came across."""
    sums, theta = rows.sums, best.theta[j]
    low, high = sums.bounds
    at_low, at_high = (np.abs(theta - end) <= AT_END * (high - low) for end in (low, high))
    snr = float(np.sqrt(max(gain, 0.0)))
    missing = ""
    if at_low[PEAK] or at_high[PEAK]:
        missing = "its best fit peaks outside of the stare"
    elif at_low[WIDTH] or at_high[WIDTH]:
        missing = f"its best fit is {'wider' if at_high[WIDTH] else 'narrower'} than the half-widths of the bank"
    elif not best.converged:
        missing = "its fit did not converge"
    if missing:
        nowhere = dict.fromkeys((*QUANTITIES, "energy"), (np.nan, np.nan))
        return (replace(NOTHING, snr=np.array([snr])), nowhere, f"detected but not measured: {missing}"), None
    area = sums.survey.bank.shape.equivalent_duration
    several = KELVIN in sums.free
    covariance = best_covariance(rows, best, j)
    duration = np.array([1.0, 0.0, 1.0, 0.0])
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    sd_duration = float(np.sqrt(max(duration @ covariance @ duration, 0.0)))
    amplitude, width, kelvin = np.exp(theta[[AMPLITUDE, WIDTH, KELVIN]])
    factors: dict[str, tuple[int, Factor | None, float]] = {
        "peak_s": (PEAK, None, 0.0), "amplitude": (AMPLITUDE, None, 0.0), "half_width_s": (WIDTH, None, 0.0),
        "temperature_k": (KELVIN, None, 0.0), "equivalent_duration_s": (AMPLITUDE, lambda _: (0.0, 0.0), np.log(area)),
    }  # fmt: skip
    if energy is not None:
        factors["energy"] = (AMPLITUDE, energy, np.log(area))
    intervals, notes = {"energy": (np.nan, np.nan)}, []
    for name, (column, factor, offset) in factors.items():
        if column == KELVIN and not several:
            intervals[name] = (np.nan, np.nan)
            continue
        if snr > PROFILED_SNR:
            found = _by_curvature(theta, covariance, column, factor)
        else:
            found, better = rows.interval(best, j, column, factor, 1.0 + BARTLETT / max(snr, 1.0) ** 2)
            if better is not None:
                return (NOTHING, {}, ""), better
        ends = np.array([found.low, found.high])
        low_end, high_end = ends if column == PEAK else np.exp(ends + offset)
        intervals[name] = (float(low_end), float(high_end))
        if found.open_low or found.open_high:
            notes.append(name.rsplit("_", 1)[0].replace("_", " "))
    note = f"the interval of its {' and its '.join(notes)} ends where the fit does" if notes else ""
    values = (
        theta[PEAK], sd[PEAK], amplitude, amplitude * sd[AMPLITUDE], width, width * sd[WIDTH],
        kelvin if several else np.nan, kelvin * sd[KELVIN] if several else np.nan,
        amplitude * width * area, amplitude * width * area * sd_duration, snr,
    )  # fmt: skip
    return (Recovered(*(np.array([value]) for value in values)), intervals, note), None


def best_covariance(rows: Block, best: Blended, j: int) -> Float:
    """Return the covariance of one flare's parameters, shape (4, 4)."""
    return np.asarray(rows.covariance(best.theta)[j, :, j, :])


def _by_curvature(theta: Float, covariance: Float, column: int, factor: Factor | None) -> Interval:
    if factor is None:
        middle, sd = theta[column], np.sqrt(covariance[column, column])
    else:
        value, slope = factor(theta[KELVIN])
        along = np.array([1.0, 0.0, 1.0, slope])
        middle, sd = theta[AMPLITUDE] + theta[WIDTH] + value, np.sqrt(along @ covariance @ along)
    return Interval(float(middle - sd), float(middle + sd))
