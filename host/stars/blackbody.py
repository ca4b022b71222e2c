"""Blackbodies."""

from __future__ import annotations

import astropy.units as u
import numpy as np
from astropy.constants import c, h, k_B
from numpy.typing import NDArray

from mauvecl.host.arrays import array_cache

#: Angstrom per nanometre, with astropy's rounding.
ANGSTROM = float(u.nm.to(u.AA))


@array_cache(32)
def blackbody(wavelength_nm: NDArray[np.float64], temperature_k: float) -> NDArray[np.float64]:
    """Return the surface flux pi B_lambda of a blackbody, erg s-1 cm-2 A-1, shape (n,)."""
    # The steps of astropy's BlackBody to the last bit, without the slow import of its models.
    metre = u.m.to(u.AA)
    frequency = c.value / (wavelength_nm * ANGSTROM / metre)
    # Overflow in the Wien tail gives zero flux.
    with np.errstate(over="ignore"):
        steps = c.value**2 * np.expm1(h.value * frequency / (k_B.value * temperature_k))
    per_hz = 2.0 * h.value * frequency**3 / steps
    # From W m-2 Hz-1 to erg s-1 cm-2 Hz-1, and to erg s-1 cm-2 A-1.
    return np.asarray(np.pi * (per_hz / 1e-3 / ((c.value / frequency * metre) ** 2 / c.to_value(u.AA / u.s))))
