"""What is asked of an engine as data, and the shares of an answer that add up exactly, wherever they were counted.

A share is a range of realisations of one part of a request. Its answer holds whole numbers, and extremes with their
realisations, so that shares may be counted in any order, on any device, and twice.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise.comparison import TEMPLATE, Comparison
from mauvecl.noise.processes import NONE, Processes
from mauvecl.noise.scene import BATCH, Mode, Recipe, Scene, prepare
from mauvecl.results.channels import ChannelPlan, plan_channels
from mauvecl.results.detection import Detection, Tails
from mauvecl.results.far import FarCounts
from mauvecl.results.snr import Counts, SnrResult, elements, observers
from mauvecl.results.tally import TailSamples, Tally
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.nuisances import Nuisances, known
from mauvecl.statistics.registry import USUAL_STATISTICS

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.host.expectation import Expectation

Arrays = dict[str, NDArray[Any]]

#: What a share holds, and how: raised with every change, so that none of an older form is ever added.
FORM = 2
#: Realisations times pixels times scenarios of one share, about: some seconds of a processor's work.
SHARE = 2**34
#: Shares of one part of a request, about, at most: larger requests have larger shares, so that one process can add up
#: what a thousand count.
MOST = 2**13


class Countable(Protocol):
    """What a worker can be asked."""

    def count(self, engine: Engine, part: int, start: int, count: int) -> Arrays:
        """One share, on an engine."""


class Request(Countable, Protocol):
    """What a pool divides among workers."""

    @property
    def parts(self) -> int:
        """Launches of different kind, each over all realisations."""

    @property
    def realisations(self) -> int:
        """Realisations from `start` on."""

    @property
    def start(self) -> int:
        """The first realisation."""

    @property
    def work(self) -> int:
        """Pixels times scenarios of one realisation, about."""

    def add(self, part: int, share: Arrays) -> None:
        """Add a share to the answer."""


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


def shares(request: Request) -> list[Share]:
    """All shares of a request: cut at multiples of a power of two, whatever counts them."""
    wanted = max(SHARE // request.work, request.realisations // MOST)
    size = 1 << max(wanted.bit_length() - 1, 12)
    first, end = request.start, request.start + request.realisations
    cuts = [first, *range(first - first % size + size, end, size), end]
    return [Share(part, a, b - a) for part in range(request.parts) for a, b in itertools.pairwise(cuts)]


@dataclass(frozen=True, eq=False)
class DetectRequest:
    """What `Engine.detect` takes; parameters as there."""

    quiet: Expectation
    flares: tuple[Expectation, ...]
    realisations: int
    seed: int
    statistics: Sequence[str | Linear] = USUAL_STATISTICS
    mode: Mode = "auto"
    start: int = 0
    processes: Processes = NONE
    recipe: Recipe = "auto"
    comparison: Comparison = TEMPLATE
    tails: Tails = "counted"
    nuisances: Nuisances | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "nuisances", known(self.nuisances, self.quiet))

    def __getstate__(self) -> dict[str, Any]:
        return _asked(self)

    @cached_property
    def answer(self) -> Detection:
        """Nothing counted yet."""
        how = {"processes": self.processes, "recipe": self.recipe, "comparison": self.comparison}
        scene = prepare([self.quiet, *self.flares], self.mode, **how)  # type: ignore[arg-type]
        asked = (self.realisations, self.tails, self.seed, known(self.nuisances, self.quiet))
        return Detection(self.quiet, self.flares, self.statistics, scene, *asked)

    @cached_property
    def plans(self) -> list[tuple[ChannelPlan, Scene]]:
        """What each part's launches compute: as many flares at a time as one launch holds."""
        scene, count = self.answer.scene, len(self.flares)
        size = BATCH[scene.frames] - 1
        batches = [range(i, min(i + size, count)) for i in range(0, count, size)] or [range(0)]
        return [
            (plan_channels(self.answer, batch, first=number == 0), scene.part([0, *(k + 1 for k in batch)]))
            for number, batch in enumerate(batches)
        ]

    @cached_property
    def _sums(self) -> list[tuple[Tally, list[TailSamples | None]]]:
        return [(Tally(plan.grids), plan.tails()) for plan, _ in self.plans]

    @property
    def parts(self) -> int:
        """Launches of different kind."""
        return len(self.plans)

    @property
    def work(self) -> int:
        """Pixels times scenarios."""
        return self.answer.scene.n_pixel * max(len(scene.levels) for _, scene in self.plans)

    def count(self, engine: Engine, part: int, start: int, count: int) -> Arrays:
        """One share, on an engine."""
        plan, _ = self.plans[part]
        tally, samples = Tally(plan.grids), plan.tails()
        engine.count_detection(self, part, start, count, tally, samples)
        share = _sparse("counts", tally.counts)
        share["sums"] = np.array([[str(value) for value in row] for row in tally.sums])
        share["n"] = np.array(tally.n)
        for number, far in enumerate(tally.far):
            found = far.found()
            if found.n or found.undefined:
                share |= _spread(f"far-{number}", found.keys, found.counts)
                share[f"far-{number}-sums"] = np.array([str(x) for x in (found.first, found.second, found.undefined)])
        for number, kept in enumerate(samples):
            if kept is not None:
                share[f"values-{number}"], share[f"realisations-{number}"] = kept.values, kept.realisations
        return share

    def add(self, part: int, share: Arrays) -> None:
        """Add a share; the answer has it once all have come."""
        tally, samples = self._sums[part]
        sums = np.array([[int(value) for value in row] for row in share["sums"]], object)
        tally.add(_dense("counts", share, tally.counts.shape), sums, int(share["n"]))
        for number, far in enumerate(tally.far):
            if f"far-{number}" in share:
                first, second, undefined = (int(value) for value in share[f"far-{number}-sums"])
                far.merge(FarCounts(*_gathered(f"far-{number}", share), first, second, undefined))
        for number, kept in enumerate(samples):
            if kept is not None:
                kept.merge(share[f"values-{number}"], share[f"realisations-{number}"])
        if tally.n == self.realisations:
            self.answer.collect(self.plans[part][0], tally, samples)


