"""Unknowns: study keys, flags, files, their cost in S/N, and false alarms with unknowns drawn."""

from __future__ import annotations

import itertools
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import of_kind, twice
from commands import ended, run
from refusals import refused
from scenes import instrument

from mauvecl import Engine, Nuisances, Sky, Source, Study, detect, detection_map, expect, limiting_magnitude
from mauvecl.answers.detection.chance_with_unknowns import chance_with_unknowns
from mauvecl.answers.detection.unknown_cost import cost_lines, marginal_lines, unknown_cost
from mauvecl.answers.detection.unknown_table import power, unknown_table
from mauvecl.cli.question import nuisances_of
from mauvecl.noise.scene import prepare
from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, PROCESSES
from mauvecl.results.requests.requests import DetectRequest
from mauvecl.study.cases import Case, cases
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.web.fields import points
from mauvecl.web.state import State

STRAY = "200 1\n450 3\n700 1  # DN\n"


def study(**nuisances: Any) -> Study:
    """Return the G2V star of METHODS section 7 with its 2 % flare, Vega at V = 0."""
    star = {"library": "G2V", "magnitude": 7.4, "magnitude_system": "vega"}
    run = {"realisations": 100_000, "statistics": ["matched"]}
    return Study.build({"star": [star], "flare": {"amplitudes": [0.02]}, "run": run, "nuisances": nuisances}, "test")


@pytest.mark.parametrize(
    ("nuisances", "known", "plain", "marginal"),
    [
        ({"dark": 0.1}, 8.36, 0.23, 3.06),
        ({"light": 0.01}, 8.36, 4.12, 5.67),
        ({"dark": "free", "light": "free"}, 8.36, 0, 3.05),
    ],
)
def test_cost_equals_that_of_the_methods(
    nuisances: dict[str, Any], known: float, plain: float, marginal: float
) -> None:
    asked = study(**nuisances)
    found = unknown_cost("it", *Case(asked).expectations, asked.nuisances, asked.run.comparison())
    assert found.known == pytest.approx(known, rel=0.01)
    assert found.plain == pytest.approx(plain, rel=0.022)
    assert found.marginal == pytest.approx(marginal, rel=0.01)
    (line,) = cost_lines([found], asked.nuisances)
    assert f"{found.marginal:.3g} marginalised" in line
    # Without unknowns of the study, the documented ones are used, which the answer states.
    none = NuisanceChoice()
    found = unknown_cost("it", *Case(asked).expectations, none, asked.run.comparison())
    (line,) = cost_lines([found], none)
    assert all(row.name in line for row in DOCUMENTED_NUISANCES)
    assert not marginal_lines(none)


@pytest.mark.long
def test_every_answer_reports_the_cost_of_unknowns(engine: Engine) -> None:
    small = study().with_settings(
        ["run.fap=0.01", "run.realisations=20000", "map.x={quantity='magnitude', values=[6, 8]}",
         "map.y={quantity='amplitude', values=[0.02, 0.2]}"]
    )  # fmt: skip
    marginal = small.with_changes({"nuisances": {"dark": 0.1}}, None)
    for ask in (detect, limiting_magnitude, detection_map):
        plain, other = (ask(s, engine) for s in (small, marginal))
        for answer in (plain, other):
            # One sentence on unknowns: where a detection takes all as known, it is that on the chance.
            chance = ask is detect and answer is plain
            assert len(of_kind(answer.messages, "chance with unknowns")) == chance
            assert len(of_kind(answer.messages, "cost of unknowns")) == 1 - chance
        assert any("marginalised over the dark level (+-0.1 deg C)" in m for m in other.messages)
        assert "[nuisances]" in other.table.meta["study"]
        assert "[nuisances]" not in plain.table.meta["study"]
    # What is marginalised detects less.
    assert limiting_magnitude(marginal, engine).limits[0].closed_form < limiting_magnitude(small).limits[0].closed_form


