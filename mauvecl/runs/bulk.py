"""Raw spectra in bulk: drawing, verification, reading, and export to a FITS or HDF5 file."""

from __future__ import annotations

import io
import json
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.device.launches import Progress
from mauvecl.host import VERSION
from mauvecl.host.arrays import map_in_threads
from mauvecl.host.tables.files import UNFINISHED, check_folder, check_size, parsing, read_bytes, write_whole
from mauvecl.host.tables.names import header_text
from mauvecl.runs.checkpoint import locked
from mauvecl.runs.pool import PREPARED, Pool
from mauvecl.runs.store import CALIBRATION, DRAWS, Chunk, Store, StoredScene, digest, exposure_attributes, is_intact
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column
from mauvecl.schema.errors import InputError, missing_package
from mauvecl.schema.fields import FirstRealisation, Realisations
from mauvecl.study.cases import Case
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.io.fits import BinTableHDU, HDUList, ImageHDU

    from mauvecl.device.engine import Engine


#: Threads that write chunks while others are drawn.
WRITERS = 4
#: Largest number of missing chunks that `verify` lists, since a study can ask for any number.
MAX_MISSING = 100_000


@validated
def draw(
    study: Study,
    scene: StoredScene,
    engine: Engine | Pool,
    start: FirstRealisation,
    count: Realisations,
    out: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Draw `count` rows of an array, raw DN, without a store; `out` is an array of shape (count, *scene.row) to fill.

    Without single frames the shape is (count, n_pixel), else (count, n_frame, n_pixel), of uint16 or int32. The study
    gives seed, mode, recipe and processes.
    """
    options = Case(study).draw_options | {"start": start, "count": count, "seed": study.run.seed}
    if scene.frames is None:
        return engine.realise(scene.expectation, out=out, **options)
    rows = np.empty((count, *scene.row), scene.dtype) if out is None else out
    single = replace(scene.expectation, n_frames=1)
    for place, frame in enumerate(scene.frames):
        rows[:, place] = engine.realise(single, first_frame=frame, **options)
    return rows


@validated
def realise(
    study: Study,
    path: str | Path,
    engine: Engine | Pool,
    *,
    resume: bool = True,
    restart: bool = False,
    progress: Progress | None = None,
) -> Store:
    """Draw a study's spectra into a store, or complete a store.

    Parameters
    ----------
    study : Study
        Its ``run.realisations`` is the number of rows of each array, and its ``bulk`` selects the stored data.
    path : str or Path
        A new folder, or an unfinished store of the same study.
    resume : bool
        Whether to complete an unfinished store; otherwise it raises InputError.
    restart : bool
        Whether to remove an existing store first, even one of another study.
    progress : callable, optional
        Called as ``progress(done, total)`` in spectra. It may raise to stop the work, which keeps written chunks.

    Raises
    ------
    InputError
        If the folder contains other files, is being written by another process, or cannot be written.
    """
    with _completed(Store(Path(path), study), engine, resume, restart, progress) as store:
        return store


@validated
def realise_file(
    study: Study,
    file: str | Path,
    engine: Engine | Pool,
    *,
    resume: bool = True,
    restart: bool = False,
    progress: Progress | None = None,
) -> Store:
    """Draw a study's spectra into a FITS or HDF5 file; parameters as for `realise`.

    A temporary store next to the file exists until the file is complete. Raises InputError if the file exists, unless
    `restart` is true.
    """
    file = Path(file)
    if file.exists() and not restart:
        raise InputError(
            f"{str(file)!r} exists already: use another name, or `restart=True` to replace it", key="restart"
        )
    with _completed(Store(unfinished(file), study), engine, resume, restart, progress) as store:
        export(Selection.of(store), file, replace=restart)
        store.clear()
        store.path.rmdir()
        return store


@validated
def unfinished(file: Path) -> Path:
    """Return the path of the temporary store of a file."""
    return file.with_name(f"{UNFINISHED}{file.name}.zarr")


@contextmanager
def _completed(
    store: Store, engine: Engine | Pool, resume: bool, restart: bool, progress: Progress | None
) -> Iterator[Store]:
    """Lock a store, draw its missing chunks, and yield it."""
    store.make_folder()
    with locked(store.path, "store"):
        if restart and any(store.path.iterdir()):
            Store.open(store.path).clear()
        existed = (store.path / "zarr.json").exists()
        store.make()
        todo = [chunk for chunk in store.chunks() if not store.has(chunk)]
        if existed and not resume and todo:
            raise InputError(
                f"store {str(store.path)!r} holds {store.count() - len(todo)} of {store.count()} chunks: use "
                "`resume=True` to draw the others, or another place",
                key="resume",
            )
        _fill(store, todo, engine, progress)
        store.sort_digests()
        yield store


@validated
def forget(path: str | Path) -> None:
    """Remove a store, unless the folder contains other files or another process is writing it."""
    path = Path(path)
    if path.exists():
        Store.open(path)
        with locked(path, "store"):
            Store.open(path).clear()
            path.rmdir()


def _fill(store: Store, todo: list[Chunk], engine: Engine | Pool, progress: Progress | None) -> None:
    """Draw and write chunks; after an error, those in progress are completed and the rest is left for a resume."""
    total = store.rows * len(store.scenes)
    done = total - sum(chunk.stop - chunk.start for chunk in todo)
    if progress is not None:
        progress(done, total)

    # An engine draws for one thread at a time, a pool for one more than it has workers.
    n_drawing, stop = (engine.workers.count + PREPARED, engine.stop) if isinstance(engine, Pool) else (1, None)
    drawing = threading.Semaphore(n_drawing)

    def write(chunk: Chunk) -> int:
        with drawing:
            rows = draw(store.study, chunk.scene, engine, chunk.start, chunk.stop - chunk.start)
        store.write(chunk, rows)
        return len(rows)

    with closing(map_in_threads(write, todo, n_drawing + WRITERS, stop)) as written:
        for rows in written:
            done += rows
            if progress is not None:
                progress(done, total)


@dataclass(frozen=True)
class Fault:
    """A faulty file of a store.

    Its state is ``missing``; ``damaged``: wrong CRC or unreadable text; ``foreign``: intact, but not what was written;
    ``unlisted``: intact, but not in the list of digests; ``differs``: not what the engine draws; or ``not of this
    store``.
    """

    key: str  # path in the store
    state: str
    mended: bool  # whether the file was repaired


FAULT_COLUMNS = (
    Column("key", heading="file"),
    Column("state", heading="what"),
    Column("mended", heading="repaired", format=lambda mended: "repaired" if mended else ""),
)


@validated
def state(store: Store, chunk: Chunk) -> str:
    """Return ``good``, or the fault of a chunk's file; see `Fault`."""
    file, size = store.path / chunk.key, chunk.n_bytes
    if not file.exists():
        return "missing"
    try:
        data = read_bytes(file, "chunk") if check_size(file, "chunk") == size else b""
    except InputError:
        # Too large, or no regular file.
        return "damaged"
    if len(data) != size or not is_intact(data):
        return "damaged"
    listed = store.digests.get(chunk.key)
    if listed is None:
        return "unlisted"
    return "good" if digest(data) == listed else "foreign"


@validated
def verify(
    path: str | Path,
    engine: Engine | Pool | None = None,
    *,
    repair: bool = False,
    redraw: bool = False,
    rows: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> list[Fault]:
    """Check every file of a store, and optionally repair it.

    Parameters
    ----------
    engine : Engine or Pool, optional
        Required to repair or redraw.
    repair : bool
        Whether to write faulty files again.
    redraw : bool
        Whether to compare every spectrum with what the engine draws, not only with its digest.
    rows : (int, int), optional
        Half-open range of realisations to which the check of chunks is restricted.
    progress : callable, optional
        Called as ``progress(done, total)`` in chunks.

    Raises
    ------
    InputError
        If the folder is not a store, is being written, or cannot be written for a repair; if copies of its study
        contradict each other, or the study does not draw what was written; or if more than `MAX_MISSING` chunks are
        missing.
    """
    if engine is None and (repair or redraw):
        raise InputError("repairing and redrawing need an engine, but none is given", key="engine")
    Store.open(path)
    with locked(Path(path), "store"):
        store = Store.open(path)
        first, last = store.range_of(rows)
        total = store.count(first, last)
        missing = (chunk for chunk in store.chunks(first, last) if not (store.path / chunk.key).exists())
        if sum(1 for _ in islice(missing, MAX_MISSING + 1)) > MAX_MISSING:
            raise InputError(
                f"at most {MAX_MISSING} of the {total} chunks of store {str(store.path)!r} may be missing: choose "
                "`rows`, or draw them with `mauvecl realise --resume`",
                key="rows",
            )
        faults = list(_faults_of_description(store, repair))
        for number, chunk in enumerate(store.chunks(first, last), 1):
            fault = _fault(store, chunk, engine, repair, redraw)
            faults += [] if fault is None else [fault]
            if progress is not None:
                progress(number, total)
        if repair:
            store.sort_digests()
        faults += [Fault(key, "not of this store", False) for key, belongs in store.files() if not belongs]
    return faults


def _fault(store: Store, chunk: Chunk, engine: Engine | Pool | None, repair: bool, redraw: bool) -> Fault | None:
    """Check a chunk, if `redraw` by drawing it again; `repair` a faulty one, and return its fault, if any."""
    fault = state(store, chunk)
    if fault == "good" and not redraw:
        return None
    if fault != "good" and not repair:
        return Fault(chunk.key, fault, False)
    assert engine is not None
    rows = draw(store.study, chunk.scene, engine, chunk.start, chunk.stop - chunk.start)
    drawn = digest(*store.encode(chunk, rows))
    if store.digests.get(chunk.key, drawn) != drawn and not redraw:
        raise InputError(
            f"{chunk.key} of {store.path.name} was written with the digest {store.digests[chunk.key]}, but is drawn "
            f"with {drawn}: its study or its list is wrong; use `redraw=True` with `repair=True` to trust the study",
            key="redraw",
        )
    if fault == "good":
        if drawn == store.digests[chunk.key]:
            return None
        fault = "differs"
    if repair:
        store.write(chunk, rows)
    return Fault(chunk.key, fault, repair)


#: Attributes of a star that stores of earlier versions do not have.
LATER_ATTRIBUTES = ("instrument", "saturation_dn", "dark_unit", "temperature_c")
#: Words of version 2.0.0, which described every instrument as the nominal one.
FORMER = {"draws": f"r{DRAWS[1:-1]}", "throughput": "the throughput is nominal, not a flight calibration"}
#: Attributes in which stores of version 1 state the study and the instrument by other defaults and names.
OTHERWISE_IN_VERSION_1 = ("study", "study_sha256", "instrument", "provenance")


def _faults_of_description(store: Store, repair: bool) -> Iterator[Fault]:
    """Compare groups, descriptions of arrays and calibration with those of the study."""
    ignored = ("mauvecl", *(OTHERWISE_IN_VERSION_1 if store.of_version_1 else ()))

    def without(description: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
        attributes = description.get("attributes", {})
        return description | {"attributes": {key: value for key, value in attributes.items() if key not in names}}

    for name, content in sorted(store.description().items()):
        file = store.path / name
        fault = "damaged" if file.exists() else "missing"
        try:
            data = read_bytes(file, "description")
            if name.endswith("zarr.json"):
                stated = json.loads(data)
                former = (key for key, words in FORMER.items() if stated.get("attributes", {}).get(key) == words)
                names = (*ignored, *former)
                existing, expected = (without(description, names) for description in (stated, json.loads(content)))
                fault = "good" if existing in (expected, without(expected, LATER_ATTRIBUTES)) else "foreign"
            elif data == content:
                fault = "good"
        except (ValueError, TypeError, AttributeError, RecursionError):
            pass
        if fault != "good":
            if repair:
                write_whole(file, content)
            yield Fault(name, fault, repair)


@validated
def read(path: str | Path, scene: str = "star-1/quiescent") -> Any:
    """Open an array of spectra, which is read from disk on access.

    The array has a path such as ``"star-1/flare-2"``.

    Returns
    -------
    xarray.DataArray, dimensions (realisation, pixel) or (realisation, frame, pixel)
        Raw DN, with the wavelengths, nm, as a coordinate. ``.values`` is a NumPy array, also of a slice.
    """
    import xarray

    store = Store.open(path)
    stored = store.scene(scene)
    group = xarray.open_zarr(store.path, group=stored.group, chunks=None, consolidated=False)
    data = group[stored.name].assign_coords(wavelength=group["wavelength_nm"])
    return data if stored.frames is None else data.assign_coords(frame=group["frame"])


#: Largest size of the spectra in a file, bytes; larger sets belong in a store.
MAX_BYTES = 4 * 2**30
#: Accepted endings of file names.
ENDINGS = (".fits", ".h5", ".hdf5")


@dataclass(frozen=True, eq=False)
class Selection:
    """Arrays and rows of a store."""

    store: Store
    scenes: Sequence[StoredScene]
    first: int
    stop: int

    @classmethod
    def of(cls, store: Store, scenes: Sequence[str] | None = None, rows: tuple[int, int] | None = None) -> Selection:
        """Select arrays and rows of a store; the default is everything.

        Parameters
        ----------
        store : Store
        scenes : sequence of str, optional
            Paths such as ``"star-1/flare-2"``.
        rows : (int, int), optional
            Half-open range of realisations.

        Raises
        ------
        InputError
            For an unknown array, an invalid range, a size above `MAX_BYTES`, or missing chunks.
        """
        first, stop = store.range_of(rows)
        chosen = [store.scene(name) for name in scenes] if scenes else store.scenes
        selection = cls(store, chosen, first, stop)
        size = sum((stop - first) * scene.row_bytes for scene in chosen)
        if size > MAX_BYTES:
            raise InputError(
                f"one file may hold {MAX_BYTES // 2**30} GiB, but the spectra have {size / 2**30:.1f} GiB: choose rows",
                key="rows",
            )
        for chunk in store.chunks(first, stop):
            if any(chunk.scene is s for s in chosen) and not store.has(chunk):
                raise InputError(
                    f"{chunk.key} is missing: use `mauvecl realise --resume` to complete the store", key="store"
                )
        return selection

    def rows(self, scene: StoredScene) -> NDArray[Any]:
        """Read the spectra of an array."""
        import zarr

        folder = self.store.path / scene.path
        check_folder(folder, "file")
        with parsing(f"array {scene.path} of store {str(self.store.path)!r}", "use `mauvecl verify` to check it"):
            rows = np.asarray(zarr.open_array(folder, mode="r")[self.first : self.stop])
        if rows.shape != (self.stop - self.first, *scene.row) or rows.dtype != scene.dtype:
            raise InputError(
                f"array {scene.path} has the shape {rows.shape} and the type {rows.dtype}, but its study needs "
                f"{(self.stop - self.first, *scene.row)} and {scene.dtype}",
                key="store",
            )
        return rows


@validated
def export(selection: Selection, path: str | Path, *, replace: bool = False) -> Path:
    """Write spectra, calibration and origin to a file, atomically.

    Parameters
    ----------
    selection : Selection
    path : str or Path
        File name ending in .fits, .h5 or .hdf5. A FITS file has an image per array, whose spectral axis refers to a
        table of wavelengths (-TAB, FITS standard, section 8.3), and a table of the calibration per star.
    replace : bool
        Whether to replace an existing file.

    Raises
    ------
    InputError
        For another ending, or if the file exists or cannot be written.
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise InputError.of("file", path.name, f"a name ending in {', '.join(ENDINGS)}")
    if path.exists() and not (replace and path.is_file()):
        remedy = "another name, or `replace=True`" if path.is_file() else "the name of a file"
        raise InputError(f"export {str(path)!r} exists already: use {remedy}", key="file")
    # Written to memory first, because the HDF5 library aborts the process on a full disk.
    content = io.BytesIO()
    if path.suffix == ".fits":
        _fits(selection).writeto(content, checksum=True)
    else:
        _hdf5(selection, content)
    write_whole(path, content.getbuffer(), shared=True)
    return path


def _fits(selection: Selection) -> HDUList:
    """Return a selection as FITS: an image for each scene, a table of pixels for each group, and the study."""
    from astropy.io import fits

    store = selection.store
    primary = fits.PrimaryHDU()
    primary.header["ORIGIN"] = (f"mauvecl {VERSION}", "simulated, not observed")
    primary.header["SEED"] = (str(store.study.run.seed), "of the random numbers")
    primary.header["FIRSTROW"] = (selection.first, "realisation of the first row of each image")
    for line in store.remarks.values():
        primary.header["COMMENT"] = header_text(line)
    primary.header["HISTORY"] = "The table STUDY holds the study that gives these spectra again."
    extensions: list[ImageHDU | BinTableHDU] = []
    for group in dict.fromkeys(scene.group for scene in selection.scenes):
        scenes = [scene for scene in selection.scenes if scene.group == group]
        x, n = scenes[0].expectation, scenes[0].expectation.wavelength_nm.size
        # The -TAB axis requires all wavelengths in one cell, of shape (1, n_pixel): one row, whose columns are vectors.
        columns = [fits.Column("COORDS", f"{n}D", unit="nm", dim=f"(1,{n})", array=x.wavelength_nm.reshape(1, n, 1))]
        for key, unit in CALIBRATION.items():
            unit = unit.replace("DN", "adu").replace(" ", "")
            columns.append(fits.Column(key.upper(), f"{n}D", unit=unit, array=getattr(x, key).reshape(1, n)))
        name = f"{group}-calibration".upper().replace("-", "_")
        table = fits.BinTableHDU.from_columns(columns, name=name)
        extensions += [*(_image(selection, scene, table.name) for scene in scenes), table]
    # Its lines may exceed the 72 characters of a card. FITS is restricted to ASCII; TOML strings accept escapes.
    text = re.sub(r"[^\x00-\x7f]", lambda letter: f"\\U{ord(letter[0]):08X}", store.study.toml())
    lines = text.splitlines()
    column = fits.Column("LINE", f"{max(map(len, lines))}A", array=lines)
    return fits.HDUList([primary, *extensions, fits.BinTableHDU.from_columns([column], name="STUDY")])


def _image(selection: Selection, scene: StoredScene, table: str) -> ImageHDU:
    """Return the FITS image of a scene, whose header names the table of its pixels."""
    from astropy.io import fits

    x = scene.expectation
    hdu = fits.ImageHDU(selection.rows(scene), name=scene.path.upper().replace("/", "_"))
    header = hdu.header
    header["BUNIT"] = "adu"
    header["OBJECT"] = header_text(scene.star)
    header["AMPLITUD"] = (scene.amplitude, "flare amplitude, 0 without a flare")
    header["EXPTIME"] = (x.frame_s if scene.frames is not None else x.exposure_s, "[s] of one row")
    header["TELAPSE"] = (x.exposure_s, "[s] of one realisation")
    header["INSTRUME"] = header_text(x.instrument)
    header["SATURATE"] = (float(x.saturation_dn), "[adu] of a single frame, with bias")
    header["DARKUNIT"] = (x.dark_unit, "in which dark counts follow Poisson's law")
    if "temperature_c" in x.conditions:
        header["CCD-TEMP"] = (x.conditions["temperature_c"], "[Celsius] of the mean")
    header["NFRAMES"] = (1 if scene.frames is not None else x.n_frames, "frames summed in one row")
    # Axis 1 is the vacuum wavelength, by pixel from the calibration table.
    header["CTYPE1"], header["CUNIT1"] = "WAVE-TAB", "nm"
    header["CRPIX1"], header["CRVAL1"], header["CDELT1"] = 1.0, 1.0, 1.0
    header["PS1_0"] = (table, "extension of the coordinates")
    header["PS1_1"] = ("COORDS", "column of the coordinates")
    header["PV1_1"], header["PV1_2"], header["PV1_3"] = 1, 1, 1
    for number, name in enumerate(scene.dimensions[-2::-1], 2):
        first = float(selection.first if name == "realisation" else 0)
        header[f"CTYPE{number}"], header[f"CNAME{number}"] = "LINEAR", name
        header[f"CRPIX{number}"], header[f"CRVAL{number}"], header[f"CDELT{number}"] = 1.0, first, 1.0
    if scene.frames is not None:
        header["FRAMES"] = (",".join(map(str, scene.frames)), "numbers of the frames along axis 2")
    return hdu


def _hdf5(selection: Selection, content: io.BytesIO) -> None:
    """Write a selection as HDF5; raises InputError without h5py."""
    try:
        import h5py
    except ImportError as error:
        raise missing_package("h5py", "an HDF5 file", "bulk") from error

    store = selection.store
    with h5py.File(content, "w") as file:
        file.attrs.update({"mauvecl": VERSION, "study": store.study.toml(), "seed": str(store.study.run.seed)})
        file.attrs.update({"first_row": selection.first} | store.remarks)
        for scene in selection.scenes:
            group = file.require_group(scene.group)
            if "wavelength_nm" not in group:
                group.attrs.update({"star": scene.star} | exposure_attributes(scene.expectation))
                if scene.frames is not None:
                    group["frame"] = np.array(scene.frames)
                for name, unit in CALIBRATION.items():
                    group[name] = getattr(scene.expectation, name)
                    group[name].attrs["units"] = unit
                group["wavelength_nm"].make_scale("wavelength")
            data = group.create_dataset(scene.name, data=selection.rows(scene), fletcher32=True, chunks=True)
            data.attrs.update({"units": "DN", "amplitude": scene.amplitude})
            for dimension, name in zip(data.dims, scene.dimensions, strict=True):
                dimension.label = name
            data.dims[data.ndim - 1].attach_scale(group["wavelength_nm"])
