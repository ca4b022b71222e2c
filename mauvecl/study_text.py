"""A study's text: keys set one by one, the study inside an answer's table, and a sentence for the first fault."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from mauvecl.host.errors import InputError


def study_of(path: Path) -> str:
    """The study in an answer's meta data."""
    from astropy.table import Table

    try:
        study = Table.read(path, format="ascii.ecsv").meta["study"]
    except (ValueError, KeyError) as error:
        raise InputError(f"{path.name} holds no study, expected an answer's ECSV table") from error
    return str(study)


def toml_value(text: str) -> Any:
    """A value as TOML has it; a bare word is text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def put(data: Any, path: list[str], value: Any, text: str) -> None:
    *parents, last = path
    for part in parents:
        if isinstance(data, list | tuple):
            if not (part.isdigit() and int(part) < len(data)):
                raise InputError(f"--set {text!r}: no entry {part!r}, expected 0 to {len(data) - 1}")
            data = data[int(part)]
        else:
            data = data.setdefault(part, {})
    if not isinstance(data, dict):
        raise InputError(f"--set {text!r}: {'.'.join(parents)} holds no keys, expected one that does")
    data[last] = value


def sentence(model: type[BaseModel], error: ValidationError) -> str:
    """The first fault as: key = value, what was expected."""
    first = error.errors()[0]
    path = [str(part) for part in first["loc"]]
    key = ".".join(path) or "study"
    if first["type"] == "extra_forbidden":
        fields = list(_fields(model, path[:-1]))
        near = difflib.get_close_matches(path[-1], fields, n=1)
        expected = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(fields)}"
        return f"unknown key {key!r}, {expected}"
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    return f"{key} = {first['input']!r}: {first['msg'].lower()}"


def _fields(model: type[BaseModel], path: list[str]) -> Any:
    for part in path:
        if not part.isdigit():
            model = _model_in(model.model_fields[part].annotation) or model
    return model.model_fields


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model in a type such as `Star | None` or `tuple[Star, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := _model_in(part))), None)
