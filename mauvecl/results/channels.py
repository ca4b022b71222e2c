"""What one launch computes for a batch of flares: weights, scales and the grids that count each statistic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise.layout import FIXED_STATISTICS
from mauvecl.results.tally import Grid, TailSamples
from mauvecl.statistics.definitions import SHAPED, Normal, QuadraticForm

if TYPE_CHECKING:
    from mauvecl.results.detection import Detection

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
    scales : ndarray of float32, shape (n_smoothed, n_centre)
        Of the statistic `paper`; see `smoothing.Smoothing`.
    scale_end : ndarray of uint32, shape (n_scenario,)
    grids : list of Grid
    keys : list of (statistic, role, flare)
        What each grid holds.
    """

    weights: NDArray[np.float32]
    linear_end: NDArray[np.uint32]
    scales: NDArray[np.float32]
    scale_end: NDArray[np.uint32]
    grids: list[Grid]
    keys: list[Key]

    def tails(self) -> list[TailSamples | None]:
        """What keeps the extremes of each grid: a null's largest values, a flare's smallest."""
        kinds: dict[Role, bool] = {"null": True, "flare": False}
        return [TailSamples(largest=kinds[role]) if role in kinds else None for _, role, _ in self.keys]

    @property
    def n_rows(self) -> int:
        """Channels."""
        return len(FIXED_STATISTICS) * len(self.linear_end) + len(self.weights) + len(self.scales)


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
    n_scenario, width = 1 + len(batch), len(result.scene.pixels)
    shared = [name for name in result.statistics if name not in (*FIXED_STATISTICS, *SHAPED)]
    rows: list[NDArray[np.float64]] = []
    scales: list[NDArray[np.float64]] = []
    ends = np.zeros((2, n_scenario), np.uint32)
    #: Where a statistic of a scenario is found, `SHAPED` ones by the flare looked for.
    place_of: dict[tuple[str, int, int], tuple[list[NDArray[np.float64]], int]] = {}
    for scenario in range(n_scenario):
        # The quiescent draws meet every flare's shape, each flare only its own.
        shapes = [flare for i, flare in enumerate(batch) if scenario in (0, i + 1)]
        wanted = [("matched", flare) for flare in shapes if "matched" in result.statistics]
        for name, flare in (*wanted, *((name, 0) for name in shared)):
            place_of[(name, scenario, flare)] = rows, len(rows)
            weights = result.weights(name, flare)
            assert weights is not None
            rows.append(weights)
        for flare in shapes if "paper" in result.statistics else ():
            place_of[("paper", scenario, flare)] = scales, len(scales)
            scales.append(result.smoothing.scale(result.flares[flare]))
        ends[:, scenario] = len(rows), len(scales)
    padded = np.zeros((len(rows), width), np.float32)
    padded[:, : result.scene.n_pixel] = np.array(rows).reshape(len(rows), result.scene.n_pixel)
    scaled = np.array(scales, np.float32) if scales else np.zeros((0, 1), np.float32)

    def row(statistic: str, scenario: int, flare: int) -> int:
        fixed = len(FIXED_STATISTICS)
        if statistic in FIXED_STATISTICS:
            return fixed * scenario + FIXED_STATISTICS.index(statistic)
        among, place = place_of[(statistic, scenario, flare if statistic in SHAPED else 0)]
        return fixed * n_scenario + place + (len(rows) if among is scales else 0)

    grids: list[Grid] = []
    keys: list[Key] = []

    def add(statistic: str, role: Role, flare: int, channel: int, shape: QuadraticForm | Normal) -> None:
        grids.append(Grid(channel, shape.mean, shape.std))
        keys.append((statistic, role, flare))

    for statistic in result.statistics:
        if first and statistic not in SHAPED:
            add(statistic, "null", 0, row(statistic, 0, 0), result.closed_form(statistic))
        for i, flare in enumerate(batch):
            null = result.closed_form(statistic, template=flare)
            if statistic in SHAPED:
                add(statistic, "null", flare, row(statistic, 0, flare), null)
            channel = row(statistic, i + 1, flare)
            add(statistic, "flare_on_null_grid", flare, channel, null)
            add(statistic, "flare", flare, channel, result.closed_form(statistic, flare))
    return ChannelPlan(padded, ends[0], scaled, ends[1], grids, keys)
