"""Reports of weighted sums that a flare lowers, whose detection probability of 0 says nothing of the flare."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from answers import of_kind, small

from mauvecl import Engine, detect, detection_map, limiting_magnitude

NUISANCES: dict[str, dict[str, Any]] = {
    "known": {},
    "light": {"nuisances": {"light": "free"}},
    "both": {"nuisances": {"light": "free", "dark": "free"}},
}


@pytest.mark.parametrize("unknown", NUISANCES)
@pytest.mark.parametrize("temperature_k", [3000.0, 4000.0, 6000.0, 10_000.0, 20_000.0])
def test_lowered_statistic_is_reported_if_simulation_lowers_it(
    engine: Engine, unknown: str, temperature_k: float
) -> None:
    """Compare with simulated means that differ by more than five standard errors; fails once in 1e6 seeds."""
    study = small(
        star=[{"library": "G2V", "magnitude": 7.4}],
        flare={"amplitudes": [0.3], "temperature_k": temperature_k},
        observation={"exposure_s": 50.0},
        run={"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["uv_excess", "matched", "chi2"]},
        **NUISANCES[unknown],
    )
    answer = detect(study, engine)
    (one,) = answer.stars
    named = {text.split(" falls by ")[0].split()[-1] for text in of_kind(answer.messages, "wrong sign")}
    for statistic in ("uv_excess", "matched"):
        null, flare = (one.detection.distribution(statistic, k) for k in (None, 0))
        gap, error = flare.mean - null.mean, np.hypot(flare.std, null.std) / 100
        if abs(gap) > 5 * error:
            assert (statistic in named) == (gap < 0), (statistic, gap)
    assert named <= {"uv_excess"}


def test_cases_include_lowered_and_raised_statistics(engine: Engine) -> None:
    """Check that the test above covers both cases, and that a lowered statistic detects nothing."""
    found = {}
    for temperature_k in (4000.0, 10_000.0):
        study = small(
            star=[{"library": "G2V", "magnitude": 7.4}],
            flare={"amplitudes": [0.3], "temperature_k": temperature_k},
            observation={"exposure_s": 50.0},
            run={"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["uv_excess", "matched"]},
            **NUISANCES["both"],
        )
        answer = detect(study, engine)
        found[temperature_k] = bool(of_kind(answer.messages, "wrong sign"))
        if found[temperature_k]:
            assert answer.table["probability"][0] < 0.01 < 0.9 < answer.table["probability"][1]
    assert found == {4000.0: True, 10_000.0: False}


@pytest.mark.parametrize("temperature_k", [4000.0, 10_000.0])
def test_maps_and_limits_report_the_same_as_detect(engine: Engine, temperature_k: float) -> None:
    """Compare the messages of all cells of a map with `detect`, and the stated cause of an impossible limit."""
    sections = {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "flare": {"amplitudes": [0.3], "temperature_k": temperature_k},
        "observation": {"exposure_s": 50.0},
        "run": {"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["uv_excess", "matched"]},
        "map": {
            "x": {"quantity": "amplitude", "values": [0.2, 0.3]},
            "y": {"quantity": "exposure", "values": [5.0, 50.0]},
        },
        **NUISANCES["both"],
    }
    named = of_kind(detect(small(**sections), engine).messages, "wrong sign")
    of_map = of_kind(detection_map(small(**sections), engine).messages, "wrong sign")
    assert len(of_map) == len(named)
    # Of magnitudes, one so bright that most pixels saturate turns the sign.
    for of in ("amplitude", "exposure"):
        found = limiting_magnitude(small(**sections, limit={"of": of, "power": 0.5}), engine)
        assert [one.statistic for one in found.limits] == ["uv_excess", "matched"][len(named) :]
        assert ["WRONG SIGN" in text for text in found.failed] == [True] * len(named)
    if named:
        assert temperature_k == 4000.0
        assert "uv_excess falls with the flare in 4 of 4 cells" in of_map[0]
