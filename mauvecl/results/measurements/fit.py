"""Fits of flares to observed frames with intervals from the profile likelihood, and forecasts of errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.results.measurements.flare_model import FlareModel, derived_values
from mauvecl.results.measurements.light_factor import undimmed
from mauvecl.results.measurements.nonnegative import BoundedProfile, bounded_intervals, with_bounds
from mauvecl.results.measurements.profile import BestFit, Profile, covariance, covariance_of, intervals
from mauvecl.results.measurements.reduction import (
    NEAR_SIGMA,
    Exposures,
    Reduction,
    check_distinct,
    check_enough,
    light_factor,
    usable_variance,
)
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import Probability, Temperature, Wavelength
from mauvecl.schema.tables import Column, table_of
from mauvecl.statistics.nuisances import Nuisances

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from astropy.table import Table

    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: Probabilities of the intervals: one and two standard deviations of a normal variable, about.
LEVELS = (0.6827, 0.95)
#: Number of fits after the first; each uses the variance of the previously fitted flare.
REFITS = 2
#: Frames share a variance if the changes of its logarithm agree to this step in each of some ranges of pixels.
VARIANCE_STEP, VARIANCE_RANGES = 0.03, 12
#: Frames that are fitted together, which bounds the memory.
BATCH = 2048
#: Fits more of exposures with pixels near saturation; the logarithmic step of the number of such pixels of those that
#: share the others in the first fit, and the least share of their pixels that all must be able to use there.
SATURATED_REFITS, SATURATED_STEP, LEAST_SHARED = 4, 0.05, 0.5
#: Pixels on both sides of one near saturation that are not used.
NEIGHBOURS = 4
#: Factor by which the largest flare of a group may exceed the mean one.
NEAR_GROUP = 1.1


@dataclass(frozen=True, eq=False)
class Measurement:
    """Fitted flares of n frames; quantities are those of the model, in its order."""

    #: Names of the quantities, in the order of the last axis of estimates and intervals.
    names: tuple[str, ...]
    units: tuple[str, ...]
    #: Smallest possible values: 1 of a jump, 0 of light.
    bounds: tuple[float, ...]
    #: Maximum-likelihood estimates, shape (n, n_derived).
    estimates: Float
    #: Covariance from the Fisher information at the fit, shape (n, n_derived, n_derived).
    covariance: Float
    #: Nominal coverage of the intervals.
    levels: tuple[float, ...]
    #: Lower ends of the intervals, shape (n_level, n, n_derived); if infinite or a bound, `high` is an upper limit.
    low: Float
    #: Upper ends of the intervals, shape (n_level, n, n_derived); if infinite, `low` is a lower limit.
    high: Float
    #: Goodness of fit, shape (n,).
    chi2: Float
    #: Probability of a larger chi-squared if the model is correct, shape (n,).
    p_value: Float
    dof: int
    #: Root of the decrease of chi-squared by the flare, shape (n,).
    snr: Float
    #: Natural logarithm of the temperature, shape (n,), or (n, 2) of two temperatures.
    log_k: Float
    #: Parameters of the model's `counts`, shape (n, n_linear), for the light before it is dimmed by `factor`.
    amplitudes: Float
    #: Factor on all light, shape (n,); 1 if it is known.
    factor: Float

    @property
    def errors(self) -> Float:
        """Standard errors from the Fisher information, shape (n, n_derived)."""
        return np.asarray(np.sqrt(np.einsum("nqq->nq", self.covariance)))

    @property
    def one_sided(self) -> NDArray[np.bool_]:
        """True for one-sided intervals, shape (n_level, n, n_derived); their other end is infinite or a bound."""
        return np.asarray((self.low <= self.bounds) != np.isinf(self.high))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the measurements of several batches of frames as one."""
        values: dict[str, Any] = {one.name: getattr(parts[0], one.name) for one in fields(cls)}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                axis = 1 if name in ("low", "high") else 0
                values[name] = np.concatenate([getattr(part, name) for part in parts], axis)
        return cls(**values)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that depend on the frames, for files; the inverse of `of_arrays`."""
        values = {one.name: np.asarray(getattr(self, one.name)) for one in fields(self)}
        return {name: value for name, value in values.items() if name not in ("names", "units", "bounds", "levels")}

    @classmethod
    def of_arrays(
        cls,
        arrays: Mapping[str, NDArray[Any]],
        levels: Sequence[float],
        *,
        names: tuple[str, ...],
        units: tuple[str, ...],
        bounds: tuple[float, ...],
    ) -> Self:
        """Return a measurement from its `arrays`, levels of intervals, and the quantities that were measured."""
        given: dict[str, Any] = {**arrays, "dof": int(arrays["dof"])}
        return cls(names, units, bounds, levels=tuple(levels), **given)

    def rows(self, which: NDArray[Any]) -> Self:
        """Return the measurements of some frames, by number or mask."""
        kept: dict[str, Any] = {}
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, np.ndarray):
                kept[one.name] = value[:, which] if one.name in ("low", "high") else value[which]
        return replace(self, **kept)

    def column(self, name: str) -> int:
        """Return the index of a quantity.

        Raises
        ------
        InputError
            For an unknown name.
        """
        if name not in self.names:
            raise InputError.of("name", name, f"one of {', '.join(self.names)}")
        return self.names.index(name)

    def table(self, frame: int = 0) -> Table:
        """Return the estimates and intervals of one frame, one row per quantity."""
        values = [
            Column("quantity", lambda _: list(self.names), description="what is measured"),
            Column("unit", lambda _: list(self.units), description="of estimate, error and interval"),
            Column("estimate", self.estimates.__getitem__, description="estimate"),
            Column("error", self.errors.__getitem__, description="standard error"),
        ]
        for level, low, high in zip(self.levels, self.low, self.high, strict=True):
            share = f"{100 * level:.4g}"
            for end, bound in (("low", low), ("high", high)):
                text = f"{share} % interval, {'lower' if end == 'low' else 'upper'} end"
                values.append(Column(f"{end}_{share}", bound.__getitem__, description=text))
        chi2, p_value = float(self.chi2[frame]), float(self.p_value[frame])
        table = table_of(values, [frame], chi2=chi2, dof=self.dof, p_value=p_value)
        for name in table.colnames[2:]:
            table[name].info.format = ".4g"
        return table


@validated
def fit(
    frames: ArrayLike,
    expectation: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    levels: Sequence[Probability] = LEVELS,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> Measurement:
    """Fit one flare to each exposure.

    The likelihood is Gaussian with the variance of the fitted flare and star. Intervals are from the profile likelihood
    with Wilks' thresholds, or simulated ones where a quantity bends within the error of the temperature. Light is at
    least 0 and a jump at least 1. An interval that reaches this bound, or an end of the model's temperatures, is a
    one-sided limit.

    Parameters
    ----------
    frames : array_like, shape (n, n_pixel)
        Raw DN of the exposures, as returned by `Engine.realise`.
    expectation : Expectation
        The exposure of the quiescent star.
    model : FlareModel
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra, over which the fit marginalises. A factor on all light, such as ``light``
        of `Nuisances.of`, dims the flare as it dims the star.
    levels : sequence of float
        Nominal coverage of the intervals.
    skipped_nm : sequence of tuple
        Wavelength ranges of pixels that are not used, such as gaps of an observation.

    Raises
    ------
    InputError
        If frames have another shape, the flare is degenerate with the unknowns, or fewer pixels than parameters are
        neither saturated nor left out.

    Examples
    --------
    >>> from mauvecl import Instrument, Source, expect
    >>> from mauvecl.results.measurements.flare_model import FlareModel
    >>> from mauvecl.results.measurements.fit import fit
    >>> star, mauve = Source.from_library("M3V").at_magnitude(9), Instrument.load("mauve")
    >>> quiet, flare = (expect(s, mauve, exposure=50.0) for s in (star, star.flaring(0.5, 9000)))
    >>> model = FlareModel.of(star, mauve, quiet)
    >>> found = fit(flare.recorded_dn, quiet, model)
    >>> [round(float(x), 2) for x in found.estimates[0, :2]]
    [9000.0, 0.5]
    """
    exposures = checked_exposures(frames, expectation, levels, nuisances)

    def reduction_of(added_dn: Float | None, **how: Any) -> Reduction:
        return Reduction.of(model, expectation, added_dn, nuisances, skipped_nm, **how)

    log_k, linear, cut = _pilot(exposures, expectation, model, reduction_of)
    every = np.arange(len(exposures.raw))
    # Exposures with saturated pixels start far from the flare, which decides on the pixels that saturate.
    saturated = [np.flatnonzero(cut)] * (SATURATED_REFITS if cut.any() else 0)
    for rows in [*saturated, *[every] * (REFITS - 1)]:
        some_of = replace(exposures, raw=exposures.raw[rows]) if cut.any() else None
        groups = variance_groups(expectation, model, log_k[rows], linear[rows], reduction_of, nuisances, some_of)
        for some, reduction in groups:
            own = rows[some]
            for start in range(0, own.size, BATCH):
                batch = own[start : start + BATCH]
                best = _estimated(exposures, batch, reduction)
                log_k[batch], linear[batch] = best.log_k, best.linear
    parts: list[tuple[NDArray[np.intp], dict[str, Any]]] = []
    near = exposures if cut.any() else None
    for some, reduction in variance_groups(expectation, model, log_k, linear, reduction_of, nuisances, near):
        for start in range(0, some.size, BATCH):
            batch = some[start : start + BATCH]
            parts.append((batch, _fitted(exposures, batch, model, reduction, levels)))
    order = np.argsort(np.concatenate([rows for rows, _ in parts]))
    along = {"low": 1, "high": 1}
    joined = {
        name: np.take(np.concatenate([one[name] for _, one in parts], along.get(name, 0)), order, along.get(name, 0))
        for name in parts[0][1]
    }
    dof = joined.pop("dof")
    joined["p_value"] = np.asarray(scipy.stats.chi2.sf(joined["chi2"], dof))
    return Measurement(model.names, model.units, model.bounds, levels=tuple(levels), dof=int(dof.min()), **joined)


def checked_exposures(
    frames: ArrayLike, expectation: Expectation, levels: Sequence[float], nuisances: Nuisances | None
) -> Exposures:
    """Return exposures less their mean without a flare; raises InputError as `fit` does."""
    raw = np.atleast_2d(np.asarray(frames))
    if raw.ndim != 2 or not len(raw) or raw.shape[1] != expectation.wavelength_nm.size:
        raise InputError(
            f"frames of the shape {raw.shape}",
            f"(n, {expectation.wavelength_nm.size})",
            key="frames",
            value=raw.shape,
        )
    if raw.dtype.kind not in "iuf" or not np.isfinite(raw).all():
        raise InputError("frames hold undefined values", "finite numbers", key="frames")
    if not levels:
        raise InputError.of("levels", levels, "at least one probability")
    mean = expectation.recorded_dn if nuisances is None else expectation.recorded_dn + nuisances.mean_dn
    return Exposures(raw, mean)


def _pilot(
    exposures: Exposures, quiet: Expectation, model: FlareModel, reduction_of: Callable[..., Reduction]
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Fit all frames with the variance of the quiescent star, and return which have saturated pixels as well.

    Pixels that are near saturation in a frame are not used.
    """
    n = len(exposures.raw)
    log_k, linear, counts = np.empty(n), np.empty((n, len(model.linear))), np.zeros(n, np.intp)
    usual = reduction_of(None)
    used = usual.variance > 0.0
    ceiling = _highest_usable(quiet)
    for start in range(0, n, BATCH):
        raw = exposures.raw[start : start + BATCH]
        if (raw.max(axis=0) > ceiling)[used].any():
            counts[start : start + BATCH] = (raw > ceiling)[:, used].sum(axis=1)

    def best(rows: NDArray[np.intp], reduction: Reduction) -> None:
        for start in range(0, rows.size, BATCH):
            some = rows[start : start + BATCH]
            found = Profile(reduction, exposures.sums(reduction, some)).best()
            log_k[some], linear[some] = found.log_k, found.linear

    best(np.flatnonzero(counts == 0), usual)
    # Frames with about as many saturated pixels share the pixels that none of them saturates.
    alike = np.rint(np.log(np.maximum(counts, 1)) / SATURATED_STEP).astype(np.intp)
    for key in np.unique(alike[counts > 0]):
        rows = np.flatnonzero((alike == key) & (counts > 0))
        for start in range(0, rows.size, BATCH):
            some = rows[start : start + BATCH]
            shared = clipped_pixels(exposures, quiet, some)
            if (~shared & used).sum() >= LEAST_SHARED * (used.sum() - counts[some].max()):
                best(some, reduction_of(None, clipped=shared))
                continue
            for row in some:
                best(np.array([row]), reduction_of(None, clipped=clipped_pixels(exposures, quiet, np.array([row]))))
    return log_k, linear, counts > 0


