"""How often a star flares: cumulative distributions of energy, of the literature or one's own.

The convention is AltaiPony's: dN/dE = beta E^-alpha, so that beta / (alpha - 1) E^(1 - alpha) flares a day are of the
energy E or more.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.files.text_table import read_text_table
from mauvecl.host.stars.flare_spectra import Blackbody, FlareSpectrum
from mauvecl.lightcurve.flares.energies import flux_in_band
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import checked
from mauvecl.schema.physical import Temperature
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]
#: What published energies are; see `Rates`.
Definition = Literal["light", "quiescent", "patch"]

#: What an energy may be of beside a band: the whole light of the flare's blackbody.
BOLOMETRIC = "bolometric"
#: Energies that flares of any star may have, erg.
ENERGIES = (1e22, 1e42)
#: By how much a published relation may miss the rate of a single star, dex (assumption: stars of one mass and age
#: differ by factors of a few).
SCATTER_DEX = 0.5
DAYS_PER_YEAR = 365.25


@dataclass(frozen=True, kw_only=True)
class Rates(ABC):
    """A cumulative distribution of flare energies.

    Attributes
    ----------
    band : str
        Which light the energies are of: a band's name, or "bolometric".
    source : str
        Where it is from.
    measured_erg : (float, float)
        Energies between which it was measured; elsewhere it is extrapolated.
    scatter_dex : float
        Standard deviation of its rate's logarithm for a single star.
    definition : {"light", "quiescent", "patch"}
        Energy of the flares' light, alike in all directions; equivalent duration times the star's luminosity in the
        band (Davenport); or the bolometric energy of a blackbody of 10 000 K, a patch seen face on (Shibayama).
        `of_star` converts to the first.
    """

    band: str = "Kepler"
    source: str = "given"
    measured_erg: tuple[float, float] = ENERGIES
    scatter_dex: float = 0.0
    definition: Definition = "light"

    def __post_init__(self) -> None:
        low, high = self.measured_erg
        if not 0 < low < high < np.inf:
            raise InputError.of("measured_erg", self.measured_erg, "two rising energies above 0", unit="erg")
        if not (np.isfinite(self.scatter_dex) and 0 <= self.scatter_dex <= 3):
            raise InputError.of("scatter_dex", self.scatter_dex, "0 to 3")

    @abstractmethod
    def per_day_above(self, energy_erg: ArrayLike) -> Float:
        """Flares a day of an energy or more, shape of the energy."""

    @abstractmethod
    def times_energy(self, factor: float) -> Self:
        """The same flares with energies that are so many times as large."""

    def in_band(self, band: str, flare_k: float = 10_000.0, flare: FlareSpectrum | None = None) -> Self:
        """The same flares with their energies in another band, or bolometric ones.

        Parameters
        ----------
        band : str
            A name of `host.stars.bands`, or "bolometric".
        flare_k : float
            Temperature of the flares, blackbodies.
        flare : FlareSpectrum, optional
            Light of the flares in place of those blackbodies.

        Raises
        ------
        InputError
            For an unknown band, or a temperature that no flare has.
        """
        return replace(self.times_energy(band_factor(self.band, band, flare_k, flare)), band=band)

    def of_light(self, erg_per_s: float, luminosity_erg_s: float) -> Self:
        """Return the same flares by the bolometric energy of their light at one star.

        Parameters
        ----------
        erg_per_s : float
            Bolometric energy per second of equivalent duration in `amplitude_band`: an `EnergyScale`.
        luminosity_erg_s : float
            The star's in that band, `quiescent_luminosity`.

        Raises
        ------
        InputError
            If the energies are those of light already; see `in_band`.
        """
        if self.definition == "light":
            raise InputError.of("definition", self.definition, "a published definition, not that of light")
        published = luminosity_erg_s
        if self.definition == "patch":
            published *= band_factor(self.amplitude_band, BOLOMETRIC) / 4
        return replace(self.times_energy(erg_per_s / published), band=BOLOMETRIC, definition="light")

    @property
    def amplitude_band(self) -> str:
        """Band in which equivalent durations were measured: for bolometric energies Kepler's."""
        return "Kepler" if self.band == BOLOMETRIC else self.band


