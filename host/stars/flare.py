"""Flares: their spectra, their light in that of a star, and tables of flares.

A flare spectrum gives the flux of a flare up to a factor; `with_flare` scales it to an amplitude. The models follow
Kowalski (2024, doi 10.1007/s41116-024-00039-4): a hot blackbody in the optical, hydrogen recombination below the Balmer
edge, and emission lines. A flare is added to a star or replaces part of its photosphere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import astropy.units as u
import numpy as np
from astropy.constants import c, h, k_B
from numpy.typing import ArrayLike

from mauvecl.host.arrays import ContentEquality, Float, array_cache, set_read_only
from mauvecl.host.stars.spectrum import ANGSTROM, FLUX_UNIT, NEEDED_NM, attach, check_points, photons, supplement
from mauvecl.host.tables.files import LARGEST, SMALLEST
from mauvecl.schema import fields
from mauvecl.schema.calls import checked, validated
from mauvecl.schema.errors import InputError, shortened, shown
from mauvecl.schema.fields import Range, Unit, is_table

if TYPE_CHECKING:
    from astropy.table import QTable, Table

Geometry = Literal["added", "replaces"]
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
def blackbody(wavelength_nm: Float, temperature_k: float) -> Float:
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

    temperature_k: float | None = None  # temperature of the (first) blackbody; None for an observed flare
    _area: float = 1.0  # area of the flare in units of that whose surface has `flux`
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
        return supplement(wavelength_nm, self.nodes_nm, SAME_NM)

    def describe(self) -> str:
        """Return the spectrum in a few words."""
        raise NotImplementedError


@validated
@dataclass(frozen=True)
class Blackbody(FlareSpectrum):
    """Flare with the spectrum of a blackbody."""

    temperature_k: fields.Temperature = 10_000.0

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        return blackbody(wavelength_nm, self.temperature_k)

    def bolometric_flux(self) -> float:
        return STEFAN_BOLTZMANN * self.temperature_k**4

    def describe(self) -> str:
        return f"{self.temperature_k:g} K"


@validated
@dataclass(frozen=True)
class TwoBlackbodies(FlareSpectrum):
    """Flare of two temperatures; `second_area` is the area at the second over that at the first."""

    temperature_k: fields.Temperature = 10_000.0
    second_temperature_k: fields.Temperature = 30_000.0
    second_area: fields.AreaRatio = 0.05

    @property
    def _area(self) -> float:  # type: ignore[override]
        """Area of both blackbodies over that of the first."""
        return 1.0 + self.second_area

    def flux(self, wavelength_nm: Wavelengths) -> Float:
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

    The `jump` is the ratio of the flux just below the Balmer edge to that just above; 1 means no jump.
    """

    temperature_k: fields.Temperature = 10_000.0
    jump: fields.BalmerJump = 2.0
    electron_temperature_k: fields.Temperature = ELECTRON_TEMPERATURE_K

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        """Both sides of the Balmer edge, nm."""
        return np.array([BALMER_EDGE_NM, BALMER_EDGE_NM + EDGE_WIDTH_NM])

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        extra = balmer_continuum(wavelength_nm, self.electron_temperature_k)
        return np.asarray(blackbody(wavelength_nm, self.temperature_k) + self.edge_flux * extra)

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
        names, key = (*LINE_GROUPS, *LINES_NM), name.strip().casefold().replace("_", " ")
        for title in names:
            if title.casefold() == key:
                return cls(title, tuple(LINES_NM[line] for line in LINE_GROUPS.get(title, (title,))))
        try:
            nm = float(name)
        except ValueError:
            raise InputError.of("lines", name, f"a wavelength in nm or one of {', '.join(names)}") from None
        kind = Annotated[float, Unit("nm"), Range(100.0, 1000.0)]
        return cls(name.strip(), (checked(kind, f"wavelength of the line {name!r}", nm),))

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

    The flux of a line is a fraction of the continuum's in 200-700 nm, or a flux at the telescope, erg s-1 cm-2, that
    does not depend on the flare's amplitude.
    """

    continuum: FlareSpectrum
    fractions: Mapping[str, fields.LineFraction] = field(default_factory=dict)
    fluxes_cgs: Mapping[str, LineFlux] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (*self.fractions, *self.fluxes_cgs):
            EmissionLine.named(name)
        repeated = set(self.fractions) & set(self.fluxes_cgs)
        if repeated:
            raise InputError(f"the line {min(repeated)!r} needs either a fraction or a flux, but has both", key="lines")

    @property
    def temperature_k(self) -> float | None:  # type: ignore[override]
        """Temperature of the continuum, K."""
        return self.continuum.temperature_k

    @property
    def _area(self) -> float:  # type: ignore[override]
        """Area of the continuum."""
        return self.continuum._area

    @property
    def surface(self) -> bool:  # type: ignore[override]
        """True if `flux` is that of the flare's surface."""
        return self.continuum.surface

    @property
    def messages(self) -> tuple[str, ...]:  # type: ignore[override]
        """Assumptions of the continuum."""
        return self.continuum.messages

    @property
    def fixed_lines(self) -> bool:  # type: ignore[override]
        """True if some lines have a fixed flux at the telescope."""
        return any(self.fluxes_cgs.values())

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        """Nodes of the continuum and of the lines, nm."""
        lines = [EmissionLine.named(name).nodes_nm for name in (*self.fractions, *self.fluxes_cgs)]
        return np.unique(np.concatenate([self.continuum.nodes_nm, *lines]))

    @property
    def continuum_flux(self) -> float:
        """Flux of the continuum in 200-700 nm, erg s-1 cm-2, to which the fractions refer."""
        at = self.continuum.grid(np.linspace(*NEEDED_NM, RANGE_POINTS))
        return 10.0 * float(np.trapezoid(self.continuum.flux(at), at))

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        continuum = self.continuum.flux(wavelength_nm)
        return np.asarray(continuum + self.continuum_flux * _sum_of_lines(self.fractions, wavelength_nm))

    def flux_at_telescope(self, wavelength_nm: Wavelengths) -> Float:
        return _sum_of_lines(self.fluxes_cgs, wavelength_nm)

    def bolometric_flux(self) -> float:
        return self.continuum.bolometric_flux() + self.continuum_flux * sum(self.fractions.values())

    def describe(self) -> str:
        lines = [f"{100 * value:g} % in {name}" for name, value in self.fractions.items()]
        lines += [f"{value:g} erg/s/cm2 in {name}" for name, value in self.fluxes_cgs.items()]
        return f"{self.continuum.describe()}{' with ' if lines else ''}{', '.join(lines)}"