def test_study_is_read_back_with_its_files(tmp_path: Path, engine: Engine) -> None:
    (tmp_path / "stray.txt").write_text(STRAY)
    text = "[nuisances]\ndark = 0.1\n[nuisances.own.stray]\nfile = 'stray.txt'\nsd = 2.0\n"
    (tmp_path / "study.toml").write_text(text)
    asked = Study.read(tmp_path / "study.toml")
    (tmp_path / "elsewhere").mkdir()
    again = tmp_path / "elsewhere" / "again.toml"
    again.write_text(asked.toml())
    assert Study.read(again).nuisances == asked.nuisances
    quiet, flare = cases(asked, swept=False)[1].expectations[:2]
    found = asked.nuisances.marginalised(quiet)
    assert found is not None
    own = np.interp(quiet.wavelength_nm, [200, 450, 700], [1, 3, 1])
    np.testing.assert_allclose(found.spectra[found.names.index("stray")], own)
    # The same from Python, and from the command line.
    by_hand = Nuisances.of(quiet, {"dark": 0.1, "stray": 2.0}, {"stray": own})
    values = [
        engine.statistic_values(quiet, [flare], count=40, seed=1, statistics=("chi2", "matched"), nuisances=n)
        for n in (found, by_hand)
    ]
    np.testing.assert_array_equal(*values)
    flags = ("--star", "G2V", "-m", "7.4", "-a", "0.02", "-n", "20000", "--fap", "0.01", "--statistic", "matched")
    run("detect", *flags, "--nuisance", "dark=0.1", "--nuisance", "stray.txt=2", "--no-pictures", folder=tmp_path)
    kept = Study.read(tmp_path / "mauvecl-detect" / "detection.ecsv").nuisances
    assert kept == asked.nuisances.model_copy(
        update={"own": {"stray": asked.nuisances.own["stray"].model_copy(update={"file": tmp_path / "stray.txt"})}}
    )


def test_points_in_a_study_equal_those_of_files() -> None:
    asked = study(own={"x": {"points": [[200, 1], [450, 3], [700, 1]], "sd": 2.0}})
    again = Study.build(tomllib.loads(asked.toml()), "text")
    assert again == asked
    quiet, _ = Case(asked).expectations
    found = asked.nuisances.marginalised(quiet)
    assert found is not None
    np.testing.assert_allclose(found.spectra[0], np.interp(quiet.wavelength_nm, [200, 450, 700], [1, 3, 1]))
    with refused("points of 'x'"):
        study(own={"x": {"points": [[450, 1], [200, 1]]}}).nuisances.marginalised(quiet)


@pytest.mark.parametrize(
    ("text", "key"),
    [(text, "own_unknown") for text in ("200 1, 450", "200", "200 1, 200 2", "200 1 2", ",")] + [("a b", "number")],
)
def test_invalid_spectrum_on_the_page_raises(text: str, key: str) -> None:
    with refused(key):
        points(text)


def test_page_asks_the_same_question(tmp_path: Path) -> None:
    state = State()
    state.enter({"unknown": "the usual", "own_unknown": "200 1, 450 3, 700 1"})
    asked = state.question().study(tmp_path)
    assert asked.nuisances.usual
    assert asked.nuisances.own["own"].points == ((200, 1), (450, 3), (700, 1))
    assert State().question().study(tmp_path).nuisances == NuisanceChoice()


@pytest.mark.parametrize(
    ("text", "key"), [("dark=", "nuisance"), ("=0.1", "nuisance"), ("dark=much", "nuisances.dark"), ("dust=1", "file")]
)
def test_invalid_nuisances_raise(text: str, key: str) -> None:
    """Refuse nuisances without a value, a name or a number, and missing files."""
    with refused(key):
        detect(Study().with_changes({"nuisances": nuisances_of(Study(), [text])}, None))


