"""Every layout that a mapping describes gives the same frames; what mauvecl writes is read back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from layouts import LAYOUTS, Truth, documented_files
from marks import long_but

from mauvecl.observations.reading import read_frames


@pytest.mark.parametrize("layout", long_but(LAYOUTS, *(LAYOUTS.keys() - {"folder of FITS tables"})))
def test_every_layout_gives_the_same_frames(layout: str, tmp_path: Path) -> None:
    truth = Truth.of()
    path, mapping = LAYOUTS[layout](truth, tmp_path)
    truth.compare(read_frames(path, mapping))


def test_every_example_of_the_page_gives_the_same_frames(tmp_path: Path) -> None:
    documented_files(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "mapping.md").read_text(encoding="utf-8")
    examples = re.findall(
        r"```toml\n# ([\w-]+\.toml)\n(.*?)```.*?read_frames\(\"([\w.-]+)\", \"\1\"\)", page, re.DOTALL
    )
    assert [name for name, _, _ in examples] == re.findall(r"^# ([\w-]+\.toml)$", page, re.MULTILINE)
    assert len(examples) == 6
    for name, text, file in examples:
        (tmp_path / name).write_text(text)
        frames = read_frames(tmp_path / file, tmp_path / name)
        np.testing.assert_allclose(frames.flux, 100.0 + np.arange(120.0).reshape(30, 4))
        assert frames.error is not None
        np.testing.assert_allclose(frames.error, frames.flux / 10)
        assert frames.wavelength_nm is not None
        # The page's images have wavelengths in air, by a refractive index of 1.00028 within 1e-5.
        np.testing.assert_allclose(frames.wavelength_nm, [300.25, 400.25, 500.25, 600.25], rtol=2e-5)
        assert frames.date(float(frames.time_s[0]))[:21] == ("2026-03-01T00:00:02.5")
        np.testing.assert_allclose(np.diff(frames.time_s), 5.0, atol=1e-3)
        np.testing.assert_allclose(frames.exposure_s, 5.0)


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
