"""Rare false alarms by importance sampling, compared with brute force and closed forms."""

from typing import Any

import numpy as np
import pytest
from answers import STATISTICS
from refusals import refused
from scenes import instrument, star
from scipy import special

from mauvecl import Comparison, Detection, Engine, Expectation, Linear, Normal, Processes, Uniform

#: A sixth of the pixels: brute force can then afford 1e7 draws, 30 of them beyond a threshold at 3e-6.
PART = {"output_min_nm": 330.0, "output_max_nm": 360.0}
N = 10_000_000
FREE = float("inf")


def sampled(engine: Engine, scene: Any, fap: float, statistic: Any, *, seed: int, **how: Any) -> Any:
    """Return the sampled threshold of a star, of which too few realisations are drawn to count them."""
    quiet, *flares = scene
    few = engine.detect(quiet, flares, realisations=100, seed=seed, statistics=(statistic,), tails="sampled", **how)
    return few.tail(fap, getattr(statistic, "name", statistic))


def check_tail(of: Any, found: Detection, fap: float, statistic: str, n: int) -> None:
    """Compare a sampled threshold with the realisations beyond it, within 4.5 standard errors."""
    beyond, expected = found.distribution(statistic).above(of.threshold.value), fap * n
    assert abs(beyond - expected) < 4.5 * np.hypot(np.sqrt(expected), of.relative_error * expected)
    assert of.relative_error <= 0.02
    assert of.threshold.low < of.threshold.value < of.threshold.high


@pytest.fixture(scope="module")
def scene() -> list[Expectation]:
    return star(amplitudes=(0.1,), payload=instrument(**PART))


@pytest.fixture(scope="module")
def found(engine: Engine, scene: list[Expectation]) -> Detection:
    return engine.detect(scene[0], scene[1:], realisations=N, seed=11, statistics=STATISTICS)


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("fap", [1e-2, 1e-4, 3e-6])
def test_sampled_tail_agrees_with_brute_force(
    engine: Engine, scene: list[Expectation], found: Detection, statistic: str, fap: float
) -> None:
    """Count realisations beyond sampled thresholds: 18 values with |z| < 4.5 fail in 1e-4 of seeds."""
    check_tail(sampled(engine, scene, fap, statistic, seed=3), found, fap, statistic, N)


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
def test_sampled_tail_with_unknowns_agrees_with_brute_force(
    engine: Engine, scene: list[Expectation], case: str
) -> None:
    """Count up to three statistics at two probabilities: 16 values with |z| < 4.5 fail in 1e-4 of seeds."""
    nuisances, processes = UNKNOWNS[case]
    n = 500_000
    how = {"nuisances": nuisances, "processes": processes}
    names = ("chi2", "chi2_element", "matched") if case != "all that is usual" else ("chi2", "matched")
    found = engine.detect(scene[0], scene[1:], realisations=n, seed=11, statistics=names, **how)
    for statistic in names:
        # Of a hundred realisations, one in a hundred cannot be counted.
        for fap in (1e-2, 1e-4):
            check_tail(sampled(engine, scene, fap, statistic, seed=3, **how), found, fap, statistic, n)


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


#: Realisations, and the false-alarm probability, where something else is compared.
FEWER, ONE_IN = 1_000_000, 1e-4


@pytest.fixture(scope="module", params=[Comparison(4), Comparison(1, True)], ids=["stack", "estimated"])
def compared(request: pytest.FixtureRequest, engine: Engine) -> tuple[Detection, list[Expectation], Comparison]:
    """Return a detection with every statistic of the same draws, its star and flare, and what is compared."""
    short = star(amplitudes=(0.1,), payload=instrument(output_min_nm=345.0, output_max_nm=360.0))
    how = {"statistics": STATISTICS, "comparison": request.param}
    return engine.detect(short[0], short[1:], realisations=FEWER, seed=12, **how), short, request.param


@pytest.mark.long
@pytest.mark.parametrize("statistic", STATISTICS)
def test_sampled_tail_agrees_for_every_comparison(engine: Engine, compared: Any, statistic: str) -> None:
    """Compare 12 values at 1e-4 of 1e6 realisations: |z| < 4.5 fails in 1e-4 of seeds."""
    found, short, comparison = compared
    of = sampled(engine, short, ONE_IN, statistic, seed=4, comparison=comparison)
    check_tail(of, found, ONE_IN, statistic, FEWER)


def test_sum_in_dn_is_tilted_in_its_unit(engine: Engine, scene: list[Expectation]) -> None:
    """Use weights of one DN each: |z| < 4.5 fails in 1e-5 of seeds."""
    own = Linear("own", np.ones(scene[0].wavelength_nm.size))
    how = {"comparison": Comparison(0, estimated=True)}
    found = engine.detect(scene[0], [], realisations=400_000, seed=11, statistics=(own,), **how)
    check_tail(sampled(engine, scene[:1], 1e-3, own, seed=3, **how), found, 1e-3, "own", 400_000)
