"""Statistics marginalised over what is unknown or drawn: METHODS section 7, and simulation by NumPy code alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scenes import star

from mauvecl import Expectation, Instrument, Normal, Nuisances, Processes, Sky, Source, Uniform, expect
from mauvecl.detection import requests
from mauvecl.detection.distributions import QuadraticForm
from mauvecl.detection.statistics import Differences, Setting
from mauvecl.noise.scene import FactorDistributions, changes_of, prepare

FREE = float("inf")


@cache
def pair(name: str = "G2V", magnitude: float = 7.4, amplitude: float = 0.02) -> tuple[Expectation, Expectation]:
    source = Source.from_library(name).at_magnitude(magnitude, "V", "vega")
    mauve, sky = Instrument.load("mauve"), Sky.of_brightness(22.1)
    quiet, flare = (expect(one, mauve, exposure=50.0, sky=sky) for one in (source, source.flaring(amplitude)))
    return quiet, flare


def setting(quiet: Expectation, sd: dict[str, float]) -> Setting:
    return Setting(quiet, ~quiet.saturated, nuisances=Nuisances.of(quiet, sd))


@pytest.mark.parametrize("name", ["chi2", "chi2_element"])
def test_subtracted_rows_give_the_inverse_covariance(name: str) -> None:
    """Compare with x^T C^-1 x for the full matrix C."""
    quiet, _ = pair()
    s, one = setting(quiet, {"dark": 0.1, "light": 0.02, "tilt": 0.05}), requests.STATISTICS[name]
    assert s.nuisances is not None
    x = np.random.default_rng(5).normal(size=(3, quiet.wavelength_nm.size)) * np.sqrt(quiet.variance_dn2)
    spectra, variance, seen = s.nuisances.spectra * s.used, quiet.variance_dn2 * s.used, x * s.used
    if name == "chi2_element":
        spectra, seen = (np.array([quiet.per_element(row) for row in rows]) for rows in (spectra, seen))
        variance = quiet.per_element(variance)
    counts = variance > 0
    full = np.diag(variance[counts]) + (spectra[:, counts].T * s.nuisances.sd**2) @ spectra[:, counts]
    wanted = np.einsum("ni,ij,nj->n", seen[:, counts], np.linalg.inv(full), seen[:, counts])
    assert one.values(s, x, np.broadcast_to(one.variance(s), x.shape)) == pytest.approx(wanted, rel=1e-9)


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
    assert s.nuisances is not None
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
    assert drawn is not None
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
