"""Rare false alarms by importance sampling, nulls without a threshold, and false alarms of whole campaigns."""

import math
import re
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from answers import STATISTICS, expectations, of_kind
from marks import long_but
from refusals import refused
from scenes import instrument, star, study_of_g2v
from scipy import optimize, special, stats

from mauvecl import Comparison, Engine, Expectation, InputError, Linear, Normal, Processes, Study, Uniform, detect
from mauvecl import map as detection_map

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
    # Without dark, the noise of the light is most of what is estimated.
    "estimated from light": (SHORT | {"dark_scale_dn_per_s": 0.0}, 1_000_000, (1e-4,), ("chi2", "matched"),
                             {"comparison": Comparison(1, True)}),
    "not drawn": (PART, 500_000, (1e-2, 1e-4), ("chi2", "chi2_element", "matched"), {"nuisances": {"dark": 0.1}}),
    "half a degree": (PART, 500_000, (1e-2, 1e-4), ("chi2", "chi2_element", "matched"),
                      {"nuisances": {"dark": 0.5}, "processes": Processes(detector_temperature=WARM)}),
    "all that is usual": (PART, 500_000, (1e-2, 1e-4), ("chi2", "matched"),
                          {"nuisances": {"dark": FREE, "light": FREE, "sky": 0.1}, "processes": Processes(**USUAL)}),
    # Weights of one DN each, of which the sum is tilted in its unit.
    "sum in DN": (PART, 400_000, (1e-3,), (ONES,), {"comparison": Comparison(0, estimated=True)}),
}  # fmt: skip


def sampled(engine: Engine, scene: Any, statistic: Any, *, seed: int, **how: Any) -> Any:
    """Return a detection whose thresholds are sampled, since too few realisations are drawn to count them."""
    quiet, *flares = scene
    return engine.detect(quiet, flares, realisations=100, seed=seed, statistics=(statistic,), tails="sampled", **how)


@pytest.mark.parametrize("case", long_but(CASES, "sum in DN"))
def test_sampled_tail_agrees_with_brute_force(engine: Engine, case: str) -> None:
    """Count realisations beyond sampled thresholds: 49 values with |z| < 4.5 fail in 3e-4 of seeds."""
    part, n, faps, statistics, how = CASES[case]
    quiet, *flares = scene = star(amplitudes=(0.1,), payload=instrument(**part))
    found = engine.detect(quiet, flares, realisations=n, seed=11, statistics=statistics, **how)
    for statistic, fap in product(statistics, faps):
        few, expected = sampled(engine, scene, statistic, seed=3, **how), fap * n
        (name,) = few.statistics
        of = few.tail(fap, name)
        beyond = found.distribution(name).above(of.threshold.value)
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
    few = sampled(engine, star(amplitudes=(0.1,), payload=instrument(**GAUSSIAN, **PART)), statistic, seed=5)
    of = few.tail(fap, statistic)
    exact = few.closed_form(statistic).sf(of.threshold.value)
    assert abs(exact / fap - 1) < 4 * of.relative_error


@pytest.mark.long
def test_tail_intervals_have_nominal_coverage(engine: Engine) -> None:
    """Check that 50 of 60 intervals of 95 % contain the closed form; fails once in 2000 new seeds."""
    scene = star(amplitudes=(0.1,), payload=instrument(**GAUSSIAN, output_min_nm=350.0, output_max_nm=360.0))
    held = 0
    for statistic, seed in product(("chi2", "matched"), range(30)):
        few = sampled(engine, scene, statistic, seed=seed)
        t = few.tail(1e-7, statistic).threshold
        held += t.low <= few.closed_form(statistic).isf(1e-7) <= t.high
    assert held >= 50
    assert special.bdtr(49, 60, 0.95) < 5e-4


