"""Files larger than memory are read in pieces, in a process whose address space is limited."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from layouts import LAYOUTS, Truth

from mauvecl.observations.reading import read_frames, reduce_frames

FRAMES, PIXELS = 65_536, 1024
#: The address space may grow by this while a file of 256 MiB is read.
MARGIN_MIB = 96
#: Light of a frame above that of its pixel.
PATTERN = np.arange(FRAMES) * 7919 % 101
CHILD = """
import resource, sys
import astropy.io.fits, astropy.table, astropy.time, scipy.special
import numpy as np
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import read_frames, reduce_frames
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + {margin} * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
mapping = FrameMapping(time="TIME", time_unit="s", flux="FLUX", wavelength="WAVES", wavelength_unit="nm", exposure_s=5)
frames = read_frames({path!r}, mapping)
weights = np.zeros((2, {pixels})); weights[0, 3] = 1.0; weights[1, :2] = 1.0
reduced = reduce_frames({path!r}, weights, mapping)
print(*frames.remarks, sep=chr(10), file=sys.stderr)
np.savez({out!r}, white=frames.flux, one=reduced.light_curves[0].flux, two=reduced.light_curves[1].flux,
         mean=reduced.pixels.mean, scatter=reduced.pixels.scatter)
"""


def _image(path: Path) -> None:
    """Write an image of 256 MiB in pieces, with its times and wavelengths."""
    header = fits.ImageHDU(np.zeros((1, 1), np.float32), name="FLUX").header
    header["NAXIS1"], header["NAXIS2"] = PIXELS, FRAMES
    rest = [fits.ImageHDU(np.arange(PIXELS) + 200.0, name="WAVES"), fits.ImageHDU(np.arange(FRAMES) * 5.0, name="TIME")]
    with path.open("wb") as file:
        file.write(fits.PrimaryHDU().header.tostring().encode() + header.tostring().encode())
        _rows(file, lambda rows: rows.astype(">f4"))
        for hdu in rest:
            held = fits.HDUList([fits.PrimaryHDU(), hdu])
            held.writeto(path.with_suffix(".part"), overwrite=True)
            file.write(path.with_suffix(".part").read_bytes()[fits.PrimaryHDU().header.tostring().__len__() :])


def _table(path: Path) -> None:
    """Write a table of 256 MiB in pieces, a spectrum in each row, with its wavelengths in another extension."""
    row = np.dtype([("TIME", ">f8"), ("FLUX", ">f4", (PIXELS,))])
    columns = [fits.Column("TIME", "D"), fits.Column("FLUX", f"{PIXELS}E")]
    header = fits.BinTableHDU.from_columns(columns, nrows=1).header
    header["NAXIS2"] = FRAMES
    primary = fits.PrimaryHDU().header.tostring().encode()
    start = 0

    def rows_of(rows: np.ndarray) -> np.ndarray:
        nonlocal start
        made = np.empty(len(rows), row)
        made["TIME"], made["FLUX"] = (start + np.arange(len(rows))) * 5.0, rows
        start += len(rows)
        return made

    waves = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.arange(PIXELS) + 200.0, name="WAVES")])
    waves.writeto(path.with_suffix(".part"), overwrite=True)
    with path.open("wb") as file:
        file.write(primary + header.tostring().encode())
        _rows(file, rows_of)
        file.write(path.with_suffix(".part").read_bytes()[len(primary) :])


def _rows(file, form) -> None:  # type: ignore[no-untyped-def]
    size = 0
    for start in range(0, FRAMES, 4096):
        raw = form(PATTERN[start : start + 4096, None] + np.arange(PIXELS)).tobytes()
        size += file.write(raw)
    file.write(b"\0" * (-size % 2880))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the size of a process as Linux states it")
@pytest.mark.parametrize("write", [_image, _table])
def test_a_file_larger_than_memory_is_reduced_in_pieces(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path, out = tmp_path / "large.fits", tmp_path / "out.npz"
    write(path)
    assert path.stat().st_size > 2.5 * MARGIN_MIB * 2**20
    code = CHILD.format(margin=MARGIN_MIB, path=str(path), out=str(out), pixels=PIXELS)
    limits = {"MAUVECL_LARGEST_CONTENT_MIB": "32", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | limits, capture_output=True, text=True, check=False
    )
    path.unlink()
    assert done.returncode == 0, done.stderr
    assert "they were summed over wavelength while they were read" in done.stderr
    found, pixel = np.load(out), np.arange(PIXELS)
    np.testing.assert_allclose(found["white"], PIXELS * PATTERN + pixel.sum())
    np.testing.assert_allclose(found["one"], PATTERN + 3)
    np.testing.assert_allclose(found["two"], 2 * PATTERN + 1)
    np.testing.assert_allclose(found["mean"], PATTERN.mean() + pixel)
    np.testing.assert_allclose(found["scatter"], np.sqrt((np.diff(PATTERN) ** 2).mean() / 2))


def test_pieces_give_what_the_whole_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = Truth.of(n=1500, n_pixel=50)
    flux = truth.flux.copy()
    flux[:, 4], flux[11, 5] = np.nan, np.nan
    path, mapping = LAYOUTS["FITS table, row per frame"](Truth(**(vars(truth) | {"flux": flux})), tmp_path)
    whole = read_frames(path, mapping)
    monkeypatch.setattr("mauvecl.observations.values.PIECE_BYTES", 8 * 50 * 400)
    monkeypatch.setattr("mauvecl.observations.fits_frames.PIECE_BYTES", 0)
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "1")
    pieces = read_frames(path, mapping)
    assert pieces.error is not None
    light, error = whole.white_light
    np.testing.assert_allclose(pieces.flux, light)
    np.testing.assert_allclose(pieces.error, error)
    np.testing.assert_array_equal(pieces.quality, whole.quality)
    assert "1 pixel is not finite in most frames" in pieces.remarks[-1]
    pixels = reduce_frames(path, mapping=mapping).pixels
    quiet = np.delete(flux, 7, axis=0)
    np.testing.assert_allclose(pixels.mean[:4], quiet[:, :4].mean(axis=0))
    assert pixels.count[[3, 4, 5]].tolist() == [1499, 0, 1498]
    steps = np.diff(np.where(np.arange(1500)[:, None] == 7, np.nan, flux), axis=0)
    np.testing.assert_allclose(pixels.scatter[6:], np.sqrt(np.nanmean(steps[:, 6:] ** 2, axis=0) / 2))
    assert pixels.stated is not None
    np.testing.assert_allclose(pixels.stated[6:], np.sqrt((np.delete(truth.error, 7, axis=0)[:, 6:] ** 2).mean(axis=0)))
