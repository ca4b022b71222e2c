"""The response matrix, compared with quadrature, and its conserved quantities."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import erf

from mauvecl.host import response
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.instrument.line_spread import LineSpread
from mauvecl.host.response import Order, electrons_per_second, response_matrix

Float = NDArray[np.float64]

KERNELS = [(10.8, 10.5), (10.8, 0.0), (0.0, 10.5), (2.0, 0.4)]
CHARGE_C = 1.602176634e-19


@pytest.fixture(scope="module")
def mauve() -> Instrument:
    return Instrument.load("mauve")


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
    half, top_hat, fwhm = (
        instrument.dispersion_nm_per_pixel / 2,
        instrument.top_hat_width_nm,
        instrument.gaussian_fwhm_nm,
    )
    if fwhm == 0:  # the overlap of two intervals
        low, high = np.maximum(offset - half, -top_hat / 2), np.minimum(offset + half, top_hat / 2)
        return np.asarray(np.maximum(high - low, 0) / top_hat)
    x, w = np.polynomial.legendre.leggauss(24)
    return np.asarray(line_function(offset[..., None] + half * x, top_hat, fwhm) @ w * half)


def brute(instrument: Instrument, wavelength: Float, flux: Float, pixel: int, order: Order) -> float:
    """Compute a pixel's electrons per second by adaptive quadrature between all kinks."""
    centre = instrument.wavelength_nm[pixel]
    corner = (instrument.top_hat_width_nm + np.array([-1, 1]) * instrument.dispersion_nm_per_pixel) / 2
    reach = corner[1] + 8 * instrument.gaussian_fwhm_nm / 2.35
    kinks = np.concatenate([wavelength, instrument.knots_nm, centre - corner, centre + corner])
    low, high = max(centre - reach, wavelength[0]), min(centre + reach, wavelength[-1])
    edges = np.unique(np.concatenate([[low, high], kinks[(kinks > low) & (kinks < high)]]))

    def integrand(x: float) -> float:
        own = x if order == "physical" else centre
        amperes = instrument.electrons_per_joule_cm2(own, held=True) * CHARGE_C
        share = landing(np.array(centre - x), instrument)
        # erg s^-1 cm^-2 A^-1 is 1e-6 W cm^-2 nm^-1.
        return float(np.interp(x, wavelength, flux) * 1e-6 * share * amperes / CHARGE_C)

    peak = max(integrand(x) for x in np.linspace(low, high, 101))
    pieces = [quad(integrand, a, b, epsabs=1e-12 * peak, epsrel=1e-11) for a, b in pairwise(edges)]
    return float(sum(piece[0] for piece in pieces))


@pytest.mark.parametrize(("top_hat", "fwhm"), KERNELS)
def test_line_spread_equals_the_convolution(mauve: Instrument, top_hat: float, fwhm: float) -> None:
    line = LineSpread.of(mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm))
    x = np.array([-30.0, -7.0, -5.0, -0.3, 0.0, 1.0, 5.2, 11.0])
    np.testing.assert_allclose(line.density(x), line_function(x, top_hat, fwhm), rtol=1e-9, atol=1e-15)
    edges = [-60.0, -top_hat / 2, 0.0, top_hat / 2, 60.0]
    total = sum(quad(lambda x: float(line.density(x)), a, b, epsrel=1e-10)[0] for a, b in pairwise(edges))
    assert total == pytest.approx(1, abs=1e-9)


def test_line_function_is_the_convolution(mauve: Instrument) -> None:
    sigma = 10.5 / 2.354820045030949
    for x in (0.0, 3.0, 9.0, 20.0):
        smoothed, _ = quad(
            lambda y, x=x: np.exp(-((x - y) ** 2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi)) / 10.8, -5.4, 5.4
        )
        assert LineSpread.of(mauve).density(x) == pytest.approx(smoothed, rel=1e-10)
    # The whole profile's width, quoted in the paper as that of the Gaussian alone.
    offset = np.linspace(0, 15, 15_001)
    density = LineSpread.of(mauve).density(offset)
    assert 2 * np.interp(-density[0] / 2, -density, offset) == pytest.approx(13.3, abs=0.05)


