"""The paper's smoothing, its bands for the device, and the distribution of the sum of squares."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import instrument, star
from scipy import stats
from scipy.ndimage import gaussian_filter1d

from mauvecl.comparison import Comparison
from mauvecl.host.errors import InputError
from mauvecl.smoothing import SMOOTHING_NM, Smoothing


def test_few_centres_say_what_all_pixels_say() -> None:
    """The paper's sum over every pixel of the filtered spectra, from every seventh: within 2 %, which the ends cost."""
    quiet, flare = star(amplitudes=(0.081,))
    used = np.ones(quiet.wavelength_nm.size, bool)
    smoothing = Smoothing.of(quiet, used)
    assert np.diff(smoothing.centres).max() == 7
    sigma = SMOOTHING_NM / np.sqrt(8 * np.log(2)) / np.median(np.diff(quiet.wavelength_nm))
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, np.sqrt(2 * quiet.variance_dn2), (200, used.size))
    for x in (noise, noise + flare.signal_dn - quiet.signal_dn):
        smoothed = gaussian_filter1d(x / 50.0, sigma, axis=1, mode="nearest")
        expected = gaussian_filter1d(flare.signal_dn / 50.0, sigma, mode="nearest")
        full = np.sum(smoothed**2 / expected, axis=1)
        ours = (x @ smoothing.rows.T) ** 2 @ smoothing.scale(flare)
        np.testing.assert_allclose(ours.mean(), full.mean(), rtol=0.02)
        np.testing.assert_allclose(ours, full, rtol=0.15)


@pytest.mark.parametrize("chunk", [4, 32])
@pytest.mark.parametrize("changes", [{}, {"output_min_nm": 300.0, "output_max_nm": 330.0}])
def test_bands_hold_the_rows(chunk: int, changes: dict) -> None:
    """Followed as the kernel follows them, chunk by chunk, with some pixels left out."""
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


def test_the_sum_is_a_generalised_chi_squared() -> None:
    """Against NumPy's normals: Kolmogorov-Smirnov p > 1e-6 with and without a flare."""
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


@pytest.mark.parametrize("words", [("stack",), ("stack:0",), ("mean",), ("exposure:2",), ("template", "guessed")])
def test_words_that_are_none(words: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="expected"):
        Comparison.of(*words)
    assert Comparison.of("stack:5", "estimated") == Comparison(5, True)
    assert Comparison.of("exposure").share == 1.0
    assert Comparison.of().plain
