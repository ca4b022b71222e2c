"""Dask workers in separate processes give the same bits, whichever of them end."""

import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil
import pytest
from answers import N, detected, same, same_snr, small
from commands import SMALL_SHARDS, run
from processes import in_background
from refusals import failed
from scenes import flaring_stares, instrument, paper, star

from mauvecl import DaskWorkers, Engine, Expectation, Pool, Stares, bulk, measure
from mauvecl.runs import cluster, store
from mauvecl.runs import pool as pools

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("small_shards")]


@pytest.fixture(scope="module")
def workers() -> Iterator[DaskWorkers]:
    """Return two worker processes; those that a test kills are replaced."""
    found = DaskWorkers("local:2")
    yield found
    found.close()


def test_two_processes_give_the_answers_of_one(
    workers: Any, engine: Engine, scene: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "CHUNK_BYTES", 64 * 197 * 2)
    pool = Pool(workers)
    assert workers.count == 2
    same(detected(pool, scene), detected(engine, scene))
    same_snr(*(one.snr(scene[0], realisations=N, seed=5) for one in (pool, engine)))
    assert pool.standing.shards == 16
    assert [device.name for device in pool.devices] == [engine.device.name] * 2
    stares = flaring_stares()
    np.testing.assert_array_equal(
        Pool(workers).stares(stares)["values"], Stares(engine.open_device).reduced(stares)["values"]
    )
    bulk.realise(small().with_settings(["run.realisations=500"]), tmp_path / "s.zarr", Pool(workers))
    assert bulk.verify(tmp_path / "s.zarr", engine, redraw=True) == []
    study = paper("star=[{library='M3V', magnitude=9}]", "flare.amplitudes=[0.5]", "measure.fits=40")
    assert measure(study, Pool(workers)) == measure(study, engine)
    # An error that another try would not mend is raised at once.
    (bright,) = star(magnitude=-0.7, payload=instrument(part=True))
    with failed("failed", "realisations 0 to 9: mode must be 'frames' or 'auto'"):
        pool.realise(bright, start=0, count=10, seed=1, mode="stacked")
    assert pool.standing.retries == 0


def kill_after(pool: Pool, shards: int, kill: Callable[[], object]) -> Future[Any]:
    def work() -> object:
        while pool.standing.shards < shards:
            time.sleep(0.005)
        return kill()

    return in_background(work)


def test_killed_worker_is_replaced(workers: DaskWorkers, engine: Engine, scene: list[Expectation]) -> None:
    """Kill a counting process: another one counts its shard, and the answer has the same bits."""
    n, pids = 150_000, workers._client.run(os.getpid)
    pool = Pool(workers)

    def kill_a_busy_one() -> int:
        # Between two shards none is busy.
        while not (busy := [pids[address] for address, tasks in workers._client.processing().items() if tasks]):
            time.sleep(0.001)
        os.kill(busy[0], signal.SIGKILL)
        return busy[0]

    killed = kill_after(pool, 10, kill_a_busy_one)
    same(detected(pool, scene, n), detected(engine, scene, n))
    assert killed.result(60) not in workers._client.run(os.getpid).values()
    assert pool.standing.retries >= 1, "the shard in its hands was counted again"


def greeted(port: int, context: ssl.SSLContext | None) -> bool:
    """Return whether a listener sends a visitor anything, as servers of Dask do."""
    try:
        plain = socket.create_connection(("127.0.0.1", port), timeout=3)
        with context.wrap_socket(plain) if context else plain as talk:
            return bool(talk.recv(1))
    except OSError:
        return False


def test_strangers_cannot_connect(workers: DaskWorkers) -> None:
    """Check that no port answers without this run's certificate, since other users of the machine see them."""
    from distributed import Security

    workers._client.wait_for_workers(2, timeout=60)
    pids = [os.getpid(), *workers._client.run(os.getpid).values()]
    ports = {c.laddr.port for pid in pids for c in psutil.Process(pid).net_connections("tcp") if c.status == "LISTEN"}

    def who_greets(context: ssl.SSLContext | None) -> int:
        with ThreadPoolExecutor(len(ports)) as threads:
            return sum(threads.map(partial(greeted, context=context), ports))

    ours, another = (
        s.get_connection_args("client")["ssl_context"] for s in (workers._client.security, Security.temporary())
    )
    without = ssl.create_default_context()
    for context in (without, another):
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    assert who_greets(ours) == 5, "scheduler, nannies and workers"
    assert [who_greets(context) for context in (None, without, another)] == [0, 0, 0]
    for pid in pids:
        assert b"PRIVATE" not in Path(f"/proc/{pid}/cmdline").read_bytes()