@pytest.mark.parametrize("flag", ["dark", "dark=-1", "missing.txt=free"])
def test_invalid_nuisance_flags_name_the_flag(flag: str, tmp_path: Path) -> None:
    star = ("--star", "G2V", "-m", "7.4", "-n", "20000", "--fap", "0.01")
    code, _, reported = ended("detect", *star, "--nuisance", flag, folder=tmp_path)
    assert (code, reported.count("\n")) == (2, 1)
    assert "expected" in reported


def test_usual_unknowns_follow_the_observation() -> None:
    """Check that they are centred on the study's temperature, and that the study's own processes stay."""
    asked = study(usual=True).with_settings(
        ["observation.temperature_c=13", "processes.jitter={uniform=[0.0, 0.01]}", "nuisances.dark=0.3"]
    )
    processes = Case(asked).processes
    assert processes.detector_temperature.mean == 13
    assert processes.jitter.high == 0.01
    quiet, _ = Case(asked).expectations
    found = asked.nuisances.marginalised(quiet)
    assert found is not None
    assert dict(zip(found.names, found.sd, strict=True)) == {"dark": 0.3, "light": np.inf, "sky": 0.1}
    dark_sky = asked.with_changes({"sky": {"none": True}}, None)
    found = dark_sky.nuisances.marginalised(Case(dark_sky).expectations[0])
    assert found is not None
    assert found.names == ("dark", "light")
    assert Case(study()).processes.detector_temperature is None


def test_documentation_lists_the_usual_unknowns() -> None:
    page = re.sub(r"\s+", " ", (Path(__file__).parents[2] / "docs" / "unknowns.md").read_text(encoding="utf-8"))
    for row in DOCUMENTED_NUISANCES:
        process = PROCESSES[row.process]
        for text in (process.drawn, row.marginalised, process.source):
            assert text in page


@pytest.mark.long
def test_priors_are_drawn_jointly_on_both_instruments() -> None:
    """Check that no usual setting needs noise to be drawn separately, which priors do not allow."""
    payloads, temperatures = ("mauve", "mauve-electrons"), (-20.0, 0.0, 13.0, 21.0, 25.0)
    for payload, temperature, exposure in itertools.product(payloads, temperatures, (5.0, 50.0, 600.0)):
        mauve = instrument(payload, part=True, temperature_c=temperature, output_max_nm=310.0)
        for magnitude in (-1.0, 5.0, 20.0):
            star = Source.from_library("G2V").at_magnitude(magnitude)
            seen = [expect(star, mauve, exposure=exposure, sky=Sky.of_brightness(22.1))]
            asked = study(usual=True).with_settings([f"observation.temperature_c={temperature}"])
            assert prepare(seen, processes=Case(asked).processes).joint


#: Draws of each scene, requested false-alarm probability, and number of scenes.
DRAWS, FAP, SCENES = 20_000, 0.01, 40
SEEDS = itertools.count(2026)


