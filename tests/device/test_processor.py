"""Processors that PoCL's compiler does not know get a name that it takes."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mauvecl.device import processor, program
from mauvecl.device.program import DeviceError

V2 = {"cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"}
V3 = V2 | {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"}
V4 = V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


@pytest.mark.parametrize(
    ("flags", "level"),
    [
        (set(), "x86-64"),
        (V2, "x86-64-v2"),
        (V3 - {"fma"}, "x86-64-v2"),
        (V3 | {"avx512f"}, "x86-64-v3"),
        (V4, "x86-64-v4"),
        (V4 - {"popcnt"}, "x86-64"),
    ],
)
def test_the_level_is_the_highest_whose_instructions_are_all_there(flags: set[str], level: str) -> None:
    assert processor.level(frozenset(flags)) == level


class Record:
    """A device whose record in memory looks like PoCL's."""

    def __init__(self, cpu: str, triple: str = "x86_64-pc-linux-gnu", *, known_form: bool = True) -> None:
        self.strings = [ctypes.create_string_buffer(text.encode()) for text in (triple, cpu)]
        words = [0, 1, 2**64 - 1, 0xDEAD0000, *(ctypes.addressof(s) for s in self.strings), 7]
        if not known_form:
            words.insert(5, 0)
        self.words = np.array(words + [0] * 300, np.uint64)
        self.int_ptr = self.words.ctypes.data
        self.version = f"OpenCL 3.0 PoCL HSTR: pthread-{triple}-{cpu}"

    @property
    def cpu(self) -> bytes:
        return ctypes.string_at(int(self.words[5]))


def test_an_unknown_processor_is_named_once_and_for_all() -> None:
    device = Record("generic")
    before = device.words.copy()
    assert processor.give_name(device) == processor.level(processor.flags())
    assert device.cpu.decode() == processor.level(processor.flags())
    assert processor.give_name(device) == processor.level(processor.flags())
    # Nothing else in the record is touched.
    changed = np.flatnonzero(device.words != before)
    assert changed.tolist() == [5]


@pytest.mark.parametrize(
    "device", [Record("znver3"), Record("generic", "aarch64-linux-gnu"), Record("generic", known_form=False)]
)
def test_what_is_known_or_not_understood_is_left_alone(device: Record) -> None:
    before = device.words.copy()
    assert processor.give_name(device) is None
    assert (device.words == before).all()


def test_a_record_outside_of_memory_is_no_crash() -> None:
    device = SimpleNamespace(version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-generic", int_ptr=2**46)
    assert processor.give_name(device) is None


def test_a_compiler_that_refuses_the_processor_is_told_in_a_sentence(monkeypatch: Any) -> None:
    cl = program.load_opencl()
    handle, _ = program.choose_device(None)

    def refuse(*_: Any) -> Any:
        raise cl.RuntimeError("error: unknown target CPU 'generic'")

    monkeypatch.setattr(cl, "Program", refuse)
    with pytest.raises(DeviceError, match=r"does not know the processor .*, expected a newer PoCL") as caught:
        program.build(cl.Context([handle]), "__kernel void nothing() {}")
    assert "\n" not in str(caught.value)
