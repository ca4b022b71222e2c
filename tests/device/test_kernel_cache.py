"""Compiled kernels: damaged stores, failing compilers and linkers cause a new build or one sentence, never a crash."""

import errno
import os
import re
import shutil
import sys
import time
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from processes import printed, python
from stores import flip

from mauvecl import Engine
from mauvecl.device import build, drivers

#: Script that runs two kernels on the toy scene, and prints digest and level, and what came from the store, or the
#: error. PoCL's compiler would write the number of warnings to file descriptor 2.
RUN = """
import hashlib, sys
from mauvecl.device import build, drivers, selftest
def digest(engine):
    x = selftest.toy(frames=1)
    build.build(engine.open_device.context, "#warning one\\nkernel void f(global int *a) {{ int unused; a[0] = 1; }}")
    raw, seen = engine.realise(x, count=64, seed=1), engine.snr(x, realisations=64, seed=1)
    return hashlib.sha256(raw.tobytes() + seen.counts.dense("pixel").tobytes()).hexdigest()
{before}
from mauvecl import Engine, InputError
restore, restored = drivers.KernelCache.restore, []
drivers.KernelCache.restore = lambda cache, key: restored.append(restore(cache, key)) or restored[-1]
try:
    print("drawn", digest(Engine()), *drivers.settled.values())
    print("restored", sum(restored), "of", len(restored))
    print("work", drivers.kernel_cache().work)
except (drivers.DeviceError, InputError) as error:
    print("sentence", str(error).count(chr(10)), error)
"""


def run(cache: Path | str, before: str = "", *, typed: str | None = None, **environment: str) -> dict[str, str]:
    """Run a separate process, which PoCL may abort, and return what it prints."""
    code = RUN.format(before=before)
    done = python(code, typed=None if typed is None else typed.format(code=code), cache=cache, **environment)
    assert done.stderr == "" or "The next lower level" in done.stderr
    return printed(done.stdout)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a filled cache, and what was drawn."""
    cache = tmp_path_factory.mktemp("filled")
    first = run(cache)
    assert first["restored"].startswith("0 of")
    return cache, first["drawn"]


@pytest.fixture
def best(filled: tuple[Path, str]) -> str:
    """Return the level for which the default device compiles."""
    level = filled[1].split()[1]
    if level == "None":
        pytest.skip("the default device chooses what it compiles for by itself")
    return level


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
    """Neither does it try a level again, and the store may be read-only.

    A second engine keeps the files of loaded kernels, since a process crashes if they are written again.
    """
    source, drawn = filled
    cache = tmp_path / "cache"
    shutil.copytree(source, cache)
    folders = [cache, *(path for path in cache.rglob("*") if path.is_dir())]
    untried = "drivers._try = lambda *a: print('tried', a[0])"
    twice = "from mauvecl import Engine as E; one = E(); assert digest(one) == digest(E()) == digest(one)"
    for state, before in (("intact", untried), ("damaged", ""), ("read-only", untried), ("used twice", twice)):
        if state == "damaged":
            for path in files_of(cache):
                DAMAGE["a flipped bit"](path)
        for path in folders:
            path.chmod(0o555 if state == "read-only" else 0o755)
        again = run(cache, before)
        restored, _, wanted = again["restored"].partition(" of ")
        assert (again["drawn"], "tried" in again) == (drawn, False)
        assert restored == ("0" if state == "damaged" else wanted)
        assert wanted != "0"
        # Only the store remains after a process ends.
        assert not Path(again["work"]).exists()


def build_in(cache: drivers.KernelCache, number: int, size: int = 100) -> Path:
    with cache.building(f"key{number}"):
        folder = cache.work / "AA" / f"program{number}"
        folder.mkdir(parents=True)
        (folder / "program.bc").write_bytes(bytes(size))
    return folder


def test_concurrent_processes_share_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Store a program at the next build, not only at the end of the process, and remove the oldest of too many."""
    one = drivers.KernelCache(tmp_path / "store", tmp_path / "work-1")
    # The first launch completes the program.
    (build_in(one, 0) / "kernel.so").write_bytes(bytes(100))
    build_in(one, 1)
    other = drivers.KernelCache(tmp_path / "store", tmp_path / "work-2")
    assert other.restore("key0")
    assert [path.name for path in files_of(other.work)] == ["kernel.so", "program.bc"]
    monkeypatch.setattr(drivers, "MAX_STORED", 25_000)
    for number in range(4):
        cache = drivers.KernelCache(tmp_path / "limited", tmp_path / f"own{number}")
        build_in(cache, number, 10_000)
        cache.store_programs()
        then = time.time() - 100 + number
        os.utime(cache.store / f"key{number}.zip", (then, then))
    assert sorted(path.name for path in cache.store.iterdir()) == ["key2.zip", "key3.zip"]
    assert ZipFile(cache.store / "key3.zip").namelist() == ["AA/program3/program.bc"]


