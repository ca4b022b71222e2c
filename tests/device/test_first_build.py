"""First builds with failing compilers: the user's process continues or ends with a one-sentence error."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import started
from processes import forked, printed, python

pytestmark = pytest.mark.long

#: Script that draws on the default device and prints the level and the counts' digest, or the error.
RUN = """
import hashlib, sys
from mauvecl.device import drivers
from mauvecl.device.engine import DeviceError, Engine
from mauvecl.device.selftest import toy
from mauvecl.schema.errors import InputError
{before}
try:
    engine = Engine()
    print("digest", hashlib.sha256(engine.realise(toy(), count=64, seed=1).tobytes()).hexdigest())
    print("level", *drivers.settled.values())
except (DeviceError, InputError) as error:
    print("sentence", str(error).count(chr(10)), error)
"""
#: Child that fails when it compiles for the first name, and does nothing otherwise.
CHILD = """
import json, sys, os, ctypes, time; asked = json.loads(sys.argv[1]); sys.path[:] = asked["path"]
from mauvecl.device.selftest import limit
limit(asked)
if asked["name"] == "bad" or asked["name"] is None:
    {act}
"""
#: Failures of compilers and the messages that report them.
ACTS = {
    "ctypes.string_at(0)": "crashed (segmentation fault)",
    "\n    while True: pass": "of processor time",
    "print('no kernels today'); sys.exit(1)": "no kernels today",
    "os.write(2, b'198 warnings generated.'); os.abort()": "crashed (aborted)",
}
#: Failures for which the driver is not to blame, and the messages that report them.
OTHERS = {
    "bytearray(6 * 2**30)": "ran out of memory",
    "time.sleep(60)": "not finished after",
    "os.kill(os.getpid(), 9)": "stopped from outside (killed)",
    "os.kill(os.getpid(), 15)": "stopped from outside (terminated)",
    "os.write(2, b'error: linker command failed with exit code 1'); os.abort()": "linker `ld`",
    "print('no room'); sys.exit(3)": "no room",
}


def run(cache: Path | str, before: str = "", **environment: str) -> dict[str, str]:
    """Run a separate process and return what it prints."""
    return printed(forked(RUN.format(before=before), cache=cache, **environment))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """Return the cache after a first start, and what this start printed."""
    cache = tmp_path_factory.mktemp("plain")
    return cache, run(cache)


@pytest.fixture
def chooses(plain: tuple[Path, dict[str, str]]) -> None:
    """Skip the test if mauvecl does not choose the processor name."""
    if plain[1]["level"] == "None":
        pytest.skip("the default device chooses what it compiles for by itself")


def misbehaving(act: str, names: str) -> str:
    # A wall-clock limit of two seconds per second of processor time ends sleeping children soon.
    clock = "drivers.CLOCK = 2.0; " if "sleep" in act else ""
    return f"{clock}drivers.CHILD = {CHILD.format(act=act)!r}; drivers.names = lambda device: {names}"


@pytest.mark.parametrize("act", ["ctypes.string_at(0)", "bytearray(6 * 2**30)", "os.kill(os.getpid(), 9)"])
def test_next_level_is_tried_after_compiler_failure(act: str, tmp_path: Path, plain, chooses) -> None:
    best = plain[1]["level"]
    found = run(tmp_path, misbehaving(act, f"('bad', {best!r})"), MAUVECL_BUILD_LIMIT_S="2")
    assert found == plain[1]


#: Counts attempts without building, since some processors' own names crash the compiler.
COUNT = (
    "drivers.names = lambda device: (None,); "
    "drivers._try = lambda *a: print('tried', a[0]) or drivers.Failure('failed'); "
)


@pytest.mark.parametrize("act", ACTS | OTHERS)
def test_error_is_one_sentence_and_only_failures_of_driver_are_stored(act: str, tmp_path: Path) -> None:
    """If no level works. Run again after a failure of something else: the driver is tried again at once."""
    found = run(tmp_path, misbehaving(act, "(None,)"), MAUVECL_BUILD_LIMIT_S="2")
    assert found.keys() == {"sentence"}
    lines, sentence = found["sentence"].split(" ", 1)
    assert lines == "0"
    remedies = (
        ("conda-forge", "`mauvecl devices --forget`") if act in ACTS else ("expected", "the next run tries again")
    )
    for word in ("driver", (ACTS | OTHERS)[act], *remedies):
        assert word in sentence
    if act in OTHERS:
        assert run(tmp_path, COUNT).keys() == {"tried", "sentence"}


def test_failure_is_reused_for_a_day_or_until_it_is_forgotten(tmp_path: Path) -> None:
    assert "sentence" in run(tmp_path, misbehaving("os.abort()", "(None,)"))
    for hours, tried in ((1, False), (25, True), (26, False)):
        later = f"import time; now = time.time; time.time = lambda: now() + {hours} * 3600; "
        assert run(tmp_path, COUNT + later).keys() == {"sentence"} | ({"tried"} if tried else set())
    started("devices", "--forget", "--no-rate", folder=tmp_path, MAUVECL_CACHE_DIR=str(tmp_path))
    assert run(tmp_path, COUNT).keys() == {"tried", "sentence"}


def test_first_build_that_is_killed_is_tried_again_by_the_next_run(tmp_path: Path, plain) -> None:
    """Kill the child from outside, as the kernel does when memory is short."""
    environment = os.environ | {"MAUVECL_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", RUN.format(before="")]
    parent = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        task = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
        while not (children := task.read_text().split()):
            assert parent.poll() is None
            time.sleep(0.05)
        # The interpreter has started and reads its modules.
        time.sleep(0.5)
        os.kill(int(children[0]), signal.SIGKILL)
        out, log = parent.communicate(timeout=120)
    finally:
        parent.kill()
    assert "stopped from outside (killed)" in log + out
    assert run(tmp_path) == plain[1]


def test_failing_linker_is_not_stored_as_failure_of_driver(tmp_path: Path, plain) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "ld").write_text("#!/bin/sh\nexit 1\n")
    (folder / "ld").chmod(0o755)
    found = run(tmp_path / "cache", PATH=f"{folder}{os.pathsep}{os.environ['PATH']}")
    assert "the linker `ld` failed" in found["sentence"]
    assert run(tmp_path / "cache") == plain[1]


def test_outcome_is_reused_until_driver_or_version_change(plain: tuple[Path, dict[str, str]]) -> None:
    cache, first = plain
    count = "drivers._try = lambda *a: print('tried', a[0]); "
    assert run(cache, count) == first
    changed = run(cache, count + "drivers.VERSION = 'another'")
    assert changed.keys() == first.keys() | {"tried"}


def test_read_only_store_suffices(plain: tuple[Path, dict[str, str]]) -> None:
    cache, first = plain
    folders = [cache, *(path for path in cache.rglob("*") if path.is_dir())]
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in folders}
    # Root ignores permissions, so the store is made read-only in another way.
    refuse = "drivers._writable = lambda folder: False; " if os.getuid() == 0 else ""
    try:
        for path in folders:
            path.chmod(0o555)
        assert run(cache, refuse)["digest"] == first["digest"]
    finally:
        for path, mode in modes.items():
            path.chmod(mode)


@pytest.mark.parametrize("how", ["typed, in a thread", "no executable"])
def test_first_build_works_for_every_way_to_start_python(how: str, tmp_path: Path, plain) -> None:
    code = RUN.format(before="sys.executable = None" if how == "no executable" else "")
    typed = f"import threading\nt = threading.Thread(target=exec, args=({code!r}, {{}}))\nt.start(); t.join()\n"
    done = python(code, typed=None if how == "no executable" else typed, cache=tmp_path)
    assert done.stderr == ""
    assert printed(done.stdout) == plain[1]


def test_concurrent_processes_build_once(tmp_path: Path, plain: tuple[Path, dict[str, str]]) -> None:
    log = tmp_path / "log"
    count = f"real = drivers._try; drivers._try = lambda *a: (open({str(log)!r}, 'a').write('.'), real(*a))[1]"
    command = [sys.executable, "-c", RUN.format(before=count)]
    environment = os.environ | {"MAUVECL_CACHE_DIR": str(tmp_path / "cache")}
    together = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for one in together:
        assert f"digest {plain[1]['digest']}" in one.communicate(timeout=120)[0]
    assert log.read_text() == "."


def test_first_build_stops_compiler_of_zen_4(tmp_path: Path, plain: tuple[Path, dict[str, str]], chooses) -> None:
    """Stop the child of PoCL 3.0 with AVX-512, which crashes for the name znver3 after minutes and gigabytes."""
    if "avx512f" not in Path("/proc/cpuinfo").read_text().split():
        pytest.skip("this processor has no AVX-512")
    names = f"drivers.names = lambda device: ('znver3', {plain[1]['level']!r})"
    start = time.monotonic()
    assert run(tmp_path, names, MAUVECL_BUILD_LIMIT_S="4") == plain[1]
    assert time.monotonic() - start < 100


@pytest.mark.parametrize("wrong", ["-1", "nan", "x"])
def test_invalid_build_limit_is_refused(wrong: str, plain: tuple[Path, dict[str, str]]) -> None:
    found = run(plain[0], MAUVECL_BUILD_LIMIT_S=wrong)
    assert found.keys() == {"sentence"}
    assert found["sentence"].startswith(f"0 MAUVECL_BUILD_LIMIT_S = '{wrong}'")
