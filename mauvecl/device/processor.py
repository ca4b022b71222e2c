"""Names of x86-64 processors that PoCL's compiler can build for.

A PoCL made for many processors, as wheels and distributions ship it, loads the library of built-in functions that suits
the instructions of the processor, but until version 5 it compiles kernels for the name by which LLVM knows the
processor. The two need not fit. LLVM 14 calls AMD's Zen 4 "znver3", which has no AVX-512, while PoCL loads the AVX-512
library because the processor has it: a build then takes minutes and gigabytes and ends in a segmentation fault. LLVM
calls a processor that it does not know "generic", which its own compiler refuses for x86-64 (PoCL issue 1049).

No setting gives another name. This module writes the highest level of the x86-64 psABI that fits both the processor and
the library into PoCL's record of the device in memory. From version 5 on, and in Debian's 3.1, PoCL names the processor
after the library, and its record is left alone.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import re
from functools import cache
from pathlib import Path
from typing import Any

#: Names to compile for, lowest first, and the instructions that each needs beyond the one before, as /proc/cpuinfo
#: spells them. The psABI has no level for processors with AVX but without AVX2, which have a library of their own.
LEVELS = {
    "x86-64": (),
    "x86-64-v2": ("cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"),
    "sandybridge": ("avx", "xsave"),
    "x86-64-v3": ("avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
#: The name of a processor that LLVM does not know.
UNKNOWN = "generic"
#: A PoCL that chooses among libraries says so in its version.
CHOOSES = "DISTRO"
#: The end of a device's version: driver, target triple, processor.
TARGET = re.compile(r"HSTR: \w+-(x86_64-\w+-\w+-\w+)-([\w-]+)$")
#: Bytes of a device's record that are searched; it is some 2500 long.
RECORD_BYTES = 2048

#: Names in memory: PoCL keeps pointers to them.
_names: dict[str, Any] = {}


def levels(flags: frozenset[str]) -> tuple[str, ...]:
    """Return the names that a processor with these flags can run, highest first."""
    fitting = itertools.takewhile(lambda name: flags.issuperset(LEVELS[name]), LEVELS)
    return tuple(fitting)[::-1]


@cache
def flags() -> frozenset[str]:
    """Return what the first processor of this machine can do; nothing if the kernel does not say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def target(device: Any) -> tuple[str, str] | None:
    """Return the triple and the processor's name for which PoCL compiles, or None if it can be left alone.

    Parameters
    ----------
    device : pyopencl.Device
    """
    found = TARGET.search(str(device.version))
    if found is None or not (CHOOSES in str(device.platform.version) or found[2] == UNKNOWN):
        return None
    return found[1], found[2]


def names(device: Any) -> tuple[str | None, ...]:
    """Return the names to compile for, best first; None alone if PoCL had better choose.

    Parameters
    ----------
    device : pyopencl.Device
    """
    return levels(flags()) if flags() and _place(device) is not None else (None,)


def give_name(device: Any, name: str) -> bool:
    """Let PoCL compile for a processor of this name; return whether its record of the device was understood.

    Parameters
    ----------
    device : pyopencl.Device
    name : str
        A name that LLVM knows, such as one of `LEVELS`.
    """
    place = _place(device)
    if place is None:
        return False
    text = _names.setdefault(name, ctypes.create_string_buffer(name.encode()))
    ctypes.c_void_p.from_address(place).value = ctypes.addressof(text)
    return True


def _place(device: Any) -> int | None:
    """Return the address of the pointer to the processor's name in PoCL's record, or None if it is not where it was."""
    found = target(device)
    if found is None:
        return None
    triple, own = found
    record = int(device.int_ptr)
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return None
    try:
        # The pointer to the triple stands before that to the name, unless PoCL names the processor after the library:
        # that of version 5, and Debian's of 3.1.
        pointers = [int.from_bytes(_bytes(memory, record + at, 8), "little") for at in range(0, RECORD_BYTES, 8)]
        for place, (first, second) in enumerate(itertools.pairwise(pointers), 1):
            if _text(memory, first) == triple and _text(memory, second) in (own, *_names):
                return record + 8 * place
    finally:
        os.close(memory)
    return None


def _bytes(memory: int, address: int, size: int) -> bytes:
    """Read memory of this process as a file, so that a wrong address gives nothing instead of a crash."""
    try:
        return os.pread(memory, size, address)
    except (OSError, OverflowError):
        return b""


def _text(memory: int, address: int) -> str:
    text, end, _ = _bytes(memory, address, 64).partition(b"\0")
    return text.decode("ascii", errors="replace") if end else ""
