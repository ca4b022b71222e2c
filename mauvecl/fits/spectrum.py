"""Fits of flares with one or two temperatures to observed frames, and forecasts of their errors.

Two temperatures may be free. At each second temperature, one of the model's, the flare is one blackbody with another
component of fixed shape, so that the rest is a fit with amplitudes of at least zero. The second temperature is the
higher one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.flare_model import (
    APART,
    NEAR_SIGMA,
    DerivedQuantity,
    FlareModel,
    Ranges,
    RawCounts,
    ReducedSums,
    check_enough,
    derived_values,
    nodes_below,
    undimmed,
)
from mauvecl.fits.profile import BestFit, Profile, Slopes, covariance, intervals
from mauvecl.host.arrays import Float
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, formatted, table_of
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Probability, Temperature, Wavelength

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.host.exposure.expectation import Expectation


#: Probabilities of the intervals: one and two standard deviations of a normal variable, about.
LEVELS = (0.6827, 0.95)
#: Number of fits after the first; each uses the variance of the previously fitted flare.
REFITS = 2
#: Frames share a variance if the changes of its logarithm agree to this step in each of some ranges of pixels.
VARIANCE_STEP, VARIANCE_RANGES = 0.03, 12
#: Frames that are fitted together, which bounds the memory, and number of frames per block of sums over pixels.
BATCH, FRAMES_AT_ONCE = 2048, 64
#: Number of additional fits of exposures with pixels near saturation.
SATURATED_REFITS = 4
#: Exposures share a first fit if the logarithms of their numbers of such pixels agree to this step, and at least this
#: share of the pixels that each of them could use is not near saturation in any of them.
SATURATED_STEP, LEAST_SHARED = 0.05, 0.5
#: Pixels on both sides of one near saturation that are not used.
NEIGHBOURS = 4
#: Factor by which the largest flare of a group may exceed the mean one.
NEAR_GROUP = 1.1


def _values(measured: Measurement | Forecast, values: Float, errors: Float) -> str:
    """Return quantities with errors and units as text."""
    return ", ".join(
        f"{name} = {formatted(value, '.4g')} +- {formatted(error, '.2g')} {unit}".rstrip()
        for name, value, error, unit in zip(measured.names, values, errors, measured.units, strict=True)
    )


#: Axis of the frames in each array of a `Measurement`.
FRAME_AXES = {
    "estimates": 0, "covariance": 0, "low": 1, "high": 1, "chi2": 0, "p_value": 0, "snr": 0, "log_k": 0,
    "amplitudes": 0, "factor": 0,
}  # fmt: skip


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

    def __repr__(self) -> str:
        if not len(self.estimates):
            return "<Measurement of no frames>"
        count = f"; the first of {len(self.estimates)} frames" if len(self.estimates) > 1 else ""
        return f"<Measurement: {_values(self, self.estimates[0], self.errors[0])}{count}>"

    @property
    def errors(self) -> Float:
        """Standard errors from the Fisher information, shape (n, n_derived)."""
        return np.asarray(np.sqrt(np.einsum("nqq->nq", self.covariance)))

    @property
    def one_sided(self) -> NDArray[np.bool_]:
        """True for one-sided intervals, shape (n_level, n, n_derived); their other end is infinite or a bound."""
        return np.asarray((self.low <= self.bounds) != np.isinf(self.high))

    @classmethod
    def joined(cls, parts: Sequence[Self], numbers: Sequence[ArrayLike] | None = None) -> Self:
        """Return the measurements of several batches of frames as one, in the order of the frames' numbers if given."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts], axis) for name, axis in FRAME_AXES.items()
        }
        joined = replace(parts[0], **arrays, dof=min(part.dof for part in parts))
        return joined if numbers is None else joined.rows(np.argsort(np.concatenate(numbers)))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that depend on the frames, and the degrees of freedom, for files."""
        return {name: np.asarray(getattr(self, name)) for name in (*FRAME_AXES, "dof")}

    def rows(self, index: NDArray[Any]) -> Self:
        """Return the measurements of some frames, by number or mask."""
        arrays: dict[str, Any] = {}
        for name, axis in FRAME_AXES.items():
            values = getattr(self, name)
            arrays[name] = values[:, index] if axis else values[index]
        return replace(self, **arrays)

    def column(self, name: str) -> int:
        """Return the index of a quantity; raises InputError for an unknown name."""
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
    frames: RawCounts,
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
    >>> from mauvecl.fits.flare_model import FlareModel
    >>> from mauvecl.fits.spectrum import fit
    >>> star, mauve = Source.from_library("M3V").at_magnitude(9), Instrument.load("mauve")
    >>> quiet, flare = (expect(s, mauve, exposure=50.0) for s in (star, star.flaring(0.5, 9000)))
    >>> model = FlareModel.of(star, mauve, quiet)
    >>> found = fit(flare.recorded_dn, quiet, model)
    >>> [round(float(x), 2) for x in found.estimates[0, :2]]
    [9000.0, 0.5]
    """
    exposures = _Exposures(frames, expectation, model, nuisances, levels, skipped_nm)
    log_k, linear, saturates = exposures.pilot()
    any_saturates, all_rows = bool(saturates.any()), np.arange(len(saturates))
    # Exposures with saturated pixels start far from the flare, which decides on the pixels that saturate.
    saturated = [np.flatnonzero(saturates)] * (SATURATED_REFITS if any_saturates else 0)
    for rows in [*saturated, *[all_rows] * (REFITS - 1)]:
        for batch, reduction in exposures.groups(log_k, linear, rows, any_saturates):
            best = exposures.profile(reduction, batch).bounded_best()
            log_k[batch], linear[batch] = best.log_k, best.linear
    measurements, batches = [], []
    for batch, reduction in exposures.groups(log_k, linear, all_rows, any_saturates):
        measurements.append(exposures.measured(batch, reduction))
        batches.append(batch)
    return Measurement.joined(measurements, batches)


