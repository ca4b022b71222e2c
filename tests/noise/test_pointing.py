"""Pointing drifts: distributions of waits, durations and depths, correlation in time, and means of frames."""

from functools import partial

import numpy as np
import pytest
from marks import long_but
from scipy import integrate, stats

from mauvecl import Study
from mauvecl.noise import reference

#: Three statistical tests of 4.5 sigma and KS tests at 1e-5: about one run in 10 000 fails by chance. Seeds were fixed
#: before the first run.
SIGMA, LEAST_P, SEED = 4.5, 1e-5, 11
DRIFTS = Study().with_settings(["stare.pointing={rate_per_h=6.0, duration_s=200.0, depth=0.8}"]).stare.pointing
drifts, losses = (partial(function, DRIFTS) for function in (reference.pointing_drifts, reference.pointing_losses))
WAIT_S = 600.0
NUMBERS = np.arange(20_000, dtype=np.uint64)


def test_waits_durations_and_depths_have_their_distributions() -> None:
    start, lasts, depth = drifts(NUMBERS[:4000], 5000.0, SEED)
    assert (start[:, -1] >= 5000.0).all()
    ends = np.column_stack([np.zeros(4000), (start + lasts)[:, :-1]])
    waits = start - ends
    assert (waits > 0).all()
    # Drawn up to a fixed number of drifts, and so without the bias of a fixed time.
    for values, law in (
        (waits[:, :8], stats.expon(scale=WAIT_S)),
        (lasts[:, :8], stats.expon(scale=200.0)),
        (depth[:, :8], stats.uniform(0.0, 0.8)),
    ):
        assert stats.kstest(values.ravel(), law.cdf).pvalue > LEAST_P
    # Nothing is related to anything else.
    table = np.column_stack([waits[:, 0], waits[:, 1], lasts[:, 0], lasts[:, 1], depth[:, 0], depth[:, 1]])
    rank = stats.spearmanr(table).statistic[np.triu_indices(6, 1)]
    assert np.abs(rank).max() * np.sqrt(4000) < SIGMA


def occupied(time_s: float) -> float:
    """Return the probability of a drift at a time after the start: a Markov chain of two states, first without one."""
    rates = 1 / WAIT_S + 1 / 200.0
    return 200.0 / (200.0 + WAIT_S) * float(-np.expm1(-rates * time_s))


@pytest.mark.parametrize(
    ("time_s", "later_s"), long_but([(50.0, 100.0), (500.0, 30.0), (3000.0, 300.0)], (3000.0, 300.0))
)
def test_occupation_and_its_correlation_in_time(time_s: float, later_s: float) -> None:
    """P(drift at t) and P(drift at t and t + h) follow in closed form."""
    at = np.array([time_s, time_s + later_s])
    lost = losses(NUMBERS, at, 1e-6, SEED) > 0
    n, p = len(NUMBERS), occupied(time_s)
    assert abs(lost[:, 0].mean() - p) < SIGMA * np.sqrt(p * (1 - p) / n)
    share = 200.0 / (200.0 + WAIT_S)
    stays = share + (1 - share) * np.exp(-later_s * (1 / WAIT_S + 1 / 200.0))
    both = p * stays
    assert abs((lost[:, 0] & lost[:, 1]).mean() - both) < SIGMA * np.sqrt(both * (1 - both) / n)


@pytest.mark.long
def test_moments_of_the_loss() -> None:
    """Long after the start, the loss in a drift is a share of its depth that is uniform between 0 and 1."""
    lost = losses(NUMBERS, np.array([20_000.0]), 1e-6, SEED)[:, 0]
    share = 200.0 / (200.0 + WAIT_S)
    mean, square, fourth = share * 0.8 / 4, share * 0.8**2 / 9, share * 0.8**4 / 25
    n = len(NUMBERS)
    assert abs(lost.mean() - mean) < SIGMA * np.sqrt((square - mean**2) / n)
    assert abs((lost**2).mean() - square) < SIGMA * np.sqrt((fourth - square**2) / n)
    assert lost.max() <= 0.8


def test_frames_hold_the_mean_of_the_drift() -> None:
    """The loss of a frame is the integral of the saw-tooth over it, whatever begins or ends in the frame."""
    start, lasts, depth = (one[0] for one in drifts(NUMBERS[:1], 3000.0, SEED))

    def lost(time_s: float) -> float:
        inside = (time_s >= start) & (time_s < start + lasts)
        return float(np.sum(inside * depth * (time_s - start) / lasts))

    edges = np.arange(0.0, 3000.0, 5.0)
    found = losses(NUMBERS[:1], edges, 5.0, SEED)[0]
    breaks = np.concatenate([start, start + lasts])
    for k in [*np.flatnonzero(found)[::7], *((breaks[breaks < 3000.0] // 5.0).astype(int))]:
        inner = [b for b in breaks if edges[k] < b < edges[k] + 5.0]
        value = integrate.quad(lost, edges[k], edges[k] + 5.0, points=inner or None, limit=200)[0] / 5.0
        assert found[k] == pytest.approx(value, abs=1e-9)


def test_a_stare_depends_on_its_number_and_the_seed_alone() -> None:
    some = losses(NUMBERS[7:9], np.arange(0.0, 6000.0, 5.0), 5.0, SEED)
    every = losses(NUMBERS[:20], np.arange(0.0, 6000.0, 5.0), 5.0, SEED)
    np.testing.assert_array_equal(some, every[7:9])
    longer = losses(NUMBERS[7:9], np.arange(0.0, 60_000.0, 5.0), 5.0, SEED)
    np.testing.assert_allclose(some, longer[:, :1200], atol=1e-12)
    assert not np.array_equal(some, losses(NUMBERS[7:9], np.arange(0.0, 6000.0, 5.0), 5.0, SEED + 1))
