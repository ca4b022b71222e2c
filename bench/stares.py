"""Rates of stares: pixel by pixel, by the cumulants of their sums, and by what one would write or take otherwise.

    python bench/stares.py [--device NAME] [--altaipony PYTHON] [--output bench/results/stares.ecsv]

Two hundred frames of 5 s of the paper's G2V star, 1643 pixels, with a flare of another amplitude in each stare, jitter
of light and temperature from frame to frame, an unknown level and drift of both, reduced to a few spectral weights.
AltaiPony needs NumPy < 2, so it lives in an environment of its own, whose Python is given; it works on a photometric
light curve of as many frames. Times are medians of interleaved repeats; rates of a core are by processor time, which
other work on the machine disturbs less.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.table import Table
from tables import processor, versions, write

from mauvecl import Instrument, Sky, Source, __version__, expect
from mauvecl.device.stares import Stares
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.flares.stare_scene import StaresRequest

REPEATS, FRAMES = 5, 200
STARE = Stare.of(
    5.0 * FRAMES,
    thermal=0.5,
    jitters={"light": 0.01, "temperature": 0.02},
    offsets={"light": 0.01, "temperature": 0.1},
    drifts={"light": 0.01, "temperature": 0.1},
)

#: Injections and recoveries of AltaiPony, as its own tutorial makes them.
ALTAIPONY = """
import json, sys, time, warnings, logging
warnings.simplefilter("ignore")
logging.disable(logging.CRITICAL)
import numpy as np
from importlib.metadata import version
from altaipony.flarelc import FlareLightCurve
rng = np.random.default_rng(1)
n, times = int(sys.argv[1]), int(sys.argv[2])
flux = 1000.0 + rng.standard_normal(n)
lc = FlareLightCurve(time=np.arange(n) * 5.0 / 86400.0, flux=flux, flux_err=np.ones(n))
lc["detrended_flux"], lc["detrended_flux_err"] = flux, np.ones(n)
def work(k):
    start = time.perf_counter(), time.process_time()
    lc.sample_flare_recovery(iterations=k, inject_before_detrending=False, fakefreq=1e-9, ampl=[0.005, 0.05],
                             dur=[60 / 86400, 300 / 86400], save=False, mode="uniform")
    return time.perf_counter() - start[0], time.process_time() - start[1]
work(1)
wall, own = work(times)
print(json.dumps({"version": version("altaipony"), "injections": times, "seconds": wall, "own": own}))
"""


@dataclass
class Line:
    """One row: what is done, by whom, how many stares at once, what a stare counts for."""

    work: str
    program: str
    stares: int
    run: Callable[[int], object]
    counted: str
    each: int
    seconds: list[float] = field(default_factory=list)
    own: list[float] = field(default_factory=list)

    def measure(self) -> None:
        start = time.perf_counter(), time.process_time()
        self.run(self.stares)
        self.seconds.append(time.perf_counter() - start[0])
        self.own.append(time.process_time() - start[1])


@dataclass(frozen=True)
class Last:
    """What is kept of a stare costs next to nothing."""

    adds: ClassVar[bool] = False

    def __call__(self, values: np.ndarray, first: int) -> dict[str, np.ndarray]:
        return {"last": values[..., -1, -1].T}


def payload(sums: int) -> Components:
    """Return the components of the paper's G2V star with flares of 7000 and 15 000 K and smooth weights."""
    star = Source.from_library("G2V").at_magnitude(7.4)
    mauve, sky = Instrument.load("mauvesim"), Sky.of_brightness(22.1)
    sources = (star, star.flaring(1.0, temperature=7000.0), star.flaring(1.0, temperature=15_000.0))
    quiet, *flares = (expect(s, mauve, exposure=5.0, sky=sky) for s in sources)
    along = np.linspace(0.0, np.pi, quiet.wavelength_nm.size)
    return Components.of(quiet, flares, np.array([np.cos(k * along) for k in range(sums)]))


