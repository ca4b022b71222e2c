"""Conversions between the energy, equivalent duration, amplitude and half-width of flares.

Amplitude and equivalent duration count photons, as a detector does; energies weight them with their energy. Both
describe the same light, the flare's excess over the quiescent star:

- amplitude: relative rise of the photons in a band, int R F_flare lambda dlambda / int R F_quiet lambda dlambda, with R
  the band's response per photon;
- equivalent duration: its integral over time, amplitude x half-width x the area of the shape, s;
- energy in the band: 4 pi d^2 int dt int R F_flare dlambda, with R's highest value 1, erg;
- bolometric energy: 4 pi d^2 int dt int F_flare dlambda, over all wavelengths, erg.

`EnergyScale` converts between photons and energies, assuming isotropic emission. Published energies differ in two ways:
`EnergyScale.shibayama2013` gives those of a flat patch seen face-on, and many catalogues call `quiescent_luminosity`
times the equivalent duration the energy in a band.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.stars.bands import band as find_band
from mauvecl.host.stars.bands import photons
from mauvecl.host.stars.blackbody import blackbody
from mauvecl.host.stars.flare import Geometry, added_light
from mauvecl.host.stars.flare_spectra import PARSEC_CM, STEFAN_BOLTZMANN, SUN_CM, Blackbody, FlareSpectrum
from mauvecl.lightcurve.flares.shapes import Shape, shape_of
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Unit
from mauvecl.schema.physical import Distance, Energy, Radius, Temperature

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

Float = NDArray[np.float64]
#: Light of a flare that counts for its energy: in the band of its amplitude, or at all wavelengths.
Kind = Literal["band", "bolometric"]
#: Number of points of the integral over a band; the step is at most a tenth of the sampling of the band.
POINTS = 20_001


@validated
@dataclass(frozen=True)
class EnergyScale:
    """Energy of a flare's light per second of equivalent duration."""

    band: str  # of amplitude and equivalent duration
    kind: Kind  # energy in the band, or at all wavelengths
    erg_per_s: Annotated[float, Unit("erg / s")]
    how: str  # description of star and flare, for tables

    @classmethod
    def of_star(
        cls,
        source: Source,
        distance_pc: Distance,
        *,
        band: str = "Kepler",
        flare_k: Temperature = 10_000.0,
        flare: FlareSpectrum | None = None,
        kind: Kind = "bolometric",
        geometry: Geometry = "added",
        photosphere_k: Temperature | None = None,
    ) -> Self:
        """Return the scale for a spectrum at a distance: 4 pi d^2 times the flux of the flare.

        Parameters
        ----------
        source : Source
            Spectrum at the magnitude of the star.
        distance_pc : float
        band : str
        flare_k : float
            Temperature of the flare's blackbody.
        flare : FlareSpectrum, optional
            Spectrum of the flare, instead of a blackbody.
        kind : {"band", "bolometric"}
        geometry : {"added", "replaces"}
            As for `Source.flaring`. The replaced photosphere is subtracted; for bolometric energies it is a blackbody.
        photosphere_k : float, optional
            For ``replaces``; the source's `temperature_k` by default.

        Raises
        ------
        InputError
            For an impossible value, a spectrum without a scale, or a band that it does not cover.
        """
        if source.unscaled:
            raise InputError(
                f"the flux of {source.name} has no absolute scale: {source.unscaled}",
                "a magnitude",
                key="source",
                value=source.name,
            )
        source.magnitude(band)  # raises InputError if the spectrum does not cover the band
        return cls._of_light(
            source.wavelength_nm,
            source.flux_flam,
            sphere_cm2=4 * np.pi * (distance_pc * PARSEC_CM) ** 2,
            star=f"{source.name} at {distance_pc:g} pc",
            band=band,
            flare=Blackbody(flare_k) if flare is None else flare,
            kind=kind,
            geometry=geometry,
            photosphere_k=source.temperature_k if photosphere_k is None else photosphere_k,
        )

    @classmethod
    def of_blackbody(
        cls,
        radius_rsun: Radius,
        temperature_k: Temperature,
        *,
        band: str = "Kepler",
        flare_k: Temperature = 10_000.0,
        flare: FlareSpectrum | None = None,
        kind: Kind = "bolometric",
        geometry: Geometry = "added",
        photosphere_k: Temperature | None = None,
    ) -> Self:
        """Return the scale for a star that is a blackbody of given radius and temperature.

        Parameters
        ----------
        radius_rsun, temperature_k : float
        band, flare_k, flare, kind, geometry
            As `of_star`.
        photosphere_k : float, optional
            For ``replaces``; the star's temperature by default.

        Raises
        ------
        InputError
            For an impossible value or an unknown band.
        """
        wavelength, _ = _response(band)
        return cls._of_light(
            wavelength,
            blackbody(wavelength, temperature_k),
            sphere_cm2=4 * np.pi * (radius_rsun * SUN_CM) ** 2,
            star=f"a blackbody of {temperature_k:g} K and {radius_rsun:g} solar radii",
            band=band,
            flare=Blackbody(flare_k) if flare is None else flare,
            kind=kind,
            geometry=geometry,
            photosphere_k=temperature_k if photosphere_k is None else photosphere_k,
        )

    @classmethod
    def shibayama2013(
        cls, radius_rsun: Radius, temperature_k: Temperature, *, band: str = "Kepler", flare_k: Temperature = 10_000.0
    ) -> Self:
        """Return the published scale for bolometric energies, for comparisons with catalogues.

        [int R B(star) / int R B(flare)] pi R_star^2 sigma T_flare^4 (Shibayama et al. 2013,
        doi 10.1088/0067-0049/209/1/5). It differs from `of_blackbody` in two ways: a flat patch seen face-on emits a
        quarter of the energy of an isotropic source, and the response weights energies although equivalent durations
        count photons.
        """
        area = np.pi * (radius_rsun * SUN_CM) ** 2 * in_band(band, temperature_k) / in_band(band, flare_k)
        return cls(
            find_band(band).name,
            "bolometric",
            area * STEFAN_BOLTZMANN * flare_k**4,
            f"a blackbody of {temperature_k:g} K and {radius_rsun:g} solar radii, a patch of {flare_k:g} K seen face "
            "on, response weighted with energies (Shibayama et al. 2013)",
        )

    @classmethod
    def _of_light(
        cls,
        wavelength_nm: Float,
        flux_flam: Float,
        *,
        sphere_cm2: float,
        star: str,
        band: str,
        flare: FlareSpectrum,
        kind: Kind,
        geometry: Geometry,
        photosphere_k: float | None,
    ) -> Self:
        """Return the scale for the light that a flare of amplitude 1 adds to a flux, over a sphere around the star."""
        light = added_light(
            wavelength_nm,
            flux_flam,
            spectrum=flare,
            band=band,
            geometry=geometry,
            photosphere_temperature_k=photosphere_k,
        )
        if kind == "band":
            flux = light.hot * flux_in_band(band, flare)
            lost = light.lost and light.lost * _through(wavelength_nm, flux_flam, band)
        else:
            flux = light.hot * flare.bolometric_flux()
            lost = light.lost and light.lost * _bolometric(wavelength_nm, flux_flam, band, photosphere_k)
        how = f"{star}, flare of {flare.describe()}"
        if geometry == "replaces":
            how += f" in place of photosphere of {photosphere_k:g} K"
        return cls(find_band(band).name, kind, sphere_cm2 * (flux - lost), how)

    def energy(self, equivalent_duration_s: Annotated[float, Unit("s")]) -> float:
        """Return the energy for an equivalent duration, erg."""
        return equivalent_duration_s * self.erg_per_s

    def equivalent_duration(self, energy_erg: Energy) -> float:
        """Return the equivalent duration for an energy, s."""
        return energy_erg / self.erg_per_s


