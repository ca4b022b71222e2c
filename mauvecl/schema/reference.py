"""Reference of all keys of a section, from the metadata of its fields."""

from __future__ import annotations

from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from mauvecl.schema.fields import Flag, Help, Range, Unit, first, found
from mauvecl.schema.records import model_in
from mauvecl.schema.section import fields_of


class Key(NamedTuple):
    """Row of the reference."""

    path: str
    meaning: str
    accepted: str
    default: str
    flags: str


def keys_of(section: type[BaseModel]) -> list[Key]:
    """Return the reference of every key of a section and of the sections in it, in the order of their declaration."""
    return [
        Key(
            ".".join(path),
            _meaning(first(field, Help)),
            _accepted(field.annotation, (first(field, Unit) or Unit("")).name, first(field, Range)),
            _default(field, first(field, Help)),
            ", ".join(name for flag in found(field, Flag) for name in flag.names),
        )
        for path, field in fields_of(section)
        if first(field, Help) is not None
    ]


def _meaning(help: Help | None) -> str:
    if help is None:
        return ""
    return help.text + (f": {help.choices}" if help.choices else "") + (f", {help.more}" if help.more else "")


def _accepted(annotation: Any, unit: str, reach: Range | None) -> str:
    """Describe the values of a type in words."""
    inner, parts = annotation, get_args(annotation)
    if get_origin(annotation) is Annotated:
        return _accepted(parts[0], unit, reach)
    if get_origin(annotation) in (Union, UnionType):
        return " or ".join(dict.fromkeys(_accepted(part, unit, reach) for part in parts if part is not NoneType))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, parts))
    if get_origin(annotation) is tuple:
        several = parts[-1] is Ellipsis
        return f"list of {_accepted(parts[0], unit, reach)}" if several else f"{len(parts)} numbers"
    if get_origin(annotation) is dict:
        return f"table of {_accepted(parts[1], unit, reach)}"
    if model_in(annotation) is not None:
        return "table"
    if inner in (float, int):
        return (reach or Range()).words(unit, whole=inner is int)
    return {str: "text", bool: "true or false", Path: "path"}.get(inner, "file")


def _default(field: Any, help: Help | None) -> str:
    if help is not None and help.default:
        return help.default
    value = field.get_default(call_default_factory=True)
    return "required" if value is PydanticUndefined else _text(value)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    if value is None or isinstance(value, BaseModel | dict):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)
