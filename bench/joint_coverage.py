"""Coverage of the intervals of joint fits of a flare's shape and spectrum to all frames of a stare.

    python bench/joint_coverage.py [--fits 300] [--device NAME] [--output bench/results/joint_coverage.ecsv]

M3V at V = 9, 60 frames of 5 s, a flare that cools from 14 000 to 7000 K with a fold of 80 s and a half-width of 40 s.
Frames are drawn pixel by pixel, each from an expectation of its own. "free": dark level with no prior and all light,
that of the flare included, with one of 2 %, the same in all frames of a stare, drawn as dark 0.5 deg C and light 2 %.
The faint flare takes five times as long, for the ends of its cooling are often open, and has a third of the fits.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import Cooling, Engine, Event, FlareModel, Instrument, Nuisances, Source, Stare, expect, fit_cooling
from mauvecl.detection.distributions import clopper_pearson

COOLING = Cooling(14_000.0, 7000.0, 80.0)
#: Amplitude and share of the fits, by what is unknown.
CASES = (("known", 1.5, 1.0), ("free", 1.5, 1.0), ("known", 0.3, 1 / 3))
#: Standard deviations with which unknowns are drawn: deg C of the dark current, and a share of all light.
DRAWN = (0.5, 0.02)


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=300)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "joint_coverage.ecsv")
    options = parser.parse_args()
    mauve, star = Instrument.load("mauvesim"), Source.from_library("M3V").at_magnitude(9)
    engine = Engine(options.device)
    quiet, stare = expect(star, mauve, exposure=5.0), Stare.of(300.0)
    model = FlareModel.of(star, mauve, quiet)
    free = Nuisances.of(quiet, {"dark": np.inf, "light": 0.02})
    rows = []
    for case, (unknown, amplitude, share) in enumerate(CASES):
        event = Event(52.0, 40.0, amplitude, COOLING)
        edges = np.column_stack([stare.start_s, stare.start_s + stare.frame_s])
        rise = amplitude * event.form.mean_over(edges, event.peak_s, event.half_width_s)
        kelvin = COOLING.at(stare.middle_s - event.peak_s)
        frames = [
            replace(expect(star.flaring(float(a), float(k)), mauve, exposure=5.0), name="frame")
            for a, k in zip(rise, kelvin, strict=True)
        ]
        count, seed = round(share * options.fits), 1000 * (case + 1)
        raw = np.stack([engine.realise(one, count=count, seed=seed + k) for k, one in enumerate(frames)], axis=1)
        raw = raw.astype(np.float64)
        if unknown == "free":
            sizes = np.random.default_rng(seed).standard_normal((count, len(DRAWN))) * DRAWN
            raw += (sizes @ free.spectra)[:, None]
            raw += sizes[:, 1, None, None] * np.array([one.net_source_dn - quiet.net_source_dn for one in frames])
        how = {"peak_s": 50.0, "half_width_s": 30.0}
        nuisances = free if unknown == "free" else None
        mean = np.array([one.recorded_dn for one in frames])
        exact = fit_cooling(mean, quiet, model, nuisances, levels=(), **how)
        truth = np.concatenate([[52.0, 40.0, amplitude, 14_000.0, 7000.0, 80.0], exact.estimates[0, 6:]])
        inside = np.zeros((count, 2, truth.size), np.bool_)
        one_sided = np.zeros((count, truth.size), np.bool_)
        for k, one in enumerate(raw):
            found = fit_cooling(one, quiet, model, nuisances, **how)
            inside[k] = (found.low[:, 0] <= truth) & (truth <= found.high[:, 0])
            one_sided[k] = found.one_sided[-1, 0]
        for q, name in enumerate(exact.names):
            narrow, wide = (clopper_pearson(int(inside[:, k, q].sum()), count) for k in range(2))
            ends = narrow.value, narrow.low, narrow.high, wide.value, wide.low, wide.high
            rows.append((unknown, amplitude, float(exact.snr[0]), count, name, *ends, float(one_sided[:, q].mean())))
    names = ("unknowns", "amplitude", "snr", "fits", "quantity", "coverage_68", "coverage_68_low", "coverage_68_high",
             "coverage_95", "coverage_95_low", "coverage_95_high", "one_sided")  # fmt: skip
    table = Table(rows=rows, names=names)
    for name in names[5:]:
        table[name].format = ".3f"
    table["snr"].format = ".0f"
    write(table, options.output, processor=processor(), device=engine.device_name, versions=versions())


if __name__ == "__main__":
    main()
