"""Processors newer than PoCL's compiler.

PoCL asks LLVM for the processor's name. An LLVM older than the processor says "generic", a name that its own compiler
then refuses for x86-64, so that no kernel builds (PoCL issue 1049, open; met with LLVM 14 and AMD's family 26). No
setting names another one. Here the device's record in memory is given the instruction set's level instead (x86-64
psABI, v2 to v4), from what the kernel says the processor can do.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
from functools import cache
from pathlib import Path
from typing import Any

#: What PoCL calls a processor that LLVM does not know.
UNKNOWN = "generic"
#: Levels of the x86-64 psABI, and what each needs beyond the one before, as /proc/cpuinfo spells it.
LEVELS = {
    "x86-64-v2": ("cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"),
    "x86-64-v3": ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
#: Bytes of a device's record that are looked through: it is some 2500 long.
RECORD_BYTES = 2048

#: Names given to devices: PoCL keeps pointers to them.
_given: dict[str, Any] = {}


def unknown(device: Any) -> bool:
    """Whether PoCL's compiler will refuse an x86-64 processor because it does not know it."""
    triple = str(device.version).rpartition("pthread-")[2]
    return triple.startswith("x86_64-") and triple.endswith(f"-{UNKNOWN}")


def level(flags: frozenset[str]) -> str:
    """The highest level of the x86-64 psABI that a processor with these flags has."""
    best = "x86-64"
    for name, needed in LEVELS.items():
        if not flags.issuperset(needed):
            break
        best = name
    return best


@cache
def flags() -> frozenset[str]:
    """What the first processor of this machine can do; nothing where the kernel does not say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def give_name(device: Any) -> str | None:
    """Give a device that PoCL calls unknown a name that its compiler takes; called again it changes nothing.

    Parameters
    ----------
    device : pyopencl.Device

    Returns
    -------
    str or None
        The name, or None where PoCL knows its own or the record was not understood.
    """
    if not unknown(device):
        return None
    wanted = level(flags())
    triple = str(device.version).rpartition("pthread-")[2].removesuffix(f"-{UNKNOWN}")
    record = int(device.int_ptr)
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return None
    try:
        # In PoCL's record the pointer to the triple stands before that to the processor's name.
        pointers = [int.from_bytes(_bytes(memory, record + at, 8), "little") for at in range(0, RECORD_BYTES, 8)]
        for place, (first, second) in enumerate(itertools.pairwise(pointers), 1):
            if _text(memory, first) == triple and _text(memory, second) in (UNKNOWN, wanted):
                text = _given.setdefault(wanted, ctypes.create_string_buffer(wanted.encode()))
                ctypes.c_void_p.from_address(record + 8 * place).value = ctypes.addressof(text)
                return wanted
    finally:
        os.close(memory)
    return None


def _bytes(memory: int, address: int, size: int) -> bytes:
    """Memory of this process, read as a file: an address that is none gives nothing instead of a crash."""
    try:
        return os.pread(memory, size, address)
    except (OSError, OverflowError):
        return b""


def _text(memory: int, address: int) -> str:
    text, end, _ = _bytes(memory, address, 64).partition(b"\0")
    return text.decode("ascii", errors="replace") if end else ""
