"""Stellar spectra, scaled to a magnitude, flaring or reddened."""

from __future__ import annotations

import contextlib
import hashlib
import html
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import astropy.units as u
import numpy as np
from numpy.typing import ArrayLike

from mauvecl.host.arrays import ContentEquality, Float, set_read_only
from mauvecl.host.stars import library
from mauvecl.host.stars import spectrum as points
from mauvecl.host.stars.flare import Blackbody, FlareSpectrum, Geometry, blackbody, with_flare
from mauvecl.host.stars.spectrum import FLUX_UNIT, NEEDED_NM, SPAN_NM
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Drawable
from mauvecl.schema.errors import InputError, missing_package
from mauvecl.schema.fields import Amplitude, AnyUnit, BinWidth, Magnitude, Reddening, Temperature, Unit

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.stars.conversion import ReadSpectrum

#: V of the brightest star, Sirius (-1.46, Bessell 1990), and of the Sun (-26.76, Willmer 2018), with margins.
BRIGHTEST_V, SUN_V = -2.0, (-27.3, -26.2)
#: First and last wavelength of formulas, nm, and number of points. They cover all bands; straight lines between them
#: are true to 2e-5 for 3000 K at 200 nm, and closer elsewhere and for hotter stars.
GRID = (100.0, 3000.0, 8000)
#: Wavelength at which a power law has unit flux, nm.
PIVOT_NM = 550.0


