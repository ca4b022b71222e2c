"""Joint fit of a flare's shape and spectrum along a stare, with a temperature that falls.

Frames are reduced to weighted sums that are sufficient for spectra of all temperatures (`results.measurements`). The
model of their means is one `Event` with `Cooling`. Their covariances depend on the fitted flare, so that each fit is
repeated with the covariances of the previous one. Unknown levels that are constant over the stare are marginalised
over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.lightcurve.flares.cooling import Cooling
from mauvecl.lightcurve.flares.events import Event
from mauvecl.lightcurve.flares.shapes import Shape, shape_of
from mauvecl.lightcurve.stares.frame_components import Components
from mauvecl.lightcurve.stares.measured_bins import checked_frames, known_strengths, less_known
from mauvecl.results.measurements.fit import LEVELS, Measurement
from mauvecl.results.measurements.profile import Profile
from mauvecl.results.measurements.reduction import Reduction
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import Duration, Moment, Probability

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.results.measurements.flare_model import FlareModel
    from mauvecl.statistics.nuisances import Nuisances

Float = NDArray[np.float64]

#: Parameters, all but the first as logarithms; the temperature at the end is relative to that at the peak.
PARAMETERS = ("peak time", "half width", "amplitude", "temperature", "end temperature", "cooling time")
#: Number of fits after the first, each with the covariances of the previous fit.
REFITS = 3
#: Reach of the search for the end of an interval, in standard errors.
REACH = 12.0
#: Smallest standard error, relative or in s, of a parameter that the frames constrain.
NO_STEP = 1e-9
#: Relative step of numerical derivatives.
DIFFERENCE = 1e-5


@dataclass(frozen=True, eq=False)
class _Data:
    """Sums of frames less their known means, and their covariances."""

    sums: Float  # shape (n_frame, n_sum)
    edges: Float  # starts and ends of frames, s, shape (n_frame, 2)
    light: Float  # known factors on the light of the flare, shape (n_frame,)
    quiet_covariance: Float  # shape (n_frame, n_sum, n_sum)
    unknown: Float  # sums of unknown levels, shape (n_unknown, n_sum)
    prior: Float  # their standard deviations
    reduction: Reduction
    model: FlareModel
    gain: Float
    shape: Shape

    @cached_property
    def spread(self) -> scipy.interpolate.CubicSpline:
        """Covariance that a blackbody of amplitude 1 adds, over log temperature."""
        weights = self.reduction.weights
        added = np.einsum("ip,jp,tp->tij", weights, weights, self.model.hot * self.gain, optimize=True)
        return scipy.interpolate.CubicSpline(self.model.log_k, added)

    def strengths(self, theta: Float) -> tuple[Float, Float]:
        """Return the amplitude and log temperature of each frame."""
        peak, (width, amplitude, kelvin, end, fold) = theta[0], np.exp(theta[1:])
        rise = amplitude * self.light * self.shape.mean_over(self.edges, peak, width)
        # As that of `Cooling`, within the temperatures of the model.
        end = min(end, 1.0)
        cooled = end + (1.0 - end) * np.exp(-np.maximum(self.edges.mean(axis=1) - peak, 0.0) / fold)
        return rise, np.clip(np.log(kelvin * cooled), self.model.log_k[0], self.model.log_k[-1])

    def mean(self, theta: Float) -> Float:
        """Return the mean sums of the flare, shape (n_frame, n_sum)."""
        rise, log_k = self.strengths(theta)
        return np.asarray(rise[:, None] * self.reduction.spline(log_k))

    def whitening(self, theta: Float | None) -> tuple[Float, Float]:
        """Return inverse Cholesky factors of the frames' covariances, and an orthonormal basis of unknown levels."""
        covariance = self.quiet_covariance
        if theta is not None:
            rise, log_k = self.strengths(theta)
            covariance = covariance + rise[:, None, None] * self.spread(log_k)
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        if not len(self.unknown):
            return inverse, np.zeros((0, self.sums.size))
        spectra = np.einsum("tij,uj->tiu", inverse, self.unknown).reshape(self.sums.size, -1)
        # The prior acts as one more datum, which is not among the residuals because its mean is zero.
        scale = np.linalg.cholesky(spectra.T @ spectra + np.diag(self.prior**-2.0))
        return inverse, np.linalg.solve(scale, spectra.T)

    def residuals(self, theta: Float, whitening: tuple[Float, Float]) -> Float:
        """Return residuals whose squares add up to chi-squared with the unknown levels marginalised over."""
        inverse, basis = whitening
        left = np.einsum("tij,tj->ti", inverse, self.sums - self.mean(theta)).ravel()
        if not len(basis):
            return np.asarray(left)
        # I - B^T B = (I - B^T K B)^2, with K from the eigenvalues of B B^T.
        values, vectors = np.linalg.eigh(basis @ basis.T)
        kept = values > 1e-12
        directions = vectors[:, kept].T @ basis / np.sqrt(values[kept])[:, None]
        shrink = 1.0 - np.sqrt(np.maximum(1.0 - values[kept], 0.0))
        return np.asarray(left - (shrink * (directions @ left)) @ directions)