def _sum_of_lines(fluxes: Mapping[str, float], wavelength_nm: Float) -> Float:
    """Return the spectrum of lines that have these fluxes by name, per Angstrom, shape (n,)."""
    lines = (value * EmissionLine.named(name).profile(wavelength_nm) for name, value in fluxes.items())
    return sum(lines, np.zeros(np.shape(wavelength_nm)))


@validated
@dataclass(frozen=True, eq=False)
class ObservedFlare(ContentEquality, FlareSpectrum):
    """The spectrum of an observed or computed flare, without its star."""

    wavelength_nm: Wavelengths
    flux_flam: Float  #: Flux, erg s-1 cm-2 A-1; straight between the points. Negative values are measured noise.
    name: str = "flare"
    #: Range of the measurement; what lies outside was continued.
    measured_nm: Annotated[tuple[float, float], Unit("nm")] = (0.0, 0.0)
    messages: tuple[str, ...] = ()
    surface: ClassVar[bool] = False

    def __post_init__(self) -> None:
        set_read_only(self, wavelength_nm=self.wavelength_nm, flux_flam=self.flux_flam)
        check_points(self.name, self.wavelength_nm, self.flux_flam)
        ends = float(self.wavelength_nm[0]), float(self.wavelength_nm[-1])
        if ends[0] > NEEDED_NM[0] or ends[1] < NEEDED_NM[1]:
            fault = f"the flare spectrum {self.name} must cover {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm, but covers"
            remedy = "`continue_at_k=10000` continues it by a blackbody of this temperature"
            raise InputError(f"{fault} {ends[0]:g}-{ends[1]:g} nm; {remedy}", key="continue_at_k")
        if self.measured_nm == (0.0, 0.0):
            object.__setattr__(self, "measured_nm", ends)
        if not (total := self.bolometric_flux()) > 0.0:
            fault = f"the flare spectrum {self.name} needs a total flux above 0, not {total:g}"
            raise InputError(fault, key="flux")

    @classmethod
    def from_arrays(
        cls,
        wavelength_nm: Annotated[ArrayLike, Unit("nm")],
        flux_flam: Annotated[ArrayLike, Unit(str(FLUX_UNIT))],
        *,
        name: str = "flare",
        continue_at_k: fields.Temperature | None = None,
        messages: tuple[str, ...] = (),
    ) -> Self:
        """Return a flare from wavelengths, nm, and fluxes, erg s-1 cm-2 A-1, of the flare alone, shape (n,) each.

        A blackbody of the temperature `continue_at_k` continues the spectrum where it ends, scaled to its last 20 nm.
        """
        nm, flux = np.asarray(wavelength_nm, np.float64), np.asarray(flux_flam, np.float64)
        check_points(name, nm, flux)
        if not np.isfinite(flux).all():
            raise InputError(f"the flare spectrum {name} must have finite fluxes, but some are undefined", key="flux")
        measured = float(nm[0]), float(nm[-1])
        gaps = [f"{nm[i]:.1f}-{nm[i + 1]:.1f}" for i in np.flatnonzero(np.diff(nm) > GAP_NM)]
        if gaps:
            noun = "gap" if len(gaps) == 1 else "gaps"
            messages += (f"The flare spectrum {name} is interpolated in its {noun} at {', '.join(gaps)} nm",)
        if continue_at_k is not None:
            nm, flux = _continue(name, nm, flux, continue_at_k)
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
        continue_at_k: fields.Temperature | None = None,
    ) -> Self:
        """Read the spectrum of a star with its flare, and subtract its quiescent one, on the same scale, from it.

        Without `quiescent` the file has the flare alone. Formats are those of `Source.read`; the units override what
        both files state. A blackbody of the temperature `continue_at_k` continues the spectrum where it ends. Raises
        InputError for files that contain no spectra or do not overlap, or a spectrum that does not cover 200-700 nm.
        """
        from mauvecl.host.stars.formats import read_spectrum

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
            excess, rounding = np.trapezoid([flux, ROUNDING * np.abs(quiet)], nm)
            if not excess > rounding:
                fault = f"the spectrum {read.name} must be brighter than {star.name}, which is subtracted from it"
                remedy = "give the star with its flare, and the same star without it"
                raise InputError(f"{fault}: {remedy}", key="quiescent")
        messages = tuple(f"{read.name}: {text}" for text in messages)
        return cls.from_arrays(nm, flux, name=read.name, continue_at_k=continue_at_k, messages=messages)

    @property
    def nodes_nm(self) -> Float:  # type: ignore[override]
        return self.wavelength_nm

    def flux(self, wavelength_nm: Wavelengths) -> Float:
        return np.interp(wavelength_nm, self.wavelength_nm, self.flux_flam, 0.0, 0.0)

    def bolometric_flux(self) -> float:
        """Return the flux over the spectrum's range and its continuation, erg s-1 cm-2."""
        return 10.0 * float(np.trapezoid(self.flux_flam, self.wavelength_nm))

    def describe(self) -> str:
        return f"the spectrum {self.name}"


