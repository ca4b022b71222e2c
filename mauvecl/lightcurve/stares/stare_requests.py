"""Requests for stares, which are split into shards, drawn and reduced by workers, and joined exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.frame_components import Components
from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.lightcurve.stares.stare_scene import Flares
from mauvecl.noise.processes import NONE, Processes
from mauvecl.results.requests.requests import Countable
from mauvecl.schema.calls import validated
from mauvecl.schema.fields import Range
from mauvecl.schema.physical import Realisations, Seed

Arrays = dict[str, NDArray[Any]]
Method = Literal["pixels", "cumulants"]
StareNumber = Annotated[int, Range(0, 2**64 - 1)]

#: Approximate cost of reducing a frame of a scenario by Fourier transforms, in draws of a pixel.
REDUCED = 500


class Reduction(Protocol):
    """Reduction of stares to results: a frozen dataclass, which can be pickled and identified by its content.

    It is called as ``reduction(values, first)`` and returns arrays by name for stares from `first` on, which do not
    depend on each other. ``values`` are float32, (n_stare, n_frame, n_statistic), preceded by an
    axis of scenarios if there are several; they are valid only during the call. If the request has `glow`, it is
    called as ``reduction(values, first, glow)`` with an array of shape (n_stare, n_frame, n_statistic + 1).

    Attributes
    ----------
    adds : bool
        True if results are integers that are summed over stares. Otherwise, arrays are joined along their first axis,
        in the order of stares.
    """

    adds: ClassVar[bool]

    @property
    def __call__(self) -> Callable[..., Mapping[str, NDArray[Any]]]:
        """Reduce stares; see the class."""


@validated
@dataclass(frozen=True, eq=False)
class StaresRequest(Countable):
    """Request for stares; flares and amplitudes as for `Stares.frames`.

    Attributes
    ----------
    realisations : int
        Number of stares.
    start : int
        Number of the first stare.
    reduction : Reduction, optional
        By default, statistics are returned as they are.
    glow : bool
        Whether the reduction also receives the draws for flares that it adds: a standard normal per statistic, for
        their photon noise, and the factor on all light minus one.
    """

    components: Components
    stare: Stare
    realisations: Realisations
    seed: Seed
    flare: NDArray[Any] | None = None
    amplitudes: NDArray[Any] | None = None
    start: StareNumber = 0
    method: Method = "cumulants"
    processes: Processes = NONE
    reduction: Reduction | None = None
    glow: bool = False
    #: Number of the stare of the first row of flares and amplitudes, if these differ between stares.
    rows_from: int = field(init=False, default=0)

    parts = 1
    least: ClassVar[int] = 64

    def __post_init__(self) -> None:
        if len(self.flares.given) > 1 or self.flares.amplitudes.shape[1] > 1:
            object.__setattr__(self, "rows_from", self.start)

    @cached_property
    def flares(self) -> Flares:
        """Flares of all stares."""
        return Flares.of(self.components, self.stare, self.flare, self.amplitudes, self.realisations)

    @property
    def work(self) -> int:
        """Approximate cost of a stare, in draws of a pixel."""
        drawn = (
            self.components.quiet.wavelength_nm.size if self.method == "pixels" else 4 * self.components.n_statistics
        )
        return self.stare.n_frames * (drawn + len(self.flares.amplitudes) * (REDUCED if self.reduction else 0))


@dataclass(frozen=True)
class KeepStatistics:
    """Reduction that returns the statistics as they are."""

    adds: ClassVar[bool] = False

    def __call__(self, values: NDArray[np.float32], first: int) -> Arrays:
        """Return one row per stare, with scenarios on the second axis."""
        return {"values": np.moveaxis(values, 0, 1).copy() if values.ndim == 4 else values.copy()}


class StareSums:
    """Shards of a request that are finished."""

    def __init__(self, request: StaresRequest) -> None:
        self._adds = (request.reduction or KeepStatistics()).adds
        self._found: dict[int, Arrays] = {}

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard."""
        rest = dict(shard)
        self._found[int(rest.pop("start"))] = rest

    def answer(self) -> Arrays:
        """Return the result of all shards, in the order of stares."""
        return joined([self._found[start] for start in sorted(self._found)], adds=self._adds)


def joined(parts: list[Arrays], *, adds: bool) -> Arrays:
    """Join the parts of a request, which are in order."""
    together = (lambda arrays: np.sum(arrays, axis=0)) if adds else np.concatenate
    return {name: np.asarray(together([part[name] for part in parts])) for name in parts[0]}
