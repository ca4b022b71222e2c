"""Sweeps over products and lists in detection, limits and S/N, and comparison with the Gaussian formula."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest
from scenes import instrument, star
from scipy import stats

from mauvecl.answers.detection.detect import detect
from mauvecl.answers.detection.gaussian import ONE_SIGMA, beyond, coverage, gaussian_report
from mauvecl.answers.detection.maps import detection_map
from mauvecl.answers.limits.assumptions import what_matters
from mauvecl.answers.limits.limits import limiting_magnitude
from mauvecl.answers.signal.exposures import exposure_for
from mauvecl.answers.signal.simulate import simulate
from mauvecl.answers.signal.snr import snr
from mauvecl.device.engine import Engine
from mauvecl.study.cases import cases
from mauvecl.study.study import PAPER_BUDGETS, Study


def study(axes: list[dict[str, Any]], how: str = "product", **changes: Any) -> Study:
    """Return a study of the paper's G2V star."""
    data: dict[str, Any] = {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "flare": {"amplitudes": [0.1]},
        "run": {"realisations": 20_000, "fap": 1e-2, "statistics": ["matched"], "seed": 5},
        "sweep": {"how": how, "axes": axes},
    }
    return Study.build(data | changes, "test")


MAGNITUDES = {"quantity": "magnitude", "values": [6.0, 9.0]}
EXPOSURES = {"quantity": "exposure", "values": [5.0, 50.0]}


def test_cells_are_all_combinations() -> None:
    both = cases(study([MAGNITUDES, EXPOSURES]))
    assert [tuple(case.at.values()) for case in both] == [(6, 5), (6, 50), (9, 5), (9, 50)]
    assert all(case.star.magnitude == case.at["magnitude"] for case in both)
    assert all(case.study.observation.exposure_s == case.at["exposure"] for case in both)
    assert all(not case.study.sweep.axes for case in both)
    listed = cases(study([MAGNITUDES, EXPOSURES], "list"))
    assert [tuple(case.at.values()) for case in listed] == [(6, 5), (9, 50)]
    assert [(case.at, case.study) for case in cases(study([]))] == [({}, study([]))]


def test_sweep_is_read_back(tmp_path: Any) -> None:
    asked = study([MAGNITUDES, EXPOSURES], "list", unknowns={"draws": 4, "known": ["qe_scale"]})
    path = tmp_path / "study.toml"
    path.write_text(asked.toml())
    assert Study.read(path) == asked


def test_each_cell_equals_its_own_detection(engine: Engine) -> None:
    """A cell of a sweep has the same bits as the cell alone; columns give the swept values."""
    asked = study([MAGNITUDES, EXPOSURES])
    found = detect(asked, engine)
    assert list(found.table["magnitude"].value) == [6, 6, 9, 9]
    assert list(found.table["exposure"].value) == [5, 50, 5, 50]
    for k, case in enumerate(cases(asked)):
        (alone,) = detect(case.study, engine).table
        assert alone["probability"] == found.table["probability"][k]
        assert alone["threshold"] == found.table["threshold"][k]
    assert found.table["probability"][0] > found.table["probability"][2]
    amplitudes = detect(study([{"quantity": "amplitude", "values": [0.01, 0.1]}]), engine).table
    assert list(amplitudes["amplitude"]) == [0.01, 0.1]


def test_limits_follow_the_sweep(engine: Engine) -> None:
    """A colder detector and a longer exposure have fainter limits."""
    axes = [{"quantity": "detector_temperature", "values": [13.0, 21.0]}, EXPOSURES]
    result = limiting_magnitude(study(axes), engine)
    table = result.table
    assert list(table["detector_temperature"].value) == [13, 13, 21, 21]
    value = table["magnitude"].value
    assert value[0] > value[2]
    assert value[1] > value[3]
    assert value[1] > value[0]


def test_noise_budgets_equal_those_of_the_paper(engine: Engine) -> None:
    """For 50 s and 600 s, noise terms add up; photons dominate for the Be star and dark current for the G2V star."""
    found = snr(PAPER_BUDGETS.with_settings(["run.realisations=1000"]), engine)
    assert [s.result.expectation.exposure_s for s in found.stars] == [50.0] * 3 + [600.0] * 3
    table = found.noise_budget
    parts = [table[name].value for name in ("source_photon", "zodiacal_photon", "dark", "read")]
    np.testing.assert_allclose(np.sqrt(np.sum(np.square(parts), axis=0)), table["total"].value, rtol=1e-9)
    blue = np.abs(table["wavelength"].value - 250) < 5
    for name, largest in (("B2IV V = 3.03", "source_photon"), ("G2V V = 7.4", "dark")):
        rows = table[blue & (table["star"] == name)]
        assert all(rows[largest].mean() >= rows[other].mean() for other in ("source_photon", "dark", "read"))
    # Noise grows with the square root of the number of frames.
    short, long = (table[(table["exposure"].value == t) & (table["star"] == "G2V V = 7.4")] for t in (50, 600))
    np.testing.assert_allclose(long["total"] / short["total"], np.sqrt(12), rtol=1e-6)


