"""What the benches' tables have in common: where and when they were made, and how they are written."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from pathlib import Path

import numpy as np
from astropy.table import Table

from mauvecl import __version__


def processor() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores"


def versions() -> dict[str, str]:
    """Return the versions of the packages on which a rate depends."""
    return {
        "mauvecl": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "pyopencl": importlib.metadata.version("pyopencl"),
    }


def write(table: Table, path: Path, **about: object) -> None:
    """Write a table with metadata and the date, and print it."""
    table.meta |= about | {"date_utc": time.strftime("%Y-%m-%d", time.gmtime())}
    path.parent.mkdir(parents=True, exist_ok=True)
    table.write(path, format="ascii.ecsv", overwrite=True)
    table.pprint(max_lines=-1, max_width=-1, align="<")
