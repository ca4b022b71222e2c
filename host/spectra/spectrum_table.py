"""Tables of spectra as stored in files, with what their files say of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mauvecl.host.spectra.column_roles import Role, role_of
from mauvecl.host.tables.medium import Medium
from mauvecl.host.tables.table import Values


@dataclass(frozen=True)
class SpectrumTable:
    """Table of a file with its metadata."""

    columns: Sequence[Values]
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
    #: Roles of the columns, if known from more than their names, units and descriptors.
    known_roles: Sequence[Role] = ()

    @property
    def roles(self) -> Sequence[Role]:
        """Roles of the columns."""
        return self.known_roles or [role_of(one.name, one.unit, one.ucd) for one in self.columns]
