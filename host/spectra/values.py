"""Numbers that a spectrum may hold: those that photometry, in double precision, can tell apart and multiply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

#: Where a wavelength may lie, nm: from gamma rays to metre waves, whose squares and products double precision holds.
NEAREST_NM, FARTHEST_NM = 1e-6, 1e9
#: Neighbours apart by less of their value are one wavelength: conversions round by some 1e-16 each.
CLOSEST = 1e-12
#: Largest flux of a spectrum, erg s-1 cm-2 A-1; the faintest star seen has some 1e-21, a white dwarf's surface 1e10.
FAINTEST, BRIGHTEST = 1e-40, 1e30


def check_values(name: str, wavelength: NDArray[np.float64], flux: NDArray[np.float64]) -> None:
    """Refuse what photometry could only overflow on, or divide by.

    Parameters
    ----------
    name : str
    wavelength, flux : ndarray, shape (n,)
        nm, increasing, and erg s-1 cm-2 A-1; finite.

    Raises
    ------
    InputError
        For a wavelength or a flux out of range, or two wavelengths that are the same to within rounding.
    """
    outside = np.flatnonzero((wavelength < NEAREST_NM) | (wavelength > FARTHEST_NM))
    if outside.size:
        i = int(outside[0])
        raise InputError(
            f"spectrum {name}: wavelength {wavelength[i]:g} nm at point {i + 1}, expected {NEAREST_NM:g} to "
            f"{FARTHEST_NM:g} nm"
        )
    close = np.flatnonzero(np.diff(wavelength) < CLOSEST * wavelength[1:])
    if close.size:
        i = int(close[0])
        raise InputError(
            f"spectrum {name}: wavelengths {float(wavelength[i])!r} and {float(wavelength[i + 1])!r} nm at points "
            f"{i + 1} and {i + 2} are the same to within rounding, expected them apart by {CLOSEST:g} of their value"
        )
    # Undefined ends are cut later.
    largest = float(np.abs(flux[np.isfinite(flux)]).max(initial=0.0))
    if largest and not FAINTEST <= largest <= BRIGHTEST:
        raise InputError(
            f"spectrum {name}: the largest flux is {largest:g} erg s-1 cm-2 A-1, expected {FAINTEST:g} to {BRIGHTEST:g}"
        )
