"""Sources of OpenCL drivers for each operating system."""

from __future__ import annotations

import platform

#: Sources by system and machine, as Python's `platform` spells them; "" is any other machine.
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


def driver_sources(system: str | None = None, machine: str | None = None) -> str:
    """Return the sources of drivers for a machine, by default this one, as the end of a sentence."""
    system = platform.system() if system is None else system
    machine = platform.machine() if machine is None else machine
    found = SOURCES.get((system, machine)) or SOURCES.get((system, "")) or SOURCES["", ""]
    return ", or ".join(found)
