"""Photometric bands and synthetic photometry with embedded bands and Vega.

As synphot has it, to the last bit (the tests compare them): photons per Angstrom straight between the points of a
spectrum, and trapezoids over the points of spectrum and band together. Loading synphot and its models took longer
than all else that a star needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import astropy.units as u
import numpy as np
from astropy.constants import c, h
from numpy.typing import NDArray

from ..errors import InputError
from ..files.bounded import shortened
from ..remembered import remembered
from .band_names import known_band
from .catalogue import band_table, find, spectrum_table

Float = NDArray[np.float64]

#: What a magnitude may mean: what catalogues print in the band, Vega at zero in every band, or AB.
System = Literal["catalogue", "vega", "ab"]
SYSTEMS: tuple[System, ...] = get_args(System)
#: A spectrum must cover this share of a band's throughput.
COVERAGE = 0.99
#: Angstrom to a nanometre, and h c in erg Angstrom, with astropy's own rounding.
ANGSTROM = float(u.nm.to(u.AA))
HC = float(h.cgs.value * c.to_value(u.AA / u.s))
#: Wavelengths nearer to each other than this are one, Angstrom (synphot).
SAME = 1e-12
#: AB = 0, erg s-1 cm-2 Hz-1 (Oke & Gunn 1983, doi 10.1086/160817: -48.60).
AB_ZERO = 10.0 ** (48.6 / -2.5)


@dataclass(frozen=True, eq=False)
class Band:
    """A photometric band.

    Attributes
    ----------
    name : str
    system : {"Vega", "AB"}
        What catalogues' magnitudes in it mean.
    vega : float
        Vega's magnitude in them; NaN for AB, where it is no zero point.
    zero_point : str
        Where that is from.
    origin : str
    wavelength_nm, throughput : ndarray, shape (n,)
        Response per photon, relative.
    """

    name: str
    system: Literal["Vega", "AB"]
    vega: float
    zero_point: str
    origin: str
    wavelength_nm: Float
    throughput: Float


def band(name: str) -> Band:
    """A band by name or alias, in any case.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    return _load(known_band(name))


@cache
def _load(name: str) -> Band:
    table = band_table(f"{name.lower().replace(' ', '_')}.ecsv")
    return Band(
        name=name,
        system=table.meta["system"],
        vega=float(table.meta.get("vega", np.nan)),
        zero_point=table.meta["zero_point"],
        origin=table.meta["origin"],
        wavelength_nm=table["wavelength"],
        throughput=table["throughput"],
    )


def scale(name: str, system: System = "catalogue") -> str:
    """What magnitudes in a band mean, as a sentence.

    Raises
    ------
    InputError
        For an unknown band or system.
    """
    chosen = band(name)
    _check_system(system)
    if system == "vega":
        return f"Magnitudes in {chosen.name} have Vega at 0, unlike catalogues'."
    if system == "ab":
        return f"Magnitudes in {chosen.name} are AB."
    meaning = "AB" if chosen.system == "AB" else f"Vega has {chosen.vega:g}"
    return f"Magnitudes in {chosen.name} are as in catalogues: {meaning}."


def _check_system(system: str) -> None:
    if system not in SYSTEMS:
        raise InputError(f"magnitude system {shortened(str(system))} is unknown, expected one of {', '.join(SYSTEMS)}")


@remembered(256)
def magnitude(wavelength_nm: Float, flux_flam: Float, name: str = "V", system: System = "catalogue") -> float:
    """Synthetic magnitude in a band.

    Parameters
    ----------
    wavelength_nm : ndarray, shape (n,)
    flux_flam : ndarray, shape (n,)
        erg s-1 cm-2 A-1.
    name : str
    system : {"catalogue", "vega", "ab"}
        What catalogues print in the band (its record holds the zero point, with its source), Vega at zero, or AB.

    Raises
    ------
    InputError
        For an unknown band or system, a band that the spectrum does not cover, or no light in it.
    """
    _check_system(system)
    chosen = _covered(wavelength_nm, name)
    grid = np.union1d(wavelength_nm, chosen.wavelength_nm) * 10.0
    star = _integral(grid, *_light(wavelength_nm, flux_flam, chosen), chosen)
    if not star > 0.0:
        raise InputError(f"the spectrum has no light in the band {chosen.name}, expected a positive flux")
    if system == "ab" or (system == "catalogue" and chosen.system == "AB"):
        return _ab(star, grid, chosen)
    vega = math.log10(photons(*_vega(), chosen.name))
    return 2.5 * (vega - math.log10(star)) + (chosen.vega if system == "catalogue" else 0.0)


