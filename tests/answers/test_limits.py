"""Limits have the requested power by theory and by simulation, and are monotone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import of_kind
from astropy.table import QTable
from marks import long_but

from mauvecl import (
    Engine,
    LocalWorkers,
    Pool,
    Study,
    limiting_magnitude,
    shortest_exposure,
    smallest_amplitude,
    what_matters,
)

STATISTICS = ("chi2", "chi2_element", "matched", "uv_excess")


def study(**changes: Any) -> Study:
    """Return the paper's G2V star with a 24 % flare, 1e5 realisations at 1e-2."""
    data: dict[str, Any] = {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "flare": {"amplitudes": [0.24]},
        "run": {"realisations": 100_000, "fap": 1e-2, "statistics": STATISTICS, "seed": 5},
    }
    for section, values in changes.items():
        data[section] = (data.get(section, {}) | values) if isinstance(values, dict) else values
    return Study.build(data, "test")


FEW = {"statistics": ("matched",), "realisations": 20_000}


@pytest.mark.long
@pytest.mark.parametrize("power", [0.5, 0.9])
def test_limiting_magnitude_has_the_requested_power(engine: Engine, power: float) -> None:
    """Compare with a fresh simulation within three half-widths of its 95 % interval; fails once in 1e4 seeds."""
    asked = study(limit={"power": power})
    result = limiting_magnitude(asked, engine)
    assert [limit.statistic for limit in result.limits] == list(STATISTICS)
    for limit in result.limits:
        assert limit.value.low <= limit.value.value <= limit.value.high
        p = limit.check.probability
        assert p.low - (p.high - p.low) < power < p.high + (p.high - p.low)
        assert limit.agrees == (p.low <= power <= p.high)
        assert limit.verdict in ("confirms it", "")
        assert limit.check.seed != asked.run.seed
        # Far from the rails the closed form is right to the skew of the dark.
        assert abs(limit.value.value - limit.closed_form) < 0.03
        # The curve of the closed form, nearest to the limit, is the power.
        values, theory = np.array(sorted(limit.curve)).T
        assert np.interp(limit.closed_form, values, theory) == pytest.approx(power, abs=0.01)
    found = {limit.statistic: limit.value.value for limit in result.limits}
    assert max(found.values()) == found["matched"]
    assert found["chi2"] < found["chi2_element"]


def test_limit_inverts_detect(engine: Engine) -> None:
    """Check that the smallest amplitude and the shortest exposure at the limiting magnitude are those given."""
    only = {"statistics": ("matched",)}
    (limit,) = limiting_magnitude(study(run=only), engine).limits
    there = study(run=only, star=[{"library": "G2V", "magnitude": limit.value.value}])
    (back,) = smallest_amplitude(there, engine).limits
    assert back.value.value == pytest.approx(0.24, rel=0.03)
    (shortest,) = shortest_exposure(there, engine).limits
    assert shortest.value.value % 5 == 0
    assert abs(shortest.value.value - 50) <= 5
    assert shortest.value.low <= shortest.value.value <= shortest.value.high


@pytest.mark.parametrize(
    "harder",
    long_but(
        [
            {"observation": {"exposure_s": 25.0}},
            {"observation": {"temperature_c": 25.0}},
            {"flare": {"amplitudes": [0.12]}},
            {"sky": {"surface_brightness": 14.0}},
        ],
        {"flare": {"amplitudes": [0.12]}},
    ),
)
def test_limits_are_monotone(engine: Engine, harder: dict[str, Any]) -> None:
    (plain,), (worse,) = (limiting_magnitude(study(run=FEW, **c), engine).limits for c in ({}, harder))
    assert worse.value.value < plain.value.value


@pytest.mark.long
def test_cooler_detector_gains_as_predicted(engine: Engine) -> None:
    """Compare 13 and 21 deg C, whose dark currents have a ratio of 0.58, with the closed form."""
    few = {"statistics": ("matched",)}
    (warm,), (cool,) = (
        limiting_magnitude(study(run=few, observation={"temperature_c": t}), engine).limits for t in (21.0, 13.0)
    )
    gain = cool.value.value - warm.value.value
    assert gain == pytest.approx(cool.closed_form - warm.closed_form, abs=0.02)
    # Dark alone: 1.25 log10 of its ratio; the read noise and the star leave less.
    assert 0.15 < gain < 1.25 * 0.0684 * 8 / np.log(10)


