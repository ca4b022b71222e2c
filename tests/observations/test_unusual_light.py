"""Light that resembles neither a quiet star nor a whole flare: tails without a peak, eclipses, too many events."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mauvecl.observations.analysis import analyse_frames
from mauvecl.observations.frames import Frames

Float = NDArray[np.float64]
#: Equivalent duration of a flare of unit amplitude and half-width in the shape of `flare`.
DURATION = 1.826885


def flare(time_s: Float, frame_s: float, peak_s: float, half_width_s: float) -> Float:
    """Return the flare of Davenport et al. (2014) as the mean of 60 points a frame, written a second time."""
    tau = (time_s[:, None] + (np.arange(60) - 29.5) / 60 * frame_s - peak_s) / half_width_s
    late = np.maximum(tau, 0.0)
    rise = 1 + tau * (1.94053 + tau * (-0.175084 + tau * (-2.24588 - 1.12498 * tau)))
    decay = 0.689008 * np.exp(-1.60053 * late) + 0.302963 * np.exp(-0.278318 * late)
    return np.asarray(np.where(tau > 0, decay, np.where(tau > -1, rise, 0.0)).mean(axis=1))


@pytest.mark.parametrize(
    ("half_width_s", "after", "amplitude", "window", "seed"),
    [
        (60.0, 1.5, 60.0, 12.0, 1),
        (60.0, 2.0, 60.0, 12.0, 2),
        pytest.param(40.0, 1.0, 20.0, 13.0, 3, marks=pytest.mark.long),
        pytest.param(90.0, 1.2, 200.0, 11.0, 4, marks=pytest.mark.long),
        pytest.param(60.0, 0.7, 5.0, 12.0, 5, marks=pytest.mark.long),
        pytest.param(120.0, 1.5, 30.0, 15.0, 6, marks=pytest.mark.long),
    ],
)
def test_tail_of_a_bright_flare_without_its_peak_is_an_event(
    half_width_s: float, after: float, amplitude: float, window: float, seed: int
) -> None:
    """Observe a flare from some half-widths after its peak, for 11 to 15 half-widths: its light never ends.

    The energy lies within five standard errors, which a normal error exceeds once in 1.7 million cases.
    """
    rng, frame_s, noise = np.random.default_rng([501, seed]), 5.0, 5e-3
    time = (np.arange(round(window * half_width_s / frame_s)) + 0.5) * frame_s
    flux = 1 + amplitude * flare(time, frame_s, -after * half_width_s, half_width_s)
    flux += noise * rng.standard_normal(time.size)
    analysis = analyse_frames(Frames.of(time, flux, np.full(time.size, noise)), per="month")
    event = max(analysis.events, key=lambda one: one.value)
    assert event.first == 0
    assert event.cut
    assert event.kind == "flare"
    assert event.value > analysis.threshold
    truth = amplitude * half_width_s * DURATION
    low, high = event.energy.low_s[0], event.energy.high_s[0]
    assert abs(event.energy.fitted_s - truth) < 2.5 * (high - low)
