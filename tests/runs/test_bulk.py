"""Stores of raw spectra: content, verification, and recovery."""

import itertools
import json
import os
import shutil
import subprocess
import time
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import zarr
from answers import expectations
from astropy.io import fits
from astropy.wcs import WCS
from commands import run
from marks import long_but
from refusals import refused
from stores import CHUNK, LAST, PAINTER, flip, full_after, killed_at, locked, study, tree

from mauvecl import Engine, Study, bulk, read_frames
from mauvecl.observations import frame_files
from mauvecl.runs import store as stored


@pytest.fixture(scope="module")
def painted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    path = tmp_path_factory.mktemp("painted") / "frames.zarr"
    bulk.realise(study(1000), path, PAINTER)
    return tree(path)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, engine: Engine) -> Path:
    path = tmp_path_factory.mktemp("drawn") / "frames.zarr"
    bulk.realise(study(), path, engine)
    return path


@pytest.fixture
def path(tmp_path: Path, original: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "frames.zarr"))


def test_rows_equal_those_of_the_engine(tmp_path: Path, engine: Engine) -> None:
    asked = study()
    made = bulk.realise(asked, tmp_path / "frames.zarr", engine)
    assert len(list(made.chunks())) > 4
    quiet, flare = expectations(asked)
    for name, x in (("star-1/quiescent", quiet), ("star-1/flare-1", flare)):
        found = bulk.read(tmp_path / "frames.zarr", name)
        assert (found.dims, found.dtype, found.attrs["units"]) == (("realisation", "pixel"), np.uint16, "DN")
        np.testing.assert_array_equal(found.values, engine.realise(x, count=300, seed=11))
        np.testing.assert_array_equal(found[17:20].values, engine.realise(x, start=17, count=3, seed=11))
        np.testing.assert_array_equal(found.wavelength, x.wavelength_nm)
    root = zarr.open_group(tmp_path / "frames.zarr", mode="r")
    np.testing.assert_array_equal(root["star-1/gain_dn_per_electron"][:], quiet.gain_dn_per_electron)
    assert Study.build(tomllib.loads(root.attrs["study"]), "store") == asked
    assert "not a flight calibration" in root.attrs["throughput"]


