"""Small files that the questions of `test_golden.py` ask about, copied or drawn with a fixed generator."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from mauvecl import Instrument, Sky, Source, expect

DATA = Path(__file__).parent / "data"
Float = NDArray[np.float64]

#: Injected flares of light curves: peak, s, half-width, s, and amplitude. One of unit half-width and amplitude has an
#: equivalent duration of 1.827 s.
FLARES = {
    "rotating.csv": ((216_000.0, 2400.0, 0.02),),
    "flares.csv": ((1000.0, 60.0, 0.1), (2200.0, 100.0, 0.03)),
    "counts.csv": ((1200.0, 60.0, 8.0),),
}
#: What the instrument of the calibration has in place of nominal values.
TRUE = {"conversion_uv_per_electron": 22.0, "dark_slope_per_c": 0.071, "light_loss": 0.3}
STANDARDS = """calibrate.observations = [
    { frames = "a0v.fits", mapping = "raw.toml", library = "A0V", magnitude = 5.0 },
    { frames = "g2v.fits", mapping = "raw.toml", library = "G2V", magnitude = 4.0 },
    { frames = "dark.fits", mapping = "raw.toml" },
]
"""
RAW = """hdu = "FRAMES"
time = "TIME"
time_unit = "s"
flux = "RAW"
flux_unit = "DN"
wavelength = "WAVELENGTH"
wavelength_unit = "nm"
temperature = "TEMPERATURE"
temperature_unit = "deg_C"
exposure_s = 5.0
"""


def template(x: Float) -> Float:
    """Return the flare template of Davenport et al. (2014), written out independently of the package."""
    rise = np.polyval([-1.125, -2.246, -0.175, 1.941, 1.0], x)
    decay = 0.6890 * np.exp(-1.600 * np.maximum(x, 0)) + 0.3030 * np.exp(-0.2783 * np.maximum(x, 0))
    return np.where(x > 0, decay, np.where(x > -1, rise, 0.0))


def _flares(name: str, time: Float) -> Float:
    return sum((a * template((time - peak) / width) for peak, width, a in FLARES[name]), np.zeros_like(time))


def _rows(path: Path, **columns: Float) -> None:
    """Write a table of fewer digits than computed numbers have, which is the same on every processor."""
    Table(columns).write(path, format="ascii.csv", formats=dict.fromkeys(columns, "%.9f"))


def rotating(path: Path, seed: int) -> None:
    """Write four days of a spotted star of a period of 12 h, in frames of half an hour, with one flare.

    Its light is that of oscillators at the period and half of it, which chance excites and time damps.
    """
    time, error, rng = np.arange(200) * 1800.0, 5e-4, np.random.Generator(np.random.PCG64(seed))
    light = np.zeros(time.size)
    for period_d, sd in ((0.5, 0.01), (0.25, 0.004)):
        turn = np.exp(1800 / 86_400 * (2j * np.pi / period_d - 1 / 10.0))
        kicks = sd * rng.standard_normal((time.size, 2)) @ [1, 1j]
        kicks[1:] *= np.sqrt(1 - abs(turn) ** 2)
        state = 0j
        for k, kick in enumerate(kicks):
            state = turn * state + kick
            light[k] += state.real
    flux = 1 + light + _flares(path.name, time) + error * rng.standard_normal(time.size)
    _rows(path, time=time / 86_400, flux=flux, error=np.full(time.size, error))


def flares(path: Path, seed: int) -> None:
    """Write 50 minutes of a constant star with two flares."""
    time, error = np.arange(150) * 20.0, 0.002
    noise = error * np.random.Generator(np.random.PCG64(seed)).standard_normal(time.size)
    _rows(path, time=time / 86_400, flux=1 + _flares(path.name, time) + noise, error=np.full(time.size, error))


def counts(path: Path, seed: int) -> None:
    """Write frames of six counts on average, and a flare."""
    time = np.arange(300) * 10.0
    drawn = np.random.Generator(np.random.PCG64(seed)).poisson(6 * (1 + _flares(path.name, time)))
    Table({"time": time, "counts": drawn}).write(path, format="ascii.csv")


def frames(path: Path, seed: int, star: str, magnitude: float, temperatures: tuple[float, ...]) -> None:
    """Write 25 raw frames at each temperature as an instrument records them that is not the nominal one."""
    rng, raw, sky = np.random.Generator(np.random.PCG64(seed)), [], Sky.of_brightness(22.1) if star else Sky.none()
    source = Source.from_library(star or "G2V").at_magnitude(magnitude)
    for celsius in temperatures:
        true = Instrument.load("mauve").with_(**TRUE, temperature_c=celsius)
        x = expect(source, true, exposure=5.0, sky=sky)
        light, shape = x.source_electrons + x.sky_electrons, (25, x.wavelength_nm.size)
        photons = x.gain_dn_per_electron * (light + np.sqrt(light) * rng.standard_normal(shape))
        dark = x.dark_step_dn * rng.poisson(x.dark_dn / x.dark_step_dn, shape)
        raw.append(np.rint(photons + dark + x.bias_dn + x.read_noise_dn * rng.standard_normal(shape)))
    counts = np.concatenate(raw).astype(np.uint16)
    times = Table({"TIME": 5.0 * np.arange(len(counts)), "TEMPERATURE": np.repeat(temperatures, 25)})
    images = [fits.ImageHDU(counts, name="RAW"), fits.ImageHDU(x.wavelength_nm, name="WAVELENGTH")]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(times, name="FRAMES"), *images]).writeto(path)


def text(path: Path, content: str) -> None:
    path.write_text(content, encoding="utf-8")


def copy(path: Path, source: str) -> None:
    shutil.copy(DATA / source, path)


INPUTS: dict[str, Callable[[Path], None]] = {
    "targets.csv": partial(text, content="name\nGJ 205\neps Eri\n"),
    "near.csv": partial(text, content="name,separation,magnitude,spectral_type\nB,8,10,M4V\nC,30,12,K4V\nD,70,6,A0V\n"),
    "vb8.fits": partial(copy, source="spectra/vb8_stiswfcnic_004.fits"),
    "flare.dat": partial(copy, source="flares/ADLeo_1497s.dat"),
    "quiet.dat": partial(copy, source="flares/adleo_quiescent2.dat"),
    "curve.toml": partial(text, content='time = "time"\ntime_unit = "d"\nflux = "flux"\nerror = "error"\n'),
    "ct.toml": partial(text, content='time = "time"\ntime_unit = "s"\nflux = "counts"\nflux_unit = "ct"\n'),
    "rotating.csv": partial(rotating, seed=1),
    "flares.csv": partial(flares, seed=2),
    "counts.csv": partial(counts, seed=3),
    "raw.toml": partial(text, content=RAW),
    "standards.toml": partial(text, content=STANDARDS),
    "a0v.fits": partial(frames, seed=4, star="A0V", magnitude=5.0, temperatures=(17.0,)),
    "g2v.fits": partial(frames, seed=5, star="G2V", magnitude=4.0, temperatures=(18.0,)),
    "dark.fits": partial(frames, seed=6, star="", magnitude=35.0, temperatures=(15.0, 17.0, 19.0)),
}
#: Files that others name.
NAMED = {"standards.toml": ("raw.toml", "a0v.fits", "g2v.fits", "dark.fits")}


def write_inputs(folder: Path, question: str) -> None:
    """Write the files that a question names."""
    named = [name for name in INPUTS if name in question]
    for name in {*named, *(other for one in named for other in NAMED.get(one, ()))}:
        INPUTS[name](folder / name)
