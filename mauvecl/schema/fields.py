"""Metadata of numbers in annotations: unit and range.

`Annotated[float, Unit("s"), Range(0, 60)]` means the same in a section of a study, which pydantic validates, and in the
signature of a validated function.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from mauvecl.schema.quantities import is_quantity, without_unit, word_of

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema


@dataclass(frozen=True)
class Unit:
    """Unit of a plain number or array, as astropy spells it; Quantities are converted to it."""

    name: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        schema = core_schema.no_info_before_validator_function(self.plain, handler(source))
        return _or_error(schema, word_of(self.name), unit=self.name)

    def plain(self, value: Any) -> Any:
        """Convert a Quantity, or each of a list of them, to plain numbers; return other values unchanged."""
        if isinstance(value, list | tuple):
            return [self.plain(one) for one in value]
        return without_unit(value, self.name) if is_quantity(value) else value


@dataclass(frozen=True)
class Range:
    """Closed range of a finite number; `open_low` and `open_high` exclude an end."""

    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        inner = handler(source)
        unit = (inner.get("metadata") or {}).get("unit", "")
        schema = core_schema.no_info_after_validator_function(self._check, inner)
        return _or_error(schema, self.words(unit, whole=int in (source, *get_args(source))), unit=unit)

    def __contains__(self, value: float) -> bool:
        if not math.isfinite(value) or not self.low <= value <= self.high:
            return False
        return not ((self.open_low and value == self.low) or (self.open_high and value == self.high))

    def _check(self, value: Any) -> Any:
        if value is not None and value not in self:
            raise ValueError(value)
        return value

    def words(self, unit: str = "", *, whole: bool = False) -> str:
        """Return what is accepted, for the message of an error."""
        noun = "a whole number" if whole else word_of(unit)
        low, high = (str(end) if whole else f"{end:g}" for end in (self.low, self.high))
        has_low, has_high = math.isfinite(self.low), math.isfinite(self.high)
        after = f" {unit}" if unit else ""
        if has_low and has_high and not (self.open_low or self.open_high):
            return f"{noun} from {low} to {high}" if whole else f"{low} to {high}{after}"
        ends = [f"above {low}" if self.open_low else f"of at least {low}"] if has_low else []
        ends += [f"below {high}" if self.open_high else f"up to {high}"] if has_high else []
        return f"{noun} {' and '.join(ends)}" if ends else noun


def _or_error(schema: CoreSchema, words: str, **metadata: str) -> CoreSchema:
    """Replace every error of a schema by the statement of what is accepted."""
    from pydantic_core import core_schema

    return core_schema.custom_error_schema(
        schema, "expected", custom_error_message=f"Input should be {words}", metadata=metadata
    )
