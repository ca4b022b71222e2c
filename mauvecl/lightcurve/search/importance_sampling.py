"""Importance sampling of the false-alarm rate in normal noise, for alarms too rare to count.

The method gives an unbiased estimate of P(max > u) for M correlated normal values rho_j at any u. One of them, i, is
chosen with a probability proportional to w_i, and the noise is drawn except for rho_i, so that every value is
r_j + c_ij z with z = rho_i. Then, for any function G that is not zero above u,

    P = sum(w) E[integral phi(z) G(z) 1(max_j rho_j > u) / sum_j w_j G(rho_j) dz].

With G a step at u this is the method of Naiman & Priebe (J. Comput. Graph. Stat. 10, 296, 2001) and of Adler, Blanchet
& Liu (2012, doi 10.1214/11-AAP792), whose 1 / number of values above u has a large variance if clusters of values above
u vary in size. Here G(z) = exp(u z) from slightly below u: the sum over a cluster then follows its maximum, and the
integral over z is computed by quadrature, so that the estimate hardly depends on how far the maximum exceeds u. The
weights w are the probabilities that a template is a local maximum, so that all clusters contribute equally.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.false_alarm_rate import WEIGHTING_THRESHOLD, TemplateGrid
from mauvecl.lightcurve.search.search import BATCH
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.statistics.intervals import CONFIDENCE, Interval

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.search import Search
    from mauvecl.lightcurve.search.unknown_shifts import UnknownShifts

Float = NDArray[np.float64]

#: Sampled thresholds; between them, the logarithm of the number of independent templates is a cubic polynomial.
STEP = 0.25
LADDER = tuple(float(u) for u in np.arange(3.0, 8.01, STEP))
#: Number of coefficients of that polynomial.
POWERS = 4
#: Number of draws, for a standard error of the rate of 3-4 % at one false alarm per star-month.
DRAWS = 160
#: Largest probability of an alarm in a stare for which importance sampling is used.
MAX_PROBABILITY = 0.7
#: Number of thresholds at which rates are tabulated for interpolation.
FINE = 20_000
#: Second half of the generator's key, which makes the draws independent of others.
NULL_KEY = 0x6E756C6C
#: G is zero below u - BELOW / u.
BELOW = 4.0
#: Nodes of the integral over the chosen template's value.
NODES = 6
#: Smallest weight of a template relative to the largest.
MIN_WEIGHT = 1e-3
#: Smallest correlation with the chosen template for which a value's crossing of the threshold is computed.
MIN_CORRELATION = 0.05


@dataclass(frozen=True, eq=False)
class SampledRate:
    """False-alarm rate in normal noise from importance sampling."""

    thresholds: Float  # shape (n,)
    probability: Float  # P(max > threshold) of a stare, shape (n,)
    error: Float  # standard error of `probability`
    days: float  # star-days of the stare
    shifted: bool = False  # stares have trends that the search neither subtracts nor marginalises over

    @property
    def likely(self) -> tuple[float, float, float]:
        """Threshold that about three stares in ten exceed, its probability, and the standard error."""
        k = int(np.argmin(np.abs(self.probability - 0.3)))
        return float(self.thresholds[k]), float(self.probability[k]), float(self.error[k])

    @property
    def _trusted(self) -> NDArray[np.bool_]:
        return np.asarray(self.probability <= MAX_PROBABILITY)

    @property
    def _relative(self) -> Float:
        """Relative standard error of the rate at each trusted threshold: d(-ln(1 - P)) = dP / (1 - P)."""
        p = self.probability[self._trusted]
        return np.asarray(self.error[self._trusted] / (1 - p) / -np.log1p(-p))

    def _fit(self) -> Float:
        """Fit a polynomial to log(rate / Q) as a function of the centred threshold."""
        u, p = self.thresholds[self._trusted], self.probability[self._trusted]
        relative = self._relative
        logs = np.log(-np.log1p(-p) / self.days) - scipy.special.log_ndtr(-u)
        columns = np.vander(u - u.mean(), min(POWERS, u.size), increasing=True) / relative[:, None]
        return np.asarray(np.linalg.pinv(columns) @ (logs / relative))

    def under(self, shifts: UnknownShifts) -> SampledRate:
        """Return the rate for stares whose noise differs from the noise that the search assumes."""
        if shifts.is_nominal:
            return self
        # The rate is tabulated finely enough for linear interpolation.
        shifted = bool(shifts.shifts.any())
        low, high = self.thresholds[0] / shifts.scales.max(), self.thresholds[-1] / shifts.scales.min()
        # Shifted values exceed a threshold as often as unshifted ones exceed a much lower one.
        fine = np.linspace(0.0 if shifted else low, high, FINE)
        polynomial = np.polynomial.polynomial.polyval(fine - self.thresholds[self._trusted].mean(), self._fit())
        rates = np.exp(scipy.special.log_ndtr(-fine) + polynomial)
        probability, error = np.zeros((2, self.thresholds.size))
        for k, threshold in enumerate(self.thresholds):
            each = shifts.alarm_probability(threshold, self.days, lambda u: np.interp(u, fine, rates))
            probability[k] = shifts.weights @ each
            spread = np.sqrt(np.sum((shifts.weights * (each - probability[k])) ** 2))
            error[k] = np.hypot(spread, probability[k] * self.error[k] / self.probability[k])
        return SampledRate(self.thresholds, probability, error, self.days, shifted)

    def log_rate(self, threshold: float) -> tuple[float, float]:
        """Return the logarithm of false alarms per star-day, and its standard error."""
        kept = self._trusted
        # All thresholds share draws, so that their errors are correlated and do not average out.
        error = float(np.interp(threshold, self.thresholds[kept], self._relative))
        if self.shifted:
            logs = np.log(-np.log1p(-self.probability[kept]) / self.days)
            return float(scipy.interpolate.PchipInterpolator(self.thresholds[kept], logs)(threshold)), error
        coefficients = self._fit()
        at = (threshold - self.thresholds[kept].mean()) ** np.arange(coefficients.size)
        return float(scipy.special.log_ndtr(-threshold) + at @ coefficients), error

    def rate(self, threshold: float) -> Interval:
        """Return the false alarms per star-day at a threshold, with a 95 % interval.

        Raises InputError if the threshold is outside the sampled range.
        """
        self._check(threshold)
        log, error = self.log_rate(threshold)
        reach = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2)) * error
        return Interval(*(float(np.exp(log + d)) for d in (0.0, -reach, reach)))

    def threshold(self, rate: float) -> Interval:
        """Return the threshold for a number of false alarms per star-day, with a 95 % interval.

        Raises InputError if it is outside the sampled range, or if trends cause more alarms at all sampled thresholds.
        """
        from scipy.optimize import brentq

        most = float(self.probability[-1])
        if self.shifted and most >= -np.expm1(-rate * self.days):
            least = -np.log1p(-min(most, 1 - 1e-16)) / self.days
            raise InputError(
                f"{rate:g} false alarms per star-day",
                f"at least {least:.2g}: what is unknown of the stare moves the level in ways that the "
                "search does not marginalise over (see search.cycle, slope, offset and window_s)",
                key="false_alarms",
                value=rate,
            )
        low, high = self._ends
        goal = np.log(rate)
        if not self.log_rate(high)[0] <= goal <= self.log_rate(low)[0]:
            ends = [float(np.exp(self.log_rate(u)[0])) for u in (high, low)]
            raise InputError(
                f"{rate:g} false alarms per star-day",
                f"{ends[0]:.2g} to {ends[1]:.2g} for importance sampling of stares of {self.days:.3g} star-days",
                key="false_alarms",
                value=rate,
            )
        value = float(brentq(lambda u: self.log_rate(u)[0] - goal, low, high, xtol=1e-6))
        # The rate falls by about a factor exp(-u) per unit of u.
        reach = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2)) * self.log_rate(value)[1] / value
        return Interval(value, value - reach, value + reach)

    @property
    def lowest(self) -> float:
        """Smallest threshold at which the rate is known."""
        return self._ends[0]

    @property
    def _ends(self) -> tuple[float, float]:
        """Range of thresholds: from one step below the lowest trusted one to the highest."""
        return float(self.thresholds[self._trusted][0] - STEP), float(self.thresholds[-1])

    def _check(self, threshold: float) -> None:
        low, high = self._ends
        if not low <= threshold <= high:
            raise InputError.of("threshold", threshold, f"{low:g} to {high:g} for importance sampling")


def sample_rate(search: Search, *, seed: int, draws: int = DRAWS) -> SampledRate:
    """Estimate the false-alarm rate of a search in normal noise of the assumed variance.

    The stare should not exceed a few days, since every draw evaluates all templates.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, NULL_KEY]))
    rows, n_sum = search.grid, search.bank.directions.shape[1]
    tried = [np.flatnonzero(row.per_amplitude > 0) for row in rows]
    sizes = np.array([t.size for t in tried])
    if not sizes.any():
        raise InputError.of("half_widths_s", search.bank.half_widths_s, "templates that fit into the stare")
    weights = TemplateGrid.from_bank(search.bank).peak_probabilities(WEIGHTING_THRESHOLD)
    weights = np.maximum(weights, MIN_WEIGHT * weights.max())
    shares = np.cumsum(weights * sizes[:, None])
    variance = search.variance[:, None]
    estimates = np.empty((draws, len(LADDER)))
    # One more sum holds the response that changes the chosen template's own value by one, since it is proportional to
    # the template in time. Batches are small so that they fit into the processor's caches.
    directions = search.bank.directions
    batch = max(1, BATCH // (8 * (n_sum + 1) * search.n_grid))
    for first in range(0, draws, batch):
        count = min(batch, draws - first)
        held = np.empty((count, search.stare.n_frames, n_sum + 1))
        own, along = np.empty(count), np.empty((count, len(directions), 1))
        for n in range(count):
            which, direction = divmod(
                int(np.searchsorted(shares, rng.random() * shares[-1], "right")), weights.shape[1]
            )
            onset = int(rng.choice(tried[which]))
            template = search.in_time(rows[which], np.array([onset]))[0]
            held[n, :, :n_sum] = np.sqrt(variance) * rng.standard_normal((search.stare.n_frames, n_sum))
            held[n, :, n_sum] = template * search.variance
            own[n] = template @ held[n, :, :n_sum] @ directions[direction]
            along[n, :, 0] = directions @ directions[direction]
        values: list[list[Float]] = [[] for _ in range(count)]
        for (row, correlated), weight in zip(search.correlations(held), weights, strict=True):
            at = row.per_amplitude > 0
            for n, kept in enumerate(values):
                c = along[n] * correlated[n, n_sum, at]
                r = directions @ correlated[n, :n_sum, at].T - own[n] * c
                kept.append(_near(np.array([r, c]), weight, LADDER[0]))
        for n, kept in enumerate(values):
            estimates[first + n] = _estimates(np.concatenate(kept, axis=1))
    estimates *= shares[-1]
    return SampledRate(
        np.array(LADDER), estimates.mean(axis=0), estimates.std(axis=0, ddof=1) / np.sqrt(draws),
        search.stare.observed_s / DAY_S,
    )  # fmt: skip


#: Nodes and weights of an integral over exp(-x).
_X, _W = np.polynomial.laguerre.laggauss(NODES)


def _near(rho: Float, weight: Float, u: float) -> Float:
    """Return r, c and w of the values for which G may be positive at a threshold of at least u, shape (3, n)."""
    near = np.flatnonzero(_reach(rho[0], rho[1], LADDER[-1]) > u - BELOW / u)
    weights = np.broadcast_to(weight[:, None], rho.shape[1:])
    return np.array([each.reshape(-1)[near] for each in (rho[0], rho[1], weights)])


def _reach(r: Float, c: Float, u: float) -> Float:
    """Return the largest values at the nodes of the integral for a threshold u."""
    return np.asarray(r + np.abs(c) * (u + _X[-1] / (u - BELOW / u)))


def _estimates(values: Float) -> Float:
    """Return one draw's estimates of P / sum(w) at each threshold, from r, c and w of its values."""
    estimates = np.zeros(len(LADDER))
    for k, u in enumerate(LADDER):
        least = u - BELOW / u
        values = values[:, _reach(values[0], values[1], LADDER[-1]) > least]
        near = values[:, _reach(values[0], values[1], u) > least]
        if not near.size:
            continue
        r, c, w = near
        # Value z at which each template exceeds the threshold; the chosen one (r = 0, c = 1) does at z = u.
        crossing = np.divide(u - r, c, out=np.full(r.size, u), where=c > MIN_CORRELATION)
        z = max(least, min(u, float(crossing.min())))
        if ((r + least * c) > u).any():
            z = least
        nodes = z + _X / z
        rho = r + nodes[:, None] * c
        counted = rho > least
        total = np.where(counted, np.exp(np.where(counted, u * (rho - u), 0.0)), 0.0) @ w
        # The tolerance allows for rounding of the crossing value.
        exceeds = rho.max(axis=1) > u * (1 - 1e-12)
        density = np.exp(-(nodes**2) / 2 + u * (nodes - u) + _X) / np.sqrt(2 * np.pi) / z
        estimates[k] = np.sum(_W * density * np.divide(exceeds, total, out=np.zeros(NODES), where=exceeds))
    return estimates
