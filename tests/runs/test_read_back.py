"""Stores, FITS and HDF5 files are read back as frames with their metadata, and refuse what they cannot use."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import expectations
from commands import run
from stores import PAINTER, study

from mauvecl import Engine, Study, bulk, read_frames
from mauvecl.observations import frame_files

#: Stacks of two frames, and single frames of which the second is stored.
STACKED: dict[str, Any] = {"observation": {"exposure_s": 10.0}}
SINGLE: dict[str, Any] = {"observation": {"exposure_s": 15.0}, "bulk": {"frames": [0, 2]}}


@pytest.mark.parametrize("ending", ["zarr", "fits", "h5"])
@pytest.mark.parametrize("which", ["stacked", "single"])
def test_stores_are_read_back_with_their_metadata(tmp_path: Path, engine: Engine, ending: str, which: str) -> None:
    asked = study(40, **(STACKED if which == "stacked" else SINGLE))
    path = _written(tmp_path, asked, engine, ending)
    frames = read_frames(f"{path}[star-1/flare-1]")
    _, x = expectations(asked)
    raw = bulk.read(tmp_path / "frames.zarr", "star-1/flare-1").values.reshape(-1, x.wavelength_nm.size)
    n = 2 if which == "stacked" else 1
    np.testing.assert_allclose(frames.flux, raw - n * (x.bias_dn + x.dark_dn), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(frames.wavelength_nm, x.wavelength_nm)
    exposure, times = (10.0, [5.0, 15.0, 25.0, 35.0]) if which == "stacked" else (5.0, [2.5, 12.5, 17.5, 27.5])
    np.testing.assert_allclose(frames.exposure_s, exposure)
    np.testing.assert_allclose(frames.time_s[:4], times)
    np.testing.assert_allclose(frames.temperature_c, 21.0)
    assert (frames.instrument, frames.unit, frames.name) == ("mauvesim", "adu", "G2V V = 7.4")
    # The mean of the squared errors is the variance of the model: 40 rows of 197 pixels know it to a percent.
    np.testing.assert_allclose((frames.error**2).mean(), (x.variance_dn2 / x.n_frames * n).mean(), rtol=0.03)
    assert not frames.quality.any()


@pytest.mark.parametrize("ending", ["zarr", "fits", "h5"])
def test_stores_are_reduced_in_pieces(
    tmp_path: Path, engine: Engine, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"{_written(tmp_path, study(40, **SINGLE), engine, ending)}[star-1/flare-1]"
    light, error = read_frames(path).white_light
    # Seven frames at once, which divide realisations of two frames.
    monkeypatch.setattr("mauvecl.host.tables.table.PIECE_BYTES", 7 * 8 * 197)
    (curve,) = frame_files.reduce_frames(path).light_curves
    np.testing.assert_allclose(curve.flux, light, rtol=1e-12)
    np.testing.assert_allclose(curve.error, error, rtol=1e-12)


def _written(folder: Path, asked: Study, engine: Engine, ending: str) -> Path:
    bulk.realise(asked, folder / "frames.zarr", engine)
    if ending == "zarr":
        return folder / "frames.zarr"
    run("export", "frames.zarr", f"frames.{ending}", folder=folder)
    return folder / f"frames.{ending}"


def test_bad_exports_are_refused(tmp_path: Path) -> None:
    bulk.realise(study(20), tmp_path / "s.zarr", PAINTER)

    def exported(*words: str) -> str:
        return run("export", "s.zarr", *words, folder=tmp_path, code=2).stderr

    assert "0:20" in exported("s.fits", "--rows", "10:60")
    assert "hdf5" in exported("s.txt")
    (tmp_path / "s.zarr" / "star-1/quiescent/c/0/0").unlink()
    assert "star-1/quiescent/c/0/0" in exported("s.fits")
    assert not (tmp_path / "s.fits").exists()
