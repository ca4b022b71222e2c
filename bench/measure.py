"""Fits per second, drawn from pixels, next to iminuit and scipy's least_squares on the same pixels.

    python bench/measure.py [--count 200000] [--device NAME] [--output bench/results/measure.ecsv]

M3V at V = 9, a flare of 50 % at 9500 K, 50 s. "Estimates" have standard errors, "intervals" two profile intervals of
every quantity and goodness of fit; "at a bound" those of flares without a jump, whose intervals end at the bound.
The other programs fit pixels that are drawn already; with two temperatures they start at the truth. Wall time of all
processors, and time of processors, which other work on the machine changes less: medians of five rounds in which the
programs take turns. Ratios are of the times of processors. Memory: growth of the peak from a tenth of the fits to all.
"""

from __future__ import annotations

import os

# As the command line does: multiplications of small matrices lose by several threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import importlib.metadata
import resource
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import scipy
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import (
    BalmerFlare,
    Engine,
    FlareModel,
    Instrument,
    Source,
    TwoBlackbodies,
    expect,
    fit,
    fit_two_temperatures,
)
from mauvecl.detection.statistics import Linear
from mauvecl.fits.flare_model import ReducedSums, derived_values
from mauvecl.fits.profile import Profile, covariance
from mauvecl.fits.spectrum import BATCH

#: Fits of the slower ways, and rounds.
FRAMES, SLOW, ROUNDS = 10_000, 100, 5
BLOCK, PART = 16_384, 2_500


def estimate(values: np.ndarray, model: FlareModel, reduction: ReducedSums) -> None:
    """Fit the sums of drawn exposures, without intervals."""
    sums = np.ascontiguousarray(values[-len(reduction.weights) :].T, np.float64)
    for start in range(0, len(sums), BATCH):
        profile = Profile(reduction, sums[start : start + BATCH])
        best = profile.bounded_best()
        derived_values(model, best.log_k, best.linear, np.ones(1))
        covariance(model, reduction, best, profile.factor(best))


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200_000, help="fits of the fastest way")
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "measure.ecsv")
    options = parser.parse_args()
    mauve, star = Instrument.load("mauvesim"), Source.from_library("M3V").at_magnitude(9)
    engine = Engine(options.device)
    quiet = expect(star, mauve, exposure=50.0)
    rows, growth = [], 0.0
    for name, true_jump, jump in (
        ("blackbody (2)", 1.0, False), ("with a Balmer jump (3)", 2.0, True), ("the same, at a bound", 1.0, True)
    ):  # fmt: skip
        lit = expect(star.flaring(0.5, spectrum=BalmerFlare(9500.0, true_jump)), mauve, exposure=50.0)
        model = FlareModel.of(star, mauve, quiet, jump=jump)
        reduction = ReducedSums.of(model, quiet, lit.net_source_dn - quiet.net_source_dn)
        # The sums as statistics, which a device draws by pixel.
        asked = tuple(Linear(f"sum {k}", weights) for k, weights in enumerate(reduction.weights))

        def sums(count: int, lit=lit, reduction=reduction, model=model, asked=asked) -> None:
            def drawn(start: int) -> np.ndarray:
                some = {"start": start, "count": min(BLOCK, count - start), "seed": 1}
                return engine.statistic_values(quiet, [lit], statistics=asked, **some)

            # The device draws the next block while this one is fitted.
            with ThreadPoolExecutor(1) as ahead:
                for values in ahead.map(drawn, range(0, count, BLOCK)):
                    estimate(values, model, reduction)

        def frames(count: int, lit=lit, model=model) -> None:
            def drawn(start: int) -> np.ndarray:
                return engine.realise(lit, start=start, count=min(PART, count - start), seed=1)

            with ThreadPoolExecutor(1) as ahead:
                for raw in ahead.map(drawn, range(0, count, PART)):
                    fit(raw, quiet, model)

        raw = engine.realise(lit, count=SLOW, seed=1)
        ways = {"mauvecl, estimates": (sums, options.count), "mauvecl, intervals": (frames, FRAMES)}
        ways |= {program: (other, SLOW) for program, other in peers(raw, quiet, model).items()}
        if not rows:
            growth = growth_mb(sums, options.count)
        rows += compared(name, ways)
    light = TwoBlackbodies(9000.0, 30_000.0, 0.05)
    raw = engine.realise(expect(star.flaring(2.0, spectrum=light), mauve, exposure=50.0), count=SLOW, seed=1)
    single = FlareModel.of(star, mauve, quiet)

    def two(count: int) -> None:
        fit_two_temperatures(raw[:count], quiet, single)

    ways = {"mauvecl, intervals": (two, SLOW)}
    ways |= {program: (other, SLOW) for program, other in two_temperature_peers(raw, quiet, single).items()}
    rows += compared("two temperatures (4)", ways)
    table = Table(rows=rows, names=("model", "program", "fits", "rate", "cpu_rate", "ratio"))
    table["cpu_rate"].unit, table["cpu_rate"].format = "1 / s", ".3g"
    table["cpu_rate"].description = "fits in a second of one processor"
    table["rate"].unit, table["rate"].format, table["rate"].description = "1 / s", ".3g", "fits in a second"
    table["ratio"].format, table["ratio"].description = (
        ".3g",
        "of cpu_rate, over least_squares in the same round",
    )
    write(
        table, options.output, memory_growth_mb=round(growth, 1), processor=processor(), device=engine.device_name,
        versions=versions(),
    )  # fmt: skip


