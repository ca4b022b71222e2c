"""True values of the quantities that are measured of a simulated flare."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mauvecl.host.stars.bands import photons
from mauvecl.host.stars.flare_spectra import (
    PARSEC_CM,
    SUN_CM,
    BalmerFlare,
    Blackbody,
    EmissionLine,
    FlareWithLines,
    TwoBlackbodies,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mauvecl.host.stars.flare_spectra import FlareSpectrum
    from mauvecl.host.stars.source import Source
    from mauvecl.study.sections import Star

Float = NDArray[np.float64] if TYPE_CHECKING else np.ndarray


class Truth:
    """True values of a flare that was added to a star."""

    def __init__(self, star: Star, quiet: Source, lit: Source, light: FlareSpectrum, band: str, exposure_s: float):
        self._light, self._star, self._exposure_s = light, star, exposure_s
        nm = lit.wavelength_nm
        added = lit.flux_flam - np.interp(nm, quiet.wavelength_nm, quiet.flux_flam)
        added = added - light.flux_at_telescope(nm)
        # Ratio of the flux at the telescope to that of the flare's spectrum.
        self._scale = float(np.trapezoid(added, nm) / np.trapezoid(light.flux(nm), nm))
        self._continuum = light.continuum if isinstance(light, FlareWithLines) else light
        self._two = self._continuum if isinstance(self._continuum, TwoBlackbodies) else None
        self._amplitude = np.nan
        if self._continuum.temperature_k is not None:
            at = quiet.wavelength_nm
            # Flux of the blackbodies without recombination.
            light = self._continuum if self._two else Blackbody(self._continuum.temperature_k)
            body = photons(at, light.flux(at), band)
            self._amplitude = self._scale * body / photons(at, quiet.flux_flam, band)

    def value(self, name: str) -> float:
        """Return the true value of a quantity by its name in fits; NaN if the flare has none."""
        far = np.nan if self._star.distance_pc is None else self._star.distance_pc * PARSEC_CM
        first, _, rest = name.partition(" ")
        if first in ("flux", "luminosity", "energy"):
            factor = {"flux": 1.0, "luminosity": 4 * np.pi * far**2, "energy": 4 * np.pi * far**2 * self._exposure_s}
            return factor[first] * self._flux(rest)
        if first == "line":
            return self._line(rest)
        if name in ("temperature", "second temperature", "second area"):
            return self._temperatures().get(name, np.nan)
        if name == "amplitude":
            return self._amplitude
        if name == "jump":
            if not self._continuum.surface:
                return np.nan
            return self._continuum.jump if isinstance(self._continuum, BalmerFlare) else 1.0
        area = np.pi * far**2 * self._scale if self._continuum.surface else np.nan
        area *= 1.0 if self._two is None else 1.0 + self._two.second_area
        if name == "area":
            return area
        radius = np.nan if self._star.radius_rsun is None else self._star.radius_rsun * SUN_CM
        return float(area / (np.pi * radius**2))

    def _temperatures(self) -> dict[str, float]:
        """Return the temperatures, and the ratio of the hotter blackbody's area to that of the cooler one."""
        kelvin, two = self._continuum.temperature_k, self._two
        if kelvin is None:
            return {}
        if two is None:
            return {"temperature": kelvin}
        (low, area), (high, hot_area) = sorted([(kelvin, 1.0), (two.second_temperature_k, two.second_area)])
        return {"temperature": low, "second temperature": high, "second area": hot_area / area}

    def _flux(self, where: str) -> float:
        if where == "bolometric":
            lines = self._light.fluxes_cgs.values() if isinstance(self._light, FlareWithLines) else ()
            return self._scale * self._light.bolometric_flux() + sum(lines)
        low, high = (float(end) for end in where.removesuffix(" nm").split("-"))
        nm = self._light.grid(np.linspace(low, high, 4001))
        return 10.0 * float(np.trapezoid(self._scale * self._light.flux(nm) + self._light.flux_at_telescope(nm), nm))

    def _line(self, name: str) -> float:
        if not isinstance(self._light, FlareWithLines):
            return 0.0 if self._light.surface else np.nan
        for mapping, factor in (
            (self._light.fractions, self._scale * self._light.continuum_flux),
            (self._light.fluxes_cgs, 1.0),
        ):
            for one, value in mapping.items():
                if EmissionLine.named(one).name == EmissionLine.named(name).name:
                    return factor * value
        return 0.0
