"""Fits of flares whose light has an unknown factor, that saturate pixels, or that have two temperatures."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy
from scenes import assert_covered
from scenes import quiescent as quiet
from scenes import source as star
from scipy import stats

import mauvecl
from mauvecl import BalmerFlare, Engine, Expectation, FlareModel, Nuisances, TwoBlackbodies, expect, fit

MAUVE = mauvecl.Instrument.load("mauvesim")
FREE, SKY_SD, DARK_C = np.inf, 0.1, 0.5
FLARE = TwoBlackbodies(8000.0, 30_000.0, 0.05)


@cache
def scene(
    library: str, magnitude: float, amplitude: float, light: Any = 10_000.0, exposure: float = 50.0, **how: Any
) -> tuple[Expectation, Expectation, FlareModel]:
    """Return expectations without and with a flare, of a temperature or a spectrum, and the model that is fitted."""
    own, x = star(library, magnitude), quiet(library, magnitude, exposure)
    lit = own.flaring(amplitude, light) if isinstance(light, float) else own.flaring(amplitude, spectrum=light)
    return x, expect(lit, MAUVE, exposure=exposure), FlareModel.of(own, MAUVE, x, **how)


def drawn(lit: Expectation, factor: np.ndarray, rng: np.random.Generator, *, unknown: bool = True) -> np.ndarray:
    """Draw exposures of a flaring star, whose light has these factors, with unknown levels of dark and sky."""
    n = factor.size
    dark = DARK_C * rng.standard_normal(n) if unknown else np.zeros(n)
    sky = 1.0 + SKY_SD * rng.standard_normal(n) if unknown else np.ones(n)
    light = factor[:, None] * (lit.light_dn + (sky[:, None] - 1.0) * lit.sky_dn)
    level = lit.n_frames * lit.dark_dn * np.exp(lit.conditions["dark_slope_per_c"] * dark)[:, None]
    variance = lit.unsaturated_variance_dn2 + lit.gain_dn_per_electron * (light - lit.light_dn)
    mean = light + level + lit.n_frames * lit.bias_dn
    return mean + rng.standard_normal(mean.shape) * np.sqrt(variance)


def covered(found: Any, m: FlareModel, truth: tuple[float, float, float], least: float, most: float) -> None:
    """Check the counts of covered values at 95 % against coverages, left with a probability of 1e-6 on each side.

    The truth holds temperature, amplitude and jump.
    """
    kelvin, amplitude, jump = truth
    values = np.array(list(m.values(kelvin, m.amplitudes(kelvin, amplitude, jump=jump)).values()))
    inside = ((found.low[-1] <= values) & (values <= found.high[-1])).sum(axis=0)
    assert_covered(inside, len(found.estimates), least, most)


@pytest.mark.parametrize("light", ["free", "prior"])
@pytest.mark.parametrize(
    ("library", "magnitude", "amplitude", "kelvin", "jump"),
    [("M3V", 7.0, 0.5, 10_000.0, 1.0), ("G2V", 4.0, 0.5, 10_000.0, 1.0), ("M3V", 9.0, 0.5, 9500.0, 2.0),
     ("M5V", 10.5, 8.0, 14_000.0, 1.0)],
    ids=lambda value: f"{value}",
)  # fmt: skip
def test_intervals_cover_where_light_is_lost(
    library: str, magnitude: float, amplitude: float, kelvin: float, jump: float, light: str
) -> None:
    """Fit 600 draws with losses of 2 +- 1 %: coverages of 93.5 to 96.5 %, each quantity fails in 2e-6 of seeds."""
    x, lit, m = scene(library, magnitude, amplitude, BalmerFlare(kelvin, jump), jump=jump > 1)
    unknown = Nuisances.of(x, {"light": FREE, "dark": FREE, "sky": SKY_SD})
    if light == "prior":
        unknown = unknown.with_prior("light", -0.02, 0.01)
    rng = np.random.default_rng(4201)
    raw = drawn(lit, 0.98 + 0.01 * rng.standard_normal(600), rng)
    found = fit(raw, x, m, unknown, levels=(0.95,))
    covered(found, m, (kelvin, amplitude, jump), 0.935, 0.965)
    # Errors in advance are those of the fits, to 5 standard errors of a standard deviation of 600.
    scatter = np.subtract(*np.quantile(found.estimates, [0.84135, 0.15865], axis=0)) / 2
    ahead = mauvecl.forecast(x, m, kelvin, m.amplitudes(kelvin, amplitude, jump=jump), unknown).errors
    np.testing.assert_allclose(scatter, ahead, rtol=5 * 1.3 / np.sqrt(1200) + 0.03)


@pytest.mark.parametrize("sd", [FREE, 0.02], ids=["free", "prior"])
@pytest.mark.parametrize("amplitude", [0.5, 2.0])
def test_intervals_agree_with_brute_force(amplitude: float, sd: float) -> None:
    """Compare with chi-squared minimised over temperature, factor and dark level, with a quantity held."""
    x, _, m = scene("M3V", 9.0, amplitude)
    counts = m.counts(11_000.0, [amplitude])
    variance = x.variance_dn2 + x.gain_dn_per_electron * counts
    rng = np.random.default_rng(4203)
    raw = x.recorded_dn - 0.04 * x.light_dn + 0.96 * counts + rng.standard_normal(counts.size) * np.sqrt(variance)
    unknown = Nuisances.of(x, {"light": sd, "dark": FREE})
    found = fit(raw, x, m, unknown, levels=(0.95,))
    assert np.isfinite(found.high[0, 0]).all()
    held = x.variance_dn2 + x.gain_dn_per_electron * m.counts(
        float(np.exp(found.log_k[0])), found.factor[0] * found.amplitudes[0]
    )
    excess, root = raw - x.recorded_dn, np.sqrt(held)
    dark = unknown.spectra[1] / root

    def least(log_k: float, amplitude: float) -> float:
        """Return chi-squared with the best factor and dark level, both linear."""
        flare = amplitude * m.hot_spline(log_k)
        rows = np.array([(x.recorded_light_dn + flare) / root, dark])
        left = (excess - flare) / root
        gram = rows @ rows.T + np.diag([0.0 if np.isinf(sd) else sd**-2.0, 0.0])
        along = rows @ left
        return float(left @ left - along @ np.linalg.solve(gram, along))

    def profile(amplitude: float) -> float:
        nodes = np.linspace(np.log(5000.0), np.log(60_000.0), 120)
        start = nodes[int(np.argmin([least(k, amplitude) for k in nodes]))]
        found = scipy.optimize.minimize_scalar(
            lambda k: least(k, amplitude), bounds=(start - 0.05, start + 0.05), method="bounded",
            options={"xatol": 1e-7},
        )  # fmt: skip
        return float(found.fun)

    value, error = found.estimates[0, 1], found.errors[0, 1]
    bottom = profile(float(value))
    for end in (found.low[0, 0, 1], found.high[0, 0, 1]):
        # Within 1.5 % of a standard error, of which chi-squared at the end tells.
        slope = abs(profile(float(end + 0.01 * error)) - profile(float(end - 0.01 * error))) / 0.02
        assert abs(profile(float(end)) - bottom - scipy.stats.chi2.isf(0.05, 1)) < 0.015 * slope + 0.01


def test_single_frames_have_uniform_losses() -> None:
    """Fit 1500 single frames that lose 0-5 %, and know the star's level by nothing else: 93.5 to 96.5 % (2e-6)."""
    x, lit, m = scene("M3V", 9.0, 20.0, exposure=5.0)
    unknown = Nuisances.of(x, {"light": FREE, "dark": FREE, "sky": SKY_SD})
    unknown = unknown.with_prior("light", -0.025, 0.05 / 12**0.5).with_spectrum("star", x.net_source_dn, FREE)
    nodes = np.linspace(-(3.0**0.5), 3.0**0.5, 401)
    uniform = Nuisances(unknown.names, unknown.spectra, unknown.sd, unknown.of_flare, unknown.mean,
                        np.array([nodes, np.full(nodes.size, 1.0 / nodes.size)]))  # fmt: skip
    rng = np.random.default_rng(4204)
    raw = drawn(lit, 1.0 - 0.05 * rng.random(1500), rng)
    covered(fit(raw, x, m, uniform, levels=(0.95,)), m, (10_000.0, 20.0, 1.0), 0.935, 0.965)
    # A normal prior of the same moments covers nearly all.
    wide = fit(raw, x, m, unknown, levels=(0.95,))
    assert ((wide.low[0, :, 1] <= 20.0) & (wide.high[0, :, 1] >= 20.0)).mean() > 0.98


