"""Energies of flares: from equivalent durations, by what the star shines with in a band.

The equivalent duration ED is the integral of (F / F_quiescent - 1) over time: the time in which the quiescent star
gives off, in the band, what the flare does. For a shape it is amplitude x half width x the shape's own area, so that
each of the three follows from the other two; energy is ED times a number of the star, `EnergyScale`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arguments import public
from mauvecl.host.errors import InputError
from mauvecl.host.ranges import FLARE_TEMPERATURES_K
from mauvecl.host.stars.bands import band as find_band
from mauvecl.host.stars.flare import blackbody
from mauvecl.lightcurve.flares.shapes import Shape, shape_of

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

Float = NDArray[np.float64]
#: CODATA 2018: erg s-1 cm-2 K-4; IAU 2015 (resolution B3) nominal solar radius, and parsec, cm.
STEFAN_BOLTZMANN, SUN_CM, PARSEC_CM = 5.670374419e-5, 6.957e10, 3.0856775814913674e18
#: As published energies have it, a response times energies (Shibayama et al. 2013); or what a detector counts.
Weighted = Literal["energy", "photons"]
#: Points of the integral over a band; a tenth of its own sampling at most.
POINTS = 20_001


@public
@dataclass(frozen=True)
class EnergyScale:
    """What a second of equivalent duration in a band comes to.

    Attributes
    ----------
    band : str
        In which amplitude and equivalent duration are measured.
    kind : {"band", "bolometric"}
        Energy in the band alone, or of the flare's whole blackbody.
    erg_per_s : float
    how : str
        What it was made of, for tables.
    """

    band: str
    kind: Literal["band", "bolometric"]
    erg_per_s: float
    how: str

    @classmethod
    def of_blackbody(
        cls,
        radius_rsun: float,
        temperature_k: float,
        *,
        band: str = "Kepler",
        flare_k: float | None = None,
        weighted: Weighted = "energy",
    ) -> Self:
        """Of a star of a radius and a temperature, taken for a blackbody.

        Parameters
        ----------
        radius_rsun, temperature_k : float
        band : str
        flare_k : float, optional
            Temperature of the flare, for its bolometric energy: [int R B(star) / int R B(flare)] pi R^2 sigma T_flare^4
            (Shibayama et al. 2013, doi 10.1088/0067-0049/209/1/5), the light of a flat patch that is seen face on.
            Without it the energy in the band: 4 pi R^2 int R pi B(star).
        weighted : {"energy", "photons"}
            Published energies weight a response with energies; the amplitudes of this package are of photons.

        Raises
        ------
        InputError
            For a radius or temperature that cannot be, or an unknown band.
        """
        _check("radius_rsun", radius_rsun, 1e-4, 1e4)
        _check("temperature_k", temperature_k, *FLARE_TEMPERATURES_K)
        radius = radius_rsun * SUN_CM
        quiet = in_band(band, temperature_k, weighted)
        star = f"a blackbody of {temperature_k:g} K and {radius_rsun:g} solar radii"
        if flare_k is None:
            name = find_band(band).name
            return cls(name, "band", 4 * np.pi * radius**2 * in_band(band, temperature_k, "energy"), star)
        _check("flare_k", flare_k, *FLARE_TEMPERATURES_K)
        area = np.pi * radius**2 * quiet / in_band(band, flare_k, weighted)
        return cls(
            find_band(band).name, "bolometric", area * STEFAN_BOLTZMANN * flare_k**4, f"{star}, flare of {flare_k:g} K"
        )

    @classmethod
    def of_star(
        cls,
        source: Source,
        distance_pc: float,
        *,
        band: str = "Kepler",
        flare_k: float | None = None,
        weighted: Weighted = "energy",
    ) -> Self:
        """Of a spectrum as it is seen from a distance; all light is taken to leave alike in all directions.

        Parameters
        ----------
        source : Source
            At its magnitude.
        distance_pc : float
        band, flare_k, weighted
            As `of_blackbody`. A face-on patch of the same flux gives off a quarter of the bolometric energy.

        Raises
        ------
        InputError
            For a distance that cannot be, a spectrum of no scale, or a band that it does not cover.
        """
        _check("distance_pc", distance_pc, 1e-7, 1e6)
        if source.unscaled:
            raise InputError(f"the flux of {source.name} is of no scale: {source.unscaled}, expected a magnitude")
        source.magnitude(band)  # refuses a band that the spectrum does not cover
        sphere = 4 * np.pi * (distance_pc * PARSEC_CM) ** 2
        told, name = f"{source.name} at {distance_pc:g} pc", find_band(band).name
        wavelength, response = _response(band)
        flux = np.interp(wavelength, source.wavelength_nm, source.flux_flam)
        if flare_k is None:
            return cls(name, "band", sphere * _integral(wavelength, response * flux), told)
        _check("flare_k", flare_k, *FLARE_TEMPERATURES_K)
        weight = response if weighted == "energy" else response * wavelength
        share = _integral(wavelength, weight * flux) / in_band(band, flare_k, weighted)
        return cls(
            name, "bolometric", sphere * share * STEFAN_BOLTZMANN * flare_k**4, f"{told}, flare of {flare_k:g} K"
        )

    def energy(self, equivalent_duration_s: float) -> float:
        """Energy of an equivalent duration, erg."""
        return equivalent_duration_s * self.erg_per_s

    def equivalent_duration(self, energy_erg: float) -> float:
        """Equivalent duration of an energy, s.

        Raises
        ------
        InputError
            For an energy of 0 or less.
        """
        if not (np.isfinite(energy_erg) and energy_erg > 0):
            raise InputError(f"energy = {energy_erg:g} erg, expected one above 0")
        return energy_erg / self.erg_per_s


def equivalent_duration(amplitude: float, half_width_s: float, shape: Shape | str) -> float:
    """Equivalent duration of a shape, s; `amplitude` is the shape's own, not always its peak."""
    return amplitude * half_width_s * shape_of(shape).equivalent_duration


