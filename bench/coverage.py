"""Coverage of the intervals of measured flares, over S/N, temperature, model and what is unknown.

    python bench/coverage.py [--fits 4000] [--device NAME] [--output bench/results/coverage.ecsv]

M3V at V = 9, 50 s; exposures are drawn pixel by pixel. S/N is what is left of the flare when the unknowns are
marginalised over. "free": dark and star with no prior, sky with one of 10 %, drawn as dark 0.5 deg C, light 1 %, sky
10 %. The column "curvature" states how far the quantity is from linear in what is uncertain: see `curvature`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import BalmerFlare, Engine, FlareModel, Instrument, Nuisances, Source, expect, fit, forecast
from mauvecl.detection.distributions import clopper_pearson
from mauvecl.fits.flare_model import ReducedSums, derived_values

SNRS, TEMPERATURES_K = (3.0, 5.0, 10.0, 30.0, 100.0, 300.0), (6_000.0, 10_000.0, 20_000.0, 30_000.0)
QUANTITIES = ("temperature", "amplitude", "flux 200-320 nm", "flux bolometric", "jump")
#: Standard deviations with which unknowns are drawn, by name.
DRAWN = {"dark": 0.5, "star": 0.01, "sky": 0.1}


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=10_000)
    parser.add_argument("--device")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "coverage.ecsv")
    options = parser.parse_args()
    mauve, star = Instrument.load("mauvesim"), Source.from_library("M3V").at_magnitude(9)
    engine = Engine(options.device)
    quiet, rng = expect(star, mauve, exposure=50.0), np.random.default_rng(28)
    free = Nuisances.of(quiet, {"dark": np.inf, "star": np.inf, "sky": 0.1}, own={"star": quiet.net_source_dn})
    rows = []
    for jump in (1.0, 2.0):
        model = FlareModel.of(star, mauve, quiet, jump=jump > 1)
        for unknown in (None, free):
            for kelvin in TEMPERATURES_K:
                for snr in SNRS:
                    amplitude = 0.5
                    for _ in range(8):
                        linear = model.amplitudes(kelvin, amplitude, jump=jump)
                        amplitude *= snr / forecast(quiet, model, kelvin, linear, unknown).snr
                    lit = expect(star.flaring(amplitude, spectrum=BalmerFlare(kelvin, jump)), mauve, exposure=50.0)
                    raw = engine.realise(lit, count=options.fits, seed=len(rows)).astype(np.float64)
                    if unknown is not None:
                        sizes = np.array([DRAWN[name] for name in unknown.names])
                        raw += (rng.standard_normal((options.fits, sizes.size)) * sizes) @ unknown.spectra
                    found = fit(raw, quiet, model, unknown)
                    linear = model.amplitudes(kelvin, amplitude, jump=jump)
                    truth = model.values(kelvin, linear)
                    plain = forecast(quiet, model, kelvin, linear).snr
                    bend = dict(zip(model.names, curvature(quiet, model, kelvin, linear, unknown), strict=True))
                    where = jump, "known" if unknown is None else "free", kelvin, snr, plain
                    for name in QUANTITIES:
                        if name in found.names:
                            rows.append((*where, name, bend[name], *covered(found, name, truth)))
    names = (
        "jump",
        "unknowns",
        "temperature",
        "snr",
        "snr_known",
        "quantity",
        "curvature",
        "coverage_68",
        "coverage_95",
        "low_95",
        "high_95",
        "one_sided",
    )
    table = Table(rows=rows, names=names)
    for name in names[6:]:
        table[name].format = ".4f"
    write(
        table, options.output, fits=options.fits, processor=processor(), device=engine.device_name, versions=versions()
    )


def curvature(quiet, model: FlareModel, kelvin: float, linear: np.ndarray, unknown) -> np.ndarray:
    """Return how far quantities are from linear within one standard error: second over first order of their change.

    Along the amplitudes that fit best at temperatures one standard error below and above the true one.
    """
    reduction = ReducedSums.of(model, quiet, model.counts(kelvin, linear), unknown)
    error = forecast(quiet, model, kelvin, linear, unknown)
    log_k = np.log(kelvin)
    step = min(error.errors[0] / kelvin, np.log(kelvin / 3000.0), np.log(200_000.0 / kelvin))
    signal = linear[0] * reduction.spline(log_k) + linear[1:] @ reduction.fixed
    values = []
    for there in (log_k - step, log_k, log_k + step):
        components = np.vstack([reduction.spline(there), reduction.fixed])
        best = np.linalg.lstsq(components.T, signal, rcond=None)[0]
        values.append(derived_values(model, np.array([there]), best[None], np.ones(1))[0])
    second = np.abs(values[0] + values[2] - 2 * values[1]) / 2
    return second / error.errors


def covered(found, name: str, truth: dict[str, float]) -> tuple[float, ...]:
    """Return coverage of both intervals, the second's 95 % interval, and the share of one-sided ones."""
    column = found.column(name)
    inside = (found.low[:, :, column] <= truth[name]) & (truth[name] <= found.high[:, :, column])
    wide = clopper_pearson(int(inside[1].sum()), inside.shape[1])
    return float(inside[0].mean()), wide.value, wide.low, wide.high, float(found.one_sided[1, :, column].mean())


if __name__ == "__main__":
    main()
