"""Model of the light that a flare adds to a frame, and the weighted sums that are sufficient for its fits.

A model is a blackbody, whose spectrum depends on one temperature, and components of fixed shape next to it: a Balmer
continuum, and emission lines. Everything but the temperature is linear, so that a fit searches in one dimension.

An unknown factor on all light of an exposure dims a flare as it dims the star. A fit of weighted sums finds the flare
as it is recorded. Quantities of the flare itself are those of the recorded one over the factor, so that their profile
intervals at a given temperature are those of a ratio of two normal estimates (Fieller 1954, doi
10.1111/j.2517-6161.1954.tb00159.x).

Fits need a few weighted sums of a frame only. The whitened spectra of flares of all temperatures span about seven
directions to one part in 10^9. A fit needs only the sums along these directions, and chi-squared of the residual. The
weights marginalise over unknown amplitudes of known spectra (generalised least squares).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.detection.nuisances import Nuisances, join_names
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.response import Order, response_matrix
from mauvecl.host.stars.flare import (
    BALMER_EDGE_NM,
    ELECTRON_TEMPERATURE_K,
    PARSEC_CM,
    STEFAN_BOLTZMANN,
    SUN_CM,
    BalmerFlare,
    EmissionLine,
    balmer_continuum,
    blackbody,
)
from mauvecl.host.stars.spectrum import photons
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Distance, Radius, Temperature, Unit, Wavelength, range_of

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source


#: Raw counts of exposures, or of the frames of a stare.
RawCounts = Annotated[ArrayLike, Unit("DN")]
#: Range of fitted temperatures, K: that of flares, without cool ones that emit no ultraviolet light.
TEMPERATURES_K = (3_000.0, float(range_of(Temperature).high))
#: Number of temperatures at which spectra are computed, evenly spaced in log T; splines interpolate between them.
NODES = 225
#: Grid of the spectra, nm: it exceeds the instrument's range by the line spread, with steps far below the resolution.
GRID_NM = np.linspace(170.0, 760.0, 2361)
#: Smallest number of nodes between two temperatures of a flare; closer ones cannot be distinguished.
APART = 4
#: Bands in which light is reported by default, nm.
BANDS_NM = ((200.0, 320.0), (200.0, 700.0))


@dataclass(frozen=True, eq=False)
class DerivedQuantity:
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
    # Value of a quantity that the model holds.
    held: float | None = None

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
    derived : tuple of DerivedQuantity
        Quantities that fits report, the temperature first.
    """

    log_k: Float
    hot: Float
    fixed: Float
    linear: tuple[str, ...]
    derived: tuple[DerivedQuantity, ...]

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
                expected = f"ascending wavelengths within {GRID_NM[0]:g}-{GRID_NM[-1]:g}"
                raise InputError.of("bands_nm", (low, high), expected)
        kelvin = np.geomspace(*TEMPERATURES_K, NODES)
        nodes = [BalmerFlare().nodes_nm, np.ravel(bands_nm), *(line.nodes_nm for line in chosen)]
        grid = np.unique(np.concatenate([GRID_NM, *nodes]))
        bodies = np.array([blackbody(grid, float(k)) for k in kelvin])
        scale = _flux_ratios(star, band, kelvin)
        balmer = [balmer_continuum(grid, electron_temperature_k)] if jump else []
        names = ("amplitude", *(["balmer"] if jump else []), *(f"line {line.name}" for line in chosen))
        fluxes = np.vstack([scale[:, None] * bodies, *balmer, *(line.profile(grid) for line in chosen)])
        dn = quiet.exposure_s * instrument.per_pixel("response", 1.0) * quiet.gain_dn_per_electron
        counts = np.asarray((response_matrix(instrument, grid, order) @ fluxes.T).T) * dn
        # Flux of each component in each range, and over all wavelengths, for an amplitude of one.
        light = [(f"{low:g}-{high:g} nm", _light_between(grid, fluxes, low, high)) for low, high in bands_nm]
        edge = BalmerFlare(10_000.0, 2.0, electron_temperature_k)
        continuum = [(edge.bolometric_flux() - STEFAN_BOLTZMANN * 1e16) / float(edge.edge_flux)] if jump else []
        bodies_flux = scale * STEFAN_BOLTZMANN * kelvin**4
        light.append(("bolometric", np.concatenate([bodies_flux, continuum, np.ones(len(chosen))])))
        derived = _derived(kelvin, scale, names, light, quiet.exposure_s, distance_pc, radius_rsun)
        log_k = np.log(kelvin)
        # The exponential of the last one must be a temperature that is accepted.
        while np.exp(log_k[-1]) > TEMPERATURES_K[1]:
            log_k[-1] = np.nextafter(log_k[-1], 0.0)
        return cls(log_k, counts[:NODES], counts[NODES:], names, tuple(derived))

    def stacked(self, n: int, light: float = 1.0) -> Self:
        """Return the model of exposures that are n times as long, of which a share `light` of all light arrives."""
        derived = tuple(
            replace(quantity, factors=n * quantity.factors)
            if quantity.unit == "erg" and quantity.factors is not None
            else quantity
            for quantity in self.derived
        )
        return replace(self, hot=n * light * self.hot, fixed=n * light * self.fixed, derived=derived)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reported quantities."""
        return tuple(derived.name for derived in self.derived)

    @property
    def bounds(self) -> tuple[float, ...]:
        """Smallest possible values of the reported quantities."""
        return tuple(derived.bound for derived in self.derived)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the reported quantities."""
        return tuple(derived.unit for derived in self.derived)

    @cached_property
    def hot_spline(self) -> scipy.interpolate.CubicSpline:
        """Counts of the blackbody over log temperature."""
        return scipy.interpolate.CubicSpline(self.log_k, self.hot)

    @cached_property
    def splines(self) -> tuple[scipy.interpolate.CubicSpline | None, ...]:
        """Splines over log temperature from which derived quantities are computed."""
        values = [derived.factors if derived.ratio is None else derived.ratio for derived in self.derived]
        return tuple(None if value is None else scipy.interpolate.CubicSpline(self.log_k, value) for value in values)

    @cached_property
    def amplitude_sums(self) -> tuple[NDArray[np.bool_], scipy.interpolate.CubicSpline]:
        """Which derived quantities are sums of amplitudes, and the spline of their factors, (n_sums, n_linear)."""
        factors = [derived.factors for derived in self.derived]
        is_sum = np.array([factor is not None for factor in factors])
        stacked = np.stack([factor for factor in factors if factor is not None], axis=1)
        return is_sum, scipy.interpolate.CubicSpline(self.log_k, stacked)

    def counts(self, temperature_k: Temperature, amplitudes: Sequence[float] | Float) -> Float:
        """Return the mean DN that a flare adds to each pixel of the exposure, shape (n_pixel,)."""
        linear = self._checked(temperature_k, amplitudes)
        return np.asarray(linear[0] * self.hot_spline(np.log(temperature_k)) + linear[1:] @ self.fixed)

    def values(self, temperature_k: Temperature, amplitudes: Sequence[float] | Float) -> dict[str, float]:
        """Return the reported quantities of a flare, by name."""
        linear = self._checked(temperature_k, amplitudes)
        values = derived_values(self, np.array([np.log(temperature_k)]), linear[None], np.ones(1))[0]
        return dict(zip(self.names, values.tolist(), strict=True))

    def amplitudes(
        self, temperature_k: Temperature, amplitude: float, *, jump: float = 1.0, lines: Sequence[float] = ()
    ) -> Float:
        """Return the model's amplitudes, shape (n_linear,), for a Balmer jump ratio and line fluxes, erg s-1 cm-2."""
        pairs = zip(self.splines, self.derived, strict=True)
        ratios = [spline for spline, derived in pairs if spline is not None and derived.ratio is not None]
        if not ratios and jump != 1.0:
            raise InputError.of("jump", jump, "1 for a model without a Balmer continuum")
        balmer = [(jump - 1.0) * amplitude / float(ratio(np.log(temperature_k))) for ratio in ratios]
        return self._checked(temperature_k, [amplitude, *balmer, *lines])

    def _checked(self, temperature_k: float, amplitudes: Sequence[float] | Float) -> Float:
        """Return amplitudes as an array; raises InputError for those, or a temperature, that the model cannot have."""
        low, high = np.exp(self.log_k[[0, -1]])
        if not low * (1 - 1e-9) <= temperature_k <= high * (1 + 1e-9):
            raise InputError.of("temperature_k", temperature_k, f"between {low:g} and {high:g}")
        linear = np.asarray(amplitudes, np.float64)
        if linear.shape != (len(self.linear),) or not np.isfinite(linear).all():
            raise InputError.of("amplitudes", amplitudes, f"finite numbers, one for each of {', '.join(self.linear)}")
        return linear


