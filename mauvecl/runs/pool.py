"""Many engines as one: requests cut into shards, counted by whoever is free, kept as they come, added up exactly."""

from __future__ import annotations

import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from numpy.typing import NDArray

from mauvecl.device.engine import DeviceError, DeviceRecord, Engine
from mauvecl.device.stares import Stares
from mauvecl.device.tiles import Progress
from mauvecl.host.arguments import public
from mauvecl.host.errors import InputError
from mauvecl.host.quantities import count as whole
from mauvecl.lightcurve.stares.requests import StaresRequest, StareSums
from mauvecl.results.requests.requests import DetectRequest, RealiseRequest, Shard, SnrRequest
from mauvecl.results.sums import Arrays, DetectionSums, SnrSums
from mauvecl.runs.shards import Task, fingerprint, shards

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.results.detection.detection import Detection
    from mauvecl.results.snr import SnrResult
    from mauvecl.runs.checkpoint import Checkpoint

#: A shard is tried so often before the run ends with what went wrong.
TRIES = 3
#: Shards under way for each worker: one in hand and one waiting.
AHEAD = 2
#: Items of `together` under way beyond the workers: what one needs is prepared while the devices count others.
PREPARED = 1


Divided = DetectRequest | SnrRequest | StaresRequest
Sums = DetectionSums | SnrSums | StareSums
Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Stopped(Exception):  # noqa: N818
    """Raised between two tiles of a shard that nobody waits for any longer."""


class Workers(Protocol):
    """Who counts shards."""

    @property
    def count(self) -> int:
        """How many work at the same time."""

    @property
    def retries(self) -> int:
        """Shards that had to be counted again so far."""

    @property
    def first(self) -> Engine | None:
        """An engine of this process, for what is not divided."""

    def describe(self) -> list[DeviceRecord]:
        """The devices, for run records."""

    def submit(self, task: Task) -> Future[Arrays]:
        """Have a shard counted."""

    def stop(self) -> None:
        """End what is under way as soon as may be."""

    def close(self) -> None:
        """Let go of everything."""


@public
class LocalWorkers:
    """The OpenCL devices of this machine, in a thread each.

    Parameters
    ----------
    devices : sequence of str or None
        As `Engine` takes them.
    make : callable, optional
        Makes an engine from a device and a progress callback, for tests.
    """

    def __init__(self, devices: Sequence[str | None] = (None,), *, make: Callable[..., Engine] = Engine) -> None:
        self._make, self._devices, self.retries = make, list(devices), 0
        self._ticks: list[Callable[[int], None] | None] = [None] * len(devices)
        self._stopping = False
        self._engines: list[Engine] = [self._made(place) for place in range(len(devices))]
        self._free = list(range(len(devices)))
        self._threads = ThreadPoolExecutor(len(devices))
        self._lock = threading.Lock()

    def _made(self, place: int) -> Engine:
        return self._make(self._devices[place], progress=partial(self._tick, place))

    def _tick(self, place: int, done: int, total: int) -> None:
        if self._stopping:
            raise Stopped
        tick = self._ticks[place]
        if tick is not None:
            tick(done)

    @property
    def count(self) -> int:
        """Devices."""
        return len(self._engines)

    @property
    def first(self) -> Engine:
        """The first device's engine."""
        return self._engines[0]

    def describe(self) -> list[DeviceRecord]:
        """The devices."""
        return [engine.device for engine in self._engines]

    def submit(self, task: Task) -> Future[Arrays]:
        """Count a shard, as soon as a device is free."""
        return self._threads.submit(self._count, task)

    def _count(self, task: Task) -> Arrays:
        with self._lock:
            place = self._free.pop(0)
        self._ticks[place] = task.tick
        try:
            for tried in range(1, TRIES + 1):
                try:
                    return self._engines[place].count(task.request, task.shard, out=task.out)
                except Exception as error:
                    engine = self._engines[place]
                    launch = isinstance(error, engine.opened.cl.Error)
                    if not launch or self._stopping:
                        raise
                    if tried == TRIES:
                        raise DeviceError(
                            f"{engine.device_name} failed {TRIES} times at {task.shard} ({error}), expected a device "
                            "that works"
                        ) from error
                    with self._lock:
                        self.retries += 1
                    # Nothing of a failed launch is trusted: a new context, and the shard from its beginning.
                    self._engines[place] = self._made(place)
            raise AssertionError
        finally:
            self._ticks[place] = None
            with self._lock:
                self._free.append(place)

    def stop(self) -> None:
        """End what is under way between two tiles."""
        self._stopping = True

    def close(self) -> None:
        """Let the threads go."""
        self._threads.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class Standing:
    """How far the work is.

    Attributes
    ----------
    done, total : int
        Realisations, of all requests known or announced.
    shards, of : int
        Shards done, of all requests known.
    retries : int
        Shards that were counted again, because a device failed or a worker died.
    resumed : int
        Of the realisations done, those taken from a checkpoint.
    """

    done: int
    total: int
    shards: int
    of: int
    retries: int
    resumed: int


