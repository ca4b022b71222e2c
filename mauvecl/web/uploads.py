"""Files of visitors: limits, readers of each kind, and the shelf that keeps them."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import io
import re
import sys
import tempfile
import threading
import zipfile
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PureWindowsPath
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, TypeVar

import numpy as np

from mauvecl.host.stars.conversion import ReadSpectrum
from mauvecl.host.stars.flare import ObservedFlare
from mauvecl.host.stars.formats import read_spectrum
from mauvecl.host.stars.source import Source
from mauvecl.host.tables.files import as_text, parsing, toml
from mauvecl.observations.frame_files import read_frames
from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError, printable, shortened
from mauvecl.schema.section import built
from mauvecl.study.questions import PATHS, CalibrateQuestion, CalibrationObservation
from mauvecl.web.fields import FIELDS, UPLOADED, UPLOADED_FILE, UPLOADED_UNKNOWN, read_points
from mauvecl.web.sandboxed_reader import EXPECTED_FRAMES, read_limited

Spectrum = TypeVar("Spectrum", Source, ObservedFlare, ReadSpectrum)

# Limits; sizes in bytes.
MOST_UPLOADED, MOST_POINTS = 4 * 2**20, 200_000  # size of an upload, and number of points of its spectrum
MOST_KEPT_BYTES = 16 * 2**20  # size of a file that is kept unread; a day of resolution elements takes some 8 MiB
MOST_VALUES = 2**24  # number of values of frames that an answer reads: the spectra of a day
MOST_PAIRS_BYTES = 2**18  # size of an unknown spectrum
MOST_FILES, MOST_BYTES = 40, 64 * 2**20  # number of files and observations of an archive, and its unpacked size
MOST_TOML_BYTES, MOST_NAME = 2**18, 100  # size of a TOML file in an archive, and number of characters of a file's name
#: Compression types that are read to the stated size and no further; others, such as LZMA, unpack to any size.
BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
MOST_RESULTS = 256 * 2**20  # size of closed forms, answers and files of all visitors together
MOST_UPLOADS = 256 * 2**20  # size of the uploads of all visitors together
MOST_OBJECTS = 20_000  # objects of a value that are counted; arrays, which take most of the memory, come early
#: Types of objects that belong to the program and not to a value.
PROGRAM = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType)
#: Keys of a mapping of frames that are chosen from menus of their columns, with labels; the first two are required.
MAPPED = {"time": "Time", "flux": "Flux", "error": "Error", "quality": "Quality", "temperature": "Temperature"}
#: Units and dates of times, chosen from a menu next to them.
TIME_UNITS = ("s", "min", "h", "d", "jd", "mjd", "bjd", "btjd", "bkjd")
#: Example files that visitors may try in place of their own, by field, with descriptions.
EXAMPLES: Mapping[str, tuple[str, str]] = {
    "frames": ("kepler-example.fits", "12 days of KIC 10002792, a flare star, by Kepler (NASA, in the public domain)")
}
refusal = partial(InputError, key="observations")  # error of an archive of observations


def content_folder(folder: Path, content: bytes, files: Callable[[], Mapping[str, bytes]]) -> Path:
    """Return the subfolder for some content, named after its digest; the first call writes its files."""
    home = folder / hashlib.sha256(content).hexdigest()
    if not home.exists():
        new = Path(tempfile.mkdtemp(dir=folder))
        for name, file in files().items():
            (new / name).write_bytes(file)
        # Another thread may have been faster; the visitor's folder is removed as a whole.
        with contextlib.suppress(OSError):
            new.rename(home)
    return home


@dataclass(frozen=True)
class Observations:
    """A visitor's archive with frames of standard stars."""

    name: str  # name on the visitor's computer
    content: bytes  # the zip archive
    rows: tuple[CalibrationObservation, ...]  # observations with the names of their files

    @classmethod
    def of(cls, name: str, content: bytes) -> Observations:
        """Keep an archive, which must hold one study with observations, and all files that it names."""
        files = unzipped(content)
        studies = [rows for file, text in files.items() if file.endswith(".toml") and (rows := _rows_of(file, text))]
        if (n := len(studies)) != 1:
            raise refusal(f"the archive must hold one TOML file with [[calibrate.observations]], but holds {n}")
        (rows,) = studies
        if len(rows) > MOST_FILES:
            raise refusal(f"the archive may list at most {MOST_FILES} observations, but lists {len(rows)}")
        for row in rows:
            for key in PATHS:
                if isinstance(row.get(key), str):
                    row[key] = file = PureWindowsPath(row[key]).name
                    if file not in files:
                        raise refusal(f"the archive needs {shortened(file)}, but holds {', '.join(sorted(files))}")
        observations = built(CalibrateQuestion, {"observations": rows}, "the archive").observations
        return cls(printable(name, MOST_NAME), content, observations)

    def written(self, folder: Path) -> list[dict[str, Any]]:
        """Write the files below a folder, once, and return the observations with their paths."""
        home = content_folder(folder, self.content, lambda: unzipped(self.content))
        data = (row.model_dump(exclude_none=True) for row in self.rows)
        return [row | {key: str(home / row[key]) for key in PATHS if key in row} for row in data]


