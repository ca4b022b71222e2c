"""Shards of a request add up to the engine's answer, whoever counts them, in any order."""

from __future__ import annotations

import json
import pickle
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import N, same, same_snr, small
from refusals import refused
from scenes import instrument, star

from mauvecl import (
    Comparison,
    Detection,
    Engine,
    Expectation,
    InputError,
    Linear,
    LocalWorkers,
    Pool,
    Processes,
    Study,
    Uniform,
    detect,
    detection_map,
    limiting_magnitude,
    snr,
)
from mauvecl.answers.progress import reported
from mauvecl.device.errors import DeviceError
from mauvecl.noise.drawing import Drawing
from mauvecl.results.requests.requests import DetectRequest, Shard, SnrRequest
from mauvecl.results.shard_sums import Arrays
from mauvecl.runs import shards
from mauvecl.runs.checkpoint import Checkpoint, _digest_of
from mauvecl.runs.pool import Stopped, map_in_order
from mauvecl.runs.shards import fingerprint
from mauvecl.study.cases import Case

pytestmark = pytest.mark.usefixtures("small_shards")


class Shuffled(LocalWorkers):
    """Workers that answer shards late, in another order, and in the form in which they travel."""

    def __init__(self, engine: Engine, seed: int) -> None:
        super().__init__([None], make=lambda device, progress: engine)
        self._random, self._late = random.Random(seed), ThreadPoolExecutor(8)
        self._alone = threading.Lock()

    @property
    def count(self) -> int:
        return 4

    def submit(self, task: shards.Task) -> Future[Arrays]:
        sent = pickle.loads(pickle.dumps(task.request))
        wait = self._random.uniform(0.0, 0.05)

        def work() -> Arrays:
            time.sleep(wait)
            with self._alone:
                found = self.first.count(sent, task.shard)
            time.sleep(wait)
            return dict(pickle.loads(pickle.dumps(found)))

        return self._late.submit(work)


@pytest.mark.parametrize("start", [0, 2**32 - 5000])
def test_order_of_shards_does_not_affect_the_answer(engine: Engine, scene: list[Expectation], start: int) -> None:
    quiet, *flares = scene
    own = Linear("own", np.linspace(0.0, 1.0, quiet.wavelength_nm.size))
    how: dict[str, Any] = {"realisations": N, "seed": 5, "start": start, "statistics": ("chi2", "matched", own)}
    pool = Pool(Shuffled(engine, 3))
    same(pool.detect(quiet, flares, **how), engine.detect(quiet, flares, **how))
    assert (
        pool.standing.shards
        == pool.standing.of
        == len(shards.shards(DetectRequest(quiet, tuple(flares), N, 5, ("chi2",), start=start)))
    )
    same_snr(
        pool.snr(quiet, realisations=N, seed=5, start=start),
        engine.snr(quiet, realisations=N, seed=5, start=start),
    )


@pytest.mark.long
def test_shards_of_every_kind_of_request_join(engine: Engine) -> None:
    """Include requests with several launches and all arguments."""
    quiet, *flares = star(amplitudes=tuple(np.linspace(0.01, 0.3, 17)), payload=instrument(part=True))
    how: dict[str, Any] = {
        "realisations": 9000,
        "seed": 1,
        "statistics": ("chi2_pair", "matched"),
        "comparison": Comparison.of("stack:3", "estimated"),
        "processes": Processes(jitter=Uniform(0.0, 0.05)),
    }
    pool = Pool(Shuffled(engine, 4))
    same(pool.detect(quiet, flares, **how), engine.detect(quiet, flares, **how))
    assert pool.standing.of == 2 * 3


@pytest.mark.long
def test_devices_of_different_form_give_one_answer(scene: list[Expectation], engine: Engine) -> None:
    """Share the work between engines with 16 realisations and with 1 per work-item."""
    quiet, *flares = scene
    widths = iter((16, 1))

    def make(device: str | None, progress: Any) -> Engine:
        return Engine(device, progress=progress, width=next(widths))

    workers = LocalWorkers([None, "0"], make=make)
    counted: list[Engine] = []
    real = Engine.count

    def noted(self: Engine, *given: Any, **more: Any) -> Arrays:
        counted.append(self)
        return real(self, *given, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Engine, "count", noted)
        found = Pool(workers).detect(quiet, flares, realisations=N, seed=2)
    workers.close()
    assert len(set(map(id, counted))) == 2, "both worked"
    same(found, engine.detect(quiet, flares, realisations=N, seed=2))