def test_light_that_may_be_lost_altogether_leaves_fluxes_without_limit() -> None:
    """Check a star too faint to tell the factor: no upper limit of the flux, and a temperature as before."""
    x, lit, m = scene("M3V", 15.0, 500.0)
    found = fit(lit.recorded_dn, x, m, Nuisances.of(x, {"light": FREE, "dark": FREE}), levels=(0.95,))
    place = found.column("flux bolometric")
    assert np.isposinf(found.high[0, 0, place])
    assert 0.0 < found.low[0, 0, place] < found.estimates[0, place]
    assert found.low[0, 0, 0] < 10_000.0 < found.high[0, 0, 0] < np.inf


def test_tilt_of_the_response_tilts_the_flare() -> None:
    """Fit an exposure without noise whose response is tilted by 2 %, star and flare: the temperature stays."""
    x, lit, m = scene("M3V", 7.0, 2.0)
    tilted = lit.recorded_dn + 0.02 * lit.light_dn * (x.wavelength_nm - 450.0) / 250.0
    found = fit(tilted, x, m, Nuisances.of(x, {"tilt": FREE, "dark": FREE}))
    assert abs(found.estimates[0, 0] - 10_000.0) < 0.1 * found.errors[0, 0]
    plain = Nuisances.of(x, {"own": FREE, "dark": FREE}, own={"own": Nuisances.of(x, {"tilt": 1.0}).spectra[0]})
    other = fit(tilted, x, m, plain)
    assert abs(other.estimates[0, 0] - 10_000.0) > 2 * found.errors[0, 0]


