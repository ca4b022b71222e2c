"""Flares measured against time: a flare that cools, a steady one, known changes of conditions, refusals."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import scipy
from scenes import assert_covered, quiescent
from scenes import source as star

import mauvecl
from mauvecl import Cooling, Engine, Event, FlareModel, Nuisances, Sinusoid, Stare, fit_cooling, measure_along

MAUVE = mauvecl.Instrument.load("mauvesim")
STEADY = Cooling(9000.0, 9000.0, 1.0)
SEEDS = 20


quiet = partial(quiescent, exposure=5.0)


@cache
def model() -> FlareModel:
    return FlareModel.of(star(), MAUVE, quiet(), distance_pc=5.0, radius_rsun=0.4)


def lit_frames(cooling: Cooling, stare: Stare) -> tuple[list[mauvecl.Expectation], np.ndarray]:
    """Return frames with a flare that peaks at 52 s, each an expectation of its own, and their temperatures."""
    x, start = quiet(), stare.start_s
    event = Event(52.0, 40.0, 1.5, cooling)
    rise = event.amplitude * event.form.mean_over(np.column_stack([start, start + 5.0]), 52.0, 40.0)
    kelvin, dark = cooling.at(start + 2.5 - 52.0), stare.dark_factor(x)
    lit = []
    for k in range(stare.n_frames):
        flaring = mauvecl.expect(star().flaring(float(rise[k]), float(kelvin[k])), MAUVE, exposure=5.0)
        added = flaring.source_electrons - x.source_electrons
        lit.append(replace(
            x, source_electrons=stare.light[k] * (stare.star[k] * x.source_electrons + added),
            sky_electrons=stare.light[k] * stare.sky[k] * x.sky_electrons, dark_dn=dark[k] * x.dark_dn,
        ))  # fmt: skip
    return lit, kelvin


@pytest.mark.long
@pytest.mark.parametrize(
    ("cooling", "unknown"),
    [
        (Cooling(14_000.0, 7000.0, 80.0), None),
        (Cooling(14_000.0, 7000.0, 80.0), {"dark": np.inf, "light": 0.02}),
        (STEADY, {"dark": np.inf, "light": 0.02}),
    ],
    ids=["cools", "cools-unknown", "steady-unknown"],
)
def test_temperature_is_measured_with_correct_errors(
    cooling: Cooling, unknown: dict[str, float] | None, engine: Engine
) -> None:
    """Check pulls of ln T in all bins of 20 stares against fits without noise; each side fails in 1e-6 of seeds."""
    nuisances = None if unknown is None else Nuisances.of(quiet(), unknown)
    lit, kelvin = lit_frames(cooling, Stare.of(300.0))
    means = np.array([one.recorded_dn for one in lit])
    raw = np.stack([engine.realise(one, count=SEEDS, seed=600 + k) for k, one in enumerate(lit)], axis=1)
    pulls, inside = [], 0
    truths: dict[tuple[int, int], float] = {}
    for frames in raw:
        along = measure_along(frames, quiet(), model(), nuisances, snr_per_bin=25.0)
        assert (along.found.snr > 0.85 * 25.0).all()
        assert (along.first[1:] >= along.first[:-1] + along.count[:-1]).all()
        for k, (first, n) in enumerate(zip(along.first, along.count, strict=True)):
            some = slice(first, first + n)
            if (first, n) not in truths:
                unknown_n = None if nuisances is None else replace(nuisances, spectra=n * nuisances.spectra)
                one = replace(quiet(), n_frames=int(n))
                exact = mauvecl.fit(means[some].sum(axis=0), one, model().stacked(int(n)), unknown_n)
                truths[first, n] = float(exact.estimates[0, 0])
            truth = truths[first, n]
            assert 0.995 * kelvin[some].min() < truth < 1.005 * kelvin[some].max()
            estimate, error = along.found.estimates[k, 0], along.found.errors[k, 0]
            pulls.append(np.log(estimate / truth) * estimate / error)
            inside += along.found.low[1, k, 0] <= truth <= along.found.high[1, k, 0]
    z, n = np.array(pulls), len(pulls)
    assert n > 100
    assert abs(z.mean()) < scipy.stats.norm.isf(1e-6) / np.sqrt(n)
    assert scipy.stats.chi2.ppf(1e-6, n) < np.sum(z**2) < scipy.stats.chi2.isf(1e-6, n)
    assert_covered(inside, n, 0.94, 0.96)
    # What is followed moves by many errors, or not at all.
    spread = max(truths.values()) / min(truths.values())
    assert spread > 1.15 if cooling is not STEADY else spread < 1.005


@pytest.mark.long
def test_known_conditions_and_gaps_are_respected() -> None:
    """Measure frames without noise: 9000 K, area and luminosity in every bin, and no bin over a gap."""
    how = {"thermal": 3.0, "throughput": Sinusoid(0.2, 300.0), "variability": Sinusoid(0.05, 200.0), "orbit_s": 400.0}
    stare = Stare.of(300.0, gaps=[(90.0, 115.0)], **how)  # type: ignore[arg-type]
    lit, _ = lit_frames(STEADY, stare)
    frames = np.array([one.recorded_dn for one in lit])
    along = measure_along(frames, quiet(), model(), stare=stare)
    found = along.found
    np.testing.assert_allclose(found.estimates[:, 0], 9000.0, rtol=3e-3)
    assert (found.chi2 < 0.1).all()
    assert not ((along.start_s < 90.0) & (along.end_s > 115.0)).any()
    assert (along.start_s < 90.0).any()
    assert (along.start_s >= 115.0).any()
    event = Event(52.0, 40.0, 1.5)
    rise = 1.5 * event.form.mean_over(np.column_stack([along.start_s, along.end_s]), 52.0, 40.0)
    values = [model().values(9000.0, [float(one)]) for one in rise]
    for name in ("area", "luminosity bolometric", "filling factor"):
        got = found.estimates[:, found.column(name)]
        np.testing.assert_allclose(got, [one[name] for one in values], rtol=1e-2)
    energy = found.estimates[:, found.column("energy bolometric")]
    np.testing.assert_allclose(
        energy, found.estimates[:, found.column("luminosity bolometric")] * (along.end_s - along.start_s), rtol=1e-9
    )
    table = along.table()
    assert str(table["luminosity_bolometric"].unit) == "erg / s"
    assert list(table["temperature"].value) == list(found.estimates[:, 0])
    # Without the conditions the flare is another.
    wrong = measure_along(frames, quiet(), model())
    assert np.abs(wrong.found.estimates[:, 0] / 9000.0 - 1).max() > 0.02


FALLING, TRUTH = Cooling(14_000.0, 7000.0, 80.0), np.array([52.0, 40.0, 1.5, 14_000.0, 7000.0, 80.0])
START: dict[str, Any] = {"peak_s": 50.0, "half_width_s": 30.0}


def test_joint_fit_recovers_shape_and_cooling_without_noise() -> None:
    """Include known changes of throughput and temperature, a gap, and flares that do not cool."""
    how = {"thermal": 3.0, "throughput": Sinusoid(0.2, 300.0), "orbit_s": 400.0}
    stare = Stare.of(300.0, gaps=[(90.0, 115.0)], **how)  # type: ignore[arg-type]
    lit, _ = lit_frames(FALLING, stare)
    frames = np.array([one.recorded_dn for one in lit])
    found = fit_cooling(frames, quiet(), model(), stare=stare, levels=(), **START)
    np.testing.assert_allclose(found.estimates[0, :6], TRUTH, rtol=1e-3)
    assert found.chi2[0] < 0.01
    assert found.dof < stare.n_frames * 12
    # The same light without what is known of the conditions is another flare.
    assert fit_cooling(frames, quiet(), model(), levels=(), **START).p_value[0] < 1e-6
    steady, _ = lit_frames(STEADY, Stare.of(300.0))
    frames = np.array([one.recorded_dn for one in steady])
    found = fit_cooling(frames, quiet(), model(), cooling=False, levels=(), **START)
    np.testing.assert_allclose(found.estimates[0, :4], [52.0, 40.0, 1.5, 9000.0], rtol=1e-3)
    # The energy is that of all bins together.
    along = measure_along(frames, quiet(), model(), snr_per_bin=8.0)
    energy = along.found.estimates[:, along.found.column("energy bolometric")].sum()
    whole = found.estimates[0, found.column("energy bolometric")]
    assert 0.9 * whole < energy < whole * (1 + 1e-6)
    fluence = found.estimates[0, found.column("fluence bolometric")]
    assert whole == pytest.approx(fluence * 4 * np.pi * (5.0 * 3.0856775814913674e18) ** 2, rel=1e-9)


@pytest.mark.long
def test_joint_fit_of_a_steady_flare_leaves_the_cooling_open() -> None:
    lit, _ = lit_frames(STEADY, Stare.of(150.0))
    found = fit_cooling(np.array([one.recorded_dn for one in lit]), quiet(), model(), levels=(0.95,), **START)
    assert found.estimates[0, :4] == pytest.approx([52.0, 40.0, 1.5, 9000.0], rel=0.01)
    place = found.column("cooling time")
    assert np.isinf(found.high[0, 0, place])
    assert found.low[0, 0, 3] < 9000.0 < found.high[0, 0, 3]


def test_skipped_wavelengths_change_no_fit_along_a_stare() -> None:
    """Remove the flare from 300-350 nm and skip these pixels in binned and joint fits."""
    lit, _ = lit_frames(STEADY, Stare.of(150.0))
    nm, gap = quiet().wavelength_nm, (300.0, 350.0)
    spoiled = np.array([np.where((nm >= gap[0]) & (nm <= gap[1]), 0.0, one.recorded_dn) for one in lit])
    found = fit_cooling(spoiled, quiet(), model(), cooling=False, levels=(), skipped_nm=[gap], **START)
    np.testing.assert_allclose(found.estimates[0, :4], [52.0, 40.0, 1.5, 9000.0], rtol=2e-3)
    along = measure_along(spoiled, quiet(), model(), snr_per_bin=15.0, skipped_nm=[gap])
    np.testing.assert_allclose(along.found.estimates[:, 0], 9000.0, rtol=2e-3)
    assert abs(fit_cooling(spoiled, quiet(), model(), cooling=False, levels=(), **START).estimates[0, 3] - 9000) > 500


@pytest.mark.parametrize(
    ("unknown", "count"),
    [(False, 12), pytest.param(True, 100, marks=pytest.mark.long)],
    ids=["known", "unknown"],
)
def test_intervals_of_joint_fits_cover(unknown: bool, count: int, engine: Engine) -> None:
    """Count coverages of nine quantities, squared distances and chi-squared; each side fails in 1e-6 of seeds."""
    nuisances = Nuisances.of(quiet(), {"dark": np.inf, "light": 0.02})
    lit, _ = lit_frames(FALLING, Stare.of(300.0))
    raw = np.stack([engine.realise(one, count=count, seed=700 + k) for k, one in enumerate(lit)], axis=1) * 1.0
    if unknown:
        levels = np.random.default_rng(7).standard_normal((count, 2)) * [0.5, 0.02]
        raw += (levels @ nuisances.spectra)[:, None]
        raw += levels[:, 1, None, None] * np.array([one.net_source_dn - quiet().net_source_dn for one in lit])
    how: dict[str, Any] = START | {"nuisances": nuisances if unknown else None}
    fluences = fit_cooling(np.array([one.recorded_dn for one in lit]), quiet(), model(), levels=(), **how)
    truth = np.concatenate([TRUTH, fluences.estimates[0, 6:9]])
    covered = np.zeros((2, truth.size), np.int64)
    distance, chi2, dof = 0.0, 0.0, 0
    for frames in raw:
        found = fit_cooling(frames, quiet(), model(), **how)
        covered += (found.low[:, 0, :9] <= truth) & (truth <= found.high[:, 0, :9])
        away = found.estimates[0, :6] - TRUTH
        assert abs(away[0]) < 10.0
        distance += float(away @ np.linalg.solve(found.covariance[0, :6, :6], away))
        chi2, dof = chi2 + float(found.chi2[0]), dof + found.dof
    for sum_of_squares, freedom in ((distance, 6 * count), (chi2, dof)):
        assert scipy.stats.chi2.ppf(1e-6, freedom) < sum_of_squares < scipy.stats.chi2.isf(1e-6, freedom)
    for inside, lowest, highest in zip(covered, (0.63, 0.92), (0.73, 0.98), strict=True):
        assert_covered(inside, count, lowest, highest)
