"""Base class of the sections of a study."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationInfo, field_validator

from mauvecl.schema.fields import Unit
from mauvecl.schema.quantities import is_quantity, numbers, unit_of
from mauvecl.schema.records import Record


def plain(key: str, given: Any) -> Any:
    """Convert Quantities, times and coordinates to the numbers and text that a study stores."""
    if is_quantity(given):
        return numbers(key, given, unit_of(key)).tolist()
    if isinstance(given, list | tuple) and any(map(is_quantity, given)):
        return [plain(key, one) for one in given]
    if hasattr(given, "tolist"):
        return given.tolist()
    if hasattr(given, "utc") and hasattr(given, "isot"):
        return str(given.utc.isot)
    if hasattr(given, "icrs") and hasattr(given, "to_string"):
        return str(given.icrs.to_string("decimal", precision=6))
    return given


class Section(Record):
    """A section of a study."""

    @field_validator("*", mode="before")
    @classmethod
    def _in_its_unit(cls, given: Any, info: ValidationInfo) -> Any:
        """Convert a Quantity to the unit of the key, and times and coordinates to text."""
        name = info.field_name or ""
        if any(isinstance(known, Unit) for known in cls.model_fields[name].metadata):
            # The annotation converts it.
            return given
        return plain(name, given)
