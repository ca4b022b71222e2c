"""What a user waits for before anything is drawn: imports, help, building the kernels, starting from the cache.

python bench/start.py [--output bench/results/start.ecsv]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import write

REPEATS = 5

#: A first small detection in a new process; prints its own seconds, imports apart.
DETECT = """
import time
from mauvecl.device.engine import Engine
from mauvecl.device.selftest import toy
quiet, flare = toy(1600), toy(1600, flare=0.1)
import mauvecl.detection.detection, pyopencl, scipy.special
start = time.perf_counter()
Engine().detect(quiet, [flare], realisations=64, seed=1)
print(time.perf_counter() - start)
"""


def wall(*command: str) -> float:
    """Return the time of a whole process, s."""
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start


def measured(code: str, cache: str) -> float:
    """Return the seconds that a child process prints."""
    environment = os.environ | {"MAUVECL_CACHE_DIR": cache}
    child = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
    return float(child.stdout)


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "start.ecsv")
    output = parser.parse_args().output
    mauvecl = str(Path(sys.executable).parent / "mauvecl")
    found: dict[str, list[float]] = {}
    for _ in range(REPEATS):
        python = wall(sys.executable, "-c", "pass")
        found.setdefault("import mauvecl", []).append(wall(sys.executable, "-c", "import mauvecl") - python)
        found.setdefault("mauvecl --help", []).append(wall(mauvecl, "--help"))
        with tempfile.TemporaryDirectory() as cache:
            found.setdefault("three statistics, kernels built", []).append(measured(DETECT, cache))
            found.setdefault("three statistics, kernels from the cache", []).append(measured(DETECT, cache))
    wanted = (0.4, 0.5, 2.0, 0.2)
    table = Table(
        {"what": list(found), "seconds": [float(np.median(v)) for v in found.values()], "wanted": list(wanted)}
    )
    table["seconds"].unit = table["wanted"].unit = "s"
    table["seconds"].info.format = ".2f"
    table["seconds"].info.description = f"median of {REPEATS} new processes"
    write(table, output)


if __name__ == "__main__":
    main()
