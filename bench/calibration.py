"""Coverage of the fitted throughput: the share of wavelengths at which the 95 % band holds the truth.

Draws five standard stars and dark frames, with throughput, dark law and gain that the fit does not know, and counts.
Prints the coverage of electrons per photon, and of DN per photon, which has no error of the gain.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "observations"))

from test_calibration import NOMINAL, STARS, answer_of, truth


def main() -> None:
    """Fit as many sets of observations as asked for, and print the coverage after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=100)
    asked = parser.parse_args()
    true = truth()
    covered = []
    for seed in range(asked.first_seed, asked.first_seed + asked.repetitions):
        answer = answer_of(STARS, true, seed)
        f, gain = answer.throughput, answer.transfer.noise.gain
        off = f.log_factor - np.log(true.throughput(f.wavelength_nm) / NOMINAL.throughput(f.wavelength_nm))
        counts = np.sqrt(f.error**2 - answer.transfer.relative_gain_error**2)
        off_counts = off - np.log(true.gain_dn_per_electron / gain)
        covered.append([np.mean(np.abs(off) < 1.96 * f.error), np.mean(np.abs(off_counts) < 1.96 * counts)])
        electrons, dn = np.mean(covered, axis=0)
        print(f"{len(covered)} repetitions: {100 * electrons:.2f} % per electron, {100 * dn:.2f} % per DN", flush=True)


if __name__ == "__main__":
    main()
