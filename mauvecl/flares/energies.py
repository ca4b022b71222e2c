"""Energies of flares: their relation to amplitudes and durations, cooling flares, and rates of stars.

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

Rates of stars are cumulative distributions of energy, published or given by the user. The convention is that of
AltaiPony: dN/dE = beta E^-alpha, so that beta / (alpha - 1) E^(1 - alpha) flares per day have at least the energy E.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from mauvecl.flares import DAYS
from mauvecl.flares.shapes import Shape, shape_of
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.host.stars.flare import (
    PARSEC_CM,
    STEFAN_BOLTZMANN,
    SUN_CM,
    Blackbody,
    FlareSpectrum,
    Geometry,
    added_light,
    blackbody,
    check_scales,
)
from mauvecl.host.stars.spectrum import band as find_band
from mauvecl.host.stars.spectrum import photons
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.table import Rows
from mauvecl.schema.calls import checked, validated
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Distance, Energy, Positive, Radius, Range, RateExponent, Temperature, Unit

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

#: Light of a flare that counts for its energy: in the band of its amplitude, or at all wavelengths.
Kind = Literal["band", "bolometric"]
#: Energies below it, erg, are logarithms: a flare of a star has more than 1e20 erg.
LIKELY_LOGARITHM = 1e3
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
                f"the flux of {source.name} has no absolute scale: {source.unscaled}; give a magnitude", key="source"
            )
        source.magnitude(band)  # raises InputError if the spectrum does not cover the band
        return cls._of_light(
            source.wavelength_nm, source.flux_flam, 4 * np.pi * (distance_pc * PARSEC_CM) ** 2,
            f"{source.name} at {distance_pc:g} pc", band, flare or Blackbody(flare_k), kind, geometry,
            source.temperature_k if photosphere_k is None else photosphere_k,
        )  # fmt: skip

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

        Other arguments are those of `of_star`; the photosphere of ``replaces`` has the star's temperature by default.
        """
        wavelength, _ = _response(band)
        return cls._of_light(
            wavelength, blackbody(wavelength, temperature_k), 4 * np.pi * (radius_rsun * SUN_CM) ** 2,
            f"a blackbody of {temperature_k:g} K and {radius_rsun:g} solar radii", band, flare or Blackbody(flare_k),
            kind, geometry, temperature_k if photosphere_k is None else photosphere_k,
        )  # fmt: skip

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
        star, flare = (flux_in_band(band, Blackbody(kelvin)) for kelvin in (temperature_k, flare_k))
        area = np.pi * (radius_rsun * SUN_CM) ** 2 * star / flare
        return cls(
            find_band(band).meta["name"],
            "bolometric",
            area * STEFAN_BOLTZMANN * flare_k**4,
            f"a blackbody of {temperature_k:g} K and {radius_rsun:g} solar radii, a patch of {flare_k:g} K seen face "
            "on, response weighted with energies (Shibayama et al. 2013)",
        )

    @classmethod
    def _of_light(
        cls, wavelength_nm: Float, flux_flam: Float, sphere_cm2: float, star: str, band: str, flare: FlareSpectrum,
        kind: Kind, geometry: Geometry, photosphere_k: float | None,
    ) -> Self:  # fmt: skip
        """Return the scale for the light that a flare of amplitude 1 adds to a flux, over a sphere around the star."""
        check_scales(flare)
        light = added_light(wavelength_nm, flux_flam, flare, band, geometry, photosphere_k)
        if kind == "band":
            flux = light.hot * flux_in_band(band, flare)
            lost = light.lost * _through(wavelength_nm, flux_flam, band)
        else:
            flux, lost = light.hot * flare.bolometric_flux(), 0.0
            if light.lost and photosphere_k is not None:
                # The bolometric flux of the blackbody with the star's photons in the band.
                body = photons(wavelength_nm, blackbody(wavelength_nm, photosphere_k), band)
                share = light.lost * photons(wavelength_nm, flux_flam, band) / body
                lost = share * STEFAN_BOLTZMANN * photosphere_k**4
        how = f"{star}, flare of {flare.describe()}"
        if geometry == "replaces":
            how += f" in place of photosphere of {photosphere_k:g} K"
        return cls(find_band(band).meta["name"], kind, sphere_cm2 * (flux - lost), how)

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


def amplitude_of(equivalent_duration_s: float, half_width_s: float, shape: Shape | str) -> float:
    """Return the amplitude of a shape for an equivalent duration."""
    return equivalent_duration_s / half_width_s / shape_of(shape).equivalent_duration


def flux_in_band(band: str, flare: FlareSpectrum) -> float:
    """Return the flux of a flare's spectrum in a band, erg s-1 cm-2; the maximum response is 1."""
    wavelength, response = _response(band)
    grid = flare.grid(wavelength)
    return _integral(grid, np.interp(grid, wavelength, response) * flare.flux(grid))


