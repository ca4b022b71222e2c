"""The files of the page about mappings; others are in the corpus."""

import shutil
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time


def documented_files(folder: Path) -> None:
    """Write the files of the page about mappings: the same 30 frames of four pixels in every layout, without noise."""
    time, nm = np.arange(30) * 5.0 + 2.5, np.array([300.25, 400.25, 500.25, 600.25])
    counts = 100.0 + np.arange(120.0).reshape(30, 4)
    sigma, mjd = 0.1 * counts, 61_100 + time / 86_400
    columns = {"TIME": time, "COUNTS": counts, "SIGMA": sigma, "FLAG": 0 * time, "EXPTIME": np.full(30, 5.0),
               "CCDTEMP": np.full(30, 21.0), "LAMBDA": np.tile(nm, (30, 1))}  # fmt: skip
    units = {"TIME": "s", "COUNTS": "adu/s", "SIGMA": "adu/s", "EXPTIME": "s", "CCDTEMP": "deg_C", "LAMBDA": "nm"}
    table = Table(columns, units=units)
    table.write(folder / "night.fits")
    unit = fits.Header({"BUNIT": "adu/s"})
    images = [fits.ImageHDU(columns[name], unit, name) for name in ("COUNTS", "SIGMA")]
    times = fits.BinTableHDU(table[["TIME"]], name="TIMES")
    fits.HDUList([fits.PrimaryHDU(), *images, times]).writeto(folder / "images.fits")
    air = u.Quantity(nm, "nm").to_value("AA") / 1.00028
    Table({"wavelength": air}).write(folder / "wavelengths.csv")
    (folder / "spectra").mkdir()
    starts = Time(61_100 + (time - 2.5) / 86_400, format="mjd").isot
    for k in range(30):
        rows = "".join(f"{w},{c},{s}\n" for w, c, s in zip(nm, counts[k], sigma[k], strict=True))
        text = f"# DATE-OBS = {starts[k]}\n# EXPTIME = 5\nlambda,counts,sigma\n{rows}"
        (folder / "spectra" / f"{k:02d}.csv").write_text(text)
    shutil.copytree(folder / "spectra", folder / "logged")
    Table({"name": [f"{k:02d}.csv" for k in range(30)], "mjd": mjd}).write(folder / "logged" / "log.csv")
    Table({"mjd": np.repeat(mjd, 4), "lambda": np.tile(nm, 30), "counts": counts.ravel(),
           "sigma": sigma.ravel()}).write(folder / "long.csv")  # fmt: skip
    wide = {"mjd": mjd}
    for k, one in enumerate(nm):
        wide |= {f"counts_{one}": counts[:, k], f"sigma_{one}": sigma[:, k]}
    Table(wide).write(folder / "wide.csv")
