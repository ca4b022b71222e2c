"""Flux of a line above a straight continuum, with its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Unit
from mauvecl.schema.physical import Wavelength

Float = NDArray[np.float64]

#: Mg II h and k with the continuum on both sides, for spectra of low resolution such as IUE's (0.6 nm), nm: an
#: assumption; definitions of Mg II indices differ between experiments, and none for stars at this resolution was found.
MG_II_NM = (278.5, 281.5)
MG_II_CONTINUUM_NM = ((275.5, 278.0), (282.0, 284.5))
#: Smallest number of pixels of the continuum, for a straight line and a sign of its scatter.
MIN_CONTINUUM = 3


@dataclass(frozen=True, eq=False)
class LineIndex:
    """Lines of one or more spectra.

    Attributes
    ----------
    flux, error : ndarray, shape (...)
        Integral over the band above the continuum, in the unit of the flux times nm, and its standard error; the
        error is NaN if the spectrum has none.
    continuum : ndarray, shape (...)
        Mean of the continuum over the band.
    equivalent_width_nm : ndarray, shape (...)
        Width of the continuum with the light of the line: positive in emission.
    """

    flux: Float
    error: Float
    continuum: Float
    equivalent_width_nm: Float


@validated
def line_index(
    wavelength_nm: Annotated[ArrayLike, Unit("nm")],
    flux: ArrayLike,
    error: ArrayLike | None = None,
    *,
    band_nm: tuple[Wavelength, Wavelength],
    continuum_nm: Sequence[tuple[Wavelength, Wavelength]],
) -> LineIndex:
    """Integrate a line above the straight line through windows of the continuum.

    The index is linear in the fluxes, so that its error follows exactly from those of the pixels, of the continuum's
    as well as of the band's. Pixels across a limit of the band count in part.

    Parameters
    ----------
    wavelength_nm : array_like, shape (n_pixel,)
        Middle of each pixel, ascending.
    flux, error : array_like, shape (..., n_pixel)
        Flux density per nm and its standard error, by which the continuum is weighted. Pixels of the continuum that
        are not finite, or whose error is not positive, are left out.
    band_nm : tuple of float
        Limits of the line.
    continuum_nm : sequence of tuple
        Limits of the windows of the continuum.

    Raises
    ------
    InputError
        If the spectrum does not cover the band, pixels of the band are not finite, or less than three pixels of the
        continuum are left.

    Examples
    --------
    >>> import numpy as np
    >>> from mauvecl.observations.line_index import line_index
    >>> nm = np.linspace(270, 290, 201)
    >>> flux = 2.0 + np.exp(-((nm - 280) ** 2) / 2 / 0.3**2) / 0.3 / np.sqrt(2 * np.pi)
    >>> found = line_index(nm, flux, band_nm=(278.5, 281.5), continuum_nm=[(275.5, 278), (282, 284.5)])
    >>> round(float(found.flux), 4)
    1.0
    """
    nm = np.asarray(wavelength_nm, np.float64)
    if nm.ndim != 1 or nm.size < 2 or not (np.diff(nm) > 0).all():
        raise InputError.of("wavelength_nm", nm.shape, "ascending wavelengths of at least two pixels")
    light = np.asarray(flux, np.float64)
    if not light.ndim or light.shape[-1] != nm.size:
        raise InputError.of("flux", light.shape, f"{nm.size} pixels in the last axis")
    if error is not None and np.shape(error) != light.shape:
        raise InputError.of("error", np.shape(error), f"the shape of the flux, {light.shape}")
    sd = np.ones_like(light) if error is None else np.asarray(error, np.float64)
    edges = np.concatenate([[1.5 * nm[0] - nm[1] / 2], (nm[1:] + nm[:-1]) / 2, [1.5 * nm[-1] - nm[-2] / 2]])
    low, high = band_nm
    if not edges[0] <= low < high <= edges[-1]:
        raise InputError.of("band_nm", band_nm, f"ascending limits within {edges[0]:g}-{edges[-1]:g} nm")
    share = np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
    inside = share > 0
    good = np.isfinite(light) & np.isfinite(sd) & (sd > 0)
    if not good[..., inside].all():
        raise InputError.of("flux", "pixels in the band without a finite flux and a positive error", "none of these")
    windows = np.zeros(nm.size, np.bool_)
    for start, end in continuum_nm:
        windows |= (nm >= start) & (nm <= end)
    left = good & windows
    if (count := int(left.sum(axis=-1).min(initial=nm.size))) < MIN_CONTINUUM:
        raise InputError.of("continuum_nm", f"{count} usable pixels", f"at least {MIN_CONTINUUM} in each spectrum")
    # The integral of the continuum is a linear function of the pixels, by the weights of its least squares.
    design = np.stack([np.ones_like(nm), nm - (low + high) / 2])
    weight = np.where(left, 1.0 / np.where(left, sd, 1.0) ** 2, 0.0)
    normal = np.einsum("ap,...p,bp->...ab", design, weight, design)
    coefficients = np.linalg.solve(normal, (design @ share)[:, None])[..., 0]
    continuum = np.einsum("...a,ap,...p->...p", coefficients, design, weight)
    light, sd = (np.where(left | inside, each, 0.0) for each in (light, sd))
    level = (continuum * light).sum(axis=-1)
    index = (share * light).sum(axis=-1) - level
    variance = ((share - continuum) ** 2 * sd**2).sum(axis=-1)
    mean = level / (high - low)
    return LineIndex(index, np.sqrt(variance) if error is not None else np.full_like(index, np.nan), mean, index / mean)
