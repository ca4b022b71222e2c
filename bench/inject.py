"""How fast flares are injected and searched for: maps of 16 half-widths x 16 sizes.

    python bench/inject.py [--count 100000] [--device NAME] [--output bench/results/inject.ecsv]

Each line is a map of `mauvecl inject`, with its thresholds, its null of 100 stares and 40 fits of each cell, on all
processors; processor time and wall time, for machines with other work.
"""

from __future__ import annotations

import argparse
import os
import time
from datetime import UTC, datetime
from pathlib import Path

from astropy.table import Table

from mauvecl.answers.inject import inject
from mauvecl.device.stares import Stares
from mauvecl.study.study import Study

STAR = {"star": [{"library": "G2V", "magnitude": 7.4}]}
#: What is injected into; all of them a star-day of elapsed time.
CASES = {
    "a day": {"stare": {"duration_s": 86_400.0}},
    "gaps in every orbit": {"stare": {"duration_s": 86_400.0, "orbit_gap_s": 2100.0}},
    "gaps, jitter and a thermal cycle": {
        "stare": {
            "duration_s": 86_400.0,
            "orbit_gap_s": 2100.0,
            "jitters": {"light": 0.01},
            "cycles": {"temperature": 0.3},
        }
    },
}


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="injections of each cell")
    parser.add_argument(
        "--case", choices=CASES, action="append", help="some of them alone, added to the table that is there"
    )
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "inject.ecsv")
    options = parser.parse_args()
    names = ("stare", "cells", "injections", "wall", "processor", "rate")
    table = Table(names=names, dtype=("U64", int, int, float, float, float))
    if options.case and options.output.exists():
        for row in Table.read(options.output):
            if row["stare"] not in options.case:
                table.add_row(tuple(row))
    stares = Stares(options.device)
    for name, case in CASES.items():
        if options.case and name not in options.case:
            continue
        study = Study.build({**STAR, **case, "injections": {"count": options.count}}, name)
        wall, used = time.perf_counter(), time.process_time()
        found = inject(study, stares)
        wall, used = time.perf_counter() - wall, time.process_time() - used
        (star,) = found.stars
        cells = star.injected.completeness.size
        table.add_row((name, cells, star.injected.count, wall, used, cells * star.injected.count / used))
        print(*table[-1], flush=True)
    for name, unit, form, text in (
        ("injections", "", "d", "of each cell"),
        ("wall", "s", ".0f", "elapsed"),
        ("processor", "s", ".0f", "of all processors together"),
        ("rate", "1 / s", ".3g", "injections in a second of one processor"),
    ):
        table[name].unit, table[name].format, table[name].description = unit or None, form, text
    table.meta = {"date_utc": datetime.now(UTC).date().isoformat(), "processors": str(os.cpu_count())}
    table.write(options.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
