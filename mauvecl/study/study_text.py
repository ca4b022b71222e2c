"""Text of a study: settings of single keys, and the study that an answer's table contains."""

from __future__ import annotations

import contextlib
import hashlib
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel

from mauvecl.host.files.parsing import parsing, read_text, toml
from mauvecl.host.files.size_limits import read_bytes
from mauvecl.host.spectra.formats import without_columns
from mauvecl.host.tables.ecsv import read_ecsv
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.study.calibrations import PATHS


def read_embedded_study(path: Path) -> str:
    """Return the text of the study in an answer's metadata."""
    study = read_ecsv(path, "study", "an answer's ECSV table").meta.get("study")
    if not isinstance(study, str):
        raise InputError(f"{path.name} contains no study", "an answer's ECSV table", key="study", value=path.name)
    return study


def with_paths(data: Any, kind: Any, change: Callable[[Path], Path]) -> Any:
    """Return data of an annotated type, such as a section, with other paths; invalid data are left unchanged."""
    parts = get_args(kind)
    if kind is Path:
        return str(change(Path(data))) if isinstance(data, str) else data
    if isinstance(kind, type) and issubclass(kind, BaseModel) and isinstance(data, dict):
        kinds = {key: field.annotation for key, field in kind.model_fields.items()}
        return {key: with_paths(value, kinds.get(key), change) for key, value in data.items()}
    if get_origin(kind) is tuple and isinstance(data, list):
        return [with_paths(value, parts[0], change) for value in data]
    if get_origin(kind) is dict and isinstance(data, dict):
        return {key: with_paths(value, parts[1], change) for key, value in data.items()}
    if get_origin(kind) in (Union, UnionType):
        # At most one of the alternatives holds paths.
        return next((new for part in parts if (new := with_paths(data, part, change)) != data), data)
    return data


def with_file_digests(text: str) -> str:
    """Replace the paths of files in a study's text by names and digests, not by paths."""
    import tomli_w

    data = tomllib.loads(text)
    named = _named_files(data)
    if not named:
        return text
    for section, key in named:
        place, _ = without_columns(Path(section[key]))
        section[key] = Path(section[key]).name
        # Keep the answer even if the file no longer exists.
        with contextlib.suppress(InputError):
            section[f"{key}_sha256"] = _digest(place)
    return tomli_w.dumps(data)


def _named_files(data: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """List the sections of stars, flare, observations and changes that name a file, with the key."""
    stars, flare = data.get("star"), data.get("flare")
    sections = [(star, key) for star in (stars if isinstance(stars, list) else []) for key in ("file", "neighbours")]
    light = flare.get("spectrum") if isinstance(flare, dict) else None
    sections += [(light, "file"), (light, "quiescent"), (data.get("data"), "file"), (data.get("data"), "mapping")]
    asked = data.get("calibrate")
    rows = asked.get("observations") if isinstance(asked, dict) else None
    sections += [(row, key) for row in (rows if isinstance(rows, list) else []) for key in PATHS]
    sections += [(data.get("change"), "file")]
    return [(one, key) for one, key in sections if isinstance(one, dict) and isinstance(one.get(key), str)]


def locate_files(data: dict[str, Any], table: Path) -> None:
    """Locate the files that the study of an answer's table gives by name and digest, in place.

    Searches the table's folder, its parent, the current folder, and the paths in a ``study.toml`` next to the table.
    Raises InputError if no file with the name and digest is found.
    """
    for section, key in _named_files(data):
        if f"{key}_sha256" not in section:
            continue
        name, digest = Path(section[key]).name, section.pop(f"{key}_sha256")
        places = [table.parent / name, table.parent.parent / name, Path(name), *_beside(table, name)]
        for place in places:
            if without_columns(place)[0].is_file() and _digest(without_columns(place)[0]) == digest:
                section[key] = str(place.resolve())
                break
        else:
            raise InputError(
                f"{shortened(table.name)}: its file {shortened(name)} with sha256 "
                f"{shortened(str(digest))} is missing or has changed",
                "it next to the table",
                key=key,
                value=name,
            )


def _beside(table: Path, name: str) -> list[Path]:
    """Return the files of this name in the ``study.toml`` next to a table."""
    study = table.parent / "study.toml"
    if not study.is_file():
        return []
    data = toml(read_text(study, "study file"), "study file 'study.toml'")
    files = [section[key] for section, key in _named_files(data)]
    return [table.parent / file for file in files if Path(file).name == name]


def _digest(file: Path) -> str:
    return hashlib.sha256(read_bytes(file, "spectrum file")).hexdigest()


def parse_toml_value(text: str) -> Any:
    """Parse a TOML value; a bare word is text."""
    with parsing(f"value {shortened(text)}", "a TOML value"):
        try:
            parsed = tomllib.loads(f"value = {text}")
        except tomllib.TOMLDecodeError:
            return text
    # Text of several lines would define several keys.
    return parsed["value"] if len(parsed) == 1 else text


def set_key(data: Any, path: list[str], value: Any, text: str) -> None:
    """Set a nested key in place; `text` is the setting, for messages."""
    *parents, last = path
    for part in parents:
        if isinstance(data, list | tuple):
            if part not in (numbers := [str(i) for i in range(len(data))]):
                raise InputError(
                    f"setting = {shortened(text)}: no entry {shortened(part)}",
                    f"0 to {len(numbers) - 1}",
                    key="setting",
                    value=text,
                )
            data = data[int(part)]
        elif isinstance(data, dict):
            data = data.setdefault(part, {})
    if not isinstance(data, dict):
        raise InputError(
            f"setting = {shortened(text)}: {shortened('.'.join(parents))} is a value",
            "a section with keys",
            key="setting",
            value=text,
        )
    data[last] = value
