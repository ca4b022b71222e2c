"""Frames with a known truth, written in every layout that a mapping can describe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from numpy.typing import NDArray

from mauvecl.observations.frames import Frames
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

    def compare(self, frames: Frames, rtol: float = 1e-9) -> None:
        """Check that frames are the truth."""
        assert frames.reference_mjd is not None
        from_epoch = frames.time_s + (frames.reference_mjd - 61_000) * 86_400
        np.testing.assert_allclose(from_epoch, self.time_s, atol=2e-5)
        np.testing.assert_allclose(frames.flux, self.flux, rtol=rtol)
        assert frames.error is not None
        assert frames.wavelength_nm is not None
        assert frames.temperature_c is not None
        np.testing.assert_allclose(frames.error, self.error, rtol=rtol)
        np.testing.assert_allclose(frames.wavelength_nm, self.wavelength_nm, rtol=rtol)
        np.testing.assert_allclose(frames.exposure_s, self.exposure_s)
        np.testing.assert_allclose(frames.temperature_c, self.temperature_c, rtol=1e-6)
        np.testing.assert_array_equal(frames.quality, self.quality)
        assert (u.Unit(frames.unit), frames.scale, frames.position) == (u.Unit("adu/s"), "tt", "GEOCENTER")


COMMON: dict[str, Any] = {"flux": "FLUX", "error": "ERR", "quality": "QUAL", "exposure": "EXPT", "temperature": "TEMP",
                          "time": "T", "epoch": "2025-11-21", "scale": "tt", "position": "geocenter"}  # fmt: skip
UNITS: dict[str, Any] = {"flux_unit": "adu/s", "time_unit": "d", "exposure_unit": "s", "temperature_unit": "deg_C",
                         "wavelength_unit": "Angstrom"}  # fmt: skip
Writer = Callable[[Truth, Path], tuple[Path, FrameMapping]]


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


def image_with_vector(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write images of flux and error, with wavelengths in another extension."""
    table = with_units(Table(scalars(truth)))
    waves = fits.ImageHDU(truth.wavelength_nm * 10, name="WAVES")
    waves.header["BUNIT"] = "Angstrom"
    images = [fits.ImageHDU(values, name=name) for name, values in (("FLUX", truth.flux), ("ERR", truth.error))]
    for image in images:
        image.header["BUNIT"] = "adu/s"
    fits.HDUList([fits.PrimaryHDU(), *images, waves, fits.table_to_hdu(table)]).writeto(folder / "vector.fits")
    return folder / "vector.fits", FrameMapping(**COMMON, wavelength="WAVES")