class Failing:
    """An engine whose launches fail at chosen calls."""

    def __init__(self, engine: Engine, fails: set[int], calls: list[int]) -> None:
        self._engine, self._fails, self._calls = engine, fails, calls
        self.open_device, self.device, self.device_name = engine.open_device, engine.device, engine.device_name

    def count(self, request: Any, shard: Shard, **more: Any) -> Arrays:
        self._calls.append(len(self._calls))
        if self._calls[-1] in self._fails:
            # Half of the shard is counted already when it fails.
            self._engine.count(request, replace(shard, count=shard.count // 2))
            raise self.open_device.cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES", -5, "")
        return self._engine.count(request, shard, **more)


def test_failed_launch_is_repeated(engine: Engine, scene: list[Expectation]) -> None:
    quiet, *flares = scene
    calls: list[int] = []
    made: list[int] = []

    def make(device: str | None, progress: Any) -> Any:
        made.append(1)
        return Failing(engine, {2, 5, 6}, calls)

    pool = Pool(LocalWorkers([None], make=make))
    same(pool.detect(quiet, flares, realisations=N, seed=5), engine.detect(quiet, flares, realisations=N, seed=5))
    assert pool.standing.retries == 3
    assert len(made) == 4, "each time with a new context"


def test_closed_workers_end_every_wait(engine: Engine, scene: list[Expectation]) -> None:
    """Close workers while a pool waits for a shard that is counted and for another behind it, its last."""
    quiet, *flares = scene
    begun, free = threading.Event(), threading.Event()

    class Held(Failing):
        def count(self, request: Any, shard: Shard, **more: Any) -> Arrays:
            begun.set()
            assert free.wait(60)
            return engine.count(request, shard, **more)

    workers = LocalWorkers([None], make=lambda device, progress: Held(engine, set(), []))  # type: ignore[return-value, arg-type]
    ends: list[BaseException] = []

    def ask() -> None:
        try:
            Pool(workers).detect(quiet, flares, realisations=8192, seed=5)
        except (Stopped, RuntimeError) as end:
            ends.append(end)

    # Daemon threads: one that waits for ever fails the test instead of holding it.
    asking, closing = (threading.Thread(target=one, daemon=True) for one in (ask, workers.close))
    asking.start()
    assert begun.wait(60)
    closing.start()
    while not workers._stopping:
        time.sleep(0.01)
    free.set()
    asking.join(60)
    closing.join(60)
    assert not asking.is_alive()
    assert not closing.is_alive()
    assert len(ends) == 1


def test_progress_that_raises_closes_its_items() -> None:
    """Check that work ahead of a verb's progress is stopped before its workers are closed."""
    ended: list[str] = []

    def items() -> Iterator[int]:
        try:
            yield from range(3)
        finally:
            ended.append("items")

    def progress(done: int, total: int) -> None:
        raise Stopped

    try:
        list(reported(items(), 3, progress))
    except Stopped:
        ended.append("verb")
    assert ended == ["items", "verb"]


def test_device_that_always_fails_raises(engine: Engine, scene: list[Expectation]) -> None:
    quiet, *flares = scene
    pool = Pool(LocalWorkers([None], make=lambda device, progress: Failing(engine, set(range(99)), [])))  # type: ignore[return-value, arg-type]
    with pytest.raises(DeviceError) as error:
        pool.detect(quiet, flares, realisations=N, seed=5)
    assert error.value.kind == "failed"
    assert "3 times at realisations 0 to 4095 " in str(error.value)
    assert "OUT_OF_RESOURCES" in str(error.value)


AXES = {"x": {"quantity": "magnitude", "values": [6, 8, 10]}, "y": {"quantity": "amplitude", "values": [0.05, 0.2]}}


@pytest.mark.parametrize(
    ("ask", "sections"),
    [
        (lambda s, e: detect(s, e).table, {}),
        (lambda s, e: snr(s, e).element, {"sweep": {"axes": [{"quantity": "exposure", "values": [5, 50]}]}}),
        pytest.param(lambda s, e: limiting_magnitude(s, e).table, {}, marks=pytest.mark.long),
        (lambda s, e: detection_map(s, e).table, {"map": AXES}),
        pytest.param(
            lambda s, e: detection_map(s, e).table, {"map": AXES, "unknowns": {"draws": 3}}, marks=pytest.mark.long
        ),
    ],
    ids=["detect", "snr", "limit", "map", "unknowns"],
)
def test_pool_gives_the_table_of_the_engine(
    engine: Engine, ask: Callable[[Study, Any], Any], sections: dict[str, Any]
) -> None:
    ours, theirs = ask(small(**sections), engine), ask(small(**sections), Pool(Shuffled(engine, 9)))
    assert ours.colnames == theirs.colnames
    for name in ours.colnames:
        np.testing.assert_array_equal(np.asarray(ours[name]), np.asarray(theirs[name]), err_msg=name)


def test_fingerprints_distinguish_requests(scene: list[Expectation]) -> None:
    """Check that the name of a shard changes with everything that changes an answer, and with nothing else."""
    quiet, *flares = scene
    base = DetectRequest(quiet, tuple(flares), N, 5, ("chi2", "matched"))
    brighter = replace(flares[1], source_electrons=np.nextafter(flares[1].source_electrons, np.inf))
    others = [
        replace(base, seed=6),
        replace(base, statistics=("chi2",)),
        replace(base, statistics=("chi2", Linear("own", np.ones(quiet.wavelength_nm.size)))),
        replace(base, statistics=("chi2", Linear("own", np.full(quiet.wavelength_nm.size, 2.0)))),
        replace(base, flares=tuple(flares[::-1])),
        replace(base, flares=(flares[0], brighter)),
        replace(base, comparison=Comparison.of("exposure")),
        replace(base, drawing=Drawing(processes=Processes(jitter=Uniform(0.0, 0.01)))),
        replace(base, drawing=Drawing(mode="frames")),
        SnrRequest(quiet, N, 5),
    ]
    names = [fingerprint(one) for one in (base, *others)]
    assert len(set(names)) == len(names)
    reported = replace(quiet, provenance={"from": "elsewhere"}, messages=())
    for same_one in (replace(base, realisations=7), replace(base, quiet=reported), pickle.loads(pickle.dumps(base))):
        assert fingerprint(same_one) == names[0]


def test_shards_do_not_depend_on_the_number_of_realisations(scene: list[Expectation]) -> None:
    """Check all shards but the last, so that a longer run finds those of a shorter one."""
    quiet, *flares = scene
    short, long = (shards.shards(DetectRequest(quiet, tuple(flares), n, 5, ("chi2",))) for n in (N, 10 * N))
    assert short[:-1] == long[: len(short) - 1]
    for request_shards, n in ((short, N), (long, 10 * N)):
        assert sum(shard.count for shard in request_shards) == n


def test_large_requests_have_larger_shards(scene: list[Expectation], monkeypatch: pytest.MonkeyPatch) -> None:
    """Limit the number of shards to what one process can add up."""
    monkeypatch.setattr(shards, "SHARD_WORK", 2**34)
    for n in (10**6, 10**9, 10**12, 10**15):
        found = shards.shards(DetectRequest(scene[0], tuple(scene[1:]), n, 5, ("chi2",)))
        assert len(found) <= 2 * shards.MAX_SHARDS + 1
        assert sum(shard.count for shard in found) == n
        assert all(shard.count & (shard.count - 1) == 0 for shard in found[:-1])


def interrupting(after: int) -> Callable[[int, int], None]:
    def progress(done: int, total: int) -> None:
        if done >= after:
            raise KeyboardInterrupt

    return progress


def at_work(
    folder: Path, engine: Engine, progress: Any = None, study: Study | None = None, **how: Any
) -> tuple[Detection, Pool, Checkpoint]:
    study = study or small()
    quiet, *flares = Case(study).expectations
    with Checkpoint(folder, "detect", study, patience_s=0.0, **how) as checkpoint:
        pool = Pool(LocalWorkers([None], make=lambda d, progress: engine), checkpoint=checkpoint, progress=progress)
        return pool.detect(quiet, flares, realisations=N, seed=5), pool, checkpoint


def test_interrupted_run_is_resumed(tmp_path: Path, engine: Engine) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    found, pool, checkpoint = at_work(tmp_path, engine, resume=True)
    assert 16_000 < pool.standing.resumed < N
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))
    checkpoint.forget()
    assert list(tmp_path.iterdir()) == []