@validated
@dataclass(frozen=True, eq=False)
class Source(Drawable, ContentEquality):
    """A stellar spectrum at the telescope; raises InputError if the arrays are not one.

    Examples
    --------
    >>> from mauvecl import Source
    >>> star = Source.from_library("G2V").at_magnitude(7.4)
    >>> round(star.magnitude("V"), 6)
    7.4
    >>> star.flaring(0.24).history
    ('scaled to V = 7.4', 'flare of 24 % in Kepler at 10000 K, added')
    """

    #: Vacuum wavelengths, strictly increasing, shape (n,), that cover at least a third of 200-700 nm; `expect` requires
    #: the range of the instrument's pixels.
    wavelength_nm: Annotated[Float, Unit("nm")]
    #: Flux density, erg s-1 cm-2 A-1, finite, linear between points. Negative values are measured noise.
    flux_flam: Float
    name: str
    origin: str  #: Includes the citation.
    notes: tuple[str, ...] = ()  #: Remarks for reports.
    history: tuple[str, ...] = ()  #: Operations applied to the spectrum.
    scale: str = ""  #: Explanation of the magnitude to which the spectrum was scaled; empty if it was not.
    messages: tuple[str, ...] = ()  #: Assumptions, continuations and merged orders, which every answer reports.
    #: Range without the parts that were continued at the level of the ends; None for the whole range.
    measured_nm: Annotated[tuple[float, float], Unit("nm")] | None = None
    unscaled: str = ""  #: Reason why the flux is not that at the telescope, so that a magnitude is needed.
    #: Temperature of the photosphere, which flares with ``geometry="replaces"`` need; None if unknown.
    temperature_k: Temperature | None = None

    def __post_init__(self) -> None:
        set_read_only(self, wavelength_nm=self.wavelength_nm, flux_flam=self.flux_flam)
        points.check_points(self.name, self.wavelength_nm, self.flux_flam)
        points.check_measured(self.name, self.wavelength_nm)
        points.check_flux(self.name, self.wavelength_nm, self.flux_flam)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the spectrum, hexadecimal."""
        return hashlib.sha256(self.wavelength_nm.tobytes() + self.flux_flam.tobytes()).hexdigest()

    @classmethod
    def from_library(cls, name: str) -> Self:
        """Return an embedded spectrum, one of the user's own stars, a blackbody or a power law, by name in any case.

        "blackbody 9000 K" is a blackbody, and "power law -2" a flux proportional to a power of the wavelength.
        `library_table` lists the names. Another spectral type, and a well-known star without a spectrum, have that of
        the nearest type, with a message. For an unknown name the error suggests the nearest ones.
        """
        star = library.named_star(name, "name")
        light = star.light
        if light is None:
            nearest = cls.from_library(star.nearest)
            return replace(nearest, name=star.name, messages=(library.listed_note(name), *nearest.messages))
        if isinstance(light, library.ModelStar):
            nm, level = np.geomspace(*GRID), "a formula has no absolute level"
            flux = (nm / PIVOT_NM) ** light.index if light.temperature_k is None else blackbody(nm, light.temperature_k)
            return cls(nm, flux, light.name, light.origin, unscaled=level, temperature_k=light.temperature_k)
        if isinstance(light, library.OwnStar):
            nm, flux = (np.asarray(light.table[key], np.float64) for key in ("wavelength", "flux"))
            source = cls(nm, flux, light.name, light.origin, light.notes, messages=light.messages,
                         measured_nm=light.measured_nm, unscaled=light.unscaled)  # fmt: skip
            if source.digest != light.table.meta["spectrum_sha256"]:
                fault = f"kept star {light.name!r} must be unchanged, but its digest differs: add or fetch it again"
                raise InputError(fault, key="name")
            return source
        table, noisy = library.spectrum_table(light["file"]), light["noisy_below_nm"]
        limit = f"noise rules its ultraviolet below {noisy} nm, where its flux is an upper limit"
        quality = f"library spectrum {light['name']} is {light['star']}; {light['uv_quality']}"
        kelvin = f"photosphere of {light['temperature_k']} K: {light['temperature_source']}"
        return cls(
            table["wavelength"], table["flux"], light["name"], f"{light['origin']}; {light['citation']}",
            (quality, kelvin), messages=(limit,) if noisy else (), temperature_k=float(light["temperature_k"]),
            unscaled="" if light["level"] == "as seen" else f"the library keeps it at {light['level']}",
        )  # fmt: skip

    @classmethod
    def read(
        cls,
        path: str | Path,
        *,
        wavelength_unit: str | u.UnitBase | None = None,
        flux_unit: str | u.UnitBase | None = None,
        extend: str | Source | None = None,
        ignore_checksum: bool = False,
    ) -> Self:
        """Read a spectrum from a file of text, ECSV, VOTable or FITS.

        `messages` lists assumptions and changes. Undefined ends beyond 200-700 nm are dropped. Dark ends within
        180-750 nm are continued at their level. Raises InputError if the file is missing, unreadable or has no usable
        spectrum, or less than a third of 200-700 nm.

        Parameters
        ----------
        path : str or Path
            May end in a column, ``grid.fits[g45]``; see `formats.read_spectrum`.
        wavelength_unit, flux_unit : str or Unit, optional
            Units that override those of the file; a unit of wavelength may end in " air" or " vacuum".
        extend : str or Source, optional
            Library spectrum that continues the file's beyond its end, scaled to match at the join.
        ignore_checksum : bool
            Whether a FITS file is read that its CHECKSUM or DATASUM contradicts.
        """
        from mauvecl.host.stars.formats import read_spectrum

        read = read_spectrum(
            Path(path), wavelength_unit=wavelength_unit, flux_unit=flux_unit, ignore_checksum=ignore_checksum
        )
        star = cls._of_points(read, extend)
        with contextlib.suppress(InputError):
            v = star.magnitude("V")
            if not star.unscaled and v <= BRIGHTEST_V and not SUN_V[0] < v < SUN_V[1]:
                return replace(star, unscaled=f"its flux makes V = {v:.1f}, brighter than any star in the sky")
        return star

    @classmethod
    def _of_points(cls, read: ReadSpectrum, extend: str | Source | None) -> Self:
        """Check a user's spectrum, drop undefined ends, continue others, and make it a source."""
        name, wavelength, flux, messages = read.name, read.wavelength_nm, read.flux_flam, read.messages
        points.check_points(name, wavelength, flux)
        points.check_measured(name, wavelength, read.axis_unit or "nm")
        wavelength, flux, cut = points.cut_undefined_ends(name, wavelength, flux)
        if read.axis_unit or extend is not None:
            covered = points.measured_part(wavelength)
            share = "" if covered > 1 - 1e-9 else f", {covered:.0%} of {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm"
            messages += (f"its own points cover {wavelength[0]:g}-{wavelength[-1]:g} nm{share}",)
        messages += points.remarks(wavelength, flux)
        if extend is not None:
            longer = cls.from_library(extend) if isinstance(extend, str) else extend
            ultraviolet = longer.messages if isinstance(extend, str) else ()
            extension = longer.name, longer.wavelength_nm, longer.flux_flam
            wavelength, flux, added = points.extend(name, wavelength, flux, extension, ultraviolet)
            messages += added
        points.check_flux(name, wavelength, flux)
        measured = (float(wavelength[0]), float(wavelength[-1]))
        wavelength, flux, added = points.continue_ends(name, wavelength, flux, dark_only=True)
        return cls(
            wavelength, flux, name, read.origin, (*read.notes, *cut), messages=(*messages, *added),
            measured_nm=measured if added else None, unscaled=read.unscaled,
        )  # fmt: skip

    def binned(self, width_nm: BinWidth) -> Self:
        """Return the spectrum averaged over bins of 0.01 to 50 nm from its first wavelength, which reduces noise."""
        first, last = self.wavelength_nm[0], self.wavelength_nm[-1]
        edges = np.append(np.arange(first, last - width_nm / 2, width_nm), last)
        flux = points.mean_fluxes(self.wavelength_nm, self.flux_flam, edges)
        nm = np.concatenate([[first], (edges[1:] + edges[:-1]) / 2, [last]])
        flux = np.concatenate([flux[:1], flux, flux[-1:]])
        return replace(self, wavelength_nm=nm, flux_flam=flux, history=(*self.history, f"binned to {width_nm:g} nm"))

    @classmethod
    def from_arrays(
        cls,
        wavelength: Annotated[ArrayLike, AnyUnit()],
        flux: Annotated[ArrayLike, AnyUnit()],
        *,
        name: str = "star",
        origin: str = "arrays",
        extend: str | Source | None = None,
    ) -> Self:
        """Make a spectrum from two arrays, shape (n,): Quantities, or plain numbers in nm and erg s-1 cm-2 A-1.

        `extend` is a library spectrum, or its name, that continues the arrays beyond their ends.
        """
        from mauvecl.host.stars.conversion import ReadSpectrum

        try:
            nm, values = (
                array if isinstance(array, u.Quantity) else np.asarray(array) * unit
                for array, unit in ((wavelength, u.nm), (flux, FLUX_UNIT))
            )
            nm = nm.to(u.nm, u.spectral())
            values = values.to(FLUX_UNIT, u.spectral_density(nm))
        except (u.UnitConversionError, TypeError, ValueError) as error:
            raise InputError(f"spectrum {name} needs a wavelength and a flux density: {error}", key="flux") from error
        axis, density = np.asarray(nm.value, float), np.asarray(values.value, float)
        if isinstance(wavelength, u.Quantity) and wavelength.unit.physical_type != "length" and axis[:1] > axis[-1:]:
            # Rising frequencies or energies are falling wavelengths.
            axis, density = axis[::-1], density[::-1]
        return cls._of_points(ReadSpectrum(axis, density, name, origin), extend)

    @classmethod
    def from_synphot(cls, spectrum: Any, *, name: str = "synphot spectrum") -> Self:
        """Sample a synphot SourceSpectrum at its own wavelengths and every half nanometre between them."""
        from synphot.units import FLAM

        if not hasattr(spectrum, "waveset"):
            raise InputError.of("spectrum", spectrum, "a SourceSpectrum of synphot")
        waveset = spectrum.waveset
        if waveset is None:
            raise InputError(f"{name} defines no wavelengths; use a spectrum with a waveset", key="spectrum")
        # A point of the grid within 1e-3 nm of one of the spectrum's own adds no information.
        grid = points.supplement(np.unique(waveset.to_value(u.nm)), np.arange(160.0, 1150.0, 0.5), 1e-3)
        flux = spectrum(grid * u.nm, flux_unit=FLAM).value
        return cls.from_arrays(grid, flux, name=name, origin=f"synphot {type(spectrum).__name__}")

    @classmethod
    def from_specutils(cls, spectrum: Any, *, name: str = "specutils spectrum") -> Self:
        """Convert a one-dimensional specutils Spectrum with units."""
        if not (hasattr(spectrum, "spectral_axis") and hasattr(spectrum, "flux")):
            raise InputError.of("spectrum", spectrum, "a Spectrum of specutils")
        axis, flux = spectrum.spectral_axis, u.Quantity(spectrum.flux, dtype=float)
        if flux.ndim != 1:
            raise InputError(f"{name} must be one spectrum, but has the shape {flux.shape}", key="spectrum")
        if spectrum.mask is not None:
            flux[spectrum.mask] = np.nan
        order = np.argsort(axis.to_value(u.nm, u.spectral()))
        return cls.from_arrays(u.Quantity(axis)[order], u.Quantity(flux)[order], name=name, origin="specutils Spectrum")

    def to_synphot(self) -> Any:
        """Convert to a synphot SourceSpectrum, linear between points."""
        from synphot import Empirical1D, SourceSpectrum
        from synphot.units import FLAM, PHOTLAM, convert_flux

        at = self.wavelength_nm * u.nm
        photons = convert_flux(at, self.flux_flam * FLAM, PHOTLAM)
        # Negative fluxes are measured noise; synphot's default sets them to zero.
        return SourceSpectrum(Empirical1D, points=at, lookup_table=photons, keep_neg=True)

    def to_specutils(self) -> Any:
        """Convert to a specutils Spectrum (needs the extra ``spectra``)."""
        try:
            from specutils import Spectrum
        except ImportError as error:
            raise missing_package("specutils", "a `Spectrum`", "spectra") from error
        return Spectrum(
            spectral_axis=self.wavelength_nm * u.nm,
            flux=self.flux_flam * FLUX_UNIT,
            meta={"name": self.name, "origin": self.origin, "history": list(self.history)},
        )

    @property
    def table(self) -> QTable:
        """Wavelength and flux with units, one row per point."""
        from astropy.table import QTable

        table = QTable({"wavelength": self.wavelength_nm * u.nm, "flux": self.flux_flam * FLUX_UNIT})
        table.meta |= {"name": self.name, "origin": self.origin, "history": list(self.history)}
        return table

    def _line(self) -> str:
        span = f"{self.name!r}, {self.wavelength_nm[0]:.0f}-{self.wavelength_nm[-1]:.0f} nm"
        return ", ".join([span, *self.history])

    def _repr_html_(self) -> str:
        notes = "".join(f"<br><small>{html.escape(text)}</small>" for text in (self.origin, *self.history))
        span = f"{self.wavelength_nm[0]:.0f}-{self.wavelength_nm[-1]:.0f} nm, {self.wavelength_nm.size} points"
        return f"<b>{html.escape(self.name)}</b>, {span}{notes}"

    def magnitude(self, band: str = "V", system: points.System = "catalogue") -> float:
        """Return the synthetic magnitude in a band; raises InputError if the measured spectrum does not cover it.

        The system is that of catalogues in the band, "vega" for Vega at zero in every band, or "ab".
        """
        low, high = self.measured_nm or (0.0, np.inf)
        # Continued ends are assumptions, so they do not count.
        inside = (self.wavelength_nm >= low) & (self.wavelength_nm <= high)
        return points.magnitude(self.wavelength_nm[inside], self.flux_flam[inside], band, system)

    def at_magnitude(self, magnitude: Magnitude, band: str = "V", system: points.System = "catalogue") -> Self:
        """Return the star scaled to a magnitude, -30 to 40: F 10**(-0.4 (m - m0)) (the paper's equation 1).

        Band and system are those of `magnitude`.
        """
        factor = 10.0 ** (-0.4 * (magnitude - self.magnitude(band, system)))
        history = (*self.history, f"scaled to {library.known_band(band)} = {magnitude:g}")
        flux, scale = self.flux_flam * factor, points.magnitude_scale(band, system)
        return replace(self, flux_flam=flux, history=history, scale=scale, unscaled="")

    def flaring(
        self,
        amplitude: Amplitude,
        temperature: Temperature = 10_000.0,
        *,
        spectrum: FlareSpectrum | None = None,
        band: str = "Kepler",
        geometry: Geometry = "added",
        photosphere_temperature: Temperature | None = None,
    ) -> Self:
        """Return the star with a flare; see `flare.with_flare` for the geometries.

        Parameters
        ----------
        amplitude : Quantity or float
            Relative rise of the photons in the band: 0.24 is 24 %.
        temperature : Quantity or float in K
            Temperature of the flare's blackbody.
        spectrum : FlareSpectrum, optional
            Light of the flare in place of a blackbody of that temperature.
        band : str
            Band in which the amplitude is measured.
        geometry : {"added", "replaces"}
        photosphere_temperature : Quantity or float in K, optional
            For ``replaces``; the default is the star's `temperature_k`.
        """
        light = Blackbody(temperature) if spectrum is None else spectrum
        photosphere = self.temperature_k if photosphere_temperature is None else photosphere_temperature
        nm, flux = with_flare(self.wavelength_nm, self.flux_flam, amplitude, light, band, geometry, photosphere)
        title = f"flare of {100 * amplitude:g} % in {library.known_band(band)} at {light.describe()}, {geometry}"
        if geometry == "replaces":
            title += f" photosphere of {photosphere:g} K"
        history, messages = (*self.history, title), (*self.messages, *light.messages)
        return replace(self, wavelength_nm=nm, flux_flam=flux, history=history, messages=messages)

    def reddened(self, ebv: Reddening, *, rv: float = 3.1, law: Literal["G23", "F19", "CCM89"] = "G23") -> Self:
        """Return the star reddened by dust of a colour excess E(B-V), 0 to 10 mag (needs the extra ``extinction``).

        The law is one of dust_extinction, and `rv` is A_V / E(B-V). Raises InputError if the law does not cover
        180-750 nm, or the extra is missing.
        """
        try:
            from dust_extinction import parameter_averages
        except ImportError as error:
            raise missing_package("dust_extinction", "extinction", "extinction") from error
        try:
            model = getattr(parameter_averages, law)(Rv=rv)
        except ValueError as error:
            raise InputError(f"R_V must be a value that the law {law} allows, not {rv!r}: {error}", key="rv") from error
        # Laws end in the far ultraviolet, whose light does not reach the detector.
        low, high = 1000.0 / np.asarray(model.x_range)[::-1]
        inside = (self.wavelength_nm >= low) & (self.wavelength_nm <= high)
        if low > SPAN_NM[0] or high < SPAN_NM[1]:
            raise InputError(f"the law {law} must cover 180-750 nm, not {low:.0f}-{high:.0f} nm", key="law")
        flux = self.flux_flam[inside] * model.extinguish(self.wavelength_nm[inside] * u.nm, Ebv=ebv)
        history = (*self.history, f"reddened by E(B-V) = {ebv:g}, {law}, R_V = {rv:g}")
        return replace(self, wavelength_nm=self.wavelength_nm[inside], flux_flam=flux, history=history)


def check_covers(source: Source, needed_nm: tuple[float, float] = NEEDED_NM, of: str = "") -> None:
    """Raise InputError if the measured range of a source does not cover that of the pixels."""
    low, high = source.measured_nm or source.wavelength_nm[[0, -1]]
    if low > needed_nm[0] or high < needed_nm[1]:
        needed = f"at least {of}{needed_nm[0]:g}-{needed_nm[1]:g} nm"
        fault = f"spectrum {source.name} must span {needed}, not {low:g}-{high:g} nm"
        raise InputError(f"{fault}: `extend` continues it by a library spectrum", key="extend")


def listed_star(name: str) -> Source:
    """Return the star of a name; one of the embedded list at its V there, with a message."""
    source = Source.from_library(name)
    if not (values := library.listed_values(name)):
        return source
    return with_listed_note(source, name, **values).at_magnitude(values["magnitude"])


def with_listed_note(source: Source, name: str, **used: float | None) -> Source:
    """Return a source with a message on the values of the embedded list that are used; see `listed_note`."""
    messages = [text for text in source.messages if text != library.listed_note(name)]
    note = library.listed_note(name, **used)
    return replace(source, messages=(note, *messages) if note else tuple(messages))
