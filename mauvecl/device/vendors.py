"""Support for Intel's OpenCL runtime for CPUs as installed by pip.

The wheel contains the driver's library, but its .icd file names a path of the machine on which the wheel was built, and
no loader searches the file's folder. The loader is therefore given a folder with a correct .icd file in addition to
those that it would have found. It finds the PoCL of pyopencl's wheels in any case.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path

from mauvecl.device.kernel_cache import kernel_cache

#: Name of the wheel and of its driver's library.
WHEEL, DRIVER = "intel-opencl-rt", "libintelocl.so"
#: Variables that name the loader's folder, in order of precedence, and the default folder.
FOLDER_VARIABLES, DEFAULT_FOLDER = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"), "/etc/OpenCL/vendors"


@contextlib.contextmanager
def show_intel_runtime() -> Iterator[None]:
    """Make Intel's runtime visible to an OpenCL loader that starts inside the block."""
    folder = None if os.environ.get(FOLDER_VARIABLES[0]) else _folder()
    if folder is None:
        yield
        return
    os.environ[FOLDER_VARIABLES[0]] = str(folder)
    try:
        yield
    finally:
        # Child processes may outlive the folder.
        del os.environ[FOLDER_VARIABLES[0]]


@cache
def _folder() -> Path | None:
    """Make a folder of .icd files, Intel's among them, or return None if there is nothing to add."""
    library = _library()
    if library is None:
        return None
    system = os.environ.get(FOLDER_VARIABLES[1]) or DEFAULT_FOLDER
    folders = [system, os.path.join(sys.prefix, "etc", "OpenCL", "vendors")]
    known = {path.name: _text(path) for place in reversed(folders) for path in sorted(Path(place).glob("*.icd"))}
    drivers = {name: text for name, text in known.items() if DRIVER not in text or Path(text.strip()).exists()}
    if any(DRIVER in text for text in drivers.values()):
        # The system lists Intel's runtime already.
        return None
    folder = kernel_cache().work / "vendors"
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        for name, text in (drivers | {"mauvecl-intel.icd": f"{library}\n"}).items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder
    return None


def _library() -> Path | None:
    """Return the path of the wheel's library, or None if the wheel is not installed."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        for file in metadata.files(WHEEL) or ():
            if file.name == DRIVER:
                path = Path(str(file.locate())).resolve()
                return path if path.exists() else None
    return None


def _text(path: Path) -> str:
    with contextlib.suppress(OSError, UnicodeError):
        return path.read_text(encoding="utf-8")
    return ""
