"""Rare false alarms by importance sampling, compared with brute force and closed forms."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from answers import STATISTICS
from marks import long_but
from refusals import refused
from scenes import instrument, star
from scipy import special

from mauvecl import Comparison, Engine, Linear, Normal, Processes, Uniform

#: A sixth of the pixels, of which brute force can draw 1e7 realisations, and a twelfth.
PART = {"output_min_nm": 330.0, "output_max_nm": 360.0}
SHORT = {"output_min_nm": 345.0, "output_max_nm": 360.0}
FREE = float("inf")
WARM = Normal(21.0, 0.5, 18.5, 23.5)
USUAL = {"jitter": Uniform(0.0, 0.05), "detector_temperature": WARM, "sky_level": Normal(1.0, 0.1, 0.5, 1.5)}
ONES = Linear("own", np.ones(star(payload=instrument(**PART))[0].wavelength_nm.size))
#: Pixels, realisations, false-alarm probabilities, statistics, and what is compared, marginalised over and drawn.
CASES: dict[str, tuple[dict, int, tuple[float, ...], tuple[Any, ...], dict[str, Any]]] = {
    "nominal": (PART, 10_000_000, (1e-2, 1e-4, 3e-6), tuple(STATISTICS), {}),
    "stack": (SHORT, 1_000_000, (1e-4,), tuple(STATISTICS), {"comparison": Comparison(4)}),
    "estimated": (SHORT, 1_000_000, (1e-4,), tuple(STATISTICS), {"comparison": Comparison(1, True)}),
    "not drawn": (PART, 500_000, (1e-2, 1e-4), ("chi2", "chi2_element", "matched"), {"nuisances": {"dark": 0.1}}),
    "half a degree": (PART, 500_000, (1e-2, 1e-4), ("chi2", "chi2_element", "matched"),
                      {"nuisances": {"dark": 0.5}, "processes": Processes(detector_temperature=WARM)}),
    "all that is usual": (PART, 500_000, (1e-2, 1e-4), ("chi2", "matched"),
                          {"nuisances": {"dark": FREE, "light": FREE, "sky": 0.1}, "processes": Processes(**USUAL)}),
    # Weights of one DN each, of which the sum is tilted in its unit.
    "sum in DN": (PART, 400_000, (1e-3,), (ONES,), {"comparison": Comparison(0, estimated=True)}),
}  # fmt: skip


def sampled(engine: Engine, scene: Any, fap: float, statistic: Any, *, seed: int, **how: Any) -> Any:
    """Return the sampled threshold of a star, of which too few realisations are drawn to count them."""
    quiet, *flares = scene
    few = engine.detect(quiet, flares, realisations=100, seed=seed, statistics=(statistic,), tails="sampled", **how)
    return few.tail(fap, getattr(statistic, "name", statistic))


@pytest.mark.parametrize("case", long_but(CASES, "sum in DN"))
def test_sampled_tail_agrees_with_brute_force(engine: Engine, case: str) -> None:
    """Count realisations beyond sampled thresholds: 47 values with |z| < 4.5 fail in 3e-4 of seeds."""
    part, n, faps, statistics, how = CASES[case]
    quiet, *flares = scene = star(amplitudes=(0.1,), payload=instrument(**part))
    found = engine.detect(quiet, flares, realisations=n, seed=11, statistics=statistics, **how)
    for statistic, fap in product(statistics, faps):
        of, expected = sampled(engine, scene, fap, statistic, seed=3, **how), fap * n
        beyond = found.distribution(getattr(statistic, "name", statistic)).above(of.threshold.value)
        assert abs(beyond - expected) < 4.5 * np.hypot(np.sqrt(expected), of.relative_error * expected), statistic
        assert of.relative_error <= 0.02
        assert of.threshold.low < of.threshold.value < of.threshold.high


#: Without dark and with 60 DN of noise, statistics are normal and chi-squared.
GAUSSIAN = {"dark_scale_dn_per_s": 0.0, "read_noise_dn": 60.0}


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("fap", [1e-3, 1e-6, 1e-9])
def test_sampled_tail_agrees_with_the_exact_closed_form(engine: Engine, statistic: str, fap: float) -> None:
    """Compare within 4 standard errors."""
    quiet, flare = star(amplitudes=(0.1,), payload=instrument(**GAUSSIAN, **PART))
    of = sampled(engine, [quiet, flare], fap, statistic, seed=5)
    plain = engine.detect(quiet, [flare], realisations=100, seed=1, statistics=(statistic,))
    exact = plain.closed_form(statistic).sf(of.threshold.value)
    assert abs(exact / fap - 1) < 4 * of.relative_error


@pytest.mark.parametrize("statistic", ["chi2", "matched"])
def test_bins_do_not_move_a_sampled_threshold(engine: Engine, statistic: str) -> None:
    """Check that a detection reports and uses the sampled threshold instead of the next edge of a bin."""
    quiet, *flares = star(amplitudes=(0.05, 0.1), payload=instrument(**PART))
    found = engine.detect(quiet, flares, realisations=20_000, seed=2, statistics=("chi2", "matched"), tails="sampled")
    for fap in (1e-4, 1e-7):
        for k, p in enumerate(found.detection_probability(fap, statistic)):
            sampled = found.tail(fap, statistic, template=k)
            cut = found.threshold(fap, statistic, template=k)
            assert cut == sampled.threshold
            d = found.distribution(statistic, k)
            # Of another grid: half of one bin's realisations, at most.
            width = d.std / 512
            assert (
                abs(p.value - d.above(cut.value) / d.n)
                <= (d.above(cut.value - width) - d.above(cut.value + width)) / d.n
            )
            assert p.low <= p.value <= p.high


@pytest.mark.long
def test_tail_intervals_have_nominal_coverage(engine: Engine) -> None:
    """Check that 50 of 60 intervals of 95 % contain the closed form; fails once in 2000 new seeds."""
    payload = instrument(**GAUSSIAN, output_min_nm=350.0, output_max_nm=360.0)
    quiet, flare = star(amplitudes=(0.1,), payload=payload)
    held = 0
    for statistic in ("chi2", "matched"):
        exact = engine.detect(quiet, [flare], realisations=100, seed=1, statistics=(statistic,)).closed_form(statistic)
        for seed in range(30):
            t = sampled(engine, [quiet, flare], 1e-7, statistic, seed=seed).threshold
            held += t.low <= exact.isf(1e-7) <= t.high
    assert held >= 50
    assert special.bdtr(49, 60, 0.95) < 5e-4


@pytest.mark.long
def test_detection_reports_sampled_tails(engine: Engine) -> None:
    quiet, *flares = star(amplitudes=(0.05, 0.24), payload=instrument(**PART))
    kind = {"realisations": 100_000, "seed": 2, "statistics": ("chi2", "matched")}
    sampled = engine.detect(quiet, flares, tails="sampled", **kind)
    table = sampled.table(fap=1e-9)
    assert table.meta["tails"] == "importance sampling"
    assert (table["fap_error"] <= 0.02).all()
    for row in table:
        assert row["low"] <= row["probability"] <= row["high"]
        assert abs(row["probability"] - row["closed_form_probability"]) < 0.05
    # Where enough realisations lie beyond, they are counted.
    counted = engine.detect(quiet, flares, **kind)
    assert sampled.table(1e-2).meta["tails"] == "counted"
    assert sampled.threshold(1e-2) == counted.threshold(1e-2)
    with refused("fap", "`tails='sampled'`"):
        counted.table(fap=1e-9)
    assert sampled.threshold(1e-9) == engine.detect(quiet, flares, tails="sampled", **kind).threshold(1e-9)
