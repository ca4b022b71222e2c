"""The same bits everywhere: digests of every kernel and statistic, side by side, for every OpenCL device found.

    python bench/same_bits.py [--output FILE.ecsv]

The first column is the NumPy reference's. Drivers outside the system's list are found through ``OCL_ICD_VENDORS``, a
folder of .icd files, each naming a driver's library (Intel's is libintelocl.so of the wheel intel-opencl-rt). Oclgrind
is added if it is installed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from astropy.table import Table

CHILD = """
import hashlib, json, sys
from dataclasses import asdict
from mauvecl.device import selftest
from mauvecl.device.engine import Engine, devices
for number, record in enumerate(devices()):
    found = {}
    for width in (None, 1):
        engine = Engine(str(number), width=width)
        digests = {
            f"{name}: {part}": hashlib.sha256(array.tobytes()).hexdigest()[:12]
            for name in selftest.CASES for part, array in selftest.results(engine, name, selftest.COUNT).items()
        }
        found = found or digests
        scalar = digests == found
    print(json.dumps({"device": asdict(record), "digests": found, "scalar": scalar}), flush=True)
"""


def vendors(folder: Path) -> dict[str, str]:
    """Return the environment with Oclgrind's driver in addition to the others."""
    listed = Path(os.environ.get("OCL_ICD_VENDORS", "/etc/OpenCL/vendors"))
    for icd in listed.glob("*.icd"):
        shutil.copy(icd, folder)
    for library in Path("/usr/lib").rglob("liboclgrind-rt-icd.so"):
        (folder / "oclgrind.icd").write_text(f"{library}\n")
    return os.environ | {"OCL_ICD_VENDORS": str(folder)}


def main() -> int:
    """Print the table; the exit code says whether all are equal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="write the table as ECSV")
    output = parser.parse_args().output
    from mauvecl.device import selftest

    arrays = selftest.known_arrays()
    reference = {name: hashlib.sha256(array.tobytes()).hexdigest()[:12] for name, array in arrays.items()}
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            [sys.executable, "-c", CHILD], env=vendors(Path(folder)), stdout=subprocess.PIPE, text=True, check=True
        )
    found = [json.loads(line) for line in run.stdout.splitlines()]
    columns = {"case": [], "part": [], "reference": []} | {f"device {i}": [] for i in range(len(found))}
    for name, digest in reference.items():
        case, _, part = name.rpartition(": ")
        if case in selftest.CASES:
            columns["case"].append(case)
            columns["part"].append(part)
            columns["reference"].append(digest)
            for i, one in enumerate(found):
                columns[f"device {i}"].append(one["digests"][name])
    table = Table(columns)
    same = True
    for i, one in enumerate(found):
        device = one["device"]
        label = f"{device['platform']}: {device['name']}, driver {device['driver']}"
        equal = one["scalar"] and list(table[f"device {i}"]) == list(table["reference"])
        same &= equal
        print(f"{i} = {label}; promises: {device['promise']}; {'EQUAL' if equal else 'DIFFERENT'}")
        table.meta[f"device {i}"] = f"{label}; promises: {device['promise']}"
    table.pprint(max_lines=-1, max_width=-1)
    if output is not None:
        table.write(output, format="ascii.ecsv", overwrite=True)
    print("All equal, with vectors and with one realisation to a work-item." if same else "NOT all equal.")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
