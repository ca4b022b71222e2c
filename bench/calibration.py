"""Coverage of the fitted throughput: the share of wavelengths at which the 95 % band holds the truth.

Draws standard stars and dark frames, with throughput, dark law and gain that the fit does not know, and counts. Prints
the coverage of electrons per photon, and of DN per photon, which has no error of the gain, with standard errors by the
scatter of the repetitions.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from mauvecl.host.instrument.curve import Curve
from tests.observations.test_calibrated_coverage import relative
from tests.observations.test_calibration import NOMINAL, STARS, answer_of, truth

NM = np.linspace(195.0, 705.0, 2041)
#: Factors on the nominal throughput by name; that of the tests is smooth.
FACTORS = {
    "steps": np.exp(0.1 * (NM > 300) - 0.15 * (NM > 420) + 0.2 * (NM > 550)),
    "edge": 0.02 + 1 / (1 + np.exp((225 - NM) / 6)),
    "tilt": np.exp(-0.3 + 0.4 * (NM - 450) / 250),
}


def main() -> None:
    """Fit as many sets of observations as asked for, and print the coverage after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--stars", type=int, default=len(STARS))
    parser.add_argument("--truth", choices=["smooth", *FACTORS], default="smooth")
    asked = parser.parse_args()
    true = truth()
    if asked.truth in FACTORS:
        true = truth(throughput_factor=Curve(tuple(NM), tuple(FACTORS[asked.truth])))
    covered = []
    for seed in range(asked.first_seed, asked.first_seed + asked.repetitions):
        answer = answer_of(STARS[: asked.stars], true, seed)
        f, (off_counts, counts) = answer.throughput, relative(answer, true)
        off = f.log_factor - np.log(true.throughput(f.wavelength_nm) / NOMINAL.throughput(f.wavelength_nm))
        covered.append([np.mean(np.abs(off) < 1.96 * f.error), np.mean(np.abs(off_counts) < 1.96 * counts)])
        mean, error = 100 * np.mean(covered, axis=0), 100 * np.std(covered, axis=0) / np.sqrt(len(covered))
        kinds = zip(mean, error, ("per electron", "per DN"), strict=True)
        text = ", ".join(f"{share:.2f} +- {wrong:.2f} % {of}" for share, wrong, of in kinds)
        print(f"{len(covered)} repetitions: {text}", flush=True)


if __name__ == "__main__":
    main()