def _continue(name: str, nm: Float, flux: Float, kelvin: float) -> tuple[Float, Float]:
    """Continue a spectrum at both ends by a blackbody that has the mean flux of the last 20 nm there."""
    low, high = CONTINUED_NM
    steps = np.log(CONTINUED_RATIO)
    for blue in (True, False):
        end = nm[0] if blue else nm[-1]
        if (end <= NEEDED_NM[0]) if blue else (end >= high):
            continue
        join = np.abs(nm - end) <= JOIN_NM
        body = blackbody(nm[join], kelvin)
        # A coarse spectrum may have only its last point within that width.
        lights = flux[join], body
        level, model = (light[0] if body.size == 1 else np.trapezoid(light, nm[join]) for light in lights)
        scale = float(level / model)
        if not scale > 0.0:
            fault = f"the flare spectrum {name} has no light near {end:g} nm, but needs some to scale a blackbody to"
            raise InputError(fault, key="continue_at_k")
        added = np.exp(np.arange(np.log(low), np.log(end), steps))
        if not blue:
            added = np.append(np.exp(np.arange(np.log(end) + steps, np.log(high), steps)), high)
        nm, flux = attach(nm, added, blue), attach(flux, scale * blackbody(added, kelvin), blue)
    return nm, flux


def with_flare(
    nm: Float,
    flux_flam: Float,
    amplitude: float,
    spectrum: FlareSpectrum,
    band: str,
    geometry: Geometry,
    photosphere_k: float | None,
) -> tuple[Float, Float]:
    """Return wavelengths and flux of a flaring star, each of shape (n,); the spectrum may need more wavelengths.

    The flux is F + k B, as in the paper, if the light B of the flare is ``added`` to the star's, F. If it ``replaces``
    photosphere in a region of filling factor f = A / (R - 1), it is F (1 - f) + f R (N_F / N_B) B, where A is the
    amplitude, N are photons in the band and R is the ratio of the surface fluxes of flare and photosphere there.
    """
    checked(fields.Amplitude, "flare amplitude", amplitude)
    light = added_light(nm, flux_flam, spectrum, band, geometry, photosphere_k)
    star, hot, ratio = light.star, light.flare, light.ratio
    grid = spectrum.grid(nm)
    quiescent = np.interp(grid, nm, flux_flam)
    body = spectrum.flux(grid)
    if spectrum.fixed_lines:
        lines = spectrum.flux_at_telescope(grid)
        rise = photons(grid, lines, band) / star
        if rise > amplitude:
            fault = f"flare amplitude must be at least {rise:g}, the rise by its lines in {band}, not {amplitude:g}"
            raise InputError(fault, key="flare_amplitude")
        return grid, quiescent + lines + (amplitude - rise) * star / hot * body
    if ratio is None:
        return grid, quiescent + amplitude * star / hot * body
    filling = amplitude / (ratio - 1.0)
    if filling > 1.0:
        fault = f"flare amplitude must be at most {ratio - 1.0:.3g} at {spectrum.describe()}, not {amplitude:g}"
        raise InputError(f"{fault}, which needs {filling:.2f} of the star's disc", key="flare_amplitude")
    return grid, quiescent * (1.0 - filling) + filling * ratio * star / hot * body