@pytest.mark.long
@pytest.mark.parametrize("order", ["paper", "physical"])
@pytest.mark.parametrize(("top_hat", "fwhm"), KERNELS)
def test_random_spectra_agree_with_quadrature(mauve: Instrument, top_hat: float, fwhm: float, order: Order) -> None:
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    rng = np.random.default_rng(20250101)
    wavelength = np.sort(np.append(rng.uniform(180, 750, 400), [180, 750]))
    flux = rng.random(wavelength.size) * np.where(rng.random(wavelength.size) < 0.03, 50, 1) * 1e-13
    rate = electrons_per_second(instrument, wavelength, flux, order)
    for pixel in (0, 811, 1642):
        # Far below the requested 1e-6.
        assert rate[pixel] == pytest.approx(brute(instrument, wavelength, flux, pixel, order), rel=1e-9)


def per_efficiency(instrument: Instrument, rate: Float) -> Float:
    """Return the flux per pixel, FLAM nm, from electrons per second in the paper's order."""
    own = instrument.efficiency(instrument.wavelength_nm) * instrument.quantum_efficiency_a_per_w.at(
        instrument.wavelength_nm
    )
    return rate / (1e-6 * instrument.collecting_area_cm2 * own / CHARGE_C)


def test_flat_spectrum_stays_flat(mauve: Instrument) -> None:
    rate = electrons_per_second(mauve, [100.0, 800.0], [2e-13, 2e-13])
    np.testing.assert_allclose(per_efficiency(mauve, rate), 2e-13 * 0.3043, rtol=1e-12)


@pytest.mark.parametrize(("top_hat", "fwhm"), KERNELS)
@pytest.mark.parametrize("half_width", [1e-4, 0.3])
def test_line_keeps_its_flux_and_position(mauve: Instrument, top_hat: float, fwhm: float, half_width: float) -> None:
    instrument = mauve.with_(top_hat_width_nm=top_hat, gaussian_fwhm_nm=fwhm)
    nodes = np.array([180, 437.1 - half_width, 437.1, 437.1 + half_width, 750])
    landed = per_efficiency(instrument, electrons_per_second(instrument, nodes, [0, 0, 1.0, 0, 0]))
    assert landed.sum() == pytest.approx(half_width, rel=1e-9)
    # A sum over pixels finds the centre of a smooth profile; of a sharp one only to a part of a pixel.
    assert landed @ instrument.wavelength_nm / landed.sum() == pytest.approx(437.1, abs=1e-6 if fwhm > 1 else 0.02)


def test_response_conserves_light(mauve: Instrument) -> None:
    rng = np.random.default_rng(7)
    wavelength = np.sort(rng.uniform(170, 760, 900))
    matrix = response_matrix(mauve, wavelength)
    assert matrix.shape == (1643, 900)
    landed = per_efficiency(mauve, np.ones(1643)) @ matrix.toarray()
    width = np.diff(wavelength)
    area = (np.append(width, 0) + np.append(0, width)) / 2  # of the nodes' hat functions
    reach = LineSpread.of(mauve).reach
    inside = np.flatnonzero((wavelength > 200 + reach) & (wavelength < 700 - reach))[1:-1]
    np.testing.assert_allclose(landed[inside], area[inside], rtol=1e-9)
    assert (landed < area * (1 + 1e-9)).all()
    assert matrix.min() > -1e-12 * matrix.max()


