"""Dask workers of a pool: processes of this machine, or of an existing cluster."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pickle
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.detection.requests import Countable, Shard
from mauvecl.device.build import DeviceRecord
from mauvecl.device.drivers import THREADS, DeviceError
from mauvecl.host import VERSION
from mauvecl.host.arrays import Arrays
from mauvecl.host.tables.files import is_file, parsing, read_text
from mauvecl.runs.checkpoint import ShardLost, Stopped, Task, code_identity
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, missing_package, shortened

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as DaskFuture

    from mauvecl.device.engine import Engine

#: Timeouts of the scheduler and of the first worker, s.
PATIENCE_S, WORKER_PATIENCE_S = 30.0, 120.0
#: Interval between counts of the workers, s, and largest number of requests kept on the workers.
RECOUNT_S, MAX_REQUESTS = 5.0, 32


@dataclass(eq=False)
class _Attempt:
    """A shard that is awaited."""

    awaited: Future[Arrays]
    task: Task
    workers: list[str] | None  # those that may count it; None for all


@validated
class DaskWorkers:
    """Workers of a Dask cluster, each with its own engine.

    Parameters
    ----------
    where : str
        ``local:N`` for N processes of this machine; the address of a scheduler, such as ``tcp://host:8786``; or a
        scheduler file.
    device : str, optional
        Device of each worker, as for `Engine`.

    Raises
    ------
    DeviceError
        If no scheduler or worker answers, a worker has other code of mauvecl, or has no such device. Shards of workers
        with other code that join later are refused and counted again by others.
    """

    first: Engine | None = None

    def __init__(self, where: str, device: str | None = None) -> None:
        try:
            import distributed
        except ImportError as error:
            raise missing_package("dask", "a cluster", "cluster") from error
        self._where, self._device, self._sends = where, device, 0
        self._lock = threading.Lock()
        self._closing = False
        # Futures of requests by their keys, and of submitted tasks.
        self._given: dict[str, DaskFuture[Any]] = {}
        self._sent: dict[DaskFuture[Any], _Attempt] = {}
        # Addresses of workers with other code, which may have joined after the start.
        self._strangers: set[str] = set()
        with contextlib.ExitStack() as stack:
            self._client: Client = stack.enter_context(_client(where, distributed))
            try:
                self._client.wait_for_workers(1, timeout=WORKER_PATIENCE_S)
            except TimeoutError as error:
                raise DeviceError(
                    f"no worker of cluster {where} answered within {WORKER_PATIENCE_S:g} s: start one"
                ) from error
            introduced = self._client.run(_introduce, device, on_error="return")
            for worker, answer in introduced.items():
                if isinstance(answer, BaseException):
                    raise DeviceError(
                        f"worker {worker} needs mauvecl {VERSION} and OpenCL, but cannot use them ({answer})"
                    )
                if answer[0] != code_identity():
                    version, code = answer[0]
                    raise DeviceError(
                        f"worker {worker} has mauvecl {version} (code {code}), but needs {VERSION} "
                        f"(code {code_identity()[1]}) as here"
                    )
            self._open = stack.pop_all()
        self._devices = [record for _, record in introduced.values()]
        self._counted = len(introduced), time.monotonic()

    @property
    def count(self) -> int:
        """Recent number of workers; attempts whose workers have all left end, since Dask gives them to no others."""
        if time.monotonic() > self._counted[1] + RECOUNT_S:
            try:
                present = self._client.nthreads()
            except OSError as error:
                raise self._gone() from error
            self._counted = max(len(present), 1), time.monotonic()
            with self._lock:
                sent = [key for key, it in self._sent.items() if it.workers and not present.keys() & it.workers]
                left = [self._sent.pop(key) for key in sent]
            for attempt in left:
                attempt.awaited.set_exception(ShardLost("its workers have left", failed=False))
        return self._counted[0]

    def _gone(self) -> DeviceError:
        return DeviceError(f"the scheduler of cluster {self._where} ended before the work was done", "lost")

    def describe(self) -> list[DeviceRecord]:
        """Return the devices of the initial workers."""
        return self._devices

    def submit(self, task: Task) -> Future[Arrays]:
        """Submit a shard to any free worker; raw spectra are returned, and the task's `out` is not used."""
        awaited: Future[Arrays] = Future()
        with self._lock:
            if self._closing:
                awaited.set_exception(Stopped())
                return awaited
            self._sends += 1
            try:
                if task.key not in self._given:
                    # A task instead of scattered data, since the scheduler repeats it if its worker is lost. Bytes,
                    # because a worker with other code might read and write a request differently.
                    content, key = pickle.dumps(task.request), f"mauvecl-request-{task.key}-{self._sends}"
                    self._given[task.key] = self._client.submit(bytes, content, key=key)
                    if len(self._given) > MAX_REQUESTS:
                        del self._given[next(iter(self._given))]
                # Workers with our code; all if none has other code, or those with our code have left.
                present = self._client.nthreads() if self._strangers else ()
                ours = [worker for worker in present if worker not in self._strangers] or None
                attempt, key = _Attempt(awaited, task, ours), f"mauvecl-{task.name}-{self._sends}"
                given = self._given[task.key], task.shard, self._device
                sent = self._client.submit(_count, *given, key=key, workers=ours, pure=False)
            except (OSError, RuntimeError) as error:
                # Dask raises either if its client has lost the scheduler.
                awaited.set_exception(self._gone().with_traceback(error.__traceback__))
                return awaited
            self._sent[sent] = attempt
        sent.add_done_callback(partial(self._came, attempt))
        return awaited

    def _find_strangers(self) -> bool:
        """Ask all workers for their code, and return whether more of them have other code than before."""
        answers = self._client.run(code_identity, on_error="return")
        # A worker that leaves raises OSError.
        strangers = {
            worker for worker, code in answers.items() if not isinstance(code, OSError) and code != code_identity()
        }
        with self._lock:
            new = not strangers <= self._strangers
            self._strangers |= strangers
        return new

    def _came(self, attempt: _Attempt, sent: DaskFuture[Any]) -> None:
        with self._lock:
            if self._sent.pop(sent, None) is None:
                # The result is no longer needed.
                return
        try:
            attempt.awaited.set_result(self._sums(attempt, sent))
        except BaseException as error:
            # The connection may break between the end of a shard and the transfer of its counts.
            broken = self._gone().with_traceback(error.__traceback__)
            attempt.awaited.set_exception(broken if isinstance(error, OSError) else error)

    def _sums(self, attempt: _Attempt, sent: DaskFuture[Any]) -> Arrays:
        """Return the counts of a task that has ended, or raise why there are none."""
        if sent.status == "finished":
            answer: Any = None
            # Dask would wait until the task is repeated, which never happens if all workers that may do so have left;
            # it calls the functions of all finished tasks in one thread, so that every other shard would wait, too.
            while answer is None:
                with contextlib.suppress(TimeoutError):
                    answer = sent.result(timeout=RECOUNT_S)
                if answer is None and sent.status != "finished":
                    raise ShardLost("its worker has left with its counts", failed=False)
            # Workers with older code answer without theirs.
            if isinstance(answer, tuple) and answer[1] == code_identity():
                sums: Arrays = answer[0]
                return sums
        error = sent.exception() if sent.status == "error" else None
        if sent.status in ("finished", "error") and self._find_strangers():
            raise ShardLost("counted by a worker with other code", failed=False)
        if isinstance(error, InputError | DeviceError):
            # Another attempt would end as this one.
            raise DeviceError(f"cluster {self._where} failed at {attempt.task.shard}: {error}", "failed")
        if sent.status in ("cancelled", "lost") and self._client.status != "running":
            raise self._gone()
        with self._lock:
            # The next attempt sends the request again, which may be lost, too.
            self._given.pop(attempt.task.key, None)
        other = "workers with other code" if sent.status == "finished" else "workers that have left"
        raise ShardLost(f"cluster {self._where}: {error or other}")

    def stop(self) -> None:
        """Cancel submitted shards; workers of other machines complete the shard in progress."""
        with self._lock:
            self._closing = True
            sent, self._sent = self._sent, {}
        # Set the exception here, because neither Dask nor a cancelled future wakes concurrent.futures.wait.
        for attempt in sent.values():
            attempt.awaited.set_exception(Stopped())
        if sent:
            with contextlib.suppress(OSError, RuntimeError, TimeoutError):
                self._client.cancel(list(sent))
        # Kill workers of this machine, since completing a shard takes seconds.
        for nanny in getattr(self._client.cluster, "workers", {}).values():
            nanny.auto_restart = False
            if nanny.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)

    def close(self) -> None:
        """Stop work in progress, and disconnect from the workers; those of this machine end."""
        self.stop()
        self._given.clear()
        self._open.close()


