"""Fits of flares with two free temperatures.

At each second temperature, one of the model's, the flare is one blackbody with another component of fixed shape, so
that the rest is a fit of `results.measurements.nonnegative`. The second temperature is the higher one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.results.measurements.fit import LEVELS, Forecast, Measurement, checked_exposures, fit, variance_groups
from mauvecl.results.measurements.flare_model import Derived, FlareModel, derived_values
from mauvecl.results.measurements.light_factor import undimmed
from mauvecl.results.measurements.nonnegative import BoundedProfile, bounded_intervals
from mauvecl.results.measurements.profile import BestFit
from mauvecl.results.measurements.reduction import Ranges, Reduction, check_enough
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import Probability, Wavelength

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.statistics.nuisances import Nuisances

Float = NDArray[np.float64]

#: Number of second temperatures per node of the model, in steps of 0.6 %.
PER_NODE = 3
#: Steps between the temperatures that are tried first, and number of those in and next to an interval.
COARSE, TRIES = 36, 20
#: Smallest number of nodes between the two temperatures; closer temperatures cannot be distinguished.
APART = 4


@dataclass(frozen=True, eq=False)
class TwoTemperatures:
    """Mean counts of a flare of two blackbodies with free temperatures."""

    single: FlareModel  # model of one blackbody, optionally with lines

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reported quantities."""
        return (*self.single.names, "second temperature", "second area")

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the reported quantities."""
        return (*self.single.units, "K", "")

    @property
    def bounds(self) -> tuple[float, ...]:
        """Smallest possible values of the reported quantities."""
        return (*self.single.bounds, -np.inf, 0.0)

    def counts(self, temperatures_k: Float, amplitudes: Sequence[float] | Float) -> Float:
        """Return the mean DN that a flare adds to each pixel, of the lower and the second temperature, (n_pixel,)."""
        lower, second = np.asarray(temperatures_k, np.float64)
        return with_second(self.single, float(np.log(second))).counts(float(lower), amplitudes)


@validated
def fit_two_temperatures(
    frames: ArrayLike,
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
        temperature and the ratio of its area to that of the first follow. Errors from the curvature are undefined if
        a single blackbody fits best.

    Raises
    ------
    InputError
        For a model with a Balmer jump, and as for `fit`.
    """
    if any(one.ratio is not None for one in model.derived):
        raise InputError("a model with a Balmer jump", "blackbodies, with lines or without", key="model")
    single = fit(frames, expectation, model, nuisances, levels=levels, skipped_nm=skipped_nm)
    exposures = checked_exposures(frames, expectation, levels, nuisances)

    def reduction_of(added_dn: Float | None, **how: Any) -> Reduction:
        return Reduction.of(model, expectation, added_dn, nuisances, skipped_nm, **how)

    allowed = [float(scipy.stats.chi2.isf(1 - p, 1)) for p in levels]
    parts, order, whole = [], [], TwoTemperatures(model)
    recorded = single.amplitudes * single.factor[:, None]
    groups = variance_groups(expectation, model, single.log_k, recorded, reduction_of, nuisances, exposures)
    for rows, reduction in groups:
        sums, rest, light = exposures.sums_and_rest(reduction, rows)
        found = _Search(model, reduction, sums, allowed, light).measured()
        best, low, high, second, estimates, factor = found
        chi2 = rest + np.einsum("nk,nk->n", sums, sums) - best.gain
        dof = reduction.n_used - reduction.n_free - len(model.linear) - 3
        check_enough(expectation, reduction.variance > 0.0, len(model.linear) + 3 + reduction.n_free)
        covariance = _covariance(model, reduction, best, second, estimates, factor)
        parts.append(
            Measurement(
                whole.names, whole.units, whole.bounds, estimates, covariance, tuple(levels), low, high, chi2,
                np.asarray(scipy.stats.chi2.sf(chi2, dof)), dof, np.sqrt(best.gain),
                np.column_stack([best.log_k, second]), undimmed(best.linear, factor), factor,
            )
        )  # fmt: skip
        order.append(rows)
    return Measurement.joined(parts).rows(np.argsort(np.concatenate(order)))


