"""Compare the closed-form false-alarm rate with counts and with importance sampling of the same banks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from searches import DAVENPORT, KNOWN, ONE

from mauvecl import Stare
from mauvecl.lightcurve.defaults import HALF_WIDTHS_S
from mauvecl.lightcurve.search.bank import Bank, Baseline
from mauvecl.lightcurve.search.completeness import default_bank, search_threshold
from mauvecl.lightcurve.search.counted_rate import CountedRate
from mauvecl.lightcurve.search.false_alarm_rate import TemplateGrid
from mauvecl.lightcurve.search.importance_sampling import sample_rate
from mauvecl.lightcurve.search.search import Search
from mauvecl.schema.physical import DAY_S


def test_bank_of_the_documentation_has_its_rate():
    """Compare eight filters a factor of two apart with TIME.md: .41 to .48 tests a frame, median of a day 3.73."""
    bank = Bank(tuple(30 * 2.0**k for k in range(8)), ONE, DAVENPORT, 5.0, KNOWN)
    grid = TemplateGrid.from_bank(bank)
    assert 0.41 < grid.trials_per_frame(3.5) < grid.trials_per_frame(3.73) < 0.51
    assert search_threshold(np.log(2), bank) == pytest.approx(3.73, abs=0.05)
    # No constant: twice as many far out.
    assert grid.trials_per_frame(6.5) > 1.9 * grid.trials_per_frame(3.5)


def test_rate_of_one_filter_equals_the_closed_form():
    """Use independent frames: both phases of a template shorter than a frame are the same filter."""
    alone = TemplateGrid.from_bank(Bank((0.02,), ONE, DAVENPORT, 5.0, KNOWN))
    assert alone.trials_per_frame(5.0) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("widths", [pytest.param(HALF_WIDTHS_S, marks=pytest.mark.long), (20.0, 40.0, 80.0, 160.0)])
def test_rate_agrees_with_importance_sampling(widths):
    """Compare one alarm a day to one in 10^10 days, for one sum and for three temperatures.

    An upper bound, up to a tenth above; four standard errors of the sampled rate, some 8 % each, which thresholds of
    one bank share: fails by chance once in 10^4 runs.
    """
    directions = ONE if widths is HALF_WIDTHS_S else np.array([[1.0, 0.0], [0.95, 0.312], [0.8, 0.6]])
    bank = Bank(widths, directions, DAVENPORT, 5.0, Baseline(window_s=900.0))
    tail, grid = sample_rate(Search(bank, Stare.of(12_000.0)), seed=2, draws=120), TemplateGrid.from_bank(bank)
    for u, p, error in zip(tail.thresholds[4:], tail.probability[4:], tail.error[4:], strict=True):
        truth = -np.log1p(-p) / (tail.days * 86_400)
        off, spread = grid.false_alarms_per_second(float(u)) / truth - 1, 4 * error / p
        assert -spread < off < 0.1 + spread


def test_rate_agrees_with_counts():
    """Compare at a few alarms per day, where maxima are clustered and the rate is at most a fifth too large.

    600 stares of six hours: 4 standard errors fail by chance once in 10^4 runs.
    """
    bank, stare, rng = default_bank(), Stare.of(21_600.0), np.random.default_rng(1)
    maxima = Search(bank, stare).largest(rng.standard_normal((600, stare.n_frames, 1), dtype=np.float32)).maximum
    null = CountedRate(np.sort(maxima), stare.observed_s / DAY_S)
    for u in (3.5, 3.75, 4.0):
        rate, expected = null.rate(u), TemplateGrid.from_bank(bank).false_alarms_per_second(u) * 86_400
        spread = 2 * (rate.high - rate.low) / 3.92 * 2
        assert rate.value - spread < expected < 1.2 * rate.value + spread
        assert special.ndtr(-u) * 17_280 * 0.45 < rate.value - spread / 4


def test_threshold_inverts_the_rate():
    for rate in (1.0, 1 / 30, 4e-5):
        cut = search_threshold(rate)
        assert TemplateGrid.from_bank(default_bank()).false_alarms_per_second(cut) * 86_400 == pytest.approx(rate)