def test_table_and_files_are_written(engine: Engine, tmp_path: Path) -> None:
    result = limiting_magnitude(study(run=FEW), engine)
    files = result.write(tmp_path)
    table = QTable.read(tmp_path / "limit.ecsv")
    assert table["magnitude"].unit == "mag"
    assert table["magnitude"].value[0] == result.limits[0].value.value
    assert {path.name for path in files} == {"limit.ecsv", "study.toml"}
    again = limiting_magnitude(Study.read(tmp_path / "study.toml"), engine)
    assert again.limits == result.limits
    result.plot(tmp_path / "limit.png")
    assert (tmp_path / "limit.png").stat().st_size > 10_000


def test_failure_of_one_star_keeps_the_others(engine: Engine) -> None:
    stars = [{"library": "G2V", "magnitude": m} for m in (25.0, 7.0)]
    found = shortest_exposure(study(run=FEW, star=stars), engine)
    assert [one.star for one in found.limits] == ["G2V V = 7"]
    assert of_kind(found.messages, "no limit") == found.messages[:1]
    assert "G2V V = 25" in found.messages[0]


@pytest.mark.long
def test_limit_above_one_day_is_found(engine: Engine) -> None:
    """Search some 1e5 frames by bisection."""
    asked = study(run=FEW, star=[{"library": "G2V", "magnitude": 16.0}])
    (limit,) = shortest_exposure(asked, engine).limits
    assert limit.value.value > 86_400.0
    assert limit.verdict != "DIFFERS"
    assert len(limit.points) < 100


def test_limit_reports_saturation(engine: Engine) -> None:
    bright = study(run=FEW, star=[{"library": "G2V", "magnitude": -1.0}])
    found = smallest_amplitude(bright, engine)
    assert of_kind(found.messages, "saturated")[:1] == found.messages[:1]


def test_shortest_exposure_is_one_frame(engine: Engine) -> None:
    (limit,) = shortest_exposure(study(run=FEW, star=[{"library": "G2V", "magnitude": 5.0}]), engine).limits
    assert limit.value.value == 5.0
    assert limit.verdict == "exceeds it"
    assert not limit.agrees


def test_assumptions_move_the_limit_as_predicted(engine: Engine) -> None:
    """Check the sign of each change, and each end against the limit of a changed instrument."""
    asked = study(run=FEW)
    table = what_matters(asked)
    assert (np.diff(table["span"]) <= 0).all()
    rows = {row["assumption"]: row for row in table}
    for name in ("detector temperature (C)", "light loss", "pointing loss", "read noise (DN)"):
        assert rows[name]["at_low_end"] > rows[name]["at_high_end"]
    assert rows["quantum efficiency, scale"]["at_low_end"] < rows["quantum efficiency, scale"]["at_high_end"]
    # Poisson in electrons has 0.77 of the dark noise.
    assert rows["dark counts are Poisson in"]["at_high_end"] > rows["dark counts are Poisson in"]["at_low_end"]
    lossy = asked.with_instrument({"light_loss": 0.44})
    assert lossy.observation.load_instrument().light_loss == 0.44
    (limit,) = limiting_magnitude(lossy, engine).limits
    assert rows["light loss"]["at_high_end"] == pytest.approx(limit.closed_form, abs=1e-3)
    assert Study.build(lossy.model_dump(), "again") == lossy


@pytest.mark.long
def test_progress_has_one_total_and_moves_with_each_simulation() -> None:
    """Three limits, of which several are computed at the same time: never back, and at the end all of it."""
    study = Study().with_settings(
        ["star=[{library='G2V'}]", "flare.amplitudes=[0.24]", "run.realisations=20000", "run.fap=0.01"]
    )
    seen: list[tuple[int, int]] = []
    found = limiting_magnitude(study, Pool(LocalWorkers([None])), lambda done, total: seen.append((done, total)))
    parts = [done for done, _ in seen]
    assert len({total for _, total in seen}) == 1
    assert parts == sorted(parts)
    assert parts[-1] == seen[-1][1]
    # Each simulation and each end of a limit, its check among the simulations.
    assert len(parts) == sum(len(one.points) + 2 for one in found.limits)
