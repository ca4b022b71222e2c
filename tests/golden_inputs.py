"""Small files that the questions of `test_golden.py` ask about, copied or drawn with a fixed generator."""

import shutil
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from mauvecl import Instrument, Sky, Source, expect

DATA = Path(__file__).parent / "data"
#: Files of the golden questions, of which the README there says how they were made.
INPUTS = DATA / "golden" / "inputs"
#: Files of the corpora that questions name otherwise.
COPIED = {
    "vb8.fits": "spectra/vb8_stiswfcnic_004.fits", "flare.dat": "flares/ADLeo_1497s.dat",
    "quiet.dat": "flares/adleo_quiescent2.dat",
}  # fmt: skip
#: Seed, star, magnitude and temperatures of the frames of standard stars.
FRAMES = {
    "a0v.fits": (4, "A0V", 5.0, (17.0,)), "g2v.fits": (5, "G2V", 4.0, (18.0,)),
    "dark.fits": (6, "", 35.0, (15.0, 17.0, 19.0)),
}  # fmt: skip
#: What the instrument of the calibration has in place of nominal values.
TRUE = {"conversion_uv_per_electron": 22.0, "dark_slope_per_c": 0.071, "light_loss": 0.3}


def frames(path: Path, seed: int, star: str, magnitude: float, temperatures: tuple[float, ...]) -> None:
    """Write 25 raw frames at each temperature as an instrument records them that is not the nominal one."""
    rng, raw, sky = np.random.Generator(np.random.PCG64(seed)), [], Sky.of_brightness(22.1) if star else Sky.none()
    source = Source.from_library(star or "G2V").at_magnitude(magnitude)
    for celsius in temperatures:
        true = Instrument.load("mauvesim").with_(**TRUE, temperature_c=celsius)
        x = expect(source, true, exposure=5.0, sky=sky)
        light, shape = x.source_electrons + x.sky_electrons, (25, x.wavelength_nm.size)
        photons = x.gain_dn_per_electron * (light + np.sqrt(light) * rng.standard_normal(shape))
        dark = x.dark_step_dn * rng.poisson(x.dark_dn / x.dark_step_dn, shape)
        raw.append(np.rint(photons + dark + x.bias_dn + x.read_noise_dn * rng.standard_normal(shape)))
    counts = np.concatenate(raw).astype(np.uint16)
    times = Table({"TIME": 5.0 * np.arange(len(counts)), "TEMPERATURE": np.repeat(temperatures, 25)})
    images = [fits.ImageHDU(counts, name="RAW"), fits.ImageHDU(x.wavelength_nm, name="WAVELENGTH")]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(times, name="FRAMES"), *images]).writeto(path)


def write_inputs(folder: Path, question: str) -> None:
    """Write the files that a question names, and those that these name."""
    if "standards.toml" in question:
        question += " raw.toml " + " ".join(FRAMES)
    for name, path in ({path.name: path for path in INPUTS.iterdir()} | COPIED).items():
        if name in question:
            shutil.copy(DATA / path, folder / name)
    for name, drawn in FRAMES.items():
        if name in question:
            frames(folder / name, *drawn)
