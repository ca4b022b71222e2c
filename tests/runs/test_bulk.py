"""Stores of raw spectra: content, verification, recovery, and what other people do to them."""

import itertools
import json
import os
import shutil
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterator
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


@pytest.fixture(autouse=True, scope="module")
def small_chunks() -> Iterator[None]:
    """Set chunks of some 64 rows, so that a small store has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stored, "CHUNK_BYTES", 64 * 197 * 2)
        yield


@pytest.fixture(scope="module")
def painted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    path = tmp_path_factory.mktemp("painted") / "frames.zarr"
    bulk.realise(study(1000), path, PAINTER)
    return tree(path)


@pytest.fixture
def made(tmp_path: Path) -> Path:
    bulk.realise(study(), tmp_path / "frames.zarr", PAINTER)
    return tmp_path / "frames.zarr"


@pytest.fixture
def other(tmp_path: Path) -> Path:
    bulk.realise(study(run={"seed": 31}), tmp_path / "other.zarr", PAINTER)
    return tmp_path / "other.zarr"


def test_rows_of_every_star_equal_those_of_the_engine(tmp_path: Path, engine: Engine) -> None:
    """Sweep the exposure: a frame has 16 bits, and the sum of ten has 32; components add up to the mean."""
    path = tmp_path / "s.zarr"
    asked = study(sweep={"axes": [{"quantity": "exposure", "values": [5.0, 50.0]}]}, bulk={"components": True})
    made = bulk.realise(asked, path, engine)
    assert [scene.path for scene in made.scenes] == [f"star-{k}/{n}" for k in (1, 2) for n in ("quiescent", "flare-1")]
    assert len(list(made.chunks())) > 8
    root = zarr.open_group(path, mode="r")
    assert Study.build(tomllib.loads(root.attrs["study"]), "store") == asked
    assert "not a flight calibration" in root.attrs["throughput"]
    for star, exposure, kind in (("star-1", 5.0, np.uint16), ("star-2", 50.0, np.int32)):
        quiet, flare = expectations(asked.at("exposure", exposure))
        for name, x in (("quiescent", quiet), ("flare-1", flare)):
            found = bulk.read(path, f"{star}/{name}")
            assert (found.dims, found.dtype, found.attrs["units"]) == (("realisation", "pixel"), kind, "DN")
            np.testing.assert_array_equal(found.values, engine.realise(x, count=300, seed=11))
            np.testing.assert_array_equal(found[17:20].values, engine.realise(x, start=17, count=3, seed=11))
            np.testing.assert_array_equal(found.wavelength, x.wavelength_nm)
        group, n = root[star], quiet.n_frames
        np.testing.assert_array_equal(group["gain_dn_per_electron"][:], quiet.gain_dn_per_electron)
        mean = group["flare-1-source"][:] + group["flare-1-sky"][:] + n * (group["bias_dn"][:] + group["dark_dn"][:])
        np.testing.assert_allclose(mean, n * flare.mean_raw_dn, rtol=1e-12)
        np.testing.assert_allclose(group["quiescent-noise"][:], np.sqrt(quiet.variance_dn2), rtol=1e-12)
    # A single frame has a tenth of the light and of the variance.
    single = study(1, observation={"exposure_s": 50.0}, bulk={"components": True, "frames": [3]})
    bulk.realise(single, tmp_path / "single.zarr", engine)
    frame = zarr.open_group(tmp_path / "single.zarr", mode="r")["star-1"]
    for name, share in (("source", 0.1), ("sky", 0.1), ("noise", np.sqrt(0.1))):
        np.testing.assert_allclose(frame[f"flare-1-{name}"][:], share * group[f"flare-1-{name}"][:], rtol=1e-12)


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
def test_damage_is_found_and_repaired_to_the_bit(made: Path, fault: str) -> None:
    break_it, expected = FAULTS[fault]
    assert bulk.verify(made) == []
    before = tree(made)
    break_it(made)
    found = {one.key: one.state for one in bulk.verify(made)}
    assert found.keys() == expected.keys()
    assert all(state in (found[key], "?") for key, state in expected.items())
    assert all(one.mended for one in bulk.verify(made, PAINTER, repair=True))
    # A list of digests keeps the line that could not be read.
    after, before = ({k: v for k, v in one.items() if "digests" not in k} for one in (tree(made), before))
    assert after == before
    assert bulk.verify(made, PAINTER, redraw=True) == []


def test_redrawing_finds_damage_with_valid_digests(tmp_path: Path, made: Path, other: Path) -> None:
    """Insert chunk and digest of another seed's store, which are consistent with each other, and its study."""
    before = tree(made)
    for name in (CHUNK, LISTED):
        shutil.copy(other / name, made / name)
    assert {f.state for f in bulk.verify(made)} == {"foreign"}, "the other chunks do not have the copied digests"
    (made / "star-1/quiescent/c").rename(tmp_path / "c")
    shutil.copytree(other / "star-1/quiescent/c", made / "star-1/quiescent/c")
    assert bulk.verify(made) == []
    assert {f.state for f in bulk.verify(made, PAINTER, redraw=True, rows=(60, 70))} == {"differs"}
    bulk.verify(made, PAINTER, redraw=True, repair=True)
    assert bulk.verify(made, PAINTER, redraw=True) == []
    # Repair needs the study that was drawn: every copy is one without its digest, or one with other chunks' digests.
    for copy in COPIES:
        relabelled(made / copy, lambda text: text.replace("seed = 11", "seed = 31"))
    with refused("store"):
        bulk.verify(made, PAINTER, repair=True)
    for copy in COPIES:
        shutil.copy(other / copy, made / copy)
    flip(made / CHUNK)
    with refused("redraw"):
        bulk.verify(made, PAINTER, repair=True)
    flip(made / CHUNK)
    chunks, now = ({name: one for name, one in found.items() if "json" not in name} for found in (before, tree(made)))
    assert now == chunks


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