def unzipped(content: bytes) -> dict[str, bytes]:
    """Return the files of a zip archive by their names without folders, but hidden ones, which some systems add."""
    remedy = "give a TOML file and the files that it names, in a sound zip archive without a password"
    with parsing("the archive", remedy), zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = dict[zipfile.ZipInfo, str]()
        for entry in archive.infolist():
            if entry.is_dir():
                continue
            path = PureWindowsPath(entry.filename)
            name = path.name
            if path.anchor or ".." in path.parts or not name.isprintable() or not 0 < len(name) <= MOST_NAME:
                raise refusal(
                    f"the archive holds a file named {shortened(entry.filename)}, but its files must lie in folders of "
                    f"the archive and have printable names of at most {MOST_NAME} characters"
                )
            if not name.startswith("."):
                entries[entry] = name
        if len(entries) > MOST_FILES or sum(entry.file_size for entry in entries) > MOST_BYTES:
            raise refusal(f"the archive must hold at most {MOST_FILES} files of {MOST_BYTES // 2**20} MiB in all")
        if any(entry.compress_type not in BOUNDED for entry in entries):
            raise refusal("the archive is packed in an unusual way; use a zip archive with deflate")
        files = {}
        for entry, name in entries.items():
            # A stated size that is too small ends the reading, and the checksum then differs.
            with archive.open(entry) as file:
                files[name] = file.read(entry.file_size)
    if len(files) < len(entries):
        raise refusal("two files of the archive have the same name, but names must differ")
    return files


def _rows_of(name: str, content: bytes) -> list[dict[str, Any]]:
    """Return the rows of a file's table of observations; empty if it has none."""
    if len(content) > MOST_TOML_BYTES:
        raise refusal(f"{shortened(name)} must be TOML of at most {MOST_TOML_BYTES // 2**10} KiB")
    study = toml(as_text(content, shortened(name)), shortened(name))
    section = study.get("calibrate")
    if not isinstance(section, dict) or "observations" not in section:
        return []
    more = [*(study.keys() - {"calibrate"}), *(f"calibrate.{key}" for key in section.keys() - {"observations"})]
    if more:
        raise refusal(
            f"{shortened(name)} sets {shortened(min(more))}, but must set calibrate.observations alone; fields set "
            "the rest"
        )
    rows = section["observations"]
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def write_spectrum(source: Source | ReadSpectrum, folder: Path, name: str) -> str:
    """Write an uploaded spectrum to a file of this name without loss, once per spectrum, and return its path."""
    from astropy.table import Table

    def files() -> dict[str, bytes]:
        table = Table({"wavelength": source.wavelength_nm, "flux": source.flux_flam})
        table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
        table.meta |= {"name": source.name, "told": list(source.messages)}
        text = io.StringIO()
        table.write(text, format="ascii.ecsv")
        return {name: text.getvalue().encode()}

    content = name.encode() + source.wavelength_nm.tobytes() + source.flux_flam.tobytes()
    return str(content_folder(folder, content, files) / name)


