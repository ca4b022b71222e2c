"""The joint draw of Gaussian and Poisson noise against their exact convolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import star
from scipy import special, stats

from mauvecl.device.engine import Engine
from mauvecl.device.selftest import pearson
from mauvecl.host.expectation import Expectation
from mauvecl.noise import layout
from mauvecl.noise.cumulants import MAX_SKEW, Cumulants, joint_is_exact, needs_fourth_power, polynomial
from mauvecl.noise.scene import prepare


def one_pixel(dark: float, photons: float, read: float, *, unit: str = "DN", noise: str = "poisson") -> Expectation:
    """Make an expectation of one frame with equal pixels, bias 600 and gain 0.6."""
    (x,) = star(exposure=5.0)
    full = np.ones_like(x.dark_dn)
    return replace(
        x,
        source_electrons=photons * full,
        sky_electrons=0 * full,
        dark_dn=dark * full,
        dark_unit=unit,
        bias_dn=600.25 * full,
        read_noise_dn=read * full,
        gain_dn_per_electron=0.6 * full,
        photon_noise=noise,
    )


def exact(x: Expectation, low: int, size: int) -> np.ndarray:
    """Return the probabilities of the raw counts low, low + 1, ..., summed over all Poisson outcomes."""
    dark, photons, read = x.dark_dn[0], x.source_electrons[0], x.read_noise_dn[0]
    step, gain = x.dark_step_dn[0], x.gain_dn_per_electron[0]
    if x.photon_noise == "gaussian":
        read, photon_counts, photon_p = np.hypot(read, gain * np.sqrt(photons)), np.array([photons]), np.ones(1)
    else:
        photon_counts = np.arange(int(photons + 12 * np.sqrt(photons) + 25))
        photon_p = stats.poisson.pmf(photon_counts, photons)
    dark_counts = np.arange(
        max(int(dark / step - 11 * np.sqrt(dark / step) - 20), 0), int(dark / step + 12 * np.sqrt(dark / step) + 25)
    )
    dark_p = stats.poisson.pmf(dark_counts, dark / step)
    edges = np.arange(low, low + size + 1) - 0.5 - x.bias_dn[0]
    # Gaussian and dark first: their sum at any offset is a smooth function, needed at edges less the photons.
    found = np.zeros(size)
    for count, p in zip(photon_counts, photon_p, strict=True):
        if p < 1e-18:
            continue
        u = (edges[:, None] - gain * count - step * dark_counts[None, :]) / read
        below, above = special.ndtr(u) @ dark_p, special.ndtr(-u) @ dark_p
        found += p * np.where(below[1:] < 0.5, np.diff(below), -np.diff(above))
    return found


def by_polynomial(x: Expectation, low: int, size: int) -> np.ndarray:
    """Return the probabilities of the polynomial that the kernels evaluate, in double precision."""
    c = Cumulants.of(x, 1)
    c0, c1, c2, c3, c4 = (float(a[0]) for a in polynomial(c))
    if not needs_fourth_power(c):
        c4 = 0.0
    z = np.linspace(-9.0, 9.0, 200_001)
    draw = c.mean[0] + c0 + z * (c1 + z * (c2 + z * (c3 + z * c4)))
    assert (np.diff(draw) > 0).all()
    at = np.interp(np.arange(low, low + size + 1) - 0.5, draw, z)
    return np.where(at[1:] < 0, np.diff(special.ndtr(at)), -np.diff(special.ndtr(-at)))


#: Dark and photons per frame, read noise: the payload at 21 and at -40 C, the largest skew with its read noise, faint
#: light on a quiet detector, dark in electrons.
PIXELS = {
    "payload": one_pixel(2225.0, 3.0, 12.0),
    "cold": one_pixel(34.0, 0.3, 12.0),
    "most skewed": one_pixel(288.0, 1.0, 12.0),
    "counting": one_pixel(5.0, 40.0, 6.0),
    "electrons": one_pixel(2225.0, 20.0, 12.0, unit="electrons"),
    "gaussian photons": one_pixel(100.0, 50.0, 12.0, noise="gaussian"),
}


def span(x: Expectation) -> tuple[int, int]:
    reach = int(9 * np.sqrt(x.variance_dn2[0])) + 5
    return int(x.mean_raw_dn[0]) - reach, 2 * reach


@pytest.mark.long
@pytest.mark.parametrize("name", PIXELS)
def test_joint_draws_cannot_be_distinguished_from_exact_ones(name: str) -> None:
    """Pearson's test would need 1e12 draws to see the polynomial at five sigma; most cases far more."""
    x = PIXELS[name]
    assert joint_is_exact(Cumulants.of(x, 1)).all()
    low, size = span(x)
    p, q = exact(x, low, size), by_polynomial(x, low, size)
    np.testing.assert_allclose([p.sum(), q.sum()], 1.0, atol=1e-12)
    counts = p > 1e-14
    needed = 5 * np.sqrt(2 * counts.sum()) / np.sum((p - q)[counts] ** 2 / p[counts])
    assert needed > 1e14


def test_noise_that_is_not_smooth_is_drawn_separately() -> None:
    for x in (
        one_pixel(2225.0, 0.0, 1.4),
        one_pixel(2.0, 0.0, 1.0),
        one_pixel(0.0, 9.0, 0.5),
        one_pixel(500.0, 0.0, 3.0),
    ):
        c = Cumulants.of(x, 1)
        assert not joint_is_exact(c).any()
        assert not prepare([x]).joint
    assert Cumulants.of(one_pixel(500.0, 0.0, 3.0), 1).shape()[0][0] > MAX_SKEW
    # Rounding alone, or Gaussian photons alone, need no Poisson steps smoothed.
    assert prepare([one_pixel(0.0, 500.0, 0.0, noise="gaussian")]).joint
    assert prepare([one_pixel(0.0, 0.0, 0.0)]).joint


#: Realisations of 1643 pixels that are all alike: 1e8 draws, which see a skewness that is off by 0.003.
ROWS = 61_000


@pytest.mark.long
@pytest.mark.parametrize("recipe", ["joint", "apart"])
@pytest.mark.parametrize("name", ["payload", "cold", "counting", "electrons"])
def test_pearson_of_raw_counts(engine: Engine, name: str, recipe: str) -> None:
    """Pearson's test of 1e8 raw counts from the production kernel; fails by chance once in 1e6 new seeds."""
    x = PIXELS[name]
    low, size = span(x)
    assert prepare([x], recipe=recipe).joint == (recipe == "joint")
    found = engine.snr(x, realisations=ROWS, seed=31, recipe=recipe)
    assert (found.observers["bin_shift"] == 0).all()
    first = int(found.scene.base_dn[0, 0]) - layout.OBSERVER_BINS // 2
    counts = found.counts.pixel.sum(axis=0)[low - first : low - first + size]
    assert counts.sum() == ROWS * x.wavelength_nm.size
    assert pearson(counts, exact(x, low, size)) > 1e-6