def test_detection_reports_sampled_tails(engine: Engine) -> None:
    """Check that a detection reports and uses the sampled threshold instead of the next edge of a bin."""
    quiet, *flares = star(amplitudes=(0.05, 0.24), payload=instrument(**PART))
    kind = {"realisations": 20_000, "seed": 2, "statistics": ("chi2", "matched")}
    sampled = engine.detect(quiet, flares, tails="sampled", **kind)
    for statistic, fap in product(sampled.statistics, (1e-4, 1e-7)):
        for k, p in enumerate(sampled.detection_probability(fap, statistic)):
            cut = sampled.threshold(fap, statistic, template=k)
            assert cut == sampled.tail(fap, statistic, template=k).threshold
            d = sampled.distribution(statistic, k)
            # Of another grid: half of one bin's realisations, at most.
            near = d.above(cut.value - d.std / 512) - d.above(cut.value + d.std / 512)
            assert abs(p.value - d.above(cut.value) / d.n) <= near / d.n
    table = sampled.table(fap=1e-9)
    assert table.meta["tails"] == "importance sampling"
    assert (table["fap_error"] <= 0.02).all()
    assert ((table["low"] <= table["probability"]) & (table["probability"] <= table["high"])).all()
    assert np.abs(table["probability"] - table["closed_form_probability"]).max() < 0.05
    # Where enough realisations lie beyond, they are counted.
    counted = engine.detect(quiet, flares, **kind)
    assert sampled.table(1e-2).meta["tails"] == "counted"
    assert sampled.threshold(1e-2) == counted.threshold(1e-2)
    with refused("fap", "`tails='sampled'`"):
        counted.table(fap=1e-9)
    assert sampled.threshold(1e-9) == engine.detect(quiet, flares, tails="sampled", **kind).threshold(1e-9)


FEW = 20_000
PAYLOAD = instrument(part=True, output_min_nm=300.0, output_max_nm=310.0)


def nearly_saturated(seed: int, sigmas: float | None = None) -> tuple[Expectation, Expectation]:
    """Return a star that leaves one pixel some sigmas of light below saturation, and no other, and a weak flare."""
    rng = np.random.default_rng(seed)
    quiet, _ = star("G2V", 5.0, amplitudes=(0.05,), exposure=5.0 * float(rng.integers(1, 3)), payload=PAYLOAD)
    room = (quiet.ceiling_dn - quiet.bias_dn - quiet.dark_dn) / quiet.gain_dn_per_electron
    light = 2.0 * room
    at = int(rng.integers(room.size))
    light[at] = room[at] - (sigmas or float(rng.uniform(0.1, 3.0))) * math.sqrt(room[at])
    quiet = replace(quiet, source_electrons=light, sky_electrons=np.zeros(light.size), messages=())
    flare = replace(quiet, source_electrons=light + 0.02 * math.sqrt(room[at]), name="flare")
    return quiet, flare


def atom(values: np.ndarray, fap: float) -> tuple[float, float]:
    """Return the shares of values beyond, and at, the one where the share from the top passes `fap`."""
    _, counts = np.unique(-values, return_counts=True)
    total = np.cumsum(counts)
    place = int(np.argmax(total > math.floor(fap * values.size * (1 + 1e-12))))
    return (total[place] - counts[place]) / values.size, counts[place] / values.size


