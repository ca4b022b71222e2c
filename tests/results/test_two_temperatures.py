"""Fits of two blackbodies with two free temperatures."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import stats

from mauvecl import Engine, Expectation, FlareModel, Instrument, Source, TwoBlackbodies, expect, fit
from mauvecl import fit_two_temperatures as fit_two

MAUVE = Instrument.load("mauve")
FLARE = TwoBlackbodies(8000.0, 30_000.0, 0.05)


@cache
def star() -> Source:
    return Source.from_library("M3V").at_magnitude(9.0)


@cache
def expectations() -> tuple[Expectation, Expectation, Expectation]:
    """Return expectations without a flare, with one of two temperatures, and with one of 9000 K."""
    lit = (star().flaring(3.0, spectrum=FLARE), star().flaring(0.5, 9000.0))
    quiet, two, one = (expect(x, MAUVE, exposure=50.0) for x in (star(), *lit))
    return quiet, two, one


@cache
def model(**how: bool) -> FlareModel:
    return FlareModel.of(star(), MAUVE, expectations()[0], distance_pc=5.0, **how)


def test_two_temperatures_are_recovered_without_noise() -> None:
    """Compare to 0.6 %, the step between second temperatures, which is far below their error."""
    quiet, two, _ = expectations()
    found = fit_two(two.recorded_dn, quiet, model())
    best = dict(zip(found.names, found.estimates[0], strict=True))
    assert best["second temperature"] == pytest.approx(30_000.0, rel=0.007)
    assert best["temperature"] == pytest.approx(8000.0, rel=0.01)
    assert best["second area"] == pytest.approx(0.05, rel=0.02)
    assert best["amplitude"] == pytest.approx(3.0, rel=0.002)
    assert found.chi2[0] < 0.1
    # A single blackbody does not fit.
    assert fit(two.recorded_dn, quiet, model()).chi2[0] > 1000.0
    # Total light is that of the spectrum that was added.
    grid = FLARE.grid(np.linspace(200.0, 700.0, 2001))
    scale = best["flux bolometric"] / FLARE.bolometric_flux()
    assert best["flux 200-700 nm"] == pytest.approx(10 * scale * np.trapezoid(FLARE.flux(grid), grid), rel=0.03)


@pytest.mark.long
def test_intervals_of_two_temperatures_have_nominal_coverage(engine: Engine) -> None:
    """Fit 400 draws: a coverage of 93 to 97 % fails in 1e-6 of seeds on each side of four quantities."""
    quiet, two, _ = expectations()
    found = fit_two(engine.realise(two, count=400, seed=3), quiet, model(), levels=(0.95,))
    exact = fit_two(two.recorded_dn, quiet, model())
    truth = {"temperature": 8000.0, "second temperature": 30_000.0, "second area": 0.05}
    truth["flux bolometric"] = float(exact.estimates[0, exact.column("flux bolometric")])
    low, high = stats.binom.ppf(1e-6, 400, 0.93), stats.binom.isf(1e-6, 400, 0.97)
    for name, value in truth.items():
        q = found.column(name)
        covered = int(((found.low[0, :, q] <= value) & (value <= found.high[0, :, q])).sum())
        assert low <= covered <= high, (name, covered)
        spread = np.diff(np.quantile(found.estimates[:, q], [0.15865, 0.84135]))[0] / 2
        assert spread == pytest.approx(float(np.median(found.errors[:, q])), rel=0.25)
    rejected = int((found.p_value < 0.01).sum())
    assert stats.binom.sf(rejected - 1, 400, 0.01) > 1e-6


@pytest.mark.long
def test_second_temperature_of_a_single_blackbody_is_unconstrained(engine: Engine) -> None:
    """Fit a blackbody of 9000 K: the second temperature has no limit, the first is that of the plain fit."""
    quiet, _, one = expectations()
    found = fit_two(engine.realise(one, count=20, seed=5), quiet, model(), levels=(0.95,))
    area, second = found.column("second area"), found.column("second temperature")
    assert (found.low[0, :, area] == 0.0).sum() >= 15
    assert np.isinf(found.high[0, :, second]).sum() >= 15
    assert (found.low[0, :, 0] <= 9000.0).sum() >= 15
    assert (found.estimates >= np.array(found.bounds)).all()
