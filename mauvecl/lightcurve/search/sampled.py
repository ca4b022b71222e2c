"""The tail of a search's null by importance sampling: alarms too rare to count, in normal noise.

P(max > u) of M correlated normal values rho_j is found without bias at any u. One of them, i, is chosen with a
probability proportional to w_i, and the noise is drawn but for rho_i itself, so that every value is r_j + c_ij z with
z = rho_i left open. Then, for any function G that is not zero above u,

    P = sum(w) E[integral phi(z) G(z) 1(max_j rho_j > u) / sum_j w_j G(rho_j) dz].

With G a step at u this is the method of Naiman & Priebe (J. Comput. Graph. Stat. 10, 296, 2001) and of Adler, Blanchet
& Liu (2012, doi 10.1214/11-AAP792), whose 1 / number of values above u scatters widely where the clump of values about
a maximum may be small. Here G(z) = exp(u z) from a little below u on: the sum over a clump then follows its maximum,
and the integral over z is done by quadrature, so that the estimate hardly depends on how far the maximum exceeds u.
Weights w are each template's chance to be a local maximum of the bank, so that all clumps count alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.search.null import DAY_S
from mauvecl.lightcurve.search.search import BATCH
from mauvecl.lightcurve.search.trials import WEIGHED_AT, Trials
from mauvecl.statistics.intervals import CONFIDENCE, Interval

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.scatter import Scatter
    from mauvecl.lightcurve.search.search import Search

Float = NDArray[np.float64]

#: Thresholds at which importance sampling is done; between them the logarithm of the number of independent templates is
#: a cubic.
STEP = 0.25
LADDER = tuple(float(u) for u in np.arange(3.0, 8.01, STEP))
#: Powers of the threshold in that polynomial.
POWERS = 4
#: Draws of importance sampling: for a standard error of the rate of 3-4 % at one false alarm per star-month.
DRAWS = 160
#: Largest probability of an alarm in a stare that importance sampling is used for.
MOST_LIKELY = 0.7
#: Values at which rates are known between those of the ladder.
FINE = 20_000
#: Second half of the generator's key: draws of this null are no others.
NULL_KEY = 0x6E756C6C
#: G is zero below u by more than this over u.
BELOW = 4.0
#: Nodes of the integral over a template's own value, above the one at which the maximum reaches the threshold.
NODES = 6
#: Least weight of a template, of the largest.
LEAST_WEIGHT = 1e-3
#: Correlation with the chosen template from which on a value can cross the threshold as the template's does.
LEAST_RISE = 0.05


@dataclass(frozen=True, eq=False)
class Sampled:
    """The tail of the null for normal noise, by importance sampling.

    Attributes
    ----------
    thresholds : ndarray, shape (n,)
        At which it was sampled.
    probability, error : ndarray, shape (n,)
        P(max > threshold) of a stare, and its standard error.
    days : float
        Star-days of the stare.
    shifted : bool
        Whether the level of a stare does what the search neither subtracts nor marginalises over.
    """

    thresholds: Float
    probability: Float
    error: Float
    days: float
    shifted: bool = False

    @property
    def likely(self) -> tuple[float, float, float]:
        """The threshold that some three stares in ten exceed, with that probability and its standard error."""
        k = int(np.argmin(np.abs(self.probability - 0.3)))
        return float(self.thresholds[k]), float(self.probability[k]), float(self.error[k])

    @property
    def _trusted(self) -> NDArray[np.bool_]:
        return np.asarray(self.probability <= MOST_LIKELY)

    @property
    def _relative(self) -> Float:
        """Standard error of the rate at each trusted threshold, relative: d(-ln(1 - P)) = dP / (1 - P)."""
        p = self.probability[self._trusted]
        return np.asarray(self.error[self._trusted] / (1 - p) / -np.log1p(-p))

    def _fit(self) -> Float:
        """Return the polynomial of log(rate / Q) over the threshold less the mean of those trusted."""
        u, p = self.thresholds[self._trusted], self.probability[self._trusted]
        relative = self._relative
        logs = np.log(-np.log1p(-p) / self.days) - scipy.special.log_ndtr(-u)
        columns = np.vander(u - u.mean(), min(POWERS, u.size), increasing=True) / relative[:, None]
        return np.asarray(np.linalg.pinv(columns) @ (logs / relative))

    def under(self, scatter: Scatter) -> Sampled:
        """Return the same where the noise is not what the search takes it for."""
        if scatter.known:
            return self
        # The rate at any u, finely enough to be straight in between.
        shifted = bool(scatter.shifts.any())
        low, high = self.thresholds[0] / scatter.scales.max(), self.thresholds[-1] / scatter.scales.min()
        # Values that are shifted exceed a threshold as unshifted ones exceed one far below.
        fine = np.linspace(0.0 if shifted else low, high, FINE)
        polynomial = np.polynomial.polynomial.polyval(fine - self.thresholds[self._trusted].mean(), self._fit())
        rates = np.exp(scipy.special.log_ndtr(-fine) + polynomial)
        probability, error = np.zeros((2, self.thresholds.size))
        for k, threshold in enumerate(self.thresholds):
            each = scatter.alarmed(threshold, self.days, lambda u: np.interp(u, fine, rates))
            probability[k] = scatter.weights @ each
            spread = np.sqrt(np.sum((scatter.weights * (each - probability[k])) ** 2))
            error[k] = np.hypot(spread, probability[k] * self.error[k] / self.probability[k])
        return Sampled(self.thresholds, probability, error, self.days, shifted)

    def log_rate(self, threshold: float) -> tuple[float, float]:
        """Return the logarithm of false alarms per star-day, and its standard error."""
        kept = self._trusted
        # All thresholds share their draws, so that errors move together: none is gained by their number.
        error = float(np.interp(threshold, self.thresholds[kept], self._relative))
        if self.shifted:
            logs = np.log(-np.log1p(-self.probability[kept]) / self.days)
            return float(scipy.interpolate.PchipInterpolator(self.thresholds[kept], logs)(threshold)), error
        coefficients = self._fit()
        at = (threshold - self.thresholds[kept].mean()) ** np.arange(coefficients.size)
        return float(scipy.special.log_ndtr(-threshold) + at @ coefficients), error

    def rate(self, threshold: float) -> Interval:
        """Return false alarms per star-day at a threshold, with 95 %.

        Raises
        ------
        InputError
            For a threshold beyond those sampled, or so low that alarms can be counted.
        """
        self._check(threshold)
        log, error = self.log_rate(threshold)
        reach = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2)) * error
        return Interval(*(float(np.exp(log + d)) for d in (0.0, -reach, reach)))

    def threshold(self, rate: float) -> Interval:
        """Return the value with a number of false alarms per star-day, with 95 %.

        Raises
        ------
        InputError
            If it lies beyond the thresholds sampled, or so low that alarms can be counted; or if what is unknown of the
            level raises more alarms at any of them.
        """
        from scipy.optimize import brentq

        most = float(self.probability[-1])
        if self.shifted and most >= -np.expm1(-rate * self.days):
            least = -np.log1p(-min(most, 1 - 1e-16)) / self.days
            raise InputError(
                f"{rate:g} false alarms per star-day, expected at least {least:.2g}: "
                "what is unknown of the stare moves the level in ways that the search does not marginalise over (see "
                "search.cycle, slope, offset and window_s)"
            )
        low, high = self._ends
        goal = np.log(rate)
        if not self.log_rate(high)[0] <= goal <= self.log_rate(low)[0]:
            ends = [float(np.exp(self.log_rate(u)[0])) for u in (high, low)]
            raise InputError(
                f"{rate:g} false alarms per star-day, expected {ends[0]:.2g} to {ends[1]:.2g} for importance sampling "
                f"of stares of {self.days:.3g} star-days"
            )
        value = float(brentq(lambda u: self.log_rate(u)[0] - goal, low, high, xtol=1e-6))
        # The rate falls by a factor exp(-u) for one more in u, about.
        reach = float(scipy.special.ndtri(0.5 + CONFIDENCE / 2)) * self.log_rate(value)[1] / value
        return Interval(value, value - reach, value + reach)

    @property
    def _ends(self) -> tuple[float, float]:
        """Thresholds that are answered: one step below the lowest that is trusted, up to the highest."""
        return float(self.thresholds[self._trusted][0] - STEP), float(self.thresholds[-1])

    def _check(self, threshold: float) -> None:
        low, high = self._ends
        if not low <= threshold <= high:
            raise InputError(f"a threshold of {threshold:g}, expected {low:g} to {high:g} for importance sampling")


def sampled(search: Search, *, seed: int, draws: int = DRAWS) -> Sampled:
    """Return the tail of a search's null for normal noise of the variance that it takes.

    Parameters
    ----------
    search : Search
        On a stare of a few days at most: templates are counted over all of it.
    seed : int
    draws : int

    Raises
    ------
    InputError
        If no template of the bank fits into the stare.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, NULL_KEY]))
    rows, n_sum = search.grid, search.bank.directions.shape[1]
    tried = [np.flatnonzero(row.per_amplitude > 0) for row in rows]
    sizes = np.array([t.size for t in tried])
    if not sizes.any():
        raise InputError("no template of the bank fits into the stare, expected a longer one")
    weights = Trials.of(search.bank).peaked(WEIGHED_AT)
    weights = np.maximum(weights, LEAST_WEIGHT * weights.max())
    shares = np.cumsum(weights * sizes[:, None])
    variance = search.variance[:, None]
    estimates = np.empty((draws, len(LADDER)))
    # Each draw is of noise, and of what moves its template's own value by one: that in time the template's direction,
    # so that it takes one more sum. Few at once, so that they stay in the caches.
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
    return Sampled(
        np.array(LADDER), estimates.mean(axis=0), estimates.std(axis=0, ddof=1) / np.sqrt(draws),
        search.stare.observed_s / DAY_S,
    )  # fmt: skip


