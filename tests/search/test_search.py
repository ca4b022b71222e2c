"""Searches of sums of frames: values of filters, losses of a bank, and rates of false alarms."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from refusals import refused
from scipy import special

from mauvecl import SHAPES, Stare, Study
from mauvecl.search import completeness, false_alarms

Search = false_alarms.Search
DAVENPORT = SHAPES["davenport2014"]
ONE = np.ones((1, 1))
KNOWN = {"offset": False, "slope": False, "window_s": 0.0}
HALF_WIDTHS_S = Study().search.half_widths_s
COLOURS = np.array([[1.0, 0.0], [0.95, 0.312], [0.8, 0.6]])


def bank_of(widths, directions=ONE, *, cycle=False, **level):
    """Return a bank of flares of Davenport's shape in frames of 5 s, by default of a single light curve."""
    bank = Study.build({"search": {"half_widths_s": widths, **level}}, "test").search.white_bank(5.0)
    return replace(bank, directions=directions, baseline=replace(bank.baseline, cycle=cycle))


#: The bank of the theory's table: eight filters from 30 s on, a factor of two apart.
EIGHT = bank_of([30.0 * 2**k for k in range(8)], **KNOWN)


def filtered(search, sums, curves):
    """Compute all values of a search by least squares, template by template."""
    stare, bank = search.stare, search.bank
    weight = 1 / search.variance
    for row, rho in search.values(sums):
        t = row.template
        for onset in range(0, row.peaks.size, 11):
            if row.per_amplitude[onset] == 0:
                continue
            peak = stare.numbers[0] + row.peaks[onset]
            place = stare.numbers - peak
            inside = (place >= t.first) & (place < t.first + t.time.size)
            at = place[inside]
            edges = np.column_stack([at, at + 1]) * bank.frame_s
            shape = DAVENPORT.mean_over(edges, t.phases[row.phase] * bank.frame_s, t.half_width_s)
            root = np.sqrt(weight[inside])
            terms = [at.astype(float) ** p for p in bank.baseline.powers] + [c[inside] for c in curves]
            left = root * shape
            if terms:
                columns = root[:, None] * np.array(terms).T
                columns /= np.linalg.norm(columns, axis=0)
                left = left - columns @ np.linalg.lstsq(columns, left, rcond=1e-13)[0]
            left *= root / np.linalg.norm(left)
            yield rho[:, :, onset], np.einsum("t,stk,dk->sd", left, sums[:, inside], bank.directions)


@pytest.mark.parametrize("level", [KNOWN, {"window_s": 600.0}, {"cycle": True, "window_s": 600.0}])
def test_filters_are_least_squares_over_gaps(level):
    """Fit each template over gaps, with unequal variances and a varying level; the last is longer than the stare."""
    stare = Stare.of(6000.0, gaps=[(1000, 1500), (3000, 3050)])
    rng = np.random.default_rng(1)
    bank = bank_of((11.0, 54.0, 266.0, 2000.0), COLOURS[::2], **level)
    level = bank.baseline
    curves = np.array([np.sin(stare.start_s / 600), np.cos(stare.start_s / 600)]) if level.cycle else np.zeros((0, 1))
    assert bank.window(2000.0)[1] > stare.n_frames or level.offset
    variance = rng.uniform(0.5, 2.0, stare.n_frames)
    search = Search(bank, stare, curves if level.cycle else None, variance)
    sums = rng.standard_normal((2, stare.n_frames, 2)) + (30 + 1e-2 * stare.start_s[:, None] if level.offset else 0)
    if level.cycle:
        sums += 20 * curves[0][:, None]
    pairs = list(filtered(search, sums, curves))
    assert len(pairs) > 200
    assert max(np.abs(a - b).max() for a, b in pairs) < 5e-3


@pytest.mark.parametrize("level", [KNOWN, {}])
def test_bank_loses_little_in_time(level):
    """Check a loss of 1.3 % of S/N at most for half-widths of 10-1800 s at any phase (spectra: 0.7 %)."""
    bank, edges = bank_of(HALF_WIDTHS_S, **level), np.arange(12_001) * 5.0
    flares, own = [], []
    for half_width in np.geomspace(10, 1800, 24):
        lead, tail = bank.window(half_width)
        for phase, frame in ((0.1, 5000), (0.5, 5007), (0.8, 5020)):
            flares.append(DAVENPORT.mean_over(edges, (frame + phase) * 5.0, half_width))
            left = DAVENPORT.mean_over(np.arange(-lead, tail + 2) * 5.0, phase * 5.0, half_width)
            own.append(np.linalg.norm(scipy.signal.detrend(left) if bank.baseline.offset else left))
    kept = Search(bank, Stare.of(60_000.0)).largest(np.array(flares, np.float32)[:, :, None]) / np.array(own)
    assert (1 - kept).max() < 0.013


