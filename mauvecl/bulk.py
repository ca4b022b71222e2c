"""Raw spectra in bulk: what is missing of a store is drawn and written; what is damaged is found and mended."""

from __future__ import annotations

import json
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.durable import UNFINISHED, alone, write_whole
from mauvecl.host.errors import InputError
from mauvecl.pool import Pool, together
from mauvecl.store import CRC_BYTES, DIGESTS, Chunk, Scene, Store, crc, digest
from mauvecl.study import Study

if TYPE_CHECKING:
    from mauvecl.engine import Engine

Progress = Callable[[int, int], None]

#: Chunks drawn in one go, and threads that write while the next are drawn.
TOGETHER, WRITERS = 4, 2


def draw(
    study: Study, scene: Scene, engine: Engine | Pool, start: int, count: int, out: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Rows of one array, from the engine alone.

    Parameters
    ----------
    study : Study
        Its seed, mode, recipe and processes.
    scene : Scene
    engine : Engine or Pool
    start, count : int
        Realisations start to start + count - 1.
    out : ndarray, shape (count, *scene.row), optional
        Where to write.

    Returns
    -------
    ndarray of uint16 or int32, shape (count, n_pixel), or (count, n_frame, n_pixel) where frames are kept apart
        Raw DN.
    """
    how = study.drawing | {"start": start, "count": count, "seed": study.run.seed}
    if scene.frames is None:
        return engine.realise(scene.expectation, out=out, **how)
    found = np.empty((count, *scene.row), scene.dtype) if out is None else out
    single = replace(scene.expectation, n_frames=1)
    for place, frame in enumerate(scene.frames):
        found[:, place] = engine.realise(single, first_frame=frame, **how)
    return found


def realise(
    study: Study, path: str | Path, engine: Engine | Pool, *, resume: bool = True, progress: Progress | None = None
) -> Store:
    """Draw a study's spectra into a store, or what is missing of it.

    Parameters
    ----------
    study : Study
        Its ``run.realisations`` are the rows of each array; its ``bulk`` says what is kept.
    path : str or Path
        A new folder, or the store of the same study that was begun before.
    engine : Engine or Pool
    resume : bool
        Whether a store that was begun before is continued, or refused.
    progress : callable, optional
        Called as ``progress(done, total)`` in spectra. It may raise to stop the work; what was written is kept.

    Raises
    ------
    InputError
        If the place holds something else or is being written by another process, or cannot be written.
    """
    store = Store(Path(path), study)
    begun = (store.path / "zarr.json").exists()
    with ExitStack() as stack:
        if begun:
            stack.enter_context(alone(store.path, "store"))
        store.make()
        if not begun:
            stack.enter_context(alone(store.path, "store"))
        todo = [chunk for chunk in store.chunks() if not store.has(chunk)]
        if begun and not resume and todo:
            every = sum(1 for _ in store.chunks())
            raise InputError(
                f"store {str(store.path)!r} holds {every - len(todo)} of {every} chunks, expected --resume to draw the "
                "others, or another place"
            )
        _fill(store, todo, engine, progress)
    return store


def forget(path: str | Path) -> None:
    """Remove a store.

    Raises
    ------
    InputError
        If something else is there.
    """
    path = Path(path)
    if path.exists():
        Store.open(path)
        shutil.rmtree(path)


def _fill(store: Store, todo: list[Chunk], engine: Engine | Pool, progress: Progress | None) -> None:
    total = store.rows * len(store.scenes)
    done = total - sum(chunk.stop - chunk.start for chunk in todo)
    if progress is not None:
        progress(done, total)
    waiting: deque[tuple[Chunk, Future[str]]] = deque()

    def collect(left: int) -> None:
        nonlocal done
        while len(waiting) > left:
            chunk, placed = waiting.popleft()
            store.note(chunk, placed.result())
            done += chunk.stop - chunk.start
            if progress is not None:
                progress(done, total)

    with ThreadPoolExecutor(WRITERS) as writers:
        try:
            for block, rows in _drawn(store.study, todo, engine):
                # The block before has left its buffer when none of its chunks wait.
                collect(0)
                for chunk in block:
                    part = rows[chunk.start - block[0].start : chunk.stop - block[0].start]
                    waiting.append((chunk, writers.submit(store.place, chunk, part)))
            collect(0)
        except BaseException:
            # What is being written is finished and listed; the rest is left for a resume.
            for _, placed in waiting:
                placed.cancel()
            writers.shutdown()
            for chunk, placed in waiting:
                if not placed.cancelled() and placed.exception() is None:
                    store.note(chunk, placed.result())
            raise


def _drawn(study: Study, todo: Sequence[Chunk], engine: Engine | Pool) -> Iterator[tuple[list[Chunk], NDArray[Any]]]:
    """Blocks of neighbouring chunks and their rows, in order."""
    if isinstance(engine, Pool) and engine.workers.count > 1:
        # Chunk by chunk: as much as travels well.
        def rows_of(block: list[Chunk]) -> NDArray[Any]:
            return draw(study, block[0].scene, engine, block[0].start, block[0].stop - block[0].start)

        blocks = list(_blocks(todo, 1))
        yield from zip(blocks, together(engine, rows_of, blocks), strict=True)
        return
    # Two buffers in turn: one is drawn into while the other is written, so that memory stays flat.
    buffers: list[NDArray[Any]] = [np.empty(0)] * 2
    for number, block in enumerate(_blocks(todo, TOGETHER)):
        scene, count = block[0].scene, block[-1].stop - block[0].start
        there = buffers[number % 2]
        if there.shape[1:] != scene.row or there.dtype != scene.dtype or len(there) < count:
            there = buffers[number % 2] = np.empty((count, *scene.row), scene.dtype)
        yield block, draw(study, scene, engine, block[0].start, count, there[:count])


def _blocks(chunks: Sequence[Chunk], most: int) -> Iterator[list[Chunk]]:
    """Neighbouring chunks of one scene, several at a time."""
    block: list[Chunk] = []
    for chunk in chunks:
        if block and (len(block) == most or chunk.scene is not block[0].scene or chunk.start != block[-1].stop):
            yield block
            block = []
        block.append(chunk)
    if block:
        yield block


@dataclass(frozen=True)
class Fault:
    """One file of a store that is not as it should be.

    Attributes
    ----------
    key : str
        Its place in the store.
    state : str
        ``missing``; ``damaged``: its CRC or its text fails; ``foreign``: whole, but not what was written; ``unlisted``:
        whole, but not in the list of digests; ``differs``: not what the engine draws; or ``not of this store``.
    mended : bool
    """

    key: str
    state: str
    mended: bool


def state(store: Store, chunk: Chunk) -> str:
    """``good``, or what a chunk's bytes show to be wrong; see `Fault`."""
    try:
        data = (store.path / chunk.key).read_bytes()
    except FileNotFoundError:
        return "missing"
    if len(data) != store.chunk_bytes(chunk) or crc(data[:-CRC_BYTES]) != data[-CRC_BYTES:]:
        return "damaged"
    known = store.digests.get(chunk.key)
    if known is None:
        return "unlisted"
    return "good" if digest(data) == known else "foreign"


def verify(
    path: str | Path,
    engine: Engine | Pool | None = None,
    *,
    repair: bool = False,
    redraw: bool = False,
    rows: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> list[Fault]:
    """Look at every file of a store; draw again what is wrong, or everything.

    Parameters
    ----------
    path : str or Path
    engine : Engine or Pool, optional
        Needed to repair or redraw.
    repair : bool
        Write what is wrong anew.
    redraw : bool
        Compare every spectrum with what the engine draws, not only with its digest.
    rows : (int, int), optional
        Look only at chunks with realisations of this half-open range.
    progress : callable, optional
        Called as ``progress(done, total)`` in chunks.

    Returns
    -------
    list of Fault
        Empty where everything is as it was written.

    Raises
    ------
    InputError
        If the folder is no store, is being written, or cannot be written to repair it.
    """
    if engine is None and (repair or redraw):
        raise InputError("no engine is given, expected one to repair or redraw")
    store = Store.open(path)
    with alone(store.path, "store"):
        found = list(_faults_of_description(store, repair))
        every = list(store.chunks())
        first, last = rows or (0, store.rows)
        if not 0 <= first < last <= store.rows:
            raise InputError(f"rows {first}:{last}, expected a range within 0:{store.rows}")
        seen = [chunk for chunk in every if chunk.stop > first and chunk.start < last]
        for number, chunk in enumerate(seen):
            fault = _fault(store, chunk, engine, repair, redraw)
            if fault is not None:
                found.append(fault)
            if progress is not None:
                progress(number + 1, len(seen))
        expected = {chunk.key for chunk in every}
        found += [Fault(key, "not of this store", False) for key in _strangers(store, expected)]
    return found


def _fault(store: Store, chunk: Chunk, engine: Engine | Pool | None, repair: bool, redraw: bool) -> Fault | None:
    seen = state(store, chunk)
    if seen == "good" and not redraw:
        return None
    if seen != "good" and not repair:
        return Fault(chunk.key, seen, False)
    assert engine is not None
    rows = draw(store.study, chunk.scene, engine, chunk.start, chunk.stop - chunk.start)
    drawn = digest(*store.encode(chunk, rows))
    if seen == "good":
        if drawn == store.digests[chunk.key]:
            return None
        seen = "differs"
    if repair:
        if seen != "unlisted" or digest((store.path / chunk.key).read_bytes()) != drawn:
            store.place(chunk, rows)
        store.note(chunk, drawn)
    return Fault(chunk.key, seen, repair)


def _faults_of_description(store: Store, repair: bool) -> Iterator[Fault]:
    """Groups, arrays' descriptions and calibration, beside what the study makes them."""
    for name, content in sorted(store.description().items()):
        there = store.path / name
        try:
            data = there.read_bytes()
            if name.endswith("zarr.json"):
                same, seen = json.loads(data) == json.loads(content), "foreign"
            else:
                same, seen = data == content, "damaged"
        except FileNotFoundError:
            same, seen = False, "missing"
        except ValueError:
            same, seen = False, "damaged"
        if not same:
            if repair:
                write_whole(there, content)
            yield Fault(name, seen, repair)


def _strangers(store: Store, expected: set[str]) -> Iterator[str]:
    """Files among the chunks that no chunk has."""
    for scene in store.scenes:
        for path in sorted((store.path / scene.path).rglob("*")):
            key = str(path.relative_to(store.path))
            own = path.name in (DIGESTS, "zarr.json") or path.name.startswith(UNFINISHED)
            if path.is_file() and key not in expected and not own:
                yield key


def read(path: str | Path, scene: str = "star-1/quiescent") -> Any:
    """The spectra of one array, read from the disk when looked at.

    Parameters
    ----------
    path : str or Path
    scene : str
        Such as ``"star-1/flare-2"``.

    Returns
    -------
    xarray.DataArray, dimensions (realisation, pixel) or (realisation, frame, pixel)
        Raw DN, with the wavelengths, nm, as a coordinate. NumPy's array is its ``.values``, also of a slice.

    Raises
    ------
    InputError
        If the folder is no store, or holds no such array.
    """
    import xarray

    store = Store.open(path)
    there = store.scene(scene)
    group = xarray.open_zarr(store.path, group=there.group, chunks=None, consolidated=False)
    found = group[there.name].assign_coords(wavelength=group["wavelength_nm"])
    return found if there.frames is None else found.assign_coords(frame=group["frame"])
