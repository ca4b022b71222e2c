"""Shapes of flares in time and their energies: published values, integrals against quadrature, frames."""

import itertools
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.models import BlackBody
from scenes import through
from scipy.integrate import quad
from scipy.special import erfc

from mauvecl import SHAPES, EnergyScale, Event, TableShape

#: A shape whose height and length follow from its equivalent duration.
FIDUCIAL: Any = SHAPES["fiducial"]
#: Where each shape has a kink or a step.
KINKS = {"davenport2014": [-1.0, 0.0], "tovarmendoza2022": [0.0], "fiducial": [0.0, FIDUCIAL.BOX], "table": [0.0, 1.0]}
TABLE = TableShape(np.array([-1.0, 0.0, 1.0, 4.0]), np.array([0.0, 3.0, 1.0, 0.0]))
every_shape = pytest.mark.parametrize("shape", [*SHAPES.values(), TABLE], ids=lambda shape: shape.name)


def between(function, first: float, last: float, kinks: list[float]) -> float:
    ends = [first, *(k for k in kinks if first < k < last), last]
    return sum(quad(function, a, b, epsabs=1e-14, epsrel=1e-12, limit=400)[0] for a, b in itertools.pairwise(ends))


def test_shapes_equal_the_published_formulas():
    # Tovar Mendoza et al. 2022 as printed, with plain exp and erfc.
    shape, tau = SHAPES["tovarmendoza2022"], np.linspace(-1.2, 30, 500)
    a, b, c = shape.A, shape.B, shape.C
    printed = sum(
        np.sqrt(np.pi) / 2 * a * c * f * np.exp(-d * tau + (b / c + d * c / 2) ** 2) * erfc((b - tau) / c + c * d / 2)
        for f, d in shape.DECAY
    )
    np.testing.assert_allclose(shape.at(tau), printed, rtol=1e-10, atol=1e-15)
    with np.errstate(all="raise", under="ignore"):
        far = shape.at(np.array([-1e4, -50.0, 1e4]))
    assert (far == 0).all()
    # The fiducial flare has its equivalent duration.
    for delta in (100.0, 1000.0, 1e5):
        amplitude, half_width = FIDUCIAL.of(delta)
        assert amplitude == pytest.approx(0.3 * delta**0.6)
        assert amplitude * half_width * FIDUCIAL.equivalent_duration == pytest.approx(delta, rel=1e-12)
        assert amplitude * half_width * FIDUCIAL.BOX == pytest.approx(delta / 1.5, rel=1e-12)


@every_shape
def test_integrals_agree_with_quadrature_and_peaks_with_a_fine_scan(shape):
    kinks = KINKS[shape.name]
    top = max(kinks) + 3.0
    tail = quad(lambda t: float(shape.at(t)), top, np.inf, epsabs=1e-14)[0] if shape is not TABLE else 0.0
    whole = between(lambda t: float(shape.at(t)), -3.0, top, kinks) + tail
    assert shape.equivalent_duration == pytest.approx(whole, abs=1e-11)
    squares = between(lambda t: float(shape.at(t)) ** 2, -3.0, top + 100, [*kinks, top, top + 10, top + 30])
    assert shape.square_integral == pytest.approx(squares, abs=1e-11)
    # Pieces anywhere, of any length.
    edges = np.array([-2.5, -1.3, -1.0, -0.7, -0.2, 0.0, 0.1, 0.6, 0.9, 3.0, 3.5, 9.0])
    exact = [between(lambda t: float(shape.at(t)), a, b, kinks) for a, b in itertools.pairwise(edges)]
    np.testing.assert_allclose(shape.integral(edges[:-1], edges[1:]), exact, atol=1e-12)
    tau = np.linspace(-2, 5, 700_001)
    values = shape.at(tau)
    # Davenport's peak is a step's upper edge.
    assert values.max() == pytest.approx(shape.peak, abs=1e-8)
    assert (values > shape.peak / 2).sum() * 1e-5 == pytest.approx(shape.width, abs=3e-5)
    assert Event(0.0, 1.0, 0.4, shape=shape).peak == pytest.approx(0.4 * values.max(), abs=1e-8)


