"""Labels of stars and cells, and columns that many tables share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mauvecl.schema.tables import Column, percent, short
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.sections import Star

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.questions import Sweep


def label(star: Star, x: Expectation) -> str:
    """Return a star's name and magnitude, for tables and plots."""
    name = star.library or x.name
    system = {"catalogue": "", "vega": " (Vega = 0)", "ab": " (AB)"}[star.magnitude_system]
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}{system}"


def place_columns(sweep: Sweep, *own: str, star: str = "label") -> tuple[Column, ...]:
    """Return the columns of the star and of the swept quantities, for rows with the values `at` a cell of the sweep.

    `own` names quantities for which a table has separate columns, and `star` the attribute with the star's label.
    """
    return (
        star_column(star),
        *(quantity_column(axis.quantity) for axis in sweep.axes if axis.quantity not in own),
    )


def star_column(get: str = "star") -> Column:
    """Return the column of a star's label."""
    return Column("star", get, description=QUANTITIES["star"].description, heading="star", kind=str)


def quantity_column(name: str, get: str | Callable[[Any], Any] = "", description: str = "") -> Column:
    """Return the column of a quantity, by default of its value `at` a cell of the sweep."""
    quantity = QUANTITIES[name]
    return Column(
        name, get or (lambda row: row.at[name]), quantity.unit, description or quantity.description, name, short
    )


def amplitude_column(get: str | Callable[[Any], Any] = "amplitude", description: str = "") -> Column:
    """Return the column of a flare's amplitude, which people read in per cent."""
    return replace(quantity_column("amplitude", get, description), heading="flare", format=percent("g"))


def full_label(name: str, at: Mapping[str, float | str]) -> str:
    """Return a star's label with the swept values that the label does not contain, for plots."""
    parts = [
        f"{quantity.replace('_', ' ')} {value:g}{QUANTITIES[quantity].suffix}"
        for quantity, value in at.items()
        if quantity not in ("magnitude", "star") and not isinstance(value, str)
    ]
    return ", ".join([name, *parts])