def _response(band: str) -> tuple[Float, Float]:
    """Return the wavelengths, nm, and the response of a band, with a maximum of 1, shape (POINTS,) each."""
    at, throughput = find_band(band)["wavelength"], find_band(band)["throughput"]
    wavelength = np.linspace(at[0], at[-1], POINTS)
    return wavelength, np.interp(wavelength, at, throughput / throughput.max())


def _through(wavelength_nm: Float, flux_flam: Float, band: str) -> float:
    """Return the flux of a spectrum in a band, erg s-1 cm-2."""
    wavelength, response = _response(band)
    return _integral(wavelength, response * np.interp(wavelength, wavelength_nm, flux_flam, left=0.0, right=0.0))


def _integral(wavelength_nm: Float, flux_flam: Float) -> float:
    """Return the integral of a flux in erg s-1 cm-2 A-1 over nm, erg s-1 cm-2."""
    return 10.0 * float(np.trapezoid(flux_flam, wavelength_nm))


#: Definitions of published energies; see `Rates`.
Definition = Literal["light", "quiescent", "patch"]

#: Name that replaces the band of bolometric energies.
BOLOMETRIC = "bolometric"
#: Range of flare energies of all stars, erg.
ENERGIES = (1e22, 1e42)
#: Scatter of the rates of single stars about a published relation, dex (assumption: stars of equal mass and age differ
#: by factors of a few).
SCATTER_DEX = 0.5


@dataclass(frozen=True, kw_only=True)
class Rates(ABC):
    """Cumulative distribution of flare energies."""

    band: str = "Kepler"  # name of the band of the energies, or "bolometric"
    source: str = "given"
    measured_erg: tuple[float, float] = ENERGIES  # range in which it was measured; it is extrapolated outside
    scatter_dex: Annotated[float, Range(0, 3)] = 0.0  # standard deviation of the logarithm of a single star's rate
    # Energy of the flares' isotropic light; equivalent duration times the star's luminosity in the band (Davenport); or
    # the bolometric energy of a patch of 10 000 K seen face-on (Shibayama). `of_light` converts to the first.
    definition: Definition = "light"

    def __post_init__(self) -> None:
        low, high = self.measured_erg
        if not 0 < low < high < np.inf:
            raise InputError.of("measured_erg", self.measured_erg, "two rising energies above 0", unit="erg")

    @abstractmethod
    def per_day_above(self, energy_erg: ArrayLike) -> Float:
        """Return the number of flares per day with at least an energy, shape of the energy."""

    @abstractmethod
    def times_energy(self, factor: float) -> Self:
        """Return the rates with all energies multiplied by a factor."""

    def in_band(self, band: str, flare_k: float = 10_000.0, flare: FlareSpectrum | None = None) -> Self:
        """Return the rates with energies in another band of `host.stars.library`, or "bolometric" ones.

        The flares are blackbodies of a temperature, or have another spectrum.
        """
        return replace(self.times_energy(band_factor(self.band, band, flare_k, flare)), band=band)

    def of_light(self, erg_per_s: float, luminosity_erg_s: float) -> Self:
        """Return the rates by the bolometric energy of the light of one star's flares.

        `erg_per_s` is that of an `EnergyScale` in `amplitude_band`, and the luminosity the star's in that band; see
        `quiescent_luminosity`. Raises InputError if the energies are already those of light; see `in_band`.
        """
        if self.definition == "light":
            raise InputError.of("definition", self.definition, "a published definition, not that of light")
        published = luminosity_erg_s
        if self.definition == "patch":
            published *= band_factor(self.amplitude_band, BOLOMETRIC) / 4
        return replace(self.times_energy(erg_per_s / published), band=BOLOMETRIC, definition="light")

    @property
    def amplitude_band(self) -> str:
        """Band of equivalent durations; Kepler for bolometric energies."""
        return "Kepler" if self.band == BOLOMETRIC else self.band


