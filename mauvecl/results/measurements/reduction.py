"""Reduction of frames to a few weighted sums that are sufficient for fits of flares.

The whitened spectra of flares of all temperatures span about seven directions to one part in 10^9. A fit needs only the
sums along these directions, and chi-squared of the residual. The weights marginalise over unknown amplitudes of known
spectra (generalised least squares).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.results.measurements.light_factor import LightFactor
from mauvecl.schema.errors import InputError
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.nuisances import Nuisances, join_names

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.results.measurements.flare_model import FlareModel

Float = NDArray[np.float64]
Ranges = Sequence[tuple[float, float]]

#: The spectra of every `EVERY`-th node of the model span the directions.
EVERY = 4
#: Directions with eigenvalues below this share of the largest are due to rounding.
LEAST = 1e-11
#: Pixels within this many standard deviations of saturation in a frame are not used.
NEAR_SIGMA = 5.0
#: Number of frames per block, small enough for a processor's cache.
FRAMES_AT_ONCE = 64
#: Smallest share of S/N^2 that must remain after marginalisation over the unknowns.
LEAST_KEPT = 1e-10


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

    @cached_property
    def directions(self) -> tuple[Float, Float]:
        """Unit vectors of blackbodies less their projections on the fixed components, and their cubics over log_k.

        Shapes (n_node, n_sum) and, of the spline's coefficients, (n_node - 1, 4, n_sum).
        """
        basis, _ = self.basis
        free = self.hot - (self.hot @ basis.T) @ basis
        units = free / np.linalg.norm(free, axis=1)[:, None]
        return units, np.moveaxis(scipy.interpolate.CubicSpline(self.log_k, units).c, 0, 1).copy()

    @cached_property
    def spline(self) -> scipy.interpolate.CubicSpline:
        """Sums of the blackbody over log temperature."""
        return scipy.interpolate.CubicSpline(self.log_k, self.hot)


@dataclass(frozen=True, eq=False)
class Reduction(MeanSums):
    """Weights of sums, and the mean sums of a model's flares.

    Attributes
    ----------
    variance : ndarray, shape (n_pixel,)
        Variance of the exposure, zero in pixels that are not used.
    weights : ndarray, shape (n_sum, n_pixel)
        Weights per DN, for which the sums have unit covariance.
    rows : ndarray, shape (k, n_pixel)
        Weights of the sums whose squares marginalisation subtracts from chi-squared.
    n_free : int
        Number of unknowns that are projected out.
    """

    variance: Float
    weights: Float
    rows: Float
    n_free: int

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
        """Compute the reduction for exposures with the variance of a given flare.

        Raises InputError if too few pixels can be used, or the flare is degenerate with the unknowns.

        Parameters
        ----------
        added_dn : ndarray, shape (n_pixel,), optional
            Mean DN of the flare as it is recorded; none by default.
        skipped_nm : sequence of tuple
            Wavelength ranges of pixels that are not used, in addition to saturated ones.
        highest_dn : ndarray, shape (n_pixel,), optional
            Largest mean DN of the flares of the exposures, which decides on saturation; `added_dn` by default.
        clipped : ndarray of bool, shape (n_pixel,), optional
            Other pixels that are not used.
        """
        added = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
        variance, used = usable_variance(quiet, added, skipped_nm, nuisances, highest_dn)
        if clipped is not None:
            used = used & ~clipped
            variance = np.where(used, variance, 0.0)
        free = nuisances.free if nuisances else 0
        check_enough(quiet, used, len(model.linear) + 1 + free)
        inverse = np.divide(1.0, variance, out=np.zeros_like(variance), where=used)
        unknown = nuisances.around(added) if nuisances else None
        rows = unknown.rows(variance, unknown.spectra * used) if unknown else np.zeros((0, variance.size))
        spanning = np.vstack([model.hot[::EVERY], model.fixed]) * used
        plain = spanning * inverse
        optimal = plain - (spanning @ rows.T) @ rows
        gram = optimal @ spanning.T
        power = np.diag(gram)
        check_distinct(power, np.einsum("tp,tp->t", plain, spanning), nuisances)
        length = np.sqrt(power)
        values, vectors = np.linalg.eigh(gram / np.outer(length, length))
        kept = values > LEAST * values[-1]
        weights = (vectors[:, kept] / length[:, None] / np.sqrt(values[kept])).T @ optimal
        hot, fixed = model.hot @ weights.T, model.fixed @ weights.T
        light = light_factor(model, unknown, rows)
        return cls(hot, fixed, model.log_k, variance, weights, rows, free, light=light)

    def rest(self, excess_dn: Float, sums: Float) -> Float:
        """Return chi-squared of the residuals of frames less the quiescent mean, shape (n,)."""
        used = self.variance > 0.0
        inverse = np.divide(1.0, self.variance, out=np.zeros_like(self.variance), where=used)
        unknown = excess_dn @ self.rows.T
        explained = np.einsum("nk,nk->n", unknown, unknown) + np.einsum("nk,nk->n", sums, sums)
        return np.asarray(excess_dn**2 @ inverse - explained)

    @property
    def statistics(self) -> tuple[Linear, ...]:
        """User-defined statistics equal to the sums, which a device draws by pixel; see `drawn_sums`."""
        return tuple(Linear(f"sum {k}", weights) for k, weights in enumerate(self.weights))

    @property
    def n_used(self) -> int:
        """Number of used pixels."""
        return int((self.variance > 0.0).sum())


def light_factor(model: FlareModel, unknown: Nuisances | None, rows: Float) -> LightFactor | None:
    """Return the factor on all light if it is among the unknowns, from `Nuisances.around` and its `rows`."""
    if unknown is None or not unknown.has_factor:
        return None
    # The last row of the Cholesky factor's inverse depends on the factor alone, given the other unknowns.
    row, precision = rows[-1], float(unknown.sd[-1]) ** -2.0
    own = float(row @ unknown.spectra[-1])
    scale = (own + np.sqrt(own**2 + 4.0 * precision)) / 2.0
    return LightFactor(
        row, scale, 1.0 + float(unknown.mean[-1]), model.log_k, model.hot @ row, model.fixed @ row,
        precision / scale**2, unknown.factor_prior,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Exposures:
    """Raw frames, shape (n, n_pixel), and the quiescent mean; sums are taken block by block, without a copy of all."""

    raw: NDArray[Any]
    mean_dn: Float

    def sums(self, reduction: Reduction, rows: NDArray[np.intp]) -> Float:
        """Return the sums of some frames, shape (n, n_sum)."""
        return np.concatenate([excess @ reduction.weights.T for excess in self._excess(rows)])

    def sums_and_rest(self, reduction: Reduction, rows: NDArray[np.intp]) -> tuple[Float, Float, Float | None]:
        """Return the sums of some frames, chi-squared of the residuals, and sums of the factor on light, (n,) each."""
        parts, light = [], reduction.light
        for excess in self._excess(rows):
            sums = excess @ reduction.weights.T
            own = np.zeros(0) if light is None else excess @ light.weights
            parts.append((sums, reduction.rest(excess, sums), own))
        sums, rest, own = (np.concatenate(one) for one in zip(*parts, strict=True))
        return sums, rest, None if light is None else own

    def _excess(self, rows: NDArray[np.intp]) -> Iterator[Float]:
        for start in range(0, rows.size, FRAMES_AT_ONCE):
            yield self.raw[rows[start : start + FRAMES_AT_ONCE]] - self.mean_dn


def drawn_sums(values: NDArray[np.float32], reduction: Reduction) -> Float:
    """Return the sums of drawn exposures, (n, n_sum), from the result of `Engine.statistic_values` for one flare."""
    return np.ascontiguousarray(values[-len(reduction.weights) :].T, np.float64)


def variance_of(
    quiet: Expectation, added_dn: Float | None = None, highest_dn: Float | None = None
) -> tuple[Float, NDArray[np.bool_]]:
    """Return the variance of an exposure with a flare, DN^2, zero in saturated pixels, and which pixels are used.

    Pixels saturate with the light `highest_dn` of a flare, by default the mean `added_dn`.
    """
    added = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
    constant = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn

    def variance_with(added: Float) -> tuple[Float, Float]:
        light = np.maximum(quiet.light_dn + added, 0.0)
        return light, constant + quiet.gain_dn_per_electron * light

    variance = variance_with(added)[1]
    light, scatter = variance_with(added if highest_dn is None else highest_dn)
    # Frames of a pixel near saturation are occasionally clipped, so that the pixel is not reliable.
    raw = light / quiet.n_frames + quiet.dark_dn + quiet.bias_dn
    used = raw + NEAR_SIGMA * np.sqrt(scatter / quiet.n_frames) < quiet.ceiling_dn
    return np.where(used, variance, 0.0), used


def usable_variance(
    quiet: Expectation,
    added_dn: Float | None = None,
    skipped_nm: Ranges = (),
    nuisances: Nuisances | None = None,
    highest_dn: Float | None = None,
) -> tuple[Float, NDArray[np.bool_]]:
    """Return `variance_of` without skipped pixels, at the unknowns' means; raises InputError without a pixel."""
    if nuisances and nuisances.mean_dn.any():
        added_dn = np.zeros(quiet.wavelength_nm.size) if added_dn is None else added_dn
        # A frame may have more light than the mean exposure, up to what the expectation has.
        highest_dn = added_dn if highest_dn is None else highest_dn
        added_dn = added_dn + nuisances.mean_dn
    variance, used = variance_of(quiet, added_dn, highest_dn)
    used = used & ~skipped_pixels(quiet, skipped_nm)
    check_enough(quiet, used, 0)
    return np.where(used, variance, 0.0), used


