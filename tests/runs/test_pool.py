"""Shards of a request add up to the answer of the engine, in any order and whatever was interrupted."""

import hashlib
import itertools
import json
import pickle
import random
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from answers import N, detected, same, same_snr, small
from marks import long_but
from processes import in_background
from refusals import failed, refused
from scenes import FIRST_STARE, N_STARES, flaring_stares, instrument, star
from stores import flip, full_after

import mauvecl
from mauvecl import Comparison, DaskWorkers, Detection, Engine, Expectation, Linear, LocalWorkers, Pool, Stare, Stares
from mauvecl.detection import requests
from mauvecl.runs import checkpoint as shards
from mauvecl.runs import cluster
from mauvecl.runs import pool as pools

pytestmark = pytest.mark.usefixtures("small_shards")
#: Of most runs below.
SCENE = star(amplitudes=(0.05, 0.24), payload=instrument(part=True))


class Shuffled(LocalWorkers):
    """Workers that answer shards late, in another order, and in the form in which they travel."""

    def __init__(self, engine: Engine, seed: int) -> None:
        super().__init__([None], make=lambda device, progress: engine)
        self._random, self._late = random.Random(seed), ThreadPoolExecutor(8)
        self._alone = threading.Lock()

    @property
    def count(self) -> int:
        return 4

    def submit(self, task: shards.Task) -> Future[Any]:
        sent = pickle.loads(pickle.dumps(task.request))
        wait = self._random.uniform(0.0, 0.05)

        def work() -> Any:
            time.sleep(wait)
            with self._alone:
                found = self.first.count(sent, task.shard)
            time.sleep(wait)
            return dict(pickle.loads(pickle.dumps(found)))

        return self._late.submit(work)


OWN = {"statistics": ("chi2", "matched", Linear("own", np.linspace(0.0, 1.0, SCENE[0].wavelength_nm.size)))}
#: Flares, arguments and number of shards; seventeen flares need two launches.
DETECTIONS: list[Any] = [
    ((0.05, 0.24), OWN, 8),
    ((0.05, 0.24), OWN | {"start": 2**32 - 5000}, 9),
    (tuple(np.linspace(0.01, 0.3, 17)), {
        "n": 9000, "statistics": ("chi2_pair", "matched"), "comparison": Comparison.of("stack:3", "estimated"),
        "processes": mauvecl.Processes(jitter=mauvecl.Uniform(0.0, 0.05)),
    }, 2 * 3),
]  # fmt: skip


@pytest.mark.parametrize(("amplitudes", "how", "n_shards"), long_but(DETECTIONS, *DETECTIONS[:2]))
def test_order_of_shards_does_not_affect_the_answer(
    engine: Engine, amplitudes: tuple[float, ...], how: dict[str, Any], n_shards: int
) -> None:
    scene = star(amplitudes=amplitudes, payload=instrument(part=True))
    pool = Pool(Shuffled(engine, 3))
    same(detected(pool, scene, **how), detected(engine, scene, **how))
    assert pool.standing.shards == pool.standing.of == n_shards
    asked = {"realisations": N, "seed": 5, "start": how.get("start", 0)}
    same_snr(*(one.snr(scene[0], **asked) for one in (pool, engine)))


@dataclass(frozen=True)
class Reduced:
    """Reduction to the number of frames above a level, or to the largest value of each stare."""

    level: float = np.inf
    adds: bool = False

    def __call__(self, values: np.ndarray, first: int) -> dict[str, np.ndarray]:
        if self.adds:
            return {"frames": np.count_nonzero(values > self.level, axis=(-3, -2))}
        largest = values.max(axis=(-2, -1)).reshape(-1, values.shape[-3]).T
        return {"largest": largest, "number": first + np.arange(len(largest))}


ABOVE = [Reduced(level, adds=True) for level in (1.0, 2.0, 500.0)]


@pytest.mark.long
@pytest.mark.parametrize("method", ["pixels", "cumulants"])
@pytest.mark.parametrize("reduction", [None, Reduced(), ABOVE[2]])
def test_shards_of_stares_join_to_the_same_bits(engine: Engine, method: Any, reduction: Any) -> None:
    """Compare two engines of different form, with requests in the form in which they travel, with one call."""
    asked = flaring_stares(method, reduction=reduction)
    engines: dict[str | None, Any] = {None: Engine(width=16), "0": Engine("0", width=1)}
    for one in engines.values():
        one.count = Mock(wraps=one.count)
    pool = Pool(workers := LocalWorkers([None, "0"], make=lambda device, progress: engines[device]))
    found = pool.stares(pickle.loads(pickle.dumps(asked)))
    workers.close()
    assert all(one.count.called for one in engines.values())
    assert pool.standing.shards == len(shards.shards(asked)) == 5, "cut at multiples of 64, and where the word ends"
    whole = Stares(engine.open_device).frames(
        asked.components, asked.stare, asked.flare, amplitudes=asked.amplitudes,
        first=FIRST_STARE, count=N_STARES, seed=5, method=method,
    )  # fmt: skip
    if reduction is None:
        np.testing.assert_array_equal(found["values"], np.moveaxis(whole, 0, 1))
    else:
        for name, values in reduction(whole, FIRST_STARE).items():
            np.testing.assert_array_equal(found[name], values)
    assert (whole[1] != whole[0]).any()


