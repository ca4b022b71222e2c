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
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.detection.requests import Shard, ShardedRequest
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
        self._where, self._device, self._n_submitted = where, device, 0
        self._lock = threading.Lock()
        self._closing = False
        # Futures of requests by their keys, and for each submitted shard the future that the pool awaits.
        self._requests: dict[str, DaskFuture[Any]] = {}
        self._submitted: dict[DaskFuture[Any], Future[Arrays]] = {}
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
        self._n_workers, self._counted_at_s = len(introduced), time.monotonic()

    @property
    def count(self) -> int:
        """Number of workers some seconds ago, at least 1."""
        if time.monotonic() > self._counted_at_s + RECOUNT_S:
            try:
                self._n_workers = max(len(self._client.nthreads()), 1)
            except OSError as error:
                raise self._scheduler_ended() from error
            self._counted_at_s = time.monotonic()
        return self._n_workers

    def _scheduler_ended(self) -> DeviceError:
        return DeviceError(f"the scheduler of cluster {self._where} ended before the work was done", "lost")

    def describe(self) -> list[DeviceRecord]:
        """Return the devices of the initial workers."""
        return self._devices

    def submit(self, task: Task) -> Future[Arrays]:
        """Submit a shard to any free worker; raw spectra are returned, and the task's `out` is not used."""
        counts: Future[Arrays] = Future()
        with self._lock:
            if self._closing:
                counts.set_exception(Stopped())
                return counts
            self._n_submitted += 1
            try:
                if task.key not in self._requests:
                    # A task instead of scattered data, since the scheduler repeats it if its worker is lost. Bytes,
                    # because a worker with other code might read and write a request differently.
                    content, key = pickle.dumps(task.request), f"mauvecl-request-{task.key}-{self._n_submitted}"
                    self._requests[task.key] = self._client.submit(bytes, content, key=key)
                    if len(self._requests) > MAX_REQUESTS:
                        del self._requests[next(iter(self._requests))]
                arguments = self._requests[task.key], task.shard, self._device
                key, options = f"mauvecl-{task.name}-{self._n_submitted}", dict[str, Any]()
                if self._strangers:
                    # Dask gives the shard to strangers only if all others have left.
                    ours = [worker for worker in self._client.nthreads() if worker not in self._strangers]
                    options = {"workers": ours, "allow_other_workers": True}
                submitted = self._client.submit(_count, *arguments, key=key, pure=False, **options)
            except (OSError, RuntimeError) as error:
                # Dask raises either if its client has lost the scheduler.
                counts.set_exception(self._scheduler_ended().with_traceback(error.__traceback__))
                return counts
            self._submitted[submitted] = counts
        submitted.add_done_callback(partial(self._finish, counts, task))
        return counts

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

    def _finish(self, counts: Future[Arrays], task: Task, submitted: DaskFuture[Any]) -> None:
        """Set the result or the exception of a shard that has ended."""
        with self._lock:
            if self._submitted.pop(submitted, None) is None:
                # The result is no longer needed.
                return
        try:
            counts.set_result(self._result(task, submitted))
        except BaseException as error:
            # The connection may break between the end of a shard and the transfer of its counts.
            broken = self._scheduler_ended().with_traceback(error.__traceback__)
            counts.set_exception(broken if isinstance(error, OSError) else error)

    def _result(self, task: Task, submitted: DaskFuture[Any]) -> Arrays:
        """Return the counts of a shard that has ended, or raise why there are none."""
        if submitted.status == "finished":
            answer: Any = None
            # Dask would wait until the task is repeated. It calls the functions of all finished tasks in one thread, so
            # every other shard would wait, too.
            while answer is None:
                with contextlib.suppress(TimeoutError):
                    answer = submitted.result(timeout=RECOUNT_S)
                if answer is None and submitted.status != "finished":
                    raise ShardLost("its worker has left with its counts")
            # Workers with older code answer without theirs.
            if isinstance(answer, tuple) and answer[1] == code_identity():
                arrays: Arrays = answer[0]
                return arrays
        error = submitted.exception() if submitted.status == "error" else None
        strangers = submitted.status in ("finished", "error") and self._find_strangers()
        if isinstance(error, InputError | DeviceError) and not strangers:
            # Another attempt would end as this one.
            raise DeviceError(f"cluster {self._where} failed at {task.shard}: {error}", "failed")
        if submitted.status in ("cancelled", "lost") and self._client.status != "running":
            raise self._scheduler_ended()
        with self._lock:
            # The next attempt sends the request again, which may be lost, too.
            self._requests.pop(task.key, None)
        reason = "workers with other code" if submitted.status == "finished" else "workers that have left"
        raise ShardLost(f"cluster {self._where}: {error or reason}")

    def stop(self) -> None:
        """Cancel submitted shards; workers of other machines complete the shard in progress."""
        with self._lock:
            self._closing = True
            submitted, self._submitted = self._submitted, {}
        # Set the exception here, because neither Dask nor a cancelled future wakes concurrent.futures.wait.
        for counts in submitted.values():
            counts.set_exception(Stopped())
        if submitted:
            with contextlib.suppress(OSError, RuntimeError, TimeoutError):
                self._client.cancel(list(submitted))
        # Kill workers of this machine, since completing a shard takes seconds.
        for nanny in getattr(self._client.cluster, "workers", {}).values():
            nanny.auto_restart = False
            if nanny.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)

    def close(self) -> None:
        """Stop work in progress, and disconnect from the workers; those of this machine end."""
        self.stop()
        self._requests.clear()
        self._open.close()


