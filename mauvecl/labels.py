"""What rows of answers are called, and what their readers must be told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.study import UNITS, Star

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation


def label(star: Star, x: Expectation) -> str:
    """A star's name with its magnitude, for tables and pictures."""
    name = star.library or x.name
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}"


def told(expectations: list[Expectation]) -> list[str]:
    """Their messages, each once, saturation first."""
    messages = list(dict.fromkeys(message for x in expectations for message in x.messages))
    return sorted(messages, key=lambda m: not m.startswith("SATURATED"))


def put_first(table: QTable, values: Mapping[str, float | str]) -> None:
    """Columns of one value each in front of a table, with their units."""
    import astropy.units as u

    for place, (name, value) in enumerate(values.items()):
        column = np.full(len(table), value)
        table.add_column(column * u.Unit(UNITS[name]) if name in UNITS else column, name=name, index=place)


def titled(name: str, at: Mapping[str, float | str]) -> str:
    """A star with the values of its cell, for pictures; its magnitude and name are there already."""
    units = {"flare_temperature": " K", "exposure": " s", "detector_temperature": " deg C", "sky": " mag/arcsec2"}
    parts = [
        f"{quantity.replace('_', ' ')} {value:g}{units.get(quantity, '')}"
        for quantity, value in at.items()
        if quantity not in ("magnitude", "star") and not isinstance(value, str)
    ]
    return ", ".join([name, *parts])
