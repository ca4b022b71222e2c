"""Plan of the channels that a launch computes for a batch of flares: weights, scales and histogram grids."""

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

#: Distributions: without a flare, with a flare in the bins of the null, with a flare in bins around its mean.
Role = Literal["null", "flare_on_null_grid", "flare"]
Key = tuple[str, Role, int]


@dataclass(frozen=True)
class ChannelPlan:
    """Channels that a launch computes for a batch of flares."""

    weights: NDArray[np.float32]  # shape (n_linear, n_padded)
    linear_end: NDArray[np.uint32]  # one past the last linear statistic of each scenario, shape (n_scenario,)
    # One past the last linear statistic with weights per pixel, shape (n_scenario,). Later ones have weights per
    # resolution element, stored at the element's last pixel.
    pixels_end: NDArray[np.uint32]
    scales: NDArray[np.float32]  # of the statistic `paper` (see `Smoothing`), shape (n_smoothed, n_centre)
    scale_end: NDArray[np.uint32]  # one past the last smoothed statistic of each scenario, shape (n_scenario,)
    grids: list[Grid]
    keys: list[Key]  # distribution that each grid counts
    # Row of chi-squared, and first and one past the last row whose squares are subtracted from it, shape (3, n).
    subtractions: NDArray[np.uint32]

    def tails(self) -> list[TailSamples | None]:
        """Return accumulators of each grid's extremes: the largest values of a null, the smallest of a flare."""
        kinds: dict[Role, bool] = {"null": True, "flare": False}
        return [TailSamples(largest=kinds[role]) if role in kinds else None for _, role, _ in self.keys]

    @property
    def n_rows(self) -> int:
        """Number of channels."""
        return len(FIXED_STATISTICS) * len(self.linear_end) + len(self.weights) + len(self.scales)


@dataclass(eq=False)
class _Rows:
    """Rows of weights of one kind, ordered by scenario."""

    rows: list[NDArray[np.float64]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)  # one past the last row of each scenario
    pixels_end: list[int] = field(default_factory=list)  # one past the last row with weights per pixel
    index: dict[tuple[str, int, int], int] = field(default_factory=dict)  # by statistic, scenario and template

    def add(self, statistic: str, scenario: int, flare: int, row: NDArray[np.float64]) -> None:
        self.index[statistic, scenario, flare] = len(self.rows)
        self.rows.append(row)

    def end_pixels(self) -> None:
        """End the rows of a scenario with weights per pixel."""
        self.pixels_end.append(len(self.rows))

    def end(self) -> None:
        """End a scenario."""
        if len(self.pixels_end) == len(self.ends):
            self.end_pixels()
        self.ends.append(len(self.rows))


def plan_channels(hypotheses: Hypotheses, batch: Sequence[int], *, first: bool) -> ChannelPlan:
    """Plan the channels of a batch of flares; scenario 0 is always the quiescent one.

    If `first`, the batch also counts the null distributions that all batches share.
    """
    asked = [hypotheses.statistic(name) for name in hypotheses.statistics]
    weighted, smoothed = _Rows(), _Rows()
    for scenario in range(1 + len(batch)):
        # Quiescent draws are compared with every flare's template, draws of a flare only with its own.
        shapes = [flare for i, flare in enumerate(batch) if scenario in (0, i + 1)]
        # Shaped statistics come first, since the kernel fuses the first row, and sums over elements last.
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
            return fixed * n_scenario + weighted.index[where]
        return fixed * n_scenario + len(weighted.rows) + smoothed.index[where]

    nuisances = hypotheses.setting.nuisances
    subtractions = []
    for one in asked if nuisances else []:
        for scenario in range(n_scenario) if one.kernel_sum is not None else []:
            begin = fixed * n_scenario + weighted.index[one.name, scenario, 0]
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
    ends = (np.array(ends, np.uint32) for ends in (weighted.ends, weighted.pixels_end, smoothed.ends))
    linear_end, pixels_end, scale_end = ends
    taken = np.array(subtractions, np.uint32).reshape(len(subtractions), 3).T
    return ChannelPlan(weights, linear_end, pixels_end, scales, scale_end, grids, keys, taken)
