"""Searches: values of filters, losses of a bank, and gains over the common rule."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from searches import DAVENPORT, KNOWN, ONE

from mauvecl import Stare
from mauvecl.lightcurve.defaults import HALF_WIDTHS_S
from mauvecl.lightcurve.search.bank import Bank, Baseline
from mauvecl.lightcurve.search.search import Search


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
            length = np.linalg.norm(left)
            found = np.einsum("t,stk,dk->sd", left / length * root, sums[:, inside], bank.directions)
            yield rho[:, :, onset], found


@pytest.mark.parametrize("level", [KNOWN, Baseline(window_s=600.0), Baseline(cycle=True, window_s=600.0)])
def test_filters_are_least_squares_over_gaps(level):
    """Compare correlations by FFT with a fit for each template, with gaps, unequal variances and a varying level.

    The last template is longer than the stare.
    """
    stare = Stare.of(6000.0, gaps=[(1000, 1500), (3000, 3050)])
    rng = np.random.default_rng(1)
    curves = np.array([np.sin(stare.start_s / 600), np.cos(stare.start_s / 600)]) if level.cycle else np.zeros((0, 1))
    bank = Bank((11.0, 54.0, 266.0, 2000.0), np.array([[1.0, 0.0], [0.8, 0.6]]), DAVENPORT, 5.0, level)
    assert bank.window(2000.0)[1] > stare.n_frames or level.offset
    variance = rng.uniform(0.5, 2.0, stare.n_frames)
    search = Search(bank, stare, curves if level.cycle else None, variance)
    sums = rng.standard_normal((2, stare.n_frames, 2)) + (30 + 1e-2 * stare.start_s[:, None] if level.offset else 0)
    if level.cycle:
        sums += 20 * curves[0][:, None]
    pairs = list(filtered(search, sums, curves))
    assert len(pairs) > 200
    assert max(np.abs(a - b).max() for a, b in pairs) < 5e-3


def test_template_is_the_filter():
    """Check that `template` returns the weights of a value, which give unit variance."""
    stare = Stare.of(3000.0, gaps=[(900, 1100)])
    bank = Bank((41.0,), np.array([[0.6, 0.8]]), DAVENPORT, 5.0, Baseline(window_s=400.0))
    search = Search(bank, stare)
    sums = np.random.default_rng(2).standard_normal((1, stare.n_frames, 2))
    ((row, rho),) = search.values(sums)
    for onset in np.flatnonzero(row.per_amplitude)[::50]:
        weights = search.template(row, int(onset), 0)
        assert np.sum(weights**2) == pytest.approx(1, abs=1e-6)
        assert np.sum(weights * sums[0]) == pytest.approx(rho[0, 0, onset], abs=1e-4)


def test_largest_finds_the_flare():
    stare = Stare.of(40_000.0, gaps=[(25_000, 27_000)])
    search = Search(Bank(HALF_WIDTHS_S, ONE, DAVENPORT, 5.0, Baseline(window_s=30_000.0)), stare)
    edges = np.column_stack([stare.start_s, stare.start_s + 5])
    sums = 2.0 * DAVENPORT.mean_over(edges, 20_003.0, 150.0)[None, :, None] + 7.0
    found = search.largest(sums)
    assert found.peak_s[0] == pytest.approx(20_003, abs=20)
    assert found.half_width_s[0] == 144
    assert found.amplitude[0] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("level", [KNOWN, Baseline()])
def test_bank_loses_little_in_time(level):
    """Check a loss of 1.3 % of S/N at most for half-widths of 10-1800 s at any phase (spectra: 0.7 %)."""
    bank = Bank(HALF_WIDTHS_S, ONE, DAVENPORT, 5.0, level)
    stare = Stare.of(60_000.0)
    search = Search(bank, stare)
    edges = np.arange(stare.n_frames + 1) * 5.0
    flares, own = [], []
    for half_width in np.geomspace(10, 1800, 24):
        for phase, frame in ((0.1, 5000), (0.5, 5007), (0.8, 5020)):
            flares.append(DAVENPORT.mean_over(edges, (frame + phase) * 5.0, half_width))
            t = bank.template(half_width, (phase,))
            left = t.shapes[0]
            if level.offset:
                left = left - np.polyval(np.polyfit(t.time, left, 1), t.time)
            own.append(np.linalg.norm(left))
    kept = search.largest(np.array(flares, np.float32)[:, :, None]).maximum / np.array(own)
    assert (1 - kept).max() < 0.013


@pytest.fixture(scope="module")
def day():
    """Return a day and the bank of the theory's table: eight filters from 30 s on, a factor of two apart."""
    return Search(Bank(tuple(30.0 * 2**k for k in range(8)), ONE, DAVENPORT, 5.0, KNOWN), Stare.of(86_400.0))


def test_largest_value_of_a_day(day):
    """Compare quantiles with 3.73, 4.20, 4.67 and 0.41-0.48 independent tests a frame; fails once in 10^4 runs."""
    rng = np.random.default_rng(18)
    days = 400
    parts = [day.largest(rng.standard_normal((50, 17280, 1), dtype=np.float32)) for _ in range(days // 50)]
    largest = np.sort(np.concatenate([p.maximum for p in parts]))
    for q, value in ((0.5, 3.73), (0.9, 4.20), (0.99, 4.67)):
        # Of 400 days so many lie below the quantile, within four standard errors, and 0.01 for two decimals.
        spread = 4 * np.sqrt(days * q * (1 - q))
        assert np.sum(largest < value + 0.02) > days * q - spread
        assert np.sum(largest < value - 0.02) < days * q + spread
    # The share below a value is (1 - Q)^(17280 N).
    tests = np.log(np.mean(largest < 3.9)) / np.log1p(-special.ndtr(-3.9)) / 17280
    assert 0.38 < tests < 0.55