@dataclass(frozen=True, kw_only=True)
class PowerLaw(Rates):
    """dN/dE = beta E^-alpha a day.

    Attributes
    ----------
    alpha : float
        Above 1.
    log10_beta : float
        Of flares a day and erg^(alpha - 1).
    largest_erg : float
        No flares beyond; infinite unless given, as in AltaiPony.

    Examples
    --------
    >>> from mauvecl.lightcurve.flares.rates import davenport2019
    >>> round(float(davenport2019(mass_msun=0.5, age_myr=100).per_day_above(1e33)), 6)
    0.074131
    """

    alpha: float
    log10_beta: float
    largest_erg: float = np.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 < self.alpha < 10:
            raise InputError.of("alpha", self.alpha, "above 1, below 10")
        if not np.isfinite(self.log10_beta):
            raise InputError.of("log10_beta", self.log10_beta, "a finite number")
        if not self.largest_erg > 0:
            raise InputError.of("largest_erg", self.largest_erg, "above 0")

    @classmethod
    def through(cls, alpha: float, energy_erg: float, per_day: float, **others: object) -> Self:
        """By the rate of flares of an energy or more.

        Parameters
        ----------
        alpha : float
        energy_erg, per_day : float
        **others
            Attributes of `Rates`, and `largest_erg`.
        """
        for name, value in (("energy_erg", energy_erg), ("per_day", per_day)):
            if not (np.isfinite(value) and value > 0):
                raise InputError.of(name, value, "above 0")
        if not 1 < alpha < 10:
            raise InputError.of("alpha", alpha, "above 1, below 10")
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
    """A cumulative distribution as a table: a line of logarithms between its rows.

    Below its first energy nothing is added, beyond its last no flare is counted.

    Attributes
    ----------
    energy_erg : ndarray, shape (n,)
        Ascending.
    per_day : ndarray, shape (n,)
        Flares a day of the energy or more; falling.
    """

    energy_erg: Float
    per_day: Float

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("energy_erg", "per_day"):
            kept = np.array(getattr(self, name), np.float64)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)
        energy, rate = self.energy_erg, self.per_day
        if energy.ndim != 1 or energy.shape != rate.shape or energy.size < 2:
            raise InputError(
                f"a table of rates has {energy.size} energies and {rate.size} rates",
                "as many, 2 at least",
                key="per_day",
                value=rate.size,
            )
        if not (np.isfinite(energy).all() and (energy > 0).all() and (np.diff(energy) > 0).all()):
            raise InputError(
                "energies of a table of rates do not ascend", "ascending ones above 0", key="energy_erg", value=energy
            )
        if not (np.isfinite(rate).all() and (rate > 0).all() and (np.diff(rate) <= 0).all()):
            raise InputError(
                "rates of a table do not fall",
                "flares a day of each energy or more, above 0",
                key="per_day",
                value=rate,
            )

    @classmethod
    def read(cls, path: str | Path, band: str = "Kepler") -> Self:
        """From CSV or ECSV with the columns ``energy`` (erg) and ``rate`` (of the energy or more, a day).

        Raises
        ------
        InputError
            If it cannot be read or has no such columns.
        """
        path = Path(path)
        table = read_text_table(path, "table of rates")
        missing = next((name for name in ("energy", "rate") if name not in table.colnames), None)
        if missing is not None:
            raise InputError(
                f"table of rates {shortened(path.name)} has no column {missing!r}",
                "energy and rate",
                key="columns",
                value=missing,
            )
        columns = []
        for name in ("energy", "rate"):
            values = np.ma.filled(np.ma.asarray(table[name]), np.nan)
            if values.dtype.kind not in "iuf":
                raise InputError(
                    f"table of rates {shortened(path.name)}: {name} holds no plain numbers",
                    "plain numbers",
                    key="columns",
                    value=name,
                )
            columns.append(np.asarray(values, np.float64))
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
    """Energy in one band over that in another, of a blackbody or another spectrum; either may be "bolometric".

    Raises
    ------
    InputError
        For an unknown band, or a temperature that no flare has.
    """
    flare_k = checked(Temperature, "flare_k", flare_k)
    light = Blackbody(flare_k) if flare is None else flare

    def flux(band: str) -> float:
        return light.bolometric_flux() if band == BOLOMETRIC else flux_in_band(band, light)

    return 1.0 if old == new else flux(new) / flux(old)


