"""Base class of the sections of a study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, Self

from pydantic import BaseModel, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from mauvecl.schema.fields import Unit, first
from mauvecl.schema.quantities import is_quantity, numbers
from mauvecl.schema.records import Record, model_in


def plain(key: str, given: Any, unit: str) -> Any:
    """Convert Quantities, times and coordinates to the numbers and text that a study stores."""
    if is_quantity(given):
        return numbers(key, given, unit).tolist()
    if isinstance(given, list | tuple) and any(map(is_quantity, given)):
        return [plain(key, one, unit) for one in given]
    if hasattr(given, "tolist"):
        return given.tolist()
    if hasattr(given, "utc") and hasattr(given, "isot"):
        return str(given.utc.isot)
    if hasattr(given, "icrs") and hasattr(given, "to_string"):
        return str(given.icrs.to_string("decimal", precision=6))
    return given


class Section(Record):
    """A section of a study."""

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value at a path of sections and a key.

        Each record of a list, such as stars, takes the value; a list of numbers is replaced by it.
        """
        key, *inner = path
        old = getattr(self, key)
        new = value
        if inner:
            many = tuple(one.with_value(inner, value) for one in (old if isinstance(old, tuple) else (old,)))
            new = many if isinstance(old, tuple) else many[0]
        elif isinstance(old, tuple):
            new = (value,)
        return self.model_copy(update={key: new})

    @field_validator("*", mode="before")
    @classmethod
    def _in_its_unit(cls, given: Any, info: ValidationInfo) -> Any:
        """Convert a Quantity to the unit of the key, and times and coordinates to text."""
        key = str(info.field_name)
        unit = _unit_of(cls, key)
        if unit is not None and not getattr(given, "ndim", 0):
            # The annotation converts it.
            return given
        return plain(key, given, "" if unit is None else unit.name)


@cache
def _unit_of(section: type[Section], key: str) -> Unit | None:
    return first(section.model_fields[key], Unit)


def fields_of(section: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Yield the path and the field of every key of a section and of the sections in it."""
    for key, field in section.model_fields.items():
        yield (*path, key), field
        inner = model_in(field.annotation)
        if inner is not None:
            yield from fields_of(inner, (*path, key))
