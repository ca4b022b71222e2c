"""What every section of a study is made of."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationInfo, field_validator

from mauvecl.host.quantities import is_quantity, numbers, unit_of
from mauvecl.host.records import Record


def plain(key: str, given: Any) -> Any:
    """What a study holds of a value: Quantities, times and places are kept as numbers and text."""
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


class Part(Record):
    """A section of a study."""

    @field_validator("*", mode="before")
    @classmethod
    def _in_its_unit(cls, given: Any, info: ValidationInfo) -> Any:
        """A Quantity as plain numbers in the unit of the key; other objects of astropy's as text."""
        return plain(info.field_name or "", given)
