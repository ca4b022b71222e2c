"""Sweeps over products and lists in detection, limits and S/N, and comparison with the Gaussian formula."""

from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from scenes import instrument, star, study_of_g2v
from scipy import stats

import mauvecl
from mauvecl import Blackbody, Engine, Study, TwoBlackbodies, detect, gaussian


def study(axes: list[dict[str, Any]], how: str = "product", **changes: Any) -> Study:
    swept = {"flare": {"amplitudes": [0.1]}, "sweep": {"how": how, "axes": axes}}
    return study_of_g2v(**swept | changes).paper()


MAGNITUDES = {"quantity": "magnitude", "values": [6.0, 9.0]}
EXPOSURES = {"quantity": "exposure", "values": ["5 s", 50.0]}
TWO = {"second_temperature_k": 4000.0, "second_area": 1.0}
LINES = {"lines": {"H alpha": 0.1}}
#: Two values of each quantity that a sweep may have.
SWEPT: dict[str, tuple[Any, Any]] = {
    "star": ("G2V", "M3V"),
    "magnitude": (6.0, 7.0),
    "amplitude": (0.1, 0.2),
    "flare_temperature": (8000.0, 12_000.0),
    "balmer_jump": (2.0, 3.0),
    "second_temperature": (5000.0, 6000.0),
    "second_area": (2.0, 3.0),
    "line_scale": (0.5, 2.0),
    "exposure": (5.0, 50.0),
    "detector_temperature": (-10.0, 10.0),
    "sky": (21.0, 22.0),
}
SECTIONS = {"second_temperature": TWO, "second_area": TWO, "line_scale": LINES}
#: The spectrum of the flare at a value.
LIGHT = {
    "flare_temperature": Blackbody,
    "balmer_jump": lambda v: mauvecl.BalmerFlare(10_000.0, v),
    "second_temperature": lambda v: TwoBlackbodies(10_000.0, v, 1.0),
    "second_area": lambda v: TwoBlackbodies(10_000.0, 4000.0, v),
    "line_scale": lambda v: mauvecl.FlareWithLines(Blackbody(10_000.0), {"H alpha": 0.1 * v}),
}


@pytest.mark.parametrize("quantity", Study.model_json_schema()["$defs"]["Axis"]["properties"]["quantity"]["enum"])
def test_sweep_gives_the_expectations_of_each_value(quantity: str, engine: Engine, monkeypatch: Any) -> None:
    """The file of the instrument is read once: temperatures of a sweep change an instrument that is kept."""
    monkeypatch.setattr(mauvecl.Instrument, "load", load := Mock(wraps=mauvecl.Instrument.load))
    values = SWEPT[quantity]
    swept = study(
        [{"quantity": quantity, "values": values}], flare={"amplitudes": [0.1], "spectrum": SECTIONS.get(quantity, {})}
    )
    found = detect(swept.with_settings(["run={realisations=1000, fap=0.2, statistics=['matched']}"]), engine)
    assert [one.at for one in found.stars] == [{quantity: value} for value in values]
    load.assert_called_once_with("mauvesim")
    for value, one in zip(values, found.stars, strict=True):
        given = {"star": "G2V", "magnitude": 7.4, "amplitude": 0.1, "exposure": 50.0, "sky": 22.1} | {quantity: value}
        light = LIGHT[quantity](value) if quantity in LIGHT else Blackbody(10_000.0)
        quiet = mauvecl.Source.from_library(given["star"]).at_magnitude(given["magnitude"])
        payload = mauvecl.Instrument.load("mauvesim").with_(temperature_c=given.get("detector_temperature", 21.0))
        how = {"exposure": given["exposure"], "sky": mauvecl.Sky.of_brightness(given["sky"])}
        wanted = [mauvecl.expect(x, payload, **how) for x in (quiet, quiet.flaring(given["amplitude"], spectrum=light))]
        for x, y in zip((one.detection.quiet, *one.detection.flares), wanted, strict=True):
            np.testing.assert_allclose(x.source_electrons, y.source_electrons, rtol=1e-12)
            np.testing.assert_allclose(x.recorded_dn, y.recorded_dn, rtol=1e-12)
            np.testing.assert_allclose(x.variance_dn2, y.variance_dn2, rtol=1e-12)
            assert x.n_frames == y.n_frames


def test_each_cell_equals_its_own_detection(engine: Engine) -> None:
    """A cell of a product or list has the same bits as the cell alone; columns give the swept values."""
    found = detect(study([MAGNITUDES, EXPOSURES]), engine).table
    assert list(found["magnitude"].value) == [6, 6, 9, 9]
    assert list(found["exposure"].value) == [5, 50, 5, 50]
    for row in found:
        alone = study([]).at("magnitude", row["magnitude"].value).at("exposure", row["exposure"].value)
        (same,) = detect(alone, engine).table
        assert (same["probability"], same["threshold"]) == (row["probability"], row["threshold"])
    assert found["probability"][0] > found["probability"][2]
    listed = detect(study([MAGNITUDES, EXPOSURES], "list"), engine).table
    assert list(listed["probability"]) == [found["probability"][0], found["probability"][3]]
    amplitudes = detect(study([{"quantity": "amplitude", "values": [0.01, 0.1]}]), engine).table
    assert list(amplitudes["amplitude"]) == [0.01, 0.1]
    # A colder detector and a longer exposure have fainter limits, and the first sentence has the first exposure.
    axes = [{"quantity": "detector_temperature", "values": [13.0, 21.0]}, EXPOSURES]
    answer = mauvecl.limit(study(axes), engine)
    assert " in 5 s with " in answer.headline
    assert list(answer.table["detector_temperature"].value) == [13, 13, 21, 21]
    value = answer.table["magnitude"].value
    assert value[0] > value[2]
    assert value[1] > max(value[0], value[3])


