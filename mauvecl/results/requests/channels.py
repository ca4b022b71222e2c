"""What one launch computes for a batch of flares: weights, scales and the grids that count each statistic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise.layout import FIXED_STATISTICS
from mauvecl.results.counts.tally import Grid, TailSamples
from mauvecl.results.requests.hypotheses import Hypotheses
from mauvecl.statistics.distributions import Form
from mauvecl.statistics.paper import Paper
from mauvecl.statistics.statistic import LinearStatistic, QuadraticStatistic, Statistic

#: Which distribution: without a flare; with it, binned around the null; with it, around its own mean.
Role = Literal["null", "flare_on_null_grid", "flare"]
Key = tuple[str, Role, int]


@dataclass(frozen=True)
class ChannelPlan:
    """What one launch computes for a batch of flares, and how its grids are called.

    Attributes
    ----------
    weights : ndarray of float32, shape (n_linear, n_padded)
    linear_end : ndarray of uint32, shape (n_scenario,)
        One past the last linear statistic of each scenario.
    pixels_end : ndarray of uint32, shape (n_scenario,)
        One past the last of them that weighs pixels; those behind it weigh sums of resolution elements, at an element's
        last pixel.
    scales : ndarray of float32, shape (n_smoothed, n_centre)
        Of the statistic `paper`; see `smoothing.Smoothing`.
    scale_end : ndarray of uint32, shape (n_scenario,)
    grids : list of Grid
    keys : list of (statistic, role, flare)
        What each grid holds.
    subtractions : ndarray of uint32, shape (3, n)
        Rows of chi-squared, and the first and one past the last of the rows whose squares are taken away from it.
    """

    weights: NDArray[np.float32]
    linear_end: NDArray[np.uint32]
    pixels_end: NDArray[np.uint32]
    scales: NDArray[np.float32]
    scale_end: NDArray[np.uint32]
    grids: list[Grid]
    keys: list[Key]
    subtractions: NDArray[np.uint32]

    def tails(self) -> list[TailSamples | None]:
        """What keeps the extremes of each grid: a null's largest values, a flare's smallest."""
        kinds: dict[Role, bool] = {"null": True, "flare": False}
        return [TailSamples(largest=kinds[role]) if role in kinds else None for _, role, _ in self.keys]

    @property
    def n_rows(self) -> int:
        """Channels."""
        return len(FIXED_STATISTICS) * len(self.linear_end) + len(self.weights) + len(self.scales)


@dataclass(eq=False)
class _Rows:
    """Rows of weights of one kind, scenario by scenario."""

    rows: list[NDArray[np.float64]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    #: One past the last of each scenario that weighs pixels.
    pixels_end: list[int] = field(default_factory=list)
    #: Where a statistic of a scenario is found; `shaped` ones by the flare looked for.
    places: dict[tuple[str, int, int], int] = field(default_factory=dict)

    def add(self, statistic: str, scenario: int, flare: int, row: NDArray[np.float64]) -> None:
        self.places[statistic, scenario, flare] = len(self.rows)
        self.rows.append(row)

    def end_pixels(self) -> None:
        """End what weighs pixels of a scenario."""
        self.pixels_end.append(len(self.rows))

    def end(self) -> None:
        """End a scenario."""
        if len(self.pixels_end) == len(self.ends):
            self.end_pixels()
        self.ends.append(len(self.rows))


def plan_channels(hypotheses: Hypotheses, batch: Sequence[int], *, first: bool) -> ChannelPlan:
    """Lay out the channels of a batch of flares; scenario 0 is always the quiescent one.

    Parameters
    ----------
    hypotheses : Hypotheses
    batch : sequence of int
        Flares of this launch.
    first : bool
        Whether nulls shared by all batches are counted in this one.
    """
    asked = [hypotheses.statistic(name) for name in hypotheses.statistics]
    weighted, smoothed = _Rows(), _Rows()
    for scenario in range(1 + len(batch)):
        # The quiescent draws meet every flare's shape, each flare only its own.
        shapes = [flare for i, flare in enumerate(batch) if scenario in (0, i + 1)]
        # Those that look for a shape come first: the kernel sums the first row on its way. Sums of elements come last.
        for one in sorted(asked, key=lambda s: (s.by_element, not s.shaped)):
            if one.by_element:
                weighted.end_pixels()
            for flare in shapes if one.shaped else [0]:
                looked_for = hypotheses.shape(one.name, flare)
                if isinstance(one, LinearStatistic):
                    weighted.add(one.name, scenario, flare, one.weights_per_dn(hypotheses.setting, looked_for))
                elif isinstance(one, QuadraticStatistic) and one.kernel_sum is not None:
                    for number, own in enumerate(one.subtracted_rows(hypotheses.setting)):
                        weighted.add(one.name, scenario, number, own)
                elif isinstance(one, Paper):
                    smoothed.add(one.name, scenario, flare, one.scale(hypotheses.setting, looked_for))
        weighted.end()
        smoothed.end()
    n_scenario, fixed = 1 + len(batch), len(FIXED_STATISTICS)

    def row(one: Statistic, scenario: int, flare: int) -> int:
        if one.kernel_sum is not None:
            return fixed * scenario + FIXED_STATISTICS.index(one.kernel_sum)
        where = one.name, scenario, flare if one.shaped else 0
        if isinstance(one, LinearStatistic):
            return fixed * n_scenario + weighted.places[where]
        return fixed * n_scenario + len(weighted.rows) + smoothed.places[where]

    nuisances = hypotheses.setting.nuisances
    subtractions = []
    for one in asked if nuisances else []:
        for scenario in range(n_scenario) if one.kernel_sum is not None else []:
            begin = fixed * n_scenario + weighted.places[one.name, scenario, 0]
            subtractions.append((row(one, scenario, 0), begin, begin + len(nuisances.names if nuisances else ())))
    grids: list[Grid] = []
    keys: list[Key] = []

    def add(one: Statistic, role: Role, flare: int, channel: int, shape: Form) -> None:
        grids.append(Grid(channel, shape.mean, shape.std))
        keys.append((one.name, role, flare))

    for one in asked:
        if first and not one.shaped:
            add(one, "null", 0, row(one, 0, 0), hypotheses.closed_form(one.name))
        for i, flare in enumerate(batch):
            null = hypotheses.closed_form(one.name, template=flare)
            if one.shaped:
                add(one, "null", flare, row(one, 0, flare), null)
            channel = row(one, i + 1, flare)
            add(one, "flare_on_null_grid", flare, channel, null)
            add(one, "flare", flare, channel, hypotheses.closed_form(one.name, flare))
    weights = np.zeros((len(weighted.rows), len(hypotheses.scene.pixels)), np.float32)
    weights[:, : hypotheses.scene.n_pixel] = np.array(weighted.rows).reshape(len(weights), hypotheses.scene.n_pixel)
    scales = np.array(smoothed.rows, np.float32) if smoothed.rows else np.zeros((0, 1), np.float32)
    ends = (np.array(places, np.uint32) for places in (weighted.ends, weighted.pixels_end, smoothed.ends))
    linear_end, pixels_end, scale_end = ends
    taken = np.array(subtractions, np.uint32).reshape(len(subtractions), 3).T
    return ChannelPlan(weights, linear_end, pixels_end, scales, scale_end, grids, keys, taken)