@remembered(256)
def photons(wavelength_nm: Float, flux_flam: Float, name: str) -> float:
    """Photons s-1 cm-2 in a band, weighted with its throughput; errors as `magnitude`."""
    chosen = _covered(wavelength_nm, name)
    at, light = _light(wavelength_nm, flux_flam, chosen)
    grid = np.union1d(at, chosen.wavelength_nm * ANGSTROM)
    return _integral(grid[np.append(np.diff(grid) > SAME, True)], at, light, chosen)


@cache
def _vega() -> tuple[Float, Float]:
    table = spectrum_table(find("Vega")["file"])
    return table["wavelength"], table["flux"]


def _covered(wavelength_nm: Float, name: str) -> Band:
    """A band that a spectrum covers.

    Raises
    ------
    InputError
        If it does not, or there is no such band.
    """
    chosen = band(name)
    inside = (chosen.wavelength_nm >= wavelength_nm[0]) & (chosen.wavelength_nm <= wavelength_nm[-1])
    share = np.trapezoid(chosen.throughput * inside, chosen.wavelength_nm) / np.trapezoid(
        chosen.throughput, chosen.wavelength_nm
    )
    if share < COVERAGE:
        raise InputError(
            f"the spectrum covers {wavelength_nm[0]:.0f}-{wavelength_nm[-1]:.0f} nm, expected {COVERAGE:.0%} of "
            f"the band {chosen.name} ({chosen.wavelength_nm[0]:.0f}-{chosen.wavelength_nm[-1]:.0f} nm), "
            f"not {share:.0%}"
        )
    return chosen


def _light(wavelength_nm: Float, flux_flam: Float, chosen: Band) -> tuple[Float, Float]:
    """Wavelengths, Angstrom, and photons s-1 cm-2 A-1 there.

    A spectrum that ends within the band goes down to nothing within one more step of the same ratio.
    """
    at = wavelength_nm * ANGSTROM
    light = flux_flam * at / HC
    seen = chosen.wavelength_nm[chosen.throughput > 0.0] * ANGSTROM
    if at[0] <= seen[0] and seen[-1] <= at[-1]:
        return at, light
    before, after = at[0] ** 2 / at[1], at[-1] ** 2 / at[-2]
    return np.array([before, *at, after]), np.array([0.0, *light, 0.0])


def _integral(grid: Float, at: Float, light: Float, chosen: Band) -> float:
    """Photons s-1 cm-2 in a band by trapezoids between the wavelengths of a grid, Angstrom."""
    through = _between(grid, chosen.wavelength_nm * ANGSTROM, chosen.throughput)
    return float(np.trapezoid(_between(grid, at, light) * through, grid))


def _between(grid: Float, at: Float, values: Float) -> Float:
    """Straight between points, the end values beyond them; weighted as scipy's `interpn` does, which synphot calls."""
    after = np.clip(np.searchsorted(at, grid, side="right"), 1, at.size - 1)
    share = np.clip((grid - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
    return np.asarray(values[after - 1] * (1.0 - share) + values[after] * share)


def _ab(star: float, grid: Float, chosen: Band) -> float:
    """The AB magnitude of so many photons: their mean flux to a wavelength, at the band's pivot to a frequency."""
    at, through = chosen.wavelength_nm * ANGSTROM, chosen.throughput
    pivot = float(np.sqrt(np.trapezoid(through * at, at) / np.trapezoid(through / at, at)))
    mean = HC * star / float(np.trapezoid(grid * _between(grid, at, through), grid))
    return -2.5 * math.log10(mean * pivot**2 / c.to_value(u.AA / u.s) / AB_ZERO)
