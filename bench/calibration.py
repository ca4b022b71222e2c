"""Coverage of fitted throughputs and of answers with fitted instruments.

    python bench/calibration.py [--sets 100] [--truth smooth] [--stars B3V:4.5 A0V:5.0 FILE ...] [--answers]

Draws frames of standard stars and of no light, with a throughput, dark law and gain that the fit does not know, and
counts at which share of the wavelengths the 95 % band holds the true electrons per photon, and DN per photon, which has
no error of the gain. Standard errors are those of the scatter of the sets, since wavelengths of a set vary together.
The spectrum of a single star is drawn wrong, by as much as the fit assumes. With ``--answers`` limit, measurements and
plan through each fitted instrument are compared with those through the true one.

The row of a truth and of its stars replaces that in the table; other rows stay.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.table import Table

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from tables import processor, versions, write

from mauvecl import Study, calibrate
from mauvecl.host.instrument.curves import SpectralCurve
from mauvecl.host.stars.source import Source
from mauvecl.observations.throughput import ERROR_KNOTS, ONE_STAR_ERROR
from tests.observations.test_calibration import NOMINAL, STARS, deviations, frames_of, relative, truth

NM = np.linspace(195.0, 705.0, 2041)
#: Factors on the nominal throughput by name; that of the tests is smooth.
FACTORS = {
    "steps": np.exp(0.1 * (NM > 300) - 0.15 * (NM > 420) + 0.2 * (NM > 550)),
    "edge": 0.02 + 1 / (1 + np.exp((225 - NM) / 6)),
    "tilt": np.exp(-0.3 + 0.4 * (NM - 450) / 250),
    "wave": np.exp(0.15 * np.sin((NM - 200) / 12)),
    "nominal": np.ones(NM.size),
}


def row_of(text: str) -> str:
    """Return the observation of a star, a name or file with its magnitude after a colon, as a row of a study."""
    name, _, magnitude = text.partition(":")
    key = "spectrum" if Path(name).exists() else "library"
    return f'{{frames="x", {key}="{name}"{f", magnitude={magnitude}" if magnitude else ""}}}'


def wrong(star: Source, rng: np.random.Generator) -> Source:
    """Draw another spectrum of a star, with the errors that a fit to it alone assumes."""
    at = np.linspace(NOMINAL.wavelength_nm[0], NOMINAL.wavelength_nm[-1], ERROR_KNOTS)
    factor = np.interp(star.wavelength_nm, at, np.exp(ONE_STAR_ERROR * rng.standard_normal(ERROR_KNOTS)))
    return replace(star, flux_flam=star.flux_flam * factor)


def main() -> None:
    """Fit as many sets of observations as asked for, and print and write the coverage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--truth", choices=["smooth", *FACTORS], default="smooth")
    parser.add_argument("--stars", nargs="+", default=[f"{name}:{magnitude:g}" for name, magnitude in STARS])
    parser.add_argument("--answers", action="store_true")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "calibration.ecsv")
    asked = parser.parse_args()
    true = truth()
    if asked.truth in FACTORS:
        true = truth(throughput_factor=SpectralCurve(tuple(NM), tuple(FACTORS[asked.truth])))
    rows = ", ".join(map(row_of, asked.stars))
    study = Study().with_settings([f'calibrate.observations=[{rows}, {{frames="y"}}]'])
    stars = [source for one in study.calibrate.observations if (source := one.source()) is not None]
    counted: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(asked.first_seed, asked.first_seed + asked.sets):
            rng = np.random.default_rng(seed)
            seen = [wrong(stars[0], rng)] if len(stars) == 1 else stars
            frames = [frames_of(true, one, [16.0 + k], 40, rng) for k, one in enumerate(seen)]
            frames.append(frames_of(true, None, [13.0, 15.0, 17.0, 19.0, 21.0], 30, rng))
            answer = calibrate(study, frames=tuple(frames))
            f, (off_counts, counts) = answer.throughput, relative(answer, true)
            off = f.log_factor - np.log(true.throughput(f.wavelength_nm) / NOMINAL.throughput(f.wavelength_nm))
            one = {
                "electrons per photon": np.mean(np.abs(off) < 1.96 * f.error),
                "DN per photon": np.mean(np.abs(off_counts) < 1.96 * counts),
            }
            if asked.answers:
                answer.write(Path(folder) / str(seed))
                far = deviations(true, Path(folder) / str(seed) / "instrument.toml")
                one |= {name: float(abs(value) < 1.96) for name, value in far.items()}
                one |= {f"{name} in errors": value**2 for name, value in far.items()}
            for name, value in one.items():
                counted.setdefault(name, []).append(value)
            print(seed, *(f"{name} {np.mean(values):.4f}" for name, values in counted.items()), sep=", ", flush=True)
    names = " ".join(Path(text).name for text in asked.stars)
    made = [
        (asked.truth, names, name, asked.sets, 100 * np.mean(values), 100 * np.std(values) / np.sqrt(asked.sets),
         np.sqrt(np.mean(counted.get(f"{name} in errors", [np.nan]))))
        for name, values in counted.items() if not name.endswith(" in errors")
    ]  # fmt: skip
    columns = ("throughput", "stars", "quantity", "sets", "within_percent", "within_error", "rms_in_errors")
    if asked.output.exists():
        made = [
            tuple(row) for row in Table.read(asked.output) if (row["throughput"], row["stars"]) != (asked.truth, names)
        ] + made
    table = Table(rows=made, names=columns)
    for name in columns[4:]:
        table[name].format = ".2f"
    write(table, asked.output, processor=processor(), versions=versions())


if __name__ == "__main__":
    main()