@pytest.mark.parametrize("disk", ["simulated", "mounted"])
def test_full_disk_raises_and_is_resumed(
    disk: str, tmp_path: Path, painted: dict[str, bytes], request: pytest.FixtureRequest, monkeypatch: Any
) -> None:
    folder = tmp_path if disk == "simulated" else request.getfixturevalue("small_disk")
    path, filler = folder / "frames.zarr", folder / "filler"
    with monkeypatch.context() as patch, refused("file", "No space left on device"):
        if disk == "simulated":
            full_after(300_000, patch)
        else:
            filler.write_bytes(bytes(1_400_000))
        bulk.realise(study(1000), path, PAINTER)
    filler.unlink(missing_ok=True)
    kept = {str(chunk.relative_to(path)) for chunk in path.glob("star-1/*/c/*/0")}
    assert len(kept) > 5, "what was written before is kept"
    assert kept == stored.Store.open(path).digests.keys(), "a chunk that could not be written has no file"
    if disk == "mounted":
        subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
        for name, key in (("frames.zarr", "file"), ("other.zarr", "store")):
            with refused(key, "Read-only file system"):
                bulk.realise(study(1000), folder / name, PAINTER)
        subprocess.run(["mount", "-o", "remount,rw", folder], check=True)
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


def test_exports_contain_the_rows_and_any_study(tmp_path: Path, engine: Engine) -> None:
    star = tmp_path / f'{"long/" * 30}ein "Stern" \\ λ Vir 🌟.txt'
    star.parent.mkdir(parents=True)
    star.write_text("".join(f"{nm} 1e-12\n" for nm in range(150, 1200, 5)))
    (payload := tmp_path / "own.toml").write_text('version = 2\nextends = "mauvesim"\nname = "λ"\nnotice = "für\\n🌟"')
    own = {"star": [{"file": star, "magnitude": 5.0}], "observation": {"instrument": str(payload)}}
    sections = study(50).model_dump() | own
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
            assert hdu.header["INSTRUME"] == r"\u03bb"
        np.testing.assert_array_equal(hdus[3].data["DARK_DN"][0], made.scenes[0].expectation.dark_dn)
        assert "table STUDY" in str(hdus[0].header["HISTORY"])
        lines = "\n".join(hdus["STUDY"].data["LINE"])
        assert lines.isascii()
        assert Study.build(tomllib.loads(lines), "fits") == made.study
    run("export", "s.zarr", "s.h5", "--array", "star-1/flare-1", "--rows", "10:30", folder=tmp_path)
    with h5py.File(tmp_path / "s.h5") as file:
        data = file["star-1/flare-1"]
        assert [d.label for d in data.dims] == ["realisation", "pixel"]
        np.testing.assert_array_equal(data[:], bulk.read(tmp_path / "s.zarr", "star-1/flare-1")[10:30].values)
        assert (file.attrs["first_row"], data.attrs["units"], "star-1/quiescent" in file) == (10, "DN", False)
    if shutil.which("fitsverify"):
        reported = subprocess.run(["fitsverify", path], capture_output=True, text=True, check=True).stdout
        assert "0 warning(s) and 0 error(s)" in reported, reported


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
    for more, why in (("f.h5 --rows 0:5", "--replace"), ("f.h5 --rows 10:600", "0:100"), ("s.txt", "hdf5")):
        assert why in said("export", "f.zarr", *more.split(), code=2)
    assert exported.read_bytes() == written
    said("export", "f.zarr", "f.h5", "--rows", "0:5", "--replace")
    assert exported.read_bytes() != written
    for name in ("f.fits", "f.h5"):
        (tmp_path / name).write_text("mine")
        for more in ([], ["--resume"]):
            assert "--restart" in said("realise", "study.toml", "--output", name, *more, code=2)
        assert (tmp_path / name).read_text() == "mine"
        said("realise", "study.toml", "--output", name, "--restart", "--quiet")
        assert (tmp_path / name).stat().st_size > 2 * 2 * 100 * 197
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.fits", "f.h5", "f.zarr", "study.toml"]
    chunk.unlink()
    assert "star-1/quiescent/c/0/0" in said("export", "f.zarr", "g.fits", code=2)
    assert not (tmp_path / "g.fits").exists()
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
def test_stores_are_read_back_with_their_metadata(
    tmp_path: Path, engine: Engine, ending: str, which: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read whole, and reduce in pieces of seven frames, which divide realisations of two frames."""
    asked = study(40, **(STACKED if which == "stacked" else SINGLE))
    bulk.realise(asked, tmp_path / "frames.zarr", engine)
    if ending != "zarr":
        run("export", "frames.zarr", f"frames.{ending}", folder=tmp_path)
    path = f"{tmp_path}/frames.{ending}[star-1/flare-1]"
    frames = read_frames(path)
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
    monkeypatch.setattr("mauvecl.host.tables.table.PIECE_BYTES", 7 * 8 * 197)
    (curve,) = frame_files.reduce_frames(path).light_curves
    np.testing.assert_allclose([curve.flux, curve.error], frames.white_light, rtol=1e-12)


def relabelled(place: Path, change: Callable[[str], str]) -> None:
    content = json.loads(place.read_text())
    content["attributes"]["study"] = change(content["attributes"]["study"])
    place.write_text(json.dumps(content, indent=2))


#: Functions of a store that need it alone.
WRITES: tuple[Callable[[Path], object], ...] = (
    lambda path: bulk.realise(study(), path, PAINTER),
    lambda path: bulk.realise(study(), path, PAINTER, restart=True),
    bulk.verify,
    bulk.forget,
)
COPIES = ["zarr.json", "star-1/quiescent/zarr.json", "star-1/flare-1/zarr.json"]
FOREIGN = ["mine.txt", "star-1/mine.txt", "star-1/quiescent/c/mine", "star-1/quiescent/c/99/0"]


@pytest.mark.parametrize("copy", COPIES)
def test_changed_copy_of_a_study_is_found(made: Path, other: Path, copy: str) -> None:
    """Change any byte: the store keeps its study, and repair restores the file; valid copies may not differ."""
    before = tree(made)
    text = study().toml()
    # A sample of the bytes, and the seed's.
    for place in [*range(3, len(text), len(text) // 6), text.index("seed = 11") + 7]:
        digit = "3" if text[place] != "3" else "4"
        relabelled(made / copy, lambda text, place=place, digit=digit: text[:place] + digit + text[place + 1 :])
        assert [fault.key for fault in bulk.verify(made)] == [copy]
        (made / copy).write_bytes(before[copy])
    relabelled(made / copy, lambda text: text.replace("seed = 11", "seed = 31"))
    assert [(f.key, f.mended) for f in bulk.verify(made, PAINTER, repair=True)] == [(copy, True)]
    assert tree(made) == before
    # Of two studies with valid digests either could be the drawn one, so that nothing is read or written.
    shutil.copy(other / copy, made / copy)
    before = tree(made)
    for ask in (*WRITES, bulk.read, partial(bulk.verify, engine=PAINTER, repair=True, redraw=True)):
        with refused("store", "'zarr.json'"):
            ask(made)
    assert tree(made) == before


def test_locked_store_is_neither_read_nor_removed(made: Path) -> None:
    (made.parent / "study.toml").write_text(study().toml())
    before = tree(made)
    with locked(made):
        done = run("realise", "study.toml", "--restart", "--output", made, folder=made.parent, code=2)
        assert f"{str(made)!r} is being written by another process" in done.stderr
        for ask in WRITES:
            with refused("lock", str(made)):
                ask(made)
    assert tree(made) == before


@pytest.mark.parametrize("kind", ["file", "link"])
@pytest.mark.parametrize("place", long_but(FOREIGN, "star-1/quiescent/c/99/0"))
def test_foreign_files_are_not_removed(made: Path, place: str, kind: str) -> None:
    elsewhere = made.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "keep").write_text("me")
    (made / place).parent.mkdir(exist_ok=True)
    (made / place).write_text("keep me") if kind == "file" else (made / place).symlink_to(elsewhere)
    before = tree(made)
    (fault,) = bulk.verify(made, PAINTER, repair=True)
    assert (fault.key, fault.state, fault.mended) == (place, "not of this store", False)
    for remove in (lambda: bulk.realise(study(), made, PAINTER, restart=True), lambda: bulk.forget(made)):
        with refused("store", str(place)):
            remove()
    assert tree(made) == before
    assert (elsewhere / "keep").read_text() == "me"


def test_kill_during_removal_is_recovered(made: Path, other: Path, tmp_path: Path) -> None:
    """Kill at any file; the rest is a store, and a second restart draws the new study."""
    for step in (0, 3, 9, 14):
        path = tmp_path / f"{step}.zarr"
        shutil.copytree(made, path)
        again = partial(bulk.realise, study(run={"seed": 31}), path, PAINTER)
        assert killed_at(step, partial(again, restart=True), (Path, "unlink"))
        with refused("store", "run.seed"):
            again()
        again(restart=True)
        assert tree(path) == tree(other)
    with refused("store", "run.seed", "star.0.magnitude"):
        bulk.realise(study().at("magnitude", 7.0), path, PAINTER)
    assert tree(path) == tree(other)
    bulk.forget(path)
    assert not path.exists()


@pytest.mark.long
def test_store_larger_than_any_disk_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim 6e15 rows with one chunk; each question is answered in about a second."""
    path, asked = tmp_path / "vast.zarr", study(6 * 10**15)
    # Written by hand, as an attacker would.
    vast = stored.Store(path, asked)
    for name, content in vast.description().items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    first = next(vast.chunks())
    vast.write(first, bulk.draw(asked, first.scene, PAINTER, 0, first.stop))
    for repair in (False, True):
        with refused("rows", "100000"):
            bulk.verify(path, PAINTER, repair=repair)
    with refused("rows", "100000"):
        bulk.verify(path, rows=(0, 10**12))
    assert [f.key for f in bulk.verify(path, rows=(0, first.stop))] == ["star-1/flare-1/c/0/0"]
    run("export", path, "few.h5", "--array", "star-1/quiescent", "--rows", "3:5", folder=tmp_path)
    assert "one file may hold 4 GiB" in run("export", path, "all.h5", folder=tmp_path, code=2).stderr
    with refused("run.realisations"):
        bulk.realise(asked, path, PAINTER)
    bulk.forget(path)
    assert not path.exists()
