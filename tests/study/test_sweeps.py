"""Sweeps over products and lists in detection, limits and S/N, and comparison with the Gaussian formula."""

from typing import Any

import numpy as np
import pytest
from scenes import study_of_g2v

import mauvecl
from mauvecl import Blackbody, Engine, Study, TwoBlackbodies, detect, gaussian


def study(axes: list[dict[str, Any]], how: str = "product", **changes: Any) -> Study:
    swept = {"flare": {"amplitudes": [0.1]}, "sweep": {"how": how, "axes": axes}}
    return study_of_g2v(**swept | changes).paper()


MAGNITUDES = {"quantity": "magnitude", "values": [6.0, 9.0]}
EXPOSURES = {"quantity": "exposure", "values": ["5 s", 50.0]}
TWO = {"second_temperature_k": 4000.0, "second_area": 1.0}
LINES = {"lines": {"H alpha": 0.1}}
#: Two values of each quantity that a sweep may have, and what it changes in an observation of a G2V star and its flare.
SWEPT: dict[str, tuple[Any, Any, str]] = {
    "star": ("G2V", "M3V", "star"),
    "magnitude": (6.0, 7.0, "magnitude"),
    "amplitude": (0.1, 0.2, "amplitude"),
    "flare_temperature": (8000.0, 12_000.0, "spectrum"),
    "balmer_jump": (2.0, 3.0, "spectrum"),
    "second_temperature": (5000.0, 6000.0, "spectrum"),
    "second_area": (2.0, 3.0, "spectrum"),
    "line_scale": (0.5, 2.0, "spectrum"),
    "exposure": (5.0, 50.0, "exposure"),
    "detector_temperature": (-10.0, 10.0, "instrument"),
    "sky": (21.0, 22.0, "sky"),
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


def test_every_quantity_is_swept() -> None:
    axis = Study.model_json_schema()["$defs"]["Axis"]["properties"]["quantity"]["enum"]
    assert set(SWEPT) == set(axis)


@pytest.mark.parametrize("quantity", SWEPT)
def test_sweep_gives_the_expectations_of_each_value(quantity: str, engine: Engine) -> None:
    *values, part = SWEPT[quantity]
    swept = study(
        [{"quantity": quantity, "values": values}], flare={"amplitudes": [0.1], "spectrum": SECTIONS.get(quantity, {})}
    )
    found = detect(swept.with_settings(["run={realisations=1000, fap=0.2, statistics=['matched']}"]), engine)
    assert [one.at for one in found.stars] == [{quantity: value} for value in values]
    for value, one in zip(values, found.stars, strict=True):
        given = {"star": "G2V", "magnitude": 7.4, "amplitude": 0.1, "exposure": 50.0, "instrument": None, "sky": 22.1}
        given |= {part: value}
        light = LIGHT[quantity](value) if part == "spectrum" else Blackbody(10_000.0)
        quiet = mauvecl.Source.from_library(given["star"]).at_magnitude(given["magnitude"])
        payload = mauvecl.Instrument.load("mauvesim")
        if given["instrument"] is not None:
            payload = payload.with_(temperature_c=given["instrument"])
        how = {"exposure": given["exposure"], "sky": mauvecl.Sky.of_brightness(given["sky"])}
        wanted = [mauvecl.expect(x, payload, **how) for x in (quiet, quiet.flaring(given["amplitude"], spectrum=light))]
        for x, y in zip((one.detection.quiet, *one.detection.flares), wanted, strict=True):
            np.testing.assert_allclose(x.source_electrons, y.source_electrons, rtol=1e-12)
            np.testing.assert_allclose(x.recorded_dn, y.recorded_dn, rtol=1e-12)
            np.testing.assert_allclose(x.variance_dn2, y.variance_dn2, rtol=1e-12)
            assert x.n_frames == y.n_frames


def test_file_of_an_instrument_is_read_once(tmp_path: Any, monkeypatch: pytest.MonkeyPatch, engine: Engine) -> None:
    """Temperatures of a sweep change an instrument that is kept, as draws of unknown values do."""
    path, loaded = tmp_path / "own.toml", list[str]()
    path.write_text('version = 2\nextends = "mauve"\n')
    load = mauvecl.Instrument.load
    monkeypatch.setattr(mauvecl.Instrument, "load", lambda name: loaded.append(str(name)) or load(name))
    asked = study_of_g2v(observation={"instrument": str(path)}, sweep={"axes": [
        {"quantity": "detector_temperature", "values": [0.0, 10.0, 20.0]},
    ]})  # fmt: skip
    assert len(mauvecl.snr(asked, engine).stars) == 3
    assert loaded == [str(path)]


def test_sweep_is_read_back(tmp_path: Any) -> None:
    asked = study([MAGNITUDES, EXPOSURES], "list", unknowns={"draws": 4, "known": ["qe_scale"]})
    path = tmp_path / "study.toml"
    path.write_text(asked.toml())
    assert Study.read(path) == asked


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


def test_limits_follow_the_sweep(engine: Engine) -> None:
    """A colder detector and a longer exposure have fainter limits, and the first sentence has the first exposure."""
    axes = [{"quantity": "detector_temperature", "values": [13.0, 21.0]}, EXPOSURES]
    answer = mauvecl.limit(study(axes), engine)
    assert " in 5 s with " in answer.headline
    table = answer.table
    assert list(table["detector_temperature"].value) == [13, 13, 21, 21]
    value = table["magnitude"].value
    assert value[0] > value[2]
    assert value[1] > value[3]
    assert value[1] > value[0]


def test_formula_holds_for_the_payload_and_fails_at_saturation(engine: Engine) -> None:
    """The formula holds for the nominal payload and fails with a bias near zero, which clips counts."""
    asked = study([MAGNITUDES, EXPOSURES])
    cells = gaussian(asked, engine).cells
    assert len(cells) == 4
    assert np.all(np.abs(cells["fap_ratio"] - 1) < 1e-9)
    assert np.all((cells["coverage_low"] > 0.66) & (cells["coverage_high"] < 0.71))
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
