"""Measure the rate of raw frames into a store, and the rates of engine and disk alone.

    python bench/store.py [--folder PLACE] [--realisations N] [--repeats K] [--output bench/results/store.ecsv]

Three ways in turn, several times: the engine alone into memory; the same bytes into one file, brought to the disk at
the end; and `mauvecl realise`, which also checks, digests, renames and lists each chunk. Medians; the memory peak is
of a process that draws one set, and of another that draws four times as many.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import write

from mauvecl.device.engine import Engine
from mauvecl.runs import bulk
from mauvecl.study.cases import Case
from mauvecl.study.study import Study

CHILD = """
import resource, sys
from mauvecl.runs import bulk
from mauvecl.device.engine import Engine
sys.path.insert(0, sys.argv[1])
from store import study
bulk.realise(study(int(sys.argv[3])), sys.argv[2], Engine())
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def study(realisations: int) -> Study:
    """Return a study of frames of the paper's G2V star, without and with a flare."""
    star = {"library": "G2V", "magnitude": 7.4}
    data = {"star": [star], "flare": {"amplitudes": [0.24]}, "observation": {"exposure_s": 5.0}}
    return Study.build(data | {"run": {"realisations": realisations}}, "bench")


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--realisations", type=int, default=300_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "store.ecsv")
    given = parser.parse_args()
    asked, engine = study(given.realisations), Engine()
    place = Path(tempfile.mkdtemp(dir=given.folder))
    quiet = Case(asked).expectations[0]
    rows = np.empty((20_000, quiet.wavelength_nm.size), np.uint16)
    engine.realise(quiet, count=len(rows), seed=1, out=rows)
    total = 2 * given.realisations * rows.shape[1] * 2

    def drawn() -> None:
        for start in range(0, 2 * given.realisations, len(rows)):
            count = min(len(rows), 2 * given.realisations - start)
            engine.realise(quiet, start=start, count=count, seed=1, out=rows[:count])

    def written() -> None:
        with (place / "plain").open("wb", buffering=0) as file:
            left = total
            while left:
                left -= file.write(memoryview(rows).cast("B")[: min(left, 16 * 2**20)])
            os.fsync(file.fileno())

    def stored() -> None:
        bulk.realise(asked, place / "store", engine)

    ways: dict[str, Callable[[], None]] = {"engine alone": drawn, "plain write": written, "mauvecl realise": stored}
    rates: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(given.repeats):
        for name, way in ways.items():
            started = time.perf_counter()
            way()
            rates[name].append(total / (time.perf_counter() - started) / 1e9)
            shutil.rmtree(place / "store", ignore_errors=True)
            (place / "plain").unlink(missing_ok=True)
    medians = {name: statistics.median(values) for name, values in rates.items()}
    allowed = [min(a, b) for a, b in zip(rates["engine alone"], rates["plain write"], strict=True)]
    share = statistics.median(c / a for c, a in zip(rates["mauvecl realise"], allowed, strict=True))
    peaks = []
    for factor in (1, 4):
        words = [sys.executable, "-c", CHILD, str(Path(__file__).parent), str(place / "store")]
        done = subprocess.run([*words, str(factor * given.realisations)], capture_output=True, text=True, check=True)
        peaks.append(float(done.stdout))
        shutil.rmtree(place / "store")
    shutil.rmtree(place)
    table = Table()
    table["what"] = [
        *(f"{name} (GB/s)" for name in ways),
        "mauvecl realise / the slower of the others",
        "memory peak (MiB)",
        "memory peak of four times as many (MiB)",
    ]
    table["median"] = [f"{value:.2f}" for value in (*medians.values(), share)] + [f"{p:.0f}" for p in peaks]
    spread = [f"{min(v):.2f}-{max(v):.2f}" for v in rates.values()]
    table["range"] = [*spread, "", "", ""]
    run = f"{total / 1e9:.2f} GB of 16-bit frames, {given.repeats} turns, {engine.device_name}"
    write(table, given.output, run=run)


if __name__ == "__main__":
    main()