@pytest.mark.parametrize(("library", "magnitude", "amplitude", "kelvin", "jump"), [
    ("K2.5V", 2.0, 5.0, 10_000.0, 1.0), ("K2.5V", 2.0, 2.0, 9500.0, 2.0), ("G2V", 0.75, 0.3, 9000.0, 1.0),
    ("G2V", -1.0, 0.3, 9000.0, 1.0), ("M3V", 5.0, 30.0, 20_000.0, 1.0),
])  # fmt: skip
def test_intervals_cover_where_pixels_saturate(
    engine: Engine, library: str, magnitude: float, amplitude: float, kelvin: float, jump: float
) -> None:
    """Fit 300 drawn exposures: coverages of 92 to 98 % and good fits, each quantity fails in 2e-6 of seeds."""
    x, lit, m = scene(library, magnitude, amplitude, BalmerFlare(kelvin, jump), jump=jump > 1)
    assert lit.saturated.any()
    n = 300
    found = fit(engine.realise(lit, count=n, seed=4301), x, m, levels=(0.95,))
    covered(found, m, (kelvin, amplitude, jump), 0.92, 0.98)
    assert scipy.stats.binom.sf(int((found.p_value < 0.01).sum()) - 1, n, 0.01) > 1e-6


def test_exposures_with_and_without_saturated_pixels_are_fitted_together(engine: Engine) -> None:
    """Compare the fits of bright and faint flares in one call with those of separate calls, to a tenth of an error."""
    raw = []
    for amplitude in (0.1, 2.0, 5.0):
        x, lit, m = scene("K2.5V", 2.0, amplitude)
        raw.append(engine.realise(lit, count=3, seed=4302))
    together = fit(np.concatenate(raw), x, m)
    for k, one in enumerate(raw):
        alone = fit(one, x, m)
        away = (together.estimates[3 * k : 3 * k + 3] - alone.estimates) / alone.errors
        assert (np.abs(away) < 0.1).all()


def test_every_jump_is_allowed_where_no_flare_is(engine: Engine) -> None:
    """Fit 200 exposures without a flare: the jump's interval is [1, inf) wherever that of the amplitude holds zero."""
    x, _, m = scene("M3V", 9.0, 0.5, jump=True)
    found = fit(engine.realise(x, count=200, seed=4303), x, m)
    for level, probability in enumerate(found.levels):
        none = found.snr**2 <= scipy.stats.chi2.ppf(probability, 1)
        assert none.mean() > 0.3
        jump = found.column("jump")
        assert (found.low[level, none, jump] == 1.0).all()
        assert np.isposinf(found.high[level, none, jump]).all()


def test_sharp_maxima_at_bounds_are_found() -> None:
    """Fit a flare without a jump in few pixels, where the bound bends the likelihood within a node of temperature."""
    x, lit, m = scene("K2.5V", 2.0, 5.0, jump=True)
    found = fit(lit.recorded_dn, x, m)
    assert found.chi2[0] < 1e-3
    assert np.abs(found.estimates[0] - list(m.values(10_000.0, m.amplitudes(10_000.0, 5.0)).values()))[0] < 1.0