@pytest.mark.long
def test_run_succeeds_where_nothing_can_be_stored(filled: tuple[Path, str], tmp_path: Path) -> None:
    """Run while the disk fills: results are unchanged, and no incomplete file is read."""
    # The first build's own process is left out, since its disk is not full.
    before = f"""
from pathlib import Path
opened = Path.open
def full(path, mode="r", *rest, **more):
    if "store" in path.parts and "w" in mode:
        raise OSError({errno.ENOSPC}, "No space left on device")
    return opened(path, mode, *rest, **more)
Path.open = full
"""
    assert run(tmp_path, before, MAUVECL_BUILD_LIMIT_S="0")["drawn"] == filled[1]
    assert files_of(tmp_path) == []
    # A folder that cannot be used is replaced, and without free space a remedy is named.
    found = run("/dev/null/mauvecl")
    assert (found["drawn"], found["work"].startswith("/dev/null")) == (filled[1], False)
    said = run(tmp_path, "drivers.MIN_FREE_BYTES = 2**60")["sentence"]
    assert all(words in said for words in ("no folder for compiled kernels", "MAUVECL_CACHE_DIR"))
    for wrong in ("-1", "nan", "x"):
        said = run(tmp_path, MAUVECL_BUILD_LIMIT_S=wrong)["sentence"]
        assert re.fullmatch(f"0 MAUVECL_BUILD_LIMIT_S must be between 1 and 86400 seconds.* not '{wrong}'", said)


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


def test_installations_do_not_share_programs(monkeypatch: pytest.MonkeyPatch, engine: Engine) -> None:
    """Use different keys, since PoCL compiles a program of another installation again at every start."""
    keys: list[str] = []
    restore = drivers.KernelCache.restore
    monkeypatch.setattr(drivers.KernelCache, "restore", lambda cache, key: keys.append(key) or restore(cache, key))
    for place in ("one", "other", "one"):
        monkeypatch.setattr(sys, "prefix", place)
        build.build(engine.open_device.context, "kernel void f(global int *a) { a[0] = 1; }")
    assert keys[0] == keys[2] != keys[1]


#: Child that fails when it compiles for the first name, and does nothing otherwise.
CHILD = """
import json, sys, os, ctypes, time; asked = json.loads(sys.argv[1]); sys.path[:] = asked["path"]
from mauvecl.device import selftest
selftest.limit(asked)
if asked["name"] == "bad" or asked["name"] is None:
    {act}
"""
#: Failures of a first build and the messages that report them.
ACTS = {
    "ctypes.string_at(0)": "ended by a signal (segmentation fault",
    "\n    while True: pass": "of processor time",
    "print('no kernels today'); sys.exit(1)": "failed (no kernels today)",
    "os.write(2, b'error: linker command failed'); os.abort()": "(aborted: error: linker command failed)",
    "bytearray(6 * 2**30)": "failed (MemoryError)",
    "time.sleep(60)": "not finished after",
    "os.kill(os.getpid(), 9)": "ended by a signal (killed",
}