def davenport2019(*, mass_msun: float, age_myr: float) -> PowerLaw:
    """By mass and age: Davenport et al. 2019 (arXiv 1901.00890), energies in the Kepler band.

    log10 nu = a log10 E + b, a = -.07 log10 t + .79 m - 1.06, b = 2.01 log10 t - 25.15 m + 33.99. It gives the Sun more
    flares than it has.

    Parameters
    ----------
    mass_msun : float
        0.1 to 1.5; fitted to stars of 0.4 to 1.1 or so.
    age_myr : float
        1 to 13 800.

    Raises
    ------
    InputError
        If either is outside.
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
    """Slowly rotating G dwarfs: 7e33 erg or more once in 3000 years (Okamoto et al. 2021), exponent 2 (Shibayama 2013).

    Maehara et al. 2015 have 1e34 erg once in 800 years, others in 5000: hence the scatter.
    """
    return PowerLaw.through(
        2.0, 7e33, 1 / (3000 * DAYS_PER_YEAR), band=BOLOMETRIC,
        source="Sun-like G dwarfs: 7e33 erg per 3000 yr (Okamoto et al. 2021), exponent 2 (Shibayama et al. 2013)",
        measured_erg=(1e33, 1e36), scatter_dex=SCATTER_DEX, definition="patch",
    )  # fmt: skip


def fiducial2018(quiescent_si_iv_erg_s: float) -> PowerLaw:
    """The fiducial M dwarf of Loyd et al. 2018 (arXiv 1809.07322), by its light in Si IV; bolometric energies.

    nu(> delta) = 8 / d (delta / 1000 s)^-0.75 of equivalent durations in Si IV from 1e2 to 1e6 s, and 160 times their
    energy in the flare's blackbody of 9000 K.

    Parameters
    ----------
    quiescent_si_iv_erg_s : float
    """
    if not (np.isfinite(quiescent_si_iv_erg_s) and quiescent_si_iv_erg_s > 0):
        raise InputError.of("quiescent_si_iv_erg_s", quiescent_si_iv_erg_s, "above 0")
    second = 160 * quiescent_si_iv_erg_s
    return PowerLaw.through(
        1.75, 1000 * second, 8.0, band=BOLOMETRIC, source="fiducial flares of Loyd et al. 2018 (arXiv 1809.07322)",
        measured_erg=(100 * second, 1e6 * second), scatter_dex=SCATTER_DEX,
    )  # fmt: skip


#: Mass and age that stand for a type where a star's own are not known (assumption).
TYPICAL = {"G": (0.95, 1000.0), "K": (0.75, 1000.0), "M": (0.4, 1000.0)}


#: Exponents for types of which no rate of a single star is to be had: Althukair & Tsiklauri 2023, "Main Sequence Star
#: Super-flare Frequency based on Entire Kepler Data", abstract.
EXPONENTS = {"A": "1.3", "F": "2.0 to 2.1"}


def preset(name: str) -> PowerLaw:
    """By name: "G", "K" and "M" are Davenport's relation for a typical mass at 1 Gyr, "sunlike" an old, slow G dwarf.

    Other work has exponents of about 2: G 1.5 to 2 (Shibayama 2013, Maehara 2015), K and M 2.0 to 2.4 (Ilin 2019).

    Raises
    ------
    InputError
        For another name.
    """
    if name == "sunlike":
        return sunlike()
    if name not in TYPICAL:
        raise InputError.of("preset", name, f"{', '.join(TYPICAL)} or sunlike")
    mass, age = TYPICAL[name]
    rates = davenport2019(mass_msun=mass, age_myr=age)
    return replace(rates, source=f"{rates.source} (typical of type {name}: assumption)")