@pytest.mark.long
def test_two_temperatures_are_recovered_without_noise() -> None:
    """Compare to 0.6 %, the step between second temperatures; in a dimmed exposure to 3 % of their errors."""
    x, two, m = scene("M3V", 9.0, 3.0, FLARE, distance_pc=5.0)
    found = mauvecl.fit_two_temperatures(two.recorded_dn, x, m)
    best = dict(zip(found.names, found.estimates[0], strict=True))
    assert best["second temperature"] == pytest.approx(30_000.0, rel=0.007)
    assert best["temperature"] == pytest.approx(8000.0, rel=0.01)
    assert best["second area"] == pytest.approx(0.05, rel=0.02)
    assert best["amplitude"] == pytest.approx(3.0, rel=0.002)
    assert found.chi2[0] < 0.1
    # A single blackbody does not fit.
    assert fit(two.recorded_dn, x, m).chi2[0] > 1000.0
    # Total light is that of the spectrum that was added.
    grid = FLARE.grid(np.linspace(200.0, 700.0, 2001))
    scale = best["flux bolometric"] / FLARE.bolometric_flux()
    assert best["flux 200-700 nm"] == pytest.approx(10 * scale * np.trapezoid(FLARE.flux(grid), grid), rel=0.03)
    # Both temperatures are dimmed alike; second temperatures lie on a grid, that of both exposures.
    dimmed = [two.recorded_dn + (f - 1.0) * two.light_dn for f in (1.0, 0.9)]
    dim = mauvecl.fit_two_temperatures(np.array(dimmed), x, m, Nuisances.of(x, {"light": FREE}))
    assert dim.factor[1] / dim.factor[0] == pytest.approx(0.9, rel=1e-4)
    away = (dim.estimates[1] - dim.estimates[0]) / dim.errors[0]
    assert (np.abs(away[np.isfinite(away)]) < 0.03).all(), away
    assert dim.estimates[1, [0, -2]] == pytest.approx([8000.0, 30_000.0], rel=0.02)
    # A line that the flare lacks hardly changes the errors.
    *_, with_line = scene("M3V", 9.0, 3.0, FLARE, distance_pc=5.0, lines=("H alpha",))
    lined = mauvecl.fit_two_temperatures(two.recorded_dn, x, with_line)
    assert lined.errors[0, [0, 1, -2, -1]] == pytest.approx(found.errors[0, [0, 1, -2, -1]], rel=0.1)


@pytest.mark.long
def test_intervals_of_two_temperatures_have_nominal_coverage(engine: Engine) -> None:
    """Fit 400 draws: a coverage of 93 to 97 % fails in 1e-6 of seeds on each side of four quantities."""
    x, two, m = scene("M3V", 9.0, 3.0, FLARE, distance_pc=5.0)
    found = mauvecl.fit_two_temperatures(engine.realise(two, count=400, seed=3), x, m, levels=(0.95,))
    exact = mauvecl.fit_two_temperatures(two.recorded_dn, x, m)
    truth = {"temperature": 8000.0, "second temperature": 30_000.0, "second area": 0.05}
    truth["flux bolometric"] = float(exact.estimates[0, exact.column("flux bolometric")])
    for name, value in truth.items():
        q = found.column(name)
        assert_covered(((found.low[0, :, q] <= value) & (value <= found.high[0, :, q])).sum(), 400, 0.93, 0.97)
        spread = np.diff(np.quantile(found.estimates[:, q], [0.15865, 0.84135]))[0] / 2
        assert spread == pytest.approx(float(np.median(found.errors[:, q])), rel=0.25)
    rejected = int((found.p_value < 0.01).sum())
    assert stats.binom.sf(rejected - 1, 400, 0.01) > 1e-6


def test_second_temperature_of_a_single_blackbody_is_unconstrained(engine: Engine) -> None:
    """Fit a blackbody of 9000 K: the second temperature has no limit, and none where a second area fits no better."""
    x, one, m = scene("M3V", 9.0, 0.5, 9000.0, distance_pc=5.0)
    frames = engine.realise(one, count=20, seed=5)
    found, single = mauvecl.fit_two_temperatures(frames, x, m, levels=(0.95,)), fit(frames, x, m)
    area, second = found.column("second area"), found.column("second temperature")
    assert (found.low[0, :, area] == 0.0).sum() >= 15
    assert np.isinf(found.high[0, :, second]).sum() >= 15
    assert (found.low[0, :, 0] <= 9000.0).sum() >= 15
    assert (np.isnan(found.estimates) | (found.estimates >= np.array(found.bounds))).all()
    absent = found.estimates[:, area] == 0.0
    assert absent.any()
    assert (np.isnan(found.estimates[:, second]) == absent).all()
    # The other estimates are those of the plain fit.
    assert (found.estimates[absent, : len(single.names)] == single.estimates[absent]).all()
