"""Background simulations: limited in number, one per visitor, and cancellable."""

from __future__ import annotations

import ctypes
import gc
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from mauvecl.device.engine import Engine
from mauvecl.runs.pool import LocalWorkers, Pool, Stopped

#: Simulations that a server computes at the same time; others wait.
TOGETHER = 2
#: Simulations that take longer, s, leave memory to release; that of a short one would stop all visitors for longer.
LONG_S = 1.0
_threads = ThreadPoolExecutor(TOGETHER, thread_name_prefix="mauvecl-page")
_per_thread = threading.local()
#: Uploads are read one after the other, outside the event loop.
_reader = ThreadPoolExecutor(1, thread_name_prefix="mauvecl-upload")


def reading(read: Callable[[], Any]) -> Future[Any]:
    """Read an upload in the background."""
    return _reader.submit(read)


class Cancelled(Exception):  # noqa: N818
    """Cancellation by the visitor."""


def _set_pending(thread: int, error: type[BaseException] | None) -> None:
    """Set the exception that a thread raises at its next bytecode, or clear a pending one."""
    given = None if error is None else ctypes.py_object(error)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), given)


def _engine(progress: Callable[[int, int], None]) -> Engine:
    """Return this thread's engine, which reports the progress of this job from any thread."""
    if not hasattr(_per_thread, "engine"):
        listener = _per_thread.listener = [progress]
        _per_thread.engine = Engine(progress=lambda done, total: listener[0](done, total))
    _per_thread.listener[0] = progress
    engine: Engine = _per_thread.engine
    return engine


def limit_arenas() -> None:
    """Let the threads share two pools of glibc's malloc, since each pool keeps what its threads have freed."""
    change = getattr(ctypes.CDLL(None), "mallopt", None)
    if change is not None:
        # M_ARENA_MAX of glibc's malloc.h.
        change(-8, 2)


def release_memory() -> None:
    """Free what simulations leave: arrays in reference cycles, which Python finds late, and pages that malloc keeps."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@dataclass(eq=False)
class Job:
    """Simulation for a visitor.

    Parameters
    ----------
    ask : callable
        Computes the answer from a pool and, if there is a unit, a function that receives counts of it.
    drawing : bool
        Whether realisations are drawn. Such a job is cancelled between two tiles, others anywhere by an exception.
    unit : str
        Unit of the progress; realisations of the pool if empty.
    """

    ask: Callable[..., Any]
    drawing: bool = True
    unit: str = ""
    _cancelled: threading.Event = field(default_factory=threading.Event)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _thread: int | None = None
    _pool: Pool | None = None
    _started: float | None = None
    _counted: tuple[int, int] = (0, 0)
    _left_s: float = math.inf

    def __post_init__(self) -> None:
        self.future: Future[Any] = _threads.submit(self._run)

    def _run(self) -> Any:
        try:
            return self._run_cancellable()
        finally:
            if time.monotonic() - (self._started or math.inf) > LONG_S:
                release_memory()

    def _run_cancellable(self) -> Any:
        if not self.drawing:
            with self._lock:
                self._thread = threading.get_ident()
        try:
            return self._asked()
        except Stopped as error:
            raise Cancelled from error
        finally:
            # A pending interruption would otherwise reach the next work of this thread.
            with self._lock:
                if self._thread is not None:
                    _set_pending(self._thread, None)
                self._thread = None

    def _asked(self) -> Any:
        self._check()
        self._started = time.monotonic()
        workers = LocalWorkers([None], make=lambda device, progress: _engine(progress))
        self._pool = Pool(workers, progress=lambda done, total: self._check())
        return self.ask(self._pool, self._count) if self.unit else self.ask(self._pool)

    def _count(self, done: int, total: int) -> None:
        self._counted = done, total
        if self.drawing:
            self._check()

    def _check(self) -> None:
        if self._cancelled.is_set():
            raise Cancelled

    def cancel(self) -> None:
        """Cancel between tiles, outside of draws, or before the start."""
        with self._lock:
            again = self._cancelled.is_set()
            self._cancelled.set()
            if self._thread is not None and not again:
                _set_pending(self._thread, Cancelled)
        # Work that waits for fits in other threads is not interrupted: fits end between two of their draws.
        if self._pool is not None:
            self._pool.stop()
        self.future.cancel()

    @property
    def counts(self) -> tuple[int, int]:
        """Return the finished part and the total, or 0 if nothing is counted yet."""
        if self.unit:
            return self._counted
        standing = None if self._pool is None else self._pool.standing
        return (0, 0) if standing is None else (standing.done, standing.total)

    @property
    def share(self) -> float:
        """Return the share that is done."""
        done, total = self.counts
        return min(done / total, 1.0) if total else 0.0

    @property
    def words(self) -> str:
        """Return the progress in words; the estimated time never rises."""
        if self._started is None:
            return "waiting for its turn"
        (done, total), spent = self.counts, time.monotonic() - self._started
        if not total:
            return f"{spent:.0f} s"
        words = f"{done:,} of {total:,} {self.unit or 'realisations'}"
        if not 0 < done < total:
            return f"{words}, {spent:.0f} s"
        self._left_s = min(self._left_s, spent * (total - done) / done)
        return f"{words}, about {self._left_s:.0f} s left"
