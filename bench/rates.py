"""Measure the rates of the engine and of its peers in one run, as one table.

    python bench/rates.py [--device NAME] [--output bench/results/rates.ecsv]

Unit: pixel-realisations per second, each with Poisson dark, Gaussian photon and read noise, ADC rounding and what is
named; medians of interleaved repeats, compile time apart. Ratios are medians of those within each repeat, by the clock
and by processor time, which other programs disturb less. Peers: pip install '.[bench]'.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from peers import children
from tables import processor, versions, write

from mauvecl import Engine, Expectation, Instrument, Sky, Source, __version__, expect

REPEATS = 9


@dataclass
class Line:
    """Row of the table: operation, program, number of realisations at once, and options."""

    work: str
    program: str
    realisations: int
    run: Callable[[int], float]
    scenarios: int = 1
    wanted: str = ""
    seconds: tuple[float, ...] = ()
    processor_seconds: tuple[float, ...] = ()

    def measure(self) -> None:
        start = time.process_time()
        self.seconds = (*self.seconds, self.run(self.realisations))
        self.processor_seconds = (*self.processor_seconds, time.process_time() - start)

    def rate(self, pixels: int, *, best: bool = False) -> float:
        """Return pixel-realisations per second, counted per scenario, by the median time or the shortest."""
        seconds = min(self.seconds) if best else float(np.median(self.seconds))
        return self.realisations * pixels * self.scenarios / seconds


def ratio(a: Line, b: Line) -> str:
    """Return the ratio of the rates of `a` and `b` for equal numbers of pixel-realisations."""
    wall, processor = (
        np.median(np.divide(getattr(b, name), getattr(a, name))) for name in ("seconds", "processor_seconds")
    )
    return f"{wall:.2f} by the clock, {processor:.2f} by processor time"


def timed(work: Callable[[int], object]) -> Callable[[int], float]:
    """Return the seconds that a number of realisations takes."""

    def seconds(n: int) -> float:
        start = time.perf_counter()
        work(n)
        return time.perf_counter() - start

    return seconds


def scenes(amplitudes: tuple[float, ...], exposure: float = 50.0) -> list[Expectation]:
    """Return the expectations of the paper's G2V star, quiescent and flaring."""
    star = Source.from_library("G2V").at_magnitude(7.4)
    mauve, sky = Instrument.load("mauvesim"), Sky.of_brightness(22.1)
    sources = (star, *(star.flaring(a) for a in amplitudes))
    return [expect(s, mauve, exposure=exposure, sky=sky) for s in sources]


def engine_lines(engine: Engine) -> list[Line]:
    """Measure the rate of the engine's detections."""
    quiet, flare, *more = scenes((0.0076, *np.linspace(0.02, 0.3, 14)))
    (frame,) = scenes((), 5.0)
    rows = np.empty((150_000, frame.wavelength_nm.size), np.uint16)

    def detect(
        flares: list[Expectation], *statistics: str, nuisances: dict[str, float] | None = None
    ) -> Callable[[int], float]:
        how: dict[str, Any] = {"statistics": statistics, "nuisances": nuisances}
        return timed(lambda n: engine.detect(quiet, flares, realisations=n, seed=1, **how))

    def snr(n: int) -> object:
        return engine.snr(quiet, realisations=n, seed=1)

    three = ("chi2", "chi2_element", "matched")
    name = f"mauvecl {__version__}"
    return [
        Line("chi2, one scenario", name, 500_000, detect([], "chi2"), 1, "1.2e9"),
        Line("chi2, quiescent and flare", name, 300_000, detect([flare], "chi2"), 2),
        Line("chi2, chi2_element, matched, together", name, 300_000, detect([flare], *three), 2, "0.85 of above"),
        Line(
            "the three marginalised over dark and light",
            name,
            300_000,
            detect([flare], *three, nuisances={"dark": 0.1, "light": float("inf")}),
            2,
            "0.8 of above",
        ),
        Line("chi2, 16 scenarios on common draws", name, 300_000, detect([flare, *more], "chi2"), 16, "1e10"),
        Line("S/N per pixel and element", name, 200_000, timed(snr), 1, "1.2e9"),
        Line(
            "raw 16-bit frames into host memory",
            name,
            len(rows),
            timed(lambda n: engine.realise(frame, count=n, seed=1, out=rows[:n])),
            1,
            "6e8",
        ),
        Line("a copy of as many bytes", f"NumPy {np.__version__}", len(rows), timed(lambda n: rows[:n].copy())),
    ]  # fmt: skip


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "rates.ecsv")
    options = parser.parse_args()
    engine = Engine(options.device)
    (quiet,) = scenes(())
    pixels = quiet.wavelength_nm.size
    lines = engine_lines(engine)
    for line in lines:
        line.run(64)  # builds
    others = children(quiet)
    lines += [Line("chi2, one scenario", c.name, c.realisations, lambda n, c=c: c.seconds()) for c in others]
    for _ in range(REPEATS):
        time.sleep(0.5)  # until the peers' threads have gone to sleep
        for line in lines:
            line.measure()
    for child in others:
        child.close()
    first = lines[0].rate(pixels)
    table = Table(
        {
            "work": [line.work for line in lines],
            "program": [line.program for line in lines],
            "rate": [float(f"{line.rate(pixels):.3g}") for line in lines],
            "wanted": [line.wanted for line in lines],
            "slower": [
                f"{first / line.rate(pixels):.0f}" if line.work == lines[0].work and line is not lines[0] else ""
                for line in lines
            ],
            "best": [float(f"{line.rate(pixels, best=True):.3g}") for line in lines],
        }
    )
    for name, which in (("rate", "median"), ("best", "shortest")):
        table[name].unit = "1 / s"
        table[name].info.format = ".2e"
        table[
            name
        ].info.description = f"pixel-realisations per second, counted per scenario, by the {which} of {REPEATS} times"
    table["slower"].info.description = "how many times slower than the engine's chi2 of one scenario"
    about: dict[str, Any] = {"device": engine.device_name, "driver": engine.driver, "processor": processor()}
    write(table, options.output, **about, pixels=pixels, versions=versions())
    one, three, marginal = lines[1:4]
    print(f"three statistics at the rate of chi2 alone, quiescent and flare each: {ratio(three, one)}")
    print(f"the three marginalised at the rate of the plain three: {ratio(marginal, three)}")


if __name__ == "__main__":
    main()