def test_threshold_exists_unless_a_value_is_too_probable(engine: Engine) -> None:
    """Compare 20 stars near saturation, of which one pixel counts, with raw values, where whole DN are apart."""
    kinds = set()
    for seed in range(20):
        quiet, flare = nearly_saturated(seed)
        found = engine.detect(quiet, [flare], realisations=FEW, seed=seed, statistics=("matched", "uv_excess"))
        assert not found.blinding
        raw = engine.realise(quiet, count=FEW, seed=seed)[:, found.scene.used][:, 0].astype(np.int64)
        kinds.add(atom(raw, 0.02)[1] > 0.02)
        for fap in (0.006, 0.02, 0.1, 0.3):
            beyond, at = atom(raw, fap)
            if 0.7 < at / fap < 1.5:
                continue
            for statistic in found.statistics:
                if at > fap:
                    with pytest.raises(InputError) as error:
                        found.threshold(fap, statistic)
                    assert error.value.key == "fap"
                    (seen,) = found.detection_probability(fap, statistic)
                    assert np.isnan([seen.value, seen.low, seen.high]).all()
                    # Those that exist hold what they promise.
                    held = found.threshold(beyond + at, statistic).value
                    assert found.false_alarm_probability(held, statistic).value == pytest.approx(beyond + at, rel=1e-9)
                else:
                    value = found.false_alarm_probability(found.threshold(fap, statistic).value, statistic).value
                    assert fap - max(at, 1.5 / FEW) - 0.01 * fap <= value <= fap
        sentences = found.without_threshold(0.006)
        assert len(sentences) == (2 if atom(raw, 0.006)[1] > 0.006 else 0)
        if sentences:
            table = found.table(0.006)
            assert np.isnan(table["threshold"]).all()
            assert np.isnan(table["probability"]).all()
    assert kinds == {True, False}
    # Sample a single frame, drawn as a stack, whose most probable value is the same.
    quiet, flare = (replace(x, n_frames=1) for x in nearly_saturated(3, 0.5))
    found = engine.detect(quiet, [flare], realisations=FEW, seed=1, statistics=("matched",), tails="sampled")
    with pytest.raises(InputError, match="no threshold"):
        found.threshold(1e-4, "matched")
    assert np.isnan(found.table(1e-4)["fap_error"]).all()


def study(magnitude: float, **sections: object) -> Study:
    observation = {"changes": {"output_min_nm": 300.0, "output_max_nm": 301.5}, "exposure_s": 5.0}
    given = {"star": [{"library": "G2V", "magnitude": magnitude}], "run": {"realisations": FEW, "seed": 3}}
    return study_of_g2v(**given, flare={"amplitudes": [1e-5]}, observation=observation, **sections).paper()


def test_answers_report_missing_thresholds(engine: Engine) -> None:
    def faintest(magnitude: float) -> float:
        x = expectations(study(magnitude))[0]
        return float((x.mean_raw_dn - x.ceiling_dn).min())

    # The faintest pixel reaches saturation on average.
    magnitude = float(optimize.brentq(faintest, -5.0, 10.0)) + 0.001
    answer = detect(study(magnitude), engine)
    assert np.isnan(answer.table["probability"]).all()
    assert "saturates" not in answer.headline
    assert of_kind(answer.messages, "no threshold")
    axes = {"x": {"quantity": "magnitude", "values": [magnitude, magnitude + 3.0]},
            "y": {"quantity": "amplitude", "values": [1e-5, 2e-5]}}  # fmt: skip
    found = detection_map(study(magnitude, map=axes), engine)
    np.testing.assert_array_equal(np.isnan(found.probability[0]), [[True, False], [True, False]])
    (message,) = of_kind(found.messages, "no threshold")
    assert "2 of 4" in message


def test_cell_whose_threshold_cannot_be_sampled_does_not_saturate(engine: Engine) -> None:
    """Near saturation frames are drawn one by one, with both draws of unknown values in the same one of two cells."""
    axes = {"x": {"quantity": "magnitude", "values": [-0.5, 7.0]}, "y": {"quantity": "amplitude", "values": [0.1]}}
    run = {"realisations": 1000, "fap": 1e-4, "tails": "sampled"}
    part = {"changes": {"output_min_nm": 270.0, "output_max_nm": 400.0}, "exposure_s": 10.0}
    asked = study_of_g2v(map=axes, run=run, observation=part, unknowns={"draws": 2, "known": ["qe_scale"]})
    found = detection_map(asked.paper(), engine)
    np.testing.assert_array_equal(np.isnan(found.probability[0]), [[True, False]])
    (message,) = of_kind(found.messages, "no answer")
    assert "1 of 2" in message
    assert not any("every pixel" in text for text in found.messages)