def test_unfinished_run_is_not_overwritten(tmp_path: Path, engine: Engine) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(10_000))
    with refused("resume", "`resume=True`", "`restart=True`"):
        at_work(tmp_path, engine)
    other = small().with_settings(["run.seed=4", "flare.amplitudes=[0.1]"])
    with refused("restart", "flare.amplitudes.0", "flare.amplitudes.1"):
        at_work(tmp_path, engine, study=other, resume=True)
    _, pool, _ = at_work(tmp_path, engine, restart=True)
    assert pool.standing.resumed == 0


def test_counts_of_another_form_raise(tmp_path: Path, engine: Engine) -> None:
    """Refuse shards of an older version, also if their manifest is lost."""
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(10_000))
    path = tmp_path / "checkpoint" / "manifest.json"
    manifest = json.loads(path.read_text())
    old = {key: value for key, value in manifest.items() if key not in ("form", "digest")}
    path.write_text(json.dumps(old | {"digest": _digest_of(old)}))
    with refused("restart", "1", "2", "`restart=True`"):
        at_work(tmp_path, engine, resume=True)
    quiet, *flares = Case(small()).expectations
    request = DetectRequest(quiet, tuple(flares), N, 5)
    ours = fingerprint(request)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "FORM", 1)
        assert fingerprint(request) != ours


