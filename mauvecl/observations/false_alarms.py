"""False-alarm rates of searches, from simulated light curves of the fitted process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.observations.level import process_level
from mauvecl.observations.process import Steps
from mauvecl.schema.physical import DAY_S

if TYPE_CHECKING:
    from mauvecl.observations.search import SeriesSurvey

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Number of alarms from which a rate is estimated, and the smallest and largest number of simulated light curves.
MIN_ALARMS, MIN_SIMULATED, MAX_SIMULATED = 100, 200, 20_000
#: Largest number of values in all simulated light curves, which bounds the time, and in one of them.
MAX_VALUES, MAX_LENGTH = 2**23, 2**16
#: Values that are simulated at once.
BATCH = 2**20
#: Probability of the upper end of the rate that sets thresholds: one standard error above it.
UPPER = 0.8413447460685429
#: Probability of a dip as large as the largest from noise below which the noise of the light is not symmetric.
CHANCE_DIP = 1e-3
#: Second half of the generator's key, which makes the draws independent of others.
SIMULATION_KEY = 0x73696D75


@dataclass(frozen=True, eq=False)
class SimulatedRate:
    """False-alarm rate in simulated light curves."""

    largest: Float  # shape (n,); largest statistic of each light curve, ascending
    days: float  # star-days of each
    heavy: bool = False  # whether the tail may fall more slowly than that of normal noise

    @property
    def total(self) -> float:
        """Star-days of all light curves."""
        return self.largest.size * self.days

    @property
    def smallest(self) -> float:
        """Smallest rate that the light curves show."""
        return MIN_ALARMS / self.total

    def rate(self, threshold: float) -> float:
        """Return the events per star-day above a threshold, at the upper end of its 68 % interval.

        Beyond the simulated values, it falls as the tail of normal noise does, or exponentially if that is not known.
        """
        return float(np.exp(self._log_rate(threshold)))

    def _log_rate(self, threshold: float) -> float:
        from scipy.stats import beta

        n = self.largest.size
        anchor = float(self.largest[-min(n, MIN_ALARMS)])
        at = min(threshold, anchor)
        above = int(np.count_nonzero(self.largest > at))
        if above == n:
            return float(np.inf)
        share = float(beta.ppf(UPPER, above + 1, n - above))
        rate = float(np.log(-np.log1p(-share) / self.days))
        return rate if threshold <= anchor else rate - self._fall(anchor, threshold)

    def _fall(self, anchor: float, threshold: float) -> float:
        """Return the fall of the logarithm of the rate from the largest simulated values to a threshold."""
        from scipy.special import log_ndtr

        normal = float(log_ndtr(-anchor) - log_ndtr(-threshold))
        if not self.heavy:
            return normal
        beyond = self.largest[self.largest > anchor] - anchor
        # The exponential that fits the largest values best (Pickands 1975, doi 10.1214/aos/1176343003), or a normal
        # tail if it falls more slowly.
        return min(normal, (threshold - anchor) / float(beyond.mean())) if beyond.size else normal

    def threshold(self, rate: float) -> float:
        """Return the threshold above which the rate of events per star-day is at most `rate`."""
        from scipy.optimize import brentq

        low = float(self.largest[0])
        goal = float(np.log(rate))
        if self._log_rate(low) <= goal:
            return low
        high = float(self.largest[-1]) + 1.0
        while self._log_rate(high) > goal:
            high += 2.0
        return float(brentq(lambda u: min(self._log_rate(u), 1e3) - goal, low, high, xtol=1e-4))


def simulated_rates(
    survey: SeriesSurvey, quiet: Bool, rate: float, seed: int, steps: Steps | None = None
) -> tuple[SimulatedRate, SimulatedRate]:
    """Return the false-alarm rates in light curves of the fitted process, and in those of measured residuals.

    Both have the covariance of the process, and levels are fitted and subtracted as in the search. The noise of the
    first is normal, or Poisson noise for counts. That of the second are blocks of the standardised residuals of
    quiescent frames, drawn with replacement (Kuensch 1989, doi 10.1214/aos/1176347265). Enough light curves are drawn
    for `MIN_ALARMS` at the smallest rate of interest, per star-day, up to a limit; `steps` reports each batch.
    """
    steps = steps or Steps()
    residual = innovations(survey, quiet)
    part = survey.frames(np.arange(survey.stare.n_frames) < MAX_LENGTH)
    n, n_sum = part.sums.shape
    days = part.stare.observed_s / DAY_S
    most = max(MIN_SIMULATED, MAX_VALUES // (n * n_sum))
    count = int(np.clip(MIN_ALARMS / (rate * days), MIN_SIMULATED, min(MAX_SIMULATED, most)))
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, SIMULATION_KEY]))
    length = max(block_length(column) for column in residual.T)
    covariances = part.search.covariances
    counts = _mean_counts(survey, quiet)[:n] if survey.counts else None
    largest: tuple[list[Float], list[Float]] = ([], [])
    batch = max(1, BATCH // (n * n_sum))
    for first in steps.each(range(0, count, batch), -(-count // batch)):
        size = min(batch, count - first)
        starts = rng.integers(0, len(residual), (size, -(-n // length)))
        rows = (starts[:, :, None] + np.arange(length)) % len(residual)
        for white, found in zip(
            (rng.standard_normal((size, n, n_sum)), residual[rows.reshape(size, -1)[:, :n]]), largest, strict=True
        ):
            if counts is not None and found is largest[0]:
                drawn = rng.poisson(counts, (size, n))[:, :, None] / survey.counts / survey.scale
            else:
                drawn = np.stack([one.coloured(white[:, :, k].T).T for k, one in enumerate(covariances)], axis=2)
            found.append(part.search.largest(drawn).maximum)
    modelled, measured = (np.sort(np.concatenate(values)) for values in largest)
    return SimulatedRate(modelled, days, bool(survey.counts)), SimulatedRate(measured, days, True)


def largest_dip(survey: SeriesSurvey, quiet: Bool, least: float) -> float:
    """Return the largest statistic of events that no flare can be: sudden dips, and slow ones that end suddenly.

    Smaller ones than `least` may be missed.

    Quiescent frames are searched upside down, in both directions of time. Noise that is as likely to rise as to fall
    has dips as large as its false alarms; losses of light have larger ones, and end as suddenly as flares begin.
    """
    down = survey.frames(quiet).inverted()
    return max(
        float(rho.max(initial=-np.inf))
        for one in (down, down.backwards())
        for _, rho in one.search.values(one.sums[None], least)
    )


def _mean_counts(survey: SeriesSurvey, quiet: Bool) -> Float:
    """Return the mean counts of each frame, shape (n_frame,)."""
    level = process_level(survey.processes[0], survey.stare.start_s, survey.sums[:, 0], survey.variance, quiet)
    return np.maximum(level * survey.scale * survey.counts, 0.0)


def innovations(survey: SeriesSurvey, quiet: Bool) -> Float:
    """Return the residuals of quiescent frames given those before them, in standard deviations, (n_quiet, n_sum).

    They are independent and of unit variance if the process describes the light.
    """
    columns = []
    for process, column in zip(survey.processes, survey.sums.T, strict=True):
        one = process.covariance(survey.stare.start_s[quiet], survey.variance[quiet] * process.excess**2)
        both = one.whitened(np.column_stack([column[quiet], np.ones(int(quiet.sum()))]))
        mean = float(both[:, 0] @ both[:, 1] / (both[:, 1] @ both[:, 1]))
        columns.append(both[:, 0] - mean * both[:, 1])
    return np.column_stack(columns)


def block_length(residual: Float) -> int:
    """Return the number of consecutive residuals to draw together: beyond the first insignificant correlation."""
    n = residual.size
    centred = residual - residual.mean()
    power = float(centred @ centred)
    limit = 2.0 / np.sqrt(n)
    for lag in range(1, n // 4):
        if float(centred[:-lag] @ centred[lag:]) / power < limit:
            # A block of the optimal order for a correlation of this length.
            return max(lag, round(n ** (1 / 3))) if lag > 1 else 1
    return max(1, n // 4)
