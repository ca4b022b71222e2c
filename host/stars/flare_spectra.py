"""Spectra of flares: blackbodies, a Balmer continuum, emission lines, and observed flares.

A flare spectrum gives the flux of a flare up to a factor; `with_flare` scales it to an amplitude. The models follow
Kowalski (2024, doi 10.1007/s41116-024-00039-4): a hot blackbody in the optical, hydrogen recombination below the Balmer
edge, and emission lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import astropy.units as u
import numpy as np
from astropy.constants import c, h, k_B
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import ContentEquality, array_cache, set_read_only
from mauvecl.host.spectra.units import NEEDED_NM
from mauvecl.host.stars.bands import ANGSTROM
from mauvecl.host.stars.coverage import attached, check_points, supplemented
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit, number
from mauvecl.schema.physical import AreaRatio, BalmerJump, LineFraction, Temperature

Float = NDArray[np.float64]
Wavelengths = Annotated[Float, Unit("nm")]
LineFlux = Annotated[float, Range(0)]

#: h c / k, nm K, and the Stefan-Boltzmann constant, erg s-1 cm-2 K-4 (CODATA 2018).
HC_OVER_K_NM_K, STEFAN_BOLTZMANN = 1.438776877e7, 5.670374419e-5
#: Nominal solar radius (IAU 2015, resolution B3) and parsec, cm.
SUN_CM, PARSEC_CM = 6.957e10, 3.0856775814913674e18
#: Balmer edge, nm, and electron temperature of the recombination below it, K (assumed: optically thin hydrogen).
BALMER_EDGE_NM, ELECTRON_TEMPERATURE_K = 364.6, 10_000.0
#: Distance below which two wavelengths count as equal, nm.
SAME_NM = 1e-6
#: Steps across the Balmer edge are this wide, nm.
EDGE_WIDTH_NM = 1e-3
#: Full width at half maximum of the triangular profile of a line, nm: far below the resolution, 10.5 nm.
LINE_WIDTH_NM = 0.1
#: Points of the integral of a continuum over 200-700 nm, to which relative line fluxes refer.
RANGE_POINTS = 5001
#: Vacuum wavelengths of lines, nm (NIST Atomic Spectra Database).
LINES_NM = {
    "Mg II k": 279.635,
    "Mg II h": 280.353,
    "Ca II K": 393.478,
    "Ca II H": 396.959,
    "H alpha": 656.461,
    "H beta": 486.269,
    "H gamma": 434.169,
    "H delta": 410.289,
    "H epsilon": 397.120,
    "H8": 389.017,
}
#: Groups of lines that share one flux equally (an assumption; Mauve resolves no doublet).
LINE_GROUPS = {
    "Mg II": ("Mg II k", "Mg II h"),
    "Ca II": ("Ca II K", "Ca II H"),
    "Balmer": ("H alpha", "H beta", "H gamma", "H delta", "H epsilon", "H8"),
}
#: An observed flare is continued by a blackbody from its ends to these wavelengths, nm, in steps of this ratio.
CONTINUED_NM, CONTINUED_RATIO = (50.0, 30_000.0), 1.01
#: Width over which a continuation is scaled to the measured flux, nm, and the largest gap that is not reported.
JOIN_NM, GAP_NM = 20.0, 5.0
#: Share of the star's light below which a flare is the rounding of its subtraction.
ROUNDING = 1e-12


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


@validated
class FlareSpectrum:
    """Spectrum of a flare, up to a factor."""

    temperature_k: float | None = None  # temperature of the hottest blackbody of the flare; None for an observed flare
    # Shape (n,); wavelengths that a grid must contain so that linear interpolation conserves the flux.
    nodes_nm: Float = np.empty(0)
    surface: ClassVar[bool] = True  # whether `flux` is that of the flare's surface, from which an area follows
    fixed_lines: bool = False  # whether some lines have a fixed flux at the telescope, independent of the amplitude
    messages: tuple[str, ...] = ()  # assumptions that every answer must report

    def flux(self, wavelength_nm: Float) -> Float:
        """Return the flux, erg s-1 cm-2 A-1, shape (n,), at the flare's surface or as observed."""
        raise NotImplementedError

    def bolometric_flux(self) -> float:
        """Return the integral of `flux` over all wavelengths, erg s-1 cm-2."""
        raise NotImplementedError

    def flux_at_telescope(self, wavelength_nm: Float) -> Float:
        """Return the flux of lines that do not scale with the amplitude, erg s-1 cm-2 A-1, shape (n,)."""
        return np.zeros(np.shape(wavelength_nm))

    def grid(self, wavelength_nm: Float) -> Float:
        """Return wavelengths supplemented by the nodes of the spectrum, nm."""
        # A node next to a wavelength would only add rounding errors.
        return supplemented(wavelength_nm, self.nodes_nm, SAME_NM)

    def describe(self) -> str:
        """Return the spectrum in a few words."""
        raise NotImplementedError