@dataclass(frozen=True, eq=False)
class SnrRequest:
    """What `Engine.snr` takes; parameters as there."""

    expectation: Expectation
    realisations: int
    seed: int
    mode: Mode = "auto"
    start: int = 0
    processes: Processes = NONE
    recipe: Recipe = "auto"

    parts = 1

    def __getstate__(self) -> dict[str, Any]:
        return _asked(self)

    @cached_property
    def answer(self) -> SnrResult:
        """Nothing counted yet."""
        x = self.expectation
        scene = prepare([x], self.mode, processes=self.processes, recipe=self.recipe)
        parts = elements(x)
        return SnrResult(x, scene, observers(x, scene), parts, Counts(scene.n_pixel, len(parts)))

    @property
    def work(self) -> int:
        """Pixels."""
        return self.answer.scene.n_pixel

    def count(self, engine: Engine, part: int, start: int, count: int) -> Arrays:
        """One share, on an engine."""
        counts = Counts(self.answer.scene.n_pixel, len(self.answer.elements))
        engine.count_snr(self, start, count, counts)
        share = _sparse("pixel", counts.pixel) | _sparse("element", counts.element)
        for name, far in counts.far.items():
            share |= _spread(f"far-{name}", far.keys, far.counts)
        return share | {"clipped": counts.clipped, "n": np.array(counts.n)}

    def add(self, part: int, share: Arrays) -> None:
        """Add a share."""
        counts = self.answer.counts
        pixel, element = _dense("pixel", share, counts.pixel.shape), _dense("element", share, counts.element.shape)
        counts.add(pixel, element, share["clipped"], int(share["n"]))
        for name, far in counts.far.items():
            far.add(*_gathered(f"far-{name}", share))


@dataclass(frozen=True, eq=False)
class RealiseRequest:
    """What `Engine.realise` takes; parameters as there. One share: callers ask for as much as travels well."""

    expectation: Expectation
    realisations: int
    seed: int
    mode: Mode = "auto"
    start: int = 0
    processes: Processes = NONE
    recipe: Recipe = "auto"
    first_frame: int = 0
    out: NDArray[Any] | None = None

    def count(self, engine: Engine, part: int, start: int, count: int) -> Arrays:
        """All of it, on an engine."""
        rows = engine.realise(
            self.expectation,
            start=start,
            count=count,
            seed=self.seed,
            mode=self.mode,
            processes=self.processes,
            recipe=self.recipe,
            first_frame=self.first_frame,
            out=self.out,
        )
        return {"rows": rows}


def _asked(request: Any) -> dict[str, Any]:
    """What travels to a worker: the question without anything made of it."""
    return {each.name: getattr(request, each.name) for each in fields(request)}


def _sparse(name: str, counts: NDArray[np.int64]) -> Arrays:
    """Steps from one bin that is not empty to the next, and what these hold, in as few bytes as they need."""
    where = np.flatnonzero(counts)
    return _spread(name, where, counts.ravel()[where])


def _spread(name: str, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> Arrays:
    """Counts of rising keys, of which only the first may be negative."""
    steps = np.diff(keys)
    return {f"{name}-first": keys[:1], f"{name}-steps": _narrow(steps), name: _narrow(counts)}


def _gathered(name: str, share: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys and counts."""
    first = share[f"{name}-first"]
    keys = np.cumsum(np.concatenate([first, share[f"{name}-steps"].astype(np.int64)]), dtype=np.int64)
    return keys, share[name].astype(np.int64)


def _narrow(values: NDArray[np.int64]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max(initial=0))))


def _dense(name: str, share: Arrays, shape: tuple[int, ...]) -> NDArray[np.int64]:
    counts = np.zeros(int(np.prod(shape)), np.int64)
    keys, found = _gathered(name, share)
    counts[keys] = found
    return counts.reshape(shape)


#: What describes an input and does not change a draw.
_TOLD = ("provenance", "messages")


def fingerprint(request: Request) -> str:
    """Sha256 of everything in a request that its answer depends on, to the last bit.

    Realisations are left out: the same shares are counted of more of them.
    """
    found = hashlib.sha256(f"form {FORM}".encode())
    _feed(found, request, leave=("realisations", "start", "tails"))
    return found.hexdigest()[:32]


def _feed(found: Any, value: Any, leave: tuple[str, ...] = ()) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        found.update(f"<{type(value).__name__}".encode())
        for each in fields(value):
            if each.name not in (*leave, *_TOLD):
                found.update(each.name.encode())
                _feed(found, getattr(value, each.name))
    elif isinstance(value, np.ndarray):
        found.update(f"<{value.dtype.str}{value.shape}".encode())
        found.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        for key in sorted(value):
            found.update(str(key).encode())
            _feed(found, value[key])
    elif isinstance(value, list | tuple):
        found.update(f"<{len(value)}".encode())
        for one in value:
            _feed(found, one)
    elif isinstance(value, float):
        found.update(value.hex().encode())
    else:
        # None, whole numbers, words.
        found.update(repr(value).encode())
