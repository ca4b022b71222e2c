"""Stores of raw spectra: Zarr v3 hierarchies, with their scenes, chunks and digests.

A group per star holds an array per scene (``quiescent``, ``flare-1``, ...) with one row per realisation, and the
calibration of its pixels. Each chunk ends with a CRC, which every Zarr reader checks. A list of digests next to each
array distinguishes its chunks from foreign ones. Chunks are written atomically.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host import VERSION
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.host.tables.files import NO_ROOM, UNFINISHED, read_bytes, toml, write_whole, writing
from mauvecl.runs.checkpoint import differing_keys
from mauvecl.schema.columns import Column, percent
from mauvecl.schema.errors import InputError, missing_package
from mauvecl.study.cases import cases, collect_messages, full_label
from mauvecl.study.study import Study, read_version

#: Units of the calibration per pixel and frame, which each star's group contains.
CALIBRATION = {
    "wavelength_nm": "nm",
    "bias_dn": "DN",
    "dark_dn": "DN",
    "read_noise_dn": "DN",
    "gain_dn_per_electron": "DN / electron",
}
#: How the rows of every store and file are drawn.
DRAWS = (
    "Row i of every array is drawn with the same random numbers, so that a flare is the only difference between two "
    "arrays; rows of different number are independent."
)


def _describe(root: Any, scene: StoredScene, study: Study) -> None:
    """Write the description of an array to its group, and with the quiescent array that of the star."""
    from zarr.codecs import Crc32cCodec

    x, group = scene.expectation, root.require_group(scene.group)

    def add(name: str, values: NDArray[Any], unit: str, dimension: str = "pixel") -> None:
        """Add an array of one value for each pixel, or each frame, to the group."""
        options: Any = {"chunks": values.shape, "compressors": [Crc32cCodec()], "dimension_names": [dimension]}
        group.create_array(name, data=values, **options).attrs["units"] = unit

    if scene.name == "quiescent":
        group.attrs.update({"star": scene.star, **scene.at})
        group.attrs.update(exposure_attributes(x) | {"messages": collect_messages([x])})
        for name, unit in CALIBRATION.items():
            add(name, np.asarray(getattr(x, name)), unit)
        if scene.frames is not None:
            add("frame", np.array(scene.frames), "", "frame")
    if study.bulk.components:
        n = x.n_frames if scene.frames is None else 1
        gain = n * x.gain_dn_per_electron
        for name, values in (
            ("source", gain * x.source_electrons),
            ("sky", gain * x.sky_electrons),
            *([("neighbours", gain * x.neighbour_electrons)] if x.neighbour_electrons.any() else []),
            ("noise", np.sqrt(x.variance_dn2 * n / x.n_frames)),
        ):
            add(f"{scene.name}-{name}", values, "DN")
    array = group.create_array(
        scene.name,
        shape=(scene.rows, *scene.row),
        chunks=(scene.chunk_rows, *scene.row),
        dtype=scene.dtype,
        compressors=[Crc32cCodec()],
        fill_value=0,
        dimension_names=scene.dimensions,
    )
    array.attrs.update({"star": scene.star, "provenance": dict(x.provenance), **signed(study.toml())})
    array.attrs.update({"units": "DN", "amplitude": scene.amplitude})


def exposure_attributes(x: Expectation) -> dict[str, float | str]:
    """Return the attributes that describe the exposure in every row of an array."""
    attributes: dict[str, float | str] = {"exposure_s": x.exposure_s, "frames": x.n_frames, "instrument": x.instrument}
    attributes |= {"saturation_dn": float(x.saturation_dn), "dark_unit": x.dark_unit}
    return attributes | ({"temperature_c": x.conditions["temperature_c"]} if "temperature_c" in x.conditions else {})


def signed(study: str) -> dict[str, str]:
    """Return a study's text and its digest, of which a store has several copies."""
    return {"study": study, "study_sha256": hashlib.sha256(study.encode()).hexdigest()}


#: Error of a store.
refusal = partial(InputError, key="store")
#: Approximate size of a chunk, bytes.
CHUNK_BYTES = 16 * 2**20