def forecast_two_temperatures(
    expectation: Expectation,
    model: FlareModel,
    temperatures_k: Float,
    amplitudes: Float,
    nuisances: Nuisances | None = None,
    skipped_nm: Ranges = (),
) -> Forecast:
    """Return the errors with which a flare of two temperatures will be measured, as `forecast`.

    Undefined where one of the blackbodies adds no light.
    """
    factor = nuisances.mean_factor if nuisances else 1.0
    whole, log_k, linear = TwoTemperatures(model), np.log(temperatures_k), factor * np.asarray(amplitudes)[None]
    counts = whole.counts(temperatures_k, linear[0])
    reduction = Reduction.of(model, expectation, counts, nuisances, skipped_nm, highest_dn=counts / min(1.0, factor))
    values = derived_values(with_second(model, float(log_k[1])), log_k[:1], linear / factor)
    values = np.insert(values, -1, temperatures_k[1], axis=1)
    sums = linear[0] @ np.vstack([reduction.spline(log_k), reduction.fixed])
    best = BestFit(log_k[:1], linear, np.array([sums @ sums]))
    spread = _covariance(model, reduction, best, log_k[1:], values, np.array([factor]))[0]
    errors = np.sqrt(np.diag(spread))
    return Forecast(whole.names, whole.units, values[0], errors, spread, float(np.linalg.norm(sums)))


def with_second(model: FlareModel, log_k: float) -> FlareModel:
    """Return a model of lower temperatures with a blackbody of a second temperature as another component."""
    end = _lower(model.log_k, log_k)
    bolometric = model.splines[model.names.index("flux bolometric")]
    assert bolometric is not None

    def area(x: Float | float) -> Float:
        # The ratio of the flux at the telescope to that at the surface is proportional to the area.
        return np.asarray(bolometric(x)[..., 0] / np.exp(4 * x))

    def both(one: Derived, spline: scipy.interpolate.CubicSpline | None) -> Derived:
        if one.factors is None or spline is None:
            return one
        return replace(one, factors=np.insert(one.factors[:end], 1, spline(log_k)[0], axis=1))

    share = Derived("second area", "", "area at the second temperature over that at the first",
                    ratio=area(log_k) / area(model.log_k[:end]), offset=0.0)  # fmt: skip
    return FlareModel(
        model.log_k[:end], model.hot[:end], np.vstack([model.hot_spline(log_k), model.fixed]),
        (model.linear[0], "second", *model.linear[1:]),
        (*map(both, model.derived, model.splines), share),
    )  # fmt: skip


def _lower(nodes: Float, log_k: float) -> int:
    """Return the number of nodes that are at least `APART` nodes below a temperature."""
    return int(np.searchsorted(nodes, log_k - APART * (nodes[1] - nodes[0]) + 1e-9))