def image_with_wcs(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write images whose headers hold the wavelengths, in 16-bit integers with a scale for the error."""
    table = with_units(Table(scalars(truth)))
    images = [fits.ImageHDU(values, name=name) for name, values in (("FLUX", truth.flux), ("ERR", truth.error))]
    step = float(truth.wavelength_nm[1] - truth.wavelength_nm[0]) * 10
    for image in images:
        image.header.update({"BUNIT": "adu/s", "CTYPE1": "WAVE", "CUNIT1": "Angstrom", "CRPIX1": 1.0, "CDELT1": step,
                             "CRVAL1": float(truth.wavelength_nm[0]) * 10})  # fmt: skip
    fits.HDUList([fits.PrimaryHDU(), *images, fits.table_to_hdu(table)]).writeto(folder / "wcs.fits")
    return folder / "wcs.fits", FrameMapping(**COMMON, wavelength="wcs")


def image_with_file(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write images, with wavelengths in a text file."""
    table = with_units(Table(scalars(truth)))
    images = [fits.ImageHDU(values, name=name) for name, values in (("FLUX", truth.flux), ("ERR", truth.error))]
    fits.HDUList([fits.PrimaryHDU(), *images, fits.table_to_hdu(table)]).writeto(folder / "file.fits")
    (folder / "waves.txt").write_text("lambda\n" + "\n".join(f"{one:.10g}" for one in truth.wavelength_nm * 10))
    units = {"flux_unit": "adu/s", "wavelength_unit": "Angstrom"}
    return folder / "file.fits", FrameMapping(**COMMON, **units, wavelength_file=str(folder / "waves.txt"))


def folder_of_text(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write a text file for each spectrum, with keywords in its comments."""
    (folder / "texts").mkdir()
    for k in range(truth.time_s.size):
        lines = [f"# {key} = {value[k]:.17g}" for key, value in scalars(truth).items()]
        lines += ["W,FLUX,ERR"]
        lines += [f"{w:.17g},{f:.17g},{e:.17g}" for w, f, e in
                  zip(truth.wavelength_nm * 10, truth.flux[k], truth.error[k], strict=True)]  # fmt: skip
        (folder / "texts" / f"{k:03d}.csv").write_text("\n".join(lines))
    return folder / "texts", FrameMapping(**COMMON, **UNITS, wavelength="W", files="*.csv")


def folder_of_fits(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write a FITS table for each spectrum, with keywords in its header."""
    (folder / "fits").mkdir()
    for k in range(truth.time_s.size):
        table = with_units(Table({"W": truth.wavelength_nm * 10, "FLUX": truth.flux[k], "ERR": truth.error[k]}))
        hdu = fits.table_to_hdu(table)
        primary = fits.PrimaryHDU()
        primary.header.update({key: value[k].item() for key, value in scalars(truth).items()})
        fits.HDUList([primary, hdu]).writeto(folder / "fits" / f"{k:03d}.fits")
    units = {key: UNITS[key] for key in ("time_unit", "exposure_unit", "temperature_unit")}
    return folder / "fits", FrameMapping(**COMMON, **units, wavelength="W")


def folder_with_table(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
    """Write 1-D FITS images, with the times of the files in a table."""
    (folder / "images").mkdir()
    for k in range(truth.time_s.size):
        flux, error = (fits.ImageHDU(values[k], name=name) for name, values in
                       (("FLUX", truth.flux), ("ERR", truth.error)))  # fmt: skip
        step = float(truth.wavelength_nm[1] - truth.wavelength_nm[0]) * 10
        flux.header.update({"BUNIT": "adu/s", "CTYPE1": "WAVE", "CUNIT1": "Angstrom", "CRPIX1": 1.0, "CDELT1": step,
                            "CRVAL1": float(truth.wavelength_nm[0]) * 10})  # fmt: skip
        fits.HDUList([fits.PrimaryHDU(), flux, error]).writeto(folder / "images" / f"{k:03d}.fits")
    table = with_units(Table({"file": [f"{k:03d}.fits" for k in range(truth.time_s.size)], **scalars(truth)}))
    table.write(folder / "images" / "times.ecsv")
    return folder / "images", FrameMapping(**COMMON, wavelength="wcs", table="times.ecsv")


def long_table(ending: str) -> Writer:
    """Return a writer of a table with a row for each pixel of each frame, in any order."""

    def write(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
        n_pixel = truth.wavelength_nm.size
        columns = {key: np.repeat(value, n_pixel) for key, value in scalars(truth).items()}
        columns |= {"W": np.tile(truth.wavelength_nm * 10, truth.time_s.size)}
        columns |= {"FLUX": truth.flux.ravel(), "ERR": truth.error.ravel()}
        order = np.random.default_rng(1).permutation(truth.flux.size)
        table = with_units(Table({key: value[order] for key, value in columns.items()}))
        table.write(folder / f"long.{ending}")
        return folder / f"long.{ending}", FrameMapping(**COMMON, **(UNITS if ending == "csv" else {}), wavelength="W")

    return write


def wide_table(ending: str) -> Writer:
    """Return a writer of a table with a row for each frame and a column for each pixel."""

    def write(truth: Truth, folder: Path) -> tuple[Path, FrameMapping]:
        columns: dict[str, Any] = scalars(truth)
        for k, nm in enumerate(truth.wavelength_nm * 10):
            columns |= {f"F_{nm:.1f}": truth.flux[:, k], f"E_{nm:.1f}": truth.error[:, k]}
        table = with_units(Table(columns))
        table.write(folder / f"wide.{ending}")
        how = COMMON | {"flux": "F_*", "error": "E_*"}
        units = UNITS if ending == "csv" else {key: UNITS[key] for key in ("flux_unit", "wavelength_unit")}
        return folder / f"wide.{ending}", FrameMapping(**how, **units, wavelength="names")

    return write


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


LAYOUTS: dict[str, Writer] = {
    "FITS table, row per frame": row_per_frame,
    "FITS images, wavelengths in an extension": image_with_vector,
    "FITS images, wavelengths in the header": image_with_wcs,
    "FITS images, wavelengths in a file": image_with_file,
    "folder of texts": folder_of_text,
    "folder of FITS tables": folder_of_fits,
    "folder of FITS images with a table": folder_with_table,
    "long CSV": long_table("csv"),
    "long ECSV": long_table("ecsv"),
    "long FITS": long_table("fits"),
    "wide CSV": wide_table("csv"),
    "wide ECSV": wide_table("ecsv"),
}
