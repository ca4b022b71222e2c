"""What each verb takes, as a user types it: wall, CPU and kernel seconds, and what the kernels alone would need.

python bench/verbs.py [--output bench/results/verbs.ecsv] [--repeats 3]

Each verb runs in a process of its own with its kernels built. The seconds of its kernels are those between a request's
beginning and its end on the device; what they alone would need is the CPU time of these requests over the cores,
without the work of Python's other threads. Judge by ratios, and on an idle machine: others stretch wall time,
and leave CPU time nearly alone; the table states the machine's load.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.table import Table

from mauvecl import Engine

#: Words of each command, wanted wall seconds, and the wanted ratio to the kernels' own time.
CASES: dict[str, tuple[list[str], float, float]] = {
    "--version": (["--version"], np.nan, np.nan),
    "a wrong value": (["detect", "-m", "99"], 0.3, np.nan),
    "library": (["library"], np.nan, np.nan),
    "exposure": (["exposure", "--snr", "10", "--at", "300", "--star", "G2V", "-m", "7.4"], np.nan, np.nan),
    "simulate": (["simulate", "--star", "G2V", "-m", "7.4"], np.nan, np.nan),
    "snr": (["snr", "--star", "G2V", "-m", "7.4"], 6.0, np.nan),
    "detect": (["detect"], 5.0, 2.5),
    "gaussian": (["gaussian", "--star", "G2V"], 10.0, np.nan),
    "map": (["map", "--star", "G2V"], 12.0, 2.5),
    "limit": (["limit", "--star", "G2V"], 15.0, 2.5),
    "selftest": (["selftest"], 20.0, np.nan),
}

#: Runs a command line and prints the seconds of its requests to the device on the last line of standard error.
CHILD = """
import json, sys, threading, time
ended = []
run = threading.Thread.run
def running(thread):
    try:
        run(thread)
    finally:
        ended.append((thread, time.thread_time()))
threading.Thread.run = running
def aside():
    # CPU time of Python's other threads, those that have ended too.
    gone = dict(ended)
    living = [t.ident for t in threading.enumerate() if t not in gone and t is not threading.current_thread()]
    clocks = [time.clock_gettime(time.pthread_getcpuclockid(i)) for i in living]
    return sum(clocks) + sum(gone.values())
home, words = sys.argv[1:]
sys.argv = ["mauvecl", *json.loads(words)]
found = {"kernel": 0.0, "alone": 0.0}
def watched(inner):
    def count(self, *given, **more):
        wall, before = time.perf_counter(), time.process_time() - aside()
        try:
            return inner(self, *given, **more)
        finally:
            found["kernel"] += time.perf_counter() - wall
            found["alone"] += time.process_time() - aside() - before
    return count
class Watch:
    # Modules are left to be loaded when the command asks for them.
    def find_spec(self, name, path, target=None):
        if name != home:
            return None
        sys.meta_path.remove(self)
        import importlib.util
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module
        def execute(module):
            load(module)
            module.Engine.count = watched(module.Engine.count)
        spec.loader.exec_module = execute
        return spec
sys.meta_path.insert(0, Watch())
from mauvecl.cli.app import main
try:
    main()
finally:
    found["cpu"] = time.process_time()
    print(json.dumps(found), file=sys.stderr)
"""


def measured(words: list[str], folder: str) -> dict[str, float]:
    """Return the times of one run, s."""
    start = time.perf_counter()
    child = subprocess.run(
        [sys.executable, "-c", CHILD, Engine.__module__, json.dumps(words)],
        capture_output=True,
        text=True,
        cwd=folder,
        check=False,
    )
    wall = time.perf_counter() - start
    seconds: dict[str, float] = json.loads(child.stderr.splitlines()[-1])
    return seconds | {"wall": wall}


def write(rows: list[tuple[object, ...]], output: Path, repeats: int) -> None:
    """Write the table of the results so far."""
    columns = ("command", "wall", "wanted", "cpu", "kernels", "kernels_alone", "ratio", "wanted_ratio")
    table = Table(rows=rows, names=columns)
    for column in ("wall", "wanted", "cpu", "kernels", "kernels_alone"):
        table[column].unit = "s"
    for column in columns[1:]:
        table[column].info.format = ".1f"
    for column, text in (
        ("wall", f"of the command as it is typed; the best of {repeats}"),
        ("cpu", "of all threads"),
        ("kernels", "wall time of its requests to the device, one after the other"),
        ("kernels_alone", "CPU time of these requests alone, over the cores"),
        ("ratio", "wall over what the kernels alone would need"),
    ):
        table[column].info.description = text
    table.meta |= {
        "cores": os.cpu_count(),
        "load": f"{os.getloadavg()[2]:.1f}",
        "date_utc": time.strftime("%Y-%m-%d", time.gmtime()),
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    table.write(output, format="ascii.ecsv", overwrite=True)


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "verbs.ecsv")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    cores = os.cpu_count() or 1
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (words, wanted, ratio) in CASES.items():
            # The first of several builds what is not in the cache.
            runs = [measured(words, folder) for _ in range(asked.repeats)]
            best = min(runs, key=lambda run: run["wall"])
            alone = best["alone"] / cores if best["alone"] else np.nan
            rows.append(
                (
                    f"mauvecl {' '.join(words)}",
                    best["wall"],
                    wanted,
                    best["cpu"],
                    best["kernel"],
                    alone,
                    best["wall"] / alone,
                    ratio,
                )
            )
            print(name, *(f"{value:.2f}" for value in rows[-1][1:]), flush=True)
            write(rows, asked.output, asked.repeats)


if __name__ == "__main__":
    main()
