"""Reader of instruments in TOML, with sources of values, paths of curves and inheritance between files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import read_text, toml
from .curve import Curve
from .paths import instrument_path
from .pixel_map import PixelMap
from .throughput_errors import ThroughputErrors

#: Tags of sources: paper, datasheet, computation, assumption, user.
TAGS = ("P", "D", "C", "A", "U")
#: Largest number of files in a chain in which each extends the next.
MAX_EXTENDED = 16


def read_values(
    path: Path, files: Mapping[str, type[Curve | PixelMap | ThroughputErrors]], seen: tuple[Path, ...] = ()
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the values and sources of a file, merged over those of the file that it extends.

    Parameters
    ----------
    files : mapping
        Classes of the values that may be paths, relative to the file.
    seen : tuple of Path
        Files that extend this one.
    """
    if path.resolve() in seen:
        raise InputError(f"{path.name} extends itself", "a chain of files that ends", key="extends", value=path.name)
    if len(seen) == MAX_EXTENDED:
        raise InputError(
            f"{path.name} ends a chain of {MAX_EXTENDED} files that extend another",
            "fewer",
            key="extends",
            value=path.name,
        )
    content = toml(read_text(path, "instrument file"), f"instrument file {shortened(str(path))}")
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    if "extends" in content:
        values, sources = read_values(
            instrument_path(content.pop("extends"), path.parent), files, (*seen, path.resolve())
        )
    for name, entry in content.items():
        if name == "sources":
            raise InputError(
                f"{path.name}: unknown key 'sources'", "each value's source in the value's own table", key="sources"
            )
        values[name], sources[name] = _entry(name, entry, path, files.get(name))
    return values, sources


def _entry(
    name: str, entry: Any, path: Path, kind: type[Curve | PixelMap | ThroughputErrors] | None
) -> tuple[Any, str]:
    """Return the value and source of an entry: a plain value, a table of value, tag and source, or a path."""
    source = f"A: assumed, no source in {path.name}"
    if isinstance(entry, dict):
        unknown = [key for key in entry if key not in ("value", "tag", "source")]
        if unknown or "value" not in entry:
            what = f"the unknown key {unknown[0]!r}" if unknown else "no 'value'"
            raise InputError(
                f"{path.name}: the table {name} has {what}", "value, tag and source", key=name, value=entry
            )
        tag = entry.get("tag", "A")
        if tag not in TAGS:
            raise InputError.of("tag", tag, f"one of {', '.join(TAGS)}", where=f"{path.name}, {name}")
        source = f"{tag}: {entry.get('source', f'no source in {path.name}')}"
        entry = entry["value"]
    if kind is not None and isinstance(entry, str):
        read = kind.read(path.parent / entry)
        return read, read.source
    if kind is Curve and isinstance(entry, int | float) and not isinstance(entry, bool):
        return Curve.flat(float(entry), source), source
    return entry, source