def compared(model: str, ways: dict[str, tuple[Callable[[int], None], int]]) -> list[tuple]:
    """Return a row for each program that fits a model."""
    rates = timed(ways)
    peer = next(rate[1] for program, rate in rates.items() if "least_squares" in program)
    return [(model, program, ways[program][1], *np.median(rate, axis=1).tolist(), float(np.median(rate[1] / peer)))
            for program, rate in rates.items()]  # fmt: skip


def timed(ways: dict[str, tuple[Callable[[int], None], int]]) -> dict[str, np.ndarray]:
    """Return fits per second, and per second of a processor, (2, n_round); kernels are compiled before."""
    rates = {name: np.empty((2, ROUNDS)) for name in ways}
    for work, count in ways.values():
        work(min(count, 50))
    for k in range(ROUNDS):
        for name, (work, count) in ways.items():
            begun = time.perf_counter(), time.process_time()
            work(count)
            rates[name][:, k] = count / (time.perf_counter() - begun[0]), count / (time.process_time() - begun[1])
    return rates


def growth_mb(work: Callable[[int], None], count: int) -> float:
    """Return by how much the peak of the memory grows from a tenth of the fits to all of them, MB."""
    peaks = []
    for n in (count // 10, count):
        work(n)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return peaks[1] - peaks[0]


def peers(raw: np.ndarray, quiet, model: FlareModel) -> dict[str, Callable[[int], None]]:
    """Return what fits the same pixels one by one: thousands of K, amplitude, and recombination of the same size."""
    excess, scale = (
        raw - quiet.recorded_dn,
        0.01 / max(model.fixed.max(), 1e-300) * model.hot.max() if len(model.fixed) else 1.0,
    )

    def mean(theta: np.ndarray) -> np.ndarray:
        linear = np.concatenate([theta[1:2], scale * theta[2:]])
        return linear[0] * model.hot_spline(np.log(1e3 * np.clip(theta[0], 3.0, 200.0))) + linear[1:] @ model.fixed

    return minimisers(mean, excess, quiet, np.array([10.0, 0.4, 1.0])[: 1 + len(model.linear)])


def two_temperature_peers(raw: np.ndarray, quiet, model: FlareModel) -> dict[str, Callable[[int], None]]:
    """Return what fits the same pixels one by one: both temperatures in thousands of K, and both amplitudes."""

    def mean(theta: np.ndarray) -> np.ndarray:
        bodies = model.hot_spline(np.log(1e3 * np.clip(theta[:2], 3.0, 200.0)))
        return np.asarray(theta[2:] @ bodies)

    return minimisers(mean, raw - quiet.recorded_dn, quiet, np.array([9.0, 30.0, 1.5, 0.5]))


def minimisers(
    mean: Callable[[np.ndarray], np.ndarray], excess: np.ndarray, quiet, start: np.ndarray
) -> dict[str, Callable[[int], None]]:
    """Return the programs that minimise chi-squared over parameters of the mean."""

    def residual(theta: np.ndarray, x: np.ndarray) -> np.ndarray:
        counts = mean(theta)
        return (x - counts) / np.sqrt(quiet.variance_dn2 + quiet.gain_dn_per_electron * np.maximum(counts, 0.0))

    def cost_of(x: np.ndarray) -> Callable[[np.ndarray], float]:
        return lambda theta: float(np.sum(residual(theta, x) ** 2))

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
