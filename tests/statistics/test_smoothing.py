"""The paper's smoothing, its bands for the device, and the distribution of the sum of squares."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import instrument, star
from scipy import stats
from scipy.ndimage import gaussian_filter1d

from mauvecl import Comparison, Expectation, Instrument, Sky, Source, expect
from mauvecl.detection.chi2 import Smoothing
from mauvecl.detection.distributions import QuadraticForm


def whole(quiet: Expectation, flare: Expectation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows, factors of squares and variances of modes of the paper's sum over every pixel."""
    n = quiet.wavelength_nm.size
    sigma = 10.5 / np.sqrt(8 * np.log(2)) / np.median(np.diff(quiet.wavelength_nm))
    rows = gaussian_filter1d(np.eye(n), sigma, axis=0, mode="nearest")
    factor = 1.0 / gaussian_filter1d(flare.recorded_light_dn, sigma, mode="nearest") / flare.exposure_s
    half = np.sqrt(factor)[:, None] * rows
    modes = np.linalg.eigvalsh((half * (quiet.variance_dn2 + quiet.variance_dn2)) @ half.T)
    return rows, factor, modes[modes > 1e-10 * modes.max()]


@pytest.mark.long
def test_few_centres_represent_all_pixels() -> None:
    """Compare draws to 1e-3, thresholds to 1e-4, false alarms to 1e-3 at 1e-2 and to 5e-3 at 1e-10."""
    quiet, flare = star(amplitudes=(0.081,))
    rows, factor, modes = whole(quiet, flare)
    smoothing = Smoothing.of(quiet, np.ones(len(rows), bool), (flare,))
    assert np.diff(smoothing.centres).max() == 7
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, np.sqrt(2 * quiet.variance_dn2), (200, len(rows)))
    for x in (noise, noise + flare.signal_dn - quiet.signal_dn):
        ours = (x @ smoothing.rows.T) ** 2 @ smoothing.scale(flare)
        np.testing.assert_allclose(ours, (x @ rows.T) ** 2 @ factor, rtol=1e-3)
    full = QuadraticForm(modes, np.zeros(modes.size))
    form = smoothing.form(smoothing.scale(flare), np.zeros(len(rows)), 2 * quiet.variance_dn2)
    for fap, error in ((1e-2, 1e-3), (1e-10, 5e-3)):
        assert form.isf(fap) == pytest.approx(full.isf(fap), rel=1e-4)
        assert full.sf(form.isf(fap)) == pytest.approx(fap, rel=error)


def test_every_pixel_is_a_centre_if_few_do_not_suffice() -> None:
    """Use a star without light or sky below 400 nm, where the inverse of the smoothed flux jumps."""
    nm = np.arange(170.0, 1150.0, 0.5)
    dark = Source.from_arrays(nm, np.where(nm > 400.0, 1e-11, 0.0)).at_magnitude(7.4)
    quiet = expect(dark, Instrument.load("mauve"), exposure=50.0, sky=Sky.none())
    used = np.ones(quiet.wavelength_nm.size, bool)
    smoothing = Smoothing.of(quiet, used)
    assert len(smoothing.centres) == used.size
    rows = gaussian_filter1d(np.eye(used.size), smoothing.sigma, axis=0, mode="nearest")
    np.testing.assert_allclose(smoothing.rows, rows)


@pytest.mark.parametrize("chunk", [4, 32])
@pytest.mark.parametrize("changes", [{}, {"output_min_nm": 300.0, "output_max_nm": 330.0}])
def test_bands_hold_the_rows(chunk: int, changes: dict) -> None:
    """Follow the bands in chunks as the kernel does, with some pixels left out."""
    (quiet,) = star(payload=instrument(**changes))
    n = quiet.wavelength_nm.size
    used = np.random.default_rng(2).random(n) > 0.1
    used[20:90] = False
    smoothing = Smoothing.of(quiet, used)
    padded = -(-n // 32) * 32
    weights, finished = smoothing.bands(padded, chunk)
    x = np.zeros(padded)
    x[:n] = np.random.default_rng(3).normal(size=n)
    window, out = np.zeros(weights.shape[1]), []
    for c, count in enumerate(finished):
        window += weights[c] @ x[c * chunk : (c + 1) * chunk]
        out += list(window[:count])
        window = np.append(window[count:], np.zeros(count))
    assert len(out) == len(smoothing.rows)
    np.testing.assert_allclose(out, smoothing.rows @ x[:n], atol=1e-6)


def test_sum_is_a_generalised_chi_squared() -> None:
    """Compare with NumPy's normals: Kolmogorov-Smirnov p > 1e-6 with and without a flare."""
    quiet, flare = star(amplitudes=(0.03,), payload=instrument(part=True))
    smoothing = Smoothing.of(quiet, np.ones(quiet.wavelength_nm.size, bool))
    scale = smoothing.scale(flare)
    rng = np.random.default_rng(4)
    for delta in (np.zeros_like(quiet.signal_dn), flare.signal_dn - quiet.signal_dn):
        form = smoothing.form(scale, delta, 2 * quiet.variance_dn2)
        x = delta + rng.normal(0.0, np.sqrt(2 * quiet.variance_dn2), (20_000, delta.size))
        values = (x @ smoothing.rows.T) ** 2 @ scale
        grid = np.quantile(values, np.linspace(0.01, 0.999, 60))
        ours = np.searchsorted(np.sort(values), grid) / values.size
        theirs = 1 - np.array([form.sf(v) for v in grid])
        assert stats.kstwo.sf(np.abs(ours - theirs).max(), values.size) > 1e-6


def test_comparison_is_read_from_words() -> None:
    assert Comparison.of("stack:5", "estimated") == Comparison(5, True)
    assert Comparison.of("exposure").added_variance == 1.0
    assert Comparison.of().plain