def flares(count: int, n_flares: int, *, own: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return a flare with each spectrum, at common times or at each stare's own, and the stares' amplitudes."""
    rng = np.random.default_rng(2)
    after = np.arange(FRAMES) - (rng.integers(20, 150, count)[:, None] if own else np.array([[50]]))
    shape = np.where(after >= 0, np.exp(-np.maximum(after, 0) / 12.0), 0.0).astype(np.float32)
    return np.repeat(shape[:, :, None], n_flares, axis=2), rng.uniform(0.0, 0.2, (1, count))


def engine_lines(stares: Stares) -> list[Line]:
    """Measure the rate of the engine."""
    name, lines = f"mauvecl {__version__}", []
    three = payload(3)
    n_pixel = three.quiet.wavelength_nm.size

    def drawn(
        components: Components, method: str, scenarios: np.ndarray | None = None, *, own: bool = False
    ) -> Callable[[int], object]:
        profiles, amplitudes = flares(65_536, 2, own=own)

        def run(n: int) -> object:
            given = profiles[:n] if own else profiles
            factors = amplitudes[:, :n] if scenarios is None else scenarios * amplitudes[:, :n]
            how = {"flare": given, "amplitudes": factors, "method": method, "reduction": Last()}
            return stares.reduced(StaresRequest(components, STARE, n, 1, **how))

        return run

    lines.append(Line("by pixels, 3 sums", name, 2048, drawn(three, "pixels"), "pixels", FRAMES * n_pixel))
    scenarios = np.linspace(0.1, 2.0, 8)[:, None]
    lines.append(
        Line(
            "by pixels, 3 sums, 8 amplitudes on common draws",
            name,
            512,
            drawn(three, "pixels", scenarios),
            "pixels",
            8 * FRAMES * n_pixel,
        )
    )
    for sums in (1, 2, 3, 4, 6):
        lines.append(
            Line(
                f"by cumulants, {sums} sum{'s'[: sums > 1]}",
                name,
                65_536,
                drawn(payload(sums), "cumulants"),
                "sums",
                FRAMES * sums,
            )
        )
    own = drawn(three, "cumulants", own=True)
    lines.append(Line("by cumulants, 3 sums, each flare in its own time", name, 65_536, own, "sums", FRAMES * 3))
    return lines


def numpy_lines() -> list[Line]:
    """Measure NumPy's Generator on one thread, in blocks that stay in the cache."""
    components, name = payload(3), f"NumPy {np.__version__}"
    x, weights = components.quiet, components.weights.astype(np.float32)
    known, spectra = components.coefficients(STARE), components.mean_dn.astype(np.float32)
    slope = x.conditions["dark_slope_per_c"]
    rng = np.random.default_rng(1)

    def conditions(flare: np.ndarray) -> np.ndarray:
        moved = {of: STARE.jitters[of] * rng.standard_normal(FRAMES) for of in ("light", "temperature")}
        for unknown in STARE.unknowns:
            moved[unknown.of] = moved[unknown.of] + unknown.sd * rng.standard_normal() * unknown.curve
        c = known.copy()
        c[:, 3:] = flare
        c[:, [0, 1, 3, 4, 5]] *= 1 + moved["light"][:, None]
        c[:, 2] *= np.exp(slope * moved["temperature"])
        return c

    def injected(n: int) -> np.ndarray:
        profiles, amplitudes = flares(n, 2, own=True)
        return profiles * amplitudes[0][:, None, None]

    def by_pixels(n: int) -> np.ndarray:
        out = np.empty((n, FRAMES, 3), np.float32)
        for i, flare in enumerate(injected(n)):
            c = conditions(flare).astype(np.float32)
            light = c[:, [0, 1, 3, 4, 5]] @ spectra[[0, 1, 3, 4, 5]]
            sd = np.sqrt(x.gain_dn_per_electron.astype(np.float32) * light + x.read_noise_dn.astype(np.float32) ** 2)
            raw = light + rng.poisson(c[:, 2:3] * spectra[2]) + x.bias_dn
            raw += sd * rng.standard_normal(sd.shape, np.float32)
            out[i] = (np.rint(raw) - x.mean_raw_dn) @ weights.T
        return out

    def by_sums(n: int) -> np.ndarray:
        out = np.empty((n, FRAMES, 3), np.float32)
        for i, flare in enumerate(injected(n)):
            c = conditions(flare)
            lower = np.linalg.cholesky(components.covariance(c))
            z = rng.standard_normal((FRAMES, 3, 1))
            out[i] = components.means(c) + (lower @ z)[..., 0]
        return out

    return [
        Line("by pixels, 3 sums", name, 3, by_pixels, "pixels", FRAMES * x.wavelength_nm.size),
        Line("means and covariances of 3 sums", name, 500, by_sums, "sums", FRAMES * 3),
    ]


def altaipony(python: str) -> dict[str, float | str]:
    """Inject and recover flares with AltaiPony in its own environment."""
    child = subprocess.run([python, "-c", ALTAIPONY, str(FRAMES), "50"], capture_output=True, text=True, check=True)
    found: dict[str, float | str] = json.loads(child.stdout.splitlines()[-1])
    return found


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--altaipony", help="Python of an environment with AltaiPony and NumPy < 2")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "stares.ecsv")
    options = parser.parse_args()
    stares = Stares(options.device)
    lines = engine_lines(stares) + numpy_lines()
    for line in lines:
        line.run(min(line.stares, 64))  # builds
    for _ in range(REPEATS):
        for line in lines:
            line.measure()
    rows = []
    for line in lines:
        wall, own = (float(np.median(x)) for x in (line.seconds, line.own))
        scenarios = 8 if "8 amplitudes" in line.work else 1
        rates = (line.stares * line.each / wall, line.stares * line.each / own, line.stares * scenarios / own)
        rows.append((line.work, line.program, line.counted, *(float(f"{rate:.3g}") for rate in rates)))
    if options.altaipony:
        found = altaipony(options.altaipony)
        per_s, own = (float(found["injections"]) / float(found[key]) for key in ("seconds", "own"))
        name = f"AltaiPony {found['version']}"
        rows.append(("one light curve, injected and searched", name, "frames", per_s * FRAMES, own * FRAMES, own))
    table = Table(rows=rows, names=("work", "program", "counted", "rate", "rate_of_a_core", "stares_of_a_core"))
    descriptions = {
        "rate": "what is counted, per second: pixels or sums of frames, of each scenario",
        "rate_of_a_core": "the same per second of processor time",
        "stares_of_a_core": "stares of 200 frames, each with a flare, per second of processor time",
    }
    for column, text in descriptions.items():
        table[column].unit = "1 / s"
        table[column].info.format, table[column].info.description = ".3g", text
    about: dict[str, Any] = {"device": stares.open_device.record.label, "processor": processor()}
    write(table, options.output, **about, pixels=payload(1).quiet.wavelength_nm.size, versions=versions())


if __name__ == "__main__":
    main()
