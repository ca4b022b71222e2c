"""Gaussian process of the quiescent light: rotation, granulation and red noise; and the progress of its fits.

The light without flares is a constant plus a Gaussian process whose covariance is a sum of celerite terms, so that all
computations take a time proportional to the number of frames (Foreman-Mackey et al. 2017, doi
10.3847/1538-3881/aa9332; 2018, doi 10.3847/2515-5172/aaaf6c). Terms are added as long as they lower the Bayesian
information criterion (Schwarz 1978, doi 10.1214/aos/1176344136).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from operator import itemgetter
from typing import Any, Literal, TypeVar

import numpy as np
import scipy

from mauvecl.host.arrays import Float
from mauvecl.schema.errors import InputError

Item = TypeVar("Item")
Kind = Literal["correlated", "smooth", "rotation", "sharp rotation"]

#: Largest number of values to which the parameters of a process are fitted; longer light curves are binned.
MAX_FITTED = 20_000
#: Largest number of terms.
MAX_TERMS = 3
#: Smallest number of values for each parameter of a process.
VALUES_PER_PARAMETER = 12
#: Standard deviation of the log noise about that of differences of neighbours (assumed), which the star changes too.
NOISE_PRIOR = 0.3
#: False-alarm probability of the highest peak of the periodogram below which rotation is fitted.
PERIODIC = 1e-3
#: Smallest period in steps between values, and largest as a share of the length of the light curve.
SHORTEST, LONGEST = 4.0, 1.0
#: Approximate numbers of frequencies of a periodogram: in the width of a peak, and in total.
PER_PEAK, MOST_FREQUENCIES = 5, 2**17
#: Period, as a share of the length, above which rotation is also searched in the residuals of a polynomial of a degree.
FEW_TURNS, DEGREE = 0.2, 8
#: Range of standard deviations of a term, in standard deviations of the noise of a value.
AMPLITUDES = (1e-2, 1e5)
#: Range of time scales of correlated and smooth terms: in steps between values, and in lengths of the light curve.
SCALES = (1.5, 3.0)
#: Quality factor of a smooth term, as of granulation (Foreman-Mackey et al. 2017).
SMOOTH_QUALITY = 2**-0.5
#: Number of values above which a process is fitted by `_score`, and not by `_descend`, which is slow for many.
MANY = 1000
#: Largest number of iterations of a fit, and the change of log likelihood at which it has converged.
ITERATIONS, CONVERGED = 80, 1e-3
#: Step of a parameter for the derivatives in `_descend`, and for the first ones in `_score`.
DESCENT_DIFFERENCE, FIRST_DIFFERENCE = 1e-8, 1e-5
#: Largest number of consecutive fits in `_descend`, and change of log likelihood below which no further one follows.
STARTS, SAME = 4, 0.5
#: Later step of a parameter in `_score`, in its standard errors, and the range of the step.
DIFFERENCE, DIFFERENCES = 1e-3, (1e-8, 1e-3)
#: Damping in `_score`, relative to the information: the least, the least after a step that fails, and the largest.
LEAST_DAMPING, DAMPING, MOST_DAMPING = 1e-6, 1e-2, 1e6
#: Largest change of a parameter in a step of `_score`, and changes of the log likelihood, over the expected one, below
#: which the damping rises and above which it falls.
LONGEST_STEP, DOUBTFUL, FAITHFUL = 1.0, 0.25, 0.75
#: Largest change of the logarithm of a period in a fit, and bounds of the parameters beyond the first two.
NEAR_PERIOD = 0.4
BOUNDS: dict[Kind, tuple[tuple[float, float], ...]] = {
    "correlated": (), "smooth": (), "rotation": ((0.6, 1e4), (1e-2, 1e3), (1e-3, 2.0)),
    "sharp rotation": ((0.6, 1e4), (0.05, 0.99)),
}  # fmt: skip
#: Number of harmonics of sharp rotation, and their first standard deviation over that of the harmonic before.
HARMONICS, EACH_HARMONIC = 6, 0.5
#: Penalty on these harmonics in addition to that on their parameters, so that only very strong evidence prefers them to
#: two harmonics (Kass & Raftery 1995, doi 10.1080/01621459.1995.10476572).
STRONG = 10.0
#: Largest number of values to which these harmonics are fitted before they replace two in a longer light curve.
MAX_TRIED = 5000
#: Share of the remaining analysis that a step counts as, where the number of steps is not known.
EACH = 0.07


class Steps:
    """Part of an analysis, which reports the share of the whole that is done.

    `report` is called with shares of the whole, which rise from `first` to `last`; it may raise to stop the work.
    """

    def __init__(self, report: Callable[[float], None] | None = None, first: float = 0.0, last: float = 1.0) -> None:
        self._report, self._first, self._last, self._done = report, first, last, 0.0

    def part(self, first: float, last: float) -> Steps:
        """Return the part between two shares of this one."""
        length = self._last - self._first
        return Steps(self._report, self._first + first * length, self._first + last * length)

    def step(self, share: float | None = None) -> None:
        """Report that a share of this part is done, or another step of an unknown number."""
        self._done = max(self._done, self._done + EACH * (1.0 - self._done) if share is None else share)
        if self._report is not None:
            self._report(self._first + self._done * (self._last - self._first))

    def track(self, items: Iterable[Item], total: int) -> Iterator[Item]:
        """Yield items, and report after the work on each."""
        for number, item in enumerate(items, 1):
            yield item
            self.step(min(number / total, 1.0))
        self.step(1.0)


#: Steps of work whose progress is not reported.
UNREPORTED = Steps()


@dataclass(frozen=True)
class ProcessTerm:
    """Term of a process, with the logarithms of its parameters.

    A correlated term has standard deviation and time scale, with covariances that fall exponentially; a smooth term has
    standard deviation and period of a critically damped oscillator; rotation has standard deviation, period, and
    quality factor, difference of quality factors and share of the first harmonic of celerite2's `RotationTerm`; sharp
    rotation, of light with narrow minima or maxima, is the sum of `HARMONICS` oscillators that last equally long, with
    standard deviation, period, quality factor of the first, and ratio of the standard deviations of neighbours.
    """

    kind: Kind
    parameters: tuple[float, ...]

    @property
    def sd(self) -> float:
        """Standard deviation, in the unit of the light curve."""
        return float(np.exp(self.parameters[0]))

    @property
    def scale_s(self) -> float:
        """Time scale or period."""
        return float(np.exp(self.parameters[1]))

    @property
    def rotates(self) -> bool:
        """True if the term is periodic."""
        return self.kind in ("rotation", "sharp rotation")

    def kernel(self) -> Any:
        """Return the covariance function as a term of celerite2."""
        from celerite2 import terms

        size, scale, *shape = np.exp(self.parameters)
        if self.kind == "correlated":
            return terms.RealTerm(a=size**2, c=1.0 / scale)
        if self.kind == "smooth":
            return terms.SHOTerm(sigma=size, rho=scale, Q=SMOOTH_QUALITY)
        if self.kind == "rotation":
            return terms.RotationTerm(sigma=size, period=scale, **dict(zip(("Q0", "dQ", "f"), shape, strict=True)))
        quality, ratio = shape
        sizes = ratio ** np.arange(float(HARMONICS))
        sizes *= size / np.linalg.norm(sizes)
        return terms.TermSum(*(terms.SHOTerm(sigma=sd, rho=scale / n, Q=n * quality) for n, sd in enumerate(sizes, 1)))


@dataclass(frozen=True)
class Process:
    """Gaussian process of the light without flares."""

    terms: tuple[ProcessTerm, ...]
    excess: float  # factor on the stated standard deviations of frames for which the process fits best
    bic: tuple[tuple[str, float], ...] = ()  # BIC of each combination of terms that was tried, less the smallest

    @property
    def name(self) -> str:
        """Name of the combination of terms."""
        return " + ".join((*(term.kind for term in self.terms), "white"))

    def kernel(self) -> Any:
        """Return the sum of the terms as a term of celerite2; one of zero variance if there are none.

        Raises InputError if celerite2 is not installed, which has no wheels for some machines.
        """
        try:
            from celerite2 import terms
        except ImportError as error:
            # It has no wheels for some machines.
            fault = "celerite2, which models the light of stars, is not installed; use pip install celerite2"
            raise InputError(fault, key="celerite2") from error
        return terms.TermSum(*(term.kernel() for term in self.terms)) if self.terms else terms.RealTerm(a=0.0, c=1.0)

    @property
    def shortest_s(self) -> float:
        """Shortest time in which a term changes by much of its standard deviation; infinite without terms."""
        turns = {"correlated": 0.5 / np.pi, "smooth": 1, "rotation": 2, "sharp rotation": HARMONICS}
        return min((term.scale_s / (2 * np.pi * turns[term.kind]) for term in self.terms), default=np.inf)

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters, with that of the noise."""
        return 1 + sum(len(term.parameters) for term in self.terms)

    @property
    def sd(self) -> float:
        """Standard deviation of the process, without the noise of frames."""
        return float(np.sqrt(sum(term.sd**2 for term in self.terms)))

    def describe(self, unit: float) -> str:
        """Return a description of the terms; `unit` is the light of the star, to which standard deviations relate."""
        words = {"correlated": "correlated noise", "smooth": "smooth variability"}
        return ", ".join(
            f"{words.get(term.kind, term.kind)} ({'period' if term.rotates else 'time scale'} {_time(term.scale_s)}, "
            f"{100 * term.sd / unit:.2g} % in the process)"
            for term in self.terms
        )

    def at(self, lags_s: Float) -> Float:
        """Return the covariance at time lags, shape of `lags_s`."""
        return np.asarray(self.kernel().get_value(np.abs(lags_s)))

    def times(self, time_s: Float, weights: Float) -> Float:
        """Return the covariance of the process at ascending times with its weighted sum at the same times."""
        return np.asarray(self.kernel().dot(time_s, np.zeros(time_s.size), weights)).reshape(time_s.shape)

    def covariance(self, time_s: Float, variance: Float) -> Covariance:
        """Return the covariance of values at ascending times, with the variance of each value's noise."""
        return Covariance(self.kernel(), time_s, variance)