def test_largest_value_of_a_day():
    """Compare quantiles with 3.73, 4.20, 4.67 and 0.41-0.48 independent tests a frame; fails once in 10^4 runs."""
    day, days, rng = Search(EIGHT, Stare.of(86_400.0)), 400, np.random.default_rng(18)
    parts = [day.largest(rng.standard_normal((50, 17280, 1), dtype=np.float32)) for _ in range(days // 50)]
    largest = np.sort(np.concatenate(parts))
    for q, value in ((0.5, 3.73), (0.9, 4.20), (0.99, 4.67)):
        # Of 400 days so many lie below the quantile, within four standard errors, and 0.01 for two decimals.
        spread = 4 * np.sqrt(days * q * (1 - q))
        assert np.sum(largest < value + 0.02) > days * q - spread
        assert np.sum(largest < value - 0.02) < days * q + spread
    assert completeness.search_threshold(np.log(2), EIGHT) == pytest.approx(3.73, abs=0.05)
    # The share below a value is (1 - Q)^(17280 N).
    tests = np.log(np.mean(largest < 3.9)) / np.log1p(-special.ndtr(-3.9)) / 17280
    assert 0.38 < tests < 0.55


@pytest.mark.long
def test_repeated_estimates_scatter_by_their_errors():
    """Compare the scatter of eight seeds with their errors, and with drawn noise; fails by chance once in 10^3 runs."""
    search = Search(Study().search.white_bank(5.0), Stare.of(2500.0))
    repeats = [false_alarms.sample_rate(search, seed=seed) for seed in range(8)]
    for u in (4.25, 5.0, 6.5):
        k = list(repeats[0].thresholds).index(u)
        p, error = (np.array([getattr(tail, name)[k] for tail in repeats]) for name in ("probability", "error"))
        scatter = np.sum((p - p.mean()) ** 2) / np.mean(error**2)
        assert special.chdtri(7, 1 - 1e-4) < scatter < special.chdtri(7, 1e-4)
    month = 12 / 365.25
    assert max(tail.log_rate(tail.threshold(month).value)[1] for tail in repeats) < 0.05
    rng, n = np.random.default_rng(9), 5000
    maxima = search.largest(rng.standard_normal((n, 500, 1), dtype=np.float32))
    for u in (3.5, 4.0):
        p = np.array([tail.probability[list(tail.thresholds).index(u)] for tail in repeats])
        q = np.mean(maxima > u)
        assert abs(p.mean() - q) < 4 * np.hypot(p.std() / np.sqrt(8), np.sqrt(q * (1 - q) / n))


def test_rate_of_one_filter_equals_the_closed_form():
    """Compare independent frames with P = 1 - (1 - Q)^n."""
    alone = bank_of([0.02], **KNOWN)
    tail = false_alarms.sample_rate(Search(alone, Stare.of(500.0)), seed=1, draws=50)
    # Both phases of a template see its one frame: they are the same filter.
    exact = -np.expm1(100 * np.log1p(-special.ndtr(-tail.thresholds)))
    kept = tail.thresholds >= 4.5
    assert tail.probability[kept] == pytest.approx(exact[kept], rel=2e-3)
    for sigma in (4.5, 5.0, 6.0):
        assert completeness.search_threshold(17_280 * special.ndtr(-sigma), alone) == pytest.approx(sigma, abs=1e-3)


@pytest.mark.parametrize("widths", [pytest.param(HALF_WIDTHS_S, marks=pytest.mark.long), (20.0, 40.0, 80.0, 160.0)])
def test_closed_form_of_the_rate_agrees_with_importance_sampling(widths):
    """An upper bound, up to a tenth above, for one alarm a day to one in 10^10 days; fails once in 10^4 runs."""
    directions = ONE if widths is HALF_WIDTHS_S else COLOURS
    bank = bank_of(widths, directions, window_s=900.0)
    tail = false_alarms.sample_rate(Search(bank, Stare.of(12_000.0)), seed=2, draws=120)
    for asked in (1.0, 1e-2, 1e-4, 1e-7, 1e-10):
        log_rate, error = tail.log_rate(completeness.search_threshold(asked, bank))
        assert -0.1 - 4 * error < log_rate - np.log(asked) < 4 * error
    for rate in (1.0, 1e-2, 1 / 365.25):
        cut = tail.threshold(rate)
        assert tail.log_rate(cut.value)[0] == pytest.approx(np.log(rate), abs=1e-4)
        assert 0 < cut.high - cut.value < 0.1
    with refused("false_alarms", "1e-30"):
        tail.threshold(1e-30)