@validated
@dataclass(frozen=True)
class Blackbody(FlareSpectrum):
    """Flare with the spectrum of a blackbody."""

    temperature_k: Temperature = 10_000.0

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        """Return the surface flux pi B, erg s-1 cm-2 A-1."""
        return blackbody(wavelength_nm, self.temperature_k)

    def bolometric_flux(self) -> float:
        return STEFAN_BOLTZMANN * self.temperature_k**4

    def describe(self) -> str:
        return f"{self.temperature_k:g} K"


@validated
@dataclass(frozen=True)
class TwoBlackbodies(FlareSpectrum):
    """Flare of two temperatures.

    Attributes
    ----------
    temperature_k, second_temperature_k : float
    second_area : float
        Area at the second temperature over that at the first.
    """

    temperature_k: Temperature = 10_000.0
    second_temperature_k: Temperature = 30_000.0
    second_area: AreaRatio = 0.05

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        """Return the surface flux of the first blackbody plus `second_area` times that of the second."""
        second = blackbody(wavelength_nm, self.second_temperature_k)
        return np.asarray(blackbody(wavelength_nm, self.temperature_k) + self.second_area * second)

    def bolometric_flux(self) -> float:
        return STEFAN_BOLTZMANN * (self.temperature_k**4 + self.second_area * self.second_temperature_k**4)

    def describe(self) -> str:
        return f"{self.temperature_k:g} K and {self.second_area:g} of its area at {self.second_temperature_k:g} K"


@validated
@dataclass(frozen=True)
class BalmerFlare(FlareSpectrum):
    """Blackbody with a Balmer continuum of optically thin hydrogen below 364.6 nm.

    Attributes
    ----------
    temperature_k : float
    jump : float
        Ratio of the flux just below the Balmer edge to that just above; 1 means no jump.
    electron_temperature_k : float
    """

    temperature_k: Temperature = 10_000.0
    jump: BalmerJump = 2.0
    electron_temperature_k: Temperature = ELECTRON_TEMPERATURE_K

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        """Return the surface flux of blackbody and Balmer continuum, erg s-1 cm-2 A-1."""
        extra = balmer_continuum(wavelength_nm, self.electron_temperature_k)
        return np.asarray(blackbody(wavelength_nm, self.temperature_k) + self.edge_flux * extra)

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        """Both sides of the Balmer edge, nm."""
        return np.array([BALMER_EDGE_NM, BALMER_EDGE_NM + EDGE_WIDTH_NM])

    @property
    def edge_flux(self) -> float:
        """Surface flux of the Balmer continuum at the edge, erg s-1 cm-2 A-1."""
        return (self.jump - 1.0) * float(blackbody(np.array([BALMER_EDGE_NM]), self.temperature_k)[0])

    def bolometric_flux(self) -> float:
        # The integral of (edge / l)^2 exp(-h c / k T (1 / l - 1 / edge)) over l, in Angstrom.
        width = 10.0 * BALMER_EDGE_NM**2 * self.electron_temperature_k / HC_OVER_K_NM_K
        return STEFAN_BOLTZMANN * self.temperature_k**4 + self.edge_flux * width

    def describe(self) -> str:
        return f"{self.temperature_k:g} K with a Balmer jump of {self.jump:g}"


def balmer_continuum(wavelength_nm: Float, electron_temperature_k: float = ELECTRON_TEMPERATURE_K) -> Float:
    """Return the Balmer continuum of optically thin hydrogen, one at the edge and zero above it, shape (n,)."""
    below = np.minimum(wavelength_nm, BALMER_EDGE_NM)
    exponent = HC_OVER_K_NM_K / electron_temperature_k * (1.0 / below - 1.0 / BALMER_EDGE_NM)
    return np.where(wavelength_nm <= BALMER_EDGE_NM, (BALMER_EDGE_NM / below) ** 2 * np.exp(-exponent), 0.0)