@every_shape
def test_frames_sum_to_the_fluence_and_conserve_light_of_any_flare(shape):
    edges = np.arange(-100, 30_001) * 5.0
    means = shape.mean_over(edges, 777.7, 33.0)
    assert 5.0 * means.sum() == pytest.approx(33.0 * shape.equivalent_duration, rel=1e-12)
    pairs = np.column_stack([edges[:-1], edges[1:]])[[3, 255, 256, 900]]
    np.testing.assert_array_equal(shape.mean_over(pairs, 777.7, 33.0), means[[3, 255, 256, 900]])
    several = shape.mean_over(edges, np.array([[777.7], [900.0]]), np.array([[33.0], [10.0]]))
    np.testing.assert_array_equal(several[0], means)
    # Whole stares about 400 random flares: scipy's erfc underflows to 0 before a product with an exponential does.
    rng = np.random.Generator(np.random.Philox(26))
    for _ in range(400):
        peak, half = rng.uniform(-2000.0, 8000.0), 10 ** rng.uniform(-2.0, 6.0)
        with np.errstate(all="raise", under="ignore"):
            assert (shape.mean_over(np.arange(1201) * 5.0, peak, half) >= 0).all(), (peak, half)


def test_small_integrals_keep_their_digits():
    # Against quadrature in units of the shape's own value at the end, down to where doubles end.
    shape = SHAPES["tovarmendoza2022"]
    for tau in (-0.2513, -0.4, -1.0, -2.0, -4.0, -6.0):
        scale = float(shape.at(tau))
        exact, _ = quad(lambda t, unit: float(shape.at(t)) / unit, tau - 1.0, tau, scale, epsrel=1e-12, limit=400)
        assert float(shape.before(tau)) / scale == pytest.approx(exact, rel=1e-8)
    # The difference of two integrals from the beginning would have none left here.
    shape = SHAPES["davenport2014"]
    exact = sum(a / b * (np.exp(-b * 100) - np.exp(-b * 101)) for a, b in shape.DECAY)
    assert float(shape.integral(100, 101)) == pytest.approx(exact, rel=1e-10)


SUN_CM, NM = 6.957e10, np.linspace(200.0, 1200.0, 40_001)
#: erg/s of Shibayama et al. 2013's formula by other tables of the bands, for flares of 9000 and 10 000 K.
ELSEWHERE = [
    ("Kepler", 5778, 1.0, 1.1774e33, 1.3289e33),
    ("Kepler", 4830, 0.755, 2.9825e32, 3.3663e32),
    ("Kepler", 3200, 0.2, 1.9525e30, 2.2037e30),
    ("TESS", 5778, 1.0, 1.5365e33, 1.8197e33),
]


def planck(kelvin: float) -> np.ndarray:
    """Return the flux at the surface of a blackbody at `NM`, by astropy, erg s-1 cm-2 A-1."""
    scale = 1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    return np.asarray(np.pi * BlackBody(kelvin * u.K, scale=scale)(NM * u.nm).value)


@pytest.mark.parametrize(("name", "star_k", "radius", "cool", "hot"), ELSEWHERE)
def test_energies_agree_with_direct_integration_and_other_band_tables(
    name: str, star_k: float, radius: float, cool: float, hot: float
) -> None:
    # The embedded bands are those of pyphot; with another table of Kepler's or TESS's energies differ by up to 1.4 %.
    sphere = 4 * np.pi * (radius * SUN_CM) ** 2
    for flare_k, elsewhere in ((9000.0, cool), (10_000.0, hot)):
        bolometric = sphere * 5.670374419e-5 * flare_k**4
        star, flare = planck(star_k), planck(flare_k)
        bodies, weighted = (through(name, NM, by * star) / through(name, NM, by * flare) for by in (NM, 1.0))
        published = EnergyScale.shibayama2013(radius, star_k, band=name, flare_k=flare_k).erg_per_s
        assert published == pytest.approx(bolometric / 4 * weighted, rel=2e-6)
        assert published == pytest.approx(elsewhere, rel=0.015)
        exact = {"bolometric": bolometric * bodies, "band": sphere * bodies * through(name, NM, flare)}
        for kind, value in exact.items():
            scale = EnergyScale.of_blackbody(radius, star_k, band=name, flare_k=flare_k, kind=kind)  # type: ignore[arg-type]
            assert scale.erg_per_s == pytest.approx(value, rel=2e-6)
