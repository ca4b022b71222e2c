"""Measured flares: forecasts, coverage of intervals, other minimisers; draws are normal, by seeds fixed beforehand."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from scenes import assert_covered
from scenes import quiescent as quiet
from scenes import source as star

import mauvecl
from mauvecl import BalmerFlare, Expectation, FlareModel, Nuisances, Source, expect, fit, forecast

MAUVE = mauvecl.Instrument.load("mauvesim")
#: Forecasts that an independent script computed for the project's specification.
PUBLISHED = tomllib.loads((Path(__file__).parents[1] / "data" / "published-fits.toml").read_text(encoding="utf-8"))


@cache
def model(**how: Any) -> FlareModel:
    return FlareModel.of(star(), MAUVE, quiet(), **how)


def free(x: Expectation, **more: float) -> Nuisances:
    return Nuisances.of(x, {"dark": np.inf, "star": np.inf, **more}, own={"star": x.net_source_dn})


def drawn(x: Expectation, counts: np.ndarray, n: int, seed: int, unknown: Nuisances | None = None) -> np.ndarray:
    """Draw raw exposures with the variance of star and flare; unknowns follow their priors, or 5 % if they are free."""
    rng = np.random.default_rng(seed)
    variance = x.variance_dn2 + x.gain_dn_per_electron * counts
    raw = x.recorded_dn + counts + rng.standard_normal((n, counts.size)) * np.sqrt(variance)
    if unknown is not None:
        size = np.where(np.isfinite(unknown.sd), unknown.sd, 0.05)
        raw += (rng.standard_normal((n, size.size)) * size) @ unknown.spectra
    return raw


@pytest.mark.parametrize("row", PUBLISHED["jumps"], ids=lambda row: f"jump-{row[0]:g}")
def test_forecasts_of_balmer_jumps_and_of_wrong_blackbodies(row: tuple[float, ...]) -> None:
    jump, snr, *errors, kelvin, chi2, ultraviolet, area = row
    m, x = model(jump=True, distance_pc=5.0), quiet()
    amplitudes = m.amplitudes(9500.0, 0.5, jump=jump)
    known, unknown = (forecast(x, m, 9500.0, amplitudes, u) for u in (None, free(x)))
    assert known.snr == pytest.approx(snr, rel=0.01)
    place = m.names.index("jump")
    got = [scale * one.errors[k] for one in (known, unknown) for k, scale in ((0, 1 / 9500), (place, 1.0))]
    np.testing.assert_allclose(got, errors, rtol=0.01, atol=5e-5)
    plain = model(distance_pc=5.0, radius_rsun=0.4)
    lit = x.recorded_dn + m.counts(9500.0, amplitudes)
    found = fit(lit, x, plain)
    assert [found.dof - fit(lit, x, plain, free(x)).dof, found.dof] == [2, lit.size - 2]
    best, truth = dict(zip(found.names, found.estimates[0], strict=True)), m.values(9500.0, amplitudes)
    assert best["temperature"] == pytest.approx(kelvin, rel=0.01)
    assert found.chi2[0] == pytest.approx(chi2, rel=0.01, abs=1e-6)
    assert best["flux 200-320 nm"] / truth["flux 200-320 nm"] == pytest.approx(ultraviolet, rel=0.01)
    product = best["area"] * best["temperature"] ** 4 / (truth["area"] * 9500.0**4)
    assert product == pytest.approx(area, rel=0.01)
    # The projected area of a sphere, and the light of all of it.
    luminosity = 4 * best["area"] * 5.670374419e-5 * best["temperature"] ** 4
    assert best["luminosity bolometric"] == pytest.approx(luminosity, rel=1e-6)
    assert best["filling factor"] == pytest.approx(best["area"] / (np.pi * (0.4 * 6.957e10) ** 2), rel=1e-9)
    longer = plain.stacked(3).values(9500.0, [0.5])
    assert longer["energy bolometric"] == pytest.approx(150.0 * longer["luminosity bolometric"], rel=1e-9)


@pytest.mark.parametrize("unknown", [False, True], ids=["known", "free"])
@pytest.mark.parametrize(("library", "v", "kelvin", "jump", "line"), [
    ("K3V", 6.0, 7500.0, 1.8, 3e-12), ("G2V", 8.0, 14_000.0, 3.0, 0.0), ("M3V", 7.0, 25_000.0, 1.2, 8e-12),
    ("F5V", 7.0, 11_000.0, 2.2, 1e-12), ("M5V", 11.0, 6000.0, 3.8, 2e-12), ("K5V", 9.0, 33_000.0, 1.5, 5e-12),
])  # fmt: skip
def test_forecasts_agree_with_brute_force(
    library: str, v: float, kelvin: float, jump: float, line: float, unknown: bool
) -> None:
    """Compare with whole spectra by `expect`, numerical derivatives, and unknowns as parameters."""
    x, s = quiet(library, v), star(library, v)
    m = FlareModel.of(s, MAUVE, x, jump=True, lines=("Ca II",))
    amplitudes = m.amplitudes(kelvin, 0.3, jump=jump, lines=(line,))
    grid = np.union1d(s.wavelength_nm, BalmerFlare().nodes_nm)
    grid = np.union1d(grid, np.add.outer(CA_II_NM, [-0.1, 0.0, 0.1]).ravel())
    base = np.interp(grid, s.wavelength_nm, s.flux_flam)

    def counts(amplitude: float, temperature: float, ratio: float, flux: float) -> np.ndarray:
        body = Source.from_arrays(s.wavelength_nm, mauvecl.Blackbody(temperature).flux(s.wavelength_nm))
        brightness = 10 ** (-0.4 * (s.magnitude("Kepler") - body.magnitude("Kepler")))
        hot = amplitude * brightness * BalmerFlare(temperature, max(ratio, 1.0)).flux(grid)
        tents = np.maximum(0.0, 1 - np.abs(np.subtract.outer(grid, CA_II_NM)) / 0.1).sum(axis=1) / 2.0
        lit = Source(grid, base + hot + flux * tents, "flaring", "test")
        return expect(lit, MAUVE, exposure=50.0).net_source_dn - x.net_source_dn

    at = np.array([0.3, kelvin, jump, line])
    steps = np.array([0.003, 10.0, 0.01, 1e-13])
    derivatives = [(counts(*(at + step)) - counts(*(at - step))) / (2 * step.sum()) for step in np.diag(steps)]
    variance = x.variance_dn2 + x.gain_dn_per_electron * counts(*at)
    if unknown:
        derivatives += [x.dark_dn, x.net_source_dn, x.sky_dn]
    rows = np.array(derivatives) / np.sqrt(variance)
    scale = np.linalg.norm(rows, axis=1)
    information = rows @ rows.T
    if unknown:
        information[6, 6] += 1 / 0.1**2
    errors = np.sqrt(np.diag(np.linalg.inv(information / np.outer(scale, scale)))) / scale
    reported = forecast(x, m, kelvin, amplitudes, free(x, sky=0.1) if unknown else None)
    assert unknown or reported.snr == pytest.approx(np.linalg.norm(counts(*at) / np.sqrt(variance)), rel=1e-4)
    got = [reported.errors[reported.names.index(name)] for name in ("amplitude", "temperature", "jump", "line Ca II")]
    np.testing.assert_allclose(got, errors[:4], rtol=2e-3)
    np.testing.assert_allclose(m.counts(kelvin, amplitudes), counts(*at), rtol=1e-4, atol=1e-3)


#: Vacuum wavelengths of lines of Ca II, nm.
CA_II_NM = np.array([393.478, 396.959])


def test_hot_flares_have_a_lower_limit_of_temperature_and_none_an_amplitude_at_its_boundary() -> None:
    """Check a one-sided coverage of 97.5 % in 400 fits; fewer than 370 have p < 1e-6.

    Without a flare half of 400 amplitudes are 0 at one temperature, and fewer over temperatures, at least 50 (1e-6).
    """
    x, m = quiet(), model()
    found = fit(drawn(x, m.counts(60_000.0, [0.01]), 400, 31), x, m, levels=(0.95,))
    assert found.one_sided[0, :, 0].mean() > 0.5
    assert np.isposinf(found.high[0, found.one_sided[0, :, 0], 0]).all()
    assert (found.low[0, :, 0] <= 60_000.0).sum() >= 370
    found = fit(drawn(x, np.zeros(x.wavelength_nm.size), 400, 32), x, m, levels=(0.95,))
    amplitude = found.column("amplitude")
    none = found.estimates[:, amplitude] == 0.0
    assert none.sum() > 50
    assert (found.low[0, none, amplitude] <= 0.0).all()
    assert (found.high[0, :, amplitude] > 0.0).all()
    assert found.one_sided[0, none, 0].sum() + np.isinf(found.low[0, none, 0]).sum() > 0


@pytest.mark.long
def test_bounded_intervals_agree_with_brute_force() -> None:
    """Compare jump and lines near their bounds with SciPy's non-negative least squares on grids."""
    x, m = quiet(), model(jump=True, lines=("Mg II",))
    raw = drawn(x, m.counts(9000.0, m.amplitudes(9000.0, 0.05, jump=1.05, lines=(2e-12,))), 4, 51)
    found, allowed = fit(raw, x, m, levels=(0.95,)), float(scipy.stats.chi2.isf(0.05, 1))
    kelvin, jumps = np.geomspace(3000.0, 200_000.0, 1500), np.linspace(1.0, 7.0, 61)
    edge = m.splines[m.names.index("jump")]
    for k in range(len(raw)):
        # The variance is that of the fit before the last, so that the reduction of this one differs by little.
        flare = m.counts(float(np.exp(found.log_k[k])), found.amplitudes[k])
        root = np.sqrt(x.variance_dn2 + x.gain_dn_per_electron * flare)
        y, fixed = (raw[k] - x.recorded_dn) / root, m.fixed / root

        def gain(columns: np.ndarray, y: np.ndarray = y) -> float:
            return float(y @ y - scipy.optimize.nnls(columns / np.linalg.norm(columns, axis=0), y)[1] ** 2)

        hot = m.hot_spline(np.log(kelvin)) / root
        gains = np.array([gain(np.column_stack([h, fixed.T])) for h in hot])
        inside = kelvin[gains >= gains.max() - allowed]
        np.testing.assert_allclose([found.low[0, k, 0], found.high[0, k, 0]], inside[[0, -1]], rtol=0.01)
        profile = np.zeros(jumps.size)
        for i in np.flatnonzero(gains >= gains.max() - allowed)[::8]:
            for j, jump in enumerate(jumps):
                both = hot[i] + (jump - 1.0) / float(edge(np.log(kelvin[i]))) * fixed[0]
                profile[j] = max(profile[j], gain(np.column_stack([both, fixed[1]])))
        ends = jumps[profile >= gains.max() - allowed][[0, -1]]
        column = found.column("jump")
        low, high = found.low[0, k, column], found.high[0, k, column]
        assert abs(low - ends[0]) < 0.12
        assert abs(high - ends[1]) < 0.12 or ends[1] == jumps[-1]
        assert (found.estimates[k] >= np.array(found.bounds)).all()
    line = found.column("line Mg II")
    assert found.one_sided[0, :, line].any()


