"""Rare false alarms by importance sampling, compared with brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from answers import STATISTICS
from refusals import refused
from scenes import instrument, star
from scipy import special

from mauvecl import Comparison, Detection, Engine, Linear, Normal, Processes, Uniform
from mauvecl.results.detection.tails import tail

#: A sixth of the pixels: brute force can then afford 1e7 draws, 30 of them beyond a threshold at 3e-6.
PART = {"output_min_nm": 330.0, "output_max_nm": 360.0}
N = 10_000_000
FREE = float("inf")


@pytest.fixture(scope="module")
def found(engine: Engine) -> Detection:
    quiet, flare = star(amplitudes=(0.1,), payload=instrument(**PART))
    return engine.detect(quiet, [flare], realisations=N, seed=11, statistics=tuple(STATISTICS), tails="sampled")


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("fap", [1e-2, 1e-4, 3e-6])
def test_sampled_tail_agrees_with_brute_force(found: Detection, statistic: str, fap: float) -> None:
    """Count realisations beyond sampled thresholds: 18 values with |z| < 4.5 fail in 1e-4 of seeds."""
    sampled = tail(found, fap, statistic, seed=3)
    null = found.distribution(statistic)
    beyond, expected = null.above(sampled.threshold.value), fap * N
    error = np.hypot(np.sqrt(expected), sampled.relative_error * expected)
    assert abs(beyond - expected) < 4.5 * error
    assert sampled.relative_error <= 0.02
    assert sampled.threshold.low < sampled.threshold.value < sampled.threshold.high


@pytest.fixture(scope="module")
def plain(engine: Engine) -> Detection:
    """Return a detection without dark and with 60 DN of noise, for which statistics are normal and chi-squared."""
    payload = instrument(dark_scale_dn_per_s=0.0, read_noise_dn=60.0, **PART)
    quiet, flare = star(amplitudes=(0.1,), payload=payload)
    return engine.detect(quiet, [flare], realisations=100, seed=1, statistics=tuple(STATISTICS), tails="sampled")


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("fap", [1e-3, 1e-6, 1e-9])
def test_sampled_tail_agrees_with_the_exact_closed_form(plain: Detection, statistic: str, fap: float) -> None:
    """Compare within 4 standard errors."""
    sampled = tail(plain, fap, statistic, seed=5)
    exact = plain.closed_form(statistic).sf(sampled.threshold.value)
    assert abs(exact / fap - 1) < 4 * sampled.relative_error


#: What is marginalised over, and what is drawn of it.
UNKNOWNS = {
    "not drawn": ({"dark": 0.1}, Processes()),
    "half a degree": ({"dark": 0.5}, Processes(detector_temperature=Normal(21.0, 0.5, 18.5, 23.5))),
    "all that is usual": (
        {"dark": FREE, "light": FREE, "sky": 0.1},
        Processes(
            jitter=Uniform(0.0, 0.05), detector_temperature=Normal(21.0, 0.5, 18.5, 23.5),
            sky_level=Normal(1.0, 0.1, 0.5, 1.5),
        ),
    ),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", UNKNOWNS)
def test_sampled_tail_with_unknowns_agrees_with_brute_force(engine: Engine, case: str) -> None:
    """Count up to three statistics at two probabilities: 16 values with |z| < 4.5 fail in 1e-4 of seeds."""
    nuisances, processes = UNKNOWNS[case]
    n = 500_000
    quiet, flare = star(amplitudes=(0.1,), payload=instrument(**PART))
    how = {"nuisances": nuisances, "processes": processes, "tails": "sampled"}
    names = ("chi2", "chi2_element", "matched") if case != "all that is usual" else ("chi2", "matched")
    found = engine.detect(quiet, [flare], realisations=n, seed=11, statistics=names, **how)
    for statistic in names:
        for fap in (1e-2, 1e-4):
            sampled = tail(found, fap, statistic, seed=3)
            beyond, expected = found.distribution(statistic).above(sampled.threshold.value), fap * n
            error = np.hypot(np.sqrt(expected), sampled.relative_error * expected)
            assert abs(beyond - expected) < 4.5 * error
            assert sampled.relative_error <= 0.02


@pytest.mark.parametrize("statistic", ["chi2", "matched"])
def test_bins_do_not_move_a_sampled_threshold(engine: Engine, statistic: str) -> None:
    """Check that a detection reports and uses the sampled threshold instead of the next edge of a bin."""
    quiet, *flares = star(amplitudes=(0.05, 0.1), payload=instrument(**PART))
    found = engine.detect(quiet, flares, realisations=20_000, seed=2, statistics=("chi2", "matched"), tails="sampled")
    for fap in (1e-4, 1e-7):
        for k, p in enumerate(found.detection_probability(fap, statistic)):
            sampled = found.tail(fap, statistic, template=k)
            assert sampled is not None
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
    payload = instrument(dark_scale_dn_per_s=0.0, read_noise_dn=60.0, output_min_nm=350.0, output_max_nm=360.0)
    quiet, flare = star(amplitudes=(0.1,), payload=payload)
    plain = engine.detect(quiet, [flare], realisations=100, seed=1, statistics=("chi2", "matched"), tails="sampled")
    held = 0
    for seed in range(30):
        for statistic in ("chi2", "matched"):
            t = tail(plain, 1e-7, statistic, seed=seed).threshold
            held += t.low <= plain.closed_form(statistic).isf(1e-7) <= t.high
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


#: Realisations, and the false-alarm probability, where something else is compared.
FEWER, ONE_IN = 1_000_000, 1e-4


@pytest.fixture(scope="module", params=[Comparison(4), Comparison(1, True)], ids=["stack", "estimated"])
def compared(request: pytest.FixtureRequest, engine: Engine) -> Detection:
    """Return a detection with every statistic of the same draws."""
    quiet, flare = star(amplitudes=(0.1,), payload=instrument(output_min_nm=345.0, output_max_nm=360.0))
    how = {"statistics": tuple(STATISTICS), "comparison": request.param, "tails": "sampled"}
    return engine.detect(quiet, [flare], realisations=FEWER, seed=12, **how)


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
def test_sampled_tail_agrees_for_every_comparison(compared: Detection, statistic: str) -> None:
    """Compare 12 values at 1e-4 of 1e6 realisations: |z| < 4.5 fails in 1e-4 of seeds."""
    sampled, expected = tail(compared, ONE_IN, statistic, seed=4), ONE_IN * FEWER
    beyond = compared.false_alarm_probability(sampled.threshold.value, statistic).value * FEWER
    assert abs(beyond - expected) < 4.5 * np.hypot(np.sqrt(expected), sampled.relative_error * expected)


def test_sum_in_dn_is_tilted_in_its_unit(engine: Engine) -> None:
    """Use weights of one DN each: |z| < 4.5 fails in 1e-5 of seeds."""
    quiet, _ = star(amplitudes=(0.1,), payload=instrument(**PART))
    own = Linear("own", np.ones(quiet.wavelength_nm.size))
    n, fap = 400_000, 1e-3
    how = {"comparison": Comparison(0, estimated=True), "tails": "sampled"}
    found = engine.detect(quiet, [], realisations=n, seed=11, statistics=(own,), **how)
    sampled = tail(found, fap, "own", seed=3)
    beyond = found.distribution("own").above(sampled.threshold.value)
    assert abs(beyond - fap * n) < 4.5 * np.hypot(np.sqrt(fap * n), sampled.relative_error * fap * n)
