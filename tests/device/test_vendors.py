"""Drivers: Intel's wheel is found and hides no other; without drivers, an error names their sources."""

import os
import platform
import subprocess
import sys
import tomllib
from pathlib import Path

import pyopencl as cl
import pytest
from commands import run
from packaging.requirements import Requirement

from mauvecl.device import drivers

CODE = """
import os, sys
sys.path.insert(0, {place!r})
from mauvecl import Engine
print([Engine().device.platform], os.environ.get("OCL_ICD_VENDORS"))
"""


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
    assert listed() == {
        "nvidia.icd": "libnvidia-opencl.so.1",
        "mauvecl-intel.icd": str(wheel / "lib" / "libintelocl.so"),
    }
    assert "OCL_ICD_VENDORS" not in os.environ


def test_users_folder_is_not_replaced(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCL_ICD_VENDORS", "/my/own")
    with drivers.show_intel_runtime():
        assert os.environ["OCL_ICD_VENDORS"] == "/my/own"
    assert os.environ["OCL_ICD_VENDORS"] == "/my/own"


@pytest.mark.parametrize("listed", [True, False], ids=["listed by the system", "no wheel"])
def test_nothing_changes_without_need(wheel: Path, listed: bool) -> None:
    if listed:
        (wheel / "usual" / "intel.icd").write_text(f"{wheel}/lib/libintelocl.so\n")
    else:
        (wheel / "lib" / "libintelocl.so").unlink()
    with drivers.show_intel_runtime():
        assert "OCL_ICD_VENDORS" not in os.environ


@pytest.mark.long
def test_pocl_is_found_despite_broken_driver(wheel: Path) -> None:
    environment = {name: text for name, text in os.environ.items() if name not in drivers.FOLDER_VARIABLES}
    code = CODE.format(place=str(wheel / "site"))
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert "'Portable Computing Language'" in run.stdout
    assert run.stdout.rstrip().endswith("None")
    assert run.stderr == ""


@pytest.mark.parametrize(
    ("system", "machine", "words"),
    [
        ("Linux", "x86_64", ["pyopencl[pocl]", "mauvecl[intel]", "pocl-opencl-icd", "conda-forge", "GPU"]),
        ("Linux", "aarch64", ["pocl-opencl-icd", "conda-forge", "GPU"]),
        ("Darwin", "arm64", ["conda-forge", "macOS"]),
        ("Windows", "AMD64", ["wsl --install"]),
        ("FreeBSD", "amd64", ["conda-forge"]),
    ],
)
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
    code = "import sys; sys.platform = 'win32'; import mauvecl"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 1
    assert "wsl --install" in run.stderr.splitlines()[-1]
