"""Fits of flares that saturate pixels of an exposure, and limits of the jump of flares that are not detected."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy

from mauvecl import BalmerFlare, Engine, Expectation, FlareModel, Instrument, Source, expect, fit

MAUVE = Instrument.load("mauve")


@cache
def star(library: str, magnitude: float) -> Source:
    return Source.from_library(library).at_magnitude(magnitude)


@cache
def exposures(library: str, magnitude: float, amplitude: float, kelvin: float, jump: float) -> list[Expectation]:
    """Return the exposure of a star, and that of its flare."""
    own = star(library, magnitude)
    light = BalmerFlare(kelvin, jump)
    return [expect(one, MAUVE, exposure=50.0) for one in (own, own.flaring(amplitude, spectrum=light))]


@pytest.mark.parametrize(
    ("library", "magnitude", "amplitude", "kelvin", "jump"),
    [
        ("K2.5V", 2.0, 5.0, 10_000.0, 1.0),
        ("K2.5V", 2.0, 2.0, 9500.0, 2.0),
        ("G2V", 0.75, 0.3, 9000.0, 1.0),
        ("G2V", -1.0, 0.3, 9000.0, 1.0),
        ("M3V", 5.0, 30.0, 20_000.0, 1.0),
    ],
)
def test_intervals_cover_where_pixels_saturate(
    engine: Engine, library: str, magnitude: float, amplitude: float, kelvin: float, jump: float
) -> None:
    """Fit 300 drawn exposures: coverages of 92 to 98 % and good fits, each quantity fails in 2e-6 of seeds."""
    quiet, lit = exposures(library, magnitude, amplitude, kelvin, jump)
    assert lit.saturated.any()
    m = FlareModel.of(star(library, magnitude), MAUVE, quiet, jump=jump > 1)
    n = 300
    found = fit(engine.realise(lit, count=n, seed=4301), quiet, m, levels=(0.95,))
    truth = np.array(list(m.values(kelvin, m.amplitudes(kelvin, amplitude, jump=jump)).values()))
    inside = ((found.low[0] <= truth) & (truth <= found.high[0])).sum(axis=0)
    low, high = scipy.stats.binom.ppf(1e-6, n, 0.92), scipy.stats.binom.isf(1e-6, n, 0.98)
    assert ((low <= inside) & (inside <= high)).all(), dict(zip(found.names, inside / n, strict=True))
    assert scipy.stats.binom.sf(int((found.p_value < 0.01).sum()) - 1, n, 0.01) > 1e-6


def test_exposures_with_and_without_saturated_pixels_are_fitted_together(engine: Engine) -> None:
    """Compare the fits of bright and faint flares in one call with those of separate calls, to a tenth of an error."""
    raw = []
    for amplitude in (0.1, 2.0, 5.0):
        quiet, lit = exposures("K2.5V", 2.0, amplitude, 10_000.0, 1.0)
        raw.append(engine.realise(lit, count=3, seed=4302))
    m = FlareModel.of(star("K2.5V", 2.0), MAUVE, quiet)
    together = fit(np.concatenate(raw), quiet, m)
    for k, one in enumerate(raw):
        alone = fit(one, quiet, m)
        away = (together.estimates[3 * k : 3 * k + 3] - alone.estimates) / alone.errors
        assert (np.abs(away) < 0.1).all()


def test_every_jump_is_allowed_where_no_flare_is(engine: Engine) -> None:
    """Fit 200 exposures without a flare: the jump's interval is [1, inf) wherever that of the amplitude holds zero."""
    quiet, _ = exposures("M3V", 9.0, 0.5, 10_000.0, 1.0)
    m = FlareModel.of(star("M3V", 9.0), MAUVE, quiet, jump=True)
    found = fit(engine.realise(quiet, count=200, seed=4303), quiet, m)
    for level, probability in enumerate(found.levels):
        none = found.snr**2 <= scipy.stats.chi2.ppf(probability, 1)
        assert none.mean() > 0.3
        jump = found.column("jump")
        assert (found.low[level, none, jump] == 1.0).all()
        assert np.isposinf(found.high[level, none, jump]).all()


def test_sharp_maxima_at_bounds_are_found() -> None:
    """Fit a flare without a jump in few pixels, where the bound bends the likelihood within a node of temperature."""
    quiet, lit = exposures("K2.5V", 2.0, 5.0, 10_000.0, 1.0)
    m = FlareModel.of(star("K2.5V", 2.0), MAUVE, quiet, jump=True)
    found = fit(lit.recorded_dn, quiet, m)
    assert found.chi2[0] < 1e-3
    assert np.abs(found.estimates[0] - list(m.values(10_000.0, m.amplitudes(10_000.0, 5.0)).values()))[0] < 1.0
