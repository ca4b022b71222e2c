"""Every layout that a mapping describes gives the same frames; what mauvecl writes is read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from layouts import LAYOUTS, Truth

from mauvecl.observations.reading import read_frames


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_frames(layout: str, tmp_path: Path) -> None:
    truth = Truth.of()
    path, mapping = LAYOUTS[layout](truth, tmp_path)
    truth.compare(read_frames(path, mapping))


def test_packed_files_give_the_same_frames(tmp_path: Path) -> None:
    import gzip

    truth = Truth.of()
    for layout in ("FITS images, wavelengths in the header", "long CSV"):
        path, mapping = LAYOUTS[layout](truth, tmp_path)
        packed = tmp_path / f"packed-{path.name}"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        truth.compare(read_frames(packed, mapping))


def test_pixels_are_put_in_order_and_dead_ones_are_left_out(tmp_path: Path) -> None:
    truth = Truth.of()
    path, mapping = LAYOUTS["wide ECSV"](truth, tmp_path)
    text = path.read_text()
    # The reversed order of wavelengths, through the names of the columns.
    for k, nm in enumerate(truth.wavelength_nm * 10):
        for letter in "FE":
            text = text.replace(f"{letter}_{nm:.1f}", f"{letter}_x{k}")
    for k, nm in enumerate(truth.wavelength_nm[::-1] * 10):
        for letter in "FE":
            text = text.replace(f"{letter}_x{k}", f"{letter}_{nm:.1f}")
    path.write_text(text)
    frames = read_frames(path, mapping)
    assert frames.wavelength_nm is not None
    assert (np.diff(frames.wavelength_nm) > 0).all()
    np.testing.assert_allclose(frames.flux, truth.flux[:, ::-1])
    flux = truth.flux.copy()
    flux[:, 2] = np.nan
    path, mapping = LAYOUTS["long FITS"](Truth(**(vars(truth) | {"flux": flux})), tmp_path)
    frames = read_frames(path, mapping)
    np.testing.assert_allclose(frames.flux, np.delete(truth.flux, 2, axis=1))
    assert frames.remarks == ("1 pixel is not finite in most frames of long and left out",)