@dataclass(frozen=True)
class EmissionLine:
    """Unresolved emission line, or several lines that share a flux equally."""

    name: str
    wavelengths_nm: tuple[float, ...]  # vacuum wavelengths

    @classmethod
    def named(cls, name: str) -> Self:
        """Return a line or group of lines by name, or a line at a wavelength in nm.

        Raises InputError for an unknown name, or a wavelength outside 100 to 1000 nm.
        """
        wanted = name.strip().casefold().replace("_", " ")
        for known in (*LINES_NM, *LINE_GROUPS):
            if wanted == known.casefold():
                return cls(known, tuple(LINES_NM[line] for line in LINE_GROUPS.get(known, (known,))))
        try:
            nm = float(name)
        except ValueError:
            names = ", ".join((*LINE_GROUPS, *LINES_NM))
            raise InputError.of("lines", name, f"a wavelength in nm or one of {names}") from None
        return cls(name.strip(), (number(f"wavelength of the line {name!r}", nm, "nm", Range(100.0, 1000.0)),))

    @property
    def nodes_nm(self) -> Float:
        """Corners of the lines' profiles, nm."""
        return np.sort(np.add.outer(self.wavelengths_nm, LINE_WIDTH_NM * np.array([-1.0, 0.0, 1.0])).ravel())

    def profile(self, wavelength_nm: Float) -> Float:
        """Return the profile for a flux of one, A-1, shape (n,)."""
        distance = np.abs(np.subtract.outer(wavelength_nm, self.wavelengths_nm))
        triangles = np.maximum(0.0, 1.0 - distance / LINE_WIDTH_NM) / (10.0 * LINE_WIDTH_NM)
        return np.asarray(triangles.mean(axis=1))


@validated
@dataclass(frozen=True)
class FlareWithLines(FlareSpectrum):
    """Continuum with emission lines.

    Attributes
    ----------
    continuum : FlareSpectrum
    fractions : mapping of str to float
        Flux of each line as a fraction of the continuum's in 200-700 nm.
    fluxes_cgs : mapping of str to float
        Flux of each line at the telescope, erg s-1 cm-2, independent of the flare's amplitude.
    """

    continuum: FlareSpectrum
    fractions: Mapping[str, LineFraction] = field(default_factory=dict)
    fluxes_cgs: Mapping[str, LineFlux] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (*self.fractions, *self.fluxes_cgs):
            EmissionLine.named(name)
        both = set(self.fractions) & set(self.fluxes_cgs)
        if both:
            raise InputError(f"the line {min(both)!r} needs either a fraction or a flux, but has both", key="lines")

    @property
    def temperature_k(self) -> float | None:  # type: ignore[override]
        """Temperature of the continuum, K."""
        return self.continuum.temperature_k

    @property
    def surface(self) -> bool:  # type: ignore[override]
        """True if `flux` is that of the flare's surface."""
        return self.continuum.surface

    @property
    def fixed_lines(self) -> bool:  # type: ignore[override]
        """True if some lines have a fixed flux at the telescope."""
        return any(self.fluxes_cgs.values())

    @property
    def messages(self) -> tuple[str, ...]:  # type: ignore[override]
        """Assumptions of the continuum."""
        return self.continuum.messages

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        """Nodes of the continuum and of the lines, nm."""
        lines = [EmissionLine.named(name).nodes_nm for name in (*self.fractions, *self.fluxes_cgs)]
        return np.unique(np.concatenate([self.continuum.nodes_nm, *lines]))

    @property
    def continuum_flux(self) -> float:
        at = self.continuum.grid(np.linspace(*NEEDED_NM, RANGE_POINTS))
        return 10.0 * float(np.trapezoid(self.continuum.flux(at), at))

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        """Return the flux of the continuum and the lines that scale with it, erg s-1 cm-2 A-1."""
        continuum = self.continuum.flux(wavelength_nm)
        return np.asarray(continuum + self.continuum_flux * _sum_of_lines(self.fractions, wavelength_nm))

    def flux_at_telescope(self, wavelength_nm: Wavelengths) -> Float:
        """Return the flux of the lines that do not scale with the amplitude, erg s-1 cm-2 A-1."""
        return _sum_of_lines(self.fluxes_cgs, wavelength_nm)

    def bolometric_flux(self) -> float:
        """Return the flux of the continuum and of the lines that scale with it, erg s-1 cm-2."""
        return self.continuum.bolometric_flux() + self.continuum_flux * sum(self.fractions.values())

    def describe(self) -> str:
        lines = [f"{100 * value:g} % in {name}" for name, value in self.fractions.items()]
        lines += [f"{value:g} erg/s/cm2 in {name}" for name, value in self.fluxes_cgs.items()]
        return f"{self.continuum.describe()}{' with ' if lines else ''}{', '.join(lines)}"