def misbehaving(act: str, names: str) -> str:
    # A wall-clock limit of two seconds per second of processor time ends sleeping children soon.
    clock = "drivers.CLOCK = 2.0; " if "sleep" in act else ""
    return f"{clock}drivers.CHILD = {CHILD.format(act=act)!r}; drivers.names = lambda device: {names}"


@pytest.mark.long
@pytest.mark.parametrize("act", ["ctypes.string_at(0)", "bytearray(6 * 2**30)", "os.kill(os.getpid(), 9)", "znver3"])
def test_next_level_is_tried_after_compiler_failure(act: str, tmp_path: Path, filled: Any, best: str) -> None:
    """PoCL 3.0 with AVX-512 crashes for the name znver3 after minutes and gigabytes, if its child is not stopped."""
    before, start = misbehaving(act, f"('bad', {best!r})"), time.monotonic()
    if act == "znver3":
        if "avx512f" not in drivers.flags():
            pytest.skip("this processor has no AVX-512")
        before = f"drivers.names = lambda device: ('znver3', {best!r})"
    assert run(tmp_path, before, MAUVECL_BUILD_LIMIT_S="4")["drawn"] == filled[1]
    assert time.monotonic() - start < 100


@pytest.mark.long
@pytest.mark.parametrize("act", ACTS)
def test_failure_at_every_level_is_one_sentence(act: str, tmp_path: Path, filled: tuple[Path, str]) -> None:
    """The next run tries again."""
    found = run(tmp_path, misbehaving(act, "(None,)"), MAUVECL_BUILD_LIMIT_S="2")
    assert found.keys() == {"sentence"}
    assert found["sentence"].startswith("0 ")
    assert all(word in found["sentence"] for word in ("driver", ACTS[act], "conda-forge", "MAUVECL_BUILD_LIMIT_S"))
    if act == "ctypes.string_at(0)":
        assert run(tmp_path)["drawn"] == filled[1]


#: Linkers, each a script in front of the usual one: one that fails, and one that knows none of the folders where
#: compilers install their libraries.
LINKERS = {
    "fails": "#!/bin/sh\nexit 1\n",
    "no folders": f"""#!{sys.executable}
import os, sys
words = [w for w in sys.argv[1:] if not w.startswith("-L") or "libraries" in w]
open(__file__ + ".log", "a").write(" ".join(words) + chr(10))
os.execv({shutil.which("ld")!r}, ["ld", "-nostdlib", *words])
""",
}


@pytest.mark.long
def test_linkers(tmp_path: Path, filled: tuple[Path, str]) -> None:
    """A missing or failing linker is reported, where PoCL would abort Python; neither PATH nor compiler is needed."""
    said = run(tmp_path / "cache", PATH=str(tmp_path))["sentence"]
    assert all(words in said for words in ("no linker `ld`", "binutils"))
    for path in ("del os.environ['PATH']", "os.environ['PATH'] = ''"):
        assert run(tmp_path / "no path", f"import os; {path}")["drawn"] == filled[1]
    for name, script in LINKERS.items():
        linker = tmp_path / name / "ld"
        linker.parent.mkdir()
        linker.write_text(script, encoding="utf-8")
        linker.chmod(0o755)
        path = f"{linker.parent}{os.pathsep}{os.environ['PATH']}"
        found = run(tmp_path / "cache", PATH=path, LIBRARY_PATH="")
        if name == "fails":
            assert "linker" in found["sentence"]
        else:
            assert found["drawn"] == filled[1]
            assert "-lgcc" in linker.with_suffix(".log").read_text(encoding="utf-8")


@pytest.mark.long
@pytest.mark.parametrize("how", ["typed, in a thread", "no executable"])
def test_first_build_works_for_every_way_to_start_python(how: str, tmp_path: Path, filled: Any) -> None:
    typed = "import threading\nt = threading.Thread(target=exec, args=({code!r}, {{}}))\nt.start(); t.join()\n"
    before, how_typed = ("sys.executable = None", None) if how == "no executable" else ("", typed)
    assert run(tmp_path, before, typed=how_typed)["drawn"] == filled[1]
