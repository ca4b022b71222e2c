"""A star: its spectrum at a magnitude, with or without a flare or dust."""

from __future__ import annotations

import hashlib
import html
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import public
from ..content import ByContent
from ..errors import InputError
from ..plotting import picture
from ..quantities import number
from ..ranges import check_magnitude
from ..spectra.ends import (
    check_flux,
    check_measured,
    check_points,
    continued,
    coverage,
    extended,
    means,
    remarks,
    without_undefined_ends,
)
from ..spectra.formats import read_spectrum
from ..spectra.range import SPAN_NM
from . import bands, catalogue, own_stars
from .flare import Geometry, with_flare

if TYPE_CHECKING:
    import astropy.units as u
    from astropy.table import QTable

#: V of the brightest star, Sirius (Bessell 1990: -1.46), with room, and of the Sun with room: -26.76 (Willmer 2018).
BRIGHTEST_V, SUN_V = -2.0, (-27.3, -26.2)


@public
@dataclass(frozen=True, eq=False)
class Source(ByContent):
    """A stellar spectrum at the telescope.

    Attributes
    ----------
    wavelength_nm : ndarray, shape (n,)
        Vacuum wavelengths, strictly increasing, covering at least a third of 200-700 nm; `expect` asks for all that
        the instrument's pixels see.
    flux_flam : ndarray, shape (n,)
        erg s-1 cm-2 A-1, finite; linear between the points. Negative ones are measured noise.
    name, origin : str
        Origin says where the spectrum came from, with its citation.
    notes : tuple of str
        What a report should say of it.
    history : tuple of str
        What was done to it.
    scale : str
        What the magnitude means that it was brought to; nothing where it was not.
    told : tuple of str
        What every answer must say of it: what was assumed, continued or merged.
    measured_nm : tuple of float, optional
        Its span without what was continued at the level of its ends; all of it by default.
    unscaled : str
        Why its flux is not that at the telescope, so that it needs a magnitude; empty where it is.
    temperature_k : float, optional
        Of its photosphere, which flares may take the place of; None where it is not known.

    Raises
    ------
    InputError
        If the arrays do not hold such a spectrum.

    Examples
    --------
    >>> from mauvecl import Source
    >>> star = Source.from_library("G2V").at_magnitude(7.4)
    >>> round(star.magnitude("V"), 6)
    7.4
    >>> star.flaring(0.24).history
    ('scaled to V = 7.4', 'flare of 24 % in Kepler at 10000 K, added')
    """

    wavelength_nm: NDArray[np.float64]
    flux_flam: NDArray[np.float64]
    name: str
    origin: str
    notes: tuple[str, ...] = ()
    history: tuple[str, ...] = ()
    scale: str = ""
    told: tuple[str, ...] = ()
    measured_nm: tuple[float, float] | None = None
    unscaled: str = ""
    temperature_k: float | None = None

    def __post_init__(self) -> None:
        for field in ("wavelength_nm", "flux_flam"):
            # A copy of its own, so that nobody else can write to it.
            array = np.array(getattr(self, field), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        check_points(self.name, self.wavelength_nm, self.flux_flam)
        check_measured(self.name, self.wavelength_nm)
        check_flux(self.name, self.wavelength_nm, self.flux_flam)

    @cached_property
    def digest(self) -> str:
        """sha256 of the spectrum, hexadecimal."""
        return hashlib.sha256(self.wavelength_nm.tobytes() + self.flux_flam.tobytes()).hexdigest()

    @classmethod
    def from_library(cls, name: str) -> Self:
        """An embedded spectrum, or one of one's own, by name in any case; `catalogue.library_table` lists them.

        Raises
        ------
        InputError
            For an unknown name, with the nearest ones.
        """
        mine = own_stars.find(name) if catalogue.embedded(name) is None else None
        if mine is not None:
            wavelength, flux = own_stars.spectrum(mine)
            return cls(
                wavelength, flux, mine.name, mine.origin, mine.notes,
                told=mine.told, measured_nm=mine.measured_nm, unscaled=mine.unscaled,
            )  # fmt: skip
        entry = catalogue.find(name)
        table = catalogue.spectrum_table(entry["file"])
        noisy = entry["noisy_below_nm"]
        return cls(
            table["wavelength"],
            table["flux"],
            entry["name"],
            f"{entry['origin']}; {entry['citation']}",
            (
                f"library spectrum {entry['name']} is {entry['star']}; {entry['uv_quality']}",
                f"photosphere of {entry['temperature_k']} K: {entry['temperature_source']}",
            ),
            told=(f"noise rules its ultraviolet below {noisy} nm, where its flux is an upper limit",) if noisy else (),
            unscaled="" if entry["level"] == "as seen" else f"the library keeps it at {entry['level']}",
            temperature_k=float(entry["temperature_k"]),
        )

    @classmethod
    def read(
        cls,
        path: str | Path,
        *,
        wavelength_unit: str | u.UnitBase | None = None,
        flux_unit: str | u.UnitBase | None = None,
        extend: str | Source | None = None,
    ) -> Self:
        """Read a spectrum from a file of text, ECSV, VOTable or FITS.

        `told` holds what was assumed or changed. Undefined ends beyond 200-700 nm are left out. Ends within 180-750 nm
        are continued at their level where they are dark.

        Parameters
        ----------
        path : str or Path
            May end in a column, ``grid.fits[g45]``; see `formats.read_spectrum`.
        wavelength_unit, flux_unit : str or Unit, optional
            Override what the file states; a wavelength's may end in " air" or " vacuum".
        extend : str or Source, optional
            A library spectrum that continues the file's where it ends, scaled to it at the join.

        Raises
        ------
        InputError
            If the file is missing, unreadable or holds no usable spectrum, or less than a third of 200-700 nm.
        """
        read = read_spectrum(Path(path), wavelength_unit=wavelength_unit, flux_unit=flux_unit)
        star = cls._made(
            read.wavelength_nm, read.flux_flam, read.name, read.origin, read.notes, read.messages, extend, is_file=True
        )
        unscaled = read.unscaled or star._too_bright()
        return replace(star, unscaled=unscaled) if unscaled else star

    @classmethod
    def _made(
        cls,
        wavelength: NDArray[np.float64],
        flux: NDArray[np.float64],
        name: str,
        origin: str,
        notes: tuple[str, ...] = (),
        told: tuple[str, ...] = (),
        extend: str | Source | None = None,
        is_file: bool = False,
    ) -> Self:
        """Make a source of a user's spectrum: check its points and range, cut undefined ends, and continue others."""
        check_points(name, wavelength, flux)
        check_measured(name, wavelength)
        wavelength, flux, cut = without_undefined_ends(name, wavelength, flux)
        if is_file or extend is not None:
            told += (coverage(wavelength),)
        told += remarks(wavelength, flux)
        if extend is not None:
            other = cls.from_library(extend) if isinstance(extend, str) else extend
            wavelength, flux, added = extended(name, wavelength, flux, other.name, other.wavelength_nm, other.flux_flam)
            told += added
        check_flux(name, wavelength, flux)
        measured = (float(wavelength[0]), float(wavelength[-1]))
        wavelength, flux, added = continued(name, wavelength, flux, dark_only=True)
        return cls(
            wavelength, flux, name, origin, (*notes, *cut), told=(*told, *added),
            measured_nm=measured if added else None,
        )  # fmt: skip

    def _too_bright(self) -> str:
        """Return why the flux cannot be that of a star at the telescope, or nothing."""
        try:
            v = self.magnitude("V")
        except InputError:
            return ""
        sunlike = SUN_V[0] < v < SUN_V[1]
        return "" if v > BRIGHTEST_V or sunlike else f"its flux makes V = {v:.1f}, brighter than any star in the sky"

    def binned(self, width_nm: u.Quantity | float) -> Self:
        """The spectrum as means over bins, for noisy ones; bins start at its first wavelength.

        Parameters
        ----------
        width_nm : Quantity or float
            In nm, 0.01 to 50.

        Raises
        ------
        InputError
            For an impossible width.
        """
        width = number("bin", width_nm, "nm", low=0.01, high=50.0)
        first, last = self.wavelength_nm[0], self.wavelength_nm[-1]
        edges = np.append(np.arange(first, last - width / 2, width), last)
        flux = means(self.wavelength_nm, self.flux_flam, edges)
        nm = np.concatenate([[first], (edges[1:] + edges[:-1]) / 2, [last]])
        flux = np.concatenate([flux[:1], flux, flux[-1:]])
        return replace(self, wavelength_nm=nm, flux_flam=flux, history=(*self.history, f"binned to {width:g} nm"))

    @classmethod
    def from_arrays(
        cls,
        wavelength: ArrayLike | u.Quantity,
        flux: ArrayLike | u.Quantity,
        *,
        name: str = "star",
        origin: str = "arrays",
        extend: str | Source | None = None,
    ) -> Self:
        """A spectrum from two arrays, shape (n,): Quantities, or plain numbers in nm and erg s-1 cm-2 A-1.

        `extend` names a library spectrum, or is one, that goes on where the arrays end.

        Raises
        ------
        InputError
            For wrong units or an unusable spectrum.
        """
        import astropy.units as u

        flam = u.erg / (u.s * u.cm**2 * u.AA)
        try:
            nm = (
                wavelength.to(u.nm, u.spectral())
                if isinstance(wavelength, u.Quantity)
                else np.asarray(wavelength) * u.nm
            )
            values = flux.to(flam, u.spectral_density(nm)) if isinstance(flux, u.Quantity) else np.asarray(flux) * flam
        except (u.UnitConversionError, TypeError, ValueError) as error:
            raise InputError(f"spectrum {name}: {error}, expected a wavelength and a flux density") from error
        axis, density = np.ma.filled(nm.value, np.nan), np.ma.filled(values.value, np.nan)
        if isinstance(wavelength, u.Quantity) and wavelength.unit.physical_type != "length" and axis[:1] > axis[-1:]:
            # Rising frequencies are falling wavelengths.
            axis, density = axis[::-1], density[::-1]
        return cls._made(np.asarray(axis, float), np.asarray(density, float), name, origin, extend=extend)

    @classmethod
    def from_synphot(cls, spectrum: Any, *, name: str = "synphot spectrum") -> Self:
        """A synphot SourceSpectrum, sampled at its own wavelengths, or at half a nanometre where it has none near."""
        import astropy.units as u
        from synphot.units import FLAM

        if not hasattr(spectrum, "waveset"):
            raise InputError(
                f"the spectrum is of the type {type(spectrum).__name__}, expected a SourceSpectrum of synphot"
            )
        own = spectrum.waveset
        if own is None:
            raise InputError(f"{name} has no wavelengths of its own, expected a spectrum with a waveset")
        grid = np.arange(160.0, 1150.0, 0.5)
        nm = np.unique(own.to_value(u.nm))
        inside = grid[(grid > nm[0]) & (grid < nm[-1])]
        # A hair beside one of its own a wavelength says nothing new.
        at = np.searchsorted(nm, inside)
        alone = np.minimum(inside - nm[at - 1], nm[at] - inside) > 1e-3
        grid = np.union1d(nm, inside[alone])
        flux = spectrum(grid * u.nm, flux_unit=FLAM).value
        return cls._made(grid, flux, name, f"synphot {type(spectrum).__name__}")

    @classmethod
    def from_specutils(cls, spectrum: Any, *, name: str = "specutils spectrum") -> Self:
        """A one-dimensional specutils Spectrum with units."""
        if not (hasattr(spectrum, "spectral_axis") and hasattr(spectrum, "flux")):
            raise InputError(f"the spectrum is of the type {type(spectrum).__name__}, expected a Spectrum of specutils")
        axis, flux = spectrum.spectral_axis, spectrum.flux
        if flux.ndim != 1:
            raise InputError(f"{name} has shape {flux.shape}, expected one spectrum")
        import astropy.units as u

        order = np.argsort(axis.to_value(u.nm, u.spectral()))
        return cls.from_arrays(u.Quantity(axis)[order], u.Quantity(flux)[order], name=name, origin="specutils Spectrum")

    def to_synphot(self) -> Any:
        """The spectrum as a synphot SourceSpectrum, linear between its points."""
        import astropy.units as u
        from synphot import Empirical1D, SourceSpectrum
        from synphot.units import FLAM, PHOTLAM, convert_flux

        at = self.wavelength_nm * u.nm
        photons = convert_flux(at, self.flux_flam * FLAM, PHOTLAM)
        # Negative fluxes are measured noise; without this they become zero.
        return SourceSpectrum(Empirical1D, points=at, lookup_table=photons, keep_neg=True)

    def to_specutils(self) -> Any:
        """The spectrum as a specutils Spectrum (needs the extra ``spectra``)."""
        import astropy.units as u

        try:
            from specutils import Spectrum
        except ImportError as error:
            raise InputError("specutils is missing, expected `pip install 'mauvecl[spectra]'`") from error
        flam = u.erg / (u.s * u.cm**2 * u.AA)
        return Spectrum(
            spectral_axis=self.wavelength_nm * u.nm,
            flux=self.flux_flam * flam,
            meta={"name": self.name, "origin": self.origin, "history": list(self.history)},
        )

    @property
    def table(self) -> QTable:
        """Wavelength and flux with their units, one row per point."""
        import astropy.units as u
        from astropy.table import QTable

        flam = u.erg / (u.s * u.cm**2 * u.AA)
        table = QTable({"wavelength": self.wavelength_nm * u.nm, "flux": self.flux_flam * flam})
        table.meta |= {"name": self.name, "origin": self.origin, "history": list(self.history)}
        return table

    def plot(self, path: str | Path | None = None, *, ax: Any = None) -> Any:
        """Flux against wavelength, saved under a path or drawn in axes; needs matplotlib."""
        return picture("inputs.source", self, path=path, ax=ax)

    def _line(self) -> str:
        span = f"{self.name!r}, {self.wavelength_nm[0]:.0f}-{self.wavelength_nm[-1]:.0f} nm"
        return ", ".join([span, *self.history])

    def _repr_html_(self) -> str:
        notes = "".join(f"<br><small>{html.escape(text)}</small>" for text in (self.origin, *self.history))
        span = f"{self.wavelength_nm[0]:.0f}-{self.wavelength_nm[-1]:.0f} nm, {self.wavelength_nm.size} points"
        return f"<b>{html.escape(self.name)}</b>, {span}{notes}"

    def magnitude(self, band: str = "V", system: bands.System = "catalogue") -> float:
        """Synthetic magnitude, as catalogues print it unless another system is named.

        Parameters
        ----------
        band : str
        system : {"catalogue", "vega", "ab"}
            What catalogues mean in the band, Vega at zero in every band, or AB.

        Raises
        ------
        InputError
            For an unknown band or system, or a band that the spectrum does not cover.
        """
        low, high = self.measured_nm or (0.0, np.inf)
        # What was made up is nobody's magnitude.
        inside = (self.wavelength_nm >= low) & (self.wavelength_nm <= high)
        return bands.magnitude(self.wavelength_nm[inside], self.flux_flam[inside], band, system)

    def at_magnitude(self, magnitude: u.Quantity | float, band: str = "V", system: bands.System = "catalogue") -> Self:
        """The same star at another magnitude: F 10**(-0.4 (m - m0)) (the paper's equation 1).

        Parameters
        ----------
        magnitude : Quantity or float in mag
        band : str
        system : {"catalogue", "vega", "ab"}
            See `magnitude`.

        Raises
        ------
        InputError
            As `magnitude`, or for a magnitude outside -30 to 40.
        """
        magnitude = number("magnitude", magnitude, "mag")
        check_magnitude(magnitude)
        factor = 10.0 ** (-0.4 * (magnitude - self.magnitude(band, system)))
        scaled = self._changed(self.flux_flam * factor, f"scaled to {bands.band(band).name} = {magnitude:g}")
        return replace(scaled, scale=bands.scale(band, system), unscaled="")

    def flaring(
        self,
        amplitude: u.Quantity | float,
        temperature: u.Quantity | float = 10_000.0,
        *,
        band: str = "Kepler",
        geometry: Geometry = "added",
        photosphere_temperature: u.Quantity | float | None = None,
    ) -> Self:
        """The star with a flare; see `flare.with_flare` for the geometries.

        Parameters
        ----------
        amplitude : Quantity or float
            Relative rise of the photons in the band: 0.24 is 24 %.
        temperature : Quantity or float in K
        band : str
        geometry : {"added", "replaces"}
        photosphere_temperature : Quantity or float in K, optional
            For ``replaces``, in place of the star's own `temperature_k`.

        Raises
        ------
        InputError
            For an impossible value, or a band that the spectrum does not cover.
        """
        amplitude, kelvin = number("flare amplitude", amplitude), number("flare temperature", temperature, "K")
        photosphere = self.temperature_k
        if photosphere_temperature is not None:
            photosphere = number("photosphere temperature", photosphere_temperature, "K")
        flux = with_flare(
            self.wavelength_nm,
            self.flux_flam,
            amplitude=amplitude,
            temperature_k=kelvin,
            band=band,
            geometry=geometry,
            photosphere_temperature_k=photosphere,
        )
        title = f"flare of {100 * amplitude:g} % in {bands.band(band).name} at {kelvin:g} K, {geometry}"
        if geometry == "replaces":
            title += f" photosphere of {photosphere:g} K"
        return self._changed(flux, title)

    def reddened(self, ebv: u.Quantity | float, *, rv: float = 3.1, law: str = "G23") -> Self:
        """The star behind dust (needs the extra ``extinction``).

        Parameters
        ----------
        ebv : Quantity or float in mag
            Colour excess E(B-V), 0 to 10 mag.
        rv : float
            A_V / E(B-V).
        law : {"G23", "F19", "CCM89"}
            A law of dust_extinction.

        Raises
        ------
        InputError
            For an impossible value, a law that does not cover the spectrum's part in 180-750 nm, or the missing extra.
        """
        try:
            from dust_extinction import parameter_averages
        except ImportError as error:
            raise InputError(
                "extinction needs dust_extinction, expected `pip install 'mauvecl[extinction]'`"
            ) from error
        import astropy.units as u

        ebv, rv = number("E(B-V)", ebv, "mag", low=0.0, high=10.0), number("R_V", rv)
        if law not in ("G23", "F19", "CCM89"):
            raise InputError(f"extinction law = {law!r}, expected 'G23', 'F19' or 'CCM89'")
        try:
            model = getattr(parameter_averages, law)(Rv=rv)
        except ValueError as error:
            raise InputError(f"R_V = {rv!r}: {error}, expected what the law {law} allows") from error
        # Laws end somewhere in the far ultraviolet; light beyond does not reach the detector.
        low, high = 1000.0 / np.asarray(model.x_range)[::-1]
        inside = (self.wavelength_nm >= low) & (self.wavelength_nm <= high)
        if low > SPAN_NM[0] or high < SPAN_NM[1]:
            raise InputError(f"extinction law {law} covers {low:.0f}-{high:.0f} nm, expected 180-750 nm")
        flux = self.flux_flam[inside] * model.extinguish(self.wavelength_nm[inside] * u.nm, Ebv=ebv)
        history = (*self.history, f"reddened by E(B-V) = {ebv:g}, {law}, R_V = {rv:g}")
        return replace(self, wavelength_nm=self.wavelength_nm[inside], flux_flam=flux, history=history)

    def _changed(self, flux: NDArray[np.float64], what: str) -> Self:
        return replace(self, flux_flam=flux, history=(*self.history, what))