@pytest.mark.parametrize(
    ("file", "misfits", "jumps", "optical_k"),
    [("spectra/ADLeo_912s.dat", (150.0, 120.0), (1.4, 2.1), (8500.0, 10_500.0)),
     ("flares/ADLeo_1497s.dat", (10.0, 10.0), (1.2, 3.0), (6500.0, 12_500.0))],
    ids=["912s", "1497s"],
)  # fmt: skip
def test_great_flare_of_ad_leo(file: str, misfits: Any, jumps: Any, optical_k: Any) -> None:
    """Fit the mean exposure: no blackbody, a Balmer jump, and an interval that contains the optical 9500 K."""
    data, units = Path(__file__).parents[1] / "data", {"wavelength_unit": "Angstrom"}
    quiescent, how = data / "flares" / "adleo_quiescent2.dat", {"continue_at_k": 9500.0, **units}
    ad_leo = Source.read(quiescent, extend="M3V", **units)  # type: ignore[arg-type]
    flare = mauvecl.ObservedFlare.read(data / file, quiescent, **how)  # type: ignore[arg-type]
    nm = flare.grid(ad_leo.wavelength_nm)
    light = np.interp(nm, ad_leo.wavelength_nm, ad_leo.flux_flam) + flare.flux(nm)
    x, lit = (expect(one, MAUVE, exposure=50.0) for one in (ad_leo, Source(nm, light, "flaring", "test")))
    plain, jump = (FlareModel.of(ad_leo, MAUVE, x, jump=with_jump) for with_jump in (False, True))
    gap = (322.0, 368.0)
    assert fit(lit.recorded_dn, x, plain).chi2[0] > misfits[0]
    assert fit(lit.recorded_dn, x, plain, skipped_nm=[gap]).chi2[0] > misfits[1]
    column = jump.names.index("jump")
    for skipped in ([gap], [(200.0, 300.0), gap]):
        found = fit(lit.recorded_dn, x, jump, skipped_nm=skipped)
        assert jumps[0] < found.estimates[0, column] < jumps[1]
    assert found.chi2[0] < misfits[0] / 1.5
    assert found.low[1, 0, 0] < 9500.0 < found.high[1, 0, 0]
    optical = fit(lit.recorded_dn, x, plain, skipped_nm=[(200.0, 400.0)])
    assert optical_k[0] < optical.low[0, 0, 0] < 9500.0 < optical.high[1, 0, 0]
    assert optical.estimates[0, 0] < optical_k[1]


