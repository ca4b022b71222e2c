"""Files larger than memory are read in pieces, in a process whose address space is limited."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from processes import python

from mauvecl import read_frames
from mauvecl.observations import frame_files

FRAMES, PIXELS = 65_536, 1024
#: The address space may grow by this while a file of 256 MiB is read.
MARGIN_MIB = 96
#: Light of a frame above that of its pixel.
PATTERN = np.arange(FRAMES) * 7919 % 101
#: A process that reads `path`, whose address space is limited after its imports and a first, small file.
CHILD = """
import resource, sys
import astropy.io.fits, astropy.table, astropy.time, scipy.special
import numpy as np
from mauvecl.observations.mapping import FrameMapping
from mauvecl import read_frames
from mauvecl.observations.frame_files import reduce_frames
# OpenBLAS reserves address space at the first large product; reading does not need it.
np.ones((300, 300)) @ np.ones((300, 300))
path, out = sys.argv[1:]
{first}
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + {margin} * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
{then}
print(*frames.remarks, sep=chr(10), file=sys.stderr)
np.savez(out, white=frames.flux, **found)
"""
#: Reads all that an image or a table has.
REDUCE = """
mapping = FrameMapping(time="TIME", time_unit="s", flux="FLUX", wavelength="WAVES", wavelength_unit="nm", exposure_s=5)
frames = read_frames(path, mapping)
weights = np.zeros((2, 1024)); weights[0, 3] = 1.0; weights[1, :2] = 1.0
reduced = reduce_frames(path, weights, mapping)
one, two = (curve.flux for curve in reduced.light_curves)
found = dict(one=one, two=two, mean=reduced.pixels.mean, scatter=reduced.pixels.scatter)
"""


def _in_pieces(path: Path, margin: int, content_mib: int, then: str, first: str = "") -> tuple[Any, str]:
    """Read a large file in a process with little memory, remove it, and return what is found and said."""
    assert path.stat().st_size > margin * 2**20
    out = path.with_suffix(".npz")
    limits = {"MAUVECL_LARGEST_CONTENT_MIB": str(content_mib), "OPENBLAS_NUM_THREADS": "1"}
    done = python(CHILD.format(margin=margin, first=first, then=then), path, out, **limits)
    path.unlink()
    return np.load(out), done.stderr


LINUX = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="needs the size of a process as Linux states it"
)


@LINUX
@pytest.mark.long
@pytest.mark.parametrize("in_table", [False, True])
def test_a_file_larger_than_memory_is_reduced_in_pieces(in_table: bool, tmp_path: Path) -> None:
    """Read light of 256 MiB, an image or a spectrum in each row of a table, with its times and wavelengths."""
    path, pixel, times = tmp_path / "large.fits", np.arange(PIXELS), np.arange(FRAMES) * 5.0
    light = (PATTERN[:, None] + pixel).astype(np.float32)
    hdus = [fits.ImageHDU(light, name="FLUX"), fits.ImageHDU(times, name="TIME")]
    if in_table:
        columns = [fits.Column("TIME", "D", array=times), fits.Column("FLUX", f"{PIXELS}E", array=light)]
        hdus = [fits.BinTableHDU.from_columns(columns)]
    fits.HDUList([fits.PrimaryHDU(), *hdus, fits.ImageHDU(pixel + 200.0, name="WAVES")]).writeto(path)
    assert path.stat().st_size > 2.5 * MARGIN_MIB * 2**20
    found, said = _in_pieces(path, MARGIN_MIB, 32, REDUCE)
    assert "they were summed over wavelength while they were read" in said
    np.testing.assert_allclose(found["white"], PIXELS * PATTERN + pixel.sum())
    np.testing.assert_allclose(found["one"], PATTERN + 3)
    np.testing.assert_allclose(found["two"], 2 * PATTERN + 1)
    np.testing.assert_allclose(found["mean"], PATTERN.mean() + pixel)
    np.testing.assert_allclose(found["scatter"], np.sqrt((np.diff(PATTERN) ** 2).mean() / 2))


@pytest.mark.long
def test_pieces_give_what_the_whole_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, n, path = np.random.default_rng(29), 1500, tmp_path / "rows.fits"
    flux = rng.normal(1000.0, 5.0, (n, 50)) * np.linspace(0.5, 1.5, 50)
    error = 0.01 * flux
    flux[:, 4], flux[11, 5] = 9.97e36, np.nan
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
    assert pixels.count[[3, 4, 5]].tolist() == [1499, 0, 1498]
    steps = np.diff(np.where(np.arange(1500)[:, None] == 7, np.nan, flux), axis=0)
    np.testing.assert_allclose(pixels.scatter[6:], np.sqrt(np.nanmean(steps[:, 6:] ** 2, axis=0) / 2))
    np.testing.assert_allclose(pixels.stated[6:], np.sqrt((np.delete(error, 7, axis=0)[:, 6:] ** 2).mean(axis=0)))


@LINUX
@pytest.mark.long
def test_a_csv_table_larger_than_memory_is_read_in_pieces(tmp_path: Path) -> None:
    """Read a table with a date and 512 columns of light in each row."""
    n, path, small = 44_000, tmp_path / "large.csv", tmp_path / "small.csv"
    start, pixel = np.datetime64("2026-03-01T00:00:00"), np.arange(512)
    with path.open("w") as file:
        file.write(",".join(["time", *(f"flux_{200 + k}" for k in pixel)]) + "\n")
        for row in range(n):
            light = ",".join(map(str, (PATTERN[row] + pixel).tolist()))
            file.write(f"{start + np.timedelta64(5 * row, 's')},{light}\n")
    small.write_text("time,flux_200\n" + "\n".join(f"{k},1" for k in range(30)) + "\n")
    how = 'how = dict(time="time", flux="flux_*", wavelength="names", wavelength_unit="nm")\n'
    first = f'{how}read_frames({str(small)!r}, FrameMapping(time_unit="s", **how))'
    then = "frames = read_frames(path, FrameMapping(**how))\nfound = dict(time=frames.time_s)"
    found, _ = _in_pieces(path, 80, 16, then, first)
    np.testing.assert_allclose(found["white"], 512 * PATTERN[:n] + pixel.sum())
    np.testing.assert_allclose(found["time"], np.arange(n) * 5.0, atol=1e-3)
