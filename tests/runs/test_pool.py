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
from commands import run
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


@pytest.mark.parametrize("start", [0, 2**32 - 5000])
def test_order_of_shards_does_not_affect_the_answer(engine: Engine, scene: list[Expectation], start: int) -> None:
    quiet, *flares = scene
    own = Linear("own", np.linspace(0.0, 1.0, quiet.wavelength_nm.size))
    how: dict[str, Any] = {"start": start, "statistics": ("chi2", "matched", own)}
    pool = Pool(Shuffled(engine, 3))
    same(detected(pool, scene, **how), detected(engine, scene, **how))
    n_shards = len(shards.shards(requests.DetectRequest(quiet, tuple(flares), N, 5, ("chi2",), start=start)))
    assert pool.standing.shards == pool.standing.of == n_shards
    same_snr(*(one.snr(quiet, realisations=N, seed=5, start=start) for one in (pool, engine)))


@pytest.mark.long
def test_shards_of_several_launches_with_all_arguments_join(engine: Engine) -> None:
    scene = star(amplitudes=tuple(np.linspace(0.01, 0.3, 17)), payload=instrument(part=True))
    how: dict[str, Any] = {"n": 9000, "statistics": ("chi2_pair", "matched")}
    how |= {"comparison": Comparison.of("stack:3", "estimated")}
    how |= {"processes": mauvecl.Processes(jitter=mauvecl.Uniform(0.0, 0.05))}
    pool = Pool(Shuffled(engine, 4))
    same(detected(pool, scene, **how), detected(engine, scene, **how))
    assert pool.standing.of == 2 * 3


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
    widths, counted = iter((16, 1)), set()

    class Noted(Engine):
        def count(self, *given: Any, **more: Any) -> Any:
            counted.add(id(self))
            return super().count(*given, **more)

    workers = LocalWorkers([None, "0"], make=lambda device, progress: Noted(device, width=next(widths)))
    pool = Pool(workers)
    found = pool.stares(pickle.loads(pickle.dumps(asked)))
    workers.close()
    assert len(counted) == 2, "both worked"
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


