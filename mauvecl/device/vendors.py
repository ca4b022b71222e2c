"""Intel's OpenCL runtime for processors as pip installs it.

The wheel brings the driver's library, but the .icd file that should name it holds a place of the machine on which the
wheel was made, in a folder where no loader looks. So the loader is shown a folder with a file that names the library,
next to what it would have found without; the PoCL that comes with pyopencl it finds in any case.
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

#: Name of the wheel, and of its driver.
WHEEL, DRIVER = "intel-opencl-rt", "libintelocl.so"
#: Variables that name the loader's folder, the first that is set; and the folder without them.
FOLDERS, USUAL = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"), "/etc/OpenCL/vendors"


@contextlib.contextmanager
def shown() -> Iterator[None]:
    """Let the OpenCL loader find Intel's runtime if it starts inside the block."""
    folder = None if os.environ.get(FOLDERS[0]) else _folder()
    if folder is None:
        yield
        return
    os.environ[FOLDERS[0]] = str(folder)
    try:
        yield
    finally:
        # Other programs started from here may outlive the folder.
        del os.environ[FOLDERS[0]]


@cache
def _folder() -> Path | None:
    """Make a folder of .icd files, Intel's among them, or return None if there is nothing to add."""
    library = _library()
    if library is None:
        return None
    places = [os.environ.get(FOLDERS[1]) or USUAL, os.path.join(sys.prefix, "etc", "OpenCL", "vendors")]
    known = {path.name: _text(path) for place in reversed(places) for path in sorted(Path(place).glob("*.icd"))}
    drivers = {name: text for name, text in known.items() if DRIVER not in text or Path(text.strip()).exists()}
    if any(DRIVER in text for text in drivers.values()):
        # The system knows Intel's runtime.
        return None
    folder = kernel_cache().work / "vendors"
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        for name, text in (drivers | {"mauvecl-intel.icd": f"{library}\n"}).items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder
    return None


def _library() -> Path | None:
    """Return the driver's library of the wheel, if that is installed here."""
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
