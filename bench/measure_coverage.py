"""Coverage of the intervals that `measure` states: unknowns drawn or none, Balmer jumps, faint flares, saturation.

    python bench/measure_coverage.py [--fits 1000] [--device NAME] [--output bench/results/measure_coverage.ecsv]

Each case is a study that the verb answers. With unknowns, the documented ones are drawn: a loss of 0-5 % of all light
in each frame, 0.5 deg C of the detector, 10 % of the sky. A case without a second number of frames has ten of 5 s.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import Engine, Study, measure


class Case(NamedTuple):
    """Star, flare and exposure of a study."""

    star: str
    magnitude: float
    amplitude: float
    kelvin: float = 10_000.0
    exposure_s: float = 50.0
    jump: float = 1.0
    unknowns: bool = True
    nuisances: tuple[str, ...] = ()  # in addition, as settings


CASES = (
    Case("M3V", 7.0, 0.5),
    Case("M3V", 7.0, 0.5, unknowns=False),
    Case("G2V", 4.0, 0.5),
    Case("G2V", 4.0, 0.02),
    Case("K2.5V", 5.5, 0.1, 20_000.0),
    Case("M3V", 9.0, 0.5, 14_000.0),
    Case("M3V", 11.0, 5.0),
    Case("M5V", 12.0, 40.0, 9000.0),
    Case("M5V", 10.0, 0.1),
    Case("F5V", 5.0, 0.05, 15_000.0, 300.0),
    Case("M3V", 6.0, 1.0, exposure_s=5.0),
    Case("M3V", 9.0, 20.0, exposure_s=5.0),
    Case("M3V", 9.0, 0.5, 9500.0, jump=2.0),
    Case("M3V", 7.0, 2.0, 9500.0, jump=2.5),
    Case("M3V", 9.0, 0.02, 9500.0, jump=2.0, unknowns=False),
    Case("K2.5V", 2.0, 5.0, unknowns=False),
    Case("K2.5V", 2.0, 1.5),
    Case("G2V", 0.75, 0.3, 9000.0),
    Case("M3V", 5.0, 10.0),
    Case("M3V", 8.0, 0.5, nuisances=("nuisances.light=0.03",)),
    Case("M3V", 8.0, 0.5, nuisances=("nuisances.light='free'",)),
)


def study_of(case: Case, fits: int, seed: int) -> Study:
    """Return the study of a case."""
    return Study().with_settings(
        [
            f"star=[{{library='{case.star}', magnitude={case.magnitude}}}]", f"flare.amplitudes=[{case.amplitude}]",
            f"flare.temperature_k={case.kelvin}", f"flare.spectrum.balmer_jump={case.jump}",
            f"observation.exposure_s={case.exposure_s}", f"nuisances.usual={str(case.unknowns).lower()}",
            f"measure.fits={fits}", f"run.seed={seed}", *case.nuisances,
        ]
    )  # fmt: skip


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=1000)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "measure_coverage.ecsv")
    options = parser.parse_args()
    engine, rows = Engine(options.device), []
    for seed, case in enumerate(CASES, start=4200):
        # The last model is the one that the flare has.
        flare = measure(study_of(case, options.fits, seed), engine).flares[-1]
        kept = ("quantity", "coverage_68", "coverage_95", "coverage_95_low", "coverage_95_high", "one_sided")
        for row in flare.rows():
            error = float(row["error"])
            pull = float(row["bias"]) / error if error > 0 else np.nan
            named = " ".join((*(["drawn"] if case.unknowns else []), *case.nuisances)) or "none"
            where = *case[:6], named, flare.found.dof, options.fits
            rows.append((*where, *(row[name] for name in kept), pull))
    names = ("star", "magnitude", "amplitude", "temperature", "exposure", "jump", "unknowns", "dof", "fits", "quantity",
             "coverage_68", "coverage_95", "coverage_95_low", "coverage_95_high", "one_sided",
             "bias_over_error")  # fmt: skip
    table = Table(rows=rows, names=names)
    for name in names[10:]:
        table[name].format = ".3f"
    write(table, options.output, processor=processor(), device=engine.device_name, versions=versions())


if __name__ == "__main__":
    main()
