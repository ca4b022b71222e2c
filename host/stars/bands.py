"""Photometric bands and synthetic photometry, by synphot with embedded bands and Vega."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.bounded import shortened
from ..remembered import remembered
from .band_names import known_band
from .catalogue import band_table, find, spectrum_table

#: What a magnitude may mean: what catalogues print in the band, Vega at zero in every band, or AB.
System = Literal["catalogue", "vega", "ab"]
SYSTEMS: tuple[System, ...] = get_args(System)
#: A spectrum must cover this share of a band's throughput.
COVERAGE = 0.99


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
    wavelength_nm: NDArray[np.float64]
    throughput: NDArray[np.float64]

    def element(self) -> Any:
        """The band as a synphot SpectralElement."""
        import astropy.units as u
        from synphot import Empirical1D, SpectralElement

        return SpectralElement(Empirical1D, points=self.wavelength_nm * u.nm, lookup_table=self.throughput)


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
        wavelength_nm=np.asarray(table["wavelength"], float),
        throughput=np.asarray(table["throughput"], float),
    )


def synphot_spectrum(wavelength_nm: NDArray[np.float64], flux_flam: NDArray[np.float64]) -> Any:
    """Arrays as a synphot SourceSpectrum, piecewise linear in F_lambda."""
    import astropy.units as u
    from synphot import Empirical1D, SourceSpectrum
    from synphot.units import FLAM, PHOTLAM, convert_flux

    # synphot interpolates in photons; the difference is far below a spectrum's own sampling.
    photons = convert_flux(wavelength_nm * u.nm, flux_flam * FLAM, PHOTLAM)
    # Negative fluxes are measured noise; without this they become zero.
    return SourceSpectrum(Empirical1D, points=wavelength_nm * u.nm, lookup_table=photons, keep_neg=True)


@cache
def _vega() -> Any:
    table = spectrum_table(find("Vega")["file"])
    return synphot_spectrum(np.asarray(table["wavelength"], float), np.asarray(table["flux"], float))


def _observation(wavelength_nm: NDArray[np.float64], flux_flam: NDArray[np.float64], name: str) -> tuple[Band, Any]:
    from synphot import Observation

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
    # Both samplings enter the integral: a narrow band on a coarse spectrum, and the other way round.
    grid = np.union1d(wavelength_nm, chosen.wavelength_nm)
    spectrum, element = synphot_spectrum(wavelength_nm, flux_flam), chosen.element()
    return chosen, Observation(spectrum, element, binset=grid * 10.0, force="taper")


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
def magnitude(
    wavelength_nm: NDArray[np.float64],
    flux_flam: NDArray[np.float64],
    name: str = "V",
    system: System = "catalogue",
) -> float:
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
    import astropy.units as u
    from synphot.units import FLAM, VEGAMAG

    _check_system(system)
    level = _level(flux_flam)
    if level is not None:
        raised, flat = (
            float(seen.effstim(FLAM, wavelengths=seen.binset).value)
            for seen in (_observation(wavelength_nm, part, name)[1] for part in (flux_flam + level, level))
        )
        if not raised > flat:
            raise InputError(f"the spectrum has no light in the band {band(name).name}, expected a positive flux")
        return magnitude(wavelength_nm, level, name, system) - 2.5 * float(np.log10((raised - flat) / flat))
    chosen, observation = _observation(wavelength_nm, flux_flam, name)
    if not float(observation.integrate().value) > 0.0:
        raise InputError(f"the spectrum has no light in the band {chosen.name}, expected a positive flux")
    ab = system == "ab" or (system == "catalogue" and chosen.system == "AB")
    value = observation.effstim(u.ABmag if ab else VEGAMAG, vegaspec=_vega(), wavelengths=observation.binset)
    return float(value.value) + (chosen.vega if system == "catalogue" and not ab else 0.0)


@remembered(256)
def photons(wavelength_nm: NDArray[np.float64], flux_flam: NDArray[np.float64], name: str) -> float:
    """Photons s-1 cm-2 in a band, weighted with its throughput; errors as `magnitude`."""
    level = _level(flux_flam)
    if level is not None:
        return photons(wavelength_nm, flux_flam + level, name) - photons(wavelength_nm, level, name)
    return float(_observation(wavelength_nm, flux_flam, name)[1].integrate().value)


def _level(flux: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """What lifts a flux above zero, the same at each point, or None: synphot takes negative fluxes for none.

    Bands are linear in the flux, so what is added can be taken off again.
    """
    lowest = float(flux.min())
    return np.full_like(flux, -2.0 * lowest) if lowest < 0.0 else None
