"""Cache of compiled kernels: damage causes a new build, but never a failure or a different result."""

import errno
import os
import shutil
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
    return hashlib.sha256(raw.tobytes() + seen.counts.dense("pixel").tobytes()).hexdigest()
{before}
from mauvecl import Engine
restore, restored = drivers.KernelCache.restore, []
drivers.KernelCache.restore = lambda cache, key: restored.append(restore(cache, key)) or restored[-1]
try:
    print("digest", digest(Engine()))
    print("restored", sum(restored), "of", len(restored))
    print("work", drivers.kernel_cache().work)
except drivers.DeviceError as error:
    print("sentence", error)
"""


def run(cache: Path | str, before: str = "") -> dict[str, str]:
    """Run a separate process, which PoCL may abort, and return what it prints."""
    done = python(RUN.format(before=before), cache=cache)
    assert done.stderr == ""
    return printed(done.stdout)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    cache = tmp_path_factory.mktemp("filled")
    first = run(cache)
    assert first["restored"].startswith("0 of")
    return cache, first["digest"]


def files_of(cache: Path) -> list[Path]:
    return sorted(path for path in cache.rglob("*") if path.is_file())


DAMAGE = {
    "a flipped bit": lambda path: flip(path, path.stat().st_size // 2),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "emptied": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(b"\xff\x00 nothing of the kind"),
    "gone": lambda path: path.unlink(),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_program_is_not_restored(filled: tuple[Path, str], tmp_path: Path, kind: str) -> None:
    (store,) = filled[0].glob("*/store")
    shutil.copytree(store, tmp_path / "store")
    cache = drivers.KernelCache(tmp_path / "store", tmp_path / "work")
    archives = [path for path in cache.store.glob("*.zip") if path.stat().st_size > 1000]
    assert len(archives) >= 2
    for stored in archives:
        DAMAGE[kind](stored)
        assert not cache.restore(stored.stem)
        assert files_of(cache.work) == []


@pytest.mark.long
def test_second_process_builds_nothing_unless_the_store_is_damaged(filled: tuple[Path, str], tmp_path: Path) -> None:
    source, digest = filled
    cache = tmp_path / "cache"
    shutil.copytree(source, cache)
    for is_damaged in (False, True, False):
        if is_damaged:
            for path in files_of(cache):
                DAMAGE["a flipped bit"](path)
        again = run(cache)
        restored, _, wanted = again["restored"].partition(" of ")
        assert again["digest"] == digest
        assert restored == ("0" if is_damaged else wanted)
        assert wanted != "0"
        # Only the store remains after a process ends.
        assert not Path(again["work"]).exists()


def build_in(cache: drivers.KernelCache, number: int, size: int = 100) -> Path:
    with cache.building(f"key{number}"):
        folder = cache.work / "AA" / f"program{number}"
        folder.mkdir(parents=True)
        (folder / "program.bc").write_bytes(bytes(size))
    return folder


def test_concurrent_processes_share_programs(tmp_path: Path) -> None:
    """Store a program at the next build, not only at the end of the process."""
    one = drivers.KernelCache(tmp_path / "store", tmp_path / "work-1")
    # The first launch completes the program.
    (build_in(one, 0) / "kernel.so").write_bytes(bytes(100))
    build_in(one, 1)
    other = drivers.KernelCache(tmp_path / "store", tmp_path / "work-2")
    assert other.restore("key0")
    assert [path.name for path in files_of(other.work)] == ["kernel.so", "program.bc"]


@pytest.mark.long
def test_run_succeeds_on_full_disk(filled: tuple[Path, str], tmp_path: Path) -> None:
    """Run while the disk fills: results are unchanged, and no incomplete file is read."""
    # The first build's own process is left out, since its disk is not full.
    before = f"""
import os
from pathlib import Path
os.environ["MAUVECL_BUILD_LIMIT_S"] = "0"
opened = Path.open
def full(path, mode="r", *rest, **more):
    if "store" in path.parts and "w" in mode:
        raise OSError({errno.ENOSPC}, "No space left on device")
    return opened(path, mode, *rest, **more)
Path.open = full
"""
    assert run(tmp_path, before)["digest"] == filled[1]
    assert files_of(tmp_path) == []


@pytest.mark.long
def test_unusable_cache_folder_is_replaced_and_an_error_without_free_space_names_a_remedy(
    filled: tuple[Path, str], tmp_path: Path
) -> None:
    found = run("/dev/null/mauvecl")
    assert (found["digest"], found["work"].startswith("/dev/null")) == (filled[1], False)
    said = run(tmp_path, "drivers.MIN_FREE_BYTES = 2**60")["sentence"]
    assert all(words in said for words in ("no folder for compiled kernels", "MAUVECL_CACHE_DIR"))


@pytest.mark.parametrize("days", [0, 89, 91])
def test_working_folder_of_killed_process_is_removed_after_90_days(tmp_path: Path, days: int) -> None:
    folder = tmp_path / f"{drivers.WORK}01234567"
    folder.mkdir()
    then = time.time() - days * 86400
    os.utime(folder, (then, then))
    # A link to nothing is listed and has no age, as a folder that another process removes meanwhile.
    (tmp_path / f"{drivers.WORK}removed").symlink_to(tmp_path / "nothing")
    assert drivers._working_folder(tmp_path) is not None
    assert folder.exists() == (days < 90)


@pytest.mark.long
def test_second_engine_does_not_rewrite_loaded_kernels(filled: tuple[Path, str]) -> None:
    """Keep the files of loaded kernels, since a process crashes if they are written again."""
    before = """
from mauvecl import Engine as E
one = E()
first = digest(one)
two = E()
assert first == digest(two) == digest(one)
"""
    assert run(filled[0], before)["digest"] == filled[1]


def test_store_is_limited_in_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers, "MAX_STORED", 25_000)
    for number in range(4):
        cache = drivers.KernelCache(tmp_path / "store", tmp_path / f"work{number}")
        build_in(cache, number, 10_000)
        cache.store_programs()
        then = time.time() - 100 + number
        os.utime(cache.store / f"key{number}.zip", (then, then))
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
