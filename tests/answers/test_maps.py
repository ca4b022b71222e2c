"""Maps: each cell equals its own detection, and probabilities fall with magnitude."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from answers import expectations, of_kind
from astropy.table import QTable

from mauvecl import Engine, Study, detection_map

N = 20_000


def study(x: dict, y: dict) -> Study:
    return Study.build(
        {
            "star": [{"library": "G2V", "magnitude": 7.4}],
            "flare": {"amplitudes": [0.1]},
            "run": {"realisations": N, "fap": 1e-2, "statistics": ("chi2", "matched"), "seed": 9},
            "map": {"x": x, "y": y},
        },
        "test",
    )


MAGNITUDE = {"quantity": "magnitude", "start": 6.0, "stop": 10.0, "steps": 5}
AMPLITUDE = {"quantity": "amplitude", "start": 0.02, "stop": 0.5, "steps": 4, "log": True}


def alone(asked: Study, engine: Engine, x: float | str, y: float | str) -> list[float]:
    one = asked.at(asked.map.x.quantity, x).at(asked.map.y.quantity, y)
    quiet, flare = expectations(one)
    found = engine.detect(quiet, [flare], realisations=N, seed=9, statistics=("chi2", "matched"))
    return [found.detection_probability(1e-2, s)[0].value for s in ("chi2", "matched")]


@pytest.mark.parametrize(
    ("x", "y"),
    [
        (MAGNITUDE, AMPLITUDE),
        (AMPLITUDE, {"quantity": "flare_temperature", "values": [6000.0, 10_000.0, 20_000.0]}),
        ({"quantity": "exposure", "values": [5.0, 50.0]}, {"quantity": "detector_temperature", "values": [13.0, 21.0]}),
        ({"quantity": "star", "values": ["G2V", "K5V"]}, {"quantity": "sky", "values": [18.0, 22.0]}),
    ],
)
def test_each_cell_equals_its_own_detection(engine: Engine, x: dict, y: dict) -> None:
    """Compare all bits, which agree because all cells share their draws."""
    asked = study(x, y)
    found = detection_map(asked, engine)
    assert found.probability.shape == (2, len(found.y), len(found.x))
    for j, i in ((0, 0), (len(found.y) - 1, 0), (1, len(found.x) - 1)):
        assert list(found.probability[:, j, i]) == alone(asked, engine, found.x[i], found.y[j])
    assert (found.low <= found.probability).all()
    assert (found.probability <= found.high).all()


def test_probability_decreases_with_magnitude(engine: Engine) -> None:
    """Check that brighter stars and larger flares are detected as often or more, but for the threshold's error."""
    found = detection_map(study(MAGNITUDE, AMPLITUDE), engine)
    slack = 5e-3
    assert (np.diff(found.probability, axis=2) < slack).all()
    assert (np.diff(found.probability, axis=1) > -slack).all()
    assert (found.probability[1] > found.probability[0] - slack).all()
    # Near the closed form: the threshold at 1e-2 of 20 000 is uncertain by 0.03 of a standard deviation.
    error = np.sqrt(found.closed_form * (1 - found.closed_form) / N)
    assert (np.abs(found.probability - found.closed_form) < 5 * (error + 0.4 * 0.03) + 1e-3).all()


@pytest.mark.long
def test_map_writes_table_and_picture(engine: Engine, tmp_path: Path) -> None:
    found = detection_map(study(MAGNITUDE, AMPLITUDE), engine)
    assert {path.name for path in found.write(tmp_path)} == {"map.ecsv", "map.fits", "study.toml"}
    table = QTable.read(tmp_path / "map.ecsv")
    assert len(table) == found.probability.size
    rows = table[(table["statistic"] == "matched") & (table["magnitude"].value == 8.0)]
    np.testing.assert_array_equal(rows["probability"], found.probability[1, :, 2])
    assert len(QTable.read(tmp_path / "map.fits")) == len(table)
    again = detection_map(Study.read(tmp_path / "study.toml"), engine)
    np.testing.assert_array_equal(again.probability, found.probability)
    found.plot(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_map_reports_saturation(engine: Engine) -> None:
    asked = study({"quantity": "magnitude", "values": [-2.0, 6.0]}, {"quantity": "sky", "values": [22.0]})
    found = detection_map(asked, engine)
    assert np.isfinite(found.probability[:, 0, 1]).all()
    assert of_kind(found.messages, "saturated")
