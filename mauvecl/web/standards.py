"""Observations of standard stars in a visitor's archive: a study that lists them, and the files that it names."""

from __future__ import annotations

import io
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import printable, shortened
from mauvecl.study.calibrations import PATHS, CalibrateQuestion, CalibrationObservation
from mauvecl.web.folders import content_folder

#: Largest numbers of files and observations of an archive, and of bytes to which it unpacks.
MOST_FILES, MOST_BYTES = 40, 64 * 2**20
#: Bytes of a TOML file of it, and characters of a file's name, at most.
MOST_TOML_BYTES, MOST_NAME = 2**18, 100
#: Packings that are read to the stated size and no further; others, such as LZMA, unpack to any size.
BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@dataclass(frozen=True)
class Observations:
    """A visitor's archive with frames of standard stars."""

    name: str  # name on the visitor's computer
    content: bytes  # the zip archive
    rows: tuple[CalibrationObservation, ...]  # observations with the names of their files

    @classmethod
    def of(cls, name: str, content: bytes) -> Observations:
        """Keep an archive of observations; raises InputError if it lacks a file."""
        return cls(printable(name, MOST_NAME), content, observations_in(unpacked(content)))

    @property
    def files(self) -> dict[str, bytes]:
        """Contents by name without folders, unpacked on each call since they are large."""
        return unpacked(self.content)

    def written(self, folder: Path) -> list[dict[str, Any]]:
        """Write the files below a folder, once, and return the observations with their paths."""

        def unpack(new: Path) -> None:
            for name, content in self.files.items():
                (new / name).write_bytes(content)

        home = content_folder(folder, self.content, unpack)
        return placed(self.rows, lambda name: str(home / name))


def placed(rows: Iterable[CalibrationObservation], place: Callable[[Path], str]) -> list[dict[str, Any]]:
    """Return observations as data of a study, with other paths."""
    data = [row.model_dump(exclude_none=True) for row in rows]
    return [row | {key: place(row[key]) for key in PATHS if key in row} for row in data]


def unpacked(content: bytes) -> dict[str, bytes]:
    """Return the files of a zip archive by their names without folders.

    Hidden files, which some systems add, are left out. Raises InputError if the content is not a zip archive, is
    damaged, encrypted or too large, or contains a name that is not a plain one in a folder of the archive.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = {entry: _name(entry.filename) for entry in archive.infolist() if not entry.is_dir()}
            entries = {entry: name for entry, name in entries.items() if not name.startswith(".")}
            if len(entries) > MOST_FILES or sum(entry.file_size for entry in entries) > MOST_BYTES:
                raise InputError(
                    "the archive holds too much", f"at most {MOST_FILES} files of {MOST_BYTES // 2**20} MiB in all",
                    key="observations",
                )  # fmt: skip
            if any(entry.compress_type not in BOUNDED for entry in entries):
                raise InputError(
                    "the archive is packed in an unusual way", "a zip archive with deflate", key="observations"
                )
            files = {}
            for entry, name in entries.items():
                # A stated size that is too small ends the reading, and the checksum then differs.
                with archive.open(entry) as file:
                    files[name] = file.read(entry.file_size)
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, ValueError) as error:
        raise InputError(
            f"the observations are no sound zip archive ({error})",
            "a TOML file and the files that it names in a zip archive without a password",
            key="observations",
        ) from error
    if len(files) < len(entries):
        raise InputError("two files of the archive have one name", "different names", key="observations")
    return files


def _name(path: str) -> str:
    """Return the name of a file of an archive without folders."""
    parts = PureWindowsPath(path)
    if parts.anchor or ".." in parts.parts or not parts.name.isprintable() or not 0 < len(parts.name) <= MOST_NAME:
        raise InputError(
            f"the archive holds a file named {shortened(path)}",
            f"files in folders of the archive, with printable names of at most {MOST_NAME} characters",
            key="observations",
            value=path,
        )
    return parts.name


def observations_in(files: Mapping[str, bytes]) -> tuple[CalibrationObservation, ...]:
    """Return the observations that a study among files lists, with the names of their files.

    Raises InputError unless exactly one file is such a study, and the archive contains all files that it names.
    """
    studies = [rows for name, one in files.items() if name.endswith(".toml") and (rows := _observations(name, one))]
    if len(studies) != 1:
        raise InputError(
            f"{len(studies)} files of the archive list observations", "one TOML file with [[calibrate.observations]]",
            key="observations",
        )  # fmt: skip
    (rows,) = studies
    if len(rows) > MOST_FILES:
        raise InputError(f"{len(rows)} observations are too many", f"at most {MOST_FILES}", key="observations")
    for row in rows:
        for key in PATHS:
            if isinstance(row.get(key), str):
                name = PureWindowsPath(row[key]).name
                if name not in files:
                    expected = f"its file in the archive, which holds {', '.join(sorted(files))}"
                    raise InputError(f"{shortened(name)} is missing", expected, key="observations", value=name)
                row[key] = name
    return CalibrateQuestion.model_validate({"observations": rows}).observations


def _observations(name: str, content: bytes) -> list[dict[str, Any]]:
    """Return the rows of a file's table of observations; empty if it has none."""
    if len(content) > MOST_TOML_BYTES:
        raise InputError(f"{shortened(name)} is too large", f"TOML of at most {MOST_TOML_BYTES // 2**10} KiB",
                         key="observations")  # fmt: skip
    try:
        study = tomllib.loads(content.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{shortened(name)} is not a TOML file ({error})", "valid TOML", key="observations") from error
    section = study.get("calibrate")
    if not isinstance(section, dict) or "observations" not in section:
        return []
    others = [*(study.keys() - {"calibrate"}), *(f"calibrate.{key}" for key in section.keys() - {"observations"})]
    if others:
        raise InputError(
            f"{shortened(name)} sets {shortened(min(others))}", "calibrate.observations alone; fields set the rest",
            key="observations", value=min(others),
        )  # fmt: skip
    rows = section["observations"]
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