NUMBER = r"([\d.e+-]*\d)"
ENDS = rf"(?:.* overlap of its stacks {NUMBER} \[{NUMBER}, {NUMBER}\])?"
#: Tests, probability of one, expected alarms, chance if independent and at most, and with overlap with its interval.
MANY = rf"makes {NUMBER} tests?: at {NUMBER} per test {NUMBER} .* is {NUMBER} if .* at most {NUMBER}{ENDS}"
#: Wanted chance, tests, probability of one if independent and in any case, with overlap with its interval, and answer.
ONE = rf"chance of {NUMBER} .* its {NUMBER} tests? may have {NUMBER} if .*?, {NUMBER} in any case{ENDS}: `fap={NUMBER}`"
#: Wanted number of alarms, tests, probability of one, and answer.
SOME = rf"For {NUMBER} false .* its {NUMBER} tests? may have {NUMBER} for any dependence .*: `fap={NUMBER}`"


def said(
    engine: Engine, frames: int, stack: int = 1, of_test: float = 0.02, **campaign: float
) -> list[list[float | None]]:
    """Return the numbers of a detection's sentences on a campaign and on what is wanted of it, in the order above."""
    study = study_of_g2v(
        observation={"exposure_s": 5.0 * stack, "changes": {"output_min_nm": 300.0, "output_max_nm": 303.0}},
        run={"realisations": 10_000, "fap": of_test, "tails": "sampled", "seed": 1},
        campaign={"frames": frames, "step": stack, **campaign},
    )
    assert Study.build(study.model_dump(), "again") == study
    text = "\n".join(detect(study, engine).messages)
    found = [re.search(pattern, text) for pattern in (MANY, ONE, SOME)]
    return [[number and float(number) for number in one.groups()] for one in found if one is not None]


def test_day_of_single_frames_has_its_false_alarms(engine: Engine) -> None:
    found, alarms = said(engine, 17_280, of_test=1e-5, alarms=2)
    exact = [17_280, 1e-5, 0.1728, 1 - (1 - 1e-5) ** 17_280, 0.1728]
    assert found == [*(pytest.approx(one, rel=0.005) for one in exact), None, None, None]
    assert alarms == pytest.approx([2, 17_280, 2 / 17_280, 2 / 17_280], rel=1e-3)


@pytest.mark.parametrize(("stack", "step"), [(2, 1), (10, 1), (10, 5)])
def test_two_overlapping_stacks_equal_the_exact_probability(engine: Engine, stack: int, step: int) -> None:
    """Compare with a correlated bivariate normal: four standard errors of 20 000 campaigns, and 3 digits."""
    (found,) = said(engine, stack + step, stack, 0.3, step=step)
    correlation = 1 - step / stack
    both = stats.multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf([stats.norm.isf(0.3)] * 2)
    tests, _, _, independent, at_most, chance, low, high = found
    assert tests == 2
    assert chance == pytest.approx(1 - both, abs=4 * np.sqrt(both * (1 - both) / 20_000) + 5e-4)
    assert low < independent < at_most
    assert low <= chance <= high


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
    _, (asked, tests, independent, at_least, *overlap, answer) = said(engine, frames, stack, fap=wanted)
    assert (asked, tests) == (wanted, frames // stack)
    assert 1 - (1 - independent) ** tests == pytest.approx(wanted, rel=1e-3)
    assert answer == at_least == pytest.approx(wanted / tests, rel=1e-3)
    assert overlap == [None] * 3


def test_overlapping_stacks_allow_more_per_test(engine: Engine) -> None:
    """Invert with other draws: 20 000 campaigns give 0.05 to 6 %, four standard errors of both, and the digits."""
    _, (*_, independent, _, value, low, high, _) = said(engine, 600, 10, step=1, fap=0.05)
    assert low <= value <= high
    assert value > independent
    (back,) = said(engine, 600, 10, value, step=1)
    assert back[0] == 591
    assert back[5] == pytest.approx(0.05, abs=4 * np.sqrt(2 * 0.05 * 0.95 / 20_000) + 5e-4)
