"""Processor names for which PoCL compiles on x86-64.

The PoCL of wheels and distributions supports many processors. It loads the library of built-in functions that suits the
instructions of the processor, but before version 5 it compiles kernels for LLVM's name of the processor, which need not
match the library. LLVM 14 calls AMD's Zen 4 "znver3", which has no AVX-512, while PoCL loads the AVX-512 library: a
build then takes minutes and gigabytes and ends in a segmentation fault. LLVM calls an unknown processor "generic",
which its compiler rejects for x86-64 (PoCL issue 1049).

No setting changes the name. This module therefore writes the highest level of the x86-64 psABI that fits processor and
library into PoCL's record of the device in memory. PoCL 5 and later, and Debian's 3.1, name the processor after the
library; their record is not changed.
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

#: Processor names, lowest first, and the instructions that each adds, as /proc/cpuinfo spells them. "sandybridge"
#: denotes processors with AVX but without AVX2, for which PoCL has a library but the psABI has no level.
LEVELS = {
    "x86-64": (),
    "x86-64-v2": ("cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"),
    "sandybridge": ("avx", "xsave"),
    "x86-64-v3": ("avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
#: Bits of the registers in which each level passes vectors. They must agree with those of the library, which PoCL
#: chooses by the processor: kernels for x86-64-v3 with the library for AVX-512 are not built within ten minutes.
WIDTHS = {"x86-64": 128, "x86-64-v2": 128, "sandybridge": 256, "x86-64-v3": 256, "x86-64-v4": 512}
#: LLVM's name of an unknown processor.
UNKNOWN = "generic"
#: Part of the version of a PoCL that chooses among libraries.
CHOOSES_LIBRARY = "DISTRO"
#: End of a device's version: driver, target triple, processor.
TARGET = re.compile(r"HSTR: \w+-(x86_64-\w+-\w+-\w+)-([\w-]+)$")
#: Bytes of a device's record that are searched, out of about 2500.
RECORD_BYTES = 2048

#: Names that must stay in memory, since PoCL has pointers to them.
_names: dict[str, Any] = {}


def levels(flags: frozenset[str]) -> tuple[str, ...]:
    """Return the names that a processor with these flags can run with the library that PoCL loads, highest first."""
    fitting = tuple(itertools.takewhile(lambda name: flags.issuperset(LEVELS[name]), LEVELS))[::-1]
    return tuple(name for name in fitting if WIDTHS[name] == WIDTHS[fitting[0]])


@cache
def flags() -> frozenset[str]:
    """Return the instruction sets of this machine's first processor; empty if unknown."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def target(device: Any) -> tuple[str, str] | None:
    """Return the triple and processor name for which PoCL compiles, or None if they need no change."""
    found = TARGET.search(str(device.version))
    if found is None or not (CHOOSES_LIBRARY in str(device.platform.version) or found[2] == UNKNOWN):
        return None
    return found[1], found[2]


def names(device: Any) -> tuple[str | None, ...]:
    """Return the names to compile for, best first; ``(None,)`` leaves the choice to PoCL."""
    return levels(flags()) if flags() and _name_address(device) is not None else (None,)


def set_processor_name(device: Any, name: str) -> bool:
    """Make PoCL compile for a processor name known to LLVM; return False if the record's layout is unknown."""
    place = _name_address(device)
    if place is None:
        return False
    text = _names.setdefault(name, ctypes.create_string_buffer(name.encode()))
    ctypes.c_void_p.from_address(place).value = ctypes.addressof(text)
    return True


def _name_address(device: Any) -> int | None:
    """Return the address of the pointer to the processor's name in PoCL's record, or None if it is not found."""
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
        # The pointer to the triple precedes that to the name, except in versions that name the processor after the
        # library.
        pointers = [int.from_bytes(_bytes(memory, record + at, 8), "little") for at in range(0, RECORD_BYTES, 8)]
        for place, (first, second) in enumerate(itertools.pairwise(pointers), 1):
            if _text(memory, first) == triple and _text(memory, second) in (own, *_names):
                return record + 8 * place
    finally:
        os.close(memory)
    return None


def _bytes(memory: int, address: int, size: int) -> bytes:
    """Read memory of this process as a file, since a wrong address then returns nothing instead of a crash."""
    try:
        return os.pread(memory, size, address)
    except (OSError, OverflowError):
        return b""


def _text(memory: int, address: int) -> str:
    text, end, _ = _bytes(memory, address, 64).partition(b"\0")
    return text.decode("ascii", errors="replace") if end else ""