def test_waiting_threads_are_woken_at_the_end(scene: list[Expectation], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that threads which wait for shards, spectra or each other end at once, whatever Dask does."""
    silent = Mock(cluster=None, status="running", **{"run.return_value": {}, "cancel.side_effect": TimeoutError})
    silent.nthreads.return_value = {"one": 1, "two": 1}
    silent.submit.side_effect = lambda *given, **how: Mock()
    monkeypatch.setattr(cluster, "_client", lambda where, distributed: nullcontext(silent))
    workers = DaskWorkers("silent")
    monkeypatch.setattr(DaskWorkers, "count", 2)
    pool = Pool(workers)
    detect = partial(detected, pool, scene)
    works = [
        detect,
        lambda: pool.realise(scene[0], start=0, count=3, seed=1),
        lambda: list(pools.map_in_order(pool, lambda work: work(), [detect, detect, detect])),
    ]
    waiting = [in_background(work) for work in works]
    time.sleep(0.5)
    assert not any(one.done() for one in waiting)
    pool.stop()
    for one in waiting:
        with pytest.raises(pools.Stopped):
            one.result(5)


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_cluster_ends_its_workers(stop: signal.Signals, tmp_path: Path) -> None:
    """Check the promised five seconds; workers are not of the group, or what they build is cut off aloud by Ctrl-C."""
    # A run of more than ten seconds would report its progress.
    flags = "--statistic chi2 -n 80000 --no-pictures --fap 0.01 --ideal --quiet"
    words = ["detect", "--star", "G2V", "--star", "K3V", "-m", "7.4,3.7", *flags.split()]
    command = [*SMALL_SHARDS, *words, "--output", "out"]
    piped: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([*command, "--cluster", "local:2"], cwd=tmp_path, start_new_session=True, **piped)
    shards = tmp_path / "out" / "checkpoint"
    while not list(shards.glob("[!.]*.npz")):
        time.sleep(0.01)
        assert process.poll() is None
    workers = [child for child in psutil.Process(process.pid).children() if "spawn_main" in " ".join(child.cmdline())]
    assert len(workers) == 2
    assert all(os.getpgid(worker.pid) == worker.pid for worker in workers)
    os.killpg(process.pid, stop) if stop == signal.SIGINT else process.send_signal(stop)
    try:
        # Twice what is promised, for machines with other work.
        _, errors = process.communicate(timeout=10)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143}[stop]
    assert len(errors.splitlines()) == 1, errors
    assert "kept in 'out/checkpoint', and the same command with --resume continues from there" in errors
    kept = sum(int(p.stem.split("-")[-1]) for p in shards.glob("[!.]*.npz"))
    if stop == signal.SIGTERM:
        return
    done = subprocess.run([*command, "--resume"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "run.json").read_text())["shards"]["resumed"] == kept > 0


@contextmanager
def dask(folder: Path, *words: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a scheduler or worker as on a cluster, with the scheduler's file in a folder."""
    command = [Path(sys.executable).with_name("dask"), *words, "--scheduler-file", folder / "scheduler.json"]
    command.append("--no-dashboard")
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


@contextmanager
def by_hand(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    file = folder / "scheduler.json"
    with dask(folder, "scheduler", "--port", "0", "--host", "127.0.0.1") as scheduler:
        while not file.exists() or not file.read_text().strip():
            time.sleep(0.05)
        with dask(folder, "worker", "--nthreads", "1"):
            yield scheduler, str(file)


@pytest.fixture(scope="module")
def scheduler_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with by_hand(tmp_path_factory.mktemp("started")) as (_, file):
        yield file


#: Changes of the code of a worker that joins later, whose counts are wrong.
OTHER_CODE = {
    "version": "shards.VERSION = '0.9.0'; identity.cache_clear()",
    "kernels": "shards.DRAWING_PACKAGES = ('kernels',); identity.cache_clear()",
    "none stated": "answer = lambda sums, code: sums; del shards.code_identity",
    "request unreadable": "count = None; shards.VERSION = '0.9.0'; identity.cache_clear()",
}
#: Script that a worker reads when it starts; Dask runs it twice.
PRELOAD = """
from mauvecl.runs import checkpoint as shards, cluster
if not hasattr(cluster, "changed"):
    cluster.changed, count, identity = True, cluster._count, shards.code_identity
    answer = lambda *counted: counted
    {change}
    def wrong(*given):
        counted = count(*given)
        sums = counted[0] if isinstance(counted, tuple) else counted
        return answer({{key: value + 1 for key, value in sums.items()}}, identity())
    cluster._count = wrong
"""


@pytest.mark.parametrize("change", OTHER_CODE)
def test_shards_of_workers_with_other_code_are_drawn_again(
    change: str, scheduler_file: str, tmp_path: Path, engine: Engine, scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other_code.py").write_text(PRELOAD.format(change=OTHER_CODE[change]))
    n, workers = 200_000, DaskWorkers(scheduler_file)
    pool = Pool(workers)
    joins = "worker", "--nthreads", "1", "--no-nanny", "--preload", tmp_path / "other_code.py"
    with dask(Path(scheduler_file).parent, *joins):
        workers._client.wait_for_workers(2, timeout=60)
        found = detected(pool, scene, n)
        assert len(workers._strangers) == 1
        assert pool.standing.retries >= 1
    same(found, detected(engine, scene, n))
    # Workers that all have other code raise.
    monkeypatch.setattr(cluster, "code_identity", lambda: ("1.0.0", "another"))
    with pytest.raises(RuntimeError, match="workers with other code"):
        detected(Pool(workers), scene)
    workers.close()


@pytest.mark.parametrize("victim", ["worker", "scheduler"])
def test_end_of_a_process_started_by_hand_is_noticed(
    victim: str, tmp_path: Path, engine: Engine, scene: list[Expectation], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restrict shards to a worker that ends and is replaced under another address, and report a lost scheduler."""
    with by_hand(tmp_path) as (scheduler, file):
        workers = DaskWorkers(file)
        pool = Pool(workers)
        if victim == "worker":
            monkeypatch.setattr(cluster, "RECOUNT_S", 0.5)
            workers._strangers.add("tcp://127.0.0.1:1")
            (pid,) = workers._client.run(os.getpid).values()
            kill_after(pool, 5, lambda: os.kill(pid, signal.SIGKILL))
            same(detected(pool, scene, 150_000), detected(engine, scene, 150_000))
        else:
            kill_after(pool, 5, scheduler.kill)
            with failed("lost"):
                detected(pool, scene, 1_000_000)
            workers.stop()
        workers.close()


@pytest.mark.parametrize("who", ["worker", "scheduler"])
def test_end_during_a_transfer_is_noticed(who: str, scheduler_file: str, engine: Engine, scene: Any) -> None:
    """Send a shard again whose worker leaves with its result, and report a scheduler that is lost."""
    workers = DaskWorkers(scheduler_file)
    submit, pool, lost = workers._client.submit, Pool(workers), Mock(status="finished")

    def leave(timeout: float) -> None:
        lost.status = "finished" if lost.result.call_count < 3 else "lost"
        raise TimeoutError if who == "worker" else ConnectionResetError("Connection reset by peer")

    lost.result.side_effect = leave
    lost.add_done_callback.side_effect = lambda came: in_background(lambda: came(lost))

    def lose_the_first(work: Any, *arguments: Any, **how: Any) -> Any:
        if work.__name__ != "_count":
            return submit(work, *arguments, **how)
        workers._client.submit = submit
        return lost

    workers._client.submit = lose_the_first
    if who == "worker":
        same(detected(pool, scene), detected(engine, scene))
        assert (lost.result.call_count, pool.standing.retries) == (3, 1)
    else:
        with failed("lost"):
            detected(pool, scene)
    workers.close()


#: The documentation's example for batch systems.
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "batch_cluster.py"


@pytest.mark.parametrize(("system", "line"), [("slurm", "#SBATCH -p astro"), ("pbs", "#PBS -q astro")])
def test_example_for_batch_systems_runs(system: str, line: str) -> None:
    pytest.importorskip("dask_jobqueue")
    command = [sys.executable, EXAMPLE, system, "--queue", "astro", "--cores", "4", "--show"]
    reported = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for part in (line, "--nthreads 1", "--nworkers 4"):
        assert part in reported


def test_existing_cluster_is_used(tmp_path: Path) -> None:
    """Name the example by address and by scheduler file; tables equal those of one machine."""
    pytest.importorskip("dask_jobqueue")
    command = [sys.executable, EXAMPLE, "local", "--jobs", "1", "--cores", "1", "--memory", "2GB"]
    script, file = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL), tmp_path / "scheduler.json"
    while not file.exists():
        time.sleep(0.05)
        assert script.poll() is None
    (tmp_path / "study.toml").write_text(small().toml())
    words = ("detect", "study.toml", "--no-pictures", "--quiet")
    run(*words, "--output", "one", folder=tmp_path)
    for name, where in (("address", json.loads(file.read_text())["address"]), ("file", str(file))):
        run(*words, "--output", name, "--cluster", where, folder=tmp_path)
        for table in ("detection.ecsv", "tails.ecsv", "roc.ecsv", "departures.ecsv"):
            assert (tmp_path / name / table).read_bytes() == (tmp_path / "one" / table).read_bytes()
        assert '"retries": 0' in (tmp_path / name / "run.json").read_text()
    script.terminate()
    script.wait(20)
    assert not file.exists()