def nodes_below(nodes: Float, log_k: float) -> int:
    """Return the number of a model's nodes that are at least `APART` of them below a temperature."""
    return int(np.searchsorted(nodes, log_k - APART * (nodes[1] - nodes[0]) + 1e-9))


def derived_values(model: FlareModel, log_k: Float, linear: Float, factor: Float) -> Float:
    """Return the reported quantities of flares, shape (n, n_derived).

    Temperatures have the shape (n,), amplitudes of the recorded light (n, n_linear), and factors by which it was
    dimmed (n,).
    """
    values = np.empty((log_k.size, len(model.derived)))
    is_sum, spline = model.amplitude_sums
    values[:, is_sum] = undimmed(np.einsum("nql,nl->nq", spline(log_k), linear), factor)
    for q in np.flatnonzero(~is_sum):
        derived, ratio = model.derived[q], model.splines[q]
        values[:, q] = np.exp(log_k) if derived.held is None else derived.held
        if ratio is not None:
            positive = linear[:, 0] > 0.0
            over = np.divide(linear[:, 1], linear[:, 0], out=np.full(log_k.size, np.nan), where=positive)
            values[:, q] = derived.offset + ratio(log_k) * over
    return values


def _flux_ratios(star: Source, band: str, kelvin: Float) -> Float:
    """Return flux at the telescope over that at the surface of flares with an amplitude of one, shape of `kelvin`."""
    nm = star.wavelength_nm
    light = photons(nm, star.flux_flam, band)
    if not light > 0.0:
        raise InputError(f"the star must have light in the band {band}, but has none", key="band")
    return np.array([light / photons(nm, blackbody(nm, float(k)), band) for k in kelvin])