def _sum_of_lines(fluxes: Mapping[str, float], wavelength_nm: Float) -> Float:
    lines = (value * EmissionLine.named(name).profile(wavelength_nm) for name, value in fluxes.items())
    return sum(lines, np.zeros(np.shape(wavelength_nm)))


@validated
@dataclass(frozen=True, eq=False)
class ObservedFlare(ContentEquality, FlareSpectrum):
    """The spectrum of an observed or computed flare, without its star.

    Attributes
    ----------
    wavelength_nm, flux_flam : ndarray, shape (n,)
        Flux, erg s-1 cm-2 A-1; straight between the points. Negative values are measured noise.
    name : str
    measured_nm : tuple of float
        Range of the measurement; what lies outside was continued.
    messages : tuple of str
    """

    wavelength_nm: Wavelengths
    flux_flam: Float
    name: str = "flare"
    measured_nm: Annotated[tuple[float, float], Unit("nm")] = (0.0, 0.0)
    messages: tuple[str, ...] = ()
    surface: ClassVar[bool] = False

    def __post_init__(self) -> None:
        set_read_only(self, wavelength_nm=self.wavelength_nm, flux_flam=self.flux_flam)
        check_points(self.name, self.wavelength_nm, self.flux_flam)
        ends = float(self.wavelength_nm[0]), float(self.wavelength_nm[-1])
        if ends[0] > NEEDED_NM[0] or ends[1] < NEEDED_NM[1]:
            needed = f"{NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm, but covers {ends[0]:g}-{ends[1]:g} nm"
            fault = f"the flare spectrum {self.name} must cover {needed}"
            remedy = "give the temperature of a blackbody that continues it"
            raise InputError(f"{fault}; {remedy}", key="continue_at_k")
        if self.measured_nm == (0.0, 0.0):
            object.__setattr__(self, "measured_nm", ends)
        if not self.bolometric_flux() > 0.0:
            fault = f"the flare spectrum {self.name} needs a total flux above 0, not {self.bolometric_flux():g}"
            raise InputError(fault, key="flux")

    @classmethod
    def from_arrays(
        cls,
        wavelength_nm: Annotated[ArrayLike, Unit("nm")],
        flux_flam: ArrayLike,
        *,
        name: str = "flare",
        continue_at_k: Temperature | None = None,
        messages: tuple[str, ...] = (),
    ) -> Self:
        """Return a flare from wavelengths, nm, and fluxes, erg s-1 cm-2 A-1, of the flare alone.

        Parameters
        ----------
        wavelength_nm, flux_flam : array_like, shape (n,)
        name : str
        continue_at_k : float, optional
            Temperature of the blackbody that continues the spectrum where it ends, scaled to its last 20 nm.
        messages : tuple of str
        """
        nm, flux = np.asarray(wavelength_nm, np.float64), np.asarray(flux_flam, np.float64)
        check_points(name, nm, flux)
        if not np.isfinite(flux).all():
            raise InputError(f"the flare spectrum {name} must have finite fluxes, but some are undefined", key="flux")
        measured = float(nm[0]), float(nm[-1])
        gaps = [f"{nm[i]:.1f}-{nm[i + 1]:.1f}" for i in np.flatnonzero(np.diff(nm) > GAP_NM)]
        if gaps:
            messages += (f"The flare spectrum {name} is interpolated in its gaps at {', '.join(gaps)} nm",)
        if continue_at_k is not None:
            nm, flux = _continued(name, nm, flux, continue_at_k)
            covered = f"The flare spectrum {name} covers {measured[0]:g}-{measured[1]:g} nm"
            messages += (f"{covered}; a blackbody of {continue_at_k:g} K continues it",)
        return cls(nm, flux, name, measured, messages)

    @classmethod
    def read(
        cls,
        path: str | Path,
        quiescent: str | Path | None = None,
        *,
        wavelength_unit: str | None = None,
        flux_unit: str | None = None,
        continue_at_k: Temperature | None = None,
    ) -> Self:
        """Read the spectrum of a flare, and subtract its star's quiescent spectrum from it.

        Raises InputError for files that hold no spectra or do not overlap, or a spectrum that does not cover 200-700
        nm.

        Parameters
        ----------
        path : str or Path
            Star and flare, or the flare alone where `quiescent` is None; formats as `Source.read`.
        quiescent : str or Path, optional
            The star without the flare, on the same scale.
        wavelength_unit, flux_unit : str, optional
            Override what both files state.
        continue_at_k : float, optional
            Temperature of the blackbody that continues the spectrum where it ends.
        """
        from mauvecl.host.spectra.formats import read_spectrum

        units: dict[str, Any] = {"wavelength_unit": wavelength_unit, "flux_unit": flux_unit}
        read = read_spectrum(Path(path), **units)
        nm, flux, messages = read.wavelength_nm, read.flux_flam, read.messages
        if quiescent is not None:
            star = read_spectrum(Path(quiescent), **units)
            inside = (nm >= star.wavelength_nm[0]) & (nm <= star.wavelength_nm[-1])
            if inside.sum() < 2:
                fault = f"the spectra {read.name} and {star.name} must be of the same star, but do not overlap"
                raise InputError(fault, key="quiescent")
            nm, messages = nm[inside], (*messages, *star.messages)
            quiet = np.interp(nm, star.wavelength_nm, star.flux_flam)
            flux = flux[inside] - quiet
            left, rounding = np.trapezoid([flux, ROUNDING * np.abs(quiet)], nm)
            if not left > rounding:
                fault = f"the spectrum {read.name} must be brighter than {star.name}, which is subtracted from it"
                remedy = "give the star with its flare, and the same star without it"
                raise InputError(f"{fault}: {remedy}", key="quiescent")
        own = tuple(f"{read.name}: {text}" for text in messages)
        return cls.from_arrays(nm, flux, name=read.name, continue_at_k=continue_at_k, messages=own)

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        """Wavelengths of the spectrum's points, nm."""
        return self.wavelength_nm

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        """Return the flux as it was observed, erg s-1 cm-2 A-1; zero outside of the spectrum."""
        return np.interp(wavelength_nm, self.wavelength_nm, self.flux_flam, 0.0, 0.0)

    def bolometric_flux(self) -> float:
        """Return the flux over the spectrum's range and its continuation, erg s-1 cm-2."""
        return 10.0 * float(np.trapezoid(self.flux_flam, self.wavelength_nm))

    def describe(self) -> str:
        return f"the spectrum {self.name}"


def _continued(name: str, nm: Float, flux: Float, kelvin: float) -> tuple[Float, Float]:
    """Continue a spectrum at both ends by a blackbody that has the mean flux of the last 20 nm there."""
    low, high = CONTINUED_NM
    steps = np.log(CONTINUED_RATIO)
    for blue in (True, False):
        end = nm[0] if blue else nm[-1]
        if (end <= NEEDED_NM[0]) if blue else (end >= high):
            continue
        join = np.abs(nm - end) <= JOIN_NM
        body = blackbody(nm[join], kelvin)
        # A coarse spectrum may have its last point alone within that width.
        alone = body.size == 1
        own, model = (light[0] if alone else np.trapezoid(light, nm[join]) for light in (flux[join], body))
        scale = float(own / model)
        if not scale > 0.0:
            fault = f"the flare spectrum {name} has no light near {end:g} nm, but needs some to scale a blackbody to"
            raise InputError(fault, key="continue_at_k")
        added = np.exp(np.arange(np.log(low), np.log(end), steps))
        if not blue:
            added = np.append(np.exp(np.arange(np.log(end) + steps, np.log(high), steps)), high)
        nm, flux = attached(nm, added, blue), attached(flux, scale * blackbody(added, kelvin), blue)
    return nm, flux
