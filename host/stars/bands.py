"""Photometric bands and synthetic photometry with embedded bands and Vega.

The results equal synphot's to the last bit (tested): photons per Angstrom are linear between the points of a spectrum,
and integrals are trapezoidal over the union of the points of spectrum and band. Importing synphot would take longer
than everything else that a star needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import astropy.units as u
import numpy as np
from astropy.constants import c, h
from numpy.typing import NDArray

from mauvecl.host.arrays import array_cache
from mauvecl.host.stars.library import embedded, known_band, spectrum_table
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]

#: Magnitude systems: that of catalogues in the band, Vega at zero in every band, or AB.
System = Literal["catalogue", "vega", "ab"]
#: Fraction of a band's throughput that a spectrum must cover.
COVERAGE = 0.99
#: Angstrom per nanometre, with astropy's rounding.
ANGSTROM = float(u.nm.to(u.AA))
#: h c in erg Angstrom, with astropy's rounding.
HC = float(h.cgs.value * c.to_value(u.AA / u.s))
#: Distance up to which two wavelengths count as one, Angstrom (synphot).
SAME_WAVELENGTH_A = 1e-12
#: AB = 0, erg s-1 cm-2 Hz-1 (Oke & Gunn 1983, doi 10.1086/160817: -48.60).
AB_ZERO = 10.0 ** (48.6 / -2.5)


@dataclass(frozen=True, eq=False)
class Band:
    """A photometric band."""

    name: str
    system: Literal["Vega", "AB"]  # magnitude system of catalogues in this band
    vega: float  # Vega's magnitude in that system; NaN for AB
    wavelength_nm: Float  # shape (n,)
    throughput: Float  # relative response per photon, shape (n,)


@cache
def band(name: str) -> Band:
    """Return a band, given its name or alias in any case."""
    name = known_band(name)
    table = spectrum_table(f"{name.lower().replace(' ', '_')}.ecsv", "bands")
    vega = float(table.meta.get("vega", np.nan))
    return Band(name, table.meta["system"], vega, table["wavelength"], table["throughput"])


def scale(name: str, system: System = "catalogue") -> str:
    """Return a sentence that explains the magnitudes of a system in a band."""
    chosen = band(name)
    if system == "vega":
        return f"Magnitudes in {chosen.name} have Vega at 0, unlike catalogues'."
    if system == "ab":
        return f"Magnitudes in {chosen.name} are AB."
    meaning = "AB" if chosen.system == "AB" else f"Vega has {chosen.vega:g}"
    return f"Magnitudes in {chosen.name} are as in catalogues: {meaning}."


@array_cache(256)
def magnitude(wavelength_nm: Float, flux_flam: Float, name: str = "V", system: System = "catalogue") -> float:
    """Return the synthetic magnitude of a flux, erg s-1 cm-2 A-1, in the band of a name or alias.

    Raises InputError if the spectrum does not cover the band or has no light in it.
    """
    chosen = _covered(wavelength_nm, name)
    grid = np.union1d(wavelength_nm, chosen.wavelength_nm) * 10.0
    star = _photon_rate(grid, *_photon_density(wavelength_nm, flux_flam, chosen), chosen)
    if not star > 0.0:
        raise InputError(f"the spectrum must have light in the band {chosen.name}, but has none", key="band")
    if system == "ab" or (system == "catalogue" and chosen.system == "AB"):
        # The mean flux per wavelength, converted at the pivot wavelength.
        at, through = chosen.wavelength_nm * ANGSTROM, chosen.throughput
        pivot = float(np.sqrt(np.trapezoid(through * at, at) / np.trapezoid(through / at, at)))
        mean = HC * star / float(np.trapezoid(grid * _interpolate(grid, at, through), grid))
        return -2.5 * math.log10(mean * pivot**2 / c.to_value(u.AA / u.s) / AB_ZERO)
    vega = math.log10(photons(*_vega(), chosen.name))
    return 2.5 * (vega - math.log10(star)) + (chosen.vega if system == "catalogue" else 0.0)


@array_cache(256)
def photons(wavelength_nm: Float, flux_flam: Float, name: str) -> float:
    """Return the photons s-1 cm-2 in a band, weighted by its throughput; raises as `magnitude`."""
    chosen = _covered(wavelength_nm, name)
    at, light = _photon_density(wavelength_nm, flux_flam, chosen)
    grid = np.union1d(at, chosen.wavelength_nm * ANGSTROM)
    return _photon_rate(grid[np.append(np.diff(grid) > SAME_WAVELENGTH_A, True)], at, light, chosen)


@cache
def _vega() -> tuple[Float, Float]:
    vega = embedded("Vega")
    assert vega is not None
    table = spectrum_table(vega["file"])
    return table["wavelength"], table["flux"]


def _covered(wavelength_nm: Float, name: str) -> Band:
    """Return a band; raises InputError if the spectrum does not cover it."""
    chosen = band(name)
    inside = (chosen.wavelength_nm >= wavelength_nm[0]) & (chosen.wavelength_nm <= wavelength_nm[-1])
    seen, whole = np.trapezoid([chosen.throughput * inside, chosen.throughput], chosen.wavelength_nm)
    share = seen / whole
    if share < COVERAGE:
        band_nm, own_nm = (f"({nm[0]:.0f}-{nm[-1]:.0f} nm)" for nm in (chosen.wavelength_nm, wavelength_nm))
        needed = f"{COVERAGE:.0%} of the band {chosen.name} {band_nm}"
        raise InputError(f"the spectrum must cover {needed}, but covers {share:.0%} {own_nm}", key="band")
    return chosen


def _photon_density(wavelength_nm: Float, flux_flam: Float, chosen: Band) -> tuple[Float, Float]:
    """Return wavelengths, Angstrom, and photon flux densities, photons s-1 cm-2 A-1.

    A spectrum that ends within the band falls to zero over one more step of the same ratio, as in synphot.
    """
    at = wavelength_nm * ANGSTROM
    light = flux_flam * at / HC
    seen = chosen.wavelength_nm[chosen.throughput > 0.0] * ANGSTROM
    if at[0] <= seen[0] and seen[-1] <= at[-1]:
        return at, light
    before, after = at[0] ** 2 / at[1], at[-1] ** 2 / at[-2]
    return np.array([before, *at, after]), np.array([0.0, *light, 0.0])


def _photon_rate(grid: Float, at: Float, light: Float, chosen: Band) -> float:
    """Integrate photons s-1 cm-2 in a band by the trapezoidal rule on a grid in Angstrom."""
    through = _interpolate(grid, chosen.wavelength_nm * ANGSTROM, chosen.throughput)
    return float(np.trapezoid(_interpolate(grid, at, light) * through, grid))


def _interpolate(grid: Float, at: Float, values: Float) -> Float:
    """Interpolate linearly and extend by the end values, with the rounding of scipy's `interpn` (synphot's choice)."""
    after = np.clip(np.searchsorted(at, grid, side="right"), 1, at.size - 1)
    share = np.clip((grid - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
    return np.asarray(values[after - 1] * (1.0 - share) + values[after] * share)
