"""Tables of spectra as files hold them: what every reader returns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.errors import InputError

from .column_roles import Role, role_of

Float = NDArray[np.float64]

#: Values at and above this mark a missing measurement (IRAF's INDEF is 1.6e38).
INDEFINITE = 1e38


@dataclass(frozen=True)
class Column:
    """A column of a file."""

    name: str
    #: Return the values: shape (n,), or (n_row, n) where each row holds a spectrum.
    values: Callable[[], Any]
    #: The unit as the file states it.
    unit: str | None = None
    #: The value that marks a missing one.
    missing: float | None = None
    #: The IVOA's unified content descriptor.
    ucd: str = ""
    #: What it holds, where that is known otherwise than by its name.
    role: Role | None = None

    @property
    def known_role(self) -> Role:
        """What the column holds."""
        return self.role or role_of(self.name, self.unit, self.ucd)

    def with_unit(self, unit: str) -> Column:
        """Return the column with a unit that is stated elsewhere in the file."""
        return replace(self, unit=unit, role=None if self.role is None else replace(self.role, unit=unit))


@dataclass(frozen=True)
class FileTable:
    """A table of a file, and what the file says about it."""

    columns: Sequence[Column]
    name: str
    origin: str
    #: What a user calls it among the tables of a file.
    label: str = ""
    #: Units of wavelength and flux that the format implies where it states none.
    implied_units: tuple[str, str] | None = None
    #: Words of the header that may speak of air, the star's surface or its dust.
    remarks: str = ""
    notes: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    #: Tables with the same group are parts of one spectrum.
    group: str | None = None
    #: Why its fluxes need a magnitude; empty where they are those at the telescope.
    unscaled: str = ""
    #: Identifiers of its rows, where another table holds them.
    row_names: Sequence[str] = ()
    #: The spectrum's name by the identifier of its row, as in ``Gaia DR3 {}``.
    row_title: str = ""


def numbers(values: ArrayLike, what: str, missing: float | None = None) -> Float:
    """Return values as floats; NaN where they are masked or mark a missing measurement."""
    kind = np.asanyarray(values).dtype.kind
    if kind in "bc":
        held = "true and false" if kind == "b" else "complex numbers"
        raise InputError(f"{what} holds {held}", "real numbers", key=what, value=held)
    try:
        if isinstance(values, np.ma.MaskedArray):
            plain_values = np.ma.filled(values.astype(np.float64), np.nan)
        else:
            plain_values = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} holds no plain numbers", "one number in each cell", key=what) from error
    if missing is not None:
        # Single precision rounds the values, and not the mark in the header.
        plain_values[np.isclose(plain_values, float(missing), rtol=1e-6, atol=0.0)] = np.nan
    plain_values[~(np.abs(plain_values) < INDEFINITE)] = np.nan
    return plain_values
