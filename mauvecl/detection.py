"""Thresholds with a known false-alarm probability, and detection probabilities with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.layout import FIXED_STATISTICS
from mauvecl.scene import Scene
from mauvecl.statistics import (
    STATISTICS,
    Interval,
    Normal,
    QuadraticForm,
    central_counts,
    clopper_pearson,
    closed_form,
    matched_weights,
)
from mauvecl.tally import Distribution, Grid, Tally

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation

#: A threshold needs this many realisations beyond it; a rarer tail is refused, never extrapolated.
FEWEST_IN_TAIL = 100

#: Which distribution: without a flare; with it, binned around the null; with it, around its own mean.
Role = Literal["null", "flare_on_null_grid", "flare"]
Key = tuple[str, Role, int]


def check_fap(fap: float, realisations: int) -> None:
    """Refuse a false-alarm probability that this many realisations cannot settle.

    Raises
    ------
    InputError
        If it is none, or fewer than 100 realisations would lie beyond the threshold.
    """
    if not 0.0 < fap < 1.0:
        raise InputError(f"fap = {fap!r}, expected a probability between 0 and 1")
    if fap * realisations < FEWEST_IN_TAIL * (1 - 1e-9):
        raise InputError(
            f"fap = {fap:g} leaves {fap * realisations:.3g} of {realisations} realisations beyond the threshold, "
            f"expected at least {FEWEST_IN_TAIL}: ask for {int(np.ceil(FEWEST_IN_TAIL / fap))} realisations"
        )


@dataclass(frozen=True)
class ChannelPlan:
    """What one launch computes for a batch of flares, and how its grids are called.

    Attributes
    ----------
    weights : ndarray of float32, shape (n_linear, n_padded)
    linear_end : ndarray of uint32, shape (n_scenario,)
        One past the last linear statistic of each scenario.
    n_rows : int
        Channels.
    grids : list of Grid
    keys : list of (statistic, role, flare)
        What each grid holds.
    """

    weights: NDArray[np.float32]
    linear_end: NDArray[np.uint32]
    n_rows: int
    grids: list[Grid]
    keys: list[Key]


@dataclass(eq=False)
class Detection:
    """Null and flare distributions of one study; made by `Engine.detect`.

    Attributes
    ----------
    quiet : Expectation
    flares : tuple of Expectation
    statistics : tuple of str
    scene : Scene
    realisations : int
    """

    quiet: Expectation
    flares: tuple[Expectation, ...]
    statistics: tuple[str, ...]
    scene: Scene
    realisations: int
    _found: dict[Key, Distribution] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not self.statistics:
            raise InputError(f"no statistic named, expected some of {', '.join(STATISTICS)}")
        for name in self.statistics:
            if name not in STATISTICS:
                raise InputError(f"statistic {name!r} is unknown, expected one of {', '.join(STATISTICS)}")
        if not self.flares and "matched" in self.statistics:
            raise InputError("no flare given, expected at least one for the statistic 'matched'")
        if not self.scene.used.any():
            raise InputError(f"every pixel of {self.quiet.name} is saturated, expected a fainter star")

    def collect(self, plan: ChannelPlan, tally: Tally) -> None:
        """Take over the distributions of one batch."""
        for index, key in enumerate(plan.keys):
            self._found[key] = tally.distribution(index)

    def distribution(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Distribution:
        """The simulated distribution of a statistic.

        Parameters
        ----------
        statistic : str
        flare : int, optional
            Which flare; None for the null.
        template : int
            For the null of ``matched``: the flare whose shape is looked for.
        """
        self._check(statistic, flare if flare is not None else template if statistic == "matched" else None)
        if flare is None:
            return self._found[(statistic, "null", self._null(statistic, template))]
        return self._found[(statistic, "flare", flare)]

    def closed_form(self, statistic: str, flare: int | None = None, *, template: int = 0) -> QuadraticForm | Normal:
        """The same distribution for Gaussian noise; parameters as for `distribution`."""
        self._check(statistic, flare if flare is not None else template if statistic == "matched" else None)
        observed = self.quiet if flare is None else self.flares[flare]
        looked_for = self.flares[template if flare is None else flare] if self.flares else self.quiet
        return closed_form(statistic, self.quiet, observed, looked_for, self.scene.used)

    def dof(self, statistic: str) -> int:
        """Degrees of freedom without a flare: pixels, resolution elements, or one."""
        if statistic == "matched":
            return 1
        if statistic == "chi2_element":
            return int(np.unique(self.quiet.element[self.scene.used]).size)
        return int(self.scene.used.sum())

    def histogram(
        self, statistic: str, flare: int | None = None, *, template: int = 0, bins: int = 200
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Edges and counts for pictures; parameters as for `distribution`."""
        return self.distribution(statistic, flare, template=template).histogram(bins)

    def threshold(self, fap: float = 1e-3, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """The value exceeded with false-alarm probability `fap` in one test.

        Parameters
        ----------
        fap : float
            Per test.
        statistic : str
        template : int
            For ``matched``: the flare whose shape is looked for.

        Returns
        -------
        Interval
            The simulated upper quantile, rounded up to a bin's edge (1/512 of a standard deviation), and an
            order-statistic interval.

        Raises
        ------
        InputError
            If fewer than 100 realisations lie beyond: the tail is not extrapolated.
        """
        null, cut = self._cut(fap, statistic, template)
        n_low, n_high = central_counts(null.n, fap)
        low, high = null.first_bin_with_at_most(n_high), null.first_bin_with_at_most(max(n_low - 1, 0))
        return Interval(*(float(null.edge(index)) for index in (cut, low, high)))

    def false_alarm_probability(self, threshold: float, statistic: str = "chi2", *, template: int = 0) -> Interval:
        """Fraction of null realisations at or above a threshold, with its interval; the inverse of `threshold`.

        The threshold is taken at the next bin edge upwards.
        """
        null = self.distribution(statistic, template=template)
        edges = np.asarray(null.edge(np.arange(null.counts.size)))
        cut = int(np.searchsorted(edges, threshold * (1 - 1e-12) if threshold > 0 else threshold))
        return clopper_pearson(null.above(cut), null.n)

    def detection_probability(self, fap: float = 1e-3, statistic: str = "chi2") -> list[Interval]:
        """For each flare, the fraction of realisations at or above the threshold.

        The interval is Clopper-Pearson's and allows for the threshold's own: its low end counts from the threshold's
        high end and the other way round.

        Raises
        ------
        InputError
            As `threshold`.
        """
        probabilities = []
        for flare in range(len(self.flares)):
            null, cut = self._cut(fap, statistic, flare)
            n_low, n_high = central_counts(null.n, fap)
            cut_low = null.first_bin_with_at_most(n_high)
            cut_high = null.first_bin_with_at_most(max(n_low - 1, 0))
            found = self._found[(statistic, "flare_on_null_grid", flare)]
            value, low, high = (clopper_pearson(found.above(index), found.n) for index in (cut, cut_high, cut_low))
            probabilities.append(Interval(value.value, low.low, high.high))
        return probabilities

    def roc(self, statistic: str = "chi2", flare: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """False-alarm probability against detection probability, at every bin edge, both descending.

        Returns
        -------
        fap, probability : ndarray, shape (n_edge,)
        """
        self._check(statistic, flare)
        null = self._found[(statistic, "null", self._null(statistic, flare))]
        found = self._found[(statistic, "flare_on_null_grid", flare)]
        fap, probability = (d.counts[::-1].cumsum()[::-1] / d.n for d in (null, found))
        keep = np.append(True, (np.diff(fap) != 0) | (np.diff(probability) != 0))
        return fap[keep], probability[keep]

    def table(self, fap: float = 1e-3) -> QTable:
        """One row per flare and statistic: expected and simulated values, threshold and probability.

        Raises
        ------
        InputError
            As `threshold`.
        """
        from astropy.table import QTable

        columns = (
            "name", "statistic", "dof", "expected", "mean", "std", "reduced", "threshold", "threshold_low",
            "threshold_high", "probability", "low", "high", "closed_form_threshold", "closed_form_probability",
        )  # fmt: skip
        probability = {statistic: self.detection_probability(fap, statistic) for statistic in self.statistics}
        rows = []
        for flare, x in enumerate(self.flares):
            for statistic in self.statistics:
                d, p = self.distribution(statistic, flare), probability[statistic][flare]
                cut = self.threshold(fap, statistic, template=flare)
                theory = self.closed_form(statistic, flare)
                limit = self.closed_form(statistic, template=flare).isf(fap)
                dof = self.dof(statistic)
                row = (x.name, statistic, dof, theory.mean, d.mean, d.std, d.mean / dof)
                rows.append((*row, cut.value, cut.low, cut.high, p.value, p.low, p.high, limit, theory.sf(limit)))
        table = QTable(rows=rows, names=columns)
        for name, text in DESCRIPTIONS.items():
            table[name].info.description = text
        table.meta |= {"fap": fap, "realisations": self.realisations, "exposure_s": self.quiet.exposure_s}
        return table

    def _null(self, statistic: str, template: int) -> int:
        # Only `matched` looks for a given shape; the others have one null for all flares.
        return template if statistic == "matched" else 0

    def _cut(self, fap: float, statistic: str, template: int) -> tuple[Distribution, int]:
        self._check(statistic, template if statistic == "matched" else None)
        check_fap(fap, self.realisations)
        null = self._found[(statistic, "null", self._null(statistic, template))]
        return null, null.first_bin_with_at_most(int(np.floor(fap * null.n * (1 + 1e-12))))

    def _check(self, statistic: str, flare: int | None) -> None:
        if statistic not in self.statistics:
            raise InputError(f"statistic {statistic!r} was not simulated, expected one of {', '.join(self.statistics)}")
        if flare is not None and not 0 <= flare < len(self.flares):
            raise InputError(f"flare = {flare}, expected 0 to {len(self.flares) - 1}")


DESCRIPTIONS = {
    "dof": "degrees of freedom without a flare",
    "expected": "closed-form mean with the flare",
    "mean": "simulated mean with the flare",
    "std": "simulated standard deviation with the flare",
    "reduced": "simulated mean over degrees of freedom",
    "threshold": "simulated threshold at the false-alarm probability, per test",
    "threshold_low": "its 95 % interval, lower end",
    "threshold_high": "its 95 % interval, upper end",
    "probability": "detection probability at that threshold",
    "low": "its 95 % interval, lower end, with the threshold's own",
    "high": "its 95 % interval, upper end, with the threshold's own",
    "closed_form_threshold": "threshold for Gaussian noise",
    "closed_form_probability": "detection probability for Gaussian noise",
}


def plan_channels(result: Detection, batch: Sequence[int], *, first: bool) -> ChannelPlan:
    """Lay out the channels of a batch of flares; scenario 0 is always the quiescent one.

    Parameters
    ----------
    result : Detection
    batch : sequence of int
        Flares of this launch.
    first : bool
        Whether nulls shared by all batches are counted in this one.
    """
    n_scenario = 1 + len(batch)
    fixed = len(FIXED_STATISTICS) * n_scenario
    matched = "matched" in result.statistics
    weights = np.zeros((2 * len(batch) if matched else 0, len(result.scene.pixels)), np.float32)
    ends = np.zeros(n_scenario, np.uint32)
    if matched:
        # The quiescent draws meet every template, each flare only its own.
        ends[:] = len(batch) + np.arange(n_scenario)
        for i, flare in enumerate(batch):
            shape = matched_weights(result.quiet, result.flares[flare], result.scene.used)
            weights[[i, len(batch) + i], : result.scene.n_pixel] = shape
    grids: list[Grid] = []
    keys: list[Key] = []

    def add(statistic: str, role: Role, flare: int, row: int, shape: QuadraticForm | Normal) -> None:
        grids.append(Grid(row, shape.mean, shape.std))
        keys.append((statistic, role, flare))

    for statistic in result.statistics:
        if first and statistic != "matched":
            add(statistic, "null", 0, FIXED_STATISTICS.index(statistic), result.closed_form(statistic))
        for i, flare in enumerate(batch):
            null = result.closed_form(statistic, template=flare)
            own = result.closed_form(statistic, flare)
            if statistic == "matched":
                null_row, row = fixed + i, fixed + len(batch) + i
                add(statistic, "null", flare, null_row, null)
            else:
                row = len(FIXED_STATISTICS) * (i + 1) + FIXED_STATISTICS.index(statistic)
            add(statistic, "flare_on_null_grid", flare, row, null)
            add(statistic, "flare", flare, row, own)
    return ChannelPlan(weights, ends, fixed + len(weights), grids, keys)