class CoolingCourse(NamedTuple):
    """A flare in the quantities of a fit, and frame by frame, added up over the pixels that are used."""

    values: Float  # shape (n_derived,)
    drawn_dn: Float  # of the frames less their known mean without a flare, shape (n_frame,)
    mean_dn: Float  # of the flare
    kelvin: Float


@validated
def fit_cooling(
    frames: ArrayLike,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    peak_s: Moment,
    half_width_s: Duration,
    shape: Shape | str = "davenport2014",
    cooling: bool = True,
    stare: Stare | None = None,
    levels: Sequence[Probability] = LEVELS,
) -> Measurement:
    """Fit the shape of one flare and a blackbody whose temperature falls to all frames of a stare together.

    Parameters
    ----------
    frames : array_like, shape (n_frame, n_pixel)
        Raw DN of single frames.
    quiet : Expectation
        One frame of the quiescent star.
    model : FlareModel
        A blackbody, of one frame.
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra, for one frame; they are constant over the stare.
    peak_s, half_width_s : float
        Starting point of the fit, such as the result of a search.
    shape : Shape or str
    cooling : bool
        Whether the temperature falls after the peak, as in `Cooling`; constant otherwise.
    stare : Stare, optional
        Times and known conditions of the frames; frames without gaps and changes by default.
    levels : sequence of float
        Nominal coverage of the intervals, by profile likelihood.

    Returns
    -------
    Measurement
        One row with peak time, half-width, amplitude, and temperature at the peak; with `cooling`, also the final
        temperature and the cooling time; fluences within the frames, and energies if the model has a distance.
        Chi-squared is that of the frames' sums.

    Raises
    ------
    InputError
        If the frames have another shape, the model has a jump or lines, or the stare contains no light of the flare.
    """
    if len(model.linear) > 1:
        raise InputError(f"a model of {', '.join(model.linear)}", "a blackbody alone", key="model", value=model.linear)
    raw, stare = checked_frames(frames, quiet, stare)
    data = _data(raw, quiet, model, nuisances, stare, shape_of(shape))
    free = np.arange(len(PARAMETERS) if cooling else 4)
    low, high = _limits(model, stare)
    theta = np.clip(_start(data, peak_s, half_width_s, cooling), low, high)
    whitening = data.whitening(None)
    for _ in range(REFITS):
        theta = _solve(data, whitening, theta, free, low, high)
        whitening = data.whitening(theta)
    theta = _solve(data, whitening, theta, free, low, high)

    def chi2_of(theta: Float) -> float:
        return float(np.sum(data.residuals(theta, whitening) ** 2))

    best = chi2_of(theta)
    jacobian = _derivative(lambda x: data.residuals(x, whitening), theta, free)
    covariance = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    quantities = _quantities(data, stare, cooling)
    slopes = _derivative(lambda x: np.array([value(x) for _, _, value, _ in quantities]), theta, free)
    spread = slopes @ covariance @ slopes.T
    estimates = np.array([float(value(theta)) for _, _, value, _ in quantities])
    ends = np.full((2, len(levels), len(quantities)), np.nan)
    names = [name for name, *_ in quantities]
    for q, (name, _, value, place) in enumerate(quantities):
        if name.startswith("energy"):
            fluence = names.index(name.replace("energy", "fluence"))
            ends[:, :, q] = estimates[q] / estimates[fluence] * ends[:, :, fluence]
            continue
        for side, sign in enumerate((-1.0, 1.0)):
            for k, level in enumerate(levels):
                allowed = best + float(scipy.stats.chi2.isf(1.0 - level, 1))
                step = sign * float(np.sqrt(spread[q, q])) / max(abs(float(value(theta))) if place else 1.0, 1e-300)
                ends[side, k, q] = _end(data, whitening, theta, free, (low, high), value, place, step, allowed)
    dof = data.sums.size - free.size - int(np.isinf(data.prior).sum())
    empty = np.full(theta.shape, -np.inf)
    none = float(np.sum(data.residuals(np.where(np.arange(theta.size) == 2, empty, theta), whitening) ** 2))
    return Measurement(
        tuple(names), tuple(q[1] for q in quantities), (-np.inf,) + (0.0,) * (len(quantities) - 1),
        estimates[None], spread[None], tuple(levels), ends[0][:, None], ends[1][:, None], np.array([best]),
        np.array([float(scipy.stats.chi2.sf(best, dof))]), dof, np.array([np.sqrt(max(none - best, 0.0))]),
        theta[3:4], np.exp(theta[2:3])[None],
    )  # fmt: skip