def _time(seconds: float) -> str:
    """Format a time in a suitable unit."""
    for unit, size in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"


class Covariance:
    """Covariance of values of a process at ascending times with independent noise, factorised as L D L^T.

    The kernel is a term of celerite2, and the variance that of the noise of each value.
    """

    def __init__(self, kernel: Any, time_s: Float, variance: Float) -> None:
        from celerite2 import driver

        self._driver = driver
        self._time, noise = (np.ascontiguousarray(values, np.float64) for values in (time_s, variance))
        self._rates, diagonal, self._u, v = kernel.get_celerite_matrices(self._time, noise)
        # In place, as celerite2 does it.
        self._d, self._w = driver.factor(self._time, self._rates, diagonal, self._u, v, diagonal, v)
        if not (self._d > 0).all():
            raise np.linalg.LinAlgError("the covariance is not positive definite")
        self.log_variances = np.log(self._d)  # of the innovations
        self.log_determinant = float(self.log_variances.sum())

    def _solved_lower(self, values: Float) -> Float:
        out = np.array(values.reshape(len(values), -1), np.float64, order="C")
        return np.asarray(self._driver.solve_lower(self._time, self._rates, self._u, self._w, out, out))

    def solve(self, values: Float) -> Float:
        """Return the inverse times values, shape (n,) or (n, k)."""
        out = self._solved_lower(values) / self._d[:, None]
        solved = self._driver.solve_upper(self._time, self._rates, self._u, self._w, out, out)
        return np.asarray(solved).reshape(np.shape(values))

    def whitened(self, values: Float) -> Float:
        """Return the innovations of values, which are independent and of unit variance, shape (n,) or (n, k)."""
        return np.asarray(self._solved_lower(values) / np.sqrt(self._d)[:, None]).reshape(np.shape(values))

    def squared_norms(self, columns: Float, first: int, after: int) -> Float:
        """Return v^T C^-1 v of each column, shape (n_column,).

        Columns, which are overwritten, have values from time number `first` on. Innovations after the last value follow
        from the state of the recursion there: their sum of squares is a quadratic form of as many variables as the
        process has. Those more than `after` times later are neglected.
        """
        last = first + len(columns)
        rows, later = slice(first, last), slice(last, last + after)
        time, rates, solve = self._time, self._rates, self._driver.solve_lower
        innovations = solve(time[rows], rates, self._u[rows], self._w[rows], columns, columns)
        total = 0.0
        if last < time.size:
            # Innovations of each unit state.
            units = -self._u[later] * np.exp((time[last] - time[later, None]) * rates)
            units = solve(time[later], rates, self._u[later], self._w[later], units, units)
            state = (np.exp((time[rows, None] - time[last]) * rates) * self._w[rows]).T @ innovations
            total = np.einsum("jo,jo->o", state, (units / self._d[later, None]).T @ units @ state)
        return np.asarray((1.0 / self._d[rows]) @ np.square(innovations, out=innovations) + total)

    def coloured(self, white: Float) -> Float:
        """Return values of this covariance from innovations, shape (n,) or (n, k)."""
        out = np.array(white.reshape(len(white), -1), np.float64, order="C") * np.sqrt(self._d)[:, None]
        values = self._driver.matmul_lower(self._time, self._rates, self._u, self._w, out, np.array(out))
        return np.asarray(values).reshape(np.shape(white))


