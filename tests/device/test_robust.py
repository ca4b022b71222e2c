"""Missing drivers, devices and tools, little memory and invalid numbers: clear errors or unchanged results."""

import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest
from commands import run
from packaging.requirements import Requirement
from processes import python
from refusals import failed, refused

from mauvecl import Engine
from mauvecl.device import build, drivers, selftest


def test_device_is_chosen_by_name_or_number() -> None:
    first = Engine().device
    assert (first.default, "Portable" in first.platform) == (True, True)
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
    for empty in (Mock(side_effect=cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")), list):
        monkeypatch.setattr(cl, "get_platforms", empty)
        with failed("no device"):
            Engine()


def test_engine_after_fork_raises(engine: Engine) -> None:
    """Raise an error for old and new engines, where PoCL would wait forever for threads, and keep its kernels."""
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
    assert all("before a fork" in queue.get(timeout=20) for _ in range(2))
    process.join(timeout=20)
    assert (process.exitcode, work.is_dir()) == (0, True)


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
    drivers._folder.cache_clear()
    yield tmp_path
    drivers._folder.cache_clear()


def listed() -> dict[str, str]:
    with drivers.show_intel_runtime():
        folder = Path(os.environ["OCL_ICD_VENDORS"])
        return {path.name: path.read_text().strip() for path in folder.iterdir()}


def test_loader_finds_intels_driver_and_all_others(wheel: Path) -> None:
    driver = str(wheel / "lib" / "libintelocl.so")
    assert listed() == {"nvidia.icd": "libnvidia-opencl.so.1", "mauvecl-intel.icd": driver}
    assert "OCL_ICD_VENDORS" not in os.environ


@pytest.mark.parametrize("why", ["folder of the user", "listed by the system", "no wheel"])
def test_nothing_changes_without_need(wheel: Path, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if why == "folder of the user":
        monkeypatch.setenv("OCL_ICD_VENDORS", "/my/own")
    elif why == "no wheel":
        (wheel / "lib" / "libintelocl.so").unlink()
    else:
        (wheel / "usual" / "intel.icd").write_text(f"{wheel}/lib/libintelocl.so\n")
    before = dict(os.environ)
    with drivers.show_intel_runtime():
        assert os.environ == before
    assert os.environ == before


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
    """Name no wheel on platforms without one."""
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(cl, "get_platforms", list)
    said = run("devices", folder=tmp_path, code=2).stderr.strip()
    for word in words:
        assert word in said
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