@validated
def quiescent_luminosity(source: Source, distance_pc: Distance, band: str = "Kepler") -> float:
    """Return the luminosity of a star in a band, erg/s: 4 pi d^2 int R F dlambda, with R's highest value 1.

    Many catalogues multiply it by the equivalent duration to obtain the energy of a flare in the band. This assumes the
    spectrum of the star, not that of the flare.
    """
    source.magnitude(band)
    sphere = 4 * np.pi * (distance_pc * PARSEC_CM) ** 2
    return sphere * _through(source.wavelength_nm, source.flux_flam, band)


def equivalent_duration(amplitude: float, half_width_s: float, shape: Shape | str) -> float:
    """Return the equivalent duration of a shape, s; `amplitude` is that of the shape, not always its peak."""
    return amplitude * half_width_s * shape_of(shape).equivalent_duration


def amplitude_of(equivalent_duration_s: float, half_width_s: float, shape: Shape | str) -> float:
    """Return the amplitude of a shape for an equivalent duration."""
    return equivalent_duration_s / half_width_s / shape_of(shape).equivalent_duration


def amplitude_of_peak(peak: float, shape: Shape | str) -> float:
    """Return the amplitude of a shape for its maximum, which differs from it for `tovarmendoza2022`."""
    return peak / shape_of(shape).peak


@lru_cache(1024)
def in_band(band: str, temperature_k: float) -> float:
    """Return a blackbody's surface flux in a band, erg s-1 cm-2; the maximum response is 1."""
    wavelength, response = _response(band)
    return _integral(wavelength, response * blackbody(wavelength, temperature_k))


def flux_in_band(band: str, flare: FlareSpectrum) -> float:
    """Return the flux of a flare's spectrum in a band, erg s-1 cm-2; the maximum response is 1."""
    if isinstance(flare, Blackbody):
        return in_band(band, flare.temperature_k)
    wavelength, response = _response(band)
    grid = flare.grid(wavelength)
    return _integral(grid, np.interp(grid, wavelength, response) * flare.flux(grid))


def _response(band: str) -> tuple[Float, Float]:
    """Return the wavelengths and the response of a band, with a maximum of 1."""
    bandpass = find_band(band)
    wavelength = np.linspace(bandpass.wavelength_nm[0], bandpass.wavelength_nm[-1], POINTS)
    return wavelength, np.interp(wavelength, bandpass.wavelength_nm, bandpass.throughput / bandpass.throughput.max())


def _through(wavelength_nm: Float, flux_flam: Float, band: str) -> float:
    """Return the flux of a spectrum in a band, erg s-1 cm-2."""
    wavelength, response = _response(band)
    return _integral(wavelength, response * np.interp(wavelength, wavelength_nm, flux_flam, left=0.0, right=0.0))


def _bolometric(wavelength_nm: Float, flux_flam: Float, band: str, photosphere_k: float | None) -> float:
    """Return the bolometric flux of the blackbody with a spectrum's photons in a band, erg s-1 cm-2."""
    assert photosphere_k is not None
    body = photons(wavelength_nm, blackbody(wavelength_nm, photosphere_k), band)
    return photons(wavelength_nm, flux_flam, band) / body * STEFAN_BOLTZMANN * photosphere_k**4


def _integral(wavelength_nm: Float, flux_flam: Float) -> float:
    # erg s-1 cm-2 A-1 over nm.
    return 10.0 * float(np.trapezoid(flux_flam, wavelength_nm))
