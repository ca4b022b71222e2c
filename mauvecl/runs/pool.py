"""Pools of engines that divide requests into shards and add up the counts exactly."""

from __future__ import annotations

import threading
import uuid
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from numpy.typing import NDArray

from mauvecl.detection.detection import Detection, detection_of
from mauvecl.detection.requests import DetectRequest, RealiseRequest, Shard, SnrRequest
from mauvecl.detection.snr import SnrResult, counts_of
from mauvecl.device.engine import DeviceError, DeviceRecord, Engine
from mauvecl.device.launches import Progress
from mauvecl.host.arrays import Arrays, map_in_threads
from mauvecl.runs.checkpoint import Checkpoint, ShardLost, Stopped, Task, fingerprint, shards
from mauvecl.schema.calls import validated
from mauvecl.schema.fields import Range, Realisations

if TYPE_CHECKING:
    from mauvecl.device.stares import Stares
    from mauvecl.flares.stare_scene import StaresRequest
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.cluster import DaskWorkers

#: Number of failures at a shard after which the run fails; a shrinking cluster may lose several workers at once.
MAX_FAILURES = 8
#: Submitted shards per worker: one being counted and one waiting.
SHARDS_PER_WORKER = 2
#: Time after which the workers are counted again even if no shard is finished, s.
RECOUNT_S = 5.0
#: Items of `map_in_order` in progress beyond the number of workers, which are prepared while devices count others.
PREPARED = 1

Item = TypeVar("Item")
Answer = TypeVar("Answer")


@validated
class LocalWorkers:
    """OpenCL devices of this machine, each used by one thread.

    Parameters
    ----------
    devices : sequence of str or None
        Devices as for `Engine`.
    make : callable, optional
        Factory of engines from a device and a progress callback, for tests.
    """

    def __init__(self, devices: Sequence[str | None] = (None,), *, make: Callable[..., Engine] = Engine) -> None:
        self._make, self._devices = make, list(devices)
        self._stopping = False
        # The task that a thread counts.
        self._current = threading.local()
        self._engines: list[Engine] = [make(device, progress=self._report_progress) for device in devices]
        self._free: SimpleQueue[int] = SimpleQueue()
        for place in range(len(devices)):
            self._free.put(place)
        self._threads = ThreadPoolExecutor(len(devices))

    def _report_progress(self, done: int, total: int) -> None:
        if self._stopping:
            raise Stopped
        self._current.task.tick(done)

    @property
    def count(self) -> int:
        """Number of devices."""
        return len(self._engines)

    @property
    def first(self) -> Engine:
        """Engine of the first device."""
        return self._engines[0]

    def describe(self) -> list[DeviceRecord]:
        """Return the devices, for run records."""
        return [engine.device for engine in self._engines]

    def submit(self, task: Task) -> Future[Arrays]:
        """Count a shard as soon as a device is free; the future raises `ShardLost` if another attempt may succeed."""
        return self._threads.submit(self._count, task)

    def _count(self, task: Task) -> Arrays:
        """Count a shard with a free engine, which a failure replaces by a new one."""
        if self._stopping:
            raise Stopped
        place, self._current.task = self._free.get(), task
        engine = self._engines[place]
        try:
            return engine.count(task.request, task.shard, out=task.out)
        except engine.open_device.cl.Error as error:
            if self._stopping:
                raise
            # A failed launch may have corrupted the context.
            self._engines[place] = self._make(self._devices[place], progress=self._report_progress)
            raise ShardLost(f"{engine.device_name}: {error}") from error
        finally:
            self._free.put(place)

    def stop(self) -> None:
        """Stop work in progress between two tiles."""
        self._stopping = True

    def close(self) -> None:
        """Stop work in progress, and the threads."""
        self.stop()
        # A future that the executor cancels would not wake those who wait for it; `_count` ends them instead.
        self._threads.shutdown(wait=True)


@dataclass
class PoolProgress:
    """Progress of a pool."""

    done: int = 0  # realisations
    total: int = 0  # realisations of all known or announced requests
    shards: int = 0  # counted shards
    of: int = 0  # shards of all known requests
    retries: int = 0  # shards that were counted again, because a device failed or a worker died
    resumed: int = 0  # realisations taken from a checkpoint