def _light_between(grid: Float, fluxes: Float, low: float, high: float) -> Float:
    """Return the integrals of fluxes on a grid in nm over a range of wavelength, erg s-1 cm-2, shape (n_flux,)."""
    inside = (grid >= low) & (grid <= high)
    return np.asarray(10.0 * np.trapezoid(fluxes[:, inside], grid[inside], axis=1))


def _derived(
    kelvin: Float, scale: Float, names: tuple[str, ...], light: list[tuple[str, Float]], exposure_s: float,
    distance_pc: float | None, radius_rsun: float | None,
) -> Iterator[DerivedQuantity]:  # fmt: skip
    """Yield the quantities of a model; `light` holds fluxes per amplitude by range, those of blackbodies first."""

    def single(column: int, values: Float | float) -> Float:
        """Return the factors of a quantity that a single amplitude changes, shape (n_node, n_linear)."""
        factors = np.zeros((NODES, len(names)))
        factors[:, column] = values
        return factors

    yield DerivedQuantity("temperature", "K", "temperature of the flare's blackbody")
    yield DerivedQuantity("amplitude", "", "relative rise of the band's photons by the blackbody", single(0, 1.0))
    if "balmer" in names:
        edge = np.array([float(blackbody(np.array([BALMER_EDGE_NM]), float(k))[0]) for k in kelvin])
        yield DerivedQuantity(
            "jump", "", "flux just below the Balmer edge over that just above", ratio=1.0 / (scale * edge)
        )
    for column, name in enumerate(names):
        if name.startswith("line "):
            text = f"flux of the line {name[5:]} at the telescope"
            yield DerivedQuantity(name, "erg / (cm2 s)", text, single(column, 1.0))
    fluxes = [(band, np.column_stack([flux[:NODES], np.tile(flux[NODES:], (NODES, 1))])) for band, flux in light]
    for band, flux in fluxes:
        yield DerivedQuantity(f"flux {band}", "erg / (cm2 s)", f"flux at the telescope, {band}", flux)
    if distance_pc is None:
        return
    distance_cm = distance_pc * PARSEC_CM
    area = single(0, np.pi * distance_cm**2 * scale)
    yield DerivedQuantity("area", "cm2", "projected area of the blackbody", area)
    if radius_rsun is not None:
        share = area / (np.pi * (radius_rsun * SUN_CM) ** 2)
        yield DerivedQuantity("filling factor", "", "share of the star's disc that the blackbody covers", share)
    for band, flux in fluxes:
        total = flux * 4 * np.pi * distance_cm**2
        yield DerivedQuantity(f"luminosity {band}", "erg / s", f"luminosity, {band}", total)
        yield DerivedQuantity(f"energy {band}", "erg", f"energy within the exposure, {band}", total * exposure_s)


