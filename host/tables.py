"""Tables whose columns carry units and descriptions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.table import QTable


def make_table(columns: Iterable[tuple[Any, ...]], **meta: object) -> QTable:
    """Make a table of columns given as (name, values), (name, values, description) or (..., description, unit)."""
    import astropy.units as u
    import numpy as np
    from astropy.table import QTable

    table, units = QTable(), cache(u.Unit)
    for name, values, *more in columns:
        text, unit = (*more, "", "")[:2]
        table[name] = np.asarray(values) * units(unit) if unit else values
        table[name].info.description = text or None
    table.meta |= meta
    return table


def set_descriptions(table: QTable, texts: Mapping[str, str]) -> QTable:
    """Set the descriptions of columns in place and return the table."""
    for name, text in texts.items():
        table[name].info.description = text
    return table