@validated
@dataclass(frozen=True, kw_only=True)
class PowerLaw(Rates):
    """Power law dN/dE = beta E^-alpha, in flares per day.

    Attributes
    ----------
    alpha : float
        Above 1.
    log10_beta : float
        Logarithm of beta in flares per day and erg^(alpha - 1).
    largest_erg : float
        Largest energy; infinite by default, as in AltaiPony.

    Examples
    --------
    >>> from mauvecl.flares.energies import davenport2019
    >>> round(float(davenport2019(mass_msun=0.5, age_myr=100).per_day_above(1e33)), 6)
    0.074131
    >>> ends = PowerLaw(alpha=2.0, log10_beta=33.0, largest_erg=1e34)
    >>> ends.per_day_above([1e32, 5e33, 2e34]).round(9).tolist()
    [9.9, 0.1, 0.0]
    >>> ends.times_energy(3.0).per_day_above([3e32, 1.5e34, 6e34]).round(9).tolist()
    [9.9, 0.1, 0.0]
    """

    alpha: RateExponent
    log10_beta: Annotated[float, Range()]
    largest_erg: float = np.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.largest_erg > 0:
            raise InputError.of("largest_erg", self.largest_erg, "above 0")

    @classmethod
    def through(cls, alpha: RateExponent, energy_erg: Energy, per_day: Positive, **others: object) -> Self:
        """Return the power law with a rate of flares above an energy; `others` are attributes of the class."""
        beta = np.log10(per_day * (alpha - 1)) + (alpha - 1) * np.log10(energy_erg)
        return cls(alpha=alpha, log10_beta=float(beta), **others)  # type: ignore[arg-type]

    def per_day_above(self, energy_erg: ArrayLike) -> Float:
        energy = np.asarray(energy_erg, np.float64)
        return np.asarray(np.maximum(self._untruncated(energy) - self._untruncated(self.largest_erg), 0.0))

    def _untruncated(self, energy: ArrayLike) -> Float:
        """Return `per_day_above` without a largest energy."""
        exponent = self.log10_beta - np.log10(self.alpha - 1) + (1 - self.alpha) * np.log10(energy)
        return np.asarray(10.0**exponent)

    def times_energy(self, factor: float) -> Self:
        low, high = self.measured_erg
        return replace(
            self,
            log10_beta=self.log10_beta + (self.alpha - 1) * float(np.log10(factor)),
            largest_erg=self.largest_erg * factor,
            measured_erg=(low * factor, high * factor),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RateTable(Rates):
    """Tabulated cumulative distribution, interpolated linearly in the logarithms.

    The rate is constant below the first energy and zero above the last.
    """

    energy_erg: Float  # ascending, shape (n,)
    per_day: Float  # flares with at least this energy, not increasing, shape (n,)

    def __post_init__(self) -> None:
        super().__post_init__()
        set_read_only(self, energy_erg=self.energy_erg, per_day=self.per_day)
        energy, rate = self.energy_erg, self.per_day
        if energy.ndim != 1 or energy.shape != rate.shape or energy.size < 2:
            raise InputError.of("per_day", rate.size, f"one rate for each of {energy.size} energies, at least 2")
        if not (np.isfinite(energy).all() and (energy > 0).all() and (np.diff(energy) > 0).all()):
            raise InputError("the energies of a table of rates must be above 0 and ascend", key="energy_erg")
        if not (np.isfinite(rate).all() and (rate > 0).all() and (np.diff(rate) <= 0).all()):
            raise InputError(
                "the rates of a table, per day, must be above 0 and must not increase with energy", key="per_day"
            )

    @classmethod
    def read(cls, path: str | Path, band: str = "Kepler") -> Self:
        """Read a table with the columns ``energy`` (erg) and ``rate`` (flares per day with at least the energy)."""
        path = Path(path)
        rows = Rows(read_table(path, "table of rates"), f"table of rates {shortened(path.name)}")
        columns = []
        for name, unit in (("energy", "erg"), ("rate", "1 / d")):
            column = rows.first((name,))
            if column is None:
                raise InputError(f"{rows.label} has no column {name!r}, but needs energy and rate", key="columns")
            values = [rows.number(column, row, unit) for row in range(rows.n)]
            columns.append(np.array([np.nan if value is None else value for value in values]))
        energy, rate = columns
        largest = np.nanmax(energy, initial=0.0)
        if largest < LIKELY_LOGARITHM:
            raise InputError(
                f"{rows.label} has energies up to {largest:g}, which look like logarithms; give them in erg",
                key="energy",
            )
        rates = cls(energy_erg=energy, per_day=rate, band=band, source=path.name)
        return replace(rates, measured_erg=(float(energy[0]), float(energy[-1])))

    def per_day_above(self, energy_erg: ArrayLike) -> Float:
        energy = np.asarray(energy_erg, np.float64)
        rate = 10.0 ** np.interp(np.log10(energy), np.log10(self.energy_erg), np.log10(self.per_day))
        return np.asarray(np.where(energy > self.energy_erg[-1], 0.0, rate))

    def times_energy(self, factor: float) -> Self:
        low, high = self.measured_erg
        return replace(self, energy_erg=self.energy_erg * factor, measured_erg=(low * factor, high * factor))


def band_factor(old: str, new: str, flare_k: float = 10_000.0, flare: FlareSpectrum | None = None) -> float:
    """Return the ratio of a flare's energy in a new band to that in an old one; either may be "bolometric"."""
    light = Blackbody(checked(Temperature, "flare_k", flare_k)) if flare is None else flare

    def flux(band: str) -> float:
        return light.bolometric_flux() if band == BOLOMETRIC else flux_in_band(band, light)

    return 1.0 if old == new else flux(new) / flux(old)


@validated
def davenport2019(
    *,
    mass_msun: Annotated[float, Unit("solMass"), Range(0.1, 1.5)],
    age_myr: Annotated[float, Unit("Myr"), Range(1, 13_800)],
) -> PowerLaw:
    """Return the rates for a mass and an age of Davenport et al. 2019 (arXiv 1901.00890), in the Kepler band.

    log10 nu = a log10 E + b, a = -.07 log10 t + .79 m - 1.06, b = 2.01 log10 t - 25.15 m + 33.99. The relation
    overestimates the rate of the Sun.

    Parameters
    ----------
    mass_msun : float
        0.1 to 1.5; the relation was fitted to stars of about 0.4 to 1.1.
    age_myr : float
        1 to 13 800.
    """
    t = float(np.log10(age_myr))
    slope, offset = -0.07 * t + 0.79 * mass_msun - 1.06, 2.01 * t - 25.15 * mass_msun + 33.99
    if slope >= 0:
        raise InputError(
            f"the relation of Davenport et al. 2019 rises with energy for mass_msun = {mass_msun:g} and "
            f"age_myr = {age_myr:g}; use less mass or another distribution",
            key="mass_msun",
        )
    return PowerLaw(
        alpha=1 - slope,
        log10_beta=offset + float(np.log10(-slope)),
        band="Kepler",
        source=f"Davenport et al. 2019 (arXiv 1901.00890), {mass_msun:g} Msun, {age_myr:g} Myr",
        measured_erg=(1e32, 1e37),
        scatter_dex=SCATTER_DEX,
        definition="quiescent",
    )


def sunlike() -> PowerLaw:
    """Return the rates of slowly rotating G dwarfs.

    At least 7e33 erg once in 3000 years (Okamoto et al. 2021), with an exponent of 2 (Shibayama et al. 2013). The
    scatter covers other results: Maehara et al. 2015 find 1e34 erg once in 800 years, others once in 5000.
    """
    return PowerLaw.through(
        2.0, 7e33, 1 / (3000 * DAYS["year"]), band=BOLOMETRIC,
        source="Sun-like G dwarfs: 7e33 erg per 3000 yr (Okamoto et al. 2021), exponent 2 (Shibayama et al. 2013)",
        measured_erg=(1e33, 1e36), scatter_dex=SCATTER_DEX, definition="patch",
    )  # fmt: skip


@validated
def fiducial2018(quiescent_si_iv_erg_s: Positive) -> PowerLaw:
    """Return the bolometric rates of the fiducial M dwarf of Loyd et al. 2018 (arXiv 1809.07322), by its Si IV light.

    nu(> delta) = 8 / d (delta / 1000 s)^-0.75 for equivalent durations in Si IV from 1e2 to 1e6 s; the blackbody of
    9000 K has 160 times the energy of Si IV.

    Examples
    --------
    >>> from mauvecl.flares.energies import fiducial2018
    >>> seconds, light = [100, 1000, 100_000], 1e27
    >>> [round(float(fiducial2018(light).per_day_above(160 * light * delta)), 6) for delta in seconds]
    [44.987306, 8.0, 0.252982]
    """
    second = 160 * quiescent_si_iv_erg_s
    return PowerLaw.through(
        1.75, 1000 * second, 8.0, band=BOLOMETRIC, source="fiducial flares of Loyd et al. 2018 (arXiv 1809.07322)",
        measured_erg=(100 * second, 1e6 * second), scatter_dex=SCATTER_DEX,
    )  # fmt: skip


#: Typical mass (solar masses) and age (Myr) of a spectral type (assumption).
TYPICAL = {"G": (0.95, 1000.0), "K": (0.75, 1000.0), "M": (0.4, 1000.0)}

#: Exponents for types without published rates of single stars: Althukair & Tsiklauri 2023, "Main Sequence Star
#: Super-flare Frequency based on Entire Kepler Data", abstract.
EXPONENTS = {"A": "1.3", "F": "2.0 to 2.1"}


def preset(name: str) -> PowerLaw:
    """Return published rates: "G", "K" and "M" by `davenport2019` for a typical mass at 1 Gyr, or "sunlike".

    Other publications find exponents of about 2: G 1.5 to 2 (Shibayama 2013, Maehara 2015), K and M 2.0 to 2.4 (Ilin
    2019).
    """
    if name == "sunlike":
        return sunlike()
    if name not in TYPICAL:
        raise InputError.of("preset", name, f"{', '.join(TYPICAL)} or sunlike")
    mass, age = TYPICAL[name]
    rates = davenport2019(mass_msun=mass, age_myr=age)
    return replace(rates, source=f"{rates.source} (typical of type {name}: assumption)")