@dataclass(frozen=True)
class AddedLight:
    """Light that a flare of amplitude 1 adds to a star: `hot` times its spectrum less `lost` of the star."""

    star: float  # photons of the star in the band in which the amplitude is measured
    flare: float  # photons of the flare's spectrum there
    ratio: float | None = None  # surface flux of the flare there over that of the photosphere that it replaces

    @property
    def hot(self) -> float:
        """Multiple of the flare spectrum's flux."""
        return (1.0 if self.ratio is None else self.ratio / (self.ratio - 1.0)) * self.star / self.flare

    @property
    def lost(self) -> float:
        """Share of the star's own light."""
        return 0.0 if self.ratio is None else 1.0 / (self.ratio - 1.0)


def check_scales(spectrum: FlareSpectrum) -> None:
    """Raise InputError if some lines of a flare do not scale with its amplitude."""
    if spectrum.fixed_lines:
        needed = "must be given as a fraction of its continuum to scale with its amplitude"
        raise InputError(f"the lines of a flare of {spectrum.describe()} {needed}", key="lines")


def added_light(
    nm: Float, flux_flam: Float, spectrum: FlareSpectrum, band: str, geometry: Geometry, photosphere_k: float | None
) -> AddedLight:
    """Return the light of a flare of amplitude 1, without lines of a fixed flux; see `with_flare`."""
    grid = spectrum.grid(nm)
    star = photons(grid, np.interp(grid, nm, flux_flam), band)
    if not star > 0.0:
        raise InputError(f"the star must have light in the band {band}, but has none", key="band")
    hot = photons(grid, spectrum.flux(grid), band)
    if not hot > 0.0:
        raise InputError(f"the flare, {spectrum.describe()}, needs light in the band {band} to be scaled", key="band")
    if geometry == "added":
        return AddedLight(star, hot)
    if photosphere_k is None:
        fault = "flare geometry 'replaces' needs a photosphere temperature, in K"
        raise InputError(fault, key="photosphere_temperature")
    if not spectrum.surface or spectrum.fixed_lines:
        fault = f"flare geometry must be 'added' with {spectrum.describe()}, since its surface flux is unknown"
        raise InputError(fault, key="flare_geometry")
    checked(fields.Temperature, "photosphere temperature", photosphere_k)
    ratio = hot / (spectrum._area * photons(nm, blackbody(nm, photosphere_k), band))
    if ratio <= 1.0:
        photosphere = f"the {photosphere_k:g} K of the photosphere that it replaces"
        fault = f"flare temperature must be above {photosphere}, not {spectrum.describe()}"
        raise InputError(fault, key="flare_temperature")
    return AddedLight(star, hot, ratio)