def _spectrum(
    kind: type[Spectrum], reader: Callable[..., Spectrum], label: str, name: str, content: bytes, **options: Any
) -> Spectrum:
    """Read an untrusted spectrum, compressed or not, and name it `label`; its format follows from the content."""
    spectrum = read_limited(kind, reader, {"upload": content}, **options)
    if spectrum.wavelength_nm.size > MOST_POINTS:
        raise InputError.of("points", spectrum.wavelength_nm.size, f"at most {MOST_POINTS}")
    origin: Any = {"name": label, "origin": "upload"} if label else {}
    return replace(spectrum, **origin)


def _flare(name: str, content: bytes, **options: Any) -> ReadSpectrum:
    """Read the measured range of a flare's spectrum; the study that reads the file continues it."""
    flare = _spectrum(ObservedFlare, ObservedFlare.read, "", name, content, **options)
    low, high = flare.measured_nm
    inside = (flare.wavelength_nm >= low) & (flare.wavelength_nm <= high)
    texts = tuple(text for text in flare.messages if text.startswith(f"{flare.name}: "))
    nm, flux = flare.wavelength_nm[inside], flare.flux_flam[inside]
    return ReadSpectrum(nm, flux, "uploaded flare", "upload", messages=texts)


@dataclass(frozen=True)
class VisitorFile:
    """A visitor's file, not read until an answer needs it."""

    name: str  # name on the visitor's computer, without folders and odd characters
    content: bytes

    @classmethod
    def of(cls, name: str, content: bytes) -> VisitorFile:
        """Keep a file."""
        name = re.sub(r"[^A-Za-z0-9_.+-]", "_", re.split(r"[/\\]", name)[-1])[-80:].strip(".-")
        return cls(name or "file", content)

    def written(self, folder: Path) -> str:
        """Write the file below a folder, once, and return its path."""
        content = self.name.encode() + self.content
        return str(content_folder(folder, content, lambda: {self.name: self.content}) / self.name)


@dataclass(frozen=True)
class Upload:
    """Kind of file that a field takes."""

    reader: Callable[..., Any]  # of its name and content, and of options by name
    entered: str = UPLOADED_FILE  # text of the field that stands for the file
    most: int = MOST_UPLOADED  # largest number of bytes
    fields: tuple[str, ...] = ()  # fields that say how it is read

    @property
    def options(self) -> dict[str, str]:
        """Names of its `fields` by the options of the reader, which have the names of their keys."""
        return {FIELDS[name].path[-1]: name for name in self.fields}

    def read(self, name: str, content: bytes, values: Mapping[str, Any]) -> Any:
        """Read an untrusted file with the values of fields; raises InputError if it is too large or unusable."""
        if len(content) > self.most:
            size = len(content) / 2**20
            fault = f"the upload has {size:.1f} MiB, but may have at most {self.most / 2**20:g} MiB"
            raise InputError(fault, key="upload")
        return self.reader(name, content, **{option: values[name] for option, name in self.options.items()})