@pytest.mark.long
def test_false_alarms_with_drawn_unknowns_are_as_requested(engine: Engine) -> None:
    """Draw the documented unknowns in 40 random scenes, 2e4 times each.

    Marginalised: the simulated threshold on fresh draws, for which its own error counts as much as theirs, for every
    statistic; and what the closed form, which integrates over what is drawn, says of that threshold. Of 40 comparisons
    each, one may leave 4 standard errors, which by chance happens in 1 run of 66; two would in 1 of 50 000. And all 40
    together within 4 standard errors, a bias of 6 % of the false alarms. Plain, in the first ten scenes: by its usual
    threshold, which fails.
    """
    rng = np.random.default_rng(16)
    statistics = ("chi2", "chi2_element", "matched")
    error = np.sqrt(FAP * (1 - FAP) / DRAWS)
    off: dict[str, list[float]] = {name: [] for one in statistics for name in (one, f"closed form of {one}")}
    failed = 0
    for number in range(SCENES):
        temperature, magnitude = rng.uniform(13, 21), rng.uniform(6, 10)
        payload = instrument(str(rng.choice(["mauve", "mauve-electrons"])), part=True, temperature_c=temperature)
        star = Source.from_library(str(rng.choice(["G2V", "K3V", "M3V", "F5V"]))).at_magnitude(magnitude)
        sky = Sky.of_brightness(rng.uniform(19, 23))
        exposure = float(rng.choice([5.0, 50.0]))
        quiet, flare = (expect(s, payload, exposure=exposure, sky=sky) for s in (star, star.flaring(0.1)))
        choice = NuisanceChoice(usual=True)
        how: dict[str, Any] = {"processes": choice.processes(Case(study()).processes, temperature)}
        marginal = {"statistics": statistics, "nuisances": choice.marginalised(quiet)}
        asked = DetectRequest.of(quiet, [flare], DRAWS, next(SEEDS), **marginal, **how)
        first, fresh = twice(engine, asked)
        for name in statistics:
            cut = first.threshold(FAP, name).value
            alarms, expected = (
                fresh.false_alarm_probability(cut, name).value,
                asked.hypotheses.closed_form(name).sf(cut),
            )
            off[name].append((alarms - FAP) / (np.sqrt(2) * error))
            off[f"closed form of {name}"].append((alarms - expected) / error)
        if number >= 10:
            continue
        plain = engine.detect(quiet, [flare], realisations=DRAWS, seed=next(SEEDS), statistics="matched", **how)
        usual = plain.closed_form("matched").isf(FAP)
        failed += abs(plain.false_alarm_probability(usual, "matched").value - FAP) > 4 * error
    for name, deviations in off.items():
        assert sum(abs(d) > 4 for d in deviations) <= 1, name
        assert abs(np.sum(deviations)) < 4 * np.sqrt(SCENES), name
    assert failed == 10


def test_table_has_a_picture(tmp_path: Path) -> None:
    """Compare a row with METHODS section 7, and check the power at the smallest amplitude."""
    found = unknown_table(study())
    rows = {row["unknown"]: row for row in found.table}
    assert rows["the dark level (+-0.1 deg C)"]["marginalised"] == pytest.approx(3.06, rel=0.01)
    assert rows["the dark level (free) and the light level (free)"]["marginalised"] == pytest.approx(3.05, rel=0.01)
    assert rows["the light level (+-1 %)"]["plain"] == pytest.approx(4.12, rel=0.01)
    for name, row in rows.items():
        snr = row["marginalised"] * found.smallest("G2V V = 7.4 (Vega = 0)", name) / row["amplitude"]
        assert power(np.array([snr]), 1e-3)[0] == pytest.approx(0.9)
    assert found.plot(tmp_path / "unknowns.png") == tmp_path / "unknowns.png"
    assert [path.name for path in found.write(tmp_path)] == ["unknowns.ecsv", "study.toml"]


def test_chance_with_unknowns_is_that_of_their_study() -> None:
    """The sentence of `detect` holds the closed forms of the table for both studies, of the most uncertain flare."""
    stars = [{"library": "M3V", "magnitude": 9.0}]
    run = {"realisations": 10_000, "fap": 0.02, "statistics": ["matched"]}
    data = {"star": stars, "flare": {"amplitudes": [0.0001, 0.02, 3.0]}, "run": run}
    chances, sentences = [], []
    for usual in (False, True):
        answer = detect(Study.build(data | {"nuisances": {"usual": usual}}, "test"))
        chances.append(f"{100 * answer.table['closed_form_probability'][1]:.1f} %")
        sentences += of_kind(answer.messages, "chance with unknowns")
    # An answer with unknowns has them in its table.
    (sentence,) = sentences
    assert "flare of 2 %" in sentence
    assert f"with a chance of {chances[0]}, with the usual unknowns of {chances[1]}" in sentence


def test_saturated_star_has_no_chance_with_unknowns() -> None:
    star = {"library": "G2V", "magnitude": -6.0}
    study = Study.build({"star": [star], "flare": {"amplitudes": [0.1]}}, "test")
    assert chance_with_unknowns(cases(study)) == []
