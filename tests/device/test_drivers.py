"""Drivers, devices, processors and tools that are missing or broken, and little memory: clear errors, same results."""

import ctypes
import importlib.util
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest
from commands import run
from packaging.requirements import Requirement
from processes import python
from refusals import failed

from mauvecl import Engine
from mauvecl.device import build, drivers, selftest


def test_device_is_chosen_by_name_or_number() -> None:
    first = Engine().device
    assert (first.default, "Portable" in first.platform) == (True, True)
    with failed("unknown device", first.label):
        Engine(device="no such device")
    assert Engine(device="portable").device == first
    assert Engine(device="0").device == first


def test_engine_after_fork_raises(engine: Engine) -> None:
    """Raise an error for old and new engines, where PoCL would wait forever for threads, and keep its kernels."""
    work = drivers.kernel_cache().work

    def child() -> None:
        for old in (engine, None):
            with pytest.raises(RuntimeError, match="before a fork"):
                (old or Engine()).realise(selftest.toy(), count=1, seed=1)
        drivers.kernel_cache().close()

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join(timeout=20)
    assert (process.exitcode, work.is_dir()) == (0, True)


def test_build_error_contains_numbered_source_or_names_the_processor(engine: Engine, monkeypatch: Any) -> None:
    with pytest.raises(RuntimeError, match=r"   2  nonsense here"):
        build.build(engine.open_device.context, "// a comment\nnonsense here\n")
    monkeypatch.setattr(cl, "Program", Mock(side_effect=cl.RuntimeError("error: unknown target CPU 'generic'")))
    with pytest.raises(RuntimeError, match=r"\A.*\Z") as caught:  # on one line
        build.build(engine.open_device.context, "__kernel void nothing() {}")
    assert caught.value.kind == "processor"


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
    """Tiles that cannot shrink further, and scenes, raise an error; other errors of a device are not retried."""
    quiet, flare = selftest.toy(), selftest.toy(flare=0.3)

    def work() -> list[np.ndarray]:
        engine = Engine()
        found = engine.detect(quiet, [flare], realisations=20_000, seed=1)
        raw, clipped = engine.realise_and_count(quiet, count=20_000, seed=1)
        return [raw, clipped, *(found.distribution(s, k).counts for s in found.statistics for k in (None, 0))]

    plain, engine = work(), Engine()
    # Statistics of 64 realisations take 64 * 4 * 8 bytes, those of 20 000 exceed the limit.
    with monkeypatch.context() as patch:
        refused = refuse_beyond(patch, 5_000)
        for ours, wanted in zip(work(), plain, strict=True):
            np.testing.assert_array_equal(ours, wanted)
        assert len(refused) > 5
    for scenes, words in ((False, " 64 realisations"), (True, "scene")):
        with monkeypatch.context() as patch, failed("memory", words):
            refuse_beyond(patch, 100, scenes=scenes)
            work()
    both, real = cl.mem_flags.READ_ONLY | cl.mem_flags.WRITE_ONLY, cl.Buffer
    monkeypatch.setattr(cl, "Buffer", lambda context, flags, *rest, **more: real(context, both, 64))
    with pytest.raises(cl.LogicError, match="INVALID_VALUE"):
        engine.realise(quiet, count=10, seed=1)


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a wheel like Intel's with an empty driver, importable in this process."""
    info = tmp_path / "site" / "intel_opencl_rt-2026.2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: intel-opencl-rt\nVersion: 2026.2.0\n")
    (info / "RECORD").write_text("../lib/libintelocl.so,,\n../etc/OpenCL/vendors/intel-cpu.icd,,\n")
    for place in ("lib", "etc/OpenCL/vendors", "usual"):
        (tmp_path / place).mkdir(parents=True)
    (tmp_path / "lib" / "libintelocl.so").write_bytes(b"")
    (tmp_path / "etc/OpenCL/vendors/intel-cpu.icd").write_text("/opt/build/lib/libintelocl.so\n")
    (tmp_path / "usual" / "nvidia.icd").write_text("libnvidia-opencl.so.1\n")
    monkeypatch.syspath_prepend(str(info.parent))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    for name in drivers.FOLDER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(drivers.FOLDER_VARIABLES[1], str(tmp_path / "usual"))
    monkeypatch.setattr(drivers, "_folder", drivers._folder.__wrapped__)
    return tmp_path


def environment_unchanged() -> bool:
    before = dict(os.environ)
    with drivers.show_intel_runtime():
        inside = dict(os.environ)
    return before == inside == dict(os.environ)


