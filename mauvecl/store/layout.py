"""Layout of a store of raw spectra: a Zarr v3 hierarchy, its chunks and their digests.

A group per star holds an array per scene (``quiescent``, ``flare-1``, ...) with one row per realisation, and the
calibration of its pixels. Each chunk ends with a CRC, which every Zarr reader checks. A list of digests next to each
array distinguishes its chunks from foreign ones. Chunks are written atomically.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.atomic import UNFINISHED, write_whole, writing
from mauvecl.host.files.parsing import toml
from mauvecl.host.files.size_limits import read_bytes
from mauvecl.runs.locks import differing_keys
from mauvecl.schema.errors import InputError
from mauvecl.store.description import describe, study_in
from mauvecl.store.stored_scenes import StoredScene, scenes
from mauvecl.study.cases import cases
from mauvecl.study.study import Study

if TYPE_CHECKING:
    pass

DIGESTS = "digests.txt"
CRC_BYTES = 4


@dataclass(frozen=True, eq=False)
class Chunk:
    """A chunk of a scene: rows `start` to `stop - 1` of its array."""

    scene: StoredScene
    number: int
    start: int
    stop: int

    @property
    def name(self) -> str:
        """Path of the file in the array's folder."""
        return "/".join(["c", str(self.number), *["0"] * len(self.scene.row)])

    @property
    def key(self) -> str:
        """Path of the file in the store."""
        return f"{self.scene.path}/{self.name}"


