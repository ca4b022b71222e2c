"""Frames with a known truth as a FITS table, and the files of the page about mappings; others are in the corpus."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from numpy.typing import NDArray

from mauvecl.observations.mapping import FrameMapping

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Truth:
    """Quantities of spectra as a file holds them: times in days after MJD 61000, wavelengths in Angstrom."""

    time_s: Float
    wavelength_nm: Float
    flux: Float  # adu/s
    error: Float
    quality: NDArray[np.int64]
    exposure_s: Float
    temperature_c: Float

    @classmethod
    def of(cls, seed: int = 29, n: int = 40, n_pixel: int = 6) -> Truth:
        """Draw spectra with noise and one flagged frame."""
        rng = np.random.default_rng(seed)
        flux = rng.normal(1000.0, 5.0, (n, n_pixel)) * np.linspace(0.5, 1.5, n_pixel)
        return cls(20.0 * np.arange(n) + 10.0, np.linspace(250.5, 650.5, n_pixel), flux, 0.01 * flux,
                   (np.arange(n) == 7).astype(np.int64), np.full(n, 18.0), 21.0 + 0.1 * np.arange(n))  # fmt: skip

    @property
    def time_d(self) -> Float:
        """Times in days."""
        return self.time_s / 86_400


COMMON: dict[str, Any] = {"flux": "FLUX", "error": "ERR", "quality": "QUAL", "exposure": "EXPT", "temperature": "TEMP",
                          "time": "T", "epoch": "2025-11-21", "scale": "tt", "position": "geocenter"}  # fmt: skip


def scalars(truth: Truth) -> dict[str, Any]:
    """Return the quantities of frames."""
    return {"T": truth.time_d, "QUAL": truth.quality, "EXPT": truth.exposure_s, "TEMP": truth.temperature_c}


def with_units(table: Table) -> Table:
    """Give the columns of a table their units."""
    for name, unit in {"T": "d", "EXPT": "s", "TEMP": "deg_C", "FLUX": "adu/s", "ERR": "adu/s", "W": "AA"}.items():
        if name in table.colnames:
            table[name].unit = unit
    return table


def row_per_frame(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write a FITS table with a spectrum in each row."""
    waves = np.tile(truth.wavelength_nm * 10, (truth.time_s.size, 1))
    table = with_units(Table(scalars(truth) | {"FLUX": truth.flux, "ERR": truth.error, "W": waves}))
    table.write(folder / "rows.fits")
    return folder / "rows.fits", FrameMapping(**COMMON, wavelength="W")


def documented_files(folder: Path) -> None:
    """Write the files of the page about mappings: the same 30 frames of four pixels in every layout, without noise."""
    time, nm = np.arange(30) * 5.0 + 2.5, np.array([300.25, 400.25, 500.25, 600.25])
    counts = 100.0 + np.arange(120.0).reshape(30, 4)
    sigma, mjd = 0.1 * counts, 61_100 + time / 86_400
    table = Table({"TIME": time, "COUNTS": counts, "SIGMA": sigma, "FLAG": 0 * time, "EXPTIME": np.full(30, 5.0),
                   "CCDTEMP": np.full(30, 21.0), "LAMBDA": np.tile(nm, (30, 1))})  # fmt: skip
    units = {"TIME": "s", "COUNTS": "adu/s", "SIGMA": "adu/s", "EXPTIME": "s", "CCDTEMP": "deg_C", "LAMBDA": "nm"}
    for name, unit in units.items():
        table[name].unit = unit
    table.write(folder / "night.fits")
    images = [fits.ImageHDU(counts, name="COUNTS"), fits.ImageHDU(sigma, name="SIGMA")]
    for image in images:
        image.header["BUNIT"] = "adu/s"
    times = fits.table_to_hdu(table[["TIME"]])
    times.name = "TIMES"
    fits.HDUList([fits.PrimaryHDU(), *images, times]).writeto(folder / "images.fits")
    air = u.Quantity(nm, "nm").to_value("AA") / 1.00028
    Table({"wavelength": air}).write(folder / "wavelengths.csv")
    for name in ("spectra", "logged"):
        (folder / name).mkdir()
    starts = Time(61_100 + (time - 2.5) / 86_400, format="mjd").isot
    for k in range(30):
        rows = "".join(f"{w},{c},{s}\n" for w, c, s in zip(nm, counts[k], sigma[k], strict=True))
        text = f"# DATE-OBS = {starts[k]}\n# EXPTIME = 5\nlambda,counts,sigma\n{rows}"
        (folder / "spectra" / f"{k:02d}.csv").write_text(text)
        (folder / "logged" / f"{k:02d}.csv").write_text(text)
    Table({"name": [f"{k:02d}.csv" for k in range(30)], "mjd": mjd}).write(folder / "logged" / "log.csv")
    Table({"mjd": np.repeat(mjd, 4), "lambda": np.tile(nm, 30), "counts": counts.ravel(),
           "sigma": sigma.ravel()}).write(folder / "long.csv")  # fmt: skip
    wide = {"mjd": mjd}
    for k, one in enumerate(nm):
        wide |= {f"counts_{one}": counts[:, k], f"sigma_{one}": sigma[:, k]}
    Table(wide).write(folder / "wide.csv")