class _Search:
    """Fit of exposures with a common variance over second temperatures."""

    def __init__(
        self, model: FlareModel, reduction: Reduction, sums: Float, allowed: list[float], light: Float | None
    ) -> None:
        self._model, self._reduction, self._sums, self._allowed = model, reduction, sums, allowed
        self._light = light
        first, last = model.log_k[2 * APART], model.log_k[-1]
        #: Second log temperatures that may be tried.
        self._grid = np.linspace(first, last, PER_NODE * (model.log_k.size - 1 - 2 * APART) + 1)
        self._gain = np.full((len(sums), self._grid.size), -np.inf)

    def _profile(self, node: int, rows: NDArray[np.intp]) -> BoundedProfile:
        r, end = self._reduction, _lower(self._reduction.log_k, self._grid[node])
        second = float(self._grid[node])
        fixed = np.vstack([r.spline(second), r.fixed])
        factor = None if r.light is None else r.light.with_second(second, end)
        own = replace(r, hot=r.hot[:end], fixed=fixed, log_k=r.log_k[:end], light=factor)
        return BoundedProfile(own, self._sums[rows], None if self._light is None else self._light[rows])

    def _evaluate(self, wanted: NDArray[np.bool_]) -> None:
        """Compute the largest gain at second temperatures, (n, n_node)."""
        for node in np.flatnonzero(wanted.any(axis=0)):
            rows = np.flatnonzero(wanted[:, node] & np.isinf(self._gain[:, node]))
            if rows.size:
                self._gain[rows, node] = self._profile(int(node), rows).best().gain

    def measured(self) -> tuple[BestFit, Float, Float, Float, Float, Float]:
        """Return best fits, intervals (n_level, n, n_derived), second log temperatures, estimates, and factors."""
        n, nodes = self._gain.shape
        coarse = np.zeros((n, nodes), np.bool_)
        coarse[:, ::COARSE] = True
        self._evaluate(coarse)
        # Twice, since the first interval may be a single temperature.
        for margin in (COARSE, COARSE // 4):
            inside = self._gain >= self._gain.max(axis=1)[:, None] - max(self._allowed)
            low = np.maximum(inside.argmax(axis=1) - margin, 0)
            high = np.minimum(nodes - 1 - inside[:, ::-1].argmax(axis=1) + margin, nodes - 1)
            fine = np.zeros((n, nodes), np.bool_)
            for share in np.linspace(0.0, 1.0, TRIES + 1):
                fine[np.arange(n), np.rint(low + share * (high - low)).astype(np.intp)] = True
            self._evaluate(fine)
        best_node = self._gain.argmax(axis=1)
        gain = self._gain.max(axis=1)
        q = len(self._model.derived) + 2
        lows, highs = np.full((len(self._allowed), n, q), np.inf), np.full((len(self._allowed), n, q), -np.inf)
        log_k, linear = np.empty(n), np.empty((n, len(self._model.linear) + 1))
        estimates, factor = np.empty((n, q)), np.ones(n)
        for node in np.flatnonzero((self._gain >= gain[:, None] - max(self._allowed)).any(axis=0)):
            rows = np.flatnonzero(self._gain[:, node] >= gain - max(self._allowed))
            profile, model = self._profile(int(node), rows), with_second(self._model, float(self._grid[node]))
            at_nodes = profile.gain_at_nodes()
            own = profile.best(at_nodes)
            here = np.flatnonzero(best_node[rows] == node)
            log_k[rows[here]], linear[rows[here]] = own.log_k[here], own.linear[here]
            values = derived_values(model, own.log_k[here], own.linear[here])
            factor[rows[here]] = profile.factor(own.log_k, own.linear)[here]
            values[:, model.sums[0]] = undimmed(values[:, model.sums[0]], factor[rows[here]])
            estimates[rows[here]] = np.insert(values, q - 2, np.exp(self._grid[node]), axis=1)
            for k, one in enumerate(self._allowed):
                there = np.flatnonzero(own.gain >= gain[rows] - one)
                if not there.size:
                    continue
                some = self._profile(int(node), rows[there])
                limit = BestFit(own.log_k[there], own.linear[there], gain[rows[there]])
                ends = bounded_intervals(model, some, limit, at_nodes[there], one)
                for found, end, which in ((lows, ends[0], np.minimum), (highs, ends[1], np.maximum)):
                    columns = np.delete(np.arange(q), q - 2)
                    found[k][np.ix_(rows[there], columns)] = which(found[k][np.ix_(rows[there], columns)], end)
        for k, one in enumerate(self._allowed):
            lows[k, :, q - 2], highs[k, :, q - 2] = self._second_ends(gain, one)
        best = BestFit(log_k, linear, gain)
        return best, lows, highs, self._grid[best_node], estimates, factor

    def _second_ends(self, gain: Float, allowed: float) -> tuple[Float, Float]:
        """Return the ends of the second temperature's interval, interpolated between the tried nodes."""
        low, high = np.full(gain.size, -np.inf), np.full(gain.size, np.inf)
        for k in range(gain.size):
            tried = np.flatnonzero(np.isfinite(self._gain[k]))
            root = np.sqrt(np.maximum(gain[k] - self._gain[k, tried], 0.0)) - np.sqrt(allowed)
            inside = np.flatnonzero(root <= 0)
            x = self._grid[tried]
            a, b = inside[0], inside[-1]
            if a > 0:
                low[k] = np.exp(np.interp(0.0, [root[a], root[a - 1]], [x[a], x[a - 1]]))
            if b < tried.size - 1:
                high[k] = np.exp(np.interp(0.0, [root[b], root[b + 1]], [x[b], x[b + 1]]))
        return low, high


def _covariance(
    model: FlareModel, reduction: Reduction, best: BestFit, second: Float, estimates: Float, factor: Float
) -> Float:
    """Return the covariance of quantities, (n, n_derived + 2, n_derived + 2), from the Fisher information."""
    n, m = best.linear.shape
    a, b = best.linear[:, 0], best.linear[:, 1]
    columns = [reduction.spline(best.log_k), reduction.spline(second)]
    columns += [np.tile(row, (n, 1)) for row in reduction.fixed]
    columns += [a[:, None] * reduction.spline(best.log_k, 1), b[:, None] * reduction.spline(second, 1)]
    jacobian = np.stack(columns, axis=1)
    over = np.where(factor > 0.0, factor, np.nan)
    gradient, by_factor = np.zeros((n, len(model.derived) + 2, m + 2)), np.zeros((n, len(model.derived) + 2))
    for q, (one, spline) in enumerate(zip(model.derived, model.splines, strict=True)):
        if spline is None or one.factors is None:
            gradient[:, q, m] = np.exp(best.log_k)
            continue
        here, there = spline(best.log_k), spline(second)
        gradient[:, q, 0], gradient[:, q, 1], gradient[:, q, 2:m] = here[:, 0], there[:, 0], here[:, 1:]
        gradient[:, q, m] = spline(best.log_k, 1)[:, 0] * a
        gradient[:, q, m + 1] = spline(second, 1)[:, 0] * b
        gradient[:, q] /= over[:, None]
        by_factor[:, q] = -estimates[:, q] / over
    gradient[:, -2, m + 1] = np.exp(second)
    with np.errstate(divide="ignore", invalid="ignore"):
        areas = estimates[:, -1]
        bolometric = model.splines[model.names.index("flux bolometric")]
        assert bolometric is not None
        slopes = [4.0 - bolometric(x, 1)[:, 0] / bolometric(x)[:, 0] for x in (best.log_k, second)]
        gradient[:, -1, 0], gradient[:, -1, 1] = -areas / a, areas / b
        gradient[:, -1, m], gradient[:, -1, m + 1] = areas * slopes[0], -areas * slopes[1]
    own = np.zeros((n, by_factor.shape[1], by_factor.shape[1]))
    if reduction.light is not None:
        light = reduction.light
        weights = [light.spline(best.log_k), light.spline(second), *(np.full(n, one) for one in light.fixed)]
        weights += [a * light.spline(best.log_k, 1), b * light.spline(second, 1)]
        gradient -= by_factor[:, :, None] * np.stack(weights, axis=1)[:, None, :] / light.scale
        own = by_factor[:, :, None] * by_factor[:, None, :] / light.scale**2
    information = np.einsum("nik,njk->nij", jacobian, jacobian)
    good = (best.linear > 0).all(axis=1)
    information[~good] = np.eye(m + 2)
    inverse = np.linalg.pinv(information, rcond=1e-14, hermitian=True)
    inverse[~good] = np.nan
    spread = np.einsum("nqi,nij,nrj->nqr", np.nan_to_num(gradient), inverse, np.nan_to_num(gradient))
    return np.asarray(spread + np.nan_to_num(own))
