"""Rate of chi-squared under noise: the engine beside a plain NumPy script, in one run.

    python bench/chi2.py

Unit: pixel-realisations per second, each with Poisson dark, Gaussian photon and read noise, ADC rounding and the
statistics named. Medians of five repeats; compile time apart.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from mauvecl import Engine, Expectation, Instrument, Sky, Source, expect


def median_rate(work: Callable[[int], object], realisations: int, pixels: int) -> float:
    """Pixel-realisations per second."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        work(realisations)
        seconds.append(time.perf_counter() - start)
    return realisations * pixels / float(np.median(seconds))


def numpy_chi2(x: Expectation, realisations: int) -> np.ndarray:
    """The same model by a careful NumPy script: float32 normals, blocks that stay in the cache."""
    generator = np.random.default_rng(1)
    light = x.n_frames * x.gain_dn_per_electron**2 * (x.source_electrons + x.sky_electrons)
    sd = np.sqrt(light + x.n_frames * x.read_noise_dn**2 + (x.n_frames - 1) / 12).astype(np.float32)
    mean = (x.n_frames * x.mean_raw_dn).astype(np.float32)
    level = mean - x.n_frames * x.dark_dn.astype(np.float32)
    weight = (1 / x.variance_dn2).astype(np.float32)
    out = np.empty(realisations, np.float32)
    for start in range(0, realisations, 64):
        n = min(64, realisations - start)
        raw = generator.standard_normal((n, mean.size), dtype=np.float32) * sd + level
        raw += generator.poisson(x.n_frames * x.dark_dn, (n, mean.size))
        out[start : start + n] = (np.rint(raw) - mean) ** 2 @ weight
    return out


def main() -> None:
    """Print the table."""
    star = Source.from_library("G2V").at_magnitude(7.4)
    mauve, sky = Instrument.load("mauve"), Sky.of_brightness(22.1)
    amplitudes = (0.0076, 0.02, 0.081, 0.24)
    quiet, *flares = (expect(s, mauve, exposure=50, sky=sky) for s in (star, *(star.flaring(a) for a in amplitudes)))
    pixels = quiet.wavelength_nm.size
    engine = Engine()
    print(f"{engine.device_name}, driver {engine.driver}")
    peer = median_rate(lambda n: numpy_chi2(quiet, n), 2_000, pixels)
    print(f"{'NumPy Generator, chi2, one scenario':62s} {peer:10.3g} /s")
    for title, few, statistics in (
        ("chi2, quiescent and one flare", flares[:1], ("chi2",)),
        ("chi2, chi2_element, matched, quiescent and one flare", flares[:1], ("chi2", "chi2_element", "matched")),
        ("chi2, chi2_element, matched, quiescent and four flares", flares, ("chi2", "chi2_element", "matched")),
    ):

        def work(n: int, few: list[Expectation] = few, statistics: tuple[str, ...] = statistics) -> object:
            return engine.detect(quiet, few, realisations=n, seed=1, statistics=statistics)

        work(100)  # builds the kernels
        rate = median_rate(work, 200_000, pixels)
        scenarios = 1 + len(few)
        print(f"{title:62s} {rate:10.3g} /s  {rate / peer:6.1f} x NumPy, {rate * scenarios:.3g} /s per scenario")


if __name__ == "__main__":
    main()
