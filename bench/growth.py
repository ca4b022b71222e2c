"""How time and memory grow with realisations, pixels, frames and scenarios.

    python bench/growth.py [--device NAME] [--output bench/results/growth.ecsv]

Each line is a process of its own, so that its memory peak is its own; times are the shortest of three, without the
kernels' build.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from astropy.table import Table
from tables import write

#: What grows, and through which values.
AXES = {
    "realisations": (1_000, 10_000, 100_000, 1_000_000, 10_000_000),
    "pixels": (64, 512, 1_600, 8_192, 65_536),
    "frames, drawn one by one": (1, 3, 10, 30, 100),
    "frames, drawn as a stack": (1, 3, 10, 30, 100),
    "scenarios": (1, 4, 16, 64),
}

CHILD = """
import json, resource, sys, time
from mauvecl.device.engine import Engine
from mauvecl.device.selftest import toy
axis, value, device = json.loads(sys.argv[1])
realisations = value if axis == "realisations" else 20_000
pixels = value if axis == "pixels" else 1_600
frames = value if axis.startswith("frames") else 10
mode = "frames" if "one by one" in axis else "stacked"
scenarios = value if axis == "scenarios" else 1
quiet = toy(pixels, frames)
flares = [toy(pixels, frames, flare=0.01 * (i + 1)) for i in range(scenarios - 1)]
engine = Engine(device)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
def work(n):
    start = time.perf_counter()
    engine.detect(quiet, flares, realisations=n, seed=1, statistics=("chi2",), mode=mode)
    return time.perf_counter() - start
work(64)
built = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
seconds = min(work(realisations) for _ in range(3))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"seconds": seconds, "draws": realisations * pixels * (frames if mode == "frames" else 1) * scenarios,
                  "peak": peak / 1024, "more": (peak - built) / 1024}))
"""


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "growth.ecsv")
    options = parser.parse_args()
    table = Table(names=("axis", "value", "seconds", "rate", "peak", "above_start"), dtype=(str, int, *[float] * 4))
    for axis, values in AXES.items():
        for value in values:
            child = subprocess.run(
                [sys.executable, "-c", CHILD, json.dumps([axis, value, options.device])],
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            found = json.loads(child.stdout)
            rate = found["draws"] / found["seconds"]
            table.add_row((axis, value, found["seconds"], rate, found["peak"], found["more"]))
            print(*table[-1], flush=True)
    for name, unit, form, text in (
        ("seconds", "s", ".3f", "shortest of three"),
        ("rate", "1 / s", ".2e", "pixel draws per second: realisations x pixels x scenarios x frames drawn one by one"),
        ("peak", "MiB", ".0f", "largest resident memory of the process"),
        ("above_start", "MiB", ".0f", "of it, beyond what the process had after its first 64 realisations"),
    ):
        table[name].unit, table[name].info.format, table[name].info.description = unit, form, text
    plain = "20 000 realisations of 1 600 pixels, a stack of 10 frames, one scenario, chi2"
    write(table, options.output, plain=plain)


if __name__ == "__main__":
    main()