def cooling_course(
    event: Event, found: Measurement, frames: Float, quiet: Expectation, model: FlareModel, stare: Stare
) -> CoolingCourse:
    """Return what a flare is in the quantities of a fit, and in each frame; parameters as for `fit_cooling`."""
    data = _data(frames, quiet, model, None, stare, event.form)
    cooling = event.temperature
    if not isinstance(cooling, Cooling):
        cooling = Cooling(cooling, cooling, stare.frame_s)
    logs = np.log([event.half_width_s, event.amplitude, cooling.peak_k, cooling.end_k / cooling.peak_k, cooling.fold_s])
    theta = np.array([event.peak_s, *logs])
    values = {name: value(theta) for name, _, value, _ in _quantities(data, stare, cooling=True)}
    rise, log_k = data.strengths(theta)
    used = (data.reduction.variance > 0).astype(np.float64)
    return CoolingCourse(
        np.array([values[name] for name in found.names]),
        less_known(frames, quiet, known_strengths(stare, quiet), used[None])[:, 0],
        rise * (model.hot_spline(log_k) @ used),
        np.exp(log_k),
    )


def cooling_event(found: Measurement, shape: Shape) -> Event:
    """Return the flare that `fit_cooling` found."""
    best = dict(zip(found.names, found.estimates[0].tolist(), strict=True))
    kelvin: float | Cooling = best["temperature"]
    if "cooling time" in best:
        kelvin = Cooling(best["temperature"], min(best["end temperature"], best["temperature"]), best["cooling time"])
    return Event(best["peak time"], best["half width"], best["amplitude"], kelvin, shape)


def _data(
    raw: Float, quiet: Expectation, model: FlareModel, nuisances: Nuisances | None, stare: Stare, shape: Shape
) -> _Data:
    # The unknowns are parameters of the stare, so the weights of single frames do not remove them.
    reduction = Reduction.of(model, quiet)
    weights, strengths = reduction.weights, known_strengths(stare, quiet)
    sums = less_known(raw, quiet, strengths, weights)
    constant, each = Components(quiet, np.zeros((0, weights.shape[1])), weights).sum_cumulants(2)
    covariance = constant + np.tensordot(strengths, each, 1)
    edges = np.column_stack([stare.start_s, stare.start_s + stare.frame_s])
    unknown = np.zeros((0, len(weights))) if nuisances is None else nuisances.spectra @ weights.T
    prior = np.zeros(0) if nuisances is None else np.asarray(nuisances.sd, np.float64)
    gain = np.asarray(quiet.gain_dn_per_electron) * np.ones(weights.shape[1])
    return _Data(sums, edges, strengths[:, 3], covariance, unknown, prior, reduction, model, gain, shape)


def _start(data: _Data, peak_s: float, half_width_s: float, cooling: bool) -> Float:
    """Return starting parameters: the best amplitude and temperature at the given peak and half-width."""
    rise = data.light * data.shape.mean_over(data.edges, peak_s, half_width_s)
    power = float(np.sqrt(np.sum(rise**2)))
    if not power > 0.0:
        raise InputError.of("peak_s", peak_s, "the peak of a flare with light in the stare")
    best = Profile(data.reduction, (rise @ data.sums / power)[None]).best()
    amplitude = max(float(best.linear[0, 0]) / power, 1e-6)
    # Somewhat hotter at the peak than on average, if it cools.
    first, last = (0.1, -0.3) if cooling else (0.0, 0.0)
    return np.array(
        [peak_s, np.log(half_width_s), np.log(amplitude), best.log_k[0] + first, last, np.log(2.0 * half_width_s)]
    )


def _limits(model: FlareModel, stare: Stare) -> tuple[Float, Float]:
    frame, whole = stare.frame_s, float(stare.start_s[-1] - stare.start_s[0]) + stare.frame_s
    first = float(stare.start_s[0])
    coolest, hottest = float(model.log_k[0]), float(model.log_k[-1])
    low = np.array([first - whole, np.log(0.1 * frame), np.log(1e-9), coolest + 1e-9, coolest - hottest, np.log(frame)])
    high = np.array([first + 2 * whole, np.log(whole), np.log(1e9), hottest - 1e-9, 0.0, np.log(100 * whole)])
    return low, high