#: Nodes and weights of an integral over exp(-x).
_X, _W = np.polynomial.laguerre.laggauss(NODES)


def _near(rho: Float, weight: Float, u: float) -> Float:
    """Return the values that G may count at a threshold or above it: their r, c and w, shape (3, n)."""
    near = np.flatnonzero(_reach(rho[0], rho[1], LADDER[-1]) > u - BELOW / u)
    weights = np.broadcast_to(weight[:, None], rho.shape[1:])
    return np.array([each.reshape(-1)[near] for each in (rho[0], rho[1], weights)])


def _reach(r: Float, c: Float, u: float) -> Float:
    """Return the largest values that nodes of the integral may see at a threshold u."""
    return np.asarray(r + np.abs(c) * (u + _X[-1] / (u - BELOW / u)))


def _estimates(values: Float) -> Float:
    """Return what one draw says of P at each threshold, over sum(w), from the r, c and w of its values."""
    estimates = np.zeros(len(LADDER))
    for k, u in enumerate(LADDER):
        least = u - BELOW / u
        values = values[:, _reach(values[0], values[1], LADDER[-1]) > least]
        near = values[:, _reach(values[0], values[1], u) > least]
        if not near.size:
            continue
        r, c, w = near
        # Own values from which on the maximum exceeds the threshold; the template's own (r = 0, c = 1) does from u on.
        crossing = np.divide(u - r, c, out=np.full(r.size, u), where=c > LEAST_RISE)
        z = max(least, min(u, float(crossing.min())))
        if ((r + least * c) > u).any():
            z = least
        nodes = z + _X / z
        rho = r + nodes[:, None] * c
        counted = rho > least
        total = np.where(counted, np.exp(np.where(counted, u * (rho - u), 0.0)), 0.0) @ w
        # Rounding may leave the crossing value a hair below.
        exceeds = rho.max(axis=1) > u * (1 - 1e-12)
        density = np.exp(-(nodes**2) / 2 + u * (nodes - u) + _X) / np.sqrt(2 * np.pi) / z
        estimates[k] = np.sum(_W * density * np.divide(exceeds, total, out=np.zeros(NODES), where=exceeds))
    return estimates
