"""Detection of wavelengths in air, and their conversion to vacuum."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

#: Words for air, including those of IVOA's UCD (em.wl;obs.atmos) and of FITS (AWAV).
_AIR = re.compile(
    r"\b(?:in|are|is|standard)\s+air\b|\bair\s+wavelengths?|wavelengths?\W{0,3}(?:\(|in\s+)?air\b|\bawav"
    r"|\bem\.wl;obs\.a|_air(?:\b|_)|\bair_|\(air\)",
    re.IGNORECASE,
)
_VACUUM = re.compile(r"(?:\b|_)vac(?:uum)?(?:\b|_)|\bvacuum", re.IGNORECASE)


def vacuum_wavelengths(
    nm: Float, column: str, remarks: str, medium: str | None = None
) -> tuple[Float, tuple[str, ...]]:
    """Return vacuum wavelengths, nm, and messages about them.

    Parameters
    ----------
    nm : ndarray, shape (n,)
    column : str
        Name of their column, which takes precedence over remarks.
    remarks : str
        Text of the file's header.
    medium : {"air", "vacuum"}, optional
        Medium given by the user, which takes precedence over everything else.
    """
    messages: tuple[str, ...] = ()
    for text in (column, remarks) if medium is None else ():
        air, vacuum = bool(_AIR.search(text)), bool(_VACUUM.search(text))
        if air and vacuum:
            messages = ("its header speaks of air and of vacuum: ASSUMED vacuum; `wavelength_unit='nm air'` says air",)
        if air or vacuum:
            medium = "vacuum" if vacuum else "air"
            break
    if medium != "air":
        return nm, messages
    return vacuum_from_air(nm), ("its wavelengths are in air, converted to vacuum (Ciddor 1996, above 200 nm)",)


def vacuum_from_air(air_nm: Float) -> Float:
    """Return vacuum wavelengths, nm, of wavelengths in standard air (15 C, 101325 Pa, dry, 450 ppm CO2).

    Ciddor 1996, Applied Optics 35, 1566, equation 1, doi 10.1364/AO.35.001566. Wavelengths below 200 nm are vacuum
    wavelengths by convention and remain unchanged (Morton 1991, ApJS 77, 119).
    """
    vacuum = air_nm.copy()
    there = np.isfinite(air_nm) & (air_nm >= 200.0)
    for _ in range(4):
        # Squared wavenumber, um-2. The index hardly changes over the shift, so the iteration converges at once.
        wavenumber2 = (1000.0 / vacuum[there]) ** 2
        index = 1.0 + 0.05792105 / (238.0185 - wavenumber2) + 0.00167917 / (57.362 - wavenumber2)
        vacuum[there] = air_nm[there] * index
    return vacuum
