"""Requests to an engine as plain data, from which every worker computes the same result.

A shard is a range of realisations of one part of a request. Its counts are integers, and its extreme values carry their
realisations, so shards can be counted in any order, on any device, and more than once; `sums` adds them up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, ClassVar, Protocol, Self

from mauvecl.host.expectation import Expectation
from mauvecl.noise.comparison import NOISE_FREE, Comparison
from mauvecl.noise.drawing import AUTOMATIC, Drawing, DrawingOptions
from mauvecl.noise.scene import BATCH, Scene, prepare
from mauvecl.results.requests.channels import ChannelPlan, plan_channels
from mauvecl.results.requests.fap_checks import Tails
from mauvecl.results.requests.hypotheses import Hypotheses
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import OneOrMore
from mauvecl.schema.physical import FirstRealisation, Realisations, Seed
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.names import DEFAULT_STATISTICS
from mauvecl.statistics.nuisances import Nuisances, as_nuisances


@dataclass(frozen=True)
class Shard:
    """Range of realisations, `start` to `start + count - 1`, of one part of a request."""

    part: int
    start: int
    count: int

    @property
    def name(self) -> str:
        """Name in files."""
        return f"{self.part}-{self.start}-{self.count}"

    def __str__(self) -> str:
        return f"realisations {self.start} to {self.start + self.count - 1}"


def check_last(start: int, realisations: int) -> None:
    """Raise InputError if the last realisation has no number of 63 bits."""
    if start + realisations >= 2**63:
        raise InputError.of("start", start, f"at most {2**63 - 1 - realisations} for {realisations} realisations")


class Countable:
    """Base class of requests, which are pickled without cached results."""

    least: ClassVar[int] = 2**12

    @classmethod
    def of(cls, *what: Any, **how: Any) -> Self:
        """Make a request from keywords that may include the fields of a `Drawing`."""
        words = {name: how.pop(name) for name in DrawingOptions.__annotations__ if name in how}
        return cls(*what, **how | {"drawing": Drawing(**words)})

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle: request fields only, no caches."""
        return {each.name: getattr(self, each.name) for each in fields(self)}  # type: ignore[arg-type]


class _RealisationRequest(Countable):
    """Base class of requests for realisations."""

    def __post_init__(self) -> None:
        check_last(vars(self)["start"], vars(self)["realisations"])


@validated
@dataclass(frozen=True, eq=False)
class DetectRequest(_RealisationRequest):
    """Arguments of `Engine.detect`."""

    quiet: Expectation
    flares: Annotated[tuple[Expectation, ...], OneOrMore((Expectation,))]
    realisations: Realisations
    seed: Seed
    statistics: Annotated[Sequence[str | Linear], OneOrMore((str, Linear))] = DEFAULT_STATISTICS
    start: FirstRealisation = 0
    drawing: Drawing = AUTOMATIC
    comparison: Comparison = NOISE_FREE
    tails: Tails = "counted"
    nuisances: Nuisances | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "nuisances", as_nuisances(self.nuisances, self.quiet))

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """Scene and statistics of the request."""
        scene = prepare([self.quiet, *self.flares], self.drawing, comparison=self.comparison)
        nuisances = as_nuisances(self.nuisances, self.quiet)
        return Hypotheses(self.quiet, self.flares, self.statistics, scene, nuisances=nuisances)

    @cached_property
    def plans(self) -> list[tuple[ChannelPlan, Scene]]:
        """Channels and scene of each part, with as many flares as a launch can process."""
        scene, count = self.hypotheses.scene, len(self.flares)
        size = BATCH[scene.frames] - 1
        batches = [range(i, min(i + size, count)) for i in range(0, count, size)] or [range(0)]
        return [
            (plan_channels(self.hypotheses, batch, first=number == 0), scene.part([0, *(k + 1 for k in batch)]))
            for number, batch in enumerate(batches)
        ]

    @property
    def parts(self) -> int:
        """Number of parts, whose launches differ."""
        return len(self.plans)

    @property
    def work(self) -> int:
        """Work per realisation: pixels times scenarios."""
        return self.hypotheses.scene.n_pixel * max(len(scene.levels) for _, scene in self.plans)


@validated
@dataclass(frozen=True, eq=False)
class SnrRequest(_RealisationRequest):
    """Arguments of `Engine.snr`."""

    expectation: Expectation
    realisations: Realisations
    seed: Seed
    start: FirstRealisation = 0
    drawing: Drawing = AUTOMATIC

    parts = 1

    @cached_property
    def scene(self) -> Scene:
        """Scene to draw."""
        return prepare([self.expectation], self.drawing)

    @property
    def work(self) -> int:
        """Work per realisation: pixels."""
        return self.scene.n_pixel


@validated
@dataclass(frozen=True, eq=False)
class RealiseRequest(_RealisationRequest):
    """Arguments of `Engine.realise`, computed as a single shard, so callers limit the number of realisations."""

    expectation: Expectation
    realisations: Realisations
    seed: Seed
    start: FirstRealisation = 0
    drawing: Drawing = AUTOMATIC


class Divisible(Protocol):
    """Request that can be divided into shards.

    Attributes
    ----------
    realisations, start : int
    parts : int
        Number of parts, whose launches differ.
    work : int
        Approximate work per realisation: pixels times scenarios.
    least : int
        Smallest number of realisations of a shard, a power of two.
    """

    @property
    def realisations(self) -> int: ...
    @property
    def start(self) -> int: ...
    @property
    def parts(self) -> int: ...
    @property
    def work(self) -> int: ...
    @property
    def least(self) -> int: ...