def level_fit(covariance: Covariance, values: Float) -> tuple[float, float, Float]:
    """Return the mean of values by generalised least squares, their log likelihood, and the innovations without it.

    The likelihood is integrated over a flat prior of the mean.
    """
    values, constant = covariance.whitened(np.column_stack([values, np.ones(values.size)])).T
    information = float(constant @ constant)
    mean = float(values @ constant) / information
    residual = values - mean * constant
    log_likelihood = -0.5 * (float(residual @ residual) + covariance.log_determinant + np.log(information))
    return mean, log_likelihood, residual


@dataclass(frozen=True, eq=False)
class BinnedLightCurve:
    """Light curve to which the parameters of a process are fitted."""

    time_s: Float
    values: Float
    variance: Float  # stated variance of each value
    step_s: float

    @property
    def span_s(self) -> float:
        """Length of the light curve."""
        return float(self.time_s[-1] - self.time_s[0]) + self.step_s

    @cached_property
    def noise(self) -> float:
        """Robust standard deviation of a value, from differences of neighbours."""
        steps = np.diff(self.values)
        near = np.diff(self.time_s) < 1.5 * self.step_s
        steps = steps[near] if near.any() else steps
        spread = 1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2.0)
        return spread if spread > 0 else float(np.std(self.values))

    @property
    def log_excess(self) -> float:
        """Logarithm of this noise over the typical stated one."""
        return float(np.log(max(self.noise / float(np.sqrt(np.median(self.variance))), 1e-6)))

    def binned(self, largest: int = MAX_FITTED) -> BinnedLightCurve:
        """Average consecutive values so that at most `largest` remain; bins hold half of their frames at least."""
        factor = -(-self.time_s.size // largest)
        if factor == 1:
            return self
        step_s = factor * self.step_s
        number = np.floor((self.time_s - self.time_s[0]) / step_s + 0.5 / factor).astype(np.int64)
        _, first, count = np.unique(number, return_index=True, return_counts=True)
        full = count >= factor / 2
        totals = np.add.reduceat([self.time_s, self.values, self.variance], first, axis=1)[:, full]
        time_s, values, variance = totals / np.array([count[full], count[full], count[full] ** 2])
        return BinnedLightCurve(time_s, values, variance, step_s)


def criterion_of_process(process: Process, data: BinnedLightCurve, size: float) -> float:
    """Return the Bayesian information criterion of a process, of which a parameter costs `size`."""
    covariance = process.covariance(data.time_s, data.variance * process.excess**2)
    return process.n_parameters * size - 2 * level_fit(covariance, data.values)[1]


def fit_process(data: BinnedLightCurve, start: Process | None = None, steps: Steps = UNREPORTED) -> Process:
    """Fit a process to a light curve without flares; the terms of `start`, of nearly the same data, are kept.

    `steps` reports each combination of terms.
    """
    if start is not None:
        return replace(_fit_terms(data, start.terms, float(np.log(start.excess)))[0], bic=start.bic)
    best, value = _fit_terms(data, (), data.log_excess)
    tried = {best.name: value}
    while len(best.terms) < MAX_TERMS:
        size, options = best.n_parameters, []
        for terms in _starting_terms(data, best):
            if (size + sum(len(term.parameters) for term in terms)) * VALUES_PER_PARAMETER <= data.values.size:
                process, bic = _fit_terms(data, (*best.terms, *terms), data.log_excess)
                options.append((process, bic))
                # A combination has several starting points.
                tried[process.name] = min(bic, tried.get(process.name, np.inf))
                steps.step()
        better, lowest = min(options, key=itemgetter(1), default=(best, np.inf))
        if not lowest < value:
            break
        best, value = better, lowest
        if best.terms[-1].kind == "rotation" and (sharp := _sharpen(data, best)) is not None:
            tried[sharp[0].name] = sharp[1]
            best, value = min((best, value), sharp, key=itemgetter(1))
    return replace(best, bic=tuple((name, bic - value) for name, bic in tried.items()))


def _sharpen(data: BinnedLightCurve, process: Process) -> tuple[Process, float] | None:
    """Return a process whose last term, rotation, has more harmonics, and its BIC; None if they do not fit better."""
    size, period, quality, *_ = process.terms[-1].parameters
    sharp = ProcessTerm("sharp rotation", (size, period, quality, float(np.log(EACH_HARMONIC))))
    terms, log_excess = (*process.terms[:-1], sharp), float(np.log(process.excess))
    coarse = data.binned(MAX_TRIED)
    fitted, bic = _fit_terms(coarse, terms, log_excess)
    if coarse is not data:
        if bic + STRONG >= _fit_terms(coarse, process.terms, log_excess)[1]:
            return None
        fitted, bic = _fit_terms(data, fitted.terms, log_excess)
    return fitted, bic + STRONG


def _starting_terms(data: BinnedLightCurve, best: Process) -> Iterator[tuple[ProcessTerm, ...]]:
    """Yield starting points of a further term, or of rotation with a slower change of the light."""
    covariance = best.covariance(data.time_s, data.variance * best.excess**2)
    spread = max(float(np.std(data.values - level_fit(covariance, data.values)[0])), data.noise)
    rotates = any(term.rotates for term in best.terms)
    low, high = SCALES[0] * data.step_s, SCALES[1] * data.span_s
    for scale in (6 * data.step_s, float(np.sqrt(low * high))):
        size = data.noise if rotates else spread
        yield (ProcessTerm("correlated", (np.log(size), np.log(np.clip(scale, low, high)))),)
    if rotates:
        return
    smooth = ProcessTerm("smooth", (np.log(spread), np.log(0.2 * data.span_s)))
    yield (smooth,)
    if (period := _find_period(data, data.values, LONGEST)) is None:
        return
    for factor in (1.0, 2.0):
        yield (_rotation(spread, factor * period),)
    if not best.terms and period > FEW_TURNS * data.span_s:
        # Beside changes as long as the light curve, rotation is not the highest peak.
        slow = np.polynomial.Polynomial.fit(data.time_s, data.values, DEGREE)(data.time_s)
        if (faster := _find_period(data, data.values - slow, FEW_TURNS)) is not None:
            yield smooth, _rotation(spread, faster)


def _rotation(size: float, period: float) -> ProcessTerm:
    """Return the starting point of rotation."""
    return ProcessTerm("rotation", tuple(np.log([size, period, 10.0, 1.0, 0.3]).tolist()))


def _find_period(data: BinnedLightCurve, values: Float, share: float) -> float | None:
    """Return the period of the highest peak of a Lomb-Scargle periodogram in seconds, or None if it is noise.

    The values may be residuals of the data; `share` is the longest period over the length of the data.
    """
    from astropy.timeseries import LombScargle

    # Visits over years have few frames and many frequencies.
    longest = share * data.span_s
    shortest = max(SHORTEST * data.step_s, PER_PEAK * data.span_s / MOST_FREQUENCIES)
    if values.size < 30 or longest <= shortest:
        return None
    periodogram = LombScargle(data.time_s, values - values.mean())
    ends = {"minimum_frequency": 1 / longest, "maximum_frequency": 1 / shortest}
    frequency, power = periodogram.autopower(**ends, samples_per_peak=PER_PEAK, method="fast")
    if not power.size or not np.isfinite(power).all():
        return None
    best = int(np.argmax(power))
    chance = float(periodogram.false_alarm_probability(power[best], maximum_frequency=1 / shortest))
    return float(1.0 / frequency[best]) if chance < PERIODIC else None


def _fit_terms(data: BinnedLightCurve, terms: tuple[ProcessTerm, ...], log_excess: float) -> tuple[Process, float]:
    """Return the process of some terms that fits best, and its BIC."""
    expected = data.log_excess
    start = np.array([log_excess, *(value for term in terms for value in term.parameters)])
    bounds: list[Any] = [(log_excess - 3.0, log_excess + 3.0)]
    shortest = np.log(SHORTEST * data.step_s)
    for term in terms:
        scale, period = (SCALES[0] * data.step_s, SCALES[1] * data.span_s), term.parameters[1]
        around = (max(period - NEAR_PERIOD, shortest), period + NEAR_PERIOD) if term.rotates else np.log(scale)
        bounds += [np.log(data.noise) + np.log(AMPLITUDES), around, *np.log(BOUNDS[term.kind])]
    low, high = np.array(bounds).T
    places = [*pairwise(accumulate([1, *(len(term.parameters) for term in terms)]))]

    def process_of(x: Float) -> Process:
        values = x.tolist()
        fitted = [ProcessTerm(term.kind, tuple(values[i:j])) for term, (i, j) in zip(terms, places, strict=True)]
        return Process(tuple(fitted), float(np.exp(x[0])))

    def cost(x: Float) -> float:
        covariance = _covariance_of(process_of(x), data)
        if covariance is None:
            return 1e25
        value = 0.5 * ((x[0] - expected) / NOISE_PRIOR) ** 2 - level_fit(covariance, data.values)[1]
        return value if np.isfinite(value) else 1e25

    x, size = np.clip(start, low, high), start.size * float(np.log(data.values.size))
    if data.values.size > MANY:
        x, value = _score(lambda x: _innovations(process_of(x), data), x, low, high)
    else:
        x, value = _descend(cost, x, low, high)
    return process_of(x), 2 * value + size


def _descend(cost: Callable[[Float], float], x: Float, low: Float, high: Float) -> tuple[Float, float]:
    """Return the parameters within bounds at which a quasi-Newton method ends, and their cost."""

    def cost_and_slopes(x: Float) -> tuple[float, Float]:
        # These are scipy's differences, whose checks would take as long as a cost.
        value, moved = cost(x), _moved(x, DESCENT_DIFFERENCE, high)
        return value, (np.array([cost(row) for row in moved]) - value) / (np.diag(moved) - x)

    options: Any = {"maxiter": ITERATIONS, "ftol": CONVERGED / max(abs(cost(x)), 1.0)}
    bounds, value = list(zip(low.tolist(), high.tolist(), strict=True)), np.inf
    # The estimate of the curvature may mislead a fit, which another one from its end on shows.
    for _ in range(STARTS):
        best = scipy.optimize.minimize(cost_and_slopes, x, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        x, before, value = best.x, value, float(best.fun)
        if before - value < SAME:
            break
    return x, value


def _moved(x: Float, step: Float | float, high: Float) -> Float:
    """Return the parameters with one of them moved by its step in each row, backwards at its upper bound."""
    return np.asarray(x + np.diag(np.where(x + step <= high, step, -step)))


def _covariance_of(process: Process, data: BinnedLightCurve) -> Covariance | None:
    """Return the covariance of the data if their process is this one, or None if it is not positive definite."""
    try:
        return process.covariance(data.time_s, data.variance * process.excess**2)
    except (np.linalg.LinAlgError, RuntimeError, ValueError):
        return None


def _innovations(process: Process, data: BinnedLightCurve) -> Float | None:
    """Return normalised innovations and the logarithms of their variances, shape (2, n + 2).

    Half of the sum of the squares and logarithms is minus the log likelihood. The last two of each are the prior of the
    noise and the integral over the mean. Return None if the covariance is not positive definite or a value not finite.
    """
    covariance = _covariance_of(process, data)
    if covariance is None:
        return None
    _, log_likelihood, innovations = level_fit(covariance, data.values)
    prior = (np.log(process.excess) - data.log_excess) / NOISE_PRIOR
    of_mean = -2 * log_likelihood - float(innovations @ innovations) - covariance.log_determinant
    parts = np.array([np.append(innovations, [prior, 0.0]), np.append(covariance.log_variances, [0.0, of_mean])])
    return parts if np.isfinite(parts).all() else None


def _cost(parts: Float | None) -> float:
    """Return minus the log likelihood by its innovations."""
    return 1e25 if parts is None else 0.5 * float(parts[0] @ parts[0] + parts[1].sum())


def _score(parts_of: Callable[[Float], Float | None], x: Float, low: Float, high: Float) -> tuple[Float, float]:
    """Return the parameters within bounds for which `_innovations` have the least cost, and this cost.

    Derivatives of the innovations and of their variances give the expected curvature, without second derivatives
    (Fisher scoring), to which the damping of Levenberg and Marquardt is added.
    """
    parts, damping, difference = parts_of(x), DAMPING / 10, np.full(x.size, FIRST_DIFFERENCE)
    for _ in range(ITERATIONS):
        cost, moved = _cost(parts), _moved(x, difference, high)
        others = [other for row in moved if (other := parts_of(row)) is not None]
        if parts is None or len(others) < x.size:
            break
        values, logs = ((np.stack(others) - parts) / (np.diag(moved) - x)[:, None, None]).transpose(1, 0, 2)
        gradient = values @ parts[0] + 0.5 * logs.sum(axis=1)
        values = values + 0.5 * logs * parts[0]
        information = values @ values.T + 0.5 * logs @ logs.T
        power = np.maximum(np.diag(information), 1e-12)
        difference = np.clip(DIFFERENCE / np.sqrt(power), *DIFFERENCES)
        limits = np.maximum(low - x, -LONGEST_STEP), np.minimum(high - x, LONGEST_STEP)
        while True:
            root = np.linalg.cholesky(information + np.diag(damping * power))
            goal = -scipy.linalg.solve_triangular(root, gradient, lower=True)
            step = scipy.optimize.lsq_linear(root.T, goal, limits, "bvls", max_iter=10 * x.size).x
            expected = -float(step @ (gradient + 0.5 * information @ step))
            if damping > MOST_DAMPING or (damping <= DAMPING and expected < CONVERGED):
                return x, cost
            tried = parts_of(np.clip(x + step, low, high))
            if (fall := cost - _cost(tried)) > 0:
                break
            damping = max(8 * damping, DAMPING)
        x, parts = np.clip(x + step, low, high), tried
        if fall > FAITHFUL * expected:
            damping = max(damping / 10, LEAST_DAMPING)
        elif fall < DOUBTFUL * expected:
            damping *= 4
    return x, _cost(parts)
