"""Model of the light that a flare adds to a frame: its temperature, and amplitudes in which it is linear.

A model is a blackbody, whose spectrum depends on one temperature, and components of fixed shape next to it: a Balmer
continuum, and emission lines. Everything but the temperature is linear, so that a fit searches in one dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.response import Order, response_matrix
from mauvecl.host.stars.bands import photons
from mauvecl.host.stars.blackbody import blackbody
from mauvecl.host.stars.flare_spectra import (
    BALMER_EDGE_NM,
    ELECTRON_TEMPERATURE_K,
    PARSEC_CM,
    STEFAN_BOLTZMANN,
    SUN_CM,
    BalmerFlare,
    EmissionLine,
    balmer_continuum,
)
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import range_of
from mauvecl.schema.physical import Distance, Radius, Temperature, Wavelength

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source

Float = NDArray[np.float64]

#: Range of fitted temperatures, K: that of flares, without cool ones that emit no ultraviolet light.
TEMPERATURES_K = (3_000.0, float(range_of(Temperature).high))
#: Number of temperatures at which spectra are computed, evenly spaced in log T; splines interpolate between them.
NODES = 225
#: Grid of the spectra, nm: it exceeds the instrument's range by the line spread, with steps far below the resolution.
GRID_NM = np.linspace(170.0, 760.0, 2361)
#: Bands in which light is reported by default, nm.
BANDS_NM = ((200.0, 320.0), (200.0, 700.0))


@dataclass(frozen=True, eq=False)
class Derived:
    """Quantity that follows from temperature and amplitudes."""

    name: str
    unit: str
    description: str
    # Shape (n_node, n_linear); the quantity is the sum of these times the amplitudes; None for the
    # temperature and for a ratio.
    factors: Float | None = None
    # Shape (n_node,); the quantity is `offset` plus amplitude 1 over amplitude 0 times this.
    ratio: Float | None = None
    offset: float = 1.0

    @property
    def bound(self) -> float:
        """Smallest value, for amplitudes of zero."""
        return self.offset if self.ratio is not None else 0.0 if self.factors is not None else -np.inf


@validated
@dataclass(frozen=True, eq=False)
class FlareModel:
    """Mean counts that a flare adds to an exposure.

    Attributes
    ----------
    log_k : ndarray, shape (n_node,)
        Natural logarithms of temperatures, ascending and evenly spaced.
    hot : ndarray, shape (n_node, n_pixel)
        DN of the exposure for a blackbody of amplitude 1.
    fixed : ndarray, shape (n_linear - 1, n_pixel)
        DN of the exposure for the other components: a Balmer continuum of 1 erg s-1 cm-2 A-1 at its edge, and lines of
        1 erg s-1 cm-2.
    linear : tuple of str
        Names of the amplitudes, the blackbody's first.
    derived : tuple of Derived
        Quantities that fits report, the temperature first.
    """

    log_k: Float
    hot: Float
    fixed: Float
    linear: tuple[str, ...]
    derived: tuple[Derived, ...]

    @classmethod
    def of(
        cls,
        star: Source,
        instrument: Instrument,
        quiet: Expectation,
        *,
        jump: bool = False,
        lines: Sequence[str] = (),
        band: str = "Kepler",
        electron_temperature_k: Temperature = ELECTRON_TEMPERATURE_K,
        distance_pc: Distance | None = None,
        radius_rsun: Radius | None = None,
        bands_nm: Sequence[tuple[Wavelength, Wavelength]] = BANDS_NM,
        order: Order = "paper",
    ) -> Self:
        """Build the model of a blackbody at a star, optionally with a Balmer continuum and lines.

        Parameters
        ----------
        star : Source
            The quiescent star at its magnitude.
        instrument : Instrument
        quiet : Expectation
            One exposure of the quiescent star.
        jump : bool
            Whether a Balmer jump is fitted.
        lines : sequence of str
            Lines whose fluxes are fitted; names as in `FlareWithLines`, or vacuum wavelengths in nm.
        band : str
            Band in which the amplitude is the relative rise of the photons.
        electron_temperature_k : float
            Electron temperature of the Balmer continuum.
        distance_pc, radius_rsun : float, optional
            Distance and radius of the star. Areas, luminosities and energies require the distance, the filling factor
            both. Isotropic emission is assumed.
        bands_nm : sequence of tuple
            Wavelength ranges in which the light is reported.
        order : {"paper", "physical"}
            As in `expect`.

        Raises
        ------
        InputError
            For an unknown name, an impossible value, or a spectrum that does not cover the band.
        """
        chosen = [EmissionLine.named(name) for name in lines]
        for low, high in bands_nm:
            if not GRID_NM[0] <= low < high <= GRID_NM[-1]:
                raise InputError.of(
                    "bands_nm", (low, high), f"ascending wavelengths within {GRID_NM[0]:g}-{GRID_NM[-1]:g}"
                )
        kelvin = np.geomspace(*TEMPERATURES_K, NODES)
        edge = BalmerFlare().nodes_nm
        ends = np.ravel(bands_nm)
        grid = np.unique(np.concatenate([GRID_NM, edge, ends, *(line.nodes_nm for line in chosen)]))
        bodies = np.array([blackbody(grid, float(k)) for k in kelvin])
        nm = star.wavelength_nm
        light = photons(nm, star.flux_flam, band)
        if not light > 0.0:
            raise InputError(
                f"the star has no light in the band {band}", "a star with light in the band", key="band", value=band
            )
        # Ratio of the flux at the telescope to that at the flare's surface, for an amplitude of one.
        scale = np.array([light / photons(nm, blackbody(nm, float(k)), band) for k in kelvin])
        extra = ([balmer_continuum(grid, electron_temperature_k)] if jump else []) + [
            one.profile(grid) for one in chosen
        ]
        names = ("amplitude", *(["balmer"] if jump else []), *(f"line {one.name}" for one in chosen))
        matrix = response_matrix(instrument, grid, order)
        dn = quiet.exposure_s * instrument.per_pixel("response", 1.0) * quiet.gain_dn_per_electron
        fluxes = np.vstack([scale[:, None] * bodies, *extra]) if extra else scale[:, None] * bodies
        counts = np.asarray((matrix @ fluxes.T).T) * dn
        # Flux of each component in each range, and over all wavelengths, for an amplitude of one.
        parts = np.array([_between(grid, fluxes, low, high) for low, high in bands_nm]).reshape(-1, len(fluxes))
        balmer = BalmerFlare(10_000.0, 2.0, electron_temperature_k)
        whole = [(balmer.bolometric_flux() - STEFAN_BOLTZMANN * 1e16) / float(balmer.edge_flux)] if jump else []
        every = np.concatenate([scale * STEFAN_BOLTZMANN * kelvin**4, whole, np.ones(len(chosen))])
        derived = _derived(
            kelvin, scale, names, parts, every, list(bands_nm), quiet.exposure_s, distance_pc, radius_rsun
        )
        log_k = np.log(kelvin)
        while np.exp(log_k[-1]) > TEMPERATURES_K[1]:
            # The exponential of the last node is a temperature that is accepted.
            log_k[-1] = np.nextafter(log_k[-1], 0.0)
        return cls(log_k, counts[:NODES], counts[NODES:], names, derived)

    def stacked(self, n: int, light: float = 1.0) -> Self:
        """Return the model of exposures that are n times as long, with a known factor on all light.

        Parameters
        ----------
        n : int
        light : float
            Mean share of the flare's light that reaches the detector.
        """
        derived = tuple(
            replace(one, factors=n * one.factors) if one.name.startswith("energy") and one.factors is not None else one
            for one in self.derived
        )
        return replace(self, hot=n * light * self.hot, fixed=n * light * self.fixed, derived=derived)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reported quantities."""
        return tuple(one.name for one in self.derived)

    @property
    def bounds(self) -> tuple[float, ...]:
        """Smallest possible values of the reported quantities."""
        return tuple(one.bound for one in self.derived)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the reported quantities."""
        return tuple(one.unit for one in self.derived)

    @cached_property
    def hot_spline(self) -> scipy.interpolate.CubicSpline:
        """Counts of the blackbody over log temperature."""
        return scipy.interpolate.CubicSpline(self.log_k, self.hot)

    @cached_property
    def splines(self) -> tuple[scipy.interpolate.CubicSpline | None, ...]:
        """Splines over log temperature from which derived quantities are computed."""
        values = [one.factors if one.ratio is None else one.ratio for one in self.derived]
        return tuple(None if value is None else scipy.interpolate.CubicSpline(self.log_k, value) for value in values)

    @cached_property
    def multiples(self) -> tuple[tuple[int, float], ...]:
        """For each derived quantity, the first one that it is a constant multiple of, maybe itself, and the multiple.

        A luminosity is a multiple of a flux, so that their intervals are computed once.
        """
        found: list[tuple[int, float]] = []
        for k, one in enumerate(self.derived):
            found.append((k, 1.0))
            for first, other in enumerate(self.derived[:k]):
                if one.factors is None or other.factors is None or found[first][0] != first:
                    continue
                times = float(np.sum(one.factors * other.factors) / np.sum(other.factors**2))
                if times > 0.0 and np.allclose(one.factors, times * other.factors, rtol=1e-12, atol=0.0):
                    found[k] = first, times
        return tuple(found)

    @cached_property
    def sums(self) -> tuple[NDArray[np.bool_], scipy.interpolate.CubicSpline]:
        """Which derived quantities are sums of amplitudes, and the spline of their factors, (n_sums, n_linear)."""
        factors = [one.factors for one in self.derived]
        which = np.array([one is not None for one in factors])
        stacked = np.stack([one for one in factors if one is not None], axis=1)
        return which, scipy.interpolate.CubicSpline(self.log_k, stacked)

    def counts(self, temperature_k: Temperature, amplitudes: Sequence[float] | Float) -> Float:
        """Return the mean DN that a flare adds to each pixel of the exposure, shape (n_pixel,)."""
        linear = self._checked(temperature_k, amplitudes)
        return np.asarray(linear[0] * self.hot_spline(np.log(temperature_k)) + linear[1:] @ self.fixed)

    def values(self, temperature_k: Temperature, amplitudes: Sequence[float] | Float) -> dict[str, float]:
        """Return the reported quantities of a flare, by name."""
        linear = self._checked(temperature_k, amplitudes)
        values = derived_values(self, np.array([np.log(temperature_k)]), linear[None])[0]
        return dict(zip(self.names, values.tolist(), strict=True))

    def amplitudes(
        self, temperature_k: Temperature, amplitude: float, *, jump: float = 1.0, lines: Sequence[float] = ()
    ) -> Float:
        """Return the model's amplitudes, shape (n_linear,), for a Balmer jump ratio and line fluxes, erg s-1 cm-2."""
        ratio = next(
            (spline for spline, one in zip(self.splines, self.derived, strict=True) if one.ratio is not None), None
        )
        if ratio is None and jump != 1.0:
            raise InputError(f"jump = {jump:g} of a model without a Balmer continuum", "1", key="jump", value=jump)
        own = [] if ratio is None else [(jump - 1.0) * amplitude / float(ratio(np.log(temperature_k)))]
        given = np.array([amplitude, *own, *lines], np.float64)
        return self._checked(temperature_k, given)

    def _checked(self, temperature_k: float, amplitudes: Sequence[float] | Float) -> Float:
        low, high = np.exp(self.log_k[[0, -1]])
        if not low * (1 - 1e-9) <= temperature_k <= high * (1 + 1e-9):
            raise InputError.of("temperature_k", temperature_k, f"{low:g} to {high:g}")
        linear = np.asarray(amplitudes, np.float64)
        if linear.shape != (len(self.linear),) or not np.isfinite(linear).all():
            raise InputError(
                f"amplitudes of the shape {linear.shape}",
                f"finite ones of {', '.join(self.linear)}",
                key="amplitudes",
                value=linear.shape,
            )
        return linear


