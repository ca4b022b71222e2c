"""Reader of instruments in TOML, with sources of values, paths of curves and inheritance between files."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import read_text, toml
from .curve import Curve
from .instrument import CURVES, LABELS, Instrument
from .paths import instrument_path, shipped_names
from .pixel_map import PixelMap
from .throughput_errors import ThroughputErrors

#: Tags of sources: paper, datasheet, computation, assumption, user.
TAGS = ("P", "D", "C", "A", "U")
#: Largest number of files in a chain in which each extends the next.
MAX_EXTENDED = 16


def read_instrument(name: str | Path) -> Instrument:
    """Read an instrument by name or path; see `Instrument.load`."""
    # Embedded files do not change during a run; a user's file may.
    return _shipped(name) if name in shipped_names() else _built(instrument_path(name, Path()))


@cache
def _shipped(name: str) -> Instrument:
    return _built(instrument_path(name, Path()))


def _built(path: Path) -> Instrument:
    values, sources = _read(path, ())
    return Instrument.build({**values, "sources": sources}, path.name)


def _read(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the values and sources of a file, merged over those of the file that it extends."""
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
        values, sources = _read(instrument_path(content.pop("extends"), path.parent), (*seen, path.resolve()))
    for name, entry in content.items():
        if name == "sources":
            raise InputError(
                f"{path.name}: unknown key 'sources'", "each value's source in the value's own table", key="sources"
            )
        value, source = _entry(name, entry, path)
        values[name] = value
        if name not in LABELS:
            sources[name] = source
    return values, sources


def _entry(name: str, entry: Any, path: Path) -> tuple[Any, str]:
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
    if name in (*CURVES, "throughput_factor") and isinstance(entry, str):
        curve = Curve.read(path.parent / entry)
        return curve, curve.source
    if name in CURVES and isinstance(entry, int | float) and not isinstance(entry, bool):
        return Curve.flat(float(entry), source), source
    if name == "pixel_map" and isinstance(entry, str):
        pixel_map = PixelMap.read(path.parent / entry)
        return pixel_map, pixel_map.source
    if name == "throughput_errors" and isinstance(entry, str):
        errors = ThroughputErrors.read(path.parent / entry)
        return errors, errors.source
    return entry, source
