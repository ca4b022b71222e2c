"""Fits of flares to the sums of a stare: blocks next to other flares."""

import numpy as np
import pytest
from scenes import paper

from mauvecl.answers.inject import survey_star
from mauvecl.search.flare_fits import SummedStare
from mauvecl.study.cases import Case

#: Two overlapping flares: log amplitude, peak time, log half-width and log temperature.
FLARES = np.array([[-1.2, 2000.0, np.log(60.0), np.log(9000.0)], [-1.6, 2150.0, np.log(90.0), np.log(11_000.0)]])


@pytest.mark.parametrize("others", [FLARES[:0], FLARES[1:]], ids=["alone", "next to another"])
def test_light_of_a_block_counts_once(others: np.ndarray) -> None:
    """A fit to sums without noise returns the flare; the light of others, and no other light, is subtracted."""
    survey = survey_star(Case(paper('star=[{library="M3V", magnitude=9}]')))
    dark = SummedStare(survey, np.zeros((survey.stare.n_frames, 3)))
    stare = SummedStare(survey, dark.light(np.vstack([FLARES[:1], others])))
    assert stare.block(FLARES[:1], others).fit(FLARES[:1] + 0.02).theta == pytest.approx(FLARES[:1], rel=1e-6)
