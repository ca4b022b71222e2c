"""What is asked of an engine, as data: no answer, no counts. A worker anywhere makes the same of it.

A share is a range of realisations of one part of a request. What is counted of it holds whole numbers, and extremes
with their realisations, so that shares may be counted in any order, on any device, and twice; `sums` adds them up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self

from mauvecl.host.expectation import Expectation
from mauvecl.noise.comparison import TEMPLATE, Comparison
from mauvecl.noise.drawing import AUTOMATIC, Drawing, DrawingWords
from mauvecl.noise.scene import BATCH, Scene, prepare
from mauvecl.results.channels import ChannelPlan, plan_channels
from mauvecl.results.fap import Tails
from mauvecl.results.hypotheses import Hypotheses
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.names import USUAL_STATISTICS
from mauvecl.statistics.nuisances import Nuisances, known


@dataclass(frozen=True)
class Share:
    """Realisations start to start + count - 1 of one part of a request."""

    part: int
    start: int
    count: int

    @property
    def name(self) -> str:
        """For files and messages."""
        return f"{self.part}-{self.start}-{self.count}"


class _Asked:
    """What travels to a worker: the question without anything made of it."""

    @classmethod
    def of(cls, *what: Any, **how: Any) -> Self:
        """With the fields of a `Drawing` among the keywords."""
        words = {name: how.pop(name) for name in DrawingWords.__annotations__ if name in how}
        return cls(*what, **how | {"drawing": Drawing(**words)})

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class DetectRequest(_Asked):
    """What `Engine.detect` takes; parameters as there."""

    quiet: Expectation
    flares: tuple[Expectation, ...]
    realisations: int
    seed: int
    statistics: Sequence[str | Linear] = USUAL_STATISTICS
    start: int = 0
    drawing: Drawing = AUTOMATIC
    comparison: Comparison = TEMPLATE
    tails: Tails = "counted"
    nuisances: Nuisances | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "nuisances", known(self.nuisances, self.quiet))

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """What is drawn, and what is computed of it."""
        scene = prepare([self.quiet, *self.flares], self.drawing, comparison=self.comparison)
        nuisances = known(self.nuisances, self.quiet)
        return Hypotheses(self.quiet, self.flares, self.statistics, scene, nuisances=nuisances)

    @cached_property
    def plans(self) -> list[tuple[ChannelPlan, Scene]]:
        """What each part's launches compute: as many flares at a time as one launch holds."""
        scene, count = self.hypotheses.scene, len(self.flares)
        size = BATCH[scene.frames] - 1
        batches = [range(i, min(i + size, count)) for i in range(0, count, size)] or [range(0)]
        return [
            (plan_channels(self.hypotheses, batch, first=number == 0), scene.part([0, *(k + 1 for k in batch)]))
            for number, batch in enumerate(batches)
        ]

    @property
    def parts(self) -> int:
        """Launches of different kind."""
        return len(self.plans)

    @property
    def work(self) -> int:
        """Pixels times scenarios."""
        return self.hypotheses.scene.n_pixel * max(len(scene.levels) for _, scene in self.plans)


@dataclass(frozen=True, eq=False)
class SnrRequest(_Asked):
    """What `Engine.snr` takes; parameters as there."""

    expectation: Expectation
    realisations: int
    seed: int
    start: int = 0
    drawing: Drawing = AUTOMATIC

    parts = 1

    @cached_property
    def scene(self) -> Scene:
        """What is drawn."""
        return prepare([self.expectation], self.drawing)

    @property
    def work(self) -> int:
        """Pixels."""
        return self.scene.n_pixel


@dataclass(frozen=True, eq=False)
class RealiseRequest(_Asked):
    """What `Engine.realise` takes; parameters as there. One share: callers ask for as much as travels well."""

    expectation: Expectation
    realisations: int
    seed: int
    start: int = 0
    drawing: Drawing = AUTOMATIC


#: What is cut into shares: its `work` is about pixels times scenarios of one realisation.
Request = DetectRequest | SnrRequest
#: What a worker can be asked.
Countable = Request | RealiseRequest