def test_limits_at_a_bound_have_nominal_coverage() -> None:
    """Half of jumps of flares without one are at the bound (Chernoff 1954), limits cover 97.5 %; 1e-6 of seeds fail."""
    x, m, n = quiet(), model(jump=True), 1500
    found = fit(drawn(x, m.counts(9000.0, m.amplitudes(9000.0, 0.3)), n, 52), x, m, levels=(0.95,))
    column = found.column("jump")
    assert_covered((found.estimates[:, column] == 1.0).sum(), n, 0.47, 0.53)
    assert_covered((found.low[0, :, column] <= 1.0).sum(), n, 0.97, 0.98)
    assert found.one_sided[0, :, column].mean() > 0.96
    assert (found.high[0, :, column] > 1.0).all()


@pytest.mark.long
def test_intervals_agree_with_minos() -> None:
    """Compare the full likelihood with unknown dark and star."""
    iminuit = pytest.importorskip("iminuit")
    x, m = quiet(), model(jump=True)
    raw = drawn(x, m.counts(9500.0, m.amplitudes(9500.0, 0.5, jump=2.0)), 1, 77)[0]
    found = fit(raw, x, m, free(x))
    spectra = np.stack([x.dark_dn, x.net_source_dn])
    edge = m.splines[m.names.index("jump")]

    def minus_two_log(theta: Any) -> float:
        amplitude, thousand_k, jump, dark, level = theta
        log_k = np.log(1e3 * thousand_k)
        flare = m.counts(1e3 * thousand_k, [amplitude, (jump - 1) * amplitude / float(edge(log_k))])
        variance = x.variance_dn2 + x.gain_dn_per_electron * flare
        rest = raw - x.recorded_dn - flare - np.array([dark, level]) @ spectra
        return float(np.sum(rest**2 / variance + np.log(variance)))

    minuit = iminuit.Minuit(minus_two_log, (0.45, 9.0, 2.2, 0.0, 0.0), name=("a", "t", "j", "dark", "star"))
    minuit.errordef = 1.0
    minuit.migrad()
    minuit.hesse()
    for k, cl in enumerate((0.6827, 0.95)):
        minuit.minos("a", "t", "j", cl=cl)
        for name, place, scale in (("a", 1, 1.0), ("t", 0, 1e3), ("j", 2, 1.0)):
            best = minuit.values[name] * scale
            ends = [best + scale * minuit.merrors[name].lower, best + scale * minuit.merrors[name].upper]
            error = found.errors[0, place]
            assert abs(found.estimates[0, place] - best) < 0.03 * error
            np.testing.assert_allclose([found.low[k, 0, place], found.high[k, 0, place]], ends, atol=0.05 * error)


