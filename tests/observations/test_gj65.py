"""GJ 65 as GALEX saw it in the near ultraviolet: a whole archive file, with a bad bin, a spike and two known flares."""

from pathlib import Path

import numpy as np
import pytest
from scenes import analysed

from mauvecl import read_frames

pytestmark = pytest.mark.long

DATA = Path(__file__).parent.parent / "data" / "flares"


def test_bins_are_flagged_and_level_and_great_flare_are_those_of_the_counts() -> None:
    """The small flare of 20:01 is as large as other changes of this star within minutes, which are no noise."""
    answer = analysed(read_frames(DATA / "gj65_galex_nuv_5s.csv", DATA / "gj65.toml"))
    flagged = {k: str(reason) for k, reason in enumerate(answer.frames["reason"]) if reason}
    assert set(flagged) == {59, 265}
    assert flagged[59] == "spike"
    assert "below" in flagged[265]
    frames = answer.analysis.frames
    assert frames.date(frames.time_s[59]).startswith("2005-11-18T20:04:43.5")
    level, error = (float(np.median(one)) for one in (answer.analysis.level.level, answer.analysis.level.error))
    assert 5.3 < level < 5.8
    # Counts of 5.5 per second in 4.5 effective seconds.
    assert 0.8 < error / np.sqrt(level / 4.54) < 1.1
    analysis = answer.analysis
    survey = analysis.survey
    great = analysis.events[-1]
    assert frames.date(survey.time_s[great.brightest])[11:19] in ("20:22:33", "20:22:38")
    assert great.kind == "flare"
    assert great.cut
    assert great.missing == 1
    # The peak of the published light curve: 838.6 counts per second over 5.5.
    level = great.energy.level * survey.level
    assert great.amplitude * level == pytest.approx(838.6 - 5.5, rel=0.005)
    assert max(e.value for e in analysis.events) == great.value