def test_formula_holds_for_the_payload_and_fails_at_saturation(engine: Engine) -> None:
    """The formula holds for the nominal payload and fails with a bias near zero, which clips counts."""
    asked = study([MAGNITUDES, EXPOSURES])
    answer = gaussian(asked, engine)
    cells, elements = answer.cells, answer.elements
    assert len(cells) == 4
    assert np.all(np.abs(cells["fap_ratio"] - 1) < 1e-9)
    assert np.all((cells["coverage_low"] > 0.66) & (cells["coverage_high"] < 0.71))
    # Coverage from histograms equals that of the same realisations.
    quiet = mauvecl.snr(asked, engine).stars[0].result.expectation
    raw = engine.realise(quiet, count=20_000, seed=5)
    net = raw - quiet.n_frames * (quiet.bias_dn + quiet.dark_dn)
    known = quiet.n_frames * (quiet.read_noise_dn**2 + quiet.dark_variance_dn2)
    sigma = np.sqrt(quiet.gain_dn_per_electron * np.maximum(net, 0) + known)
    direct = np.mean(np.abs(net - quiet.recorded_light_dn) <= sigma, axis=0)
    first = (elements["magnitude"].value == 6) & (elements["exposure"].value == 5)
    count = quiet.per_element(np.ones(quiet.wavelength_nm.size))
    np.testing.assert_allclose(elements[first]["coverage"].value, quiet.per_element(direct) / count, atol=0.003)
    low = gaussian(asked.with_instrument({"bias_dn": 5.0, "dark_scale_dn_per_s": 0.01}), engine)
    # Counts are cut off at zero, not at saturation.
    assert not any("saturation" in text for text in low.signal.messages)
    clipped = low.cells
    (faint,) = clipped[(clipped["magnitude"].value == 9) & (clipped["exposure"].value == 5)]
    assert abs(faint["snr_off_by"]) > 0.1
    assert faint["why"] == "clipping"
    assert faint["fap_ratio"] != 1.0
    # Nothing is said of false alarms that are not counted.
    rare = gaussian(study([]).with_settings(["run.fap=1e-6", "run.tails=sampled"]), engine)
    assert np.isnan(rare.cells["fap_ratio"][0])
    assert "as many" not in rare.headline


@pytest.mark.parametrize("name", ["mauvesim", "mauve"])
@pytest.mark.parametrize("temperature", [21.0, -30.0])
def test_pixels_beyond_five_sigma_are_counted(name: str, temperature: float, engine: Engine) -> None:
    """The saddle-point tail agrees with the exact sum over dark counts to 0.3 %; the distribution is skewed upward."""
    part = {"output_min_nm": 340.0, "output_max_nm": 350.0, "temperature_c": temperature}
    asked = study([{"quantity": "exposure", "values": [5.0]}], observation={"changes": part})
    answer = gaussian(asked.with_settings([f"observation.instrument={name}"]), engine)
    (cell,) = answer.cells
    # A part of the spectrum without any of the usual wavelengths shows its middle.
    assert answer.signal.shown_nm == [pytest.approx(345.0, abs=0.2)]
    assert len(answer.signal.views[0].table) == 1
    (quiet,) = star(exposure=5.0, payload=instrument(name, **part))
    poisson = quiet.photon_noise == "poisson"
    found = []
    for p in range(quiet.wavelength_nm.size):
        step = float(quiet.dark_step_dn[p])
        # Both photons and dark current are then Poisson in electrons.
        mean = quiet.dark_dn[p] / step + (quiet.source_electrons + quiet.sky_electrons)[p] * poisson
        goal = 5 * np.sqrt(quiet.variance_dn2[p] - 1 / 12)
        photon = quiet.gain_dn_per_electron[p] * quiet.recorded_light_dn[p]
        sd = np.sqrt(quiet.read_noise_dn[p] ** 2 + photon * (not poisson))
        counts = np.arange(int(mean + 14 * np.sqrt(mean) + 30))
        beyond = [stats.norm.sf((goal - side * (counts - mean) * step) / sd) for side in (1, -1)]
        found.append(beyond @ stats.poisson.pmf(counts, mean) / stats.norm.sf(5.0))
    above, below = np.transpose(found)
    assert cell["five_sigma_above"] == pytest.approx(above.max(), rel=3e-3)
    assert cell["five_sigma_below"] == pytest.approx(below.min(), rel=3e-3)
    assert cell["five_sigma_above"] > 1 > cell["five_sigma_below"]