def check_enough(quiet: Expectation, used: NDArray[np.bool_], parameters: int) -> None:
    """Raise InputError unless more pixels are used than parameters are fitted."""
    count = int(used.sum())
    if count <= parameters:
        fault = f"{count} of {used.size} pixels of {quiet.name} can be used, since others saturate or are left out"
        expected = f"more than the {parameters} parameters of the fit"
        if not count:
            fault, expected = f"every pixel of {quiet.name} saturates or is left out", "some that count"
        raise InputError(fault, expected, key="skipped_nm", value=count)


def skipped_pixels(quiet: Expectation, skipped_nm: Ranges) -> NDArray[np.bool_]:
    """Return which pixels lie in wavelength ranges that are not used, shape (n_pixel,)."""
    nm = quiet.wavelength_nm
    skipped = np.zeros(nm.size, np.bool_)
    for low, high in skipped_nm:
        skipped |= (nm >= low) & (nm <= high)
    return skipped


def check_distinct(kept: Float, whole: Float, nuisances: Nuisances | None) -> None:
    """Raise InputError if marginalisation over nuisances removes the S/N^2 of a component."""
    if not (whole > 0.0).all():
        raise InputError(
            "a component of the flare has no light in the pixels that neither saturate nor are left out",
            "a model whose components have light there",
            key="model",
        )
    if not (kept > LEAST_KEPT * whole).all():
        unknown = join_names(nuisances.names) if nuisances else "nothing"
        raise InputError(
            f"the light of a flare cannot be distinguished from {unknown}",
            "fewer unknowns",
            key="nuisances",
            value=unknown,
        )
