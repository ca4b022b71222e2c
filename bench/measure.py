"""Fits per second, drawn from pixels, next to iminuit and scipy's least_squares on the same pixels.

    python bench/measure.py [--count 200000] [--device NAME] [--output bench/results/measure.ecsv]

M3V at V = 9, a flare of 50 % at 9500 K, 50 s. "Estimates" have standard errors, "intervals" two profile intervals of
every quantity and goodness of fit. The other programs fit pixels that are drawn already. Wall time of all processors.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import scipy
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import BalmerFlare, Engine, FlareModel, Instrument, Source, expect, fit
from mauvecl.results.measurements.fit import fit_sums
from mauvecl.results.measurements.reduction import Reduction, drawn_sums

#: Fits of the slower ways.
FRAMES, SLOW = 10_000, 100
BLOCK = 16_384


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200_000, help="fits of the fastest way")
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "measure.ecsv")
    options = parser.parse_args()
    mauve, star, engine = Instrument.load("mauve"), Source.from_library("M3V").at_magnitude(9), Engine(options.device)
    quiet = expect(star, mauve, exposure=50.0)
    rows = []
    for name, jump in (("blackbody (2)", 1.0), ("with a Balmer jump (3)", 2.0)):
        lit = expect(star.flaring(0.5, spectrum=BalmerFlare(9500.0, jump)), mauve, exposure=50.0)
        model = FlareModel.of(star, mauve, quiet, jump=jump > 1)
        reduction = Reduction.of(model, quiet, lit.net_source_dn - quiet.net_source_dn)

        def sums(count: int, lit=lit, reduction=reduction, model=model) -> None:
            def drawn(start: int) -> np.ndarray:
                some = {"start": start, "count": min(BLOCK, count - start), "seed": 1}
                return engine.statistic_values(quiet, [lit], statistics=reduction.statistics, **some)

            # The device draws the next block while this one is fitted.
            with ThreadPoolExecutor(1) as ahead:
                for values in ahead.map(drawn, range(0, count, BLOCK)):
                    fit_sums(drawn_sums(values, reduction), model, reduction)

        def frames(count: int, lit=lit, model=model) -> None:
            for start in range(0, count, BLOCK):
                raw = engine.realise(lit, start=start, count=min(BLOCK, count - start), seed=1)
                fit(raw, quiet, model)

        raw = engine.realise(lit, count=SLOW, seed=1)
        rows.append((name, "mauvecl, estimates", options.count, timed(sums, options.count)))
        rows.append((name, "mauvecl, intervals", FRAMES, timed(frames, FRAMES)))
        for program, other in peers(raw, quiet, model).items():
            rows.append((name, program, SLOW, timed(other, SLOW)))
    table = Table(rows=rows, names=("model", "program", "fits", "rate"))
    table["rate"].unit, table["rate"].format, table["rate"].description = "1 / s", ".3g", "fits in a second"
    write(table, options.output, processor=processor(), device=engine.device_name, versions=versions())


def timed(work: Callable[[int], None], count: int) -> float:
    """Return fits per second, kernels compiled before: the best of three runs, for other programs use the machine."""
    work(min(count, 50))
    best = np.inf
    for _ in range(3):
        begun = time.perf_counter()
        work(count)
        best = min(best, time.perf_counter() - begun)
    return count / best


def peers(raw: np.ndarray, quiet, model: FlareModel) -> dict[str, Callable[[int], None]]:
    """Return what fits the same pixels one by one: thousands of K, amplitude, and recombination of the same size."""
    excess, scale = (
        raw - quiet.recorded_dn,
        0.01 / max(model.fixed.max(), 1e-300) * model.hot.max() if len(model.fixed) else 1.0,
    )

    def mean(theta: np.ndarray) -> np.ndarray:
        linear = np.concatenate([theta[1:2], scale * theta[2:]])
        return linear[0] * model.hot_spline(np.log(1e3 * np.clip(theta[0], 3.0, 200.0))) + linear[1:] @ model.fixed

    def residual(theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        counts = mean(theta)
        return (x - counts) / np.sqrt(quiet.variance_dn2 + quiet.gain_dn_per_electron * np.maximum(counts, 0.0))

    def cost_of(x: np.ndarray) -> Callable[[np.ndarray], float]:
        return lambda theta: float(np.sum(residual(theta, x) ** 2))

    start = np.array([10.0, 0.4, 1.0])[: 1 + len(model.linear)]

    def least_squares(count: int) -> None:
        for x in excess[:count]:
            scipy.optimize.least_squares(residual, start, args=(x,), x_scale=start)

    found: dict[str, Callable[[int], None]] = {f"scipy {scipy.__version__} least_squares": least_squares}
    try:
        import iminuit
    except ImportError:
        return found

    def migrad(count: int) -> None:
        for x in excess[:count]:
            minuit = iminuit.Minuit(cost_of(x), start)
            minuit.errordef = 1.0
            minuit.migrad()

    return found | {f"iminuit {importlib.metadata.version('iminuit')} migrad": migrad}


if __name__ == "__main__":
    main()
