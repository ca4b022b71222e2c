"""Cache of compiled kernels: damage causes a new build, but never a failure or a different result."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from zipfile import ZipFile

import pytest
from processes import printed, python
from stores import flip

from mauvecl import Engine
from mauvecl.device import build, drivers

#: Script that runs two kernels on the toy scene and prints whether they came from the store.
RUN = """
import hashlib, sys
from mauvecl.device import build, drivers
from mauvecl.device.selftest import toy
def digest(engine):
    x = toy(frames=1)
    raw, seen = engine.realise(x, count=64, seed=1), engine.snr(x, realisations=64, seed=1)
    return hashlib.sha256(raw.tobytes() + seen.counts.pixel.tobytes()).hexdigest()
{before}
from mauvecl.device.engine import DeviceError, Engine
restore, restored = drivers.KernelCache.restore, []
drivers.KernelCache.restore = lambda cache, key: restored.append(restore(cache, key)) or restored[-1]
try:
    print("digest", digest(Engine()))
    print("restored", sum(restored), "of", len(restored))
    print("work", drivers.kernel_cache().work)
except DeviceError as error:
    print("sentence", error)
"""


def run(cache: Path | str, before: str = "") -> dict[str, str]:
    """Run a separate process, which PoCL may abort, and return what it prints."""
    done = python(RUN.format(before=before), cache=cache)
    assert done.stderr == ""
    return printed(done.stdout)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a cache that one process has filled, and the digest that it printed."""
    cache = tmp_path_factory.mktemp("filled")
    first = run(cache)
    assert first["restored"].startswith("0 of")
    return cache, first["digest"]


def files_of(cache: Path) -> list[Path]:
    return sorted(path for path in cache.rglob("*") if path.is_file())


@pytest.mark.long
def test_second_process_builds_nothing(filled: tuple[Path, str]) -> None:
    cache, digest = filled
    again = run(cache)
    restored, _, wanted = again["restored"].partition(" of ")
    assert again["digest"] == digest
    assert restored == wanted != "0"
    # Only the store remains after a process ends.
    assert not Path(again["work"]).exists()


