"""Stares as a request: cut into shards of stares, drawn and reduced by whoever is free, joined exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.components import Components
from mauvecl.lightcurve.stares.scene import Flares
from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.noise.processes import NONE, Processes
from mauvecl.results.requests.requests import Countable

Arrays = dict[str, NDArray[Any]]
Method = Literal["pixels", "cumulants"]

#: What becomes of a frame of a scenario costs about as much as drawing so many pixels of it: a search by Fourier
#: transforms.
REDUCED = 500


class Reduction(Protocol):
    """What is kept of stares: a frozen dataclass, so that it travels and can be told from others.

    It is called as ``reduction(values, first)``, and gives arrays by name for stares `first` and on, each looked at by
    itself. ``values`` are float32, (n_stare, n_frame, n_statistic), with scenarios one axis more in front; they are
    valid during the call. Where the request has `glow` it is called as ``reduction(values, first, glow)``, with another
    array of the shape (n_stare, n_frame, n_statistic + 1).

    Attributes
    ----------
    adds : bool
        Whether what is kept are whole numbers that add up over stares; otherwise arrays are joined along their first
        axis, stares in their order.
    """

    adds: ClassVar[bool]

    @property
    def __call__(self) -> Callable[..., Mapping[str, NDArray[Any]]]:
        """See the class."""


@dataclass(frozen=True, eq=False)
class StaresRequest(Countable):
    """What `Stares.frames` takes, and what is kept of it; flares and amplitudes as there, for all stares asked for.

    Attributes
    ----------
    realisations : int
        Stares.
    start : int
        Number of the first.
    reduction : Reduction, optional
        By default statistics are kept as they are.
    glow : bool
        Whether the reduction also takes what flares put into the frames need: a normal for each statistic, for their
        own photons, and the factor on all light as drawn, less one.
    """

    components: Components
    stare: Stare
    realisations: int
    seed: int
    flare: NDArray[Any] | None = None
    amplitudes: NDArray[Any] | None = None
    start: int = 0
    method: Method = "cumulants"
    processes: Processes = NONE
    reduction: Reduction | None = None
    glow: bool = False
    #: Where rows of flares and amplitudes are counted from, where they differ from stare to stare.
    rows_from: int = field(init=False, default=0)

    parts = 1
    least: ClassVar[int] = 64

    def __post_init__(self) -> None:
        if len(self.flares.given) > 1 or self.flares.amplitudes.shape[1] > 1:
            object.__setattr__(self, "rows_from", self.start)

    @cached_property
    def flares(self) -> Flares:
        """Of all its stares."""
        return Flares.of(self.components, self.stare, self.flare, self.amplitudes, self.realisations)

    @property
    def work(self) -> int:
        """About as many draws of a pixel as one stare costs."""
        drawn = (
            self.components.quiet.wavelength_nm.size if self.method == "pixels" else 4 * self.components.n_statistics
        )
        return self.stare.n_frames * (drawn + len(self.flares.amplitudes) * (REDUCED if self.reduction else 0))


@dataclass(frozen=True)
class Kept:
    """Statistics as they are."""

    adds: ClassVar[bool] = False

    def __call__(self, values: NDArray[np.float32], first: int) -> Arrays:
        """Rows of ``values``, one to a stare; scenarios come behind."""
        return {"values": np.moveaxis(values, 0, 1).copy() if values.ndim == 4 else values.copy()}


class StareSums:
    """What has come of a request so far."""

    def __init__(self, request: StaresRequest) -> None:
        self._adds = (request.reduction or Kept()).adds
        self._found: dict[int, Arrays] = {}

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard."""
        rest = dict(shard)
        self._found[int(rest.pop("start"))] = rest

    def answer(self) -> Arrays:
        """All of it, once all shards have come; stares in their order."""
        return joined([self._found[start] for start in sorted(self._found)], adds=self._adds)


def joined(parts: list[Arrays], *, adds: bool) -> Arrays:
    """Parts of a request, in order, as one."""
    together = (lambda arrays: np.sum(arrays, axis=0)) if adds else np.concatenate
    return {name: np.asarray(together([part[name] for part in parts])) for name in parts[0]}