@contextlib.contextmanager
def _client(where: str, distributed: Any) -> Iterator[Client]:
    """Connect to a cluster, starting it first if it is local."""
    import dask

    for name in LOGS:
        # Errors reach the user as exceptions.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        scheme, _, number = where.partition(":")
        if scheme == "local":
            if not (number.isdecimal() and len(number) <= 4 and 1 <= int(number) <= 1024):
                raise InputError.of("cluster", where, "local:N with N from 1 to 1024")
            settings: dict[str, Any] = {
                # The pool counts failures and submits shards again, so that it can report them.
                "distributed.scheduler.allowed-failures": 0,
                "distributed.admin.tick.limit": "1h",
                # No HTTP pages, since they have no authentication.
                "distributed.scheduler.http.routes": [],
                "distributed.worker.http.routes": [],
                "logging": dict.fromkeys(LOGS, "critical"),
            }
            stack.enter_context(dask.config.set(settings))
            cluster = stack.enter_context(_local_cluster(int(number), distributed))
            options = {"address": cluster, "security": cluster.security}
        elif "://" in where and _is_address(where):
            options = {"address": where}
        elif "://" not in where and is_file(Path(where)):
            with parsing(f"scheduler file {shortened(where)}", "give JSON"):
                scheduler = json.loads(read_text(Path(where), "scheduler file"))
            address = scheduler.get("address") if isinstance(scheduler, dict) else None
            if not (isinstance(address, str) and _is_address(address)):
                raise InputError(
                    f"scheduler file {shortened(where)} names no address: use one that Dask wrote", key="cluster"
                )
            options = {"scheduler_file": where}
        else:
            raise InputError.of("cluster", where, "local:N, an address such as tcp://host:8786, or a scheduler file")
        try:
            client = stack.enter_context(distributed.Client(**options, timeout=PATIENCE_S, set_as_default=False))
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
    match = re.fullmatch(r"(tcp|tls|ucxx?|wss?)://([\w.-]+|\[[\w:.%]+\]):(\d{1,5})/?", where, flags=re.ASCII)
    return match is not None and 0 < int(match[3]) < 2**16


LOGS = ("distributed", *(f"distributed.{part}" for part in ("client", "nanny", "worker", "scheduler", "core")))


# Functions below run on a worker.


def dask_setup(worker: Any) -> None:
    """Leave the run's process group, so that Ctrl-C does not reach workers; Dask calls this on local workers.

    Ignoring the signal would not suffice: LLVM sets its own handlers during a build, and the linker would be killed.
    """
    os.setpgid(0, 0)


_one_at_a_time = threading.Lock()
#: Requests by their bytes; each keeps what it has computed for earlier shards.
_request: Callable[[bytes], ShardedRequest] = lru_cache(maxsize=4)(pickle.loads)


@cache
def _engine(device: str | None, threads: int) -> Engine:
    """Return the worker's engine, with PoCL limited to the threads that Dask assigns."""
    from mauvecl.device.engine import Engine

    for name in THREADS:
        os.environ.setdefault(name, str(threads))
    return Engine(device)


def _introduce(device: str | None, dask_worker: Any = None) -> tuple[tuple[str, str], DeviceRecord]:
    """Return the worker's code and device."""
    with _one_at_a_time:
        return code_identity(), _engine(device, dask_worker.state.nthreads).device


def _count(content: bytes, shard: Shard, device: str | None) -> tuple[Arrays, tuple[str, str]]:
    """Return the counts of a shard, and the code that counted them."""
    from distributed import get_worker

    with _one_at_a_time:
        engine = _engine(device, get_worker().state.nthreads)
        return engine.count(_request(content), shard), code_identity()
