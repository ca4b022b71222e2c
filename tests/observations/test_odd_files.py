"""Odd spectra of several files: each gives the truth where it is defined, or one sentence that names what is wrong.

Files of one table are in tests/data/corpus.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from corpus import CORPUS, cases, mapping_of, written
from layouts import LAYOUTS, Truth
from refusals import refused

from mauvecl.observations.frames import Frames
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reading import read_frames

#: Check frames against the truth, or the key of an error.
Expected = Callable[[Frames], Any] | str
CASES = dict(cases(CORPUS / "odd_frames.toml"))


def judge(path: Path | str, mapping: FrameMapping | None, expected: Expected) -> None:
    """Check that a file gives the expected frames, or one sentence with the expected key."""
    if callable(expected):
        expected(read_frames(path, mapping))
        return
    with refused(expected) as caught:
        read_frames(path, mapping)
    assert 20 < len(str(caught.value)) < 600, str(caught.value)
    assert "Error" not in str(caught.value), str(caught.value)


SPECTRA = Truth.of(n=30, n_pixel=5)


def same_spectra(frames: Frames) -> None:
    """Check that frames are the spectra."""
    SPECTRA.compare(frames)


def changed(**values: Any) -> Truth:
    """Return spectra with other values."""
    return Truth(**(vars(SPECTRA) | values))


def waves(values: Any) -> Truth:
    """Return spectra with other wavelengths."""
    return changed(wavelength_nm=np.asarray(values, np.float64))


def image(change: Callable[[fits.HDUList], None]) -> Callable[[Path], tuple[Path, FrameMapping]]:
    """Return a writer of FITS images that are changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS["FITS images, wavelengths in the header"](SPECTRA, folder)
        with fits.open(path, mode="update") as hdus:
            change(hdus)
        return path, mapping

    return write


def spoilt_folder(change: Callable[[Path], None], layout: str = "folder of texts") -> Any:
    """Return a writer of a folder of spectra in which something is changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS[layout](SPECTRA, folder)
        change(path)
        return path, mapping

    return write


def replaced(path: Path, old: str, new: str) -> None:
    """Change the text of a file."""
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))


def layout(name: str, truth: Truth = SPECTRA, **change: Any) -> Any:
    """Return a writer of a layout with a changed mapping."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS[name](truth, folder)
        return path, FrameMapping(**(mapping.model_dump(exclude_defaults=True) | change))

    return write


def long_rows(change: Callable[[Table], Table]) -> Any:
    """Return a writer of a long table that is changed."""

    def write(folder: Path) -> tuple[Path, FrameMapping]:
        path, mapping = LAYOUTS["long ECSV"](SPECTRA, folder)
        change(Table.read(path)).write(path, overwrite=True)
        return path, mapping

    return write


def first_frame(flag: int) -> Callable[[Table], Table]:
    """Return a function that flags a pixel of the first frame."""

    def change(table: Table) -> Table:
        table["QUAL"][(table["T"] == table["T"].min()) & (table["W"] < 2600)] = flag
        return table

    return change


def one_pixel_flagged(frames: Frames) -> None:
    """Check that a flagged pixel takes its frame out of the search, and no other value changes."""
    assert np.flatnonzero(frames.faults).tolist() == [0, 7]
    assert np.isnan(frames.flux[0, 0])
    assert np.isfinite(frames.flux[0, 1:]).all()


def transpose(hdus: fits.HDUList) -> None:
    """Exchange the axes of the images."""
    for name in ("FLUX", "ERR"):
        hdus[name].data = hdus[name].data.T.copy()


def keyword(key: str, value: Any) -> Callable[[fits.HDUList], None]:
    """Return a function that sets a keyword of the image, or removes it."""

    def change(hdus: fits.HDUList) -> None:
        if value is None:
            del hdus["FLUX"].header[key]
        else:
            hdus["FLUX"].header[key] = value

    return change


