"""Campaigns: bounds, independence, overlap, and false-alarm probabilities of single tests, as a detection says them."""

import re
from typing import Any

import numpy as np
import pytest
from scenes import paper, study_of_g2v
from scipy import stats

from mauvecl import Engine, Study, detect

NUMBER = r"([\d.e+-]*\d)"
ENDS = rf"(?:.* overlap of its stacks {NUMBER} \[{NUMBER}, {NUMBER}\])?"
#: Tests, probability of one, expected alarms, chance if independent and at most, and with overlap with its interval.
MANY = rf"makes {NUMBER} tests: at {NUMBER} per test {NUMBER} .* is {NUMBER} if .* at most {NUMBER}{ENDS}"
#: Wanted chance, tests, probability of one if independent and in any case, and with overlap with its interval.
ONE = rf"chance of {NUMBER} .* its {NUMBER} tests may have {NUMBER} if .*?, {NUMBER} in any case{ENDS}"


def said(
    engine: Engine, frames: int, stack: int = 1, of_test: float = 0.02, **campaign: float
) -> list[list[float | None]]:
    """Return the numbers of a detection's sentences on a campaign and on its wanted chance, in the order above."""
    study = study_of_g2v(
        observation={"exposure_s": 5.0 * stack, "changes": {"output_min_nm": 300.0, "output_max_nm": 303.0}},
        run={"realisations": 10_000, "fap": of_test, "tails": "sampled", "seed": 1},
        campaign={"frames": frames, "step": stack, **campaign},
    )
    assert Study.build(study.model_dump(), "again") == study
    text = "\n".join(detect(study, engine).messages)
    found = [re.search(pattern, text) for pattern in (MANY, ONE)]
    return [[number and float(number) for number in one.groups()] for one in found if one is not None]


def test_day_of_single_frames_has_its_false_alarms(engine: Engine) -> None:
    (found,) = said(engine, 17_280, of_test=1e-5)
    exact = [17_280, 1e-5, 0.1728, 1 - (1 - 1e-5) ** 17_280, 0.1728]
    assert found == [*(pytest.approx(one, rel=0.005) for one in exact), None, None, None]


@pytest.mark.parametrize(("stack", "step"), [(2, 1), (10, 1), (10, 5)])
def test_overlap_lies_between_the_bounds(engine: Engine, stack: int, step: int) -> None:
    """Check that overlapping stacks alarm less often than independent ones and more often than adjacent ones."""
    (found,), (apart,) = (said(engine, 600, stack, 1e-3, step=one) for one in (step, stack))
    tests, _, _, independent, at_most, _, low, high = found
    assert tests == (600 - stack) // step + 1
    assert low < independent < at_most
    assert high > apart[3]


def test_two_overlapping_stacks_equal_the_exact_probability(engine: Engine) -> None:
    """Compare two stacks of two frames that share one with a bivariate normal of correlation 1/2.

    Within four standard errors of 20 000 simulated campaigns, and three printed digits.
    """
    (found,) = said(engine, 3, 2, 0.05, step=1)
    cut = stats.norm.isf(0.05)
    both = stats.multivariate_normal([0, 0], [[1, 0.5], [0.5, 1]]).cdf([cut, cut])
    assert found[0] == 2
    assert found[5] == pytest.approx(1 - both, abs=4 * np.sqrt(both * (1 - both) / 20_000) + 5e-4)


@pytest.mark.long
def test_long_campaigns_are_joined_from_stretches(engine: Engine) -> None:
    """Check that ten times the frames take P(no alarm) to the tenth power, to four standard errors and the digits."""
    rate = []
    for frames in (40_005, 400_050):
        ((tests, *_, chance, _, _),) = said(engine, frames, 10, 1e-6, step=1)
        rate.append(-np.log1p(-chance) / tests)
    # Some 4096 x 20 000 x 1e-6 / clustering alarms are drawn, twice.
    assert abs(rate[0] / rate[1] - 1) < 4 * np.sqrt(2 / (20_000 * 4096 * rate[0])) + 0.01


@pytest.mark.parametrize("wanted", [0.01, 0.5])
@pytest.mark.parametrize(("frames", "stack"), [(17_280, 1), (17_280, 10), (7, 7)])
def test_false_alarm_probability_per_test_is_the_inverse(engine: Any, wanted: float, frames: int, stack: int) -> None:
    _, (asked, tests, independent, at_least, *overlap) = said(engine, frames, stack, fap=wanted)
    assert (asked, tests) == (wanted, frames // stack)
    assert 1 - (1 - independent) ** tests == pytest.approx(wanted, rel=1e-3)
    assert at_least == pytest.approx(wanted / tests, rel=1e-3)
    assert overlap == [None] * 3


def test_overlapping_stacks_allow_more_per_test(engine: Engine) -> None:
    """Invert with other draws: 20 000 campaigns give 0.05 to 6 %, four standard errors of both, and the digits."""
    _, (*_, independent, _, value, low, high) = said(engine, 600, 10, step=1, fap=0.05)
    assert low <= value <= high
    assert value > independent
    (back,) = said(engine, 600, 10, value, step=1)
    assert back[5] == pytest.approx(0.05, abs=4 * np.sqrt(2 * 0.05 * 0.95 / 20_000) + 5e-4)


def test_wanted_number_of_alarms_is_divided_among_the_tests(engine: Engine) -> None:
    study = paper(
        "star=[{library='G2V', magnitude=7.4}]",
        "run={realisations=20000, fap=0.01, statistics=['matched']}",
        "campaign={frames=17280, step=1, fap=0.01, alarms=2}",
    )
    sentences = [text for text in detect(study, engine).messages if "campaign" in text]
    assert "173 false alarms are expected" in sentences[0]
    assert "`fap=5.79e-07`" in sentences[1]
    assert "`fap=0.0001158`" in sentences[2]