def test_snr_grows_with_exposure(engine: Engine) -> None:
    table = snr(study([MAGNITUDES, EXPOSURES]), engine).element
    by_cell = {
        (m, t): table[(table["magnitude"].value == m) & (table["exposure"].value == t)]["expected"]
        for m in (6, 9)
        for t in (5, 50)
    }
    np.testing.assert_allclose(by_cell[6, 50] / by_cell[6, 5], np.sqrt(10), rtol=1e-6)
    assert np.all(by_cell[6, 5] > by_cell[9, 5])


def test_gaussian_coverage_is_exact(engine: Engine) -> None:
    """Coverage from histograms equals that from the counts, and the nominal one for normal noise."""
    (quiet,) = star(exposure=5.0, payload=instrument(part=True))
    n = 20_000
    result = engine.snr(quiet, realisations=n, seed=4)
    raw = engine.realise(quiet, count=n, seed=4)
    net = raw - quiet.n_frames * (quiet.bias_dn + quiet.dark_dn)
    known = quiet.n_frames * (quiet.read_noise_dn**2 + quiet.dark_variance_dn2)
    sigma = np.sqrt(quiet.gain_dn_per_electron * np.maximum(net, 0) + known)
    direct = np.mean(np.abs(net - quiet.recorded_light_dn) <= sigma, axis=0)
    np.testing.assert_allclose(coverage(result), direct, atol=0.01)
    assert coverage(result).mean() == pytest.approx(direct.mean(), abs=5e-4)
    # The mean of 198 pixels has a standard error of 2.4e-4, and a DN is 1/49 of sigma.
    assert direct.mean() == pytest.approx(ONE_SIGMA, abs=5e-3)


@pytest.mark.long
def test_formula_holds_for_the_payload_and_fails_at_saturation(engine: Engine) -> None:
    """The formula holds for the nominal payload and fails with a bias near zero, which clips counts."""
    asked = study([MAGNITUDES, EXPOSURES])
    cells = gaussian_report(asked, engine).cells
    assert len(cells) == 4
    assert np.all(np.abs(cells["fap_ratio"] - 1) < 1e-9)
    assert np.all((cells["coverage_low"] > 0.66) & (cells["coverage_high"] < 0.71))
    clipped = gaussian_report(asked.with_instrument({"bias_dn": 5.0, "dark_scale_dn_per_s": 0.01}), engine).cells
    (faint,) = clipped[(clipped["magnitude"].value == 9) & (clipped["exposure"].value == 5)]
    assert abs(faint["snr_off_by"]) > 0.1
    assert faint["why"] == "clipping"
    assert faint["fap_ratio"] != 1.0


@pytest.mark.parametrize("name", ["mauve", "mauve-electrons"])
@pytest.mark.parametrize("temperature", [21.0, -30.0])
@pytest.mark.parametrize("sigmas", [3.0, 5.0])
def test_pixels_beyond_five_sigma_are_counted(name: str, temperature: float, sigmas: float) -> None:
    """The saddle-point tail agrees with the exact sum over dark counts to 0.3 %; the distribution is skewed upward."""
    (quiet,) = star(exposure=5.0, payload=instrument(name, part=True, temperature_c=temperature))
    p, step = 90, float(quiet.dark_step_dn[90])
    poisson = quiet.photon_noise == "poisson"
    # Both photons and dark current are then Poisson in electrons.
    mean = quiet.dark_dn[p] / step + (quiet.source_electrons + quiet.sky_electrons)[p] * poisson
    goal = sigmas * np.sqrt(quiet.variance_dn2[p] - 1 / 12)
    photon = quiet.gain_dn_per_electron[p] * quiet.recorded_light_dn[p]
    sd = np.sqrt(quiet.read_noise_dn[p] ** 2 + photon * (not poisson))
    counts = np.arange(int(mean + 14 * np.sqrt(mean) + 30))
    for side in (1, -1):
        exact = stats.poisson.pmf(counts, mean) @ stats.norm.sf((goal - side * (counts - mean) * step) / sd)
        found = beyond(quiet, side * sigmas)[p]
        assert found == pytest.approx(exact, rel=3e-3)
        assert (found > stats.norm.sf(sigmas)) == (side > 0)


@pytest.mark.long
def test_every_column_is_described_and_every_answer_knows_its_study(engine: Engine) -> None:
    """Every column of every answer has a description, and each table contains the study that made it."""
    asked = study([{"quantity": "sky", "values": [21.0, 22.0]}])
    plain = study([]).with_settings(
        ["map.x={quantity='magnitude',values=[7.0]}", "map.y={quantity='amplitude',values=[0.1]}"]
    )
    unknown = asked.model_copy(update={"unknowns": type(asked.unknowns)(draws=2)})
    detected, seen, usual = detect(asked, engine), snr(asked, engine), gaussian_report(asked, engine)
    limits, exposures = limiting_magnitude(unknown, engine), exposure_for(plain, 5.0, 300.0)
    tables = [
        (asked, [detected.table, detected.departures, detected.roc, detected.tails]),
        (asked, [seen.pixel, seen.element, seen.noise_budget, usual.cells, usual.elements, usual.thresholds]),
        (unknown, [limits.table, limits.draws]),
        (exposures.study, [exposures.table]),
        (plain, [what_matters(plain), simulate(plain).observations[0][2]]),
    ]
    found = detection_map(plain, engine)
    tables.append((found.study, [found.table]))
    for made_by, group in tables:
        for table in group:
            assert [name for name in table.colnames if not table[name].info.description] == []
            assert Study.build(tomllib.loads(table.meta["study"]), "table") == made_by
