"""Quantities that sweeps, maps and limits vary: the fields of a study with `Quantity` metadata."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mauvecl.schema.fields import Quantity, Range, Unit, checked_number, first
from mauvecl.schema.section import fields_of
from mauvecl.study.sections import Flare, Observation, SkyLight, Star


@dataclass(frozen=True)
class StudyQuantity(Quantity):
    """Quantity of a study, with the unit and range of its field."""

    path: tuple[str, ...]  # sections and key
    unit: str  # in astropy's notation; empty if dimensionless
    range: Range
    is_name: bool  # names instead of numbers

    def checked(self, value: Any) -> float | str:
        """Return a value in the unit of the quantity; raises InputError if it is outside of the range."""
        return value if self.is_name else checked_number(self.name.replace("_", " "), value, self.unit, self.range)

    @property
    def suffix(self) -> str:
        """Unit that follows a value in a title."""
        return f" {Unit(self.unit).written}" if self.unit else ""


QUANTITIES = {
    one.name: StudyQuantity(
        one.name,
        one.description,
        one.label,
        path,
        unit=(first(field, Unit) or Unit("")).name,
        range=first(field, Range) or Range(),
        is_name=first(field, Range) is None,
    )
    for name, section in (("star", Star), ("flare", Flare), ("observation", Observation), ("sky", SkyLight))
    for path, field in fields_of(section, (name,))
    if (one := first(field, Quantity)) is not None
}
#: Units of the quantities that have one.
UNITS = {name: quantity.unit for name, quantity in QUANTITIES.items() if quantity.unit}
