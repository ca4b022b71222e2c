"""Pearson's test and four moments of 1e10 counts from the production kernel, for dark means of one frame and of ten.

    python bench/pearson.py [--draws 1e10] [--device NAME] [--output bench/results/pearson.ecsv]

Without read noise the raw count is the Poisson count, by alias table and by expansion; with it the joint draw is
compared with the exact convolution. A sound engine gives p below 1e-6 once in half a million new seeds.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy import special, stats
from tables import write

from mauvecl import Engine
from mauvecl.device.selftest import pearson, toy
from mauvecl.noise import layout, scene

PIXELS = 1600
SEED = 20_261_121
#: Mean, read noise (DN), how counts are drawn, where tables end.
CASES = (
    (2225.0, 0.0, "apart", np.inf, "alias table"),
    (2225.0, 0.0, "apart", 1000.0, "expansion"),
    (2225.0, 12.0, "joint", 1000.0, "joint draw, read noise 12 DN"),
    (22250.0, 0.0, "apart", np.inf, "alias table"),
    (22250.0, 0.0, "apart", 1000.0, "expansion"),
    (22250.0, 12.0, "joint", 1000.0, "joint draw, read noise 12 DN"),
)


def probabilities(mean: float, read: float, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probabilities of counts between half-integer edges: Poisson with added Gaussian noise."""
    if read == 0.0:
        below, above = stats.poisson.cdf(edges, mean), stats.poisson.sf(edges, mean)
    else:
        k = np.arange(int(mean - 11 * np.sqrt(mean)), int(mean + 12 * np.sqrt(mean)))
        p = stats.poisson.pmf(k, mean)
        below, above = (np.array([special.ndtr(sign * (e - k) / read) @ p for e in edges]) for sign in (1, -1))
    return np.where(below[1:] < 0.5, np.diff(below), -np.diff(above))


def moments(counts: NDArray[np.int64], expected: NDArray[np.float64]) -> list[float]:
    """Return moments of orders one to four of the binned counts less the expected ones, in standard errors."""
    x = np.arange(counts.size) - float(np.arange(counts.size) @ expected)
    x /= np.sqrt(x**2 @ expected)
    share, n = counts / counts.sum(), counts.sum()
    return [
        float((x**r @ share - x**r @ expected) / np.sqrt((x ** (2 * r) @ expected - (x**r @ expected) ** 2) / n))
        for r in (1, 2, 3, 4)
    ]


def main() -> int:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=float, default=1e10)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "pearson.ecsv")
    options = parser.parse_args()
    engine, rows = Engine(options.device), []
    for mean, read, recipe, smallest_expanded, title in CASES:
        x = replace(toy(PIXELS, 1, dark=mean, read=read, light=0.0), sky_electrons=np.zeros(PIXELS))
        with patch.object(scene, "SMALLEST_EXPANDED", smallest_expanded):
            found = engine.snr(x, realisations=int(options.draws / PIXELS), seed=SEED, recipe=recipe)
        counts = found.counts.dense("pixel").sum(axis=0)
        # A bin holds 2**shift whole DN.
        shift = int(found.observers["bin_shift"][0])
        bins = np.arange(layout.OBSERVER_BINS + 1) - layout.OBSERVER_BINS // 2
        edges = found.scene.base_dn[0, 0] - 600.0 + bins * 2.0**shift - 0.5
        expected = probabilities(mean, read, edges)
        rows.append((mean, title, counts.sum(), pearson(counts, expected), *moments(counts, expected / expected.sum())))
        print(*rows[-1], flush=True)
    names = ("mean", "drawn by", "counts", "p", "mean_z", "variance_z", "third_z", "fourth_z")
    table = Table(rows=rows, names=names)
    table["counts"].info.format = table["p"].info.format = ".3g"
    table["p"].info.description = "both tails of Pearson's statistic"
    for name in names[4:]:
        table[name].info.format = "+.2f"
        table[name].info.description = "moment less the exact one, standard errors"
    write(table, options.output, device=engine.device_name, driver=engine.driver, seed=SEED)
    return 0 if table["p"].min() > 1e-6 else 1


if __name__ == "__main__":
    sys.exit(main())