#: Names of the column of the relative rise above the quiescent flux; AltaiPony's first.
AMPLITUDES = ("ampl_rec", "amplitude", "ampl", "amp", "peak_amplitude", "relative_amplitude")
#: Names of the columns of start and stop, days; AltaiPony's first.
STARTS, STOPS = ("tstart", "start", "t_start", "time_start"), ("tstop", "stop", "t_stop", "time_stop", "end")
#: Largest number of flares; results for more would be too many to read.
MAX_FLARES = 500


def read_flares(path: str | Path | Table | Any) -> QTable:
    """Read amplitudes, and times if present, from a table of flares, with a column named as in `AMPLITUDES`.

    The file is CSV, ECSV or FITS, or a table in memory, as of `flares_of`. The columns are ``amplitude``, and ``start``
    and ``stop`` in days of the table's own time system. Columns that are not used are named in ``meta["comments"]``.
    """
    from mauvecl.host.tables.opening import read_table

    return flares_of(read_table(path, "flare table"), "flare table" if is_table(path) else shortened(Path(path).name))


def flares_of(table: Table | Any, name: str = "flare table") -> QTable:
    """Extract amplitudes and times from a table in memory; see `read_flares`.

    It is an astropy table, or a DataFrame such as AltaiPony's ``flares``; errors call it by `name`.
    """
    from astropy.table import QTable

    from mauvecl.host.tables.opening import read_table
    from mauvecl.host.tables.table import Rows

    rows = Rows(read_table(table, "flare table"), name, "amplitude")
    amplitude, start, stop = map(rows.first, (AMPLITUDES, STARTS, STOPS))
    if amplitude is None:
        names = shown(", ".join(rows.names), 300)
        raise rows.error(f"it has the columns {names}, but needs one named {', '.join(AMPLITUDES)}", "amplitude")
    columns = ((amplitude, "1"), (start, "d"), (stop, "d"))
    cells = [[rows.number(column, row, unit) for column, unit in columns] for row in range(rows.n)]
    # Missing numbers are NaN. AltaiPony's tables have an empty row for a star without flares.
    numbers = np.array(cells, np.float64).reshape(-1, len(columns))
    filled = np.flatnonzero(~np.isnan(numbers).all(axis=1))
    if not 0 < filled.size <= MAX_FLARES:
        raise rows.error(f"it must have 1 to {MAX_FLARES} flares, not {filled.size}", "amplitude")
    for row, (value, begin, end) in zip(filled + 1, numbers[filled], strict=True):
        if not SMALLEST <= value <= LARGEST:
            cell = "an empty cell" if np.isnan(value) else f"{value:g}"
            raise rows.error(f"the amplitude in row {row} must be a rise above 0, not {cell}", "amplitude")
        if end < begin:
            raise rows.error(f"row {row} ends at {end:.10g} d, but must end after {begin:.10g} d", "stop")
    flares = QTable({"amplitude": numbers[filled, 0]})
    for k, title in ((1, "start"), (2, "stop")):
        if columns[k][0] is not None:
            flares[title] = numbers[filled, k] * u.d
    flares.meta["comments"] = list(rows.unused([name for name in rows.names if name not in (amplitude, start, stop)]))
    flares["amplitude"].info.description = "relative rise above the quiescent flux, in the band of the light curve"
    return flares