def test_loader_finds_intels_driver_and_all_others(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, listed = wheel / "lib" / "libintelocl.so", wheel / "usual" / "intel.icd"
    with drivers.show_intel_runtime():
        found = {path.name: path.read_text().strip() for path in Path(os.environ["OCL_ICD_VENDORS"]).iterdir()}
    assert found == {"nvidia.icd": "libnvidia-opencl.so.1", "mauvecl-intel.icd": str(driver)}
    assert "OCL_ICD_VENDORS" not in os.environ
    # Nothing changes without need.
    listed.write_text(f"{driver}\n")
    assert environment_unchanged(), "the system lists it"
    listed.unlink()
    with monkeypatch.context() as patch:
        patch.setenv("OCL_ICD_VENDORS", "/my/own")
        assert environment_unchanged(), "the user has a folder"
    driver.unlink()
    assert environment_unchanged(), "there is no driver"


@pytest.mark.long
def test_pocl_is_found_despite_broken_driver(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(drivers.FOLDER_VARIABLES[1])
    code = "import os, mauvecl; print(mauvecl.Engine().device.platform, os.environ.get('OCL_ICD_VENDORS'))"
    done = python(code, PYTHONPATH=os.pathsep.join(sys.path))
    assert (done.stdout, done.stderr) == ("Portable Computing Language None\n", "")


@pytest.mark.parametrize(("system", "machine", "words"), [
    ("Linux", "x86_64", ["pyopencl[pocl]", "mauvecl[intel]", "pocl-opencl-icd", "conda-forge", "GPU"]),
    ("Linux", "aarch64", ["pocl-opencl-icd", "conda-forge", "GPU"]), ("Darwin", "arm64", ["conda-forge", "macOS"]),
    ("Windows", "AMD64", ["wsl --install"]), ("FreeBSD", "amd64", ["conda-forge"]),
])  # fmt: skip
def test_devices_command_names_sources_of_drivers(
    system: str, machine: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Name no wheel on platforms without one, whether the loader finds no platform or refuses to look for one."""
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    for empty in (Mock(side_effect=cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")), list):
        monkeypatch.setattr(cl, "get_platforms", empty)
        with failed("no device", *words):
            Engine()
        said = run("devices", folder=tmp_path, code=2).stderr.strip()
        assert all(word in said for word in words)
        assert ("[pocl]" in said or "[intel]" in said) == (machine == "x86_64")
        assert "\n" not in said


def test_requirements_name_wheels_only_for_supported_platforms() -> None:
    """Require PoCL's and Intel's wheels only on Linux on x86-64, since they exist for no other platform."""
    wheels = {"pyopencl": "pocl", "intel-opencl-rt": "", "intel-cmplr-lib-rt": "", "tbb": ""}
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    wanted = [Requirement(line) for line in project["dependencies"] + project["optional-dependencies"]["intel"]]
    for machine, system in (("x86_64", "linux"), ("aarch64", "linux"), ("arm64", "darwin"), ("AMD64", "win32")):
        here = {"platform_machine": machine, "sys_platform": system}
        asked = [one for one in wanted if one.marker is None or one.marker.evaluate(here)]
        only = {one.name for one in asked if wheels.get(one.name) in ("", *one.extras)}
        assert only == (set(wheels) if (machine, system) == ("x86_64", "linux") else set())
        assert "pyopencl" in {one.name for one in asked}


def test_windows_error_names_alternative() -> None:
    # Python 3.13's shutil is that of the platform.
    code = "import shutil, sys; sys.platform = 'win32'; import mauvecl"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (found.returncode, "wsl --install" in found.stderr.splitlines()[-1]) == (1, True)


V2 = {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}
AVX = V2 | {"avx", "xsave"}
V3 = AVX | {"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


def library(flags: set[str]) -> str:
    """Return the built-in library that PoCL 3.0 to 4.0 loads (getX86KernelLibName in lib/CL/pocl_llvm_build.cc)."""
    best = "sse2"
    for name, needed in {
        "ssse3": {"ssse3", "cx16"},
        "sse41": {"sse4_1", "cx16"},
        "avx": {"avx", "cx16", "popcnt"},
        "avx_f16c": {"avx", "cx16", "popcnt", "f16c"},
        "avx2": {"avx", "avx2", "cx16", "popcnt", "abm", "f16c", "fma", "bmi1", "bmi2"},
        "avx512": {"avx512f"},
    }.items():
        best = name if flags >= needed else best
    return best


#: Sets of instructions for which PoCL loads different libraries.
STEPS = [set(), {"ssse3", "cx16"}, V2, AVX, AVX | {"f16c"}, V3, V4]


def test_highest_level_has_all_its_instructions_and_vectors_as_wide_as_those_of_library() -> None:
    """Compare the register widths of the library and of the kernels, which must agree to pass vectors."""
    steps = (set(), V2, AVX, V3, V4)
    for level, flags, higher in zip(drivers.LEVELS, steps, (*steps[1:], V4), strict=True):
        for missing in higher - flags or {""}:
            # A processor without one of the instructions that the next level adds.
            assert drivers.levels(frozenset(V4 - {missing}))[0] == level, missing
        assert drivers.levels(frozenset(flags))[0] == level, flags
    passed = {"sse2": 128, "ssse3": 128, "sse41": 128, "avx": 256, "avx_f16c": 256, "avx2": 256, "avx512": 512}
    for flags in STEPS:
        offered = drivers.levels(frozenset(flags))
        assert offered
        assert {drivers.WIDTHS[level] for level in offered} == {passed[library(flags)]}, sorted(flags)


@pytest.fixture(scope="module")
def with_library(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that makes a copy of PoCL load a library, and returns the folder of its .icd file."""
    spec = importlib.util.find_spec("pocl_binary_distribution")
    if spec is None or spec.origin is None or not drivers.flags():
        pytest.skip("PoCL is not from a wheel")
    top, wheels = tmp_path_factory.mktemp("pocl"), Path(spec.origin).parents[1]
    for folder in ("pyopencl/.libs", "pocl_binary_distribution"):
        shutil.copytree(wheels / folder, top / folder)
    (driver,) = (top / "pyopencl/.libs").glob("libpocl*.so")
    (top / "vendors").mkdir()
    (top / "vendors/pocl.icd").write_text(f"{driver}\n")
    (loaded,) = top.rglob(f"kernel-*-{library(set(drivers.flags()))}.bc")

    def use(name: str) -> Path:
        (original,) = wheels.glob(f"pocl_binary_distribution/.libs/share/pocl/kernel-*-{name}.bc")
        shutil.copy(original, loaded)
        return top / "vendors"

    return use


#: Script that builds for a level in a first build's child, and prints the failure and the driver's path.
BUILD = """
import sys
from mauvecl.device import build, drivers
device, _ = build.choose_device(None)
print(drivers._try(sys.argv[1], 0, device, 60.0))
print({line.split()[-1] for line in open("/proc/self/maps") if "libpocl" in line})
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "level"), [(library(flags), level) for flags in STEPS for level in drivers.levels(frozenset(flags))]
)
def test_every_offered_level_builds_and_draws(name: str, level: str, with_library, tmp_path: Path) -> None:
    """Build kernels for each level with the library for which it is offered, in place of this processor's library."""
    levels = list(drivers.LEVELS)
    needed = [flag for lower in levels[: levels.index(level) + 1] for flag in drivers.LEVELS[lower]]
    if not drivers.flags().issuperset(needed):
        pytest.skip("this processor lacks instructions of the level")
    vendors = with_library(name)
    done = python(BUILD, level, cache=tmp_path, OCL_ICD_VENDORS=str(vendors))
    assert done.stdout.splitlines() == ["None", str({(vendors / "pocl.icd").read_text().strip()})]


class Record:
    """Device whose record in memory looks like PoCL's."""

    def __init__(
        self, cpu: str, triple: str = "x86_64-pc-linux-gnu", *, known_form: bool = True, chooses: bool = True
    ) -> None:
        self.strings = [ctypes.create_string_buffer(text.encode()) for text in (triple, cpu)]
        words = [0, 1, 2**64 - 1, 0xDEAD0000, *(ctypes.addressof(s) for s in self.strings), 7]
        if not known_form:
            words.insert(5, 0)
        self.words = np.array(words + [0] * 300, np.uint64)
        self.int_ptr = self.words.ctypes.data
        self.version = f"OpenCL 3.0 PoCL HSTR: pthread-{triple}-{cpu}"
        self.platform = SimpleNamespace(version=f"OpenCL 3.0 PoCL 3.0, LLVM 14.0.6{', DISTRO' if chooses else ''}")

    @property
    def cpu(self) -> bytes:
        return ctypes.string_at(int(self.words[5]))


@pytest.mark.parametrize("own", ["generic", "znver3", "znver4", "skylake-avx512", "haswell", "x86-64"])
def test_processor_is_named_after_level(own: str) -> None:
    """Keep the record of an unknown form, such as that of PoCL 6.0, and that of a device that chooses well."""
    for device, is_named in (
        (Record(own), True),
        (Record(own, known_form=False), False),
        (Record("znver3", chooses=False), False),
        (Record("generic", "aarch64-unknown-linux-gnu"), False),
    ):
        before = device.words.copy()
        for name in ("x86-64-v4", "x86-64-v3", "x86-64-v3"):
            assert drivers.set_processor_name(device, name) == is_named
            assert not is_named or device.cpu.decode() == name
        # The rest of the record is unchanged.
        assert np.flatnonzero(device.words != before).tolist() == ([5] if is_named else [])
        assert (drivers.names(device) == (None,)) != is_named
        # Nothing is read at an invalid address.
        device.int_ptr = 2**46
        assert not drivers.set_processor_name(device, "x86-64-v3")
