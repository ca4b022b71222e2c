"""Stars whose spectrum is a formula: blackbodies and power laws, by names such as "blackbody 9000 K"."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mauvecl.schema.fields import Range, checked, checked_number
from mauvecl.schema.physical import Temperature

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Names by which they are offered.
EXAMPLES = ("blackbody 9000 K", "power law -2")
#: Indices of power laws that are accepted; steeper spectra say nothing of stars (assumed).
INDEX = Range(-10, 10)
#: First and last wavelength of the spectra, nm, and number of points: they cover all bands, and straight lines between
#: them are true to 2e-5 for 3000 K at 200 nm, and closer elsewhere and for hotter stars.
GRID = (100.0, 3000.0, 8000)
#: Wavelength at which a power law has unit flux, nm.
PIVOT_NM = 550.0
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_NAME = re.compile(
    rf"\s*(?:(?P<body>black[ -]?body|planck)\s+(?P<kelvin>{_NUMBER})\s*K?|power[ -]?law\s+(?P<index>{_NUMBER}))\s*",
    flags=re.IGNORECASE,
)


@dataclass(frozen=True)
class ModelStar:
    """Blackbody of a temperature, or power law of an index; exactly one of them is given."""

    temperature_k: float | None
    index: float | None

    @classmethod
    def named(cls, text: str) -> ModelStar | None:
        """Return the star of a name such as "blackbody 9000 K" or "power law -2", or None for another name.

        Raises InputError if the number is out of range.
        """
        found = _NAME.fullmatch(text)
        if found is None:
            return None
        if found["body"] is not None:
            return cls(checked(Temperature, "temperature of the blackbody", float(found["kelvin"])), None)
        return cls(None, checked_number("index of the power law", float(found["index"]), "", INDEX))

    @property
    def name(self) -> str:
        """Name that gives this star again."""
        return f"blackbody {self.temperature_k:.15g} K" if self.index is None else f"power law {self.index:.15g}"

    @property
    def origin(self) -> str:
        """Formula of the spectrum."""
        return "Planck's law" if self.index is None else f"flux per wavelength proportional to its power {self.index:g}"

    def spectrum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return wavelengths, nm, and fluxes, erg s-1 cm-2 A-1, of an arbitrary level."""
        import numpy as np

        nm = np.geomspace(*GRID)
        if self.index is not None:
            return nm, (nm / PIVOT_NM) ** self.index
        from .blackbody import blackbody

        assert self.temperature_k is not None
        return nm, blackbody(nm, self.temperature_k)
