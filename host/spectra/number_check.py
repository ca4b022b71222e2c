"""Check that a spectrum's wavelengths are distinct and its numbers are in range for double precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

#: Range of wavelengths, nm, from gamma rays to metre waves, whose products stay within double precision.
NEAREST_NM, FARTHEST_NM = 1e-6, 1e9
#: Smallest relative distance of two wavelengths; each conversion rounds by about 1e-16.
CLOSEST = 1e-12
#: Range of a spectrum's largest flux, erg s-1 cm-2 A-1, from 1e-21 for the faintest stars to 1e10 at a white dwarf's
#: surface, with margins.
FAINTEST, BRIGHTEST = 1e-40, 1e30


def check_values(name: str, wavelength: NDArray[np.float64], flux: NDArray[np.float64]) -> None:
    """Raise InputError for numbers out of range, or two wavelengths that are equal to within rounding.

    Parameters
    ----------
    wavelength, flux : ndarray, shape (n,)
        nm, finite and increasing, and erg s-1 cm-2 A-1.
    """
    outside = np.flatnonzero((wavelength < NEAREST_NM) | (wavelength > FARTHEST_NM))
    if outside.size:
        i = int(outside[0])
        raise InputError.of(
            "wavelength",
            wavelength[i],
            f"{NEAREST_NM:g} to {FARTHEST_NM:g} nm",
            where=f"spectrum {name}, point {i + 1}",
        )
    close = np.flatnonzero(np.diff(wavelength) < CLOSEST * wavelength[1:])
    if close.size:
        i = int(close[0])
        raise InputError(
            f"spectrum {name}: wavelengths {float(wavelength[i])!r} and {float(wavelength[i + 1])!r} nm at "
            f"points {i + 1} and {i + 2} are the same to within rounding",
            f"wavelengths that differ by {CLOSEST:g} of their value",
            key="wavelength",
            value=float(wavelength[i]),
        )
    # Undefined ends are cut later.
    largest = float(np.abs(flux[np.isfinite(flux)]).max(initial=0.0))
    if largest and not FAINTEST <= largest <= BRIGHTEST:
        raise InputError.of("flux", largest, f"{FAINTEST:g} to {BRIGHTEST:g}", where=f"spectrum {name}, largest value")
