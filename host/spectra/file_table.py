"""Tables of spectra as stored in files, which all readers return."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.errors import InputError

from ..tables.medium import Medium
from .column_roles import Role, role_of

Float = NDArray[np.float64]

#: Values of at least this mark missing measurements (IRAF's INDEF is 1.6e38).
INDEFINITE = 1e38


@dataclass(frozen=True)
class Column:
    """Column of a file."""

    name: str
    #: Function that returns the values, shape (n,), or (n_row, n) if each row contains a spectrum.
    values: Callable[[], Any]
    #: Unit as stated in the file.
    unit: str | None = None
    #: IVOA unified content descriptor.
    ucd: str = ""
    #: Role, if known from more than the name.
    role: Role | None = None

    @property
    def known_role(self) -> Role:
        """Role of the column."""
        return self.role or role_of(self.name, self.unit, self.ucd)

    def with_unit(self, unit: str) -> Column:
        """Return the column with a unit from elsewhere in the file."""
        return replace(self, unit=unit, role=None if self.role is None else replace(self.role, unit=unit))


@dataclass(frozen=True)
class FileTable:
    """Table of a file with its metadata."""

    columns: Sequence[Column]
    name: str
    origin: str
    #: Name by which users select it among the tables of a file.
    label: str = ""
    #: Units of wavelength and flux that the format implies if none is stated.
    implied_units: tuple[str, str] | None = None
    #: Text of the header that may mention air, the star's surface or its dust.
    remarks: str = ""
    #: Function that returns the medium of the wavelengths that keywords state.
    medium: Callable[[], Medium | None] = lambda: None
    notes: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    #: Group; tables of the same group are parts of one spectrum.
    group: str | None = None
    #: Reason why fluxes need a magnitude; empty if they are those at the telescope.
    unscaled: str = ""
    #: Identifiers of its rows, if stored in another table.
    row_names: Sequence[str] = ()
    #: Format of a spectrum's name from the identifier of its row, as in ``Gaia DR3 {}``.
    row_title: str = ""


def numbers(values: ArrayLike, what: str) -> Float:
    """Convert values to floats, with NaN for masked values and missing measurements."""
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
        raise InputError(f"{what} does not contain plain numbers", "one number in each cell", key=what) from error
    plain_values[~(np.abs(plain_values) < INDEFINITE)] = np.nan
    return plain_values