class Failing:
    """An engine whose launches fail at chosen calls."""

    def __init__(self, engine: Engine, fails: set[int], calls: list[int]) -> None:
        self._engine, self._fails, self._calls = engine, fails, calls
        self.open_device, self.device, self.device_name = engine.open_device, engine.device, engine.device_name

    def count(self, request: Any, shard: Any, **more: Any) -> Any:
        self._calls.append(len(self._calls))
        if self._calls[-1] in self._fails:
            # Half of the shard is counted already when it fails.
            self._engine.count(request, replace(shard, count=shard.count // 2))
            raise self.open_device.cl.RuntimeError("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES", -5, "")
        return self._engine.count(request, shard, **more)


def working(make: Callable[[], Any]) -> Pool:
    return Pool(LocalWorkers([None], make=lambda device, progress: make()))


def test_failed_launch_is_repeated(engine: Engine, scene: list[Expectation]) -> None:
    calls, made = list[int](), list[Failing]()

    def make() -> Failing:
        made.append(Failing(engine, {2, 5, 6}, calls))
        return made[-1]

    pool = working(make)
    same(detected(pool, scene), detected(engine, scene))
    assert pool.standing.retries == 3
    assert len(made) == 4, "each time with a new context"
    pool = working(lambda: Failing(engine, set(range(99)), []))
    with failed("failed", "realisations 0 to 4095 failed 8 times", "OUT_OF_RESOURCES"):
        detected(pool, scene)


def test_closed_workers_end_every_wait(engine: Engine, scene: list[Expectation]) -> None:
    """Close workers while a pool waits for a shard that is counted and for another behind it, its last."""
    begun, free = threading.Event(), threading.Event()

    class Held(Failing):
        def count(self, request: Any, shard: Any, **more: Any) -> Any:
            begun.set()
            assert free.wait(60)
            return engine.count(request, shard, **more)

    pool = working(lambda: Held(engine, set(), []))
    asking = in_background(lambda: detected(pool, scene, 8192))
    assert begun.wait(60)
    closing = in_background(pool.workers.close)
    time.sleep(0.2)
    free.set()
    with pytest.raises((pools.Stopped, RuntimeError)):
        asking.result(60)
    closing.result(60)


AXES = {"x": {"quantity": "magnitude", "values": [6, 8, 10]}, "y": {"quantity": "amplitude", "values": [0.05, 0.2]}}
#: Tables: verb, attribute of its answer, sections of the study.
TABLES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "detect": ("detect", "table", {}), "limit": ("limit", "table", {}), "map": ("map", "table", {"map": AXES}),
    "snr": ("snr", "element", {"sweep": {"axes": [{"quantity": "exposure", "values": [5, 50]}]}}),
    "unknowns": ("map", "table", {"map": AXES, "unknowns": {"draws": 3}}),
}  # fmt: skip


@pytest.mark.parametrize("name", long_but(TABLES, "detect", "map", "snr"))
def test_pool_gives_the_table_of_the_engine(engine: Engine, name: str) -> None:
    verb, table, sections = TABLES[name]
    ask = getattr(mauvecl, verb)
    ours, theirs = (getattr(ask(small(**sections), one), table) for one in (engine, Pool(Shuffled(engine, 9))))
    assert ours.colnames == theirs.colnames
    for name in ours.colnames:
        np.testing.assert_array_equal(np.asarray(ours[name]), np.asarray(theirs[name]), err_msg=name)


def test_fingerprints_distinguish_requests(scene: list[Expectation]) -> None:
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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "FORM", 1)
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
        pool = Pool(LocalWorkers([None], make=lambda d, progress: engine), checkpoint=checkpoint, progress=progress)
        return detected(pool, SCENE), pool, checkpoint


#: Of all runs below.
SCENE = star(amplitudes=(0.05, 0.24), payload=instrument(part=True))


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


def test_jumps_of_the_clock_have_no_effect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the wall time jump and run backwards while a command reports its progress."""
    leaps, real = itertools.cycle([1e9, -1e9, 0.0, 5e9]), time.time
    question = "-s G2V -m 7.4 -a 0.24 -n 30000 --fap 0.1 --statistic chi2 --no-pictures"
    words = ("detect", *question.split())
    monkeypatch.setitem(shards.Checkpoint.__init__.__kwdefaults__, "patience_s", 0.0)
    run(*words, "--output", "usual", folder=tmp_path)
    monkeypatch.setattr(time, "time", lambda: real() + next(leaps))
    run(*words, "--output", "jumps", folder=tmp_path)
    usual, jumps = ((tmp_path / name / "detection.ecsv").read_bytes() for name in ("usual", "jumps"))
    assert usual == jumps


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


def test_answers_keep_their_order_and_errors_end_the_rest(engine: Engine) -> None:
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
        detected(pool, SCENE)


def test_progress_that_raises_stops_the_work_ahead_of_it(engine: Engine) -> None:
    """Check that work ahead of a verb's progress is stopped before its workers are closed."""
    pool = Pool(Shuffled(engine, 1))
    with pytest.raises(ArithmeticError):
        mauvecl.map(small(map=AXES), pool, Mock(side_effect=ArithmeticError))
    with pytest.raises(pools.Stopped):
        detected(pool, SCENE)


@pytest.mark.parametrize("package", ["distributed", "cryptography"])
def test_missing_package_raises(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse to start a cluster without encryption."""
    monkeypatch.setitem(sys.modules, package, None)
    with refused({"distributed": "dask"}.get(package, package), "'mauvecl[cluster]'"):
        DaskWorkers("local:2")


def test_absent_scheduler_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE_S", 1.0)
    with pytest.raises(RuntimeError, match=r"tcp://127\.0\.0\.1:1"):
        DaskWorkers("tcp://127.0.0.1:1")
