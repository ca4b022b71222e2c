"""Closed forms of weighted sums over drawn unknowns."""

from __future__ import annotations

import numpy as np
import pytest

from mauvecl import Study
from mauvecl.noise.factor_distributions import changes_of
from mauvecl.statistics.distributions import Mixture
from mauvecl.statistics.registry import STATISTICS
from mauvecl.statistics.statistic import Differences, Statistic
from mauvecl.study.cases import Case


@pytest.mark.parametrize("name", ["matched", "uv_excess"])
def test_weighted_sum_over_drawn_unknowns_is_integrated_at_once(name: str) -> None:
    """All nodes together give the same distribution as one node after the other."""
    case = Case(Study.build({"star": [{"library": "G2V", "magnitude": 7.0}], "nuisances": {"usual": True}}, "test"))
    flare, statistic = case.flares[0], STATISTICS[name]
    setting = case.setting(case.quiet, flare)
    means, variances = changes_of(flare)
    assert setting.drawn is not None
    nodes, rows = setting.drawn.nodes(flare, weighted=True)
    amounts = np.array([node.amounts for node in nodes])
    assert len(nodes) > 100
    seen = Differences(flare.recorded_light_dn - case.quiet.recorded_light_dn, flare.variance_dn2, scatter=rows)
    given = (setting, seen, amounts, means, variances, flare)
    together = statistic.moved_forms(*given)
    for one, alone in zip(together, Statistic.moved_forms(statistic, *given), strict=True):
        assert (one.mean, one.std) == pytest.approx((alone.mean, alone.std), rel=1e-12)
    mixture = Mixture(tuple(together), np.full(len(nodes), 1 / len(nodes)))
    assert mixture.sf(3.0) == pytest.approx(np.mean([part.sf(3.0) for part in together]), rel=1e-12)