def derived_values(model: FlareModel, log_k: Float, linear: Float) -> Float:
    """Return the reported quantities, shape (n, n_derived), of temperatures (n,) and amplitudes (n, n_linear)."""
    values = np.empty((log_k.size, len(model.derived)))
    which, spline = model.sums
    values[:, which] = np.einsum("nql,nl->nq", spline(log_k), linear)
    for q in np.flatnonzero(~which):
        one, ratio = model.derived[q], model.splines[q]
        values[:, q] = np.exp(log_k)
        if ratio is not None:
            positive = linear[:, 0] > 0.0
            over = np.divide(linear[:, 1], linear[:, 0], out=np.full(log_k.size, np.nan), where=positive)
            values[:, q] = one.offset + ratio(log_k) * over
    return values


def _between(grid: Float, fluxes: Float, low: float, high: float) -> Float:
    inside = (grid >= low) & (grid <= high)
    return np.asarray(10.0 * np.trapezoid(fluxes[:, inside], grid[inside], axis=1))


def _derived(
    kelvin: Float,
    scale: Float,
    names: tuple[str, ...],
    parts: Float,
    every: Float,
    bands_nm: list[tuple[float, float]],
    exposure_s: float,
    distance_pc: float | None,
    radius_rsun: float | None,
) -> tuple[Derived, ...]:
    """Return the quantities of a model; `parts` and `every` hold fluxes per amplitude, those of blackbodies first."""
    n, m = kelvin.size, len(names)

    def summed(fluxes: Float) -> Float:
        return np.column_stack([fluxes[:n], np.tile(fluxes[n:], (n, 1))])

    def single(column: int, values: Float | float) -> Float:
        factors = np.zeros((n, m))
        factors[:, column] = values
        return factors

    derived = [Derived("temperature", "K", "temperature of the flare's blackbody")]
    derived.append(Derived("amplitude", "", "relative rise of the band's photons by the blackbody", single(0, 1.0)))
    if "balmer" in names:
        edge = np.array([float(blackbody(np.array([BALMER_EDGE_NM]), float(k))[0]) for k in kelvin])
        derived.append(
            Derived("jump", "", "flux just below the Balmer edge over that just above", ratio=1.0 / (scale * edge))
        )
    for column, name in enumerate(names):
        if name.startswith("line "):
            what = f"flux of the line {name[5:]} at the telescope"
            derived.append(Derived(name, "erg / (cm2 s)", what, single(column, 1.0)))
    light = [(f"{low:g}-{high:g} nm", flux) for (low, high), flux in zip(bands_nm, parts, strict=True)]
    light.append(("bolometric", every))
    for where, flux in light:
        derived.append(Derived(f"flux {where}", "erg / (cm2 s)", f"flux at the telescope, {where}", summed(flux)))
    if distance_pc is not None:
        far = distance_pc * PARSEC_CM
        area = single(0, np.pi * far**2 * scale)
        derived.append(Derived("area", "cm2", "projected area of the blackbody", area))
        if radius_rsun is not None:
            share = area / (np.pi * (radius_rsun * SUN_CM) ** 2)
            derived.append(Derived("filling factor", "", "share of the star's disc that the blackbody covers", share))
        for where, flux in light:
            total = summed(flux) * 4 * np.pi * far**2
            derived.append(Derived(f"luminosity {where}", "erg / s", f"luminosity, {where}", total))
            energy = total * exposure_s
            derived.append(Derived(f"energy {where}", "erg", f"energy within the exposure, {where}", energy))
    return tuple(derived)
