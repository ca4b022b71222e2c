"""Periods that are recovered from irregular visits by a Lomb-Scargle periodogram (VanderPlas 2018, ApJS 236, 16)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.distributions import Interval, clopper_pearson
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.physical import Positive, Probability, Seed

if TYPE_CHECKING:
    from mauvecl.host.orbit.visibility import Windows

Float = NDArray[np.float64]

#: Frequencies per resolution of the time base.
OVERSAMPLING = 5
#: Smallest number of visits of which a sinusoid with a free mean leaves residuals.
MIN_VISITS = 5
#: Largest number of frequencies.
MAX_FREQUENCIES = 200_000
#: Simulated periodograms beyond the threshold.
IN_TAIL = 20


@dataclass(frozen=True, eq=False)
class Recovery:
    """Share of sinusoids whose period is recovered."""

    time_d: Float  # shape (n_visit,)
    # Normalised power that noise exceeds with the false-alarm probability, anywhere in the periodogram.
    threshold: float
    periods_d: Float  # shape (n_period,)
    amplitudes: Float  # shape (n_amplitude,); semi-amplitudes in standard errors of a visit
    recovered: list[list[Interval]]  # for each amplitude and period


def visit_times_d(windows: Windows, visits: int, exposure_s: float, seed: int) -> Float:
    """Draw the middles of visits in windows, evenly over the time in which an exposure fits, in days; ascending.

    Raises InputError if no window is long enough.
    """
    room = np.maximum(windows.length_s - exposure_s, 0.0)
    if not room.sum() > 0:
        longest = windows.length_s.max(initial=0.0)
        expected = f"at most the longest window, {longest:.0f} s"
        raise InputError.of("observation.exposure_s", exposure_s, expected, unit="s")
    ends = np.cumsum(room)
    at = np.sort(np.random.default_rng(seed).uniform(0.0, ends[-1], visits))
    which = np.searchsorted(ends, at, side="right")
    start = windows.start_s[which] + at - (ends[which] - room[which])
    return np.asarray((start + exposure_s / 2) / 86_400.0)


@validated
def recover_periods(
    time_d: Annotated[Float, Unit("d")],
    periods_d: Annotated[Float, Unit("d")],
    amplitudes: Float,
    *,
    fap: Probability = 0.01,
    trials: Annotated[int, Range(1)] = 100,
    seed: Seed = 1,
    shortest_d: Annotated[Positive | None, Unit("d")] = None,
    longest_d: Annotated[Positive | None, Unit("d")] = None,
) -> Recovery:
    """Simulate how often the period of a sinusoid is found in visits with normal errors of one.

    A period is recovered if the highest peak exceeds the threshold and lies within half of the frequency resolution,
    1 / (2 time base), of the truth.

    Parameters
    ----------
    time_d : ndarray, shape (n_visit,)
    periods_d : ndarray, shape (n_period,)
    amplitudes : ndarray, shape (n_amplitude,)
        Semi-amplitudes in standard errors of a visit.
    fap : float
        Probability that noise exceeds the threshold anywhere in the periodogram, by simulation.
    trials : int
        Sinusoids of random phase for each period and amplitude.
    seed : int
    shortest_d, longest_d : float, optional
        Range of the periodogram; by default that of the periods.
    """
    from astropy.timeseries import LombScargle

    time = np.sort(np.asarray(time_d, np.float64))
    if time.size < MIN_VISITS:
        raise InputError.of("visits", time.size, f"at least {MIN_VISITS}")
    base = float(np.ptp(time))
    if not base > 0:
        raise InputError.of("time_d", "visits at one time", "visits at different times")
    low, high = 1 / (longest_d or max(periods_d)), 1 / (shortest_d or min(periods_d))
    step = 1 / (OVERSAMPLING * base)
    # Half a resolution beyond the ends, so that periods at the ends can be recovered.
    count = int(np.ceil((high - low) / step)) + OVERSAMPLING + 1
    if count > MAX_FREQUENCIES:
        expected = f"at most {MAX_FREQUENCIES}: longer periods or a shorter campaign"
        raise InputError.of("periods", f"{count} frequencies", expected)
    frequency = max(low - 0.5 / base, step) + step * np.arange(count)
    generator = np.random.default_rng(seed)

    def peak(values: Float) -> tuple[float, float]:
        power = LombScargle(time, values).power(frequency, method="fast", assume_regular_frequency=True)
        best = int(np.argmax(power))
        return float(power[best]), float(frequency[best])

    noise = np.sort([peak(generator.standard_normal(time.size))[0] for _ in range(int(np.ceil(IN_TAIL / fap)))])
    threshold = float(noise[-IN_TAIL])
    recovered = []
    for amplitude in amplitudes:
        row = []
        for period in periods_d:
            found = 0
            for phase in generator.uniform(0, 2 * np.pi, trials):
                values = amplitude * np.sin(2 * np.pi * time / period + phase) + generator.standard_normal(time.size)
                power, at = peak(values)
                found += power > threshold and abs(at - 1 / period) < 0.5 / base
            row.append(clopper_pearson(found, trials))
        recovered.append(row)
    return Recovery(time, threshold, np.asarray(periods_d), np.asarray(amplitudes), recovered)
