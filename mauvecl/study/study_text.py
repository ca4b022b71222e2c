"""A study's text: keys set one by one, the study inside an answer's table, and a sentence for the first fault."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.files.ecsv import read_ecsv
from mauvecl.host.files.parsed import parsing, shown


def study_of(path: Path) -> str:
    """The study in an answer's meta data."""
    study = read_ecsv(path, "study", "an answer's ECSV table").meta.get("study")
    if not isinstance(study, str):
        raise InputError(f"{path.name} holds no study, expected an answer's ECSV table")
    return study


def toml_value(text: str) -> Any:
    """A value as TOML has it; a bare word is text."""
    with parsing(f"value {shortened(text)}", "a value as TOML has it"):
        try:
            found = tomllib.loads(f"value = {text}")
        except tomllib.TOMLDecodeError:
            return text
    # Several lines would be several keys.
    return found["value"] if len(found) == 1 else text


def put(data: Any, path: list[str], value: Any, text: str) -> None:
    *parents, last = path
    for part in parents:
        if isinstance(data, list | tuple):
            if part not in (numbers := [str(i) for i in range(len(data))]):
                raise InputError(
                    f"--set {shortened(text)}: no entry {shortened(part)}, expected 0 to {len(numbers) - 1}"
                )
            data = data[int(part)]
        elif isinstance(data, dict):
            data = data.setdefault(part, {})
    if not isinstance(data, dict):
        raise InputError(
            f"--set {shortened(text)}: {shortened('.'.join(parents))} holds no keys, expected one that does"
        )
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
        return f"unknown key {shortened(key)}, {expected}"
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    return f"{key} = {shown(first['input'])}: {first['msg'].lower()}"


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