@validated
class Pool:
    """Several workers with the interface of an `Engine`, which return bit-identical results.

    Parameters
    ----------
    workers : LocalWorkers or DaskWorkers, optional
        The default is the default device of this machine.
    checkpoint : Checkpoint, optional
        Checkpoint from which shards are read and to which they are written.
    progress : callable, optional
        Called as ``progress(done, total)`` in realisations of all known requests; may raise to stop the work.
    meanwhile : callable, optional
        Function called once in a separate thread as soon as the devices are busy.
    """

    def __init__(
        self,
        workers: LocalWorkers | DaskWorkers | None = None,
        *,
        checkpoint: Checkpoint | None = None,
        progress: Progress | None = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        self.workers = LocalWorkers() if workers is None else workers
        self.checkpoint, self._progress, self._meanwhile = checkpoint, progress, meanwhile
        self._lock = threading.RLock()
        # Finished shards; counted realisations of others, by the names of their tasks; and the announced total.
        self._finished, self._partly, self._expected = PoolProgress(), dict[str, int](), 0
        self._stopping = False

    def expect(self, realisations: Annotated[int, Range(0)]) -> None:
        """Announce a number of further realisations, for an estimate of the remaining time; the largest total holds."""
        self._expected = max(self._expected, self._finished.total + realisations)

    def stop(self) -> None:
        """Stop all work in progress, including that of other threads."""
        self._stopping = True
        self.workers.stop()

    @property
    def kernel_digest(self) -> str:
        """Short SHA-256 of the kernels rendered in this process; empty if only other processes draw."""
        first = self.workers.first
        return "" if first is None else first.kernel_digest

    @property
    def devices(self) -> list[DeviceRecord]:
        """Devices of all workers."""
        return self.workers.describe()

    @property
    def standing(self) -> PoolProgress:
        """Progress of the work."""
        done = self._finished.done + sum(self._partly.values())
        return replace(self._finished, done=done, total=max(self._finished.total, self._expected))

    def detect(self, quiet: Expectation, flares: Sequence[Expectation] | Expectation, **how: Any) -> Detection:
        """Compute a detection; parameters as for `Engine.detect`."""
        request = DetectRequest.of(quiet, flares, **how)
        tallies = [plan.tally() for plan in request.plans]
        self._add_up(request, lambda part, shard: tallies[part].merge(shard))
        return detection_of(request, tallies)

    def snr(self, expectation: Expectation, **how: Any) -> SnrResult:
        """Compute distributions of the S/N; parameters as for `Engine.snr`."""
        request = SnrRequest.of(expectation, **how)
        counts = counts_of(request)
        self._add_up(request, lambda _, shard: counts.merge(shard))
        return SnrResult(request.expectation, request.scene, counts)

    def stares(self, request: StaresRequest) -> Arrays:
        """Reduce all stares of a request; see `Stares.reduced`."""
        from mauvecl.flares.stare_scene import joined

        by_start: dict[int, Arrays] = {}
        self._add_up(request, lambda _, shard: by_start.update({int(shard["start"]): shard}))
        return joined(request, [by_start[start] for start in sorted(by_start)])

    def realise(
        self, expectation: Expectation, *, count: Realisations, out: NDArray[Any] | None = None, **how: Any
    ) -> NDArray[Any]:
        """Draw raw spectra with one worker; parameters as for `Engine.realise`.

        Concurrent calls use several workers.
        """
        request = RealiseRequest.of(expectation, count, **how)
        task = Task(request, uuid.uuid4().hex, Shard(0, request.start, request.realisations), out=out)
        ((_, drawn),) = self._counted([task])
        rows: NDArray[Any] = drawn["rows"]
        if out is None or rows is out:
            return rows
        out[:] = rows
        return out

    def _add_up(self, request: DetectRequest | SnrRequest | StaresRequest, add: Callable[[int, Arrays], None]) -> None:
        """Count all shards of a request, and call `add` with the part of each and its arrays."""
        key, todo = fingerprint(request), shards(request)
        with self._lock:
            self._finished.total += sum(shard.count for shard in todo)
            self._finished.of += len(todo)
        self._report_progress()

        def missing() -> Iterator[Task]:
            """Add shards of the checkpoint, and yield the others."""
            for shard in todo:
                task = Task(request, key, shard, partial(self._tick, f"{key}-{shard.name}"))
                resumed = None if self.checkpoint is None else self.checkpoint.get(task.name)
                if resumed is None:
                    yield task
                else:
                    add(shard.part, resumed)
                    self._finish(task, resumed=True)

        for task, counted in self._counted(missing()):
            add(task.shard.part, counted)
            if self.checkpoint is not None:
                self.checkpoint.put(task.name, counted)
            self._finish(task)

    def _counted(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Arrays]]:
        """Count tasks with all workers, and yield them with their arrays, in the order in which they are finished."""
        waiting: dict[Future[Arrays], Task] = {}
        failures: Counter[str] = Counter()
        todo = iter(tasks)
        while True:
            for task in islice(todo, max(self.workers.count * SHARDS_PER_WORKER - len(waiting), 0)):
                if self._stopping:
                    raise Stopped
                waiting[self.workers.submit(task)] = task
            if not waiting:
                return
            # The number of workers may change while no shard is finished.
            for future in wait(waiting, RECOUNT_S, FIRST_COMPLETED).done:
                task = waiting.pop(future)
                try:
                    counted = future.result()
                except ShardLost as lost:
                    failures[task.name] += 1
                    if failures[task.name] >= MAX_FAILURES:
                        fault = f"{task.shard} failed {MAX_FAILURES} times, the last time with: {lost}"
                        raise DeviceError(fault, "failed") from lost
                    with self._lock:
                        self._finished.retries += 1
                    waiting[self.workers.submit(task)] = task
                else:
                    yield task, counted

    def _tick(self, name: str, done: int) -> None:
        """Note the counted realisations of a shard in progress; the first call starts `meanwhile`."""
        with self._lock:
            self._partly[name] = done
            meanwhile, self._meanwhile = self._meanwhile, None
        if meanwhile is not None:
            threading.Thread(target=meanwhile, name="mauvecl-meanwhile", daemon=True).start()
        self._report_progress()

    def _finish(self, task: Task, *, resumed: bool = False) -> None:
        """Note that a shard is counted, or `resumed` from the checkpoint."""
        with self._lock:
            self._partly.pop(task.name, None)
            self._finished.done += task.shard.count
            self._finished.shards += 1
            self._finished.resumed += task.shard.count if resumed else 0
        self._report_progress()

    def _report_progress(self) -> None:
        if self._progress is not None:
            standing = self.standing
            self._progress(standing.done, standing.total)


def map_in_order(
    engine: Engine | Pool | Stares | None, work: Callable[[Item], Answer], items: Iterable[Item]
) -> Generator[Answer]:
    """Apply `work` to items and yield the results in order; with a pool, several items are in progress at once."""
    if not isinstance(engine, Pool):
        yield from map(work, items)
        return
    yield from map_in_threads(work, items, engine.workers.count + PREPARED, engine.stop)
