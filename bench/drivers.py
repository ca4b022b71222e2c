"""How fast each OpenCL driver is on this machine's processor, and whether it draws the same bits.

    python bench/drivers.py [--python COMMAND]... [--output FILE.ecsv]

Every device of every Python is measured: of this one, and of those that `--python` names, such as
``--python "chroot /srv/debian13 /venv/bin/python"``. They take turns in rounds, so that what else the machine does
strikes all alike; ratios are those of one round to the first device, and their median stands in the table.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import processor, write

ROUNDS = 5
#: Prints each device of a Python, its rate and the digests of two cases.
CHILD = """
import json, platform, sys
import numpy
from mauvecl.device import selftest
from mauvecl.device.engine import Engine, devices
from mauvecl.device.selftest import chi2_rate
for number, record in enumerate(devices()):
    if record.kind != "cpu" or record.platform == "Oclgrind":
        continue
    engine = Engine(str(number))
    known, names = selftest.known_arrays(), ("stack", "one frame")
    results = {name: selftest.results(engine, name, selftest.COUNT) for name in names}
    same = all((array == known[f"{name}: {part}"]).all() for name in names for part, array in results[name].items())
    version = engine.open_device.context.devices[0].platform.version
    python = f"{platform.python_version()}, numpy {numpy.__version__}"
    rate = max(chi2_rate(engine) for _ in range(3))
    print(json.dumps([record.platform, record.driver, version, python, same, rate]), flush=True)
"""


def measured(python: list[str]) -> list[list[object]]:
    """Return what a Python prints, device by device."""
    run = subprocess.run([*python, "-c", CHILD], stdout=subprocess.PIPE, text=True, check=True)
    return [json.loads(line) for line in run.stdout.splitlines()]


def main() -> int:
    """Print the table and write it; the exit code says whether all bits are equal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", default=[], help="another Python with mauvecl and drivers")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "drivers.ecsv")
    asked = parser.parse_args()
    pythons = [[sys.executable], *map(shlex.split, asked.python)]
    rounds = [[device for python in pythons for device in measured(python)] for _ in range(ROUNDS)]
    rates = np.array([[device[-1] for device in one] for one in rounds], float)
    first = rounds[0]
    compiler = [str(d[2]).rpartition("LLVM ")[2].split(",")[0] if "LLVM" in str(d[2]) else "" for d in first]
    table = Table(
        {
            "driver": [f"{d[0]} {d[1]}" for d in first],
            "LLVM": compiler,
            "Python": [d[3] for d in first],
            "same bits": [all(one[i][4] for one in rounds) for i in range(len(first))],
            "rate": np.median(rates, axis=0),
            "ratio": np.median(rates / rates[:, :1], axis=0),
        }
    )
    table["rate"].unit, table["rate"].info.format, table["ratio"].info.format = "1 / s", ".2g", ".2f"
    table["rate"].info.description = "pixel-realisations of chi2, median of the rounds"
    table["ratio"].info.description = f"to the first driver, median of {ROUNDS} rounds"
    write(table, asked.output, processor=processor())
    return 0 if all(table["same bits"]) else 1


if __name__ == "__main__":
    sys.exit(main())