def local(engine: Engine, **how: Any) -> Pool:
    """Return a pool with an engine instead of its own."""
    return Pool(LocalWorkers([None], make=lambda device, progress: engine), **how)


@pytest.mark.parametrize("fails", [{2, 5, 6}, set(range(99))])
def test_failed_launch_is_repeated(
    engine: Engine, scene: list[Expectation], fails: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fail after half of a shard is counted; each further attempt has a new context."""
    wanted, made, calls, count = detected(engine, scene), list[Engine](), itertools.count(), Engine.count

    def failing(engine: Engine, request: Any, shard: Any, **more: Any) -> Any:
        if next(calls) not in fails:
            return count(engine, request, shard, **more)
        count(engine, request, replace(shard, count=shard.count // 2))
        raise engine.open_device.cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES", -5, "")

    def make(device: str | None, progress: Any) -> Engine:
        made.append(engine)
        return engine

    monkeypatch.setattr(Engine, "count", failing)
    pool = Pool(LocalWorkers([None], make=make))
    if len(fails) == 3:
        same(detected(pool, scene), wanted)
        assert (pool.standing.retries, len(made)) == (3, 4)
        return
    with failed("failed", "realisations 0 to 4095 failed 8 times", "OUT_OF_RESOURCES"):
        detected(pool, scene)


def test_closed_workers_end_every_wait(engine: Engine, scene: list[Expectation], monkeypatch: Any) -> None:
    """Close workers while a pool waits for a shard that is counted and for another behind it, its last."""
    begun, free, count = threading.Event(), threading.Event(), Engine.count

    def held(*given: Any, **more: Any) -> Any:
        begun.set()
        assert free.wait(60)
        return count(*given, **more)

    monkeypatch.setattr(Engine, "count", held)
    pool = local(engine)
    asking = in_background(lambda: detected(pool, scene, 8192))
    assert begun.wait(60)
    closing = in_background(pool.workers.close)
    time.sleep(0.2)
    free.set()
    with pytest.raises((pools.Stopped, RuntimeError)):
        asking.result(60)
    closing.result(60)


def test_fingerprints_distinguish_requests(scene: list[Expectation], monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the name of a shard changes with everything that changes an answer, and with nothing else."""
    quiet, *flares = scene
    own = [Linear("own", level * np.ones(quiet.wavelength_nm.size)) for level in (1.0, 2.0)]
    brighter = replace(flares[1], source_electrons=np.nextafter(flares[1].source_electrons, np.inf))

    def asked(flares: Sequence[Expectation] = flares, seed: int = 5, **how: Any) -> requests.DetectRequest:
        return requests.DetectRequest.of(quiet, tuple(flares), N, seed, **{"statistics": ("chi2", "matched")} | how)

    base, stares = asked(), flaring_stares()
    unlit, how = replace(stares, flare=None, amplitudes=None), {"jitters": {"light": 0.01}}
    asks: list[dict[str, Any]] = [
        {"seed": 6}, {"mode": "frames"}, {"flares": flares[::-1]}, {"flares": [flares[0], brighter]},
        {"statistics": ("chi2",)}, *({"statistics": ("chi2", one)} for one in own),
        {"comparison": Comparison.of("exposure")}, *({"nuisances": {"dark": sd}} for sd in (0.1, 0.2)),
        {"processes": mauvecl.Processes(jitter=mauvecl.Uniform(0.0, 0.01))},
    ]  # fmt: skip
    # Rows belong to stares: from another first one on they mean something else.
    changes: list[dict[str, Any]] = [
        {}, {"seed": 6}, {"method": "pixels"}, {"flare": np.nextafter(stares.flare, 9)}, {"start": stares.start + 64},
        {"stare": Stare.of(30.0, **how, offsets={"temperature": 0.1}, temperature_c=np.nextafter(21, 22))},
        {"stare": Stare.of(30.0, **how, offsets={"star": 0.1}, temperature_c=21.0)},
        {"components": replace(stares.components, weights=2 * stares.components.weights)},
        {"amplitudes": stares.amplitudes[:1]}, *({"reduction": one} for one in (Reduced(), *ABOVE)),
    ]  # fmt: skip
    others = [*(asked(**one) for one in asks), *(replace(stares, **one) for one in changes), unlit]
    names = [shards.fingerprint(one) for one in (base, *others)]
    assert len(set(names)) == len(names)
    reported = replace(quiet, provenance={"from": "elsewhere"}, messages=())
    for same_one in (replace(base, realisations=7), replace(base, quiet=reported), pickle.loads(pickle.dumps(base))):
        assert shards.fingerprint(same_one) == names[0]
    assert shards.fingerprint(pickle.loads(pickle.dumps(stares))) == shards.fingerprint(stares)
    assert shards.fingerprint(replace(unlit, start=0, realisations=7)) == names[-1]
    monkeypatch.setattr(shards, "FORM", 1)
    assert shards.fingerprint(base) != names[0], "shards of an older form are not read"


def test_shards_depend_on_the_number_of_realisations_in_the_last_and_largest_only(scene: Any, monkeypatch: Any) -> None:
    """A longer run finds the shards of a shorter one; huge ones have as many as one process can add up."""

    def cut(n: int) -> list[shards.Shard]:
        found = shards.shards(requests.DetectRequest(scene[0], tuple(scene[1:]), n, 5, ("chi2",)))
        assert sum(shard.count for shard in found) == n
        assert all(shard.count & (shard.count - 1) == 0 for shard in found[:-1])
        return found

    short, long = cut(N), cut(10 * N)
    assert short[:-1] == long[: len(short) - 1]
    monkeypatch.setattr(shards, "SHARD_WORK", 2**34)
    for n in (10**6, 10**9, 10**12, 10**15):
        assert len(cut(n)) <= 2 * shards.MAX_SHARDS + 1


def at_work(folder: Path, engine: Engine, progress: Any = None, study: mauvecl.Study | None = None, **how: Any) -> Any:
    """Ask for a detection whose shards are kept; return it, the pool and the checkpoint."""
    with shards.Checkpoint(folder, "detect", study or small(), **{"patience_s": 0.0} | how) as checkpoint:
        pool = local(engine, checkpoint=checkpoint, progress=progress)
        return detected(pool, SCENE), pool, checkpoint


@pytest.fixture(scope="module")
def whole(engine: Engine) -> Detection:
    return detected(engine, SCENE)


@pytest.fixture
def begun(tmp_path: Path, engine: Engine) -> Path:
    """Return the folder of a run that was interrupted after 20 000 realisations."""

    def progress(done: int, total: int) -> None:
        if done >= 20_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        at_work(tmp_path, engine, progress)
    return tmp_path


def shards_in(folder: Path) -> list[Path]:
    return sorted((folder / "checkpoint").glob("*.npz"))


def manifest(folder: Path) -> Path:
    return folder / "checkpoint" / "manifest.json"


#: What happens to the files of an interrupted run, and whether a shard, or the manifest, is then found to be damaged.
DAMAGES: dict[str, tuple[Callable[[Path], object], bool, bool]] = {
    "none": (lambda folder: None, False, False),
    "flipped digest": (lambda folder: flip(shards_in(folder)[0], 0), True, False),
    "flipped header": (lambda folder: flip(shards_in(folder)[0], 20), True, False),
    "flipped end": (lambda folder: flip(shards_in(folder)[0], -1), True, False),
    "misplaced": (lambda folder: shards_in(folder)[0].write_bytes(shards_in(folder)[1].read_bytes()), True, False),
    "flipped manifest": (lambda folder: flip(manifest(folder), manifest(folder).read_text().index("7.4")), False, True),
    "empty manifest": (lambda folder: manifest(folder).write_text(""), False, True),
    "no manifest": (lambda folder: manifest(folder).unlink(), False, True),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_interrupted_run_is_resumed_whatever_happens_to_its_files(
    begun: Path, engine: Engine, whole: Detection, damage: str
) -> None:
    text = manifest(begun).read_text()
    work, shard, in_manifest = DAMAGES[damage]
    work(begun)
    found, pool, checkpoint = at_work(begun, engine, progress := Mock(), resume=True)
    same(found, whole)
    assert checkpoint.damaged == int(shard)
    about = [said for said in checkpoint.messages if "manifest" in said]
    assert ["damaged or missing" in said for said in about] == [True] * in_manifest
    assert 16_000 - 4096 * shard < pool.standing.resumed < N
    assert manifest(begun).read_text() == text
    # Progress includes what was resumed.
    reported = [one.args for one in progress.call_args_list]
    assert (reported[0], reported[-1], reported) == ((0, N), (N, N), sorted(reported))
    assert (pool.standing.shards, pool.standing.of, pool.standing.retries) == (8, 8, 0)
    checkpoint.forget()
    assert list(begun.iterdir()) == []


def test_unfinished_run_is_not_overwritten(begun: Path, engine: Engine) -> None:
    with refused("resume", "`resume=True`", "`restart=True`"):
        at_work(begun, engine)
    other = small().with_settings(["run.seed=4", "flare.amplitudes=[0.1]"])
    with refused("restart", "flare.amplitudes.0", "flare.amplitudes.1"):
        at_work(begun, engine, study=other, resume=True)
    with shards.Checkpoint(begun, "detect", small(), resume=True), refused("lock"):
        at_work(begun, engine)
    _, pool, _ = at_work(begun, engine, restart=True)
    assert pool.standing.resumed == 0
    # Neither are counts of another form read.
    content = json.loads(manifest(begun).read_text())
    old = {key: value for key, value in content.items() if key not in ("form", "digest")}
    digest = hashlib.sha256(json.dumps(old, sort_keys=True).encode()).hexdigest()
    manifest(begun).write_text(json.dumps(old | {"digest": digest}))
    with refused("restart", "form", "`restart=True`"):
        at_work(begun, engine, resume=True)


def test_short_run_leaves_no_files_and_full_disk_is_resumed(
    tmp_path: Path, engine: Engine, whole: Detection, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_work(tmp_path, engine, patience_s=shards.PATIENCE_S)
    assert list(tmp_path.iterdir()) == []
    with monkeypatch.context() as patch:
        full_after(400_000, patch)
        with refused("file"):
            at_work(tmp_path, engine)
    kept = len(shards_in(tmp_path))
    assert kept >= 1
    found, pool, _ = at_work(tmp_path, engine, resume=True)
    assert pool.standing.resumed == kept * 4096
    same(found, whole)


def test_background_work_begins_once_after_the_devices() -> None:
    begun: list[int] = []
    pool = Pool(LocalWorkers(), meanwhile=lambda: begun.append(pool.standing.of))
    assert begun == []
    for _ in range(2):
        detected(pool, SCENE)
    assert [of > 0 for of in begun] == [True]


def test_answers_keep_their_order_and_errors_end_the_rest(engine: Engine, scene: Any) -> None:
    pool = Pool(Shuffled(engine, 1))
    pauses: Sequence[float] = [0.05, 0.0, 0.03, 0.01, 0.02, 0.0]
    together = threading.Barrier(pool.workers.count)

    def slow(number: int) -> int:
        if number < together.parties:
            together.wait(10)
        time.sleep(pauses[number])
        return number

    assert list(pools.map_in_order(pool, slow, range(6))) == list(range(6))

    begun: list[int] = []
    answers = pools.map_in_order(pool, begun.append, range(100))
    for _ in range(5):
        next(answers)
    time.sleep(0.05)
    before = len(begun)
    assert before < 20, "few are ahead of their use"
    answers.close()
    time.sleep(0.05)
    assert len(begun) == before, "and none after it"

    def bad(number: int) -> int:
        if number == 2:
            raise mauvecl.InputError.of("number", 2, "another")
        return number

    with refused("number", "2"):
        list(pools.map_in_order(pool, bad, range(6)))
    with pytest.raises(pools.Stopped):
        detected(pool, scene)
    # So does progress that raises: work ahead of a verb is stopped before its workers are closed.
    axes = {"x": {"quantity": "magnitude", "values": [6, 8]}, "y": {"quantity": "amplitude", "values": [0.05, 0.2]}}
    pool = Pool(Shuffled(engine, 1))
    with pytest.raises(ArithmeticError):
        mauvecl.map(small(map=axes), pool, Mock(side_effect=ArithmeticError))
    with pytest.raises(pools.Stopped):
        detected(pool, scene)


def test_cluster_that_cannot_start_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE_S", 1.0)
    with pytest.raises(RuntimeError, match=r"tcp://127\.0\.0\.1:1"):
        DaskWorkers("tcp://127.0.0.1:1")
    # None is started without encryption.
    for package, name in (("cryptography", "cryptography"), ("distributed", "dask")):
        monkeypatch.setitem(sys.modules, package, None)
        with refused(name, "'mauvecl[cluster]'"):
            DaskWorkers("local:2")
