"""The response of the detector to light, compared with quadrature."""

from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erf

from mauvecl import Instrument, Sky, Source, expect

Float = NDArray[np.float64]
Order = Literal["paper", "physical"]


def landing(offset: Float, instrument: Instrument) -> Float:
    """Integrate a top hat convolved with a Gaussian numerically over pixels at an array of offsets, nm."""
    half, top_hat = instrument.dispersion_nm_per_pixel / 2, instrument.top_hat_width_nm
    root = np.sqrt(2) * instrument.gaussian_fwhm_nm / 2.354820045030949
    if root == 0:  # the overlap of two intervals
        low, high = np.maximum(offset - half, -top_hat / 2), np.minimum(offset + half, top_hat / 2)
        return np.asarray(np.maximum(high - low, 0) / top_hat)
    x, w = np.polynomial.legendre.leggauss(24)
    at = offset[..., None] + half * x
    if top_hat == 0:
        line = np.exp(-((at / root) ** 2)) / (root * np.sqrt(np.pi))
    else:
        line = (erf((at + top_hat / 2) / root) - erf((at - top_hat / 2) / root)) / (2 * top_hat)
    return np.asarray(line @ w * half)


def by_quadrature(instrument: Instrument, wavelength: Float, flux: Float, pixel: int, order: Order) -> float:
    """Compute a pixel's electrons per second by Gauss-Legendre quadrature between all kinks."""
    centre = instrument.wavelength_nm[pixel]
    corner = (instrument.top_hat_width_nm + np.array([-1, 1]) * instrument.dispersion_nm_per_pixel) / 2
    reach = corner[1] + 8 * instrument.gaussian_fwhm_nm / 2.35 + 0.1
    within = np.linspace(centre - reach, centre + reach, 400)
    edges = np.unique(np.concatenate([wavelength, instrument.knots_nm, centre - corner, centre + corner, within]))
    edges = edges[np.abs(edges - centre) <= reach]
    x, w = np.polynomial.legendre.leggauss(8)
    at = edges[:-1, None] + np.diff(edges)[:, None] * (1 + x) / 2
    per_joule = instrument.electrons_per_joule_cm2(at if order == "physical" else centre, held=True)
    # erg s^-1 cm^-2 A^-1 is 1e-6 W cm^-2 nm^-1.
    light = np.interp(at, wavelength, flux) * 1e-6 * landing(centre - at, instrument)
    return float(np.sum(light * per_joule * np.diff(edges)[:, None] / 2 * w))


@pytest.mark.parametrize("order", ["paper", "physical"])
@pytest.mark.parametrize(("top_hat", "fwhm"), [(10.8, 10.5), (10.8, 0.0), (0.0, 10.5), (2.0, 0.4)])
@pytest.mark.parametrize("n", [400, 40_001])
def test_random_spectra_agree_with_quadrature(
    mauve: Instrument, top_hat: float, fwhm: float, order: Order, n: int
) -> None:
    """Try fewer and more nodes than a matrix of the response is made for."""
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    rng = np.random.default_rng(20250101)
    wavelength = np.sort(np.append(rng.uniform(150, 790, n), [150, 790]))
    flux = rng.random(wavelength.size) * np.where(rng.random(wavelength.size) < 0.03, 50, 1)
    star = Source.from_arrays(wavelength, 1e-12 * flux)
    x = expect(star, instrument, exposure=instrument.frame_s, sky=Sky.none(), order=order)
    rate = 1e12 * x.source_electrons / x.frame_s
    # Light of every wavelength reaches one of these.
    for pixel in (0, 1, *range(53, 1642, 53), 1642):
        # Far below the requested 1e-6.
        assert rate[pixel] == pytest.approx(by_quadrature(instrument, wavelength, flux, pixel, order), rel=1e-9)