#: Files by the field that takes them.
UPLOADS: Mapping[str, Upload] = {
    "star": Upload(
        partial(_spectrum, Source, Source.read, UPLOADED), UPLOADED, fields=("wavelength_unit", "flux_unit", "extend")
    ),
    "flare_file": Upload(_flare, fields=("flare_wavelength_unit", "flare_flux_unit", "continue_at_k")),
    "flare_quiescent": Upload(
        partial(_spectrum, ReadSpectrum, read_spectrum, "uploaded star without the flare"),
        fields=("flare_wavelength_unit", "flare_flux_unit"),
    ),
    "change_file": Upload(
        partial(_spectrum, Source, Source.read, "added spectrum"),
        fields=("change_wavelength_unit", "change_flux_unit", "change_extend"),
    ),
    "own_unknown": Upload(
        lambda name, content: read_points(as_text(content, shortened(name)), shortened(name)),
        UPLOADED_UNKNOWN,
        most=MOST_PAIRS_BYTES,
    ),
    **{
        name: Upload(VisitorFile.of, most=MOST_KEPT_BYTES)
        for name, page_field in FIELDS.items()
        if page_field.kind == "upload"
    },
    "observations": Upload(Observations.of, most=MOST_KEPT_BYTES),
}


def read_frames_of(file: VisitorFile, mapping: VisitorFile | None, *, quality_bits: str | None = None) -> Frames:
    """Read the frames of a visitor's file, through a mapping if there is one, without those of the quality bits."""
    files = {file.name: file.content}
    mapping_name = None
    if mapping is not None:
        mapping_name = mapping.name if mapping.name != file.name else f"mapping-{mapping.name}"
        files[mapping_name] = mapping.content
    options = {"mapping": mapping_name, "quality_bits": quality_bits}
    return read_limited(Frames, read_frames, files, expected=EXPECTED_FRAMES, **options)


class Shelf:
    """Values of all visitors, of which the least recently used are dropped if they take more than `most` bytes."""

    def __init__(self, most: int) -> None:
        self.most, self.size = most, 0
        # Size and value by visitor, kind and key. The visitor itself, since an id is given again when it has left.
        self._entries: OrderedDict[tuple[object, str, Hashable], tuple[int, Any]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, owner: object, kind: str, key: Hashable, value: object, most: int = 1) -> None:
        """Keep a value for its owner, who has at most `most` of its kind."""
        size, path = size_of(value), (owner, kind, key)
        with self._lock:
            self._remove(path)
            self._entries[path] = size, value
            self.size += size
            for old in self._paths(owner, kind)[:-most]:
                self._remove(old)
            while self.size > self.most and len(self._entries) > 1:
                self._remove(next(iter(self._entries)))

    def get(self, owner: object, kind: str, key: Hashable) -> Any:
        """Return a value, which counts as its use, or None if it was dropped."""
        with self._lock:
            if (path := (owner, kind, key)) not in self._entries:
                return None
            self._entries.move_to_end(path)
            return self._entries[path][1]

    def of(self, owner: object, kind: str) -> dict[Any, Any]:
        """Return an owner's values of a kind by key."""
        with self._lock:
            return {path[2]: self._entries[path][1] for path in self._paths(owner, kind)}

    def drop(self, owner: object, *kind_and_key: Hashable) -> None:
        """Drop the values of an owner: all of them, or those of a kind, or of a kind and key."""
        with self._lock:
            for path in self._paths(owner, *kind_and_key):
                self._remove(path)

    def _paths(self, *start: object) -> list[tuple[object, str, Hashable]]:
        return [path for path in self._entries if path[: len(start)] == start]

    def _remove(self, path: tuple[object, str, Hashable]) -> None:
        self.size -= self._entries.pop(path, (0, None))[0]


def size_of(value: object) -> int:
    """Return the approximate size of a value and of the objects to which it refers, bytes."""
    # Breadth first, so that the top is counted before the details.
    counted, waiting, size = set[int](), deque[Any]([value]), 0
    while waiting and len(counted) < MOST_OBJECTS:
        item = waiting.popleft()
        if id(item) not in counted and not isinstance(item, PROGRAM):
            counted.add(id(item))
            size += sys.getsizeof(item, 0)
            waiting += gc.get_referents(item)
            if isinstance(item, np.ndarray):
                waiting.append(item.base)
    return size


#: Results and uploads of all visitors.
RESULTS, UPLOAD_SHELF = Shelf(MOST_RESULTS), Shelf(MOST_UPLOADS)
