"""Raw spectra in bulk: drawing, verification and reading."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.device.launches import Progress
from mauvecl.host.arrays import map_in_threads
from mauvecl.host.tables.files import UNFINISHED, check_size, read_bytes, write_whole
from mauvecl.runs.checkpoint import locked
from mauvecl.runs.export import Selection, export
from mauvecl.runs.pool import PREPARED, Pool
from mauvecl.runs.store import (
    CRC_BYTES,
    LATER_ATTRIBUTES,
    OTHERWISE_IN_VERSION_1,
    Chunk,
    Store,
    StoredScene,
    crc,
    digest,
    without,
)
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import FirstRealisation, Realisations
from mauvecl.study.cases import Case
from mauvecl.study.study import Study

if TYPE_CHECKING:
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
    how = Case(study).draw_options | {"start": start, "count": count, "seed": study.run.seed}
    if scene.frames is None:
        return engine.realise(scene.expectation, out=out, **how)
    rows = np.empty((count, *scene.row), scene.dtype) if out is None else out
    single = replace(scene.expectation, n_frames=1)
    for place, frame in enumerate(scene.frames):
        rows[:, place] = engine.realise(single, first_frame=frame, **how)
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
        begun = (store.path / "zarr.json").exists()
        store.make()
        todo = [chunk for chunk in store.chunks() if not store.has(chunk)]
        if begun and not resume and todo:
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
    """Remove a store.

    Raises InputError, without removing anything, if the folder contains other files or another process is writing it.
    """
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


#: Columns of the table of faults.
FAULT_COLUMNS = (
    Column("key", heading="file"),
    Column("state", heading="what"),
    Column("mended", heading="repaired", format=lambda mended: "repaired" if mended else ""),
)


@validated
def state(store: Store, chunk: Chunk) -> str:
    """Return ``good``, or the fault of a chunk's file; see `Fault`."""
    place, size = store.path / chunk.key, chunk.n_bytes
    if not place.exists():
        return "missing"
    try:
        data = read_bytes(place, "chunk") if check_size(place, "chunk") == size else b""
    except InputError:
        # Too large, or no regular file.
        return "damaged"
    if len(data) != size or crc(data[:-CRC_BYTES]) != data[-CRC_BYTES:]:
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
        faults += [Fault(key, "not of this store", False) for key, own in store.files() if not own]
    return faults


def _fault(store: Store, chunk: Chunk, engine: Engine | Pool | None, repair: bool, redraw: bool) -> Fault | None:
    seen = state(store, chunk)
    if seen == "good" and not redraw:
        return None
    if seen != "good" and not repair:
        return Fault(chunk.key, seen, False)
    assert engine is not None
    rows = draw(store.study, chunk.scene, engine, chunk.start, chunk.stop - chunk.start)
    drawn = digest(*store.encode(chunk, rows))
    if store.digests.get(chunk.key, drawn) != drawn and not redraw:
        raise InputError(
            f"{chunk.key} of {store.path.name} was written with the digest {store.digests[chunk.key]}, but is drawn "
            f"with {drawn}: its study or its list is wrong; use `redraw=True` with `repair=True` to trust the study",
            key="redraw",
        )
    if seen == "good":
        if drawn == store.digests[chunk.key]:
            return None
        seen = "differs"
    if repair:
        store.write(chunk, rows)
    return Fault(chunk.key, seen, repair)


def _faults_of_description(store: Store, repair: bool) -> Iterator[Fault]:
    """Compare groups, descriptions of arrays and calibration with those of the study."""
    left_out = ("mauvecl", *(OTHERWISE_IN_VERSION_1 if store.of_version_1 else ()))
    for name, content in sorted(store.description().items()):
        there = store.path / name
        try:
            data = read_bytes(there, "description")
            if name.endswith("zarr.json"):
                existing, made = (without(json.loads(text), left_out) for text in (data, content))
                same, seen = existing in (made, without(made, LATER_ATTRIBUTES)), "foreign"
            else:
                same, seen = data == content, "damaged"
        except (ValueError, TypeError, AttributeError, RecursionError):
            same, seen = False, "damaged" if there.exists() else "missing"
        if not same:
            if repair:
                write_whole(there, content)
            yield Fault(name, seen, repair)


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
    there = store.scene(scene)
    group = xarray.open_zarr(store.path, group=there.group, chunks=None, consolidated=False)
    data = group[there.name].assign_coords(wavelength=group["wavelength_nm"])
    return data if there.frames is None else data.assign_coords(frame=group["frame"])
