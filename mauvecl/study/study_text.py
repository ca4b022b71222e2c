"""A study's text: keys set one by one, the study inside an answer's table, and a sentence for the first fault."""

from __future__ import annotations

import contextlib
import hashlib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import read_bytes, shortened
from mauvecl.host.files.ecsv import read_ecsv
from mauvecl.host.files.parsed import parsing, read_text, toml
from mauvecl.host.spectra.formats import without_columns


def study_of(path: Path) -> str:
    """The study in an answer's meta data."""
    study = read_ecsv(path, "study", "an answer's ECSV table").meta.get("study")
    if not isinstance(study, str):
        raise InputError(f"{path.name} holds no study, expected an answer's ECSV table")
    return study


def in_table(text: str, files: Sequence[Path | None]) -> str:
    """A study's text with its stars' files by name and digest: where they are is no part of an answer."""
    import tomli_w

    if not any(files):
        return text
    data = tomllib.loads(text)
    for star, file in zip(data["star"], files, strict=True):
        if file is not None:
            place, _ = without_columns(file)
            star["file"] = file.name
            # An answer is not lost for a file that is gone by now.
            with contextlib.suppress(InputError):
                star["file_sha256"] = _digest(place)
    return tomli_w.dumps(data)


def find_files(data: dict[str, Any], table: Path) -> None:
    """Put the places of stars' files into the study of an answer's table, which names them by name and digest.

    They are looked for beside the table, above it, in the current folder, and where the ``study.toml`` beside the table
    has them.

    Raises
    ------
    InputError
        If none of that name is there as it was.
    """
    stars = data.get("star")
    for star in stars if isinstance(stars, list) else ():
        if not (isinstance(star, dict) and "file_sha256" in star and isinstance(star.get("file"), str)):
            continue
        name, digest = Path(star["file"]).name, star.pop("file_sha256")
        places = [table.parent / name, table.parent.parent / name, Path(name), *_beside(table, name)]
        for place in places:
            if without_columns(place)[0].is_file() and _digest(without_columns(place)[0]) == digest:
                star["file"] = str(place.resolve())
                break
        else:
            raise InputError(
                f"{shortened(table.name)}: its star's file {shortened(name)} is not there as it was (sha256 "
                f"{shortened(str(digest))}), expected it beside the table"
            )


def _beside(table: Path, name: str) -> list[Path]:
    """Files of that name in the study that was written with a table."""
    study = table.parent / "study.toml"
    if not study.is_file():
        return []
    stars = toml(read_text(study, "study file"), "study file 'study.toml'").get("star")
    files = [star.get("file") for star in stars if isinstance(star, dict)] if isinstance(stars, list) else []
    return [table.parent / file for file in files if isinstance(file, str) and Path(file).name == name]


def _digest(file: Path) -> str:
    return hashlib.sha256(read_bytes(file, "spectrum file")).hexdigest()


def toml_value(text: str) -> Any:
    """A value as TOML has it; a bare word is text."""
    with parsing(f"value {shortened(text)}", "a value as TOML has it"):
        try:
            parsed = tomllib.loads(f"value = {text}")
        except tomllib.TOMLDecodeError:
            return text
    # Several lines would be several keys.
    return parsed["value"] if len(parsed) == 1 else text


def put(data: Any, path: list[str], value: Any, text: str) -> None:
    *parents, last = path
    for part in parents:
        if isinstance(data, list | tuple):
            if part not in (numbers := [str(i) for i in range(len(data))]):
                raise InputError(
                    f"setting = {shortened(text)}: no entry {shortened(part)}, expected 0 to {len(numbers) - 1}"
                )
            data = data[int(part)]
        elif isinstance(data, dict):
            data = data.setdefault(part, {})
    if not isinstance(data, dict):
        raise InputError(
            f"setting = {shortened(text)}: {shortened('.'.join(parents))} holds no keys, expected one that does"
        )
    data[last] = value
