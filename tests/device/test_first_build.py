"""First builds with failing compilers: the user's process continues or ends with a one-sentence error."""

import os
import re
import stat
import time
from pathlib import Path

import pytest
from processes import printed, python

pytestmark = pytest.mark.long
#: Script that draws on the default device and prints the level and the counts' digest, or the error.
RUN = """
import hashlib, sys
from mauvecl import Engine, InputError
from mauvecl.device import drivers
from mauvecl.device.selftest import toy
{before}
try:
    engine = Engine()
    print("digest", hashlib.sha256(engine.realise(toy(), count=64, seed=1).tobytes()).hexdigest())
    print("level", *drivers.settled.values())
except (drivers.DeviceError, InputError) as error:
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


def run(cache: Path | str, before: str = "", **environment: str) -> dict[str, str]:
    return printed(python(RUN.format(before=before), cache=cache, **environment).stdout)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    cache = tmp_path_factory.mktemp("plain")
    return cache, run(cache)


@pytest.fixture
def chooses(plain: tuple[Path, dict[str, str]]) -> None:
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


@pytest.mark.parametrize("act", ACTS)
def test_failure_at_every_level_is_one_sentence(act: str, tmp_path: Path, plain: tuple[Path, dict[str, str]]) -> None:
    """The next run tries again."""
    found = run(tmp_path, misbehaving(act, "(None,)"), MAUVECL_BUILD_LIMIT_S="2")
    assert found.keys() == {"sentence"}
    assert found["sentence"].startswith("0 ")
    assert all(word in found["sentence"] for word in ("driver", ACTS[act], "conda-forge", "MAUVECL_BUILD_LIMIT_S"))
    if act == "ctypes.string_at(0)":
        assert run(tmp_path) == plain[1]


def test_failing_linker_is_reported(tmp_path: Path, plain) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "ld").write_text("#!/bin/sh\nexit 1\n")
    (folder / "ld").chmod(0o755)
    found = run(tmp_path / "cache", PATH=f"{folder}{os.pathsep}{os.environ['PATH']}")
    assert "linker" in found["sentence"]
    assert run(tmp_path / "cache") == plain[1]


def test_level_is_reused_and_a_read_only_store_suffices(plain: tuple[Path, dict[str, str]]) -> None:
    cache, first = plain
    folders = [cache, *(path for path in cache.rglob("*") if path.is_dir())]
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in folders}
    try:
        for path in folders:
            path.chmod(0o555)
        assert run(cache, "drivers._try = lambda *a: print('tried', a[0]); ") == first
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
    said = f"0 MAUVECL_BUILD_LIMIT_S must be between 1 and 86400 seconds.* not '{wrong}'"
    assert re.fullmatch(said, found["sentence"])
