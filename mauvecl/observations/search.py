"""Search of an observed light curve for flares, with the false-alarm rate of its measured noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import Bank, Baseline
from mauvecl.lightcurve.search.importance_sampling import SampledRate, sample_rate
from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.survey import select_frames
from mauvecl.lightcurve.search.templates import Templates
from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.schema.physical import DAY_S

if TYPE_CHECKING:
    from mauvecl.lightcurve.flares.shapes import Shape
    from mauvecl.observations.frames import Frames
    from mauvecl.observations.level import QuiescentLevel

Float = NDArray[np.float64]

#: Step between half-widths of a bank: the same as that of `lightcurve.defaults.HALF_WIDTHS_S`.
WIDTH_STEP = 1.86
#: Narrowest template in frames, and widest as a share of the light curve's length and in seconds.
NARROWEST, WIDEST, WIDEST_S = 1.5, 0.15, 7200.0
#: Smallest baseline window, in cadences and seconds.
WINDOW_FRAMES, WINDOW_S = 120, 1800.0
#: Number of alarms in resampled light curves from which a rate is estimated, and the largest number of those.
MIN_ALARMS, MAX_RESAMPLED = 30, 20_000
#: Largest number of values in all resampled light curves, which bounds the time.
MAX_VALUES = 2**24
#: Expected number of false alarms at the largest rate of interest in the part of the light curve that importance
#: sampling uses, and the smallest number of its frames.
SAMPLED_ALARMS, MIN_SAMPLED = 0.6, 200
#: Temperature assumed for flares in a light curve without colour, K.
NO_COLOUR_K = 10_000.0
#: Smallest number of quiescent frames of a window whose residuals are resampled.
MIN_WINDOW = 10
#: Second half of the generator's key, which makes the draws independent of others.
RESAMPLING_KEY = 0x72657361


@dataclass(frozen=True, eq=False)
class MeasuredRate:
    """False-alarm rate in light curves composed of the measured residuals."""

    largest: Float  # shape (n,); largest statistic of each resampled light curve, ascending
    days: float  # star-days of each

    def rate(self, threshold: float) -> float:
        """Return the false alarms per star-day above a threshold; beyond the largest value, three over the time."""
        above = int(np.count_nonzero(self.largest > threshold))
        total = self.largest.size * self.days
        if above == self.largest.size:
            return float("inf")
        return 3.0 / total if above == 0 else -float(np.log1p(-above / self.largest.size)) / self.days

    @property
    def smallest(self) -> float:
        """Smallest rate that the resampled light curves can show."""
        return MIN_ALARMS / (self.largest.size * self.days)

    def threshold(self, rate: float) -> float:
        """Return the threshold for a number of false alarms per star-day.

        Rates below `smallest` use the threshold of `smallest`, raised as normal noise would be.
        """
        from scipy.optimize import brentq
        from scipy.special import log_ndtr

        reached = max(rate, self.smallest)
        share = -np.expm1(-reached * self.days)
        value = float(np.quantile(self.largest, 1 - share))
        if rate >= self.smallest:
            return value
        # The tail beyond the resampled light curves is extrapolated with the shape of a normal one.
        fall = float(np.log(rate / reached))
        return float(brentq(lambda u: log_ndtr(-u) - log_ndtr(-value) - fall, value, value + 40.0))


@dataclass(frozen=True, eq=False)
class SeriesSurvey:
    """Observed frames as `lightcurve.search` sees a stare: sums in units of the quiescent noise."""

    stare: Stare  # times of the searched frames
    bank: Bank
    # Sums of a flare of unit amplitude, whose light equals that of the quiescent star.
    templates: Templates
    # Shape (n_frame, n_sum); searched sums less their quiescent level: for spectra, sums weighted for flares; for a
    # light curve, its flux.
    sums: Float
    variance: Float  # shape (n_frame,); variance of the quiescent sums
    # Shape (n_frame,); flux less the quiescent level, over `scale`: what amplitudes and durations are measured of.
    flux: Float
    flux_variance: Float  # shape (n_frame,); variance of the quiescent flux
    scale: float  # typical standard deviation of the flux of a frame, in the unit of the flux
    level: float  # typical quiescent level, in the unit of the flux, to which amplitudes are relative
    photon: float  # rise of the variance with the flux, in the unit of the flux
    time_s: Float  # shape (n_frame,); times of the frames as observed, against those of the stare's regular grid
    curves: None = None

    @classmethod
    def of(cls, frames: Frames, flux: Float, error: Float | None, level: QuiescentLevel, shape: Shape) -> SeriesSurvey:
        """Prepare the frames of a light curve that can be searched."""
        used = level.used
        stare = stare_of(frames, used)
        scale = float(np.median(level.error[used]))
        typical = abs(float(np.median(level.level[used])))
        photon = _photon_noise(
            flux[used], None if error is None else error[used] * np.nan_to_num(level.excess, nan=1.0)
        )
        size, noise = typical / scale, photon * typical / scale**2
        templates = Templates(
            (NO_COLOUR_K,), np.ones((1, 1)), np.full((1, 1), size), np.array([size]), np.full((1, 1, 1), noise)
        )
        net, variance = (flux - level.level)[used] / scale, (level.error[used] / scale) ** 2
        return cls(
            stare, bank_of(stare, np.ones((1, 1)), shape), templates, net[:, None], variance, net, variance, scale,
            typical, photon, frames.time_s[used],
        )  # fmt: skip

    @cached_property
    def search(self) -> Search:
        """Search of the light curve."""
        return Search(self.bank, self.stare, None, self.variance)

    @property
    def directions(self) -> dict[Any, Float]:
        """Derivatives of the mean sums by jitters: none, since the scatter is measured."""
        return {"light": np.zeros_like(self.sums)}

    def covariance(self) -> Float:
        """Return the covariance of each frame's sums without a flare, shape (n_frame, 1, 1)."""
        return np.asarray(self.variance[:, None, None] * np.eye(self.sums.shape[1]))

    def net(self, sums: NDArray[Any]) -> NDArray[np.float32]:
        """Return the sums, whose level is already subtracted."""
        return np.asarray(sums, np.float32)

    def along(self, direction: int) -> Float:
        """Return the sum along a direction of the bank, which its templates search, (n_frame,)."""
        return np.asarray(self.sums @ self.bank.directions[direction])

    def frames(self, kept: NDArray[np.bool_]) -> SeriesSurvey:
        """Return the survey of some of the frames."""
        part = select_frames(self.stare, kept)
        names = ("sums", "variance", "flux", "flux_variance", "time_s")
        return replace(self, stare=part, **{name: getattr(self, name)[kept] for name in names})

    def binned(self, factor: int) -> SeriesSurvey:
        """Return the survey of means of consecutive frames, without those that lack a frame."""
        part = self.stare.numbers // factor
        bins, first, counts = np.unique(part, return_index=True, return_counts=True)
        whole = counts == factor
        rows = first[whole][:, None] + np.arange(factor)

        def mean(values: Float) -> Float:
            return np.asarray(values[rows].mean(axis=1))

        ones, frame_s = np.ones(rows.shape[0]), factor * self.stare.frame_s
        stare = Stare(bins[whole] * frame_s, frame_s, ones, ones, ones, np.zeros(ones.size))
        widths = tuple(width for width in self.bank.half_widths_s if width >= NARROWEST * frame_s)
        return replace(
            self, stare=stare, bank=replace(self.bank, half_widths_s=widths, frame_s=frame_s),
            templates=replace(self.templates, noise=self.templates.noise / factor), sums=mean(self.sums),
            variance=mean(self.variance) / factor, flux=mean(self.flux),
            flux_variance=mean(self.flux_variance) / factor, time_s=mean(self.time_s),
        )  # fmt: skip

    def normal_rate(self, rate: float, seed: int) -> SampledRate:
        """Return the false-alarm rate in normal noise of the measured variance.

        Parameters
        ----------
        rate : float
            Largest rate of interest, false alarms per star-day: importance sampling uses a part of the light curve
            that is short enough for it.
        """
        count = max(MIN_SAMPLED, int(SAMPLED_ALARMS / rate * DAY_S / self.stare.frame_s))
        return sample_rate(self.frames(np.arange(self.stare.n_frames) < count).search, seed=seed)

    def measured_rate(self, quiet: NDArray[np.bool_], rate: float, seed: int) -> MeasuredRate:
        """Return the false-alarm rate in light curves resampled from quiescent residuals.

        Blocks of consecutive residuals are drawn with replacement, so that their distribution and short correlations
        are those of the data (Kuensch 1989, doi 10.1214/aos/1176347265). Beyond the block, correlations are lost.

        Parameters
        ----------
        quiet : ndarray of bool, shape (n_frame,)
            Searched frames of the quiescent star.
        rate : float
            Wanted false alarms per star-day: enough light curves are drawn for `MIN_ALARMS`, up to a limit.
        """
        days = self.stare.observed_s / DAY_S
        n, n_sum = self.sums.shape
        residual = self._residual(quiet)
        count = int(np.clip(MIN_ALARMS / (rate * days), 200, min(MAX_RESAMPLED, max(200, MAX_VALUES // (n * n_sum)))))
        rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, RESAMPLING_KEY]))
        length = max(block_length(column) for column in residual.T)
        largest = []
        # Few at once, so that memory stays flat.
        batch = max(1, 2**22 // (n * n_sum))
        for first in range(0, count, batch):
            size = min(batch, count - first)
            starts = rng.integers(0, len(residual), (size, -(-n // length)))
            rows = (starts[:, :, None] + np.arange(length)) % len(residual)
            drawn = residual[rows.reshape(size, -1)[:, :n]] * np.sqrt(self.variance)[:, None]
            largest.append(self.search.largest(drawn.astype(np.float32)).maximum)
        return MeasuredRate(np.sort(np.concatenate(largest)).astype(np.float64), days)

    def _residual(self, quiet: NDArray[np.bool_]) -> Float:
        """Return residuals of quiescent frames from a line in each window, in standard deviations, (n, n_sum)."""
        y = self.sums / np.sqrt(self.variance)[:, None]
        windows = (self.stare.start_s // self.bank.baseline.window_s).astype(np.int64)
        residual = []
        for window in np.unique(windows[quiet]):
            here = quiet & (windows == window)
            if here.sum() >= MIN_WINDOW:
                line = np.vander(self.stare.start_s[here] - self.stare.start_s[here].mean(), 2)
                residual.append(y[here] - line @ np.linalg.lstsq(line, y[here], rcond=None)[0])
        every = np.concatenate(residual) if residual else y[quiet]
        return np.asarray(every)


def stare_of(frames: Frames, used: NDArray[np.bool_]) -> Stare:
    """Return the frames that are searched as a stare on the regular grid of the cadence."""
    numbers = frames.numbers[used]
    ones = np.ones(numbers.size)
    return Stare((numbers - numbers[0]) * frames.cadence_s, frames.cadence_s, ones, ones, ones, np.zeros(numbers.size))


def bank_of(stare: Stare, directions: Float, shape: Shape) -> Bank:
    """Return the template bank for a stare."""
    window = max(WINDOW_S, WINDOW_FRAMES * stare.frame_s)
    return Bank(half_widths(stare), directions, shape, stare.frame_s, Baseline(window_s=window))


def half_widths(stare: Stare) -> tuple[float, ...]:
    """Return the half-widths of a bank for a light curve, s."""
    low = NARROWEST * stare.frame_s
    high = max(low, min(WIDEST * stare.duration_s, WIDEST_S))
    steps = max(1, round(np.log(high / low) / np.log(WIDTH_STEP)) + 1)
    return tuple(float(w) for w in low * WIDTH_STEP ** np.arange(steps))


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


def _photon_noise(flux: Float, error: Float | None) -> float:
    """Return the rise of the stated variance with flux, by least squares; zero if no errors are stated."""
    if error is None:
        return 0.0
    design = np.column_stack([np.ones_like(flux), flux - np.median(flux)])
    slope = np.linalg.lstsq(design, error**2, rcond=None)[0][1]
    return max(float(slope), 0.0)
