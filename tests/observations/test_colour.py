"""The colour of events in spectra: flares are bluer than the star, changes of throughput have its colour."""

from __future__ import annotations

import numpy as np
from scenes import analysed
from scipy import stats

from mauvecl import Frames
from mauvecl.observations.colour import event_colour

PIXELS, FRAMES = 40, 300
STAR = np.linspace(100.0, 900.0, PIXELS)
BLUE = np.linspace(300.0, 50.0, PIXELS)


def test_an_event_without_colour_has_uniform_p_values() -> None:
    """Kolmogorov's test over 300 events of one star; fails by chance once in ten thousand times."""
    rng = np.random.default_rng(298)
    event = np.zeros(120, np.bool_)
    event[50:60] = True
    values, ratios = [], []
    for _ in range(300):
        mean = STAR * np.where(event, 1.2, 1.0)[:, None]
        error = np.full(mean.shape, 10.0)
        found = event_colour(rng.normal(mean, error), error, event, ~event)
        values.append(found.p_value)
        ratios.append((found.blue_over_red - 1) / found.blue_over_red_error)
    # The star's own error makes the spectra slightly more different: by 0.2^2 of its variance.
    assert stats.kstest(values, "uniform").pvalue > 1e-4
    assert abs(np.mean(ratios)) < 0.3
    assert 0.85 < np.std(ratios) < 1.15


def test_the_answer_tells_a_flare_from_a_change_of_throughput() -> None:
    rng = np.random.default_rng(299)
    shape = np.zeros(FRAMES)
    shape[80:100] = np.exp(-np.arange(20) / 6.0)
    loss = np.ones(FRAMES)
    loss[200:215] = 1.15
    mean = (STAR + shape[:, None] * BLUE) * loss[:, None]
    error = np.full(mean.shape, 15.0)
    wavelength = np.linspace(200.0, 700.0, PIXELS)
    frames = Frames.of(np.arange(FRAMES) * 60.0, rng.normal(mean, error), error, wavelength_nm=wavelength)
    events = analysed(frames).events
    flare, change = (next(row for row in events if row["istart"] <= at <= row["istop"]) for at in (82, 205))
    assert flare["blue_over_red"] > 2
    assert flare["p_no_colour"] < 1e-6
    assert abs(change["blue_over_red"] - 1) < 4 * change["blue_over_red_error"]
    assert change["p_no_colour"] > 1e-4