def clipped_pixels(exposures: Exposures, quiet: Expectation, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels are near saturation in any of some exposures, and their neighbours, shape (n_pixel,).

    Neighbours are left out so that the noise of single pixels does not select the pixels of a fit.
    """
    clipped = (exposures.raw[rows] > _highest_usable(quiet)).any(axis=0)
    return np.convolve(clipped, np.ones(2 * NEIGHBOURS + 1), "same") > 0.5


def _highest_usable(quiet: Expectation) -> Float:
    """Return the raw DN of the exposure above which a pixel is near saturation, shape (n_pixel,)."""
    constant = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn
    light = quiet.n_frames * np.maximum(quiet.ceiling_dn - quiet.dark_dn - quiet.bias_dn, 0.0)
    sd = np.sqrt((constant + quiet.gain_dn_per_electron * light) / quiet.n_frames)
    return np.asarray(quiet.n_frames * (quiet.ceiling_dn - NEAR_SIGMA * sd))


def variance_groups(
    quiet: Expectation,
    model: FlareModel,
    log_k: Float,
    linear: Float,
    reduction_of: Callable[..., Reduction],
    nuisances: Nuisances | None,
    exposures: Exposures | None,
) -> Iterator[tuple[NDArray[np.intp], Reduction]]:
    """Yield groups of frames whose fitted flares have nearly the same variance, with their reduction.

    The exposures are needed if pixels are near saturation in some of them.
    """
    n_pixel = quiet.wavelength_nm.size
    edges = np.linspace(0, n_pixel, VARIANCE_RANGES + 1).astype(np.intp)[:-1]
    ceiling = _highest_usable(quiet)
    # Pixels that saturate in every frame have no say.
    seen = True if exposures is None else exposures.raw.min(axis=0) <= ceiling
    relative = seen * quiet.gain_dn_per_electron / quiet.unsaturated_variance_dn2
    averaged = np.diff(np.append(edges, n_pixel))
    hot = np.add.reduceat(model.hot * relative, edges, axis=1) / averaged
    fixed = np.add.reduceat(model.fixed * relative, edges, axis=1) / averaged
    node = np.rint(np.interp(log_k, model.log_k, np.arange(model.log_k.size))).astype(np.intp)
    added = linear[:, :1] * hot[node] + linear[:, 1:] @ fixed
    keys = np.rint(np.log1p(np.maximum(added, -0.9)) / VARIANCE_STEP).astype(np.int64)
    _, number, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(number, kind="stable")
    # Single frames may have all the light that an exposure loses on average.
    undimmed = 1.0 / min(1.0, nuisances.mean_factor) if nuisances else 1.0
    for rows in np.split(order, np.cumsum(counts)[:-1]):
        middle = np.mean(log_k[rows])
        mean = linear[rows, 0].mean() * model.hot_spline(middle) + linear[rows, 1:].mean(axis=0) @ model.fixed
        highest = undimmed * mean
        if (quiet.n_frames * quiet.mean_raw_dn + NEAR_GROUP * highest > ceiling).any():
            each = (linear[k, 0] * model.hot_spline(log_k[k]) + linear[k, 1:] @ model.fixed for k in rows)
            highest = undimmed * np.max(list(each), axis=0) if rows.size <= BATCH else NEAR_GROUP * highest
        clipped = None
        if exposures is not None and (exposures.raw[rows].max(axis=0) > ceiling).any():
            clipped = clipped_pixels(exposures, quiet, rows)
        yield rows, reduction_of(mean, highest_dn=highest, clipped=clipped)


def _estimated(exposures: Exposures, rows: NDArray[np.intp], reduction: Reduction) -> BestFit:
    """Return the best fits of some frames of one variance."""
    profile = Profile(reduction, exposures.sums(reduction, rows))
    return with_bounds(reduction, profile.sums, profile.best())


def _fitted(
    exposures: Exposures, rows: NDArray[np.intp], model: FlareModel, reduction: Reduction, levels: Sequence[float]
) -> dict[str, Any]:
    """Return the attributes of `Measurement` for some frames of one variance."""
    sums, rest, light = exposures.sums_and_rest(reduction, rows)
    profile = Profile(reduction, sums, light)
    at_nodes = profile.gain_at_nodes()
    best = profile.best(at_nodes)
    allowed = [float(scipy.stats.chi2.isf(1 - p, 1)) for p in levels]
    ends = [intervals(model, profile, best, at_nodes, one) for one in allowed]
    low, high = (np.stack([one[side] for one in ends]) for side in (0, 1))
    # Intervals differ from unbounded ones only if they reach a bound.
    reaches = (low <= np.array(model.bounds)) & np.isfinite(model.bounds)
    near = np.flatnonzero(reaches.any(axis=(0, 2)) | (best.linear < 0.0).any(axis=1))
    if near.size:
        bounded = BoundedProfile(reduction, sums[near], None if light is None else light[near])
        nodes = bounded.gain_at_nodes()
        there = bounded.best(nodes)
        for k, one in enumerate(allowed):
            low[k, near], high[k, near] = bounded_intervals(model, bounded, there, nodes, one)
        best = best.replaced(near, there)
    left = np.einsum("nk,nk->n", sums, sums) - best.gain
    n_fitted = len(model.linear) + 1
    factor = profile.factor(best.log_k, best.linear)
    estimates = derived_values(model, best.log_k, best.linear)
    which, _ = model.sums
    estimates[:, which] = undimmed(estimates[:, which], factor)
    return {
        "log_k": best.log_k,
        "amplitudes": undimmed(best.linear, factor),
        "factor": factor,
        "estimates": estimates,
        "covariance": covariance(model, profile, best),
        "low": low,
        "high": high,
        "chi2": rest + left,
        "dof": np.full(len(sums), reduction.n_used - reduction.n_free - n_fitted),
        "snr": np.sqrt(best.gain),
    }


def fit_sums(sums: Float, model: FlareModel, reduction: Reduction) -> tuple[Float, Float]:
    """Fit the sums of exposures, without intervals; a processor core fits about 3e5 exposures per second.

    Parameters
    ----------
    sums : ndarray, shape (n, n_sum)
    model : FlareModel
    reduction : Reduction
        Its variance is assumed for every exposure.

    Returns
    -------
    estimates : ndarray, shape (n, n_derived)
        Quantities of the model.
    covariance : ndarray, shape (n, n_derived, n_derived)
        Covariance from the Fisher information at the fit.
    """
    estimates, spreads = [], []
    for start in range(0, len(sums), BATCH):
        profile = Profile(reduction, sums[start : start + BATCH])
        best = with_bounds(reduction, profile.sums, profile.best())
        estimates.append(derived_values(model, best.log_k, best.linear))
        spreads.append(covariance(model, profile, best))
    return np.concatenate(estimates), np.concatenate(spreads)


@dataclass(frozen=True, eq=False)
class Forecast:
    """Expected errors of a measurement, from the Fisher information."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    #: Quantities of the flare, shape (n_derived,).
    values: Float
    #: Standard errors, shape (n_derived,).
    errors: Float
    #: Covariance of the estimates, shape (n_derived, n_derived).
    covariance: Float
    #: S/N of the flare.
    snr: float

    @property
    def correlation(self) -> Float:
        """Correlation of the estimates, shape (n_derived, n_derived)."""
        return np.asarray(self.covariance / np.outer(self.errors, self.errors))


@validated
def forecast(
    expectation: Expectation,
    model: FlareModel,
    temperature_k: Temperature,
    amplitudes: Sequence[float] | Float,
    nuisances: Nuisances | None = None,
    *,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> Forecast:
    """Forecast the errors of the measurement of a flare from the Fisher information of one exposure.

    Parameters
    ----------
    expectation : Expectation
        The exposure of the quiescent star.
    model : FlareModel
    temperature_k, amplitudes
        Flare, as for `FlareModel.counts`.
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra.
    skipped_nm : sequence of tuple
        Wavelength ranges of pixels that are not used.

    Raises
    ------
    InputError
        If the model cannot describe the flare, or the flare is degenerate with the unknowns.
    """
    factor = nuisances.mean_factor if nuisances else 1.0
    # The flare as it is recorded.
    counts = factor * model.counts(temperature_k, amplitudes)
    log_k, linear = np.array([np.log(temperature_k)]), factor * np.asarray(amplitudes, np.float64)[None]
    variance, used = usable_variance(expectation, counts, skipped_nm, nuisances, counts / min(1.0, factor))
    check_enough(expectation, used, len(model.linear) + 1 + (nuisances.free if nuisances else 0))
    slope = linear[0, 0] * model.hot_spline(log_k[0], 1)
    rows = np.vstack([model.hot_spline(log_k[0]), model.fixed, slope, counts]) * used
    plain = np.divide(rows, variance, out=np.zeros_like(rows), where=used) @ rows.T
    unknown = nuisances.around(counts) if nuisances else None
    weights = unknown.rows(variance, unknown.spectra * used) if unknown else np.zeros((0, used.size))
    lost = weights @ rows.T
    information = plain - lost.T @ lost
    check_distinct(np.diag(information)[:-2], np.diag(plain)[:-2], nuisances)
    light = light_factor(model, unknown, weights)
    spread = covariance_of(model, log_k, linear, information[None, :-1, :-1], light, factor)[0]
    values = derived_values(model, log_k, linear / factor)[0]
    snr = float(np.sqrt(max(information[-1, -1], 0.0)))
    return Forecast(model.names, model.units, values, np.sqrt(np.diag(spread)), spread, snr)
