"""Processor names that fit both the processor and the library that PoCL loads."""

import ctypes
import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest
from processes import python

from mauvecl import Engine
from mauvecl.device import build, drivers

V2 = {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}
AVX = V2 | {"avx", "xsave"}
V3 = AVX | {"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


@pytest.mark.parametrize(("flags", "level"), [
    (set(), "x86-64"), (V2, "x86-64-v2"), (AVX, "sandybridge"), (V3 - {"fma"}, "sandybridge"),
    (V3 | {"avx512f"}, "x86-64-v3"), (V4, "x86-64-v4"), (V4 - {"popcnt"}, "x86-64"),
])  # fmt: skip
def test_highest_level_has_all_its_instructions(flags: set[str], level: str) -> None:
    assert drivers.levels(frozenset(flags))[0] == level


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


def test_compiled_vectors_are_as_wide_as_those_of_library() -> None:
    """Compare the register widths of the library and of the kernels, which must agree to pass vectors."""
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


def test_error_names_processor_unknown_to_compiler(engine: Engine, monkeypatch: Any) -> None:
    monkeypatch.setattr(cl, "Program", Mock(side_effect=cl.RuntimeError("error: unknown target CPU 'generic'")))
    with pytest.raises(RuntimeError) as caught:
        build.build(engine.open_device.context, "__kernel void nothing() {}")
    assert (caught.value.kind, "\n" in str(caught.value)) == ("processor", False)
