"""How often a search alarms without a flare: the null of its largest value, simulated; thresholds too rare to count.

Rates are false alarms per star-day, 86 400 s of frames (gaps do not count). Alarms come in clumps, of which a search
reports the largest, so that the probability of none in t star-days is exp(-rate t).

Where counting ends, P(max > u) of normal noise is found by importance sampling: one of the M templates is drawn, and
noise given that its own value exceeds u; then P = M Q(u) E[1 / number of templates that exceed u], without bias and
with a spread that does not grow with u (Adler, Blanchet & Liu 2012, doi 10.1214/11-AAP792).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.statistics.intervals import CONFIDENCE, Interval, central_counts, clopper_pearson

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.scatter import Scatter
    from mauvecl.lightcurve.search.search import Search

Float = NDArray[np.float64]

DAY_S = 86_400.0
#: Thresholds at which importance sampling is done; between them the logarithm of the number of independent templates is
#: a parabola.
STEP = 0.25
LADDER = tuple(float(u) for u in np.arange(3.0, 8.01, STEP))
#: Draws of importance sampling.
DRAWS = 200
#: Largest probability of an alarm in a stare that importance sampling is used for.
MOST_LIKELY = 0.7
#: Values at which rates are known between those of the ladder.
FINE = 20_000
#: Second half of the generator's key: draws of this null are no others.
NULL_KEY = 0x6E756C6C
#: Alarms that a counted threshold rests on at least.
FEWEST_ALARMS = 10


@dataclass(frozen=True, eq=False)
class Counted:
    """The largest values of stares without a flare.

    Attributes
    ----------
    maxima : ndarray, shape (n_stare,)
        Ascending.
    days : float
        Star-days of each stare.
    """

    maxima: Float
    days: float

    def rate(self, threshold: float) -> Interval:
        """False alarms per star-day at a threshold, with 95 %; infinite where every stare has one."""
        n = self.maxima.size
        above = n - int(np.searchsorted(self.maxima, threshold, side="left"))
        p = clopper_pearson(above, n)
        with np.errstate(divide="ignore"):
            values = [float(-np.log1p(-x) / self.days) for x in (p.value, p.low, p.high)]
        return Interval(*values)

    def threshold(self, rate: float) -> Interval:
        """The value with so many false alarms per star-day, with 95 %.

        Raises
        ------
        InputError
            If fewer than 10 of the stares would have one, or fewer than 10 none.
        """
        n = self.maxima.size
        alarmed = -np.expm1(-rate * self.days)
        if min(alarmed, 1 - alarmed) * n < FEWEST_ALARMS:
            raise InputError(
                f"{rate:g} false alarms per star-day are {alarmed * n:.3g} of {n} simulated stares, expected at least "
                f"{FEWEST_ALARMS} with one and as many without"
            )
        low, high = central_counts(n, 1 - alarmed)
        places = np.clip([round(n * (1 - alarmed)), low, high], 0, n - 1)
        return Interval(*(float(self.maxima[k]) for k in places))


def in_a_row(values: NDArray[Any], points: int, sigma: float) -> NDArray[np.bool_]:
    """Where the common rule alarms: frames that end a run of so many consecutive ones above so many sigma.

    Parameters
    ----------
    values : ndarray, shape (..., n_frame)
        In standard deviations; the first `points` of a longer run end in one alarm.
    points : int
    sigma : float
    """
    above = np.asarray(values > sigma)
    alarm = np.zeros(above.shape, np.bool_)
    if above.shape[-1] < points:
        return alarm
    windows = np.asarray(np.lib.stride_tricks.sliding_window_view(above, points, axis=-1).all(axis=-1))
    before = np.concatenate([np.zeros((*above.shape[:-1], 1), np.bool_), windows[..., :-1]], axis=-1)
    alarm[..., points - 1 :] = windows & ~before
    return alarm


def in_a_row_rate(points: int, sigma: float, frame_s: float) -> float:
    """False alarms per star-day of `in_a_row` in white noise: runs of at least so many points."""
    above = float(scipy.special.ndtr(-sigma))
    frames = DAY_S / frame_s
    # A run begins with the first frame, or after one that is not above.
    return above**points * (1 + (frames - points) * (1 - above))


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
    """

    thresholds: Float
    probability: Float
    error: Float
    days: float

    @property
    def likely(self) -> tuple[float, float, float]:
        """The threshold that some three stares in ten exceed, with that probability and its standard error."""
        k = int(np.argmin(np.abs(self.probability - 0.3)))
        return float(self.thresholds[k]), float(self.probability[k]), float(self.error[k])

    @property
    def _trusted(self) -> NDArray[np.bool_]:
        return np.asarray(self.probability <= MOST_LIKELY)

    def _fit(self) -> tuple[Float, Float]:
        """The parabola of log(rate / Q) over the threshold, and the covariance of its coefficients."""
        kept = self._trusted
        u, p = self.thresholds[kept], self.probability[kept]
        relative = self.error[kept] / p / (1 - p)
        logs = np.log(-np.log1p(-p) / self.days) - scipy.special.log_ndtr(-u)
        columns = np.vander(u - u.mean(), min(3, u.size), increasing=True) / relative[:, None]
        # All thresholds share their draws, so that errors move together: none is gained by their number.
        inverse = np.linalg.pinv(columns)
        return inverse @ (logs / relative), inverse @ inverse.T

    def under(self, scatter: Scatter) -> Sampled:
        """The same where the noise is not what the search takes it for."""
        if scatter.known:
            return self
        coefficients, _ = self._fit()
        # The rate at any u, finely enough to be straight in between.
        ends = self.thresholds[0] / scatter.scales.max(), self.thresholds[-1] / scatter.scales.min()
        fine = np.linspace(*ends, FINE)
        parabola = np.polynomial.polynomial.polyval(fine - self.thresholds[self._trusted].mean(), coefficients)
        rates = np.exp(scipy.special.log_ndtr(-fine) + parabola)
        probability, error = np.zeros((2, self.thresholds.size))
        for k, threshold in enumerate(self.thresholds):
            rate = np.interp(threshold / scatter.scales, fine, rates).mean(axis=1)
            each = -np.expm1(-self.days * rate)
            probability[k] = scatter.weights @ each
            spread = np.sqrt(np.sum((scatter.weights * (each - probability[k])) ** 2))
            error[k] = np.hypot(spread, probability[k] * self.error[k] / self.probability[k])
        return Sampled(self.thresholds, probability, error, self.days)

    def log_rate(self, threshold: float) -> tuple[float, float]:
        """The logarithm of false alarms per star-day, and its standard error."""
        kept = self._trusted
        coefficients, _ = self._fit()
        at = (threshold - self.thresholds[kept].mean()) ** np.arange(coefficients.size)
        error = float(np.interp(threshold, self.thresholds, self.error / self.probability))
        return float(scipy.special.log_ndtr(-threshold) + at @ coefficients), error

    def rate(self, threshold: float) -> Interval:
        """False alarms per star-day at a threshold, with 95 %.

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
        """The value with so many false alarms per star-day, with 95 %.

        Raises
        ------
        InputError
            If it lies beyond the thresholds sampled, or so low that alarms can be counted.
        """
        from scipy.optimize import brentq

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
    """The tail of a search's null for normal noise of the variance that it takes.

    Parameters
    ----------
    search : Search
        On a stare of a few days at most: templates are counted over all of it.
    seed : int
    draws : int
    """
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, NULL_KEY]))
    rows = search.grid
    tried = [np.flatnonzero(row.per_amplitude > 0) for row in rows]
    sizes = np.array([t.size for t in tried])
    if not sizes.any():
        raise InputError("no template of the bank fits into the stare, expected a longer one")
    ladder = np.array(LADDER)
    n_direction, spread = len(search.bank.directions), np.sqrt(search.variance)[:, None]
    one_in = np.zeros((draws, ladder.size))
    for draw in range(draws):
        which = int(rng.choice(len(rows), p=sizes / sizes.sum()))
        onset, direction = int(rng.choice(tried[which])), int(rng.integers(n_direction))
        weights = search.template(rows[which], onset, direction)
        noise = spread * rng.standard_normal(weights.shape)
        value = float(np.sum(weights * noise))
        # Moving the noise by this, the template's own value moves by one.
        move = weights * spread**2
        tail = rng.random()
        wanted = -scipy.special.ndtri(tail * scipy.special.ndtr(-ladder))
        both = np.stack([noise, move]).astype(np.float32)
        exceeding = np.zeros(ladder.size, np.int64)
        for row, rho in search.values(both):
            base, rise = rho[:, :, row.per_amplitude > 0].reshape(2, -1)
            near = base + np.abs(rise) * np.abs(wanted - value).max() > ladder[0]
            base, rise = base[near], rise[near]
            exceeding += [np.count_nonzero(base + (v - value) * rise > u) for v, u in zip(wanted, ladder, strict=True)]
        # Its own template exceeds for certain, whatever rounding says.
        one_in[draw] = 1.0 / np.maximum(exceeding, 1)
    scale = sizes.sum() * n_direction * scipy.special.ndtr(-ladder)
    return Sampled(
        ladder, scale * one_in.mean(axis=0), scale * one_in.std(axis=0, ddof=1) / np.sqrt(draws),
        search.stare.observed_s / DAY_S,
    )  # fmt: skip