#: Flares whose bolometric flux is near its least, where it bends: library star, V, K, jump.
BENT = (("M3V", 9.0, 10_000.0, 2.0), ("K3V", 5.0, 12_000.0, 2.5))


@pytest.mark.long
@pytest.mark.parametrize(("snr", "flare"), [(10.0, BENT[0]), (15.0, BENT[1])], ids=["M3V", "K3V"])
def test_intervals_of_a_bent_quantity_cover(snr: float, flare: Any) -> None:
    """Count fits near the least bolometric flux, where Wilks' thresholds cover 96.7 %; 2e-4 of seeds fail for each."""
    n, parts = 20_000, 20
    x, own, unknown, kelvin, amplitudes = bent(snr, *flare)
    truth = np.array(list(own.values(kelvin, amplitudes).values()))
    inside = np.zeros(truth.size, int)
    for part in range(parts):
        raw = drawn(x, own.counts(kelvin, amplitudes), n // parts, 9000 + part, unknown)
        found = fit(raw, x, own, unknown, levels=(0.95,))
        inside += ((found.low[0] <= truth) & (truth <= found.high[0])).sum(axis=0)
    assert_covered(inside, n, 0.94, 0.96, 1e-4)


@pytest.mark.parametrize(("snr", "flare"), [(5.0, BENT[0]), (10.0, BENT[1])], ids=["M3V", "K3V"])
def test_rounding_moves_no_interval(snr: float, flare: Any) -> None:
    """Change frames of faint flares by one unit in the last place; ends once moved by up to a factor of eight."""
    x, own, unknown, kelvin, amplitudes = bent(snr, *flare)
    raw = drawn(x, own.counts(kelvin, amplitudes), 300, 9000, unknown)
    one, other = (fit(frames, x, own, unknown) for frames in (raw, np.nextafter(raw, np.inf)))
    for name in ("low", "high"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-5, atol=0)


def bent(snr: float, library: str, v: float, kelvin: float, jump: float) -> tuple[Any, ...]:
    """Return a flare with an S/N that is left when the unknowns are marginalised over."""
    x = quiet(library, v)
    own, unknown = FlareModel.of(star(library, v), MAUVE, x, jump=True), free(x, sky=0.1)
    amplitudes = own.amplitudes(kelvin, 0.1, jump=jump)
    for _ in range(8):
        amplitudes *= snr / forecast(x, own, kelvin, amplitudes, unknown).snr
    return x, own, unknown, kelvin, amplitudes
