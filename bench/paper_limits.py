"""The paper's conclusions asked again: how faint may a G2V star be for a 24 % flare to show?

    python bench/paper_limits.py [--realisations 200000]

Writes bench/results/paper_limits.ecsv (each statistic, one frame and 50 s) and paper_assumptions.ecsv (what moves it).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from astropy.table import vstack
from tables import write

from mauvecl import Study, limit
from mauvecl.answers.limit import what_matters
from mauvecl.detection.requests import STATISTICS

KEPT = ("amplitude", "exposure", "statistic", "magnitude", "low", "high", "closed_form", "check")


def main() -> None:
    """Print both tables and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--realisations", type=int, default=200_000)
    options = parser.parse_args()
    folder = Path(__file__).parent / "results"

    def study(exposure: float, amplitude: float, *statistics: str) -> Study:
        return Study.build(
            {
                "star": [{"library": "G2V", "magnitude": 7.4}],
                "flare": {"amplitudes": [amplitude]},
                "observation": {"exposure_s": exposure},
                "run": {"realisations": options.realisations, "statistics": statistics},
            },
            "the paper's question",
        )

    parts = []
    for amplitude in (0.081, 0.24):
        for exposure in (5.0, 50.0):
            table = limit(study(exposure, amplitude, *STATISTICS)).table
            table["exposure"] = exposure
            table.meta.clear()
            parts.append(table[list(KEPT)])
            parts[-1].pprint(max_width=-1)
    limits = vstack(parts)
    limits["exposure"].unit = "s"
    for name in ("magnitude", "low", "high", "closed_form", "check"):
        limits[name].info.format = ".3f"
    moved = what_matters(study(50.0, 0.24, "chi2", "matched"))
    moved.meta.clear()
    write(limits, folder / "paper_limits.ecsv")
    moves = ("statistic", "assumption", "low_end", "high_end", "magnitude", "at_low_end", "at_high_end", "span")
    write(moved[moves], folder / "paper_assumptions.ecsv")


if __name__ == "__main__":
    main()
