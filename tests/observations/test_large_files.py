"""Files larger than memory are read in pieces, in a process whose address space is limited."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from processes import python

from mauvecl import read_frames
from mauvecl.observations import frame_files

#: The address space may grow by this while a file is read, of which at most the other is read at once.
MARGIN_MIB, CONTENT_MIB = 96, 16
#: A process that reads `path`, whose address space is limited after its imports and a first, small file.
CHILD = f"""
import json, resource, sys
import astropy.io.fits, astropy.table, astropy.time, scipy.special
import numpy as np
from mauvecl import read_frames
from mauvecl.observations import frame_files
# OpenBLAS reserves address space at the first large product; reading does not need it.
np.ones((300, 300)) @ np.ones((300, 300))
small, path, out, mapping = sys.argv[1:]
mapping = frame_files.FrameMapping(**json.loads(mapping))
weights = np.zeros((2, read_frames(small, mapping).wavelength_nm.size)); weights[0, 3] = 1.0; weights[1, :2] = 1.0
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + {MARGIN_MIB} * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
frames = read_frames(path, mapping)
reduced = frame_files.reduce_frames(path, weights, mapping)
one, two = (curve.flux for curve in reduced.light_curves)
print(*frames.remarks, sep=chr(10), file=sys.stderr)
np.savez(out, time=frames.time_s, white=frames.flux, one=one, two=two, mean=reduced.pixels.mean,
         scatter=reduced.pixels.scatter)
"""
FITS = {"time": "TIME", "time_unit": "s", "flux": "FLUX", "wavelength": "WAVES", "wavelength_unit": "nm"}
CSV = {"time": "time", "flux": "flux_*", "wavelength": "names", "wavelength_unit": "nm"}


def write(path: Path, light: np.ndarray, form: str) -> None:
    """Write frames of 5 s with their times and wavelengths: an image, or a spectrum in each row of a table."""
    n, pixels = light.shape
    if form == "csv":
        start = np.datetime64("2026-03-01T00:00:00")
        with path.open("w") as file:
            file.write(",".join(["time", *(f"flux_{200 + k}" for k in range(pixels))]) + "\n")
            for row, values in enumerate(light):
                file.write(f"{start + np.timedelta64(5 * row, 's')},{','.join(map(str, values.tolist()))}\n")
        return
    flux, times = light.astype(np.float32), np.arange(n) * 5.0
    hdus = [fits.ImageHDU(flux, name="FLUX"), fits.ImageHDU(times, name="TIME")]
    if form == "table":
        columns = [fits.Column("TIME", "D", array=times), fits.Column("FLUX", f"{pixels}E", array=flux)]
        hdus = [fits.BinTableHDU.from_columns(columns)]
    waves = fits.ImageHDU(np.arange(pixels) + 200.0, name="WAVES")
    fits.HDUList([fits.PrimaryHDU(), *hdus, waves]).writeto(path)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the size of a process as Linux states it")
@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "n", "pixels", "mapping"),
    [("image", 65_536, 1024, FITS), ("table", 65_536, 1024, FITS), ("csv", 44_000, 512, CSV)],
)
def test_a_file_larger_than_memory_is_read_in_pieces(
    form: str, n: int, pixels: int, mapping: dict[str, str], tmp_path: Path
) -> None:
    small, path, out = tmp_path / f"small.{form}", tmp_path / f"large.{form}", tmp_path / "found.npz"
    pattern, pixel = np.arange(n) * 7919 % 101, np.arange(pixels)
    for file, rows in ((small, pattern[:30]), (path, pattern)):
        write(file, rows[:, None] + pixel, form)
    assert path.stat().st_size > (0.8 if form == "csv" else 2.5) * MARGIN_MIB * 2**20
    limits = {"MAUVECL_LARGEST_CONTENT_MIB": str(CONTENT_MIB), "OPENBLAS_NUM_THREADS": "1"}
    done = python(CHILD, small, path, out, json.dumps(mapping), **limits)
    path.unlink()
    found = np.load(out)
    assert "they were summed over wavelength while they were read" in done.stderr
    np.testing.assert_allclose(found["time"], np.arange(n) * 5.0, atol=1e-3)
    np.testing.assert_allclose(found["white"], pixels * pattern + pixel.sum())
    np.testing.assert_allclose(found["one"], pattern + 3)
    np.testing.assert_allclose(found["two"], 2 * pattern + 1)
    np.testing.assert_allclose(found["mean"], pattern.mean() + pixel)
    np.testing.assert_allclose(found["scatter"], np.sqrt((np.diff(pattern) ** 2).mean() / 2))


@pytest.mark.long
def test_pieces_give_what_the_whole_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, n, path = np.random.default_rng(29), 1500, tmp_path / "rows.fits"
    flux = rng.normal(1000.0, 5.0, (n, 50)) * np.linspace(0.5, 1.5, 50)
    error = 0.01 * flux
    flux[:, 4], flux[11, 5], flux[[13, 800], 5] = 9.97e36, np.nan, -99_999.0
    bad = (np.arange(n) == 7).astype(int)
    columns = {"T": 20.0 * np.arange(n), "QUAL": bad, "DQ": np.tile(bad[:, None], 50), "FLUX": flux, "ERR": error,
               "W": np.tile(np.linspace(250.5, 650.5, 50), (n, 1))}  # fmt: skip
    Table(columns, units={"T": "s", "FLUX": "adu/s", "ERR": "adu/s", "W": "nm"}).write(path)
    how: dict[str, Any] = {"flux": "FLUX", "error": "ERR", "quality": "QUAL", "wavelength": "W", "exposure_s": 18.0}
    mapping = frame_files.FrameMapping(time="T", **how)
    whole = read_frames(path, mapping)
    monkeypatch.setattr("mauvecl.host.tables.table.PIECE_BYTES", 8 * 50 * 400)
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "1")
    pieces = read_frames(path, mapping)
    for found, wanted in zip((pieces.flux, pieces.error), whole.white_light, strict=True):
        np.testing.assert_allclose(found, wanted)
    np.testing.assert_array_equal(pieces.quality, whole.quality)
    assert "1 pixel is not finite in most frames" in pieces.remarks[-1]
    pixels, same = (frame_files.reduce_frames(path, mapping=mapping.model_copy(update={"quality": name})).pixels
                    for name in ("QUAL", "DQ"))  # fmt: skip
    np.testing.assert_array_equal(same.mean, pixels.mean)
    quiet = np.delete(flux, 7, axis=0)
    np.testing.assert_allclose(pixels.mean[:4], quiet[:, :4].mean(axis=0))
    assert pixels.count[[3, 4, 5]].tolist() == [1499, 0, 1496]
    steps = np.diff(np.where(np.arange(1500)[:, None] == 7, np.nan, flux), axis=0)
    np.testing.assert_allclose(pixels.scatter[6:], np.sqrt(np.nanmean(steps[:, 6:] ** 2, axis=0) / 2))
    np.testing.assert_allclose(pixels.stated[6:], np.sqrt((np.delete(error, 7, axis=0)[:, 6:] ** 2).mean(axis=0)))
