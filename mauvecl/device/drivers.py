"""Where OpenCL drivers come from, by operating system."""

from __future__ import annotations

import platform

#: By system and machine, as Python's `platform` spells them; "" stands for every other machine.
SOURCES = {
    ("Linux", "x86_64"): (
        "`pip install 'pyopencl[pocl]'` (PoCL, for processors)",
        "`pip install 'mauvecl[intel]'` (Intel's runtime, for processors)",
        "`apt-get install pocl-opencl-icd` (Debian, Ubuntu) or `dnf install pocl` (Fedora)",
        "`conda install -c conda-forge pyopencl pocl`",
        "the driver of your GPU's maker",
    ),
    ("Linux", ""): (
        "`apt-get install pocl-opencl-icd` (Debian, Ubuntu) or `dnf install pocl` (Fedora)",
        "`conda install -c conda-forge pyopencl pocl`",
        "the driver of your GPU's maker",
    ),
    ("Darwin", ""): (
        "`conda install -c conda-forge pyopencl pocl`",
        "the OpenCL that macOS brings, with pip's pyopencl",
    ),
    ("Windows", ""): ("Linux on Windows (`wsl --install`), since mauvecl needs Linux or macOS",),
    ("", ""): ("`conda install -c conda-forge pyopencl pocl`", "a driver for your device"),
}


def sources(system: str | None = None, machine: str | None = None) -> str:
    """Return where drivers for a machine come from, as the end of a sentence.

    Parameters
    ----------
    system, machine : str, optional
        As `platform.system` and `platform.machine` spell them; this machine's by default.
    """
    system = platform.system() if system is None else system
    machine = platform.machine() if machine is None else machine
    found = SOURCES.get((system, machine)) or SOURCES.get((system, "")) or SOURCES["", ""]
    return ", or ".join(found)
