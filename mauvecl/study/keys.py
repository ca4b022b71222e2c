"""Keys of a study: their fields, with flags, widgets, units and ranges as metadata."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from mauvecl.schema.fields import Flag, found
from mauvecl.schema.section import fields_of
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic.fields import FieldInfo


@cache
def study_keys() -> Mapping[str, FieldInfo]:
    """Return the field of every key of a study, by its path, as in ``run.fap``."""
    return {".".join(path): field for path, field in fields_of(Study)}


@cache
def keys_with_flags() -> tuple[tuple[str, FieldInfo, Flag], ...]:
    """Return key, field and metadata of every flag of a study."""
    return tuple((key, field, flag) for key, field in study_keys().items() for flag in found(field, Flag))
