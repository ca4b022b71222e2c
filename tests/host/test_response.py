"""The response of the detector to light, compared with quadrature."""

from typing import Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import quad
from scipy.special import erf

from mauvecl import Instrument, Sky, Source, expect

Float = NDArray[np.float64]
Order = Literal["paper", "physical"]

KERNELS = pytest.mark.parametrize(("top_hat", "fwhm"), [(10.8, 10.5), (10.8, 0.0), (0.0, 10.5), (2.0, 0.4)])
ORDERS = pytest.mark.parametrize("order", ["paper", "physical"])
CHARGE_C = 1.602176634e-19


def rate_of(instrument: Instrument, nm: ArrayLike, flux: ArrayLike, order: Order = "paper") -> Float:
    """Return the electrons per second of a spectrum, of which the star has a trillionth."""
    star = Source.from_arrays(np.asarray(nm), 1e-12 * np.asarray(flux, float))
    x = expect(star, instrument, exposure=instrument.frame_s, sky=Sky.none(), order=order)
    return np.asarray(1e12 * x.source_electrons / x.frame_s)


def line_function(x: Float, top_hat: float, fwhm: float) -> Float:
    """Return a top hat convolved with a Gaussian, nm^-1, implemented independently."""
    sigma = fwhm / 2.354820045030949
    if top_hat == 0:
        return np.asarray(np.exp(-(x**2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi)))
    if fwhm == 0:
        return np.asarray(np.where(np.abs(x) < top_hat / 2, 1 / top_hat, 0.0))
    root = np.sqrt(2) * sigma
    return np.asarray((erf((x + top_hat / 2) / root) - erf((x - top_hat / 2) / root)) / (2 * top_hat))


def landing(offset: Float, instrument: Instrument) -> Float:
    """Integrate the line function numerically over pixels at an array of offsets, nm."""
    half, top_hat = instrument.dispersion_nm_per_pixel / 2, instrument.top_hat_width_nm
    fwhm = instrument.gaussian_fwhm_nm
    if fwhm == 0:  # the overlap of two intervals
        low, high = np.maximum(offset - half, -top_hat / 2), np.minimum(offset + half, top_hat / 2)
        return np.asarray(np.maximum(high - low, 0) / top_hat)
    x, w = np.polynomial.legendre.leggauss(24)
    return np.asarray(line_function(offset[..., None] + half * x, top_hat, fwhm) @ w * half)


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


def test_whole_profile_has_the_width_of_the_paper() -> None:
    """The independent line function is the convolution, and is as wide as the paper says of the Gaussian alone."""
    sigma = 10.5 / 2.354820045030949
    for x in (0.0, 3.0, 9.0, 20.0):
        smoothed, _ = quad(lambda y, x=x: line_function(x - y, 0.0, 10.5) / 10.8, -5.4, 5.4)
        assert line_function(np.array(x), 10.8, 10.5) == pytest.approx(smoothed, rel=1e-10)
    assert line_function(np.array(0.0), 0.0, 10.5) == pytest.approx(1 / (sigma * np.sqrt(2 * np.pi)))
    offset = np.linspace(0, 15, 15_001)
    density = line_function(offset, 10.8, 10.5)
    assert 2 * np.interp(-density[0] / 2, -density, offset) == pytest.approx(13.3, abs=0.05)


@ORDERS
@KERNELS
@pytest.mark.parametrize("n", [400, 40_001])
def test_random_spectra_agree_with_quadrature(
    mauve: Instrument, top_hat: float, fwhm: float, order: Order, n: int
) -> None:
    """Try fewer and more nodes than a matrix of the response is made for."""
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    rng = np.random.default_rng(20250101)
    wavelength = np.sort(np.append(rng.uniform(150, 790, n), [150, 790]))
    flux = rng.random(wavelength.size) * np.where(rng.random(wavelength.size) < 0.03, 50, 1)
    rate = rate_of(instrument, wavelength, flux, order)
    # Light of every wavelength reaches one of these.
    for pixel in (0, 1, *range(53, 1642, 53), 1642):
        # Far below the requested 1e-6.
        assert rate[pixel] == pytest.approx(by_quadrature(instrument, wavelength, flux, pixel, order), rel=1e-9)


def per_efficiency(instrument: Instrument, rate: Float) -> Float:
    """Return the flux per pixel, FLAM nm, from electrons per second in the paper's order."""
    nm = instrument.wavelength_nm
    own = instrument.efficiency(nm) * instrument.quantum_efficiency_a_per_w.at(nm)
    return rate / (1e-6 * instrument.collecting_area_cm2 * own / CHARGE_C)


@KERNELS
@pytest.mark.parametrize("half_width", [1e-4, 0.3])
def test_line_lands_as_the_line_function(mauve: Instrument, top_hat: float, fwhm: float, half_width: float) -> None:
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    nodes = np.array([150, 437.1 - half_width, 437.1, 437.1 + half_width, 790])
    landed = per_efficiency(instrument, rate_of(instrument, nodes, [0, 0, 1.0, 0, 0]))
    assert landed.sum() == pytest.approx(half_width, rel=1e-9)
    # A sum over pixels finds the centre of a smooth profile; of a sharp one only to a part of a pixel.
    assert landed @ instrument.wavelength_nm / landed.sum() == pytest.approx(437.1, abs=1e-6 if fwhm > 1 else 0.02)
    if half_width < 1e-3:
        wanted = half_width * landing(instrument.wavelength_nm - 437.1, instrument)
        np.testing.assert_allclose(landed, wanted, rtol=1e-5, atol=1e-7 * wanted.max())
