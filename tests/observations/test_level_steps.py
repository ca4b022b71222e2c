"""Steps of the level that last, as where observations are joined: they are fitted, and flares beside them are found."""

import numpy as np
import pytest
from scenes import analysed, flare

from mauvecl import Frames

DAY_S = 86_400.0
#: Frames of half an hour for 41 days, the frames before which the level changes, and by how much.
FRAME_S, N_FRAMES, NOISE = 1765.0, 2000, 4e-4
STEPS = {600: -0.03, 1150: 0.012, 1600: 0.03}
#: Peaks (d), half-widths (s) and amplitudes of flares with an S/N of 20 or more.
FLARES = ((3.7, 1500.0, 0.012), (14.4, 900.0, 0.02), (25.5, 1800.0, 0.03), (34.2, 2900.0, 0.02))


@pytest.mark.parametrize("turns", [False, pytest.param(True, marks=pytest.mark.long)])
def test_flares_beside_steps_of_the_level_are_detected(turns: bool) -> None:
    """A constant star and one that turns: 1.4 false alarms are promised, seven or more occur once in 1600 cases."""
    time, truth = np.arange(N_FRAMES) * FRAME_S, np.ones(N_FRAMES)
    if turns:
        angle, slow = 2 * np.pi * time / (1.158 * DAY_S), 2 * np.pi * time / (70 * DAY_S)
        truth += 0.015 * np.sin(angle) + 0.006 * np.sin(2 * angle + 1) + 0.03 * np.sin(slow)
    for first, size in STEPS.items():
        truth[first:] += size
    flux = truth + NOISE * np.random.default_rng([507, int(turns)]).standard_normal(N_FRAMES)
    for peak, half_width, amplitude in FLARES:
        flux += amplitude * flare(time, FRAME_S, peak * DAY_S, half_width)
    answer = analysed(Frames.of(time, flux, np.full(N_FRAMES, NOISE)), per="month")
    assert any("The level changes 3 times suddenly" in message for message in answer.messages)
    found = answer.events[answer.events["verdict"] == "detected"]
    start, stop = (found[name].to_value("d") for name in ("tstart", "tstop"))
    assert all(((start <= peak) & (peak <= stop)).any() for peak, *_ in FLARES)
    assert len(found) <= len(FLARES) + 6
    level = np.asarray(answer.frames["level"], float)
    near = np.concatenate([[first - 1, first] for first in STEPS])
    assert np.abs(level - truth)[near].max() < 6 * NOISE


@pytest.mark.parametrize("what", ["long flare", "dip of half a day", "fast trend"])
def test_changes_that_do_not_last_are_no_steps(what: str) -> None:
    """Observe twenty days with a flare that takes a day to decay, a dip of half a day, or a change within two days."""
    rng = np.random.default_rng(508)
    time = np.arange(1000) * FRAME_S
    flux = 1 + NOISE * rng.standard_normal(time.size)
    if what == "long flare":
        flux += 0.05 * flare(time, FRAME_S, 9 * DAY_S, 4 * 3600.0)
    elif what == "dip of half a day":
        flux[(time > 8 * DAY_S) & (time < 8.5 * DAY_S)] -= 0.02
    else:
        flux += 0.03 / (1 + np.exp(-(time - 9 * DAY_S) / (0.5 * DAY_S)))
    answer = analysed(Frames.of(time, flux, np.full(time.size, NOISE)), per="month")
    assert not any("for a day or more" in message for message in answer.messages)
    assert (what == "long flare") == any(
        str(row["verdict"]) == "detected" and row["value"] > 20 for row in answer.events
    )