@contextlib.contextmanager
def _client(where: str, distributed: Any) -> Iterator[Client]:
    """Connect to a cluster, starting it first if it is local."""
    import dask

    for name in LOGS:
        # Errors reach the user as exceptions.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    how: dict[str, Any]
    with contextlib.ExitStack() as stack:
        word, _, number = where.partition(":")
        if word == "local":
            if not (number.isdecimal() and len(number) <= 4 and 1 <= int(number) <= 1024):
                raise InputError.of("cluster", where, "local:N with N from 1 to 1024")
            # The pool counts failures and submits shards again, so that it can report them.
            how = {"distributed.scheduler.allowed-failures": 0, "distributed.admin.tick.limit": "1h"}
            # No HTTP pages, since they have no authentication.
            how |= {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
            stack.enter_context(dask.config.set(how | {"logging": dict.fromkeys(LOGS, "critical")}))
            cluster = stack.enter_context(_local_cluster(int(number), distributed))
            how = {"address": cluster, "security": cluster.security}
        elif "://" in where and _is_address(where):
            how = {"address": where}
        elif "://" not in where and is_file(Path(where)):
            with parsing(f"scheduler file {shortened(where)}", "give JSON"):
                scheduler = json.loads(read_text(Path(where), "scheduler file"))
            address = scheduler.get("address") if isinstance(scheduler, dict) else None
            if not (isinstance(address, str) and _is_address(address)):
                raise InputError(
                    f"scheduler file {shortened(where)} names no address: use one that Dask wrote", key="cluster"
                )
            how = {"scheduler_file": where}
        else:
            raise InputError.of("cluster", where, "local:N, an address such as tcp://host:8786, or a scheduler file")
        try:
            client = stack.enter_context(distributed.Client(**how, timeout=PATIENCE_S, set_as_default=False))
        except (OSError, ValueError, TimeoutError) as error:
            raise DeviceError(f"no scheduler answered at {where} within {PATIENCE_S:g} s: start one") from error
        yield client


def _local_cluster(n_workers: int, distributed: Any) -> Any:
    """Start workers on this machine, each with its share of the cores and with temporary certificates."""
    threads = max((os.cpu_count() or 1) // n_workers, 1)
    try:
        # A worker executes everything that the scheduler receives, so other users of the machine must not connect.
        security = distributed.Security.temporary()
    except ImportError as error:
        raise missing_package("cryptography", "a cluster of this machine", "cluster") from error
    return distributed.LocalCluster(
        n_workers=n_workers, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"}, security=security, preload=__name__, memory_limit=0,
        silence_logs=logging.CRITICAL, env=dict.fromkeys(THREADS, str(threads)),
    )  # fmt: skip


def _is_address(where: str) -> bool:
    """Return whether an address has a scheme of Dask, a host and a port."""
    found = re.fullmatch(r"(tcp|tls|ucxx?|wss?)://([\w.-]+|\[[\w:.%]+\]):(\d{1,5})/?", where, flags=re.ASCII)
    return found is not None and 0 < int(found[3]) < 2**16


LOGS = ("distributed", *(f"distributed.{part}" for part in ("client", "nanny", "worker", "scheduler", "core")))


# Functions below run on a worker.


def dask_setup(worker: Any) -> None:
    """Leave the run's process group, so that Ctrl-C does not reach workers; Dask calls this on local workers.

    Ignoring the signal would not suffice: LLVM sets its own handlers during a build, and the linker would be killed.
    """
    os.setpgid(0, 0)


_engine: Engine | None = None
_one_at_a_time = threading.Lock()


#: Requests by their bytes; each keeps what it has computed for earlier shards.
_request: Callable[[bytes], Countable] = lru_cache(maxsize=4)(pickle.loads)


def _engine_here(device: str | None, threads: int) -> Engine:
    """Return the worker's engine, with PoCL limited to the threads that Dask assigns."""
    from mauvecl.device.engine import Engine

    global _engine
    if _engine is None:
        for name in THREADS:
            os.environ.setdefault(name, str(threads))
        _engine = Engine(device)
    return _engine


def _introduce(device: str | None, dask_worker: Any = None) -> tuple[tuple[str, str], DeviceRecord]:
    with _one_at_a_time:
        return code_identity(), _engine_here(device, dask_worker.state.nthreads).device


def _count(content: bytes, shard: Shard, device: str | None) -> tuple[Arrays, tuple[str, str]]:
    """Return the counts of a shard, and the code that counted them."""
    from distributed import get_worker

    with _one_at_a_time:
        engine = _engine_here(device, get_worker().state.nthreads)
        return engine.count(_request(content), shard), code_identity()
