"""A study's text: keys set one by one, the study inside an answer's table, and a sentence for the first fault."""

from __future__ import annotations

import contextlib
import hashlib
import tomllib
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


def in_table(text: str) -> str:
    """Return a study's text with files of spectra by name and digest: where they are is no part of an answer."""
    import tomli_w

    data = tomllib.loads(text)
    named = _named_files(data)
    if not named:
        return text
    for section, key in named:
        place, _ = without_columns(Path(section[key]))
        section[key] = Path(section[key]).name
        # An answer is not lost for a file that is gone by now.
        with contextlib.suppress(InputError):
            section[f"{key}_sha256"] = _digest(place)
    return tomli_w.dumps(data)


def _named_files(data: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """List sections of a study that name a file of a spectrum, stars' and the flare's, with their keys."""
    stars, flare = data.get("star"), data.get("flare")
    sections = [(star, "file") for star in (stars if isinstance(stars, list) else [])]
    light = flare.get("spectrum") if isinstance(flare, dict) else None
    sections += [(light, "file"), (light, "quiescent")]
    return [(one, key) for one, key in sections if isinstance(one, dict) and isinstance(one.get(key), str)]


def find_files(data: dict[str, Any], table: Path) -> None:
    """Put the places of spectra's files into the study of an answer's table, which names them by name and digest.

    They are looked for beside the table, above it, in the current folder, and where the ``study.toml`` beside the table
    has them.

    Raises
    ------
    InputError
        If none of that name is there as it was.
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
                f"{shortened(table.name)}: its file {shortened(name)} is not there as it was (sha256 "
                f"{shortened(str(digest))}), expected it beside the table"
            )


def _beside(table: Path, name: str) -> list[Path]:
    """Files of that name in the study that was written with a table."""
    study = table.parent / "study.toml"
    if not study.is_file():
        return []
    data = toml(read_text(study, "study file"), "study file 'study.toml'")
    files = [section[key] for section, key in _named_files(data)]
    return [table.parent / file for file in files if Path(file).name == name]


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
