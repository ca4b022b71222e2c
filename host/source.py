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

from . import bands, catalogue, own_stars
from .errors import InputError
from .flare import Geometry, with_flare
from .formats import read_spectrum
from .spectral_values import check_values

if TYPE_CHECKING:
    import astropy.units as u

#: What a spectrum must span, in nm (the paper, section "Preparing the input spectrum").
SPAN_NM = (180.0, 750.0)


@dataclass(frozen=True, eq=False)
class Source:
    """A stellar spectrum at the telescope.

    Attributes
    ----------
    wavelength_nm : ndarray, shape (n,)
        Vacuum wavelengths, strictly increasing, spanning at least 180-750 nm.
    flux_flam : ndarray, shape (n,)
        erg s-1 cm-2 A-1, finite and not negative; linear between the points.
    name, origin : str
        Origin says where the spectrum came from, with its citation.
    notes : tuple of str
        What a report should say of it.
    history : tuple of str
        What was done to it.

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

    def __post_init__(self) -> None:
        for field in ("wavelength_nm", "flux_flam"):
            # A copy of its own, so that nobody else can write to it.
            array = np.array(getattr(self, field), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        _check(self.name, self.wavelength_nm, self.flux_flam)

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
            return cls(*own_stars.spectrum(mine), mine.name, mine.origin, mine.notes)
        entry = catalogue.find(name)
        table = catalogue.spectrum_table(entry["file"])
        return cls(
            np.asarray(table["wavelength"], float),
            np.asarray(table["flux"], float),
            entry["name"],
            f"{entry['origin']}; {entry['citation']}",
            (f"library spectrum {entry['name']} is {entry['star']}; {entry['uv_quality']}",),
        )

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """A user's own spectrum: two-column text (nm, erg s-1 cm-2 A-1), ECSV, or an archive's FITS table.

        Ends beyond 180-750 nm with negative or undefined flux, as archive spectra have, are left out and noted.

        Raises
        ------
        InputError
            If the file is missing, unreadable or holds no usable spectrum.
        """
        found = read_spectrum(Path(path))
        wavelength, flux, note = _without_bad_ends(found.wavelength_nm, found.flux_flam)
        return cls(wavelength, flux, found.name, found.origin, (*found.notes, *note))

    @classmethod
    def from_arrays(
        cls,
        wavelength: ArrayLike | u.Quantity,
        flux: ArrayLike | u.Quantity,
        *,
        name: str = "star",
        origin: str = "arrays",
    ) -> Self:
        """A spectrum from two arrays, shape (n,): Quantities, or plain numbers in nm and erg s-1 cm-2 A-1.

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
        return cls(axis, density, name, origin)

    @classmethod
    def from_synphot(cls, spectrum: Any, *, name: str = "synphot spectrum") -> Self:
        """A synphot SourceSpectrum, sampled at its own wavelengths, or at half a nanometre where it has none near."""
        import astropy.units as u
        from synphot.units import FLAM

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
        return cls(grid, flux, name, f"synphot {type(spectrum).__name__}")

    @classmethod
    def from_specutils(cls, spectrum: Any, *, name: str = "specutils spectrum") -> Self:
        """A one-dimensional specutils Spectrum with units."""
        axis, flux = spectrum.spectral_axis, spectrum.flux
        if flux.ndim != 1:
            raise InputError(f"{name} has shape {flux.shape}, expected one spectrum")
        import astropy.units as u

        order = np.argsort(axis.to_value(u.nm, u.spectral()))
        return cls.from_arrays(u.Quantity(axis)[order], u.Quantity(flux)[order], name=name, origin="specutils Spectrum")

    def to_synphot(self) -> Any:
        """The spectrum as a synphot SourceSpectrum, linear between its points."""
        return bands.synphot_spectrum(self.wavelength_nm, self.flux_flam)

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

    def _repr_html_(self) -> str:
        notes = "".join(f"<br><small>{html.escape(text)}</small>" for text in (self.origin, *self.history))
        span = f"{self.wavelength_nm[0]:.0f}-{self.wavelength_nm[-1]:.0f} nm, {self.wavelength_nm.size} points"
        return f"<b>{html.escape(self.name)}</b>, {span}{notes}"

    def magnitude(self, band: str = "V") -> float:
        """Synthetic magnitude; Vega system, AB for GALEX NUV.

        Raises
        ------
        InputError
            For an unknown band or one that the spectrum does not cover.
        """
        return bands.magnitude(self.wavelength_nm, self.flux_flam, band)

    def at_magnitude(self, magnitude: float, band: str = "V") -> Self:
        """The same star at another magnitude: F 10**(-0.4 (m - m0)) (the paper's equation 1).

        Raises
        ------
        InputError
            As `magnitude`, or for a magnitude outside -30 to 40.
        """
        magnitude = _number("magnitude", magnitude, "mag")
        if not (np.isfinite(magnitude) and -30.0 <= magnitude <= 40.0):
            raise InputError(f"magnitude = {magnitude!r}, expected -30 to 40")
        scale = 10.0 ** (-0.4 * (magnitude - self.magnitude(band)))
        return self._changed(self.flux_flam * scale, f"scaled to {bands.band(band).name} = {magnitude:g}")

    def flaring(
        self,
        amplitude: float,
        temperature: u.Quantity | float = 10_000.0,
        *,
        band: str = "Kepler",
        geometry: Geometry = "added",
        photosphere_temperature: u.Quantity | float | None = None,
    ) -> Self:
        """The star with a flare; see `flare.with_flare` for the geometries.

        Parameters
        ----------
        amplitude : float
            Relative rise of the photons in the band: 0.24 is 24 %.
        temperature : Quantity or float in K
        band : str
        geometry : {"added", "replaces"}
        photosphere_temperature : Quantity or float in K, optional
            Needed by ``replaces``.

        Raises
        ------
        InputError
            For an impossible value, or a band that the spectrum does not cover.
        """
        amplitude, kelvin = _number("flare amplitude", amplitude), _number("temperature", temperature, "K")
        flux = with_flare(
            self.wavelength_nm,
            self.flux_flam,
            amplitude=amplitude,
            temperature_k=kelvin,
            band=band,
            geometry=geometry,
            photosphere_temperature_k=None
            if photosphere_temperature is None
            else _number("photosphere temperature", photosphere_temperature, "K"),
        )
        title = f"flare of {100 * amplitude:g} % in {bands.band(band).name} at {kelvin:g} K, {geometry}"
        return self._changed(flux, title)

    def reddened(self, ebv: float, *, rv: float = 3.1, law: str = "G23") -> Self:
        """The star behind dust (needs the extra ``extinction``).

        Parameters
        ----------
        ebv : float
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

        ebv, rv = _number("E(B-V)", ebv, "mag"), _number("R_V", rv)
        if not (np.isfinite(ebv) and 0.0 <= ebv <= 10.0):
            raise InputError(f"E(B-V) = {ebv!r}, expected 0 to 10")
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


def _number(what: str, value: u.Quantity | float, unit: str = "") -> float:
    """One number, from a Quantity in the unit or a plain one."""
    import astropy.units as u

    try:
        if isinstance(value, str):
            raise TypeError("text")
        return float(value.to_value(unit)) if isinstance(value, u.Quantity) else float(value)
    except (u.UnitConversionError, TypeError, ValueError) as error:
        shown = str(value) if isinstance(value, u.Quantity) else repr(value)
        names = {"K": "kelvin", "mag": "magnitudes", "": "a number"}
        raise InputError(f"{what} = {shown}, expected {names[unit]}") from error


def _without_bad_ends(
    wavelength: NDArray[np.float64], flux: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]:
    """Leave out the ends beyond 180-750 nm from their innermost negative or undefined point on, and say so.

    Archive spectra end in noise; within the span such points remain, to be refused.
    """
    bad = ~(np.isfinite(flux) & (flux >= 0.0))
    low, high = (np.flatnonzero(bad & side) for side in (wavelength < SPAN_NM[0], wavelength > SPAN_NM[1]))
    start = int(low[-1]) + 1 if low.size else 0
    stop = int(high[0]) if high.size else wavelength.size
    if (start, stop) == (0, wavelength.size):
        return wavelength, flux, ()
    kept = wavelength[start:stop]
    note = (
        f"cut to {kept[0]:.1f}-{kept[-1]:.1f} nm: negative or undefined flux beyond, "
        f"outside {SPAN_NM[0]:g}-{SPAN_NM[1]:g} nm"
        if kept.size
        else "nothing left"
    )
    return kept, flux[start:stop], (note,)


def _check(name: str, wavelength: NDArray[np.float64], flux: NDArray[np.float64]) -> None:
    if wavelength.ndim != 1 or wavelength.shape != flux.shape or wavelength.size < 2:
        raise InputError(
            f"spectrum {name} has {wavelength.shape} wavelengths and {flux.shape} fluxes, expected two equal columns"
        )
    for what, values in (("wavelength", wavelength), ("flux", flux)):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise InputError(
                f"spectrum {name}: {what} {values[bad[0]]} at point {bad[0] + 1}, expected a finite number"
            )
    back = np.flatnonzero(np.diff(wavelength) <= 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"spectrum {name}: wavelength {wavelength[i + 1]:g} nm at point {i + 2} follows {wavelength[i]:g} nm, "
            "expected increasing wavelengths"
        )
    check_values(name, wavelength, flux)
    low, high = float(wavelength[0]), float(wavelength[-1])
    if low > SPAN_NM[0] or high < SPAN_NM[1]:
        guess = ""
        for unit, factor in (("Angstrom", 0.1), ("micrometres", 1000.0)):
            if (
                low * factor <= SPAN_NM[0] * 1.05
                and high * factor >= SPAN_NM[1] * 0.95
                and (low > 300.0 or high < 100.0)
            ):
                guess = f" (these look like {unit})"
        raise InputError(f"spectrum {name} spans {low:g}-{high:g} nm, expected at least 180-750 nm{guess}")
    negative = np.flatnonzero(flux < 0.0)
    if negative.size:
        i = int(negative[0])
        raise InputError(
            f"spectrum {name}: flux {flux[i]:g} at {wavelength[i]:g} nm, the first of {negative.size} negative, "
            "expected none: bin the spectrum more coarsely or mend it first"
        )
    if not flux.any():
        raise InputError(f"spectrum {name}: every flux is zero, expected some light")
