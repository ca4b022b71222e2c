"""Shapes of flares in time: published check values, integrals against quadrature, frames."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from mauvecl import SHAPES, TableShape

#: A shape whose height and length follow from its equivalent duration.
FIDUCIAL: Any = SHAPES["fiducial"]
#: Where each shape has a kink or a step.
KINKS = {"davenport2014": [-1.0, 0.0], "tovarmendoza2022": [0.0], "fiducial": [0.0, FIDUCIAL.BOX], "table": [0.0, 1.0]}
TABLE = TableShape(np.array([-1.0, 0.0, 1.0, 4.0]), np.array([0.0, 3.0, 1.0, 0.0]))
ALL = [*SHAPES.values(), TABLE]
NAMES = [shape.name for shape in ALL]
#: A value, and digits that its source gives (Davenport et al. 2014; Tovar Mendoza et al. 2022; own quadrature).
KNOWN = [
    ("davenport2014", "equivalent_duration", 1.8268848561, 1e-10),
    ("davenport2014", "square_integral", 0.7214828160, 1e-10),
    ("davenport2014", "peak", 1.0, 1e-15),
    ("davenport2014", "width", 0.9128820, 5e-7),
    ("tovarmendoza2022", "equivalent_duration", 2.0408731751, 1e-10),
    ("tovarmendoza2022", "square_integral", 0.7953667, 5e-8),
    ("tovarmendoza2022", "peak", 0.9501549, 5e-8),
    ("tovarmendoza2022", "peak_at", -0.0025694, 5e-8),
    ("tovarmendoza2022", "width", 1.0866563, 5e-8),
    ("fiducial", "width", 1.0, 1e-12),
    ("table", "peak", 1.0, 0.0),
]


def between(function, first: float, last: float, kinks: list[float]) -> float:
    """Integrate a shape numerically, piece by piece."""
    ends = [first, *(k for k in kinks if first < k < last), last]
    return sum(quad(function, a, b, epsabs=1e-14, epsrel=1e-12, limit=400)[0] for a, b in itertools.pairwise(ends))


@pytest.mark.parametrize(("name", "what", "value", "within"), KNOWN)
def test_shapes_equal_published_values(name, what, value, within):
    shape = dict(zip(NAMES, ALL, strict=True))[name]
    assert getattr(shape, what) == pytest.approx(value, rel=0, abs=within)


def test_area_equals_the_published_closed_form():
    shape = SHAPES["tovarmendoza2022"]
    (f1, d1), (f2, d2) = shape.DECAY
    area = shape.A * shape.C * np.sqrt(np.pi) * np.exp((shape.B / shape.C) ** 2) * (f1 / d1 + f2 / d2)
    assert shape.equivalent_duration == pytest.approx(area, rel=1e-13)


def test_davenport_shape_has_its_rise_and_decay():
    shape = SHAPES["davenport2014"]
    assert float(shape.before(0.0)) == pytest.approx(0.3078476667, abs=1e-10)
    assert float(shape.after(0.0)) == pytest.approx(1.5190371894, abs=1e-10)
    assert float(shape.at(1e-14)) == pytest.approx(0.991971, abs=1e-12)
    assert float(shape.at(-1 + 1e-14)) == pytest.approx(0.005286, abs=1e-12)
    assert float(shape.at(-1.0)) == 0.0


@pytest.mark.parametrize(
    ("name", "shares"),
    [
        ("davenport2014", {1: 0.50136, 5: 0.85175, 10: 0.96315, 20: 0.99772}),
        ("tovarmendoza2022", {10: 0.89196, 20: 0.97719}),
    ],
)
def test_fluence_before_a_time_is_the_integral(name, shares):
    shape = SHAPES[name]
    for tau, share in shares.items():
        assert float(shape.before(tau)) / shape.equivalent_duration == pytest.approx(share, abs=5e-6)


def test_shape_equals_the_published_formula():
    # Tovar Mendoza et al. 2022 as printed, with plain exp and erfc.
    from scipy.special import erfc

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


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
def test_integrals_agree_with_quadrature(shape):
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


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
def test_frames_sum_to_the_fluence_outside_of_gaps(shape):
    edges = np.arange(-100, 30_001) * 5.0
    means = shape.mean_over(edges, 777.7, 33.0)
    assert 5.0 * means.sum() == pytest.approx(33.0 * shape.equivalent_duration, rel=1e-12)
    pairs = np.column_stack([edges[:-1], edges[1:]])[[3, 255, 256, 900]]
    np.testing.assert_array_equal(shape.mean_over(pairs, 777.7, 33.0), means[[3, 255, 256, 900]])
    several = shape.mean_over(edges, np.array([[777.7], [900.0]]), np.array([[33.0], [10.0]]))
    np.testing.assert_array_equal(several[0], means)


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
def test_frames_conserve_light_of_any_flare(shape):
    # Whole stares about 400 random flares: scipy's erfc underflows to 0 before a product with an exponential does.
    rng = np.random.Generator(np.random.Philox(26))
    for _ in range(400):
        peak, half = rng.uniform(-2000.0, 8000.0), 10 ** rng.uniform(-2.0, 6.0)
        with np.errstate(all="raise", under="ignore"):
            means = shape.mean_over(np.arange(1201) * 5.0, peak, half)
        assert (means >= 0).all(), (peak, half, means.min())


def test_tovar_mendoza_rise_keeps_its_digits():
    # Against quadrature of the shape itself, down to where doubles end.
    shape = SHAPES["tovarmendoza2022"]
    for tau in (-0.2513, -0.4, -1.0, -2.0, -4.0, -6.0):
        # In units of the shape's own value at the end, so that quadrature sees something.
        scale = float(shape.at(tau))
        exact = scale * quad(lambda t: float(shape.at(t)) / scale, tau - 1.0, tau, epsrel=1e-12, limit=400)[0]  # noqa: B023
        assert float(shape.before(tau)) == pytest.approx(exact, rel=1e-8)


def test_late_frame_keeps_its_digits():
    # The difference of two integrals from the beginning would have none left here.
    shape = SHAPES["davenport2014"]
    (a, b), (c, d) = shape.DECAY
    exact = a / b * (np.exp(-b * 100) - np.exp(-b * 101)) + c / d * (np.exp(-d * 100) - np.exp(-d * 101))
    assert float(shape.integral(100, 101)) == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize("shape", ALL, ids=NAMES)
def test_peak_and_width_agree_with_a_fine_scan(shape):
    tau = np.linspace(-2, 5, 700_001)
    values = shape.at(tau)
    # Davenport's peak is a step's upper edge.
    assert values.max() == pytest.approx(shape.peak, abs=1e-8)
    assert (values > shape.peak / 2).sum() * 1e-5 == pytest.approx(shape.width, abs=3e-5)


def test_fiducial_flare_has_its_equivalent_duration():
    for delta in (100.0, 1000.0, 1e5):
        amplitude, half_width = FIDUCIAL.of(delta)
        shape = SHAPES["fiducial"]
        assert amplitude == pytest.approx(0.3 * delta**0.6)
        assert amplitude * half_width * shape.equivalent_duration == pytest.approx(delta, rel=1e-12)
        box = amplitude * half_width * shape.BOX
        assert box == pytest.approx(delta / 1.5, rel=1e-12)