DAMAGE = {
    "a flipped bit": lambda path: flip(path, path.stat().st_size // 2),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "emptied": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(b"\xff\x00 nothing of the kind"),
    "gone": lambda path: path.unlink(),
}


def store_of(cache: Path) -> Path:
    (store,) = cache.glob("*/store")
    return store


@pytest.mark.long
@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_program_is_not_restored(filled: tuple[Path, str], tmp_path: Path, kind: str) -> None:
    """Keep damaged files of every kind out of the folder that PoCL reads."""
    shutil.copytree(store_of(filled[0]), tmp_path / "store")
    cache = drivers.KernelCache(tmp_path, tmp_path / "work")
    programs = list(cache.store.glob("*.zip"))
    assert len(programs) >= 2
    for stored in programs:
        DAMAGE[kind](stored)
        assert not cache.restore(stored.stem)
        assert files_of(cache.work) == []


@pytest.mark.long
@pytest.mark.parametrize(("kind", "ending"), [("a flipped bit", ".zip"), ("a flipped bit", ".txt")])
def test_damaged_store_is_rebuilt(filled: tuple[Path, str], tmp_path: Path, kind: str, ending: str) -> None:
    source, digest = filled
    cache = tmp_path / "cache"
    shutil.copytree(source, cache)
    damaged = [path for path in files_of(cache) if path.suffix == ending]
    assert damaged
    for path in damaged:
        DAMAGE[kind](path)
    after = run(cache)
    assert after["digest"] == digest
    if ending != ".txt":
        # A text is a rendered source: rendering gives the same text again, and its program is found.
        assert after["restored"].startswith("0 of")
    healed = run(cache)
    restored, _, wanted = healed["restored"].partition(" of ")
    assert (healed["digest"], restored) == (digest, wanted)


def test_concurrent_processes_share_programs(tmp_path: Path) -> None:
    """Store a program at the next build, not only at the end of the process."""
    one = drivers.KernelCache(tmp_path, tmp_path / "work-1")
    for number in range(2):
        with one.building(f"key{number}"):
            (one.work / "AA" / f"program{number}").mkdir(parents=True)
            (one.work / "AA" / f"program{number}" / "program.bc").write_bytes(bytes(100))
        if number == 0:
            # The first launch completes the program.
            (one.work / "AA" / "program0" / "kernel.so").write_bytes(bytes(100))
    other = drivers.KernelCache(tmp_path, tmp_path / "work-2")
    assert other.restore("key0")
    assert [path.name for path in files_of(other.work)] == ["kernel.so", "program.bc"]


def test_archive_without_files_is_rejected(tmp_path: Path) -> None:
    cache = drivers.KernelCache(tmp_path, tmp_path / "work")
    cache.store.mkdir()
    ZipFile(cache.store / "key.zip", "w").close()
    assert not cache.restore("key")
    assert files_of(tmp_path) == []


@pytest.mark.long
def test_run_succeeds_on_full_disk(filled: tuple[Path, str], tmp_path: Path) -> None:
    """Run while the disk fills: results are unchanged, and no incomplete file is read."""
    # The first build's own process is left out, since its disk is not full.
    before = f"""
import os
from pathlib import Path
os.environ["MAUVECL_BUILD_LIMIT_S"] = "0"
write_bytes, write_text = Path.write_bytes, Path.write_text
def full(path, *rest, **more):
    if "store" in path.parts:
        raise OSError({errno.ENOSPC}, "No space left on device")
    return (write_bytes if isinstance(rest[0], bytes) else write_text)(path, *rest, **more)
Path.write_bytes = Path.write_text = full
"""
    assert run(tmp_path, before)["digest"] == filled[1]
    assert files_of(tmp_path) == []


@pytest.mark.long
def test_error_without_free_space_names_remedy(tmp_path: Path) -> None:
    said = run(tmp_path, "drivers.MIN_FREE_BYTES = 2**60")["sentence"]
    assert "no folder for compiled kernels" in said
    assert "MAUVECL_CACHE_DIR" in said
    assert "\n" not in said


@pytest.mark.long
def test_unusable_cache_folder_is_replaced(filled: tuple[Path, str]) -> None:
    found = run("/dev/null/mauvecl")
    assert found["digest"] == filled[1]
    assert not found["work"].startswith("/dev/null")


@pytest.mark.long
def test_folder_of_killed_process_is_removed(filled: tuple[Path, str], tmp_path: Path) -> None:
    shutil.copytree(filled[0], tmp_path, dirs_exist_ok=True)
    code = "import time; from mauvecl import Engine; Engine(); print('up', flush=True); time.sleep(60)"
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        env=os.environ | {"MAUVECL_CACHE_DIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout.readline() == "up\n"
    left = list(tmp_path.glob("*/mauvecl-work-*"))
    assert len(left) == 1
    child.send_signal(signal.SIGKILL)
    child.wait()
    grow_old(left[0])
    assert run(tmp_path)["digest"] == filled[1]
    assert not left[0].exists()


def grow_old(work: Path) -> None:
    """Make a working folder look unused for longer than a day."""
    then = time.time() - 25 * 3600
    os.utime(work / "lock", (then, then))


HOLDS = "from mauvecl.device import drivers; print(drivers.kernel_cache().work, flush=True); input()"
SWEEPS = "import sys, pathlib; from mauvecl.device import drivers; drivers._sweep(pathlib.Path(sys.argv[1]))"
#: Commands that run another one with its own process numbers and host name, as on another machine.
ELSEWHERE = {
    "another container": ["unshare", "--pid", "--fork", "--mount-proc"],
    "another name": ["unshare", "--uts", "sh", "-c", 'hostname elsewhere && exec "$@"', "sh"],
    "both": ["unshare", "--pid", "--fork", "--mount-proc", "--uts", "sh", "-c", 'hostname elsewhere && "$@"', "sh"],
}


@pytest.mark.long
@pytest.mark.parametrize("place", ELSEWHERE)
@pytest.mark.parametrize("holder", ["here", "there"])
def test_containers_with_shared_home_keep_each_others_folders(tmp_path: Path, place: str, holder: str) -> None:
    """Keep a working folder while its process runs, and remove it afterwards, in any container."""
    there = ELSEWHERE[place]
    if subprocess.run([*there, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no namespaces can be made here")
    one, other = (there, []) if holder == "there" else ([], there)
    environment = os.environ | {"MAUVECL_CACHE_DIR": str(tmp_path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    child = subprocess.Popen([*one, sys.executable, "-c", HOLDS], env=environment, text=True, **pipes)  # type: ignore[call-overload]
    work = Path(child.stdout.readline().strip())
    grow_old(work)
    sweep = [*other, sys.executable, "-c", SWEEPS, work.parent]
    subprocess.run(sweep, env=environment, check=True)
    assert work.is_dir(), "swept while it was in use"
    (left,) = [int(p.name) for p in Path("/proc").glob("[0-9]*") if _holds(p, work / "lock")]
    os.kill(left, signal.SIGKILL)
    child.communicate()
    subprocess.run(sweep, env=environment, check=True)
    assert not work.exists()


def _holds(process: Path, file: Path) -> bool:
    try:
        return any(handle.readlink() == file for handle in (process / "fd").iterdir())
    except OSError:
        return False


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("hours", [0, 23, 25])
def test_working_folder_is_removed_by_age_and_lock(tmp_path: Path, hours: int, locked: bool) -> None:
    """Remove an unlocked folder after a day, since the locks of other hosts may be invisible."""
    folder = tmp_path / "mauvecl-work-0123456789abcdef"
    folder.mkdir()
    then = time.time() - hours * 3600
    with (folder / "lock").open("w") as lock:
        if locked:
            fcntl.flock(lock, fcntl.LOCK_EX)
        os.utime(folder / "lock", (then, then))
        drivers._sweep(tmp_path)
    assert folder.exists() == (locked or hours < 24)


@pytest.mark.long
def test_second_engine_does_not_rewrite_loaded_kernels(filled: tuple[Path, str]) -> None:
    """Keep the files of loaded kernels, since a process crashes if they are written again."""
    before = """
from mauvecl.device.engine import Engine as E
one = E()
first = digest(one)
two = E()
assert first == digest(two) == digest(one)
"""
    assert run(filled[0], before)["digest"] == filled[1]


def test_store_is_limited_in_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove the least recently used programs."""
    monkeypatch.setattr(drivers, "MAX_STORED", 25_000)
    for number in range(4):
        cache = drivers.KernelCache(tmp_path, tmp_path / f"work{number}")
        with cache.building(f"key{number}"):
            folder = cache.work / "AA" / f"program{number}"
            folder.mkdir(parents=True)
            (folder / "program.bc").write_bytes(bytes(10_000))
        cache.publish()
        then = time.time() - 100 + number
        os.utime(cache.store / f"key{number}.zip", (then, then))
    # Without new programs, the end of a run does not list the store.
    monkeypatch.setattr(cache, "_prune", lambda: pytest.fail("the store was looked through"))
    cache.publish()
    assert sorted(path.name for path in cache.store.iterdir()) == ["key2.zip", "key3.zip"]
    assert ZipFile(cache.store / "key3.zip").namelist() == ["AA/program3/program.bc"]


def test_installations_do_not_share_programs(monkeypatch: pytest.MonkeyPatch, engine: Engine) -> None:
    """Use different keys, since PoCL compiles a program of another installation again at every start."""
    keys: list[str] = []
    restore = drivers.KernelCache.restore
    monkeypatch.setattr(drivers.KernelCache, "restore", lambda cache, key: keys.append(key) or restore(cache, key))
    for place in ("one", "other", "one"):
        monkeypatch.setattr(sys, "prefix", place)
        build.build(engine.open_device.context, "kernel void f(global int *a) { a[0] = 1; }")
    assert keys[0] == keys[2] != keys[1]