FOLDER, IMAGES = "folder of texts", "folder of FITS images with a table"
#: Odd spectra: a writer of files with their mapping, and what is expected.
ODD_SPECTRA: dict[str, tuple[Callable[[Path], tuple[Path, FrameMapping]], Expected]] = {
    "image plain": (image(lambda _: None), same_spectra),
    "image transposed": (image(transpose), "FLUX"),
    "image in a cube": (image(lambda hdus: setattr(hdus["FLUX"], "data", hdus["FLUX"].data[None])), "FLUX"),
    "image without CRVAL1": (image(keyword("CRVAL1", None)), "CRVAL1"),
    "image without a step": (image(keyword("CDELT1", None)), "CRVAL1"),
    "image of unknown coordinates": (image(keyword("CTYPE1", "VELO-LSR")), "CTYPE1"),
    "image in an unknown unit": (image(keyword("CUNIT1", "cubit")), "wavelength_unit"),
    "image of frequencies": (image(keyword("CUNIT1", "GHz")), lambda frames: None),
    "image with one frame less": (image(lambda hdus: setattr(hdus["FLUX"], "data", hdus["FLUX"].data[:-1])), "FLUX"),
    "errors of another shape": (image(lambda hdus: setattr(hdus["ERR"], "data", hdus["ERR"].data[:, :-1])), "error"),
    "wavelengths of a table by wcs": (layout("FITS table, row per frame", wavelength="wcs"), "flux"),
    "wavelengths too few": (layout("FITS images, wavelengths in an extension", waves(SPECTRA.wavelength_nm[:4])),
                            "wavelength"),
    "wavelengths too many": (layout("FITS images, wavelengths in an extension", waves(np.arange(9) + 300)),
                             "wavelength"),
    "a wavelength is nan": (layout("FITS images, wavelengths in an extension", waves([300, np.nan, 320, 330, 340])),
                            "wavelength"),
    "a wavelength is negative": (layout("FITS table, row per frame", waves([-300, 310, 320, 330, 340])), "wavelength"),
    "a wavelength is zero": (layout("FITS table, row per frame", waves([0, 310, 320, 330, 340])), "wavelength"),
    "no file of wavelengths": (layout("FITS images, wavelengths in a file", wavelength_file="none.txt"), "file"),
    "two columns of wavelengths": (layout("FITS images, wavelengths in a file", wavelength="x"), "column"),
    "an unknown unit of wavelength": (layout("long CSV", wavelength_unit="ell"), "wavelength_unit"),
    "no unit of wavelength": (layout("long CSV", wavelength_unit=None), "wavelength_unit"),
    "no unit of exposure": (layout("long CSV", exposure_unit=None), "exposure_unit"),
    "no unit of temperature": (layout("long CSV", temperature_unit=None), "temperature_unit"),
    "an extension that is not there": (layout("FITS images, wavelengths in an extension", wavelength="W"), "column"),
    "every pixel is nan": (layout("long FITS", changed(flux=SPECTRA.flux * np.nan)), "flux"),
    "a frame is nan": (layout("long FITS", changed(flux=np.where(np.arange(30)[:, None] == 3, np.nan, SPECTRA.flux))),
                       lambda frames: np.testing.assert_array_equal(np.flatnonzero(frames.faults), [3, 7])),
    "a row of a long table is missing": (long_rows(lambda table: table[1:]), "wavelength"),
    "a row of a long table is double": (long_rows(lambda table: table[np.r_[0, 0 : len(table)]]), "wavelength"),
    "a pixel is flagged": (long_rows(first_frame(4)), one_pixel_flagged),
    "exposure changes in a frame": (long_rows(lambda table: _with(table, "EXPT", 3, 5.0)), "EXPT"),
    "temperature changes in a frame": (long_rows(lambda table: _with(table, "TEMP", 3, 5.0)), "TEMP"),
    "no number in a name": (layout("wide CSV", flux="*T*", error=None), "wavelength"),
    "a pattern without a column": (layout("wide CSV", flux="G_*"), "column"),
    "wide without errors": (layout("wide CSV", error="G_*"), "column"),
    "an empty folder": (spoilt_folder(lambda path: [one.unlink() for one in path.iterdir()] and None), "files"),
    "a pattern without a file": (layout(FOLDER, files="*.dat"), "files"),
    "other files in a folder": (spoilt_folder(lambda path: (path / "notes.txt").write_text("clouds") and None),
                                same_spectra),
    "a file without the keyword": (spoilt_folder(lambda path: replaced(path / "003.csv", "# T =", "# U =")), "T"),
    "no file with the keyword": (layout(FOLDER, time="MJD"), "column"),
    "a file with a pixel less": (spoilt_folder(lambda path: (path / "004.csv").write_text(
        "\n".join((path / "004.csv").read_text().splitlines()[:-1]))), "W"),
    "a file with another wavelength": (spoilt_folder(lambda path: replaced(path / "004.csv", "2505,", "2506,")),
                                       "wavelength"),
    "an empty file": (spoilt_folder(lambda path: (path / "005.csv").write_text("") and None), "file"),
    "a file of words": (spoilt_folder(lambda path: replaced(path / "005.csv", "2505,", "2505,x")), "FLUX"),
    "a time of words": (spoilt_folder(lambda path: replaced(path / "005.csv", "# T = ", "# T = x")), "T"),
    "no table of files": (layout(IMAGES, table="none.csv"), "file"),
    "no column of files": (layout(IMAGES, files="spectrum"), "column"),
    "a listed file is missing": (spoilt_folder(lambda path: (path / "004.fits").unlink(), IMAGES), "file"),
    "a listed file is cut short": (spoilt_folder(lambda path: (path / "004.fits").write_bytes(
        (path / "004.fits").read_bytes()[:3000]) and None, IMAGES), "file"),
    "a spectrum with other coordinates": (spoilt_folder(lambda path: _shift(path / "004.fits"), IMAGES), "wavelength"),
}  # fmt: skip


def _with(table: Table, name: str, row: int, value: float) -> Table:
    table[name][row] = value
    return table


def _shift(path: Path) -> None:
    with fits.open(path, mode="update") as hdus:
        hdus["FLUX"].header["CRVAL1"] += 5.0


@pytest.mark.parametrize("name", ODD_SPECTRA)
def test_odd_spectra_give_the_truth_or_an_error(name: str, tmp_path: Path) -> None:
    write, expected = ODD_SPECTRA[name]
    judge(*write(tmp_path), expected)


def test_folders_without_a_store_raise(tmp_path: Path) -> None:
    judge(tmp_path, None, "mapping")
    (tmp_path / "zarr.json").write_text("{")
    judge(tmp_path, None, "file")
    (tmp_path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    judge(tmp_path, None, "file")
    judge(tmp_path / "none", None, "file")


@pytest.mark.parametrize(
    "name", ["unusable column no flux", "rows that are no light curve one row", "unit that is none pc"]
)
def test_command_ends_with_a_message(name: str, tmp_path: Path) -> None:
    case = CASES[f"odd_frames {name} csv"]
    path, mapping = written(case, tmp_path), mapping_of(case, tmp_path)
    done = run("analyse", path, "--mapping", mapping, "--output", "out", folder=tmp_path, code=2)
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(("mauvecl: file 'a.csv'", "mauvecl: a:")), line
    assert not (tmp_path / "out").exists()
