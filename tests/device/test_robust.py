"""Missing devices and tools, little memory and invalid numbers: clear errors or unchanged results."""

import multiprocessing
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from processes import python
from refusals import failed, refused

from mauvecl import Engine
from mauvecl.device import build, drivers, selftest


def test_device_is_chosen_by_name_or_number() -> None:
    first = Engine().device
    assert first.default
    assert "Portable" in first.platform
    with failed("unknown device", first.label):
        Engine(device="no such device")
    assert Engine(device="portable").device == first
    assert Engine(device="0").device == first


@pytest.mark.long
def test_error_names_missing_linker(tmp_path: Path) -> None:
    """Raise an error that names the remedy, where PoCL would abort Python."""
    code = "from mauvecl import Engine\ntry: Engine()\nexcept RuntimeError as e: print(e)"
    said = python(code, PATH=str(tmp_path)).stdout
    assert "no linker `ld`" in said
    assert "binutils" in said


@pytest.mark.long
def test_kernels_are_linked_without_a_compiler(tmp_path: Path) -> None:
    """Link with a linker that knows none of the folders where compilers install their libraries."""
    imports = "from mauvecl import Engine; from mauvecl.device.selftest import toy"
    code = f"{imports}; Engine().realise(toy(), count=64, seed=1)"
    (tmp_path / "bin").mkdir()
    linker = tmp_path / "bin" / "ld"
    linker.write_text(
        f"#!{sys.executable}\nimport os, sys\n"
        "words = [w for w in sys.argv[1:] if not w.startswith('-L') or 'libraries' in w]\n"
        f"open({str(tmp_path / 'log')!r}, 'a').write(' '.join(words) + chr(10))\n"
        f"os.execv({shutil.which('ld')!r}, ['ld', '-nostdlib', *words])\n",
        encoding="utf-8",
    )
    linker.chmod(0o755)
    path = f"{linker.parent}{os.pathsep}{os.environ['PATH']}"
    python(code, cache=tmp_path / "cache", PATH=path, LIBRARY_PATH="")
    assert "-lgcc" in (tmp_path / "log").read_text(encoding="utf-8")


def test_no_device_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing() -> list:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    for empty in (nothing, list):
        monkeypatch.setattr(cl, "get_platforms", empty)
        with failed("no device"):
            Engine()


def test_engine_after_fork_raises(engine: Engine) -> None:
    """Raise an error for old and new engines, where PoCL would wait forever for threads of the parent.

    The child leaves the parent's folder of kernels as it is.
    """
    queue, work = multiprocessing.get_context("fork").Queue(), drivers.kernel_cache().work

    def child() -> None:
        for old in (engine, None):
            try:
                (old or Engine()).realise(selftest.toy(), count=1, seed=1)
            except RuntimeError as error:
                queue.put(str(error))
        drivers.kernel_cache().close()

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    for _ in range(2):
        assert "before a fork" in queue.get(timeout=20)
    process.join(timeout=20)
    assert process.exitcode == 0
    assert work.is_dir()


def test_build_error_contains_numbered_source(engine: Engine) -> None:
    with pytest.raises(RuntimeError, match=r"   2  nonsense here"):
        build.build(engine.open_device.context, "// a comment\nnonsense here\n")


def refuse_beyond(monkeypatch: pytest.MonkeyPatch, limit: int, *, scenes: bool = False) -> list[int]:
    """Make allocations above `limit` bytes fail, or all buffers of a scene; return the list of failed sizes."""
    refused: list[int] = []

    def buffer(context: cl.Context, flags: int, size: int = 0, hostbuf: np.ndarray | None = None) -> cl.Buffer:
        if size > limit or (scenes and hostbuf is not None):
            refused.append(size)
            hostbuf, flags, size = None, cl.mem_flags.READ_WRITE, 2**60  # larger than any device
        return real(context, flags, size, hostbuf)

    real = cl.Buffer
    monkeypatch.setattr(cl, "Buffer", buffer)
    return refused


def test_little_memory_shrinks_tiles_without_affecting_results(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet, flare = selftest.toy(), selftest.toy(flare=0.3)

    def work() -> list[np.ndarray]:
        engine = Engine()
        found = engine.detect(quiet, [flare], realisations=20_000, seed=1)
        raw, clipped = engine.realise_and_count(quiet, count=20_000, seed=1)
        return [raw, clipped, *(found.distribution(s, k).counts for s in found.statistics for k in (None, 0))]

    plain = work()
    # Statistics of 64 realisations take 64 * 4 * 8 bytes, those of 20 000 exceed the limit.
    refused = refuse_beyond(monkeypatch, 5_000)
    for ours, wanted in zip(work(), plain, strict=True):
        np.testing.assert_array_equal(ours, wanted)
    assert len(refused) > 5


def test_too_little_memory_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_beyond(monkeypatch, 100)
    with failed("memory", " 64 realisations"):
        Engine().detect(selftest.toy(), [selftest.toy(flare=0.3)], realisations=20_000, seed=1)
    refuse_beyond(monkeypatch, 100, scenes=True)
    with failed("memory", "scene"):
        Engine().realise(selftest.toy(), count=1, seed=1)


def test_other_device_errors_are_not_retried(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, real = Engine(), cl.Buffer
    both = cl.mem_flags.READ_ONLY | cl.mem_flags.WRITE_ONLY
    monkeypatch.setattr(cl, "Buffer", lambda context, flags, *rest, **more: real(context, both, 64))
    with pytest.raises(cl.LogicError, match="INVALID_VALUE"):
        engine.realise(selftest.toy(), count=10, seed=1)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e13])
@pytest.mark.parametrize(
    "name", ["source_electrons", "sky_electrons", "dark_dn", "bias_dn", "read_noise_dn", "gain_dn_per_electron"]
)
def test_invalid_expectation_names_pixel(name: str, value: float) -> None:
    x = selftest.toy()
    wrong = getattr(x, name).copy()
    wrong[17] = value
    with refused(name, "pixel 17"):
        replace(x, **{name: wrong})
