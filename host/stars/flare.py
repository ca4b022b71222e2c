"""Flares as blackbodies that are added to a star or replace part of its photosphere (METHODS section 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import astropy.units as u
import numpy as np
from astropy.constants import c, h, k_B
from numpy.typing import NDArray

from ..array_cache import array_cache
from ..errors import InputError
from ..ranges import check_amplitude, check_temperature
from .bands import ANGSTROM, photons

Geometry = Literal["added", "replaces"]


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


def with_flare(
    wavelength_nm: NDArray[np.float64],
    flux_flam: NDArray[np.float64],
    *,
    amplitude: float,
    temperature_k: float,
    band: str,
    geometry: Geometry,
    photosphere_temperature_k: float | None,
) -> NDArray[np.float64]:
    """Return the flux of a flaring star, shape (n,).

    Parameters
    ----------
    wavelength_nm, flux_flam : ndarray, shape (n,)
        The quiescent star, erg s-1 cm-2 A-1.
    amplitude : float
        Relative rise of the photons in the band: 0.24 is 24 %.
    temperature_k : float
        Temperature of the flare's blackbody.
    band : str
        Band in which the amplitude is measured.
    geometry : {"added", "replaces"}
        With ``added``, the flux is F + k B, as in the paper. With ``replaces``, a region of filling factor
        f = A / (R - 1) replaces photosphere: F (1 - f) + f R (N_F / N_B) B, where N are photons in the band and R is
        the ratio of the surface fluxes of the two blackbodies there.
    photosphere_temperature_k : float, optional
        Temperature of the photosphere, which ``replaces`` requires.
    """
    check_amplitude(amplitude)
    light = _photons_in_band(
        wavelength_nm,
        flux_flam,
        temperature_k=temperature_k,
        band=band,
        geometry=geometry,
        photosphere_temperature_k=photosphere_temperature_k,
    )
    body = blackbody(wavelength_nm, temperature_k)
    if light.ratio is None:
        return flux_flam + amplitude * light.star / light.hot * body
    filling = amplitude / (light.ratio - 1.0)
    if filling > 1.0:
        raise InputError(
            f"flare amplitude = {amplitude:g} needs {filling:.2f} of the star's disc at {temperature_k:g} K, "
            f"expected at most {light.ratio - 1.0:.3g}"
        )
    return flux_flam * (1.0 - filling) + filling * light.ratio * light.star / light.hot * body


@dataclass(frozen=True)
class AddedLight:
    """The light that a flare of amplitude 1 adds to a star: `hot` blackbodies of the flare less `lost` of the star."""

    hot: float  # multiple of the flare's surface flux pi B_lambda
    lost: float  # share of the star's own light


def added_light(
    wavelength_nm: NDArray[np.float64],
    flux_flam: NDArray[np.float64],
    *,
    temperature_k: float,
    band: str,
    geometry: Geometry,
    photosphere_temperature_k: float | None,
) -> AddedLight:
    """Return the light of a flare of amplitude 1, with the arguments and errors of `with_flare`.

    `with_flare` adds it times the amplitude, whose largest value it checks.
    """
    light = _photons_in_band(
        wavelength_nm,
        flux_flam,
        temperature_k=temperature_k,
        band=band,
        geometry=geometry,
        photosphere_temperature_k=photosphere_temperature_k,
    )
    if light.ratio is None:
        return AddedLight(light.star / light.hot, 0.0)
    return AddedLight(light.ratio / (light.ratio - 1.0) * light.star / light.hot, 1.0 / (light.ratio - 1.0))


@dataclass(frozen=True)
class _Photons:
    """Photons in the band in which amplitudes are measured."""

    star: float
    hot: float  # of the flare's surface
    ratio: float | None  # flare's surface to photosphere's; None where the flare replaces nothing


def _photons_in_band(
    wavelength_nm: NDArray[np.float64],
    flux_flam: NDArray[np.float64],
    *,
    temperature_k: float,
    band: str,
    geometry: Geometry,
    photosphere_temperature_k: float | None,
) -> _Photons:
    check_temperature("flare temperature", temperature_k)
    star = photons(wavelength_nm, flux_flam, band)
    if not star > 0.0:
        raise InputError(f"the star has no light in the band {band}, expected some to measure the flare against")
    hot = photons(wavelength_nm, blackbody(wavelength_nm, temperature_k), band)
    if geometry == "added":
        return _Photons(star, hot, None)
    if geometry != "replaces":
        raise InputError(f"flare geometry = {geometry!r}, expected 'added' or 'replaces'")
    if photosphere_temperature_k is None:
        raise InputError("flare geometry 'replaces' needs a photosphere temperature, expected one in K")
    check_temperature("photosphere temperature", photosphere_temperature_k)
    ratio = hot / photons(wavelength_nm, blackbody(wavelength_nm, photosphere_temperature_k), band)
    if ratio <= 1.0:
        raise InputError(
            f"flare temperature = {temperature_k:g} K is no hotter than the photosphere it replaces, "
            f"expected more than {photosphere_temperature_k:g} K"
        )
    return _Photons(star, hot, ratio)