def _solve(
    data: _Data, whitening: tuple[Float, Float], theta: Float, free: NDArray[np.intp], low: Float, high: Float
) -> Float:
    """Return the least-squares parameters; fixed ones are unchanged."""
    scale = np.where(free == 0, np.exp(theta[1]), 1.0)

    def residuals(values: Float) -> Float:
        there = theta.copy()
        there[free] = values
        return data.residuals(there, whitening)

    start = np.clip(theta[free], low[free] + 1e-9, high[free] - 1e-9)
    found = scipy.optimize.least_squares(residuals, start, bounds=(low[free], high[free]), x_scale=scale)
    best = theta.copy()
    best[free] = found.x
    return best


def _derivative(function: Callable[[Float], Float], theta: Float, free: NDArray[np.intp]) -> Float:
    """Return the derivatives of a function with respect to the free parameters, shape (n, n_free)."""
    columns = []
    for k in free:
        step = np.zeros(theta.size)
        step[k] = DIFFERENCE * (np.exp(theta[1]) if k == 0 else 1.0)
        columns.append((function(theta + step) - function(theta - step)) / (2 * step[k]))
    return np.column_stack(columns)


def _quantities(data: _Data, stare: Stare, cooling: bool) -> list[tuple[str, str, Callable[[Float], float], int]]:
    """Return for each quantity its name, unit, function of the parameters, and the parameter that sets it."""
    found: list[tuple[str, str, Callable[[Float], float], int]] = [
        ("peak time", "s", lambda x: float(x[0]), 0),
        ("half width", "s", lambda x: float(np.exp(x[1])), 1),
        ("amplitude", "", lambda x: float(np.exp(x[2])), 2),
        ("temperature", "K", lambda x: float(np.exp(x[3])), 3),
    ]
    if cooling:
        found += [
            ("end temperature", "K", lambda x: float(np.exp(x[3] + x[4])), 4),
            ("cooling time", "s", lambda x: float(np.exp(x[5])), 5),
        ]
    for one, spline in zip(data.model.derived, data.model.splines, strict=True):
        kind, _, band = one.name.partition(" ")
        if kind not in ("flux", "energy") or spline is None:
            continue

        def total(
            theta: Float, spline: Any = spline, factor: float = stare.frame_s if kind == "flux" else 1.0
        ) -> float:
            rise, log_k = data.strengths(theta)
            return factor * float(np.sum(rise / np.where(data.light > 0, data.light, 1.0) * spline(log_k)[:, 0]))

        name, unit = (f"fluence {band}", "erg / cm2") if kind == "flux" else (one.name, one.unit)
        found.append((name, unit, total, 2))
    return found


def _end(
    data: _Data,
    whitening: tuple[Float, Float],
    theta: Float,
    free: NDArray[np.intp],
    limits: tuple[Float, Float],
    value: Callable[[Float], float],
    place: int,
    step: float,
    allowed: float,
) -> float:
    """Return the end of a profile interval on one side; infinite if chi-squared does not rise that far.

    The parameter `place` holds the quantity fixed: it is the quantity, or the amplitude if that is proportional to it.
    """
    rest = free[free != place]
    centre, there = value(theta), theta

    def held(log_factor: float, theta: Float) -> Float:
        """Return parameters with a changed quantity: by a difference for the peak, otherwise by a factor."""
        target = centre + log_factor if place == 0 else centre * np.exp(log_factor)
        moved = theta.copy()
        if place == 0:
            moved[0] = target
        elif place == 4:
            moved[4] = np.log(target) - moved[3]
        else:
            moved[place] += np.log(target / value(moved))
        return moved

    @cache  # a root is between values that have different signs, though refits start elsewhere
    def rise(log_factor: float) -> float:
        nonlocal there

        def residuals(values: Float) -> Float:
            trial = there.copy()
            trial[rest] = values
            trial = held(log_factor, trial)
            trial[4] = min(trial[4], 0.0)
            return data.residuals(trial, whitening)

        low, high = limits[0][rest], limits[1][rest]
        start = np.clip(there[rest], low + 1e-9, high - 1e-9)
        scale = np.where(rest == 0, np.exp(theta[1]), 1.0)
        found = scipy.optimize.least_squares(residuals, start, bounds=(low, high), x_scale=scale, xtol=1e-6, ftol=1e-8)
        there = there.copy()
        there[rest] = found.x
        return float(2 * found.cost - allowed)

    inner, outer = 0.0, step
    if abs(step) < NO_STEP:
        return float(np.copysign(np.inf, step))
    while rise(outer) < 0.0:
        inner, outer = outer, 1.7 * outer
        if abs(outer) > REACH * abs(step) or not limits[0][place] <= held(outer, theta)[place] <= limits[1][place]:
            return float(np.copysign(np.inf, step))
    there = theta
    found = scipy.optimize.brentq(rise, inner, outer, xtol=1e-3 * abs(step), rtol=1e-6)
    return float(centre + found if place == 0 else centre * np.exp(found))