@public
class Pool:
    """Answers what an `Engine` answers, with all workers, and the same to the last bit.

    Parameters
    ----------
    workers : Workers, optional
        The default device of this machine unless told otherwise.
    checkpoint : Checkpoint, optional
        Where shards are kept, and looked for.
    progress : callable, optional
        Called as ``progress(done, total)`` in realisations of all requests known so far; may raise to stop the work.
    meanwhile : callable, optional
        Done once, in a thread of its own, as soon as devices are busy: what would keep them waiting before.
    """

    def __init__(
        self,
        workers: Workers | None = None,
        *,
        checkpoint: Checkpoint | None = None,
        progress: Progress | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        if workers is not None and not hasattr(workers, "submit"):
            kind = type(workers).__name__
            raise InputError(f"the workers are of the type {kind}, expected LocalWorkers or DaskWorkers")
        self.workers = LocalWorkers() if workers is None else workers
        self._meanwhile = meanwhile
        self.checkpoint, self._progress = checkpoint, progress
        self._lock = threading.RLock()
        self._done = self._total = self._shards = self._of = self._resumed = self._expected = 0
        self._partly: dict[str, int] = {}
        self._stopping = False

    def expect(self, realisations: int) -> None:
        """Announce how much will be asked for, so that the time left can be told from the beginning."""
        self._expected = self._total + whole("realisations", realisations)

    def stop(self) -> None:
        """End everything that is under way, in other threads too."""
        self._stopping = True
        self.workers.stop()

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered in this process; empty where others draw."""
        first = self.workers.first
        return "" if first is None else first.kernel_digest

    @property
    def devices(self) -> list[DeviceRecord]:
        """Who counts."""
        return self.workers.describe()

    @property
    def standing(self) -> Standing:
        """How far the work is."""
        partly = sum(self._partly.values())
        total = max(self._total, self._expected)
        return Standing(self._done + partly, total, self._shards, self._of, self.workers.retries, self._resumed)

    def detect(self, quiet: Expectation, flares: Sequence[Expectation] | Expectation, **how: Any) -> Detection:
        """As `Engine.detect`, with the same keywords."""
        request = DetectRequest.of(quiet, flares, **how)
        sums = DetectionSums(request)
        self._add_up(request, sums)
        return sums.answer()

    def snr(self, expectation: Expectation, **how: Any) -> SnrResult:
        """As `Engine.snr`, with the same keywords."""
        request = SnrRequest.of(expectation, **how)
        sums = SnrSums(request)
        self._add_up(request, sums)
        return sums.answer()

    def stares(self, request: StaresRequest) -> Arrays:
        """As `Stares.reduced`, of all stares of a request."""
        sums = StareSums(request)
        self._add_up(request, sums)
        return sums.answer()

    def realise(
        self, expectation: Expectation, *, count: int, out: NDArray[Any] | None = None, **how: Any
    ) -> NDArray[Any]:
        """As `Engine.realise`, with the same keywords, by one worker; several calls at a time keep all of them busy."""
        request = RealiseRequest.of(expectation, count, **how)
        task = Task(request, uuid.uuid4().hex, Shard(0, request.start, request.realisations), out=out)
        rows: NDArray[Any] = self.workers.submit(task).result()["rows"]
        if out is None or rows is out:
            return rows
        out[:] = rows
        return out

    def _add_up(self, request: Divided, sums: Sums) -> None:
        key = fingerprint(request)
        todo = shards(request)
        with self._lock:
            self._total += sum(shard.count for shard in todo)
            self._of += len(todo)
        self._told()
        waiting: dict[Future[Arrays], Task] = {}
        for shard in todo:
            task = Task(request, key, shard, partial(self._tick, f"{key}-{shard.name}"))
            known = None if self.checkpoint is None else self.checkpoint.get(task.name)
            if known is not None:
                sums.add(shard.part, known)
                self._finished(task, resumed=True)
                continue
            if self._stopping:
                raise Stopped
            while len(waiting) >= self.workers.count * AHEAD:
                self._collect(sums, waiting)
            waiting[self.workers.submit(task)] = task
        while waiting:
            self._collect(sums, waiting)

    def _collect(self, sums: Sums, waiting: dict[Future[Arrays], Task]) -> None:
        finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
        for future in finished:
            task = waiting.pop(future)
            counted = future.result()
            sums.add(task.shard.part, counted)
            if self.checkpoint is not None:
                self.checkpoint.put(task.name, counted)
            self._finished(task)

    def _tick(self, name: str, done: int) -> None:
        with self._lock:
            self._partly[name] = done
            aside, self._meanwhile = self._meanwhile, None
        if aside is not None:
            threading.Thread(target=aside, name="mauvecl-aside", daemon=True).start()
        self._told()

    def _finished(self, task: Task, *, resumed: bool = False) -> None:
        with self._lock:
            self._partly.pop(task.name, None)
            self._done += task.shard.count
            self._shards += 1
            self._resumed += task.shard.count if resumed else 0
        self._told()

    def _told(self) -> None:
        if self._progress is not None:
            standing = self.standing
            self._progress(standing.done, standing.total)


def together(engine: Engine | Pool | Stares, work: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
    """What `work` makes of each item, in their order; by a pool some at a time, so that devices need not wait."""
    if not isinstance(engine, Pool):
        yield from map(work, items)
        return
    ahead: deque[Future[Answer]] = deque()
    with ThreadPoolExecutor(engine.workers.count + PREPARED) as threads:
        try:
            for item in items:
                ahead.append(threads.submit(work, item))
                # No more answers wait for their turn than are worked on.
                if len(ahead) > engine.workers.count + PREPARED:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        except BaseException:
            for future in ahead:
                future.cancel()
            engine.stop()
            raise
