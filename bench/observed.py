"""Stares with pointing losses, drawn, written to FITS and analysed blind: false alarms, flares found, intervals.

    python bench/observed.py M3V 9 12 2900
    python bench/observed.py G2V 8 12 3000

print a row for each stare and the sums of docs/validation.md: star, magnitude, number of stares, first seed. Each stare
lasts 90 minutes and has one flare, drifts out of the fibre, jitter and drift of the light, and cosmic rays.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mauvecl import Study, analyse, stare
from mauvecl.device.stares import Stares
from mauvecl.observations.frame_files import read_frames

#: False alarms per star-day, enough to count them in a few star-days.
FALSE_ALARMS = 10.0
#: Distance of an event's brightest frame from the peak of the flare that was put in, s.
NEAR_S = 120.0


@dataclass(frozen=True)
class Outcome:
    """What a blind analysis of one stare found.

    Attributes
    ----------
    days : float
        Star-days that were searched.
    false : int
        Detected flares where there is none.
    found : bool
        True if the flare that was put in is detected.
    inside : dict of str to bool
        Measured quantities, and if their 95 % intervals hold the truth.
    """

    days: float
    false: int
    found: bool
    inside: dict[str, bool]


def outcome(
    engine: Stares, star: str, magnitude: float, amplitude: float, seed: int, rate_per_h: float = 3.0
) -> Outcome:
    """Draw a stare, write it, and analyse the file."""
    rng = np.random.default_rng(seed)
    study = Study(
        star=[{"library": star, "magnitude": magnitude, "distance_pc": 5.0}],
        flare={"temperature_k": float(rng.uniform(8_000, 14_000))},
        stare={"duration_s": 5400.0, "jitters": {"light": 0.005}, "drifts": {"star": 0.01}, "search": False,
               "pointing": {"rate_per_h": rate_per_h} if rate_per_h else None},
        events=[{"peak_s": float(rng.uniform(900, 4500)), "half_width_s": float(rng.uniform(30, 120)),
                 "amplitude": amplitude}],
        search={"false_alarms": FALSE_ALARMS, "per": "day"}, processes={"cosmic_rays": {"rate_per_cm2_s": 5.0}},
        run={"seed": seed},
    )  # fmt: skip
    drawn = stare(study, engine)
    (truth,) = drawn.stares[0].flares
    with tempfile.TemporaryDirectory() as folder:
        drawn.write(Path(folder))
        frames = read_frames(Path(folder) / "light-curve-1.fits")
    blind = Study(star=study.star, search=study.search)
    answer = analyse(blind, frames=frames)
    one = answer.analysis
    near, far = [], []
    for row in answer.rows:
        if row.verdict == "detected":
            time_s = one.survey.time_s[row.event.first : row.event.last + 1]
            inside = time_s[0] - NEAR_S < truth.event.peak_s < time_s[-1] + NEAR_S
            (near if inside else far).append(row)
    held = {}
    for row in near[:1]:
        if not isinstance(row.measured, str):
            # Frames of an event lack the faint tail of its flare: a tenth of its energy at most.
            for name, value, more in (("temperature", study.flare.temperature_k, 1.0),
                                      ("energy bolometric", truth.bolometric_erg, 1 / 0.9)):  # fmt: skip
                k = row.measured.column(name)
                held[name] = bool(row.measured.low[1, 0, k] < value < row.measured.high[1, 0, k] * more)
    return Outcome(one.days, len(far), bool(near), held)


def main(star: str, magnitude: float, number: int, first: int, amplitude: float) -> None:
    """Print the outcome of each stare, and sums."""
    engine, found = Stares(), []
    for seed in range(first, first + number):
        found.append(outcome(engine, star, magnitude, amplitude, seed))
        print(seed, found[-1], flush=True)
    days = sum(one.days for one in found)
    print(f"{star} V={magnitude:g}: {days:.2f} star-days, {sum(one.false for one in found)} false alarms, expected "
          f"{FALSE_ALARMS * days:.1f}; {sum(one.found for one in found)} of {number} flares")  # fmt: skip
    for name in ("temperature", "energy bolometric"):
        held = [one.inside[name] for one in found if name in one.inside]
        print(f"{name}: the 95 % intervals hold {sum(held)} of {len(held)}")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), float((*sys.argv, "0.3")[5]))
