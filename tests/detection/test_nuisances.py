"""Statistics marginalised over what is unknown or drawn: METHODS section 7, and simulation by NumPy code alone."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scenes import star

from mauvecl import Expectation, Instrument, Linear, Normal, Nuisances, Processes, Sky, Source, Uniform, expect
from mauvecl.detection import requests
from mauvecl.detection.distributions import QuadraticForm
from mauvecl.detection.statistics import Differences, Setting
from mauvecl.noise.scene import FactorDistributions, changes_of, prepare

FREE = float("inf")


@cache
def pair(name: str = "G2V", magnitude: float = 7.4, amplitude: float = 0.02) -> tuple[Expectation, Expectation]:
    source = Source.from_library(name).at_magnitude(magnitude, "V", "vega")
    mauve, sky = Instrument.load("mauvesim"), Sky.of_brightness(22.1)
    quiet, flare = (expect(one, mauve, exposure=50.0, sky=sky) for one in (source, source.flaring(amplitude)))
    return quiet, flare


def setting(quiet: Expectation, sd: dict[str, float]) -> Setting:
    return Setting(quiet, ~quiet.saturated, nuisances=Nuisances.of(quiet, sd))


@pytest.mark.parametrize(
    ("star", "known", "dark", "light", "both"),
    [
        (("G2V", 7.4, 0.02), 8.36, (0.23, 3.06), (4.12, 5.67), 3.05),
        (("G2V", 7.4, 0.081), 33.88, (0.92, 12.39), (16.7, 23.0), 12.36),
        (("K3V", 3.7, 0.0076), 92.9, (2.94, 34.1), (3.15, 71.9), 32.7),
        (("M3V", 9.0, 0.24), 46.5, (1.25, 17.0), (44.8, 45.1), 13.6),
    ],
)
def test_costs_of_unknowns_equal_those_computed_elsewhere(
    star: Any, known: float, dark: tuple[float, float], light: tuple[float, float], both: float
) -> None:
    """Compare with numbers of another program (Vega at V = 0) to 1 %, or half a digit of 0.23."""
    quiet, flare = pair(*star)
    matched, plain = requests.STATISTICS["matched"], Setting(quiet, ~quiet.saturated)
    weights, delta = matched.plain_weights(plain, flare), flare.signal_dn - quiet.signal_dn
    assert matched.closed_form(plain, flare, flare).mean == pytest.approx(known, rel=0.01)
    for sd, (naive, marginal) in (({"dark": 0.1}, dark), ({"light": 0.01}, light)):
        s = setting(quiet, sd)
        noise = weights**2 @ quiet.variance_dn2 + np.sum((s.nuisances.finite(s.nuisances.spectra) @ weights) ** 2)
        assert weights @ delta / np.sqrt(noise) == pytest.approx(naive, rel=0.022 if naive < 0.5 else 0.01)
        assert matched.closed_form(s, flare, flare).mean == pytest.approx(marginal, rel=0.01)
    s = setting(quiet, {"dark": FREE, "light": FREE})
    assert matched.closed_form(s, flare, flare).mean == pytest.approx(both, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("sd", [{"dark": 0.1}, {"dark": FREE, "light": 0.02}, {"dark": 0.3, "sky": 1.0, "tilt": FREE}])
@pytest.mark.parametrize("name", ["chi2", "chi2_element", "matched", "uv_excess", "own"])
def test_distributions_agree_with_drawn_nuisances(name: str, sd: dict[str, float]) -> None:
    """Compare 4000 spectra with and without a flare.

    60 means and standard deviations lie within 5 standard errors: by chance one run in 3e4 fails.
    """
    quiet, flare = pair(amplitude=0.081)
    n = quiet.wavelength_nm.size
    one = Linear("own", 1.0 + np.arange(n) / n) if name == "own" else requests.STATISTICS[name]
    s = setting(quiet, sd)
    rng = np.random.default_rng(20_261_122)
    size = 4000
    for observed in (quiet, flare):
        x = rng.normal(size=(size, n)) * np.sqrt(observed.variance_dn2) + (observed.signal_dn - quiet.signal_dn)
        for spectrum, spread in zip(s.nuisances.spectra, s.nuisances.sd, strict=True):
            # What is projected out may be as large as it likes.
            x += rng.normal(size=(size, 1)) * (spread if np.isfinite(spread) else 7.0) * spectrum
        values = one.values(s, x, np.broadcast_to(one.variance(s), x.shape), flare)
        form = one.closed_form(s, observed, flare)
        assert abs(values.mean() - form.mean) < 5 * form.std / np.sqrt(size)
        assert abs(values.std() / form.std - 1) < 5 / np.sqrt(2 * size) * (1.0 if name != "chi2_element" else 1.3)


@pytest.mark.parametrize("name", ["chi2", "chi2_element"])
def test_subtracted_rows_give_the_inverse_covariance(name: str) -> None:
    """Compare with x^T C^-1 x for the full matrix C."""
    quiet, _ = pair()
    s, one = setting(quiet, {"dark": 0.1, "light": 0.02, "tilt": 0.05}), requests.STATISTICS[name]
    x = np.random.default_rng(5).normal(size=(3, quiet.wavelength_nm.size)) * np.sqrt(quiet.variance_dn2)
    spectra, variance, seen = s.nuisances.spectra * s.used, quiet.variance_dn2 * s.used, x * s.used
    if name == "chi2_element":
        spectra, seen = (np.array([quiet.per_element(row) for row in rows]) for rows in (spectra, seen))
        variance = quiet.per_element(variance)
    counts = variance > 0
    full = np.diag(variance[counts]) + (spectra[:, counts].T * s.nuisances.sd**2) @ spectra[:, counts]
    wanted = np.einsum("ni,ij,nj->n", seen[:, counts], np.linalg.inv(full), seen[:, counts])
    assert one.values(s, x, np.broadcast_to(one.variance(s), x.shape)) == pytest.approx(wanted, rel=1e-9)


def test_projected_out_spectra_do_not_change_the_statistic() -> None:
    quiet, flare = pair()
    s = setting(quiet, {"dark": FREE, "light": FREE})
    x = np.random.default_rng(6).normal(size=(1, quiet.wavelength_nm.size)) * np.sqrt(quiet.variance_dn2)
    moved = x + 100.0 * s.nuisances.spectra[0] - 3.0 * s.nuisances.spectra[1]
    for name in ("chi2", "chi2_element", "matched", "uv_excess"):
        one = requests.STATISTICS[name]
        before, after = (one.values(s, v, np.broadcast_to(one.variance(s), v.shape), flare) for v in (x, moved))
        assert after == pytest.approx(before, abs=1e-3)


def test_projected_out_unknowns_take_degrees_of_freedom() -> None:
    quiet, _ = pair()
    s = setting(quiet, {"dark": FREE, "light": 0.01})
    wanted = {"chi2": quiet.wavelength_nm.size - 1, "chi2_element": quiet.element_wavelength_nm.size - 1, "matched": 1}
    assert {name: requests.STATISTICS[name].dof(s) for name in wanted} == wanted


@pytest.mark.long
@pytest.mark.parametrize("amplitude", [0.24, 3.0])
def test_closed_form_in_a_span_equals_the_full_one(amplitude: float) -> None:
    """Compare with the eigenvalues of the whole covariance, for every fourth pixel."""
    quiet, flare = pair(amplitude=amplitude)
    used = np.arange(quiet.wavelength_nm.size) % 4 == 0
    s = Setting(quiet, used, nuisances=Nuisances.of(quiet, {"dark": 0.5, "light": FREE, "sky": 0.1}))
    spectra, model, true = s.nuisances.spectra[:, used], quiet.variance_dn2[used], flare.variance_dn2[used]
    rows, drawn = s.nuisances.rows(model, spectra), s.nuisances.finite(spectra)
    root = np.linalg.cholesky(np.diag(true) + drawn.T @ drawn)
    weight, vectors = np.linalg.eigh((root.T / model) @ root - (root.T @ rows.T) @ (rows @ root))
    shift = vectors.T @ np.linalg.solve(root, (flare.signal_dn - quiet.signal_dn)[used])
    kept = weight > 1e-9
    full, found = QuadraticForm(weight[kept], shift[kept]), requests.STATISTICS["chi2"].closed_form(s, flare, flare)
    assert found.mean == pytest.approx(full.mean, rel=1e-9)
    assert found.std == pytest.approx(full.std, rel=1e-5)
    for probability in (0.9, 0.1, 1e-3, 1e-6):
        assert found.sf(full.isf(probability)) == pytest.approx(probability, rel=1e-4)


@pytest.mark.parametrize("name", ["matched", "uv_excess"])
def test_weighted_sums_over_drawn_unknowns_have_the_moments_of_their_nodes(name: str) -> None:
    """Compare each node's mean and variance with the sums over pixels at its temperature and light."""
    quiet, flare = star(amplitudes=(0.1,))
    processes = Processes(
        jitter=Uniform(0.0, 0.05),
        detector_temperature=Normal(21.0, 0.5, 18.5, 23.5),
        sky_level=Normal(1.0, 0.1, 0.5, 1.5),
    )
    drawn, statistic = FactorDistributions.of(prepare([quiet], processes=processes)), requests.STATISTICS[name]
    setting = Setting(quiet, ~quiet.saturated, nuisances=Nuisances.of(quiet, {"dark": 0.5, "sky": 0.1}))
    nodes, rows = drawn.nodes(flare, weighted=True)
    amounts = np.array([node.amounts for node in nodes])
    assert len(nodes) > 100
    means, variances = changes_of(flare)
    delta = flare.recorded_light_dn - quiet.recorded_light_dn
    weights = statistic.weights_per_dn(setting, flare)
    seen = Differences(delta, flare.variance_dn2, scatter=rows)
    found = statistic.moved_forms(setting, seen, amounts, means, variances, flare)
    for one, amount in zip(found, amounts, strict=True):
        variance = weights**2 @ (flare.variance_dn2 + amount @ variances) + np.sum((rows @ weights) ** 2)
        wanted = float(weights @ (delta + amount @ means)), float(np.sqrt(variance))
        assert (one.mean, one.std) == pytest.approx(wanted, rel=1e-12)


def test_light_of_unknowns_is_separated_from_a_flare() -> None:
    """Of data without noise all amplitudes with flat priors are found; with noise, none is biased by the flare."""
    rng = np.random.default_rng(8)
    spectra, flare, variance = rng.uniform(1, 2, (2, 50)), rng.uniform(0, 5, 50), rng.uniform(4, 9, 50)
    unknown = Nuisances(("dark", "light"), spectra, np.array([np.inf, np.inf]))
    variance[:5] = np.inf
    light = np.array([30.0, -7.0]) @ spectra
    np.testing.assert_allclose(unknown.fitted_dn(light + 3.0 * flare, variance, flare), light, rtol=1e-9)
    # A prior that excludes the level keeps it away.
    known = Nuisances(("dark", "light"), spectra, np.array([1e-9, 1e-9]))
    np.testing.assert_allclose(known.fitted_dn(light + 3.0 * flare, variance, flare), 0.0, atol=1e-9)
