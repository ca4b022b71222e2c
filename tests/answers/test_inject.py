"""Completeness answers: sweeps, unknown changes of the detector, and intervals; golden tables hold their numbers."""

import numpy as np
import pytest
from answers import of_kind
from refusals import refused
from scipy import stats

from mauvecl import Study, inject

SMALL = {
    "star": [{"library": "G2V", "magnitude": 7.4, "distance_pc": 14.0}],
    "stare": {"duration_s": 6000.0, "gaps": [[2000.0, 2600.0]]},
    "search": {"half_widths_s": [20.0, 60.0, 180.0], "nulls": 30, "per": "day", "false_alarms": 1.0},
    "injections": {"widths": 3, "half_width_high_s": 200.0, "sizes": 5, "count": 60, "positions": 6, "fitted": 12},
}


def study(**changes):
    data = {**SMALL, **{k: {**SMALL.get(k, {}), **v} if isinstance(v, dict) else v for k, v in changes.items()}}
    return Study.build(data, "test")


@pytest.mark.long
def test_sweep_over_magnitude_and_temperature_is_answered(stares):
    """Check that fainter stars hide larger flares; all cells share their draws."""
    magnitudes, temperatures = [6.0, 8.0], [8000.0, 20_000.0]
    axes = [{"quantity": "magnitude", "values": magnitudes}, {"quantity": "flare_temperature", "values": temperatures}]
    quick = {"count": 30, "positions": 3, "fitted": 0, "widths": 2, "of": "amplitude"}
    asked = study(sweep={"axes": axes}, injections=quick, search={"nulls": 0}).ideal()
    answer = inject(asked.with_settings(["search.frame.light=0.05"]), stares)
    # The search marginalises over a level that is steady.
    assert (answer.table["e50_ideal"] < answer.table["e50"]).all()
    assert dict(answer.stars[0].at) == {"magnitude": 6.0, "flare_temperature": 8000.0}
    half = np.array([star.injected.limit(0.5, None).value for star in answer.stars]).reshape(2, 2)
    assert (half[1] > 1.5 * half[0]).all()
    # Hotter flares of the same amplitude have more ultraviolet light.
    assert (half[:, 1] < half[:, 0]).all()


@pytest.mark.long
def test_search_without_the_cycle_reports_its_false_alarms(stares):
    """Check that an unknown thermal cycle raises the threshold, or that the search is refused."""
    quick = {"count": 10, "positions": 2, "fitted": 0, "widths": 2, "sizes": 2}
    changes = {"stare": {"cycles": {"temperature": 0.5}}, "injections": quick}
    with refused("false_alarms"):
        inject(study(search={"cycle": False}, **changes), stares)
    small = {"stare": {"cycles": {"temperature": 0.002}}, "injections": quick}
    blind = inject(study(search={"cycle": False}, **small), stares)
    assert of_kind(blind.messages, "false alarms") == blind.messages[:1]
    known = inject(study(**changes), stares)
    assert not of_kind(known.messages, "false alarms")
    assert blind.stars[0].threshold.value > known.stars[0].threshold.value + 0.1


@pytest.mark.long
def test_temperature_drift_hides_no_flare(stares):
    """Compare limits and recovered energies with and without an unknown drift of 0.3 deg C per hour."""
    quick = {"count": 80, "positions": 8, "fitted": 40, "widths": 2, "sizes": 3, "low": 1e33, "high": 3e34}
    steady = study(injections=quick, search={"nulls": 20}, stare={"duration_s": 9000.0, "gaps": []})
    asked = steady, steady.with_settings(["stare.drifts.temperature=0.3"])
    plain, drifting = (inject(one, stares).stars[0] for one in asked)
    for k in (None, 0, 1):
        half = [star.injected.limit(0.5, k).value for star in (plain, drifting)]
        assert half[1] == pytest.approx(half[0], rel=0.03)
    ratios = [star.fitted["energy_ratio"][:, -1] for star in (plain, drifting)]
    assert ratios[1] == pytest.approx(ratios[0], abs=0.02)
    assert drifting.threshold.value == pytest.approx(plain.threshold.value, abs=0.05)


def test_intervals_widen_as_positions_differ(stares):
    """Draws of one position share its noise: as many trials are independent as explain the scatter of positions."""
    found = inject(study(), stares)
    one, widened = found.stars[0].injected, 0
    sizes = found.completeness["size"].value.reshape(one.completeness.shape)
    for row, (critical, size) in enumerate(zip(one.critical, sizes, strict=True)):
        for column, edge in enumerate(size):
            each = np.mean(critical <= edge, axis=1)
            share = each.mean()
            assert one.completeness[row, column] == pytest.approx(share)
            width = one.completeness_high[row, column] - one.completeness_low[row, column]
            scatter = each.var(ddof=1) / each.size
            trials = min(critical.size, share * (1 - share) / scatter) if scatter > 0 else critical.size
            # Whole trials and whole counts of them.
            low, high = (clopper_pearson(share, max(n, 1)) for n in (1.2 * trials + 1, 0.8 * trials - 1))
            assert low <= width <= high
            widened += trials < 0.6 * critical.size
    assert widened
    for half_width in (None, *range(len(one.critical))):
        limit = one.limit(0.5, half_width)
        which = one.critical if half_width is None else one.critical[half_width]
        assert limit.low <= limit.value <= limit.high
        assert np.mean(which <= limit.value) == pytest.approx(0.5, abs=2 / which.shape[-1])


def clopper_pearson(share: float, n: int) -> float:
    """Return the width of the exact interval of a share of n trials."""
    k = share * n
    low = 0.0 if k == 0 else stats.beta.ppf(0.025, k, n - k + 1)
    high = 1.0 if k == n else stats.beta.ppf(0.975, k + 1, n - k)
    return high - low
