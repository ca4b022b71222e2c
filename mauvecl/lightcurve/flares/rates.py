"""Flare rates of stars: cumulative distributions of energy, published or given by the user.

The convention is that of AltaiPony: dN/dE = beta E^-alpha, so that beta / (alpha - 1) E^(1 - alpha) flares per day have
at least the energy E.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.stars.flare_spectra import Blackbody, FlareSpectrum
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.rows import Rows
from mauvecl.lightcurve.flares.energies import flux_in_band
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, checked
from mauvecl.schema.physical import Energy, Positive, RateExponent, Temperature
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]
#: Definitions of published energies; see `Rates`.
Definition = Literal["light", "quiescent", "patch"]

#: Name that replaces the band of bolometric energies.
BOLOMETRIC = "bolometric"
#: Range of flare energies of all stars, erg.
ENERGIES = (1e22, 1e42)
#: Scatter of the rates of single stars about a published relation, dex (assumption: stars of equal mass and age differ
#: by factors of a few).
SCATTER_DEX = 0.5
DAYS_PER_YEAR = 365.25


@dataclass(frozen=True, kw_only=True)
class Rates(ABC):
    """Cumulative distribution of flare energies."""

    band: str = "Kepler"  # name of the band of the energies, or "bolometric"
    source: str = "given"
    measured_erg: tuple[float, float] = ENERGIES  # range in which it was measured; it is extrapolated outside
    scatter_dex: float = 0.0  # standard deviation of the logarithm of a single star's rate
    # Energy of the flares' isotropic light; equivalent duration times the star's luminosity in the band (Davenport); or
    # the bolometric energy of a patch of 10 000 K seen face-on (Shibayama). `of_light` converts to the first.
    definition: Definition = "light"

    def __post_init__(self) -> None:
        low, high = self.measured_erg
        if not 0 < low < high < np.inf:
            raise InputError.of("measured_erg", self.measured_erg, "two rising energies above 0", unit="erg")
        if not (np.isfinite(self.scatter_dex) and 0 <= self.scatter_dex <= 3):
            raise InputError.of("scatter_dex", self.scatter_dex, "0 to 3")

    @abstractmethod
    def per_day_above(self, energy_erg: ArrayLike) -> Float:
        """Return the number of flares per day with at least an energy, shape of the energy."""

    @abstractmethod
    def times_energy(self, factor: float) -> Self:
        """Return the rates with all energies multiplied by a factor."""

    def in_band(self, band: str, flare_k: float = 10_000.0, flare: FlareSpectrum | None = None) -> Self:
        """Return the rates with energies in another band, or bolometric energies.

        Parameters
        ----------
        band : str
            A name of `host.stars.bands`, or "bolometric".
        flare_k : float
            Temperature of the flares, which are blackbodies.
        flare : FlareSpectrum, optional
            Spectrum of the flares, instead of blackbodies.
        """
        return replace(self.times_energy(band_factor(self.band, band, flare_k, flare)), band=band)

    def of_light(self, erg_per_s: float, luminosity_erg_s: float) -> Self:
        """Return the rates by the bolometric energy of the light of one star's flares.

        Raises InputError if the energies are already those of light; see `in_band`.

        Parameters
        ----------
        erg_per_s : float
            Bolometric energy per second of equivalent duration in `amplitude_band`; see `EnergyScale`.
        luminosity_erg_s : float
            Luminosity of the star in that band; see `quiescent_luminosity`.
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
    >>> from mauvecl.lightcurve.flares.rates import davenport2019
    >>> round(float(davenport2019(mass_msun=0.5, age_myr=100).per_day_above(1e33)), 6)
    0.074131
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
        for name in ("energy_erg", "per_day"):
            kept = np.array(getattr(self, name), np.float64)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)
        energy, rate = self.energy_erg, self.per_day
        if energy.ndim != 1 or energy.shape != rate.shape or energy.size < 2:
            raise InputError.of("per_day", rate.size, f"one rate for each of {energy.size} energies, at least 2")
        if not (np.isfinite(energy).all() and (energy > 0).all() and (np.diff(energy) > 0).all()):
            raise InputError(
                "the energies of a table of rates do not ascend", "ascending energies above 0", key="energy_erg"
            )
        if not (np.isfinite(rate).all() and (rate > 0).all() and (np.diff(rate) <= 0).all()):
            raise InputError(
                "the rates of a table increase with energy", "decreasing rates above 0, per day", key="per_day"
            )

    @classmethod
    def read(cls, path: str | Path, band: str = "Kepler") -> Self:
        """Read a table with the columns ``energy`` (erg) and ``rate`` (flares per day with at least the energy)."""
        path = Path(path)
        rows = Rows(read_table(path, "table of rates"), f"table of rates {shortened(path.name)}")
        columns = []
        for name, unit in (("energy", "erg"), ("rate", "1 / d")):
            held = rows.first((name,))
            if held is None:
                fault = f"{rows.named} has no column {name!r}"
                raise InputError(fault, "energy and rate", key="columns", value=name)
            values = [rows.number(held, row, unit) for row in range(rows.n)]
            columns.append(np.array([np.nan if value is None else value for value in values]))
        energy, rate = columns
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
    flare_k = checked(Temperature, "flare_k", flare_k)
    light = Blackbody(flare_k) if flare is None else flare

    def flux(band: str) -> float:
        return light.bolometric_flux() if band == BOLOMETRIC else flux_in_band(band, light)

    return 1.0 if old == new else flux(new) / flux(old)


def davenport2019(*, mass_msun: float, age_myr: float) -> PowerLaw:
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
    for name, value, low, high in (("mass_msun", mass_msun, 0.1, 1.5), ("age_myr", age_myr, 1.0, 13_800.0)):
        if not low <= value <= high:
            raise InputError.of(name, value, f"{low:g} to {high:g}")
    t = float(np.log10(age_myr))
    slope, offset = -0.07 * t + 0.79 * mass_msun - 1.06, 2.01 * t - 25.15 * mass_msun + 33.99
    if slope >= 0:
        raise InputError(
            f"the relation of Davenport et al. 2019 rises with energy for mass_msun = {mass_msun:g} and "
            f"age_myr = {age_myr:g}",
            "less mass or another distribution",
            key="mass_msun",
            value=mass_msun,
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
        2.0, 7e33, 1 / (3000 * DAYS_PER_YEAR), band=BOLOMETRIC,
        source="Sun-like G dwarfs: 7e33 erg per 3000 yr (Okamoto et al. 2021), exponent 2 (Shibayama et al. 2013)",
        measured_erg=(1e33, 1e36), scatter_dex=SCATTER_DEX, definition="patch",
    )  # fmt: skip


@validated
def fiducial2018(quiescent_si_iv_erg_s: Positive) -> PowerLaw:
    """Return the bolometric rates of the fiducial M dwarf of Loyd et al. 2018 (arXiv 1809.07322), by its Si IV light.

    nu(> delta) = 8 / d (delta / 1000 s)^-0.75 for equivalent durations in Si IV from 1e2 to 1e6 s; the blackbody of
    9000 K has 160 times the energy of Si IV.
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