def amplitude_of(equivalent_duration_s: float, half_width_s: float, shape: Shape | str) -> float:
    """The shape's amplitude for an equivalent duration."""
    return equivalent_duration_s / half_width_s / shape_of(shape).equivalent_duration


def half_width_of(equivalent_duration_s: float, amplitude: float, shape: Shape | str) -> float:
    """The half width for an equivalent duration, s."""
    return equivalent_duration_s / amplitude / shape_of(shape).equivalent_duration


def amplitude_of_peak(peak: float, shape: Shape | str) -> float:
    """The shape's amplitude for its highest value: another one for `tovarmendoza2022`."""
    return peak / shape_of(shape).peak


@lru_cache(1024)
def in_band(band: str, temperature_k: float, weighted: Weighted = "energy") -> float:
    """A blackbody's surface flux through a band, erg s-1 cm-2, or times nm for photons; the highest response is 1."""
    wavelength, response = _response(band)
    weight = response if weighted == "energy" else response * wavelength
    return _integral(wavelength, weight * blackbody(wavelength, temperature_k))


def share_within(low_nm: float, high_nm: float, temperature_k: float) -> float:
    """Share of a blackbody's light between two wavelengths."""
    # 15 / pi^4 times the integral of x^3 / (e^x - 1) over x = h c / (wavelength k T), CODATA 2018.
    from scipy.integrate import quad

    ends = [1.438776877e7 / (nm * temperature_k) for nm in (high_nm, low_nm)]
    value = quad(lambda x: x**3 / np.expm1(x), ends[0], ends[1], epsabs=0.0, epsrel=1e-12, limit=200)[0]
    return float(15 / np.pi**4 * value)


def _response(band: str) -> tuple[Float, Float]:
    """Wavelengths and response of a band, its highest one."""
    bandpass = find_band(band)
    wavelength = np.linspace(bandpass.wavelength_nm[0], bandpass.wavelength_nm[-1], POINTS)
    return wavelength, np.interp(wavelength, bandpass.wavelength_nm, bandpass.throughput / bandpass.throughput.max())


def _integral(wavelength_nm: Float, flux_flam: Float) -> float:
    # erg s-1 cm-2 A-1 over nm.
    return 10.0 * float(np.trapezoid(flux_flam, wavelength_nm))


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"{name} = {value:g}, expected {low:g} to {high:g}")
