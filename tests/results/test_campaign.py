"""Campaigns: bounds, independence, overlap, and what a detection says of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mauvecl import Engine, Study, detect
from mauvecl.results.detection.campaign import campaign, per_test


def test_day_of_single_frames_has_its_false_alarms() -> None:
    found = campaign(1e-5, 17_280)
    assert found.tests == 17_280
    assert found.independent == pytest.approx(1 - (1 - 1e-5) ** 17_280)
    assert found.at_most == pytest.approx(0.1728)
    assert found.overlapping is None


@pytest.mark.parametrize(("stack", "step"), [(2, 1), (10, 1), (10, 5)])
def test_overlap_lies_between_the_bounds(stack: int, step: int) -> None:
    """Check that overlapping stacks alarm less often than independent ones and more often than adjacent ones."""
    found, apart = campaign(1e-3, 600, stack, step=step), campaign(1e-3, 600, stack)
    assert found.overlapping is not None
    assert found.tests == (600 - stack) // step + 1
    assert found.overlapping.low < found.independent < found.at_most
    assert found.overlapping.high > apart.independent


def test_two_overlapping_stacks_equal_the_exact_probability() -> None:
    """Compare two stacks of two frames that share one with a bivariate normal of correlation 1/2."""
    found = campaign(0.05, 3, 2, step=1)
    cut = stats.norm.isf(0.05)
    both = stats.multivariate_normal([0, 0], [[1, 0.5], [0.5, 1]]).cdf([cut, cut])
    assert found.tests == 2
    assert found.overlapping is not None
    # A 95 % interval, widened to four standard errors.
    assert abs(found.overlapping.value - (1 - both)) < 4 * np.sqrt(both * (1 - both) / 20_000)


@pytest.mark.long
def test_long_campaigns_are_joined_from_stretches() -> None:
    """Check that ten times the frames take P(no alarm) to the tenth power, to four standard errors."""
    one, ten = campaign(1e-5, 40_005, 10, step=1), campaign(1e-5, 400_050, 10, step=1, seed=2)
    assert one.overlapping is not None
    assert ten.overlapping is not None
    rate = [-np.log1p(-o.value) / n for o, n in ((one.overlapping, one.tests), (ten.overlapping, ten.tests))]
    # Some 4096 x 20 000 x 1e-5 / clustering alarms are drawn.
    assert abs(rate[0] / rate[1] - 1) < 4 * np.sqrt(2 / (20_000 * 4096 * rate[0]))


@pytest.mark.parametrize("wanted", [1e-4, 0.01, 0.5])
@pytest.mark.parametrize(("frames", "stack"), [(17_280, 1), (17_280, 10), (7, 7)])
def test_false_alarm_probability_per_test_is_the_inverse(wanted: float, frames: int, stack: int) -> None:
    one = per_test(wanted, frames, stack)
    there = campaign(one.independent, frames, stack)
    assert there.independent == pytest.approx(wanted, rel=1e-9)
    assert campaign(one.at_least, frames, stack).at_most == pytest.approx(wanted)
    assert one.at_least <= one.independent
    assert there.expected == pytest.approx(there.tests * one.independent)
    assert one.overlapping is None


def test_overlapping_stacks_allow_more_per_test() -> None:
    """Invert with other draws: 20 000 campaigns give 0.05 to 6 %, four standard errors of both."""
    one = per_test(0.05, 600, 10, step=1, seed=1)
    assert one.overlapping is not None
    assert one.overlapping.low <= one.overlapping.value <= one.overlapping.high
    assert one.overlapping.value > one.independent
    back = campaign(one.overlapping.value, 600, 10, step=1, seed=2).overlapping
    assert back is not None
    assert back.value == pytest.approx(0.05, abs=4 * np.sqrt(2 * 0.05 * 0.95 / 20_000))
    # Ten of 20 000 settle nothing.
    assert per_test(5e-4, 600, 10, step=1).overlapping is None


@pytest.mark.long
def test_detection_reports_test_and_campaign(engine: Engine) -> None:
    study = Study.build(
        {
            "star": [{"library": "G2V", "magnitude": 7.4}],
            "flare": {"amplitudes": [0.1]},
            "run": {"realisations": 20_000, "fap": 0.01, "statistics": ["matched"]},
            "campaign": {"frames": 17_280, "step": 1, "fap": 0.01, "alarms": 2},
        },
        "test",
    )
    said = [m for m in detect(study, engine).messages if "campaign" in m]
    assert len(said) == 3
    assert "17271 tests" in said[0]
    assert "173 false alarms are expected" in said[0]
    assert "at 0.01 per test" in said[0]
    assert "with the overlap of its stacks" in said[0]
    assert "`fap=5.79e-07`" in said[1]
    assert "`fap=0.0001158`" in said[2]
    assert Study.build(study.model_dump(), "again") == study