def test_second_run_in_a_folder_raises(tmp_path: Path, engine: Engine) -> None:
    with (
        Checkpoint(tmp_path, "detect", small()),
        refused("lock"),
    ):
        at_work(tmp_path, engine)


@pytest.mark.parametrize("place", [0, 20, -1])
def test_flipped_byte_in_a_shard_is_found(tmp_path: Path, engine: Engine, place: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    first, *_ = sorted((tmp_path / "checkpoint").glob("*.npz"))
    data = bytearray(first.read_bytes())
    data[place] ^= 4
    first.write_bytes(data)
    found, pool, checkpoint = at_work(tmp_path, engine, resume=True)
    assert checkpoint.damaged == 1
    assert pool.standing.resumed >= 8192
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))


def test_misplaced_shard_is_found(tmp_path: Path, engine: Engine) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    first, second, *_ = sorted((tmp_path / "checkpoint").glob("*.npz"))
    first.write_bytes(second.read_bytes())
    found, _, checkpoint = at_work(tmp_path, engine, resume=True)
    assert checkpoint.damaged == 1
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))


@pytest.mark.parametrize("spoil", ["flip", "empty", "gone"])
def test_damaged_manifest_is_replaced(tmp_path: Path, engine: Engine, spoil: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    manifest = tmp_path / "checkpoint" / "manifest.json"
    text = manifest.read_text()
    manifest.unlink() if spoil == "gone" else manifest.write_text(text.replace("7.4", "7.5") if spoil == "flip" else "")
    found, pool, checkpoint = at_work(tmp_path, engine, resume=True)
    assert "was damaged or missing and is written anew" in checkpoint.messages[0]
    assert pool.standing.resumed > 16_000
    assert manifest.read_text() == text
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))


def test_short_runs_leave_no_files(tmp_path: Path, engine: Engine) -> None:
    study = small()
    quiet, *flares = Case(study).expectations
    with Checkpoint(tmp_path, "detect", study) as checkpoint:
        pool = Pool(LocalWorkers([None], make=lambda d, progress: engine), checkpoint=checkpoint)
        pool.detect(quiet, flares, realisations=N, seed=5)
    assert list(tmp_path.iterdir()) == []


def test_jumps_of_the_clock_have_no_effect(tmp_path: Path, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the wall time jump and run backwards; shards and progress are unaffected."""
    from mauvecl.cli.console import Meter

    leaps = iter(np.resize([1e9, -1e9, 0.0, 5e9], 100_000))
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + next(leaps))
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    with Meter(quiet=True) as meter:
        found, pool, _ = at_work(tmp_path, engine, meter, resume=True)
    assert pool.standing.resumed > 16_000
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))


def test_full_disk_raises_and_is_resumed(tmp_path: Path, engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    from stores import full_after

    with monkeypatch.context() as patch:
        full_after(400_000, patch)
        with refused("file"):
            at_work(tmp_path, engine)
    kept = len(list((tmp_path / "checkpoint").glob("*.npz")))
    assert kept >= 1
    found, pool, _ = at_work(tmp_path, engine, resume=True)
    assert pool.standing.resumed == kept * 4096
    quiet, *flares = Case(small()).expectations
    same(found, engine.detect(quiet, flares, realisations=N, seed=5))


def test_background_work_begins_once_after_the_devices() -> None:
    quiet, *flares = Case(small()).expectations
    begun: list[int] = []
    pool = Pool(LocalWorkers(), meanwhile=lambda: begun.append(pool.standing.of))
    assert begun == []
    for _ in range(2):
        pool.detect(quiet, flares, realisations=N, seed=5)
    (of,) = begun
    assert of > 0


def test_progress_includes_resumed_shards(tmp_path: Path, engine: Engine) -> None:
    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, interrupting(20_000))
    reported: list[tuple[int, int]] = []
    _, pool, _ = at_work(tmp_path, engine, lambda done, total: reported.append((done, total)), resume=True)
    assert reported[0] == (0, N)
    assert reported[-1] == (N, N)
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    s = pool.standing
    assert (s.shards, s.of, s.retries) == (8, 8, 0)


def test_answers_keep_their_order_and_errors_end_the_rest(engine: Engine) -> None:
    pool = Pool(Shuffled(engine, 1))
    pauses: Sequence[float] = [0.05, 0.0, 0.03, 0.01, 0.02, 0.0]

    def slow(number: int) -> int:
        time.sleep(pauses[number])
        return number

    assert list(map_in_order(pool, slow, range(6))) == list(range(6))

    def bad(number: int) -> int:
        if number == 2:
            raise InputError.of("number", 2, "another")
        return number

    with refused("number", "2"):
        list(map_in_order(pool, bad, range(6)))
    quiet, *flares = Case(small()).expectations
    with pytest.raises(Stopped):
        pool.detect(quiet, flares, realisations=N, seed=5)