@pytest.mark.parametrize("order", ["paper", "physical"])
def test_many_nodes_lose_no_flux(mauve: Instrument, order: Order) -> None:
    rng = np.random.default_rng(11)
    wavelength = np.linspace(180, 750, 150_001)
    flux = rng.exponential(size=wavelength.size)
    rate = electrons_per_second(mauve, wavelength, flux, order)
    # Cells of 0.004 nm: three points each are brute force here.
    x, w = np.polynomial.legendre.leggauss(3)
    at = wavelength[:-1, None] + np.diff(wavelength)[:, None] * (1 + x) / 2
    mass = np.interp(at, wavelength, flux) * np.diff(wavelength)[:, None] / 2 * w * 1e-6 / CHARGE_C
    for pixel in (0, 700, 1642):
        centre = mauve.wavelength_nm[pixel]
        own = at if order == "physical" else centre
        amperes = mauve.electrons_per_joule_cm2(own, held=True) * CHARGE_C
        near = np.abs(at[:, 0] - centre) < 45
        expected = np.sum((mass * amperes)[near] * landing(centre - at[near], mauve))
        assert rate[pixel] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("order", ["paper", "physical"])
def test_results_with_and_without_a_matrix_agree(
    mauve: Instrument, order: Order, monkeypatch: pytest.MonkeyPatch
) -> None:
    wavelength = np.linspace(180, 750, 3001)
    flux = 1 + np.sin(wavelength)
    by_matrix = electrons_per_second(mauve, wavelength, flux, order)
    monkeypatch.setattr(response, "MATRIX_NODES", 0)
    monkeypatch.setattr(response, "CHUNK", 97)
    np.testing.assert_allclose(electrons_per_second(mauve, wavelength, flux, order), by_matrix, rtol=1e-12)


def test_redundant_nodes_change_nothing(mauve: Instrument) -> None:
    wavelength = np.array([150.0, 230.0, 390.0, 400.0, 800.0])
    flux = np.array([0.0, 1.0, 3.0, 1.0, 2.0])
    more = np.union1d(wavelength, np.linspace(150, 800, 5000))
    np.testing.assert_allclose(
        electrons_per_second(mauve, wavelength, flux),
        electrons_per_second(mauve, more, np.interp(more, wavelength, flux)),
        rtol=1e-10,
    )


def test_physical_order_applies_the_efficiency_of_the_light(mauve: Instrument) -> None:
    nodes = np.array([180, 302.999, 303.0, 303.001, 750])
    rate = electrons_per_second(mauve, nodes, [0, 0, 1.0, 0, 0], "physical")
    own = mauve.efficiency(303.0) * mauve.quantum_efficiency_a_per_w.at(303.0)
    assert rate.sum() == pytest.approx(1e-6 * 0.001 * 122 * own / CHARGE_C, rel=1e-6)


def test_order_matters_where_the_efficiency_is_steep(mauve: Instrument) -> None:
    # For a flat flux it is the efficiency's curvature alone: some per cent at most, but at the ends of the range.
    nodes, flat = np.array([100.0, 900.0]), np.ones(2)
    ratio = electrons_per_second(mauve, nodes, flat, "physical") / electrons_per_second(mauve, nodes, flat)
    assert np.abs(ratio[100:-100] - 1).max() < 0.03
    assert np.abs(ratio - 1).max() > 0.005


def test_light_out_of_reach_is_not_detected(mauve: Instrument) -> None:
    assert not electrons_per_second(mauve, [900.0, 1000.0], [1.0, 1.0]).any()
    beyond = LineSpread.of(mauve).reach + 1
    assert electrons_per_second(mauve, [500.0, 501.0], [1.0, 1.0])[mauve.wavelength_nm > 501 + beyond].max() == 0


def test_matrix_is_cached(mauve: Instrument) -> None:
    wavelength = np.linspace(180, 750, 500)
    first = response_matrix(mauve, wavelength)
    assert response_matrix(Instrument.load("mauve"), wavelength.copy()) is first
    assert response_matrix(mauve.with_(light_loss=0.3), wavelength) is not first
    with pytest.raises(ValueError, match="read-only"):
        first.data[0] = 1.0