def test_every_star_of_a_sweep_is_stored_in_32_bits_with_its_components(tmp_path: Path, engine: Engine) -> None:
    sweep = {"axes": [{"quantity": "magnitude", "values": [7.4, 8.0]}]}
    asked = study(40, observation={"exposure_s": 50.0}, bulk={"components": True}, sweep=sweep)
    made = bulk.realise(asked, tmp_path / "s.zarr", engine)
    assert [scene.path for scene in made.scenes] == [f"star-{k}/{n}" for k in (1, 2) for n in ("quiescent", "flare-1")]
    second, _ = expectations(asked.at("magnitude", 8.0))
    found = bulk.read(tmp_path / "s.zarr", "star-2/quiescent")
    np.testing.assert_array_equal(found.values, engine.realise(second, count=40, seed=11))
    quiet, flare = expectations(asked)
    found = bulk.read(tmp_path / "s.zarr", "star-1/flare-1")
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found.values, engine.realise(flare, count=40, seed=11))
    group = zarr.open_group(tmp_path / "s.zarr", mode="r")["star-1"]
    mean = group["flare-1-source"][:] + group["flare-1-sky"][:] + 10 * (group["bias_dn"][:] + group["dark_dn"][:])
    np.testing.assert_allclose(mean, 10 * flare.mean_raw_dn, rtol=1e-12)
    np.testing.assert_allclose(group["quiescent-noise"][:], np.sqrt(quiet.variance_dn2), rtol=1e-12)
    # A single frame has a tenth of the light and of the variance.
    single = asked.with_changes({"bulk": {"frames": [3]}, "run": {"realisations": 1}}, None)
    bulk.realise(single, tmp_path / "single.zarr", engine)
    frame = zarr.open_group(tmp_path / "single.zarr", mode="r")["star-1"]
    for name, share in (("source", 0.1), ("sky", 0.1), ("noise", np.sqrt(0.1))):
        whole = group[f"flare-1-{name}"][:]
        np.testing.assert_allclose(frame[f"flare-1-{name}"][:], share * whole, rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("processes", [{}, {"jitter": {"uniform": (0.0, 0.05)}}])
def test_separate_frames_sum_to_the_exposure(tmp_path: Path, engine: Engine, processes: dict[str, Any]) -> None:
    how = {"observation": {"exposure_s": 50.0, "mode": "frames"}, "processes": processes}
    whole = bulk.realise(study(30, **how), tmp_path / "whole.zarr", engine)
    bulk.realise(study(30, **how, bulk={"frames": "all"}), tmp_path / "all.zarr", engine)
    bulk.realise(study(30, **how, bulk={"frames": [0, 7]}), tmp_path / "two.zarr", engine)
    for scene in whole.scenes:
        every = bulk.read(tmp_path / "all.zarr", scene.path)
        assert (every.dims, every.dtype) == (("realisation", "frame", "pixel"), np.uint16)
        np.testing.assert_array_equal(every.values.sum(axis=1), bulk.read(tmp_path / "whole.zarr", scene.path).values)
        two = bulk.read(tmp_path / "two.zarr", scene.path)
        np.testing.assert_array_equal(two.frame, [0, 7])
        np.testing.assert_array_equal(two.values, every.values[:, [0, 7]])


DESCRIBED, LISTED = "star-1/flare-1/zarr.json", "star-1/quiescent/digests.txt"
FIRST, THIRD = "star-1/quiescent/c/0/0", "star-1/quiescent/c/2/0"
#: What happens to a store, and the states of its files that are then found; "?" for any.
FAULTS: dict[str, tuple[Callable[[Path], object], dict[str, str]]] = {
    "flipped byte": (lambda p: flip(p / CHUNK), {CHUNK: "damaged"}),
    "flipped CRC": (lambda p: flip(p / LAST, -1), {LAST: "damaged"}),
    "cut short": (lambda p: (p / CHUNK).write_bytes((p / CHUNK).read_bytes()[:-10]), {CHUNK: "damaged"}),
    "missing": (lambda p: (p / CHUNK).unlink(), {CHUNK: "missing"}),
    "misplaced": (lambda p: shutil.copy(p / CHUNK, p / THIRD), {THIRD: "foreign"}),
    "flipped byte in the list": (lambda p: flip(p / LISTED, 5), {FIRST: "unlisted"}),
    "flipped byte in the study": (lambda p: flip(p / "zarr.json", 40), {"zarr.json": "?"}),
    "a missing description": (lambda p: (p / DESCRIBED).unlink(), {DESCRIBED: "missing"}),
    "flipped calibration": (lambda p: flip(p / "star-1/bias_dn/c/0"), {"star-1/bias_dn/c/0": "damaged"}),
}


@pytest.mark.parametrize("fault", long_but(FAULTS, "flipped byte", "flipped byte in the study", "missing"))
def test_damage_is_found_and_repaired_to_the_bit(path: Path, engine: Engine, fault: str) -> None:
    break_it, expected = FAULTS[fault]
    assert bulk.verify(path) == []
    before = tree(path)
    break_it(path)
    found = {one.key: one.state for one in bulk.verify(path)}
    assert found.keys() == expected.keys()
    assert all(state in (found[key], "?") for key, state in expected.items())
    assert all(one.mended for one in bulk.verify(path, engine, repair=True))
    # A list of digests keeps the line that could not be read.
    after, before = ({k: v for k, v in one.items() if "digests" not in k} for one in (tree(path), before))
    assert after == before
    assert bulk.verify(path, engine, redraw=True) == []


@pytest.mark.long
def test_redrawing_finds_damage_with_valid_digests(tmp_path: Path, path: Path, engine: Engine) -> None:
    """Insert chunk and digest of another seed's store, which are consistent with each other."""
    other = tmp_path / "other.zarr"
    bulk.realise(study(run={"seed": 12}), other, engine)
    for name in (CHUNK, LISTED):
        shutil.copy(other / name, path / name)
    assert {f.state for f in bulk.verify(path)} == {"foreign"}, "the other chunks do not have the copied digests"
    (path / "star-1/quiescent/c").rename(tmp_path / "c")
    shutil.copytree(other / "star-1/quiescent/c", path / "star-1/quiescent/c")
    assert bulk.verify(path) == []
    assert {f.state for f in bulk.verify(path, engine, redraw=True, rows=(60, 70))} == {"differs"}
    bulk.verify(path, engine, redraw=True, repair=True)
    assert bulk.verify(path, engine, redraw=True) == []


def test_foreign_files_are_named_and_kept_and_another_study_raises(path: Path, engine: Engine) -> None:
    with refused("store", "run.seed", "star.0.magnitude"):
        bulk.realise(study(run={"seed": 3}).at("magnitude", 7.0), path, engine)
    assert bulk.verify(path) == []
    (path / "star-1/quiescent/c/99").mkdir()
    (path / "star-1/quiescent/c/99/0").write_bytes(b"?")
    (fault,) = bulk.verify(path, engine, repair=True)
    assert (fault.key, fault.state, fault.mended) == ("star-1/quiescent/c/99/0", "not of this store", False)


@pytest.mark.long
def test_kill_at_every_step_of_writing_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kill before each fsync, rename and line of digests; a run that goes on leaves the same bits."""
    store = stored.Store(tmp_path, study(200))
    # Described once for all runs, which then begin to write at once.
    described, scenes = store.description(), store.scenes
    monkeypatch.setattr(stored.Store, "description", lambda self: described)
    monkeypatch.setattr(stored.Store, "scenes", property(lambda self: scenes))
    first: dict[str, bytes] = {}
    for step in itertools.count():
        path = tmp_path / f"{step}.zarr"
        paint = partial(bulk.realise, study(200), path, PAINTER)
        was_killed = killed_at(step, paint, (os, "fsync"), (Path, "replace"), (Path, "open"))
        paint()
        first = first or tree(path)
        assert tree(path) == first
        shutil.rmtree(path)
        if not was_killed:
            break
    assert step > 30


def test_full_disk_raises_and_is_resumed(tmp_path: Path, painted: dict[str, bytes], monkeypatch: Any) -> None:
    path = tmp_path / "frames.zarr"
    with monkeypatch.context() as patch:
        full_after(300_000, patch)
        with refused("file", "No space left on device"):
            bulk.realise(study(1000), path, PAINTER)
    kept = {str(chunk.relative_to(path)) for chunk in path.glob("star-1/*/c/*/0")}
    assert len(kept) > 5, "what was written before is kept"
    assert kept == stored.Store.open(path).digests.keys(), "a chunk that could not be written has no file"
    bulk.realise(study(1000), path, PAINTER)
    assert tree(path) == painted


def test_full_or_read_only_file_system_raises(small_disk: Path, painted: dict[str, bytes]) -> None:
    path = small_disk / "frames.zarr"
    filler = small_disk / "filler"
    filler.write_bytes(bytes(1_400_000))
    with refused("file", "No space left on device"):
        bulk.realise(study(1000), path, PAINTER)
    filler.unlink()
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with refused("file", "Read-only file system"):
        bulk.realise(study(1000), path, PAINTER)
    with refused("store", "Read-only file system"):
        bulk.realise(study(1000), small_disk / "other.zarr", PAINTER)
    subprocess.run(["mount", "-o", "remount,rw", small_disk], check=True)
    bulk.realise(study(1000), path, PAINTER)
    assert tree(path) == painted


def test_no_chunk_is_being_written_when_a_stopped_run_has_ended(tmp_path: Path, painted: Any, monkeypatch: Any) -> None:
    """Stop after the first chunk, while threads write others: the store stays locked until they have ended."""
    path, write, is_locked = tmp_path / "frames.zarr", stored.Store.write, list[bool]()

    def slow(store: stored.Store, chunk: Any, rows: Any) -> None:
        time.sleep(0.2)
        write(store, chunk, rows)
        try:
            with locked(store.path, wait=False):
                is_locked.append(False)
        except BlockingIOError:
            is_locked.append(True)

    with monkeypatch.context() as patch:
        patch.setattr(stored.Store, "write", slow)
        with pytest.raises(KeyboardInterrupt):
            bulk.realise(study(1000), path, PAINTER, progress=Mock(side_effect=[None, KeyboardInterrupt]))
    assert all(is_locked)
    assert len(is_locked) == len(stored.Store.open(path).digests) > 4
    bulk.realise(study(1000), path, PAINTER, progress=(seen := Mock()))
    assert seen.call_args_list[0].args[0] >= 64 * len(is_locked), "it went on from where it was"
    assert (seen.call_args.args[0], tree(path)) == (2000, painted)


def test_fits_export_contains_the_rows_and_any_study(tmp_path: Path, engine: Engine) -> None:
    star = tmp_path / f'{"long/" * 30}ein "Stern" \\ λ Vir 🌟.txt'
    star.parent.mkdir(parents=True)
    star.write_text("".join(f"{nm} 1e-12\n" for nm in range(150, 1200, 5)))
    sections = study(50).model_dump() | {"star": [{"file": star, "magnitude": 5.0}]}
    made = bulk.realise(Study.build(sections, "test"), tmp_path / "s.zarr", engine)
    run("export", "s.zarr", "s.fits", "--rows", "10:30", folder=tmp_path)
    path = tmp_path / "s.fits"
    with fits.open(path, checksum=True) as hdus:
        for hdu, scene in zip(hdus[1:3], made.scenes, strict=True):
            np.testing.assert_array_equal(hdu.data, engine.realise(scene.expectation, start=10, count=20, seed=11))
            wcs = WCS(hdu.header, hdus)
            pixels = np.arange(hdu.data.shape[1])
            wavelength, row = wcs.pixel_to_world_values(pixels, 3 + 0 * pixels)
            np.testing.assert_allclose(wavelength, scene.expectation.wavelength_nm, rtol=1e-12)
            np.testing.assert_array_equal(row, 13)
        np.testing.assert_array_equal(hdus[3].data["DARK_DN"][0], made.scenes[0].expectation.dark_dn)
        assert "table STUDY" in str(hdus[0].header["HISTORY"])
        lines = "\n".join(hdus["STUDY"].data["LINE"])
        assert lines.isascii()
        assert Study.build(tomllib.loads(lines), "fits") == made.study
    if shutil.which("fitsverify"):
        reported = subprocess.run(["fitsverify", path], capture_output=True, text=True, check=True).stdout
        assert "0 warning(s) and 0 error(s)" in reported, reported


def test_hdf5_export_contains_the_frames(tmp_path: Path, engine: Engine) -> None:
    asked = study(50, observation={"exposure_s": 10.0}, bulk={"frames": "all"})
    bulk.realise(asked, tmp_path / "s.zarr", engine)
    run("export", "s.zarr", "s.h5", "--array", "star-1/flare-1", "--rows", "5:9", folder=tmp_path)
    with h5py.File(tmp_path / "s.h5") as file:
        data = file["star-1/flare-1"]
        assert [d.label for d in data.dims] == ["realisation", "frame", "pixel"]
        np.testing.assert_array_equal(data[:], bulk.read(tmp_path / "s.zarr", "star-1/flare-1")[5:9].values)
        assert (file.attrs["first_row"], data.attrs["units"], "star-1/quiescent" in file) == (5, "DN", False)


@pytest.mark.long
def test_commands_of_stores_work(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(study(100).toml())

    def said(*words: str, code: int = 0) -> str:
        done = run(*words, folder=tmp_path, code=code)
        return done.stdout + done.stderr

    made = said("realise", "study.toml", "--output", "f.zarr")
    assert all(words in made for words in ("100 x 197", "not a flight calibration"))
    again = run("realise", "study.toml", "--output", "f.zarr", "--json", folder=tmp_path)
    assert json.loads(again.stdout)["arrays"][1]["amplitude"] == 0.24
    assert "Everything agrees" in said("verify", "f.zarr")
    chunk, exported = tmp_path / "f.zarr/star-1/quiescent/c/0/0", tmp_path / "f.h5"
    flip(chunk)
    assert "damaged" in said("verify", "f.zarr", code=1)
    said("verify", "f.zarr", "--repair")
    said("verify", "f.zarr", "--redraw", "--rows", "0:10")
    said("export", "f.zarr", "f.h5", "--rows", "0:10")
    written = exported.read_bytes()
    assert "--replace" in said("export", "f.zarr", "f.h5", "--rows", "0:5", code=2)
    assert exported.read_bytes() == written
    said("export", "f.zarr", "f.h5", "--rows", "0:5", "--replace")
    assert exported.read_bytes() != written
    said("realise", "study.toml", "--output", "f.fits", "--quiet")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.fits", "f.h5", "f.zarr", "study.toml"]
    chunk.unlink()
    refusal = said("realise", "study.toml", "--output", "f.zarr", code=2)
    assert all(word in refusal for word in ("3", "4", "--resume"))
    said("realise", "study.toml", "--output", "f.zarr", "--resume")
    said("verify", "f.zarr")
    assert ".zarr" in said("realise", "study.toml", "--output", "f.txt", code=2)


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
def test_stores_are_reduced_in_pieces(tmp_path: Path, engine: Engine, ending: str, monkeypatch: Any) -> None:
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
