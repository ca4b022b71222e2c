"""Files larger than memory are read in pieces, in a process whose address space is limited."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from mauvecl import InputError, read_frames
from mauvecl.observations import frame_files
from mauvecl.observations.mapping import FrameMapping

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
from mauvecl.observations.frame_files import read_frames, reduce_frames
# OpenBLAS reserves address space at the first large product; reading does not need it.
np.ones((300, 300)) @ np.ones((300, 300))
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


def _light() -> np.ndarray:
    return (PATTERN[:, None] + np.arange(PIXELS)).astype(np.float32)


def _image(path: Path) -> None:
    """Write an image of 256 MiB, with its times and wavelengths."""
    images = {"FLUX": _light(), "WAVES": np.arange(PIXELS) + 200.0, "TIME": np.arange(FRAMES) * 5.0}
    fits.HDUList([fits.PrimaryHDU(), *(fits.ImageHDU(one, name=name) for name, one in images.items())]).writeto(path)


def _table(path: Path) -> None:
    """Write a table of 256 MiB, a spectrum in each row, with its wavelengths in another extension."""
    times = fits.Column("TIME", "D", array=np.arange(FRAMES) * 5.0)
    table = fits.BinTableHDU.from_columns([times, fits.Column("FLUX", f"{PIXELS}E", array=_light())])
    fits.HDUList([fits.PrimaryHDU(), table, fits.ImageHDU(np.arange(PIXELS) + 200.0, name="WAVES")]).writeto(path)


@pytest.mark.long
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


@pytest.mark.long
def test_pieces_give_what_the_whole_gives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, n, path = np.random.default_rng(29), 1500, tmp_path / "rows.fits"
    flux = rng.normal(1000.0, 5.0, (n, 50)) * np.linspace(0.5, 1.5, 50)
    error = 0.01 * flux
    flux[:, 4], flux[11, 5] = np.nan, np.nan
    columns = {"T": 20.0 * np.arange(n), "QUAL": (np.arange(n) == 7).astype(int), "FLUX": flux, "ERR": error,
               "W": np.tile(np.linspace(250.5, 650.5, 50), (n, 1))}  # fmt: skip
    Table(columns, units={"T": "s", "FLUX": "adu/s", "ERR": "adu/s", "W": "nm"}).write(path)
    mapping = FrameMapping(time="T", flux="FLUX", error="ERR", quality="QUAL", wavelength="W", exposure_s=18.0)
    whole = read_frames(path, mapping)
    monkeypatch.setattr("mauvecl.host.tables.table.PIECE_BYTES", 8 * 50 * 400)
    monkeypatch.setattr("mauvecl.host.tables.fits_tables.PIECE_BYTES", 0)
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "1")
    pieces = read_frames(path, mapping)
    for found, wanted in zip((pieces.flux, pieces.error), whole.white_light, strict=True):
        np.testing.assert_allclose(found, wanted)
    np.testing.assert_array_equal(pieces.quality, whole.quality)
    assert "1 pixel is not finite in most frames" in pieces.remarks[-1]
    pixels = frame_files.reduce_frames(path, mapping=mapping).pixels
    quiet = np.delete(flux, 7, axis=0)
    np.testing.assert_allclose(pixels.mean[:4], quiet[:, :4].mean(axis=0))
    assert pixels.count[[3, 4, 5]].tolist() == [1499, 0, 1498]
    steps = np.diff(np.where(np.arange(1500)[:, None] == 7, np.nan, flux), axis=0)
    np.testing.assert_allclose(pixels.scatter[6:], np.sqrt(np.nanmean(steps[:, 6:] ** 2, axis=0) / 2))
    np.testing.assert_allclose(pixels.stated[6:], np.sqrt((np.delete(error, 7, axis=0)[:, 6:] ** 2).mean(axis=0)))


CSV_CHILD = """
import resource, sys
import astropy.table, astropy.time, scipy.special
import numpy as np
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.frame_files import read_frames
how = dict(time="time", flux="flux_*", wavelength="names", wavelength_unit="nm")
read_frames({small!r}, FrameMapping(time_unit="s", **how))
# OpenBLAS reserves address space at the first large product; reading does not need it.
np.ones((300, 300)) @ np.ones((300, 300))
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + {margin} * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
frames = read_frames({path!r}, FrameMapping(**how))
np.savez({out!r}, white=frames.flux, time=frames.time_s)
"""


def _csv(path: Path, n: int) -> None:
    """Write a table with a date and 512 columns of light in each row."""
    start = np.datetime64("2026-03-01T00:00:00")
    with path.open("w") as file:
        file.write(",".join(["time", *(f"flux_{200 + k}" for k in range(512))]) + "\n")
        for row in range(n):
            light = ",".join(map(str, (PATTERN[row] + np.arange(512)).tolist()))
            file.write(f"{start + np.timedelta64(5 * row, 's')},{light}\n")


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the size of a process as Linux states it")
def test_a_csv_table_larger_than_memory_is_read_in_pieces(tmp_path: Path) -> None:
    n, margin = 44_000, 80
    path, small, out = tmp_path / "large.csv", tmp_path / "small.csv", tmp_path / "out.npz"
    _csv(path, n)
    small.write_text("time,flux_200\n" + "\n".join(f"{k},1" for k in range(30)) + "\n")
    assert path.stat().st_size > margin * 2**20
    code = CSV_CHILD.format(margin=margin, path=str(path), small=str(small), out=str(out))
    limits = {"MAUVECL_LARGEST_CONTENT_MIB": "16", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | limits, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = np.load(out)
    np.testing.assert_allclose(found["white"], 512 * PATTERN[:n] + np.arange(512).sum())
    np.testing.assert_allclose(found["time"], np.arange(n) * 5.0, atol=1e-3)


CELLS = [f"{k},{1000 + k % 7},{'' if k == 33 else 5}" for k in range(60)]
TABLES = {
    "plain": ["time,flux,error", *CELLS],
    "names in a comment": ["# OBJECT = GJ 65", "# time,flux,error", *CELLS],
    "semicolons": ["time;flux;error", *(row.replace(",", ";") for row in CELLS)],
    "tabs": ["time\tflux\terror", *(row.replace(",", "\t") for row in CELLS)],
    "dates": ["time,flux,error", *(f"2026-03-01T00:{k:02d}:00,{1000 + k % 7},5" for k in range(60))],
    "text among numbers": ["time,flux,error", *CELLS[:-5], "55,bad,5", *CELLS[-4:]],
    "short row": ["time,flux,error", *CELLS[:-5], "55,1000", *CELLS[-4:]],
    "long row": ["time,flux,error", *CELLS[:-5], "55,1000,5,6", *CELLS[-4:]],
    "decimal commas": ["time;flux;error", *(f"{k},5;{1000 + k % 7},0;{'' if k == 33 else 5}" for k in range(60))],
    "no rows": ["time,flux,error"],
    "separators at the end": ["time,flux,error", *(f"{line}," for line in CELLS)],
    "an empty last column": ["time,flux,error,note", *(f"{line}," for line in CELLS)],
}
REFUSED = {"text among numbers": "in row 56", "short row": "2 cells in row 56", "long row": "4 cells in row 56",
           "no rows": "has no rows"}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_tables_in_pieces_are_those_read_whole(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table.csv"
    path.write_text("\n".join(TABLES[name]) + "\n")
    mapping = FrameMapping(time="time", time_unit=None if name == "dates" else "s", flux="flux", error="error")
    for large, piece in ((2**40, 2**20), (0, 200)):
        monkeypatch.setattr("mauvecl.host.tables.opening.LARGE", large)
        monkeypatch.setattr("mauvecl.host.tables.opening.PIECE", piece)
        if name in REFUSED:
            with pytest.raises(InputError, match=REFUSED[name]):
                read_frames(path, mapping)
            continue
        frames = read_frames(path, mapping)
        assert frames.flux.tolist() == [1000 + k % 7 for k in range(60)]
        assert frames.name == ("GJ 65" if "comment" in name else "table")
        assert np.isnan(frames.error).sum() == (name != "dates")
