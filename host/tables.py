"""Tables with their columns' units and what they hold, in one place each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.table import QTable


def tabled(columns: Iterable[tuple[Any, ...]], **meta: object) -> QTable:
    """A table, column by column.

    Parameters
    ----------
    columns : iterable of tuple
        Name and values; then what they are, in words; then their unit.
    **meta
    """
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


def telling(table: QTable, texts: Mapping[str, str]) -> QTable:
    """The table, some of its columns told in words."""
    for name, text in texts.items():
        table[name].info.description = text
    return table