def _batches(rows: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Yield the numbers of frames that are fitted together."""
    for start in range(0, rows.size, BATCH):
        yield rows[start : start + BATCH]


class _Exposures:
    """Exposures, and the model of the flares that are fitted to them."""

    def __init__(
        self, frames: ArrayLike, quiet: Expectation, model: FlareModel, nuisances: Nuisances | None,
        levels: Sequence[float], skipped_nm: Ranges,
    ) -> None:  # fmt: skip
        """Raise InputError as `fit` does."""
        raw = np.atleast_2d(np.asarray(frames))
        if raw.ndim != 2 or not len(raw) or raw.shape[1] != quiet.wavelength_nm.size:
            raise InputError(
                f"frames must have the shape (n, {quiet.wavelength_nm.size}), not {raw.shape}", key="frames"
            )
        if raw.dtype.kind not in "iuf" or not np.isfinite(raw).all():
            raise InputError("frames must hold finite numbers, but some are undefined", key="frames")
        if not levels:
            raise InputError.of("levels", levels, "at least one probability")
        self.raw, self.quiet, self.model, self.nuisances, self.levels = raw, quiet, model, nuisances, tuple(levels)
        #: Mean of the frames without a flare, and rises of chi-squared at the ends of intervals of each level.
        self.mean_dn = quiet.recorded_dn if nuisances is None else quiet.recorded_dn + nuisances.mean_dn
        self.rises = scipy.stats.chi2.isf(1 - np.array(levels), 1).tolist()
        #: Reduction of exposures with a flare, for its mean and further options of `ReducedSums.of`.
        self.reduction = partial(ReducedSums.of, model, quiet, nuisances=nuisances, skipped_nm=skipped_nm)

    def _excess(self, rows: NDArray[np.intp]) -> Iterator[Float]:
        """Yield frames less their mean without a flare, (n, n_pixel), in blocks that fit into a processor's cache."""
        for start in range(0, rows.size, FRAMES_AT_ONCE):
            yield self.raw[rows[start : start + FRAMES_AT_ONCE]] - self.mean_dn

    def profile(self, reduction: ReducedSums, rows: NDArray[np.intp]) -> Profile:
        """Return the profile of some frames."""
        light = np.zeros((0, self.mean_dn.size)) if reduction.light is None else reduction.light.weights[None]
        weights = np.vstack([reduction.weights, light])
        sums = np.concatenate([excess @ weights.T for excess in self._excess(rows)])
        n = len(reduction.weights)
        return Profile(reduction, sums[:, :n], sums[:, n] if len(light) else None)

    def quiescent_chi2(self, reduction: ReducedSums, rows: NDArray[np.intp]) -> Float:
        """Return chi-squared of some frames without a flare, shape (n,)."""
        variance, chi2 = reduction.variance, []
        inverse = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
        for excess in self._excess(rows):
            unknown = excess @ reduction.rows.T
            chi2.append(excess**2 @ inverse - np.vecdot(unknown, unknown))
        return np.concatenate(chi2)

    def pilot(self) -> tuple[Float, Float, NDArray[np.bool_]]:
        """Fit all frames with the variance of the quiescent star, without the pixels that are near saturation in them.

        Returns log temperatures, (n,), amplitudes, (n, n_linear), and whether a frame has saturated pixels, (n,).
        """
        raw, quiet, n = self.raw, self.quiet, len(self.raw)
        log_k, linear = np.empty(n), np.empty((n, len(self.model.linear)))
        usual = self.reduction()
        used = usual.variance > 0.0
        counts = np.count_nonzero(raw > np.where(used, _highest_usable(quiet), np.inf), axis=1)

        def fit_rows(rows: NDArray[np.intp], reduction: ReducedSums) -> None:
            for batch in _batches(rows):
                best = self.profile(reduction, batch).best()
                log_k[batch], linear[batch] = best.log_k, best.linear

        fit_rows(np.flatnonzero(counts == 0), usual)
        # Frames with about as many saturated pixels share the pixels that none of them saturates.
        step = np.rint(np.log(np.maximum(counts, 1)) / SATURATED_STEP).astype(np.intp)
        for key in np.unique(step[counts > 0]):
            for batch in _batches(np.flatnonzero((step == key) & (counts > 0))):
                clipped = clipped_pixels(raw[batch], quiet)
                if (~clipped & used).sum() >= LEAST_SHARED * (used.sum() - counts[batch].max()):
                    fit_rows(batch, self.reduction(clipped=clipped))
                    continue
                for row in batch[:, None]:
                    fit_rows(row, self.reduction(clipped=clipped_pixels(raw[row], quiet)))
        return log_k, linear, counts > 0

    def groups(
        self, log_k: Float, linear: Float, rows: NDArray[np.intp], any_saturates: bool
    ) -> Iterator[tuple[NDArray[np.intp], ReducedSums]]:
        """Yield batches of frames whose fitted flares have nearly the same variance, with their reduction.

        The frames are some `rows` of all; if `any_saturates`, pixels are near saturation in some of these.
        """
        quiet, model, raw, nuisances = self.quiet, self.model, self.raw, self.nuisances
        log_k, linear, n_pixel = log_k[rows], linear[rows], quiet.wavelength_nm.size
        edges = np.linspace(0, n_pixel, VARIANCE_RANGES + 1).astype(np.intp)[:-1]
        ceiling = _highest_usable(quiet)
        # Pixels that saturate in every frame have no say.
        usable = raw[rows].min(axis=0) <= ceiling if any_saturates else True
        relative = usable * quiet.gain_dn_per_electron / quiet.unsaturated_variance_dn2
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
        for group in np.split(order, np.cumsum(counts)[:-1]):
            middle = np.mean(log_k[group])
            mean = linear[group, 0].mean() * model.hot_spline(middle) + linear[group, 1:].mean(axis=0) @ model.fixed
            highest = undimmed * mean
            if (quiet.n_frames * quiet.mean_raw_dn + NEAR_GROUP * highest > ceiling).any():
                flares = (linear[k, 0] * model.hot_spline(log_k[k]) + linear[k, 1:] @ model.fixed for k in group)
                highest = undimmed * np.max(list(flares), axis=0) if group.size <= BATCH else NEAR_GROUP * highest
            numbers = rows[group]
            clipped = clipped_pixels(raw[numbers], quiet) if any_saturates else None
            reduction = self.reduction(mean, highest_dn=highest, clipped=clipped)
            yield from ((batch, reduction) for batch in _batches(numbers))

    def measured(self, rows: NDArray[np.intp], reduction: ReducedSums) -> Measurement:
        """Measure the flares of some frames of one variance."""
        model = self.model
        profile = self.profile(reduction, rows)
        at_nodes = profile.gain_at_nodes()
        best = profile.best(at_nodes)
        ends = [intervals(model, profile, best, at_nodes, rise) for rise in self.rises]
        low, high = (np.stack([interval[side] for interval in ends]) for side in (0, 1))
        # Intervals differ from unbounded ones only if they reach a bound.
        reaches = (low <= np.array(model.bounds)) & np.isfinite(model.bounds)
        near_bound = np.flatnonzero(reaches.any(axis=(0, 2)) | (best.linear < 0.0).any(axis=1))
        if near_bound.size:
            bounded = profile.bounded_rows(near_bound)
            bounded_at_nodes = bounded.gain_at_nodes()
            bounded_best = bounded.best(bounded_at_nodes)
            for k, rise in enumerate(self.rises):
                ends_at_bound = intervals(model, bounded, bounded_best, bounded_at_nodes, rise)
                low[k, near_bound], high[k, near_bound] = ends_at_bound
            best = best.replaced(near_bound, bounded_best)
        return self.measurement(model, profile, best, self.quiescent_chi2(reduction, rows), (low, high))

    def measurement(
        self, model: FlareModel, profile: Profile, best: BestFit, quiescent: Float, ends: tuple[Float, Float],
        second: tuple[float, Slopes] | None = None,
    ) -> Measurement:  # fmt: skip
        """Return the measurement of best fits with the ends of their intervals.

        `quiescent` is chi-squared without a flare. A second blackbody is given by its log temperature and the
        derivatives with respect to it.
        """
        chi2, reduction = quiescent - best.gain, profile.reduction
        n_used = int(np.count_nonzero(reduction.variance))
        dof = n_used - reduction.n_free - len(model.linear) - (1 if second is None else 2)
        factor, log_k = profile.factor(best), best.log_k
        spread = covariance(model, reduction, best, factor, None if second is None else second[1])
        if second is not None:
            log_k = np.column_stack([log_k, np.full(log_k.size, second[0])])
        return Measurement(
            model.names, model.units, model.bounds, derived_values(model, best.log_k, best.linear, factor), spread,
            self.levels, *ends, chi2=chi2, p_value=np.asarray(scipy.stats.chi2.sf(chi2, dof)), dof=dof,
            snr=np.sqrt(best.gain), log_k=log_k, amplitudes=undimmed(best.linear, factor), factor=factor,
        )  # fmt: skip


def clipped_pixels(raw: NDArray[Any], quiet: Expectation) -> NDArray[np.bool_]:
    """Return which pixels are near saturation in any of some exposures, and their neighbours, shape (n_pixel,).

    Neighbours are left out so that the noise of single pixels does not select the pixels of a fit.
    """
    clipped = (raw > _highest_usable(quiet)).any(axis=0)
    return np.convolve(clipped, np.ones(2 * NEIGHBOURS + 1), "same") > 0.5


def _highest_usable(quiet: Expectation) -> Float:
    """Return the raw DN of the exposure above which a pixel is near saturation, shape (n_pixel,)."""
    constant = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn
    light = quiet.n_frames * np.maximum(quiet.ceiling_dn - quiet.dark_dn - quiet.bias_dn, 0.0)
    sd = np.sqrt((constant + quiet.gain_dn_per_electron * light) / quiet.n_frames)
    return np.asarray(quiet.n_frames * (quiet.ceiling_dn - NEAR_SIGMA * sd))


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

    def __repr__(self) -> str:
        return f"<Forecast: {_values(self, self.values, self.errors)}>"

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
    return forecast_model(expectation, model, temperature_k, amplitudes, nuisances, skipped_nm)


def forecast_model(
    expectation: Expectation,
    model: FlareModel | TwoTemperatures,
    temperature_k: Any,
    amplitudes: Sequence[float] | Float,
    nuisances: Nuisances | None = None,
    skipped_nm: Ranges = (),
) -> Forecast:
    """Forecast the errors of a model of one temperature, or of two, which are undefined without light of both.

    Parameters are those of `forecast`.
    """
    factor = nuisances.mean_factor if nuisances else 1.0
    # The flare as it is recorded.
    linear = factor * np.asarray(amplitudes, np.float64)[None]
    log_k = np.log(np.atleast_1d(temperature_k))
    single = model.single if isinstance(model, TwoTemperatures) else model
    counts = factor * model.counts(temperature_k, amplitudes)
    reduction = ReducedSums.of(single, expectation, counts, nuisances, skipped_nm, highest_dn=counts / min(1.0, factor))
    # The model with a second temperature held, and the response of the sums to it.
    flare, response, slopes = single, reduction, None
    if isinstance(model, TwoTemperatures):
        second, log_k = float(log_k[1]), log_k[:1]
        flare, response = model.at(second), reduction.with_second(second)
        slopes = model.slopes(second, reduction, log_k, linear)
    sums, factors = linear[0] @ np.vstack([response.spline(log_k), response.fixed]), np.array([factor])
    spread = covariance(flare, response, BestFit(log_k, linear, np.array([sums @ sums])), factors, slopes)[0]
    values = derived_values(flare, log_k, linear, factors)[0]
    return Forecast(flare.names, flare.units, values, np.sqrt(np.diag(spread)), spread, float(np.linalg.norm(sums)))


#: Number of second temperatures per node of the model, in steps of 0.6 %.
PER_NODE = 3
#: Steps between the temperatures that are tried first, and number of those in and next to an interval.
COARSE, TRIES = 36, 20


@dataclass(frozen=True, eq=False)
class TwoTemperatures:
    """Mean counts of a flare of two blackbodies with free temperatures."""

    single: FlareModel  # model of one blackbody, optionally with lines

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reported quantities."""
        return (*self.single.names, "second temperature", "second area")

    def counts(self, temperatures_k: Float, amplitudes: Sequence[float] | Float) -> Float:
        """Return the mean DN that a flare adds to each pixel, of the lower and the second temperature, (n_pixel,)."""
        lower, second = np.asarray(temperatures_k, np.float64)
        return self.at(float(np.log(second))).counts(float(lower), amplitudes)

    @property
    def _bolometric(self) -> scipy.interpolate.CubicSpline:
        """Bolometric flux of a blackbody of amplitude 1, and of other components."""
        spline = self.single.splines[self.single.names.index("flux bolometric")]
        assert spline is not None
        return spline

    def at(self, log_k: float) -> FlareModel:
        """Return a model of lower temperatures with a blackbody of a second temperature as another component."""
        single, end = self.single, nodes_below(self.single.log_k, log_k)

        def area(x: Float | float) -> Float:
            # The ratio of the flux at the telescope to that at the surface is proportional to the area.
            return np.asarray(self._bolometric(x)[..., 0] / np.exp(4 * x))

        def with_second(derived: DerivedQuantity, spline: scipy.interpolate.CubicSpline | None) -> DerivedQuantity:
            if derived.factors is None or spline is None:
                return derived
            return replace(derived, factors=np.insert(derived.factors[:end], 1, spline(log_k)[0], axis=1))

        kelvin = DerivedQuantity(
            "second temperature", "K", "temperature of the second blackbody", held=float(np.exp(log_k))
        )
        share = DerivedQuantity("second area", "", "area at the second temperature over that at the first",
                        ratio=area(log_k) / area(single.log_k[:end]), offset=0.0)  # fmt: skip
        return FlareModel(
            single.log_k[:end], single.hot[:end], np.vstack([single.hot_spline(log_k), single.fixed]),
            (single.linear[0], "second", *single.linear[1:]),
            (*map(with_second, single.derived, single.splines), kelvin, share),
        )  # fmt: skip

    def slopes(self, log_k: float, reduction: ReducedSums, lower: Float, linear: Float) -> Slopes:
        """Return derivatives with respect to a second log temperature of flares with lower ones, (n,), and amplitudes.

        The reduction is that of the model of one blackbody.
        """
        model, amplitude = self.at(log_k), linear[:, 1]
        quantities = np.zeros((amplitude.size, len(model.derived)))
        quantities[:, model.amplitude_sums[0]] = amplitude[:, None] * self.single.amplitude_sums[1](log_k, 1)[:, 0]
        quantities[:, -2] = np.exp(log_k)
        areas = derived_values(model, lower, linear, np.ones(1))[:, -1]
        quantities[:, -1] = areas * (self._bolometric(log_k, 1)[0] / self._bolometric(log_k)[0] - 4.0)
        light = np.zeros(1) if reduction.light is None else reduction.light.spline(log_k, 1)[0]
        return amplitude[:, None] * reduction.spline(log_k, 1), quantities, amplitude * light


@validated
def fit_two_temperatures(
    frames: RawCounts,
    expectation: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    levels: Sequence[Probability] = LEVELS,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> Measurement:
    """Fit a flare of two blackbodies with free temperatures to each exposure.

    Parameters
    ----------
    frames, expectation, nuisances, levels, skipped_nm
        As for `fit`.
    model : FlareModel
        Model of one blackbody, optionally with lines.

    Returns
    -------
    Measurement
        As for `fit`, with the lower temperature, and with amplitude, fluxes and areas of both blackbodies. The second
        temperature and the ratio of its area to that of the first follow. If a single blackbody fits best, estimates
        are those of `fit` with an undefined (NaN) second temperature of area 0, and errors from the curvature are
        undefined.

    Raises
    ------
    InputError
        For a model with a Balmer jump, and as for `fit`.
    """
    if any(derived.ratio is not None for derived in model.derived):
        raise InputError("the model must have blackbodies, with or without lines, and no Balmer jump", key="model")
    single = fit(frames, expectation, model, nuisances, levels=levels, skipped_nm=skipped_nm)
    exposures = _Exposures(frames, expectation, model, nuisances, levels, skipped_nm)
    measurements, order, two = [], [], TwoTemperatures(model)
    recorded = single.amplitudes * single.factor[:, None]
    for rows, reduction in exposures.groups(single.log_k, recorded, np.arange(len(recorded)), True):
        check_enough(expectation, reduction.variance > 0.0, len(model.linear) + 3 + reduction.n_free)
        quiescent = exposures.quiescent_chi2(reduction, rows)
        search = _SecondTemperatures(two, exposures.profile(reduction, rows), exposures.rises)
        low, high = search.intervals()
        best_node = search.gain.argmax(axis=1)
        # Exposures with the same best second temperature are measured together.
        for node in np.unique(best_node):
            alike, log_k = np.flatnonzero(best_node == node), float(search.grid[node])
            profile, ends = search.profile(int(node), alike), (low[:, alike], high[:, alike])
            best = replace(profile.best(profile.gain_at_nodes()), gain=search.gain[alike, node])
            second = log_k, two.slopes(log_k, reduction, best.log_k, best.linear)
            flare = two.at(log_k)
            measurements.append(exposures.measurement(flare, profile, best, quiescent[alike], ends, second))
            order.append(rows[alike])
    measured, n = Measurement.joined(measurements, order), len(recorded)
    # Without light of the other blackbody, the estimates are those of one.
    single_estimates = np.column_stack([single.estimates, np.full(n, np.nan), np.zeros(n)])
    absent = (measured.amplitudes[:, :2] <= 0.0).any(axis=1, keepdims=True)
    return replace(measured, estimates=np.where(absent, single_estimates, measured.estimates))


class _SecondTemperatures:
    """Largest gains of exposures with a common variance at second temperatures in and next to their intervals."""

    def __init__(self, model: TwoTemperatures, profile: Profile, rises: list[float]) -> None:
        """Take the exposures' profile for a single temperature, and the rises of chi-squared at ends of intervals."""
        self._model, self._single, self._rises = model, profile, rises
        log_k = profile.nodes
        #: Second log temperatures that may be tried, and the largest gain at each, minus infinity if not tried.
        self.grid = np.linspace(log_k[2 * APART], log_k[-1], PER_NODE * (log_k.size - 1 - 2 * APART) + 1)
        self.gain = np.full((len(profile.sums), self.grid.size), -np.inf)
        n, nodes = self.gain.shape
        selected = np.zeros((n, nodes), np.bool_)
        selected[:, ::COARSE] = True
        # Twice around the intervals, since the first one may be a single temperature.
        for margin in (COARSE, COARSE // 4, None):
            for node in np.flatnonzero(selected.any(axis=0)):
                rows = np.flatnonzero(selected[:, node] & np.isinf(self.gain[:, node]))
                if rows.size:
                    self.gain[rows, node] = self.profile(int(node), rows).best().gain
            if margin is not None:
                inside = self.gain >= self.gain.max(axis=1)[:, None] - max(rises)
                low = np.maximum(inside.argmax(axis=1) - margin, 0)
                high = np.minimum(nodes - 1 - inside[:, ::-1].argmax(axis=1) + margin, nodes - 1)
                selected[:] = False
                for share in np.linspace(0.0, 1.0, TRIES + 1):
                    selected[np.arange(n), np.rint(low + share * (high - low)).astype(np.intp)] = True

    def profile(self, node: int, rows: NDArray[np.intp]) -> Profile:
        """Return the profile of some exposures at a second temperature."""
        return self._single.bounded_rows(rows, self._single.reduction.with_second(float(self.grid[node])))

    def intervals(self) -> tuple[Float, Float]:
        """Return the ends of intervals, (n_level, n, n_derived): the outermost ones at all second temperatures."""
        gain = self.gain.max(axis=1)
        shape = len(self._rises), gain.size, len(self._model.names)
        lows, highs = np.full(shape, np.inf), np.full(shape, -np.inf)
        for node in np.flatnonzero((self.gain >= gain[:, None] - max(self._rises)).any(axis=0)):
            rows = np.flatnonzero(self.gain[:, node] >= gain - max(self._rises))
            profile, model = self.profile(int(node), rows), self._model.at(float(self.grid[node]))
            at_nodes = profile.gain_at_nodes()
            best = profile.best(at_nodes)
            for k, rise in enumerate(self._rises):
                inside = np.flatnonzero(best.gain >= gain[rows] - rise)
                if not inside.size:
                    continue
                numbers = rows[inside]
                # The rise is that above the best fit at all second temperatures.
                fits = BestFit(best.log_k[inside], best.linear[inside], gain[numbers])
                low, high = intervals(model, profile.bounded_rows(inside), fits, at_nodes[inside], rise)
                lows[k, numbers] = np.minimum(lows[k, numbers], low)
                highs[k, numbers] = np.maximum(highs[k, numbers], high)
        for k, n in np.ndindex(shape[:2]):
            # Ends of the second temperature, interpolated between the tried nodes.
            tried = np.isfinite(self.gain[n])
            x, over = self.grid[tried], np.sqrt(gain[n] - self.gain[n, tried]) - np.sqrt(self._rises[k])
            a, b = np.flatnonzero(over <= 0)[[0, -1]]
            lows[k, n, -2] = np.exp(np.interp(0.0, over[[a, a - 1]], x[[a, a - 1]])) if a > 0 else -np.inf
            highs[k, n, -2] = np.exp(np.interp(0.0, over[[b, b + 1]], x[[b, b + 1]])) if b < x.size - 1 else np.inf
        return lows, highs