@dataclass(frozen=True, eq=False)
class StoredScene:
    """An array of a store: a star with or without a flare."""

    group: str
    name: str
    star: str
    amplitude: float
    expectation: Expectation
    frames: tuple[int, ...] | None
    at: Mapping[str, float | str]
    rows: int  # number of realisations

    @property
    def path(self) -> str:
        """Path in the store."""
        return f"{self.group}/{self.name}"

    @property
    def row(self) -> tuple[int, ...]:
        """Shape of one realisation: pixels, or frames and pixels."""
        n_pixel = self.expectation.wavelength_nm.size
        return (n_pixel,) if self.frames is None else (len(self.frames), n_pixel)

    @property
    def dimensions(self) -> list[str]:
        """Names of the array's dimensions."""
        return ["realisation", "pixel"] if self.frames is None else ["realisation", "frame", "pixel"]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of a value: 16 bits for single frames of a 16-bit ADC, 32 bits for sums."""
        x = self.expectation
        single = self.frames is not None or x.n_frames == 1
        return np.dtype("<u2" if single and x.adc_max_dn < 2**16 else "<i4")

    @property
    def row_bytes(self) -> int:
        """Size of a realisation, bytes."""
        return int(np.prod(self.row)) * self.dtype.itemsize

    @cached_property
    def chunk_rows(self) -> int:
        """Number of realisations per chunk."""
        return max(min(CHUNK_BYTES // self.row_bytes, self.rows), 1)

    def chunk_numbers(self, first: int = 0, stop: int | None = None) -> range:
        """Return the numbers of the chunks that contain rows `first` to `stop - 1`, by default of all."""
        return range(first // self.chunk_rows, -(-(self.rows if stop is None else stop) // self.chunk_rows))

    def chunk(self, number: int) -> Chunk:
        """Return a chunk by number."""
        start = number * self.chunk_rows
        name = "/".join(["c", str(number), *["0"] * len(self.row)])
        return Chunk(self, name, start, min(start + self.chunk_rows, self.rows))


ARRAY_COLUMNS = (
    Column("array", heading="array"),
    Column("star", heading="star"),
    Column("amplitude", heading="flare", format=percent("g")),
    Column("shape", heading="shape", format=lambda shape: " x ".join(map(str, shape))),
    Column("type", heading="type"),
)

DIGESTS = "digests.txt"
CRC_BYTES = 4


@dataclass(frozen=True, eq=False)
class Chunk:
    """A chunk of a scene: rows `start` to `stop - 1` of its array."""

    scene: StoredScene
    name: str  # path of the file in the array's folder
    start: int
    stop: int

    @property
    def key(self) -> str:
        """Path of the file in the store."""
        return f"{self.scene.path}/{self.name}"

    @property
    def n_bytes(self) -> int:
        """Size of the file, bytes: rows and CRC."""
        return self.scene.chunk_rows * self.scene.row_bytes + CRC_BYTES


@dataclass(eq=False)
class Store:
    """A store and its study, whose ``run.realisations`` is the number of rows of each array."""

    path: Path
    study: Study
    digests: dict[str, str] = field(default_factory=dict)  # of written chunks, by path
    of_version_1: bool = False
    _listing: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        missing = [name for name in ("zarr", "xxhash", "google_crc32c") if find_spec(name) is None]
        if missing:
            raise missing_package(missing[0], "a store", "bulk")

    @classmethod
    def open(cls, path: str | Path) -> Store:
        """Open an existing store; at least one copy of its study is intact, and intact copies are the same."""
        path = Path(path)
        copies: dict[str, Path] = {}
        for file in (path / "zarr.json", *sorted(path.glob("*/*/zarr.json"))):
            # Only intact copies count: those whose digest is correct.
            with suppress(ValueError, LookupError, TypeError, AttributeError, RecursionError):
                attributes = json.loads(read_bytes(file, "description"))["attributes"]
                if signed(attributes["study"]).items() <= attributes.items():
                    copies.setdefault(attributes["study"], file.relative_to(path))
        if not copies:
            raise refusal(
                f"{str(path)!r} is not a store of spectra: give a folder that `mauvecl realise` wrote, with an intact "
                "copy of its study"
            )
        (text, file), *contradictions = copies.items()
        if contradictions:
            other_text, other_file = contradictions[0]
            keys = ", ".join(differing_keys(toml(text, path.name), toml(other_text, path.name)))
            raise refusal(
                f"store {str(path)!r} must hold one study, but {str(file)!r} and {str(other_file)!r} differ in {keys}: "
                "restore the file of the correct one"
            )
        data = toml(text, path.name)
        store = cls(path, Study.build(read_version(data, path.name), path.name), of_version_1="version" not in data)
        store.read_digests()
        return store

    @cached_property
    def scenes(self) -> list[StoredScene]:
        """Arrays of spectra: every star and sweep value, without and with each flare."""
        scenes = []
        for number, case in enumerate(cases(self.study), 1):
            chosen = case.study.bulk.chosen(case.quiet.n_frames)
            # The amplitude is an attribute of the flare's array.
            swept = {name: value for name, value in case.at.items() if name != "amplitude"}
            name = full_label(case.label, swept)
            for k, (amplitude, x) in enumerate(zip((0.0, *case.amplitudes), (case.quiet, *case.flares), strict=True)):
                array = f"flare-{k}" if k else "quiescent"
                scenes.append(StoredScene(f"star-{number}", array, name, amplitude, x, chosen, swept, self.rows))
        return scenes

    def scene(self, path: str) -> StoredScene:
        """Return an array by path, such as ``star-1/flare-2``."""
        by_path = {scene.path: scene for scene in self.scenes}
        if path not in by_path:
            raise InputError.of("scenes", path, f"one of {', '.join(by_path)}")
        return by_path[path]

    @property
    def rows(self) -> int:
        """Number of realisations of each array."""
        return self.study.run.realisations

    @property
    def n_bytes(self) -> int:
        """Size of all spectra, bytes."""
        return sum(self.rows * scene.row_bytes for scene in self.scenes)

    def range_of(self, rows: tuple[int, int] | None) -> tuple[int, int]:
        """Return a half-open range of realisations, by default all; raises InputError if the store has no such rows."""
        first, stop = rows or (0, self.rows)
        if not 0 <= first < stop <= self.rows:
            raise InputError.of("rows", (first, stop), f"a range within 0:{self.rows}")
        return first, stop

    def chunks(self, first: int = 0, stop: int | None = None) -> Iterator[Chunk]:
        """Yield the chunks of all scenes that contain rows `first` to `stop - 1`; all chunks by default."""
        for scene in self.scenes:
            yield from map(scene.chunk, scene.chunk_numbers(first, stop))

    def count(self, first: int = 0, stop: int | None = None) -> int:
        """Return the number of chunks that `chunks` yields, without iterating."""
        return sum(len(scene.chunk_numbers(first, stop)) for scene in self.scenes)

    def make(self) -> None:
        """Write the description of the arrays, or check that an existing one is of the same study."""
        root = self.path / "zarr.json"
        if root.exists():
            existing = Store.open(self.path).study
            differing = differing_keys(self.study.model_dump(mode="json"), existing.model_dump(mode="json"))
            if differing:
                raise refusal(
                    f"store {str(self.path)!r} was started by another study, which differs in {', '.join(differing)}: "
                    "use the same study or another place"
                )
            self.read_digests()
            return
        groups = {scene.group for scene in self.scenes}
        foreign = [p.name for p in self.path.iterdir() if p.name not in groups and not p.name.startswith(UNFINISHED)]
        if foreign:
            raise refusal(f"{str(self.path)!r} holds {min(foreign)!r} and no store: use an empty or a new folder")
        # The root comes last, so that its presence means that the description is complete.
        files = self.description()
        for name in sorted(files, key=lambda name: name == root.name):
            write_whole(self.path / name, files[name])

    def make_folder(self) -> None:
        """Make the folder if needed; raises InputError if its file system is smaller than the spectra."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            disk_bytes = shutil.disk_usage(self.path).total
        except OSError as error:
            raise refusal(
                f"store {str(self.path)!r} cannot be made ({error.strerror}): use a writable folder"
            ) from error
        if self.n_bytes > disk_bytes:
            raise InputError(
                f"the spectra need {self.n_bytes / 2**30:.4g} GiB, but the disk of {str(self.path)!r} has "
                f"{disk_bytes / 2**30:.4g} GiB",
                key="run.realisations",
            )

    @property
    def remarks(self) -> dict[str, str]:
        """Attributes of the store and of files: how rows are drawn, and the instrument's remark on its throughput."""
        return {
            "draws": DRAWS,
            "throughput": " ".join(dict.fromkeys(scene.expectation.notice for scene in self.scenes)),
        }

    def description(self) -> dict[str, bytes]:
        """Return the content of every file except spectra, by path."""
        import zarr

        files: dict[str, Any] = {}
        root = zarr.open_group(zarr.storage.MemoryStore(files), mode="w", zarr_format=3)
        run: dict[str, Any] = signed(self.study.toml()) | {"seed": self.study.run.seed, "realisations": self.rows}
        root.attrs.update(run | {"mauvecl": VERSION} | self.remarks)
        for scene in self.scenes:
            _describe(root, scene, self.study)
        return {name: content.to_bytes() for name, content in files.items()}

    def read_digests(self) -> None:
        """Read the digests of written chunks; incomplete lines are ignored."""
        self.digests = {}
        for scene in self.scenes:
            try:
                text = read_bytes(self.path / scene.path / DIGESTS, "list of digests").decode(errors="replace")
            except InputError:
                continue
            for line in text.splitlines():
                name, written = [*line.split(" "), ""][:2]
                if line == _line(name, written):
                    self.digests[f"{scene.path}/{name}"] = written

    def sort_digests(self) -> None:
        """Write the lists of digests in the order of their chunks, which may have been written in another."""
        for scene in self.scenes:
            file, prefix = self.path / scene.path / DIGESTS, f"{scene.path}/"
            names = [key.removeprefix(prefix) for key in self.digests if key.startswith(f"{prefix}c/")]
            names.sort(key=lambda name: int(name.split("/")[1]))
            text = "".join(f"{_line(name, self.digests[prefix + name])}\n" for name in names).encode()
            if names and file.read_bytes() != text:
                write_whole(file, text)

    def encode(self, chunk: Chunk, rows: NDArray[Any]) -> tuple[memoryview, bytes]:
        """Encode a chunk by Zarr's codecs `bytes` and `crc32c`, padding the last chunk with zeros."""
        missing = chunk.scene.chunk_rows - len(rows)
        rows = np.pad(rows, [(0, missing), *[(0, 0)] * len(chunk.scene.row)]) if missing else rows
        rows = np.ascontiguousarray(rows, chunk.scene.dtype)
        return memoryview(rows.data).cast("B"), crc(rows)

    def write(self, chunk: Chunk, rows: NDArray[Any]) -> None:
        """Write a chunk atomically, and then its digest to its array's list, for which threads wait for each other."""
        data, check = self.encode(chunk, rows)
        write_whole(self.path / chunk.key, data, check)
        written = self.digests[chunk.key] = digest(data, check)
        digests = self.path / chunk.scene.path / DIGESTS
        name = f"{chunk.scene.path}/{DIGESTS} of {self.path.name}"
        with self._listing, writing(name, NO_ROOM, key="store"), digests.open("ab", buffering=0) as file:
            # A single short write, which first ends a line that a full disk has cut short.
            file.write(f"\n{_line(chunk.name, written)}\n".encode())

    def has(self, chunk: Chunk) -> bool:
        """Return whether a chunk was written, by digest list and file size; `bulk.state` checks its content."""
        try:
            size = (self.path / chunk.key).stat().st_size
        except OSError:
            return False
        return chunk.key in self.digests and size == chunk.n_bytes

    def files(self) -> Iterator[tuple[str, bool]]:
        """Yield every file and link in the folder, and whether it belongs to this store."""
        scenes = {scene.path: scene for scene in self.scenes}
        described = {*self.description(), *(f"{path}/{DIGESTS}" for path in scenes)}
        for path in sorted(self.path.rglob("*")):
            if path.is_dir() and not path.is_symlink():
                continue
            key = str(path.relative_to(self.path).with_name(path.name.removeprefix(UNFINISHED) or path.name))
            # Twenty digits suffice for any chunk; int() of a very long name would be slow.
            match = re.match("(.+)/c/([0-9]{1,20})/", key)
            belongs = key in described
            if match is not None and (scene := scenes.get(match[1])) is not None:
                number = int(match[2])
                belongs |= number in scene.chunk_numbers() and key == scene.chunk(number).key
            yield str(path.relative_to(self.path)), belongs

    def clear(self) -> None:
        """Remove all files if no others exist; the study is last, so that an interrupted removal leaves a store."""
        files = list(self.files())
        foreign = [key for key, belongs in files if not belongs]
        if foreign:
            raise refusal(
                f"a store that is removed must hold no other files, but {str(self.path)!r} holds {foreign[0]!r}"
            )
        for key, _ in sorted(files, key=lambda entry: entry[0] == "zarr.json"):
            (self.path / key).unlink(missing_ok=True)
        for folder, _, _ in os.walk(self.path, topdown=False):
            if folder != str(self.path):
                Path(folder).rmdir()
        self.digests = {}


def crc(data: bytes | NDArray[Any]) -> bytes:
    """Return the CRC-32C in the format of Zarr's codec."""
    import google_crc32c

    return int(google_crc32c.value(data)).to_bytes(CRC_BYTES, "little")


def is_intact(data: bytes) -> bool:
    """Return whether the content of a chunk's file ends with its CRC."""
    return crc(data[:-CRC_BYTES]) == data[-CRC_BYTES:]


def digest(*parts: bytes | memoryview) -> str:
    """Return the 128-bit XXH3 hash of concatenated parts."""
    import xxhash

    hashed = xxhash.xxh3_128()
    for part in parts:
        hashed.update(part)
    return hashed.hexdigest()


def _line(name: str, written: str) -> str:
    """Return the line of a chunk in a list of digests, which ends with a check of itself."""
    text = f"{name} {written}"
    return f"{text} {digest(text.encode())[:8]}"