#: Shares of a prior in the variance of a ratio at which thresholds are computed, and their largest root.
SHARES, LARGEST = np.linspace(0.0, 1.0, 65), 10.0


@lru_cache(maxsize=16)
def _thresholds(prior: bytes, allowed: float) -> Float:
    """Return squared thresholds that deviations exceed as often as normal ones exceed `allowed`, shape of `SHARES`."""
    deviation, weight = np.frombuffer(prior).reshape(2, -1)
    level = 2.0 * scipy.special.ndtr(np.sqrt(allowed)) - 1.0

    def beyond(root: float, share: float) -> float:
        # A small normal part keeps the distribution continuous.
        normal, moved = np.sqrt(max(1.0 - share, 1e-4)), np.sqrt(share) * deviation
        inside = scipy.special.ndtr((root - moved) / normal) - scipy.special.ndtr((-root - moved) / normal)
        return float(inside @ weight) - level

    return np.array([
        scipy.optimize.brentq(beyond, 0.0, LARGEST, args=(share,)) if beyond(LARGEST, share) > 0.0 else LARGEST
        for share in SHARES
    ]) ** 2  # fmt: skip


def undimmed(values: Float, factor: Float) -> Float:
    """Return light (n, k) over the factor by which it was dimmed, (n,); infinite where the factor is not above zero."""
    lost = (factor <= 0.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        bright = np.where(lost, np.copysign(np.inf, values), values / factor[:, None])
    return np.asarray(np.where(values == 0.0, 0.0, bright))


@dataclass(frozen=True, eq=False)
class Ratio:
    """Ratio of two normal estimates, such as a recorded flux and the factor on the light; arrays of one shape."""

    top: Float
    bottom: Float
    # Variances of both, and their covariance.
    top_variance: Float
    bottom_variance: Float
    covariance: Float

    @property
    def value(self) -> Float:
        """Ratio of the estimates; that of a bottom of at most zero is undefined."""
        return np.divide(self.top, self.bottom, out=np.full_like(self.top, np.nan), where=self.bottom > 0.0)

    def rows(self, rows: NDArray[np.intp]) -> Self:
        """Return some rows."""
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})

    def variance_at(self, ratio: Float) -> Float:
        """Return the variance of top - ratio x bottom."""
        return self.top_variance - 2.0 * ratio * self.covariance + ratio**2 * self.bottom_variance

    def root(self, rise: Float, sign: float) -> Float:
        """Return one of the two ratios at which chi-squared has risen by `rise`: the end if the bottom is not zero."""
        a = self.bottom**2 - rise * self.bottom_variance
        b = self.top * self.bottom - rise * self.covariance
        # The root of b^2 - a c, without its cancellation.
        spread = self.bottom**2 * self.top_variance - 2.0 * self.top * self.bottom * self.covariance
        spread = spread + self.top**2 * self.bottom_variance
        determinant = self.top_variance * self.bottom_variance - self.covariance**2
        root = np.sqrt(np.maximum(rise * (spread - rise * determinant), 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((b + sign * root) / a)

    def end(self, rise: Float, sign: float) -> Float:
        """Return the end of the set of ratios that raise chi-squared by at most `rise`, with a positive bottom.

        The end is infinite if the bottom may be zero, and of the other sign, no end, if it cannot be positive.
        """
        rise = np.maximum(rise, 0.0)
        if self.bottom.all() and not self.bottom_variance.any():
            return np.asarray((self.top + sign * np.sqrt(rise * self.top_variance)) / self.bottom)
        end, may_be_zero = self.root(rise, sign), self.bottom**2 <= rise * self.bottom_variance
        # Where the bottom may be zero, the ratio ends only on the side of zero, if the top is not zero.
        closed = ~may_be_zero | ((self.top**2 > rise * self.top_variance) & (sign * self.top < 0.0))
        return np.where(may_be_zero | (self.bottom > 0.0), np.where(closed, end, sign * np.inf), -sign * np.inf)


#: Ranges of wavelength, nm.
Ranges = Sequence[tuple[float, float]]

#: The spectra of every `NODE_STRIDE`-th node of the model span the directions.
NODE_STRIDE = 4
#: Directions with eigenvalues below this share of the largest are due to rounding.
LEAST_EIGENVALUE = 1e-11
#: Pixels within this many standard deviations of saturation in a frame are not used.
NEAR_SIGMA = 5.0
#: Smallest share of S/N^2 that must remain after marginalisation over the unknowns.
LEAST_REMAINING = 1e-10


@dataclass(frozen=True, eq=False)
class MeanSums:
    """Response of weighted sums with unit covariance to the flares of a model."""

    hot: Float  # shape (n_node, n_sum); mean sums for a blackbody of amplitude 1, at each of the model's temperatures
    fixed: Float  # shape (n_linear - 1, n_sum); mean sums of the other components for unit amplitude
    log_k: Float  # shape (n_node,); evenly spaced, to a few percent of a step
    light: LightFactor | None = field(default=None, kw_only=True)  # factor on all light, if it is unknown

    @cached_property
    def basis(self) -> tuple[Float, Float]:
        """Orthonormal directions of the fixed components, (n_linear - 1, n_sum), and their inverted triangle."""
        if not len(self.fixed):
            return np.zeros((0, self.hot.shape[1])), np.zeros((0, 0))
        q, r = np.linalg.qr(self.fixed.T)
        return q.T, np.linalg.inv(r)

    def without_fixed(self, sums: Float) -> Float:
        """Return sums, (n, n_sum), less what the fixed components explain."""
        basis, _ = self.basis
        return np.asarray(sums - (sums @ basis.T) @ basis)

    @cached_property
    def directions(self) -> tuple[Float, Float]:
        """Unit vectors of blackbodies less their projections on the fixed components, and their cubics over log_k.

        Shapes (n_node, n_sum) and, of the spline's coefficients, (n_node - 1, 4, n_sum).
        """
        bodies = self.without_fixed(self.hot)
        units = bodies / np.linalg.norm(bodies, axis=1)[:, None]
        return units, np.moveaxis(scipy.interpolate.CubicSpline(self.log_k, units).c, 0, 1).copy()

    @cached_property
    def spline(self) -> scipy.interpolate.CubicSpline:
        """Sums of the blackbody over log temperature."""
        return scipy.interpolate.CubicSpline(self.log_k, self.hot)

    def with_second(self, log_k: float) -> Self:
        """Return the response to lower temperatures, with a blackbody of a second one as another component."""
        light = None if self.light is None else self.light.with_second(log_k)
        fixed, end = np.vstack([self.spline(log_k), self.fixed]), nodes_below(self.log_k, log_k)
        return replace(self, hot=self.hot[:end], fixed=fixed, log_k=self.log_k[:end], light=light)


@dataclass(frozen=True, eq=False)
class LightFactor(MeanSums):
    """Weighted sum of an exposure that estimates the factor on its light, and its means for the flares of a model."""

    weights: Float  # per DN, shape (n_pixel,); the sum has unit variance if the flare is known
    scale: float  # change of the sum for a change of the factor by one
    expected: float  # factor for which the mean of the sum is zero without a flare
    prior_share: float  # share of the prior in the information on the factor if the flare is known
    # Deviations of the prior in standard deviations, and their probabilities, shape (2, n); empty if it is normal.
    prior: Float

    def change(self, value: Float, factor: Float, width: Float, allowed: float) -> Float:
        """Return how far the thresholds of quantities are from `allowed`, since the prior is not normal, shape (n,).

        The part of a quantity's scatter that comes from the prior has the distribution of the prior. `width` is that of
        the quantity's interval for a rise of chi-squared by `allowed`.
        """
        share = np.zeros_like(value)
        usable = np.isfinite(value) & np.isfinite(width) & (width > 0.0) & (factor > 0.0)
        by_prior = value[usable] * np.sqrt(self.prior_share) / (self.scale * factor[usable])
        share[usable] = np.clip(4.0 * allowed * (by_prior / width[usable]) ** 2, 0.0, 1.0)
        return np.asarray(np.interp(share, SHARES, _thresholds(self.prior.tobytes(), allowed)) - allowed)

    def weights_of(self, log_k: Float) -> Float:
        """Return the decrease of the best factor per unit of each amplitude, shape (..., n_linear)."""
        fixed = np.broadcast_to(self.fixed[:, 0], (*log_k.shape, len(self.fixed)))
        return np.asarray(np.concatenate([self.spline(log_k), fixed], -1) / self.scale)


@dataclass(frozen=True, eq=False)
class ReducedSums(MeanSums):
    """Weights of sums, and the mean sums of a model's flares."""

    variance: Float  # of the exposure, zero in pixels that are not used, shape (n_pixel,)
    weights: Float  # per DN, for which the sums have unit covariance, shape (n_sum, n_pixel)
    rows: Float  # weights of the sums whose squares marginalisation subtracts from chi-squared, shape (k, n_pixel)
    n_free: int  # number of unknowns that are projected out

    @classmethod
    def of(
        cls,
        model: FlareModel,
        quiet: Expectation,
        added_dn: Float | None = None,
        nuisances: Nuisances | None = None,
        skipped_nm: Ranges = (),
        *,
        highest_dn: Float | None = None,
        clipped: NDArray[np.bool_] | None = None,
    ) -> Self:
        """Compute the reduction for exposures with the variance of a flare, whose recorded mean is `added_dn`.

        The largest mean of the exposures' flares, `highest_dn`, decides on saturation; pixels at `skipped_nm` and
        `clipped` ones are not used either. Raises InputError if too few pixels can be used, or the flare is degenerate
        with the unknowns.
        """
        added = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
        variance, used = usable_variance(quiet, added, skipped_nm, nuisances, highest_dn)
        if clipped is not None:
            used = used & ~clipped
            variance = np.where(used, variance, 0.0)
        free = nuisances.free if nuisances else 0
        check_enough(quiet, used, len(model.linear) + 1 + free)
        unknown = nuisances.around(added) if nuisances else None
        rows = unknown.rows(variance, unknown.spectra * used) if unknown else np.zeros((0, variance.size))
        spanning = np.vstack([model.hot[::NODE_STRIDE], model.fixed]) * used
        inverse = np.divide(1.0, variance, out=np.zeros_like(variance), where=used)
        weights, _ = spanning_weights(spanning, spanning * inverse, nuisances, rows, LEAST_EIGENVALUE)
        hot, fixed = model.hot @ weights.T, model.fixed @ weights.T
        light = None
        if unknown is not None and unknown.has_factor:
            # The last row of the Cholesky factor's inverse depends on the factor alone, given the other unknowns.
            row, precision = rows[-1], float(unknown.sd[-1]) ** -2.0
            change = float(row @ unknown.spectra[-1])
            scale = (change + np.sqrt(change**2 + 4.0 * precision)) / 2.0
            means = (model.hot @ row)[:, None], (model.fixed @ row)[:, None], model.log_k
            expected, share = 1.0 + float(unknown.mean[-1]), precision / scale**2
            light = LightFactor(*means, row, scale, expected, share, unknown.factor_prior)
        return cls(hot, fixed, model.log_k, variance, weights, rows, free, light=light)


def spanning_weights(
    spectra: Float, plain: Float, nuisances: Nuisances | None, rows: Float | None, least: float
) -> tuple[Float, Float]:
    """Return weights of sums with unit covariance that span the optimal filters of spectra, and the S/N of each.

    The sums, of shape (n_sum, n_pixel), have ascending eigenvalues above `least` of the largest. Spectra are zero in
    pixels that are not used, `plain` are the same over the variances, and `rows` are those of `Nuisances.rows`. Raises
    InputError if the light of a flare cannot be distinguished from the nuisances.
    """
    optimal = plain if rows is None else plain - (spectra @ rows.T) @ rows
    gram = optimal @ spectra.T
    power, power_if_known = np.diag(gram), np.einsum("tp,tp->t", plain, spectra)
    if not (power_if_known > 0.0).all():
        raise InputError(
            "each component of a flare must have light in pixels that neither saturate nor are left out", key="model"
        )
    if not (power > LEAST_REMAINING * power_if_known).all():
        unknown = join_names(nuisances.names) if nuisances else "nothing"
        raise InputError(
            f"the light of a flare cannot be distinguished from {unknown}; give fewer unknowns", key="nuisances"
        )
    length = np.sqrt(power)
    values, vectors = np.linalg.eigh(gram / np.outer(length, length))
    large = values > least * values[-1]
    return (vectors[:, large] / length[:, None] / np.sqrt(values[large])).T @ optimal, length


def variance_of(
    quiet: Expectation, added_dn: Float | None = None, highest_dn: Float | None = None
) -> tuple[Float, NDArray[np.bool_]]:
    """Return the variance of an exposure with a flare and which pixels are used, shape (n_pixel,) each.

    The variance, DN^2, is zero in saturated pixels.
    Pixels saturate with the light `highest_dn` of a flare, by default the mean `added_dn`.
    """
    added = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
    highest = added if highest_dn is None else highest_dn
    light, most = (np.maximum(quiet.light_dn + flare, 0.0) for flare in (added, highest))
    constant = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn
    variance, scatter = (constant + quiet.gain_dn_per_electron * photons_dn for photons_dn in (light, most))
    # Frames of a pixel near saturation are occasionally clipped, so that the pixel is not reliable.
    raw = most / quiet.n_frames + quiet.dark_dn + quiet.bias_dn
    used = raw + NEAR_SIGMA * np.sqrt(scatter / quiet.n_frames) < quiet.ceiling_dn
    return np.where(used, variance, 0.0), used


def usable_variance(
    quiet: Expectation, added_dn: Float | None = None, skipped_nm: Ranges = (), nuisances: Nuisances | None = None,
    highest_dn: Float | None = None,
) -> tuple[Float, NDArray[np.bool_]]:  # fmt: skip
    """Return `variance_of` at the unknowns' means, without the pixels at `skipped_nm`.

    Raises InputError if no pixel is left.
    """
    if nuisances and nuisances.mean_dn.any():
        added_dn = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
        # A frame may have more light than the mean exposure, up to what the expectation has.
        highest_dn = added_dn if highest_dn is None else highest_dn
        added_dn = added_dn + nuisances.mean_dn
    variance, used = variance_of(quiet, added_dn, highest_dn)
    for low, high in skipped_nm:
        used = used & ~((quiet.wavelength_nm >= low) & (quiet.wavelength_nm <= high))
    check_enough(quiet, used, 0)
    return np.where(used, variance, 0.0), used


def check_enough(quiet: Expectation, used: NDArray[np.bool_], parameters: int) -> None:
    """Raise InputError unless more pixels are used than parameters are fitted."""
    count = int(used.sum())
    if not count:
        raise InputError(f"every pixel of {quiet.name} saturates or is left out, but some must count", key="skipped_nm")
    if count <= parameters:
        raise InputError(
            f"the {parameters} parameters of the fit need more pixels of {quiet.name} than the {count} of {used.size} "
            "that neither saturate nor are left out",
            key="skipped_nm",
        )
