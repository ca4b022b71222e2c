"""Completeness answers: unknown changes of the detector, and intervals; golden tables hold their numbers."""

import numpy as np
import pytest
from scipy import stats

from mauvecl import Study, inject

SMALL = {
    "star": [{"library": "G2V", "magnitude": 7.4, "distance_pc": 14.0}],
    "stare": {"duration_s": 6000.0, "gaps": [[2000.0, 2600.0]]},
    "search": {"half_widths_s": [20.0, 60.0, 180.0], "nulls": 30, "per": "day", "false_alarms": 1.0},
    "injections": {"widths": 3, "half_width_high_s": 200.0, "sizes": 5, "count": 60, "positions": 6, "fitted": 12},
}


@pytest.mark.long
def test_temperature_drift_hides_no_flare(stares):
    """Compare limits and recovered energies with and without an unknown drift of 0.3 deg C per hour."""
    quick = {"count": 80, "positions": 8, "fitted": 40, "widths": 2, "sizes": 3, "low": 1e33, "high": 3e34}
    steady = Study.build(SMALL | {"stare": {"duration_s": 9000.0}, "injections": SMALL["injections"] | quick}, "test")
    asked = steady, steady.with_settings(["stare.drifts.temperature=0.3"])
    plain, drifting = (inject(one, stares).stars[0] for one in asked)
    for k in (None, 0, 1):
        half = [star.injected.limit(0.5, k).value for star in (plain, drifting)]
        assert half[1] == pytest.approx(half[0], rel=0.03)
    ratios = [star.fitted["energy_ratio"][:, -1] for star in (plain, drifting)]
    assert ratios[1] == pytest.approx(ratios[0], abs=0.02)
    assert drifting.threshold.value == pytest.approx(plain.threshold.value, abs=0.05)


def interval(share: float, n: int) -> float:
    """Return the width of the exact interval (Clopper and Pearson) of a share of n trials."""
    low, high = (stats.beta.ppf(p, share * n + one, n - share * n + 1 - one) for p, one in ((0.025, 0), (0.975, 1)))
    return float(np.nan_to_num(high, nan=1.0) - np.nan_to_num(low))


def test_intervals_widen_as_positions_differ(stares):
    """Draws of one position share its noise: as many trials are independent as explain the scatter of positions."""
    found = inject(Study.build(SMALL, "test"), stares)
    assert (found.table["e50_ideal"] < found.table["e50"]).all()
    one, widened = found.stars[0].injected, 0
    sizes = found.completeness["size"].value.reshape(one.completeness.shape)
    for (row, column), edge in np.ndenumerate(sizes):
        critical = one.critical[row]
        each = np.mean(critical <= edge, axis=1)
        share = each.mean()
        assert one.completeness[row, column] == pytest.approx(share)
        width = one.completeness_high[row, column] - one.completeness_low[row, column]
        scatter = each.var(ddof=1) / each.size
        trials = min(critical.size, share * (1 - share) / scatter) if scatter > 0 else critical.size
        # Whole trials and whole counts of them.
        low, high = (interval(share, max(n, 1)) for n in (1.2 * trials + 1, 0.8 * trials - 1))
        assert low <= width <= high
        widened += trials < 0.6 * critical.size
    assert widened
    for half_width in (None, *range(len(one.critical))):
        limit = one.limit(0.5, half_width)
        which = one.critical if half_width is None else one.critical[half_width]
        assert limit.low <= limit.value <= limit.high
        assert np.mean(which <= limit.value) == pytest.approx(0.5, abs=2 / which.shape[-1])