@dataclass(eq=False)
class Store:
    """A store and its study, whose ``run.realisations`` is the number of rows of each array."""

    path: Path
    study: Study
    digests: dict[str, str] = field(default_factory=dict)  # of written chunks, by path

    def __post_init__(self) -> None:
        missing = [name for name in ("zarr", "xxhash", "google_crc32c") if find_spec(name) is None]
        if missing:
            raise InputError(
                f"{missing[0]} is missing", "the packages for stores: pip install 'mauvecl[bulk]'", key=missing[0]
            )

    @classmethod
    def open(cls, path: str | Path) -> Store:
        """Open an existing store.

        Raises InputError if the folder is not a store, no copy of its study is intact, or intact copies contradict each
        other.
        """
        path = Path(path)
        copies: dict[str, Path] = {}
        for place in (path / "zarr.json", *sorted(path.glob("*/*/zarr.json"))):
            text = study_in(place)
            if text is not None:
                copies.setdefault(text, place.relative_to(path))
        if not copies:
            raise InputError(
                f"{str(path)!r} is not a store of spectra",
                "a folder that `mauvecl realise` wrote, with an intact copy of its study",
                key="store",
                value=str(path),
            )
        (text, first), *others = copies.items()
        if others:
            other, second = others[0]
            keys = ", ".join(differing_keys(toml(text, path.name), toml(other, path.name)))
            raise InputError(
                f"store {str(path)!r} holds two studies, {str(first)!r} and {str(second)!r} differ in {keys}",
                "one study: restore the file of the correct one",
                key="store",
                value=keys,
            )
        store = cls(path, Study.build(toml(text, path.name), path.name))
        store.read_digests()
        return store

    @cached_property
    def scenes(self) -> list[StoredScene]:
        """Arrays of spectra."""
        return scenes(cases(self.study))

    def scene(self, path: str) -> StoredScene:
        """Return an array by path, such as ``star-1/flare-2``."""
        known = next((scene for scene in self.scenes if scene.path == path), None)
        if known is None:
            raise InputError.of("scenes", path, f"one of {', '.join(s.path for s in self.scenes)}")
        return known

    @property
    def rows(self) -> int:
        """Number of realisations of each array."""
        return self.study.run.realisations

    @property
    def n_bytes(self) -> int:
        """Size of all spectra, bytes."""
        return sum(self.rows * scene.row_bytes for scene in self.scenes)

    def chunks(self, first: int = 0, stop: int | None = None) -> Iterator[Chunk]:
        """Yield the chunks of all scenes that contain rows `first` to `stop - 1`; all chunks by default."""
        for scene in self.scenes:
            rows = scene.chunk_rows(self.rows)
            for number in self._numbers(scene, first, stop):
                yield Chunk(scene, number, number * rows, min((number + 1) * rows, self.rows))

    def count(self, first: int = 0, stop: int | None = None) -> int:
        """Return the number of chunks that `chunks` yields, without iterating."""
        return sum(len(self._numbers(scene, first, stop)) for scene in self.scenes)

    def _numbers(self, scene: StoredScene, first: int = 0, stop: int | None = None) -> range:
        rows = scene.chunk_rows(self.rows)
        return range(first // rows, -(-(self.rows if stop is None else stop) // rows))

    def make(self) -> None:
        """Write the description of the arrays, or check that an existing one is the same.

        Raises InputError if the store exists and is another study's (the message lists keys that differ), or cannot be
        written.
        """
        root = self.path / "zarr.json"
        if root.exists():
            self._check_same()
            self.read_digests()
            return
        self.make_folder()
        ours = {scene.group for scene in self.scenes}
        other = [p.name for p in self.path.iterdir() if p.name not in ours and not p.name.startswith(UNFINISHED)]
        if other:
            raise InputError(
                f"{str(self.path)!r} holds {min(other)!r} and no store",
                "an empty or a new folder",
                key="store",
                value=min(other),
            )
        # The root comes last, so that its presence means that the description is complete.
        made = self.description()
        for name in sorted(made, key=lambda name: name == root.name):
            write_whole(self.path / name, made[name])

    def make_folder(self) -> None:
        """Make the folder if needed; raises InputError if its file system is smaller than the spectra."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            room = shutil.disk_usage(self.path).total
        except OSError as error:
            raise InputError(
                f"store {str(self.path)!r} cannot be made ({error.strerror})",
                "a writable folder",
                key="store",
                value=str(self.path),
            ) from error
        if self.n_bytes > room:
            raise InputError(
                f"spectra of {self.n_bytes / 2**30:.4g} GiB for {str(self.path)!r}",
                f"less than its disk's {room / 2**30:.4g} GiB",
                key="run.realisations",
                value=self.n_bytes,
            )

    def description(self) -> dict[str, bytes]:
        """Return the content of every file except spectra, by path."""
        with tempfile.TemporaryDirectory() as folder:
            describe(self.study, self.scenes, Path(folder))
            files = [p for p in Path(folder).rglob("*") if p.is_file()]
            return {str(p.relative_to(folder)): p.read_bytes() for p in files}

    def _check_same(self) -> None:
        there = Store.open(self.path).study
        differing = differing_keys(self.study.model_dump(mode="json"), there.model_dump(mode="json"))
        if differing:
            raise InputError(
                f"store {str(self.path)!r} was started by another study, which differs in {', '.join(differing)}",
                "the same study or another place",
                key="store",
                value=differing,
            )

    def read_digests(self) -> None:
        """Read the digests of written chunks; incomplete lines are ignored."""
        self.digests = {}
        for scene in self.scenes:
            try:
                text = read_bytes(self.path / scene.path / DIGESTS, "list of digests").decode(errors="replace")
            except InputError:
                continue
            for line in text.splitlines():
                name, _, rest = line.partition(" ")
                written, _, check = rest.partition(" ")
                if check == _check(name, written):
                    self.digests[f"{scene.path}/{name}"] = written

    def note(self, chunk: Chunk, digest_text: str) -> None:
        """Add a chunk's digest to its array's list."""
        self.digests[chunk.key] = digest_text
        line = _line(chunk.name, digest_text)
        what = f"{chunk.scene.path}/{DIGESTS} of {self.path.name}"
        # A single short write at the end. A line that a full disk cut short is terminated first.
        with (
            writing(what, self.path, "a writable disk with room; what was written before is kept", key="store"),
            (self.path / chunk.scene.path / DIGESTS).open("a+b", buffering=0) as file,
        ):
            file.seek(0, 2)
            if file.tell():
                file.seek(-1, 2)
                line = line if file.read(1) == b"\n" else "\n" + line
            file.write(line.encode())

    def sort_digests(self) -> None:
        """Write the lists of digests in the order of their chunks, which may have been written in another."""
        for scene in self.scenes:
            place = self.path / scene.path / DIGESTS
            keys = sorted(
                (key for key in self.digests if key.startswith(f"{scene.path}/c/")),
                key=lambda key: int(key.removeprefix(f"{scene.path}/c/").partition("/")[0]),
            )
            names = [(key.removeprefix(f"{scene.path}/"), self.digests[key]) for key in keys]
            text = "".join(_line(name, digest_text) for name, digest_text in names).encode()
            if names and place.read_bytes() != text:
                write_whole(place, text)

    def encode(self, chunk: Chunk, rows: NDArray[Any]) -> tuple[memoryview, bytes]:
        """Encode a chunk by Zarr's codecs `bytes` and `crc32c`, padding the last chunk with zeros."""
        full = chunk.scene.chunk_rows(self.rows)
        if len(rows) < full:
            rows = np.concatenate([rows, np.zeros((full - len(rows), *chunk.scene.row), rows.dtype)])
        whole = np.ascontiguousarray(rows, chunk.scene.dtype)
        return memoryview(whole.data).cast("B"), crc(whole)

    def place(self, chunk: Chunk, rows: NDArray[Any]) -> str:
        """Write a chunk atomically and return its digest."""
        data, check = self.encode(chunk, rows)
        write_whole(self.path / chunk.key, data, check)
        return digest(data, check)

    def has(self, chunk: Chunk) -> bool:
        """Return whether a chunk was written, by digest list and file size; `bulk.state` checks its content."""
        try:
            size = (self.path / chunk.key).stat().st_size
        except OSError:
            return False
        return chunk.key in self.digests and size == self.chunk_bytes(chunk)

    def owns(self, key: str) -> bool:
        """Return whether a path in the store is that of a chunk."""
        scene = next((scene for scene in self.scenes if key.startswith(f"{scene.path}/c/")), None)
        number = key.removeprefix(f"{scene.path}/c/").partition("/")[0] if scene else ""
        # Twenty digits suffice for any chunk; int() of a very long name would be slow.
        if scene is None or not (number.isascii() and number.isdigit() and len(number) <= 20):
            return False
        return int(number) in self._numbers(scene) and key == Chunk(scene, int(number), 0, 0).key

    def files(self) -> Iterator[tuple[str, bool]]:
        """Yield every file and link in the folder, and whether it belongs to this store."""
        described = self.description()
        lists = {f"{scene.path}/{DIGESTS}" for scene in self.scenes}
        for folder, folders, names in os.walk(self.path):
            here = Path(folder).relative_to(self.path)
            linked = [name for name in folders if (Path(folder) / name).is_symlink()]
            for name in sorted([*names, *linked]):
                whole = str(here / name.removeprefix(UNFINISHED))
                yield str(here / name), whole in described or whole in lists or self.owns(whole)

    def clear(self) -> None:
        """Remove all files but not the folder; the study is last, so that an interrupted removal leaves a store.

        Raises InputError, without removing anything, if the folder contains other files.
        """
        files = list(self.files())
        other = [key for key, own in files if not own]
        if other:
            raise InputError(
                f"store {str(self.path)!r} holds {other[0]!r}, which does not belong to it",
                "no other files in a store that is removed",
                key="store",
                value=other[0],
            )
        for key, _ in sorted(files, key=lambda entry: entry[0] == "zarr.json"):
            (self.path / key).unlink(missing_ok=True)
        for folder, _, _ in os.walk(self.path, topdown=False):
            if folder != str(self.path):
                Path(folder).rmdir()
        self.digests = {}

    def chunk_bytes(self, chunk: Chunk) -> int:
        """Return the size of a chunk's file, bytes: rows and CRC."""
        return chunk.scene.chunk_rows(self.rows) * chunk.scene.row_bytes + CRC_BYTES


def crc(data: bytes | NDArray[Any]) -> bytes:
    """Return the CRC-32C in the format of Zarr's codec."""
    import google_crc32c

    return int(google_crc32c.value(data)).to_bytes(CRC_BYTES, "little")


def digest(*parts: bytes | memoryview) -> str:
    """Return the 128-bit XXH3 hash of concatenated parts."""
    import xxhash

    hashed = xxhash.xxh3_128()
    for part in parts:
        hashed.update(part)
    return hashed.hexdigest()


def _line(name: str, digest_text: str) -> str:
    """Return the line of a chunk in a list of digests."""
    return f"{name} {digest_text} {_check(name, digest_text)}\n"


def _check(*words: str) -> str:
    return digest(" ".join(words).encode())[:8]
