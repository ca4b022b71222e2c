"""Limits, maps and exposures with the requested power or S/N, realistic and ideal answers, and files of version 1."""

import pickle
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import expectations
from astropy.table import Table
from marks import long_but
from scenes import paper, study_of_g2v
from tables import toml

import mauvecl
from mauvecl import Engine, Instrument, Study, detect, exposure_for, plan, shortest_exposure

STATISTICS = ("chi2", "chi2_element", "matched", "uv_excess")


def study(**changes: Any) -> Study:
    """Return the paper's G2V star with a 24 % flare, 1e5 realisations at 1e-2."""
    run = {"realisations": 100_000, "statistics": STATISTICS} | changes.pop("run", {})
    return study_of_g2v(run=run, **changes).paper()


@pytest.mark.long
@pytest.mark.parametrize("power", [0.5, 0.9])
def test_limiting_magnitude_has_the_requested_power(engine: Engine, power: float) -> None:
    """Compare with the 95 % interval of a fresh simulation, which each of 4 limits leaves in 5 % of seeds."""
    asked = study(limit={"power": power})
    result = mauvecl.limit(asked, engine)
    assert [limit.statistic for limit in result.limits] == list(STATISTICS)
    for limit in result.limits:
        assert limit.value.low <= limit.value.value <= limit.value.high
        assert limit.check.probability.low <= power <= limit.check.probability.high
        assert limit.verdict == "confirms it"
        assert limit.check.seed != asked.run.seed
        # Far from the rails the closed form is right to the skew of the dark.
        assert abs(limit.value.value - limit.closed_form) < 0.03
        # The curve of the closed form, nearest to the limit, is the power.
        values, theory = np.array(sorted(pickle.loads(pickle.dumps(limit)).curve)).T
        assert np.interp(limit.closed_form, values, theory) == pytest.approx(power, abs=0.01)


@pytest.mark.long
def test_limit_inverts_detect(engine: Engine) -> None:
    """Check that the smallest amplitude and the shortest exposure at the limiting magnitude are those given."""
    only = {"statistics": ("matched",)}
    (limit,) = mauvecl.limit(study(run=only), engine).limits
    there = study(run=only, star=[{"library": "G2V", "magnitude": limit.value.value}])
    (back,) = mauvecl.smallest_amplitude(there, engine).limits
    assert back.value.value == pytest.approx(0.24, rel=0.03)
    (shortest,) = shortest_exposure(there, engine).limits
    assert shortest.value.value % 5 == 0
    assert abs(shortest.value.value - 50) <= 5
    assert shortest.value.low <= shortest.value.value <= shortest.value.high
    # An interval of the second simulation, and the verdicts for a limit that is no exposure, and for one that is.
    for p, verdicts in (((0.8, 0.91), ["confirms it"] * 2), ((0.905, 0.91), ["misses it narrowly", "exceeds it"]),
                        ((0.8, 0.81), ["DIFFERS"] * 2)):  # fmt: skip
        check = replace(shortest.check, probability=replace(shortest.value, low=p[0], high=p[1]))
        assert [replace(x, check=check).verdict for x in (limit, shortest)] == verdicts


def test_assumptions_move_the_limit_as_predicted(engine: Engine) -> None:
    """Compare an end with the limit of a changed instrument; `test_golden_python.py` has the values of all."""
    asked = study(run={"statistics": ("matched",), "realisations": 20_000})
    rows = {row["assumption"]: row for row in mauvecl.what_matters(asked)}
    lossy = asked.with_instrument({"light_loss": 0.44})
    assert lossy.observation.load_instrument().light_loss == 0.44
    (limit,) = mauvecl.limit(lossy, engine).limits
    assert rows["light loss"]["at_high_end"] == pytest.approx(limit.closed_form, abs=1e-3)
    assert Study.build(lossy.model_dump(), "again") == lossy


@pytest.mark.parametrize(("star", "least"), long_but([("M3V", 0.02), ("B2IV", 0.02), ("G2V", 1e-6)], ("M3V", 0.02)))
def test_map_without_magnitudes_has_those_over_which_flares_are_lost(star: str, least: float, engine: Engine) -> None:
    """The least flares of the G2V star are lost where it saturates; the answer's study gives the same map again."""
    y = f'map.y={{quantity="amplitude", values=[{least}, 0.5]}}'
    asked = paper(f'star=[{{library="{star}"}}]', y, "run.realisations=10000", "run.fap=0.01")
    found = mauvecl.map(asked, engine)
    chances = found.closed_form[found.statistics.index("matched")]
    assert chances[1, -1] < 0.1 < chances[1, -2]
    assert found.x == found.study.map.axes[0].points()
    assert [float(column.heading) for column in found.views[0].columns[1:]] == list(found.x)
    assert not found.inputs[0].saturated.any()
    assert not np.isnan(found.probability).any()
    if star == "G2V":
        assert expectations(asked.at("magnitude", found.x[0] - 1))[0].saturated.any()
    else:
        assert chances[0, 0] > 0.9


@pytest.mark.parametrize("axes", toml("studies/maps.toml").values(), ids=toml("studies/maps.toml"))
def test_each_cell_equals_its_own_detection(engine: Engine, axes: dict[str, Any]) -> None:
    """Compare all bits, which agree because all cells share their draws."""
    run = {"statistics": ("chi2", "matched"), "seed": 9}
    asked = study_of_g2v(flare={"amplitudes": [0.1]}, run=run, map=axes).paper()
    found = mauvecl.map(asked, engine)
    assert found.probability.shape == (2, len(found.y), len(found.x))
    for j, i in ((0, 0), (len(found.y) - 1, 0), (1, len(found.x) - 1)):
        there = asked.at(axes["x"]["quantity"], found.x[i]).at(axes["y"]["quantity"], found.y[j])
        quiet, flare = expectations(there)
        alone = engine.detect(quiet, [flare], realisations=20_000, seed=9, statistics=found.statistics)
        expected = [alone.detection_probability(1e-2, statistic)[0].value for statistic in found.statistics]
        assert list(found.probability[:, j, i]) == expected
        np.testing.assert_allclose(found.closed_form[:, j, i], alone.table(1e-2)["closed_form_probability"])
    assert (found.low <= found.probability).all()
    assert (found.probability <= found.high).all()


@pytest.mark.parametrize("per", ["pixel", "element"])
@pytest.mark.parametrize("frames", long_but([1, 2, 7, 120], 1, 2, 7))
@pytest.mark.parametrize("wavelength", [280.0, 450.0])
def test_exposure_inverts_snr(per: str, frames: int, wavelength: float) -> None:
    """Check that the S/N of an exposure asks for that exposure, and that one frame more is a little longer."""
    asked = paper("star=[{library='G2V', magnitude=7.4}]", f"observation.exposure_s={5 * frames}")
    x = expectations(asked)[0]
    pixel = int(np.argmin(np.abs(x.wavelength_nm - wavelength)))
    snr = float(x.snr()[pixel] if per == "pixel" else x.snr_per_element()[x.element[pixel]])
    (same,) = exposure_for(asked, snr * (1 - 1e-9), wavelength, per=per).exposures
    assert (same.frames, same.exposure_s) == (frames, 5.0 * frames)
    assert same.snr_one_frame_less < snr <= same.snr * (1 + 1e-9)
    (more,) = exposure_for(asked, snr * (1 + 1e-9), wavelength, per=per).exposures
    assert more.frames == frames + 1


ASKED = Study().with_settings([
    "star=[{library='M3V', magnitude=9}]", "flare.amplitudes=[0.02, 0.1]", "run.realisations=20000", "run.fap=0.01",
    "map.x={quantity='magnitude', values=[8, 10]}", "map.y={quantity='amplitude', values=[0.02, 0.2]}",
])  # fmt: skip


def test_defaults_are_realistic_unlike_those_of_the_paper() -> None:
    study = Study()
    assert (study.observation.instrument, study.nuisances.usual, study.run.statistics) == ("mauve", True, ("matched",))
    mauve, mauvesim = Instrument.load("mauve"), Instrument.load("mauvesim")
    assert (mauve.dark_unit, mauvesim.dark_unit) == ("electrons", "DN")
    assert mauve == mauvesim.with_(dark_unit="electrons", photon_noise="poisson")
    # Nothing but these conventions changes.
    for changed, instrument in ((ASKED.paper(), "mauvesim"), (ASKED.ideal(), "mauve")):
        assert changed.observation.instrument == instrument
        assert not changed.nuisances.usual
        assert changed.star == ASKED.star
        assert changed.flare == ASKED.flare
    assert Study().paper().run.statistics == ("chi2", "chi2_element", "matched")
    assert Study.build({"run": {"statistics": ["matched"]}}, "test").paper().run.statistics == ("matched",)


@pytest.mark.parametrize("verb", ["detect", "limit", "map"])
def test_ideal_answer_is_that_of_the_ideal_study(verb: str, engine: Engine) -> None:
    """Compare with the closed form of the study in which everything is known; the realistic answer is the worse."""
    realistic, ideal = (Table(getattr(mauvecl, verb)(study, engine).table) for study in (ASKED, ASKED.ideal()))
    assert "ideal" not in ideal.colnames
    column = {"detect": "closed_form_probability"}.get(verb, "closed_form")
    np.testing.assert_allclose(realistic["ideal"], ideal[column], rtol=1e-4)
    # Where both are nearly sure to see the flare, neither is better.
    assert (realistic["ideal"] >= realistic[column] - 1e-12).all()
    assert (realistic["ideal"] > realistic[column] + 1e-3).any()


def test_plan_by_the_closed_form_is_worse_than_the_ideal() -> None:
    """The S/N of a frame is that of a matched filter, less what the jitters of light and sky take away."""
    settings = ["plan.targets=[{name='eps Eri'}]", "orbit.days=5", "plan.completeness='closed form'"]
    study = Study().with_settings(settings)
    realistic, ideal = plan(study), plan(study.ideal())
    assert realistic.table["ideal"][0] == pytest.approx(ideal.table["expected"][0], rel=1e-9)
    assert realistic.table["expected"][0] < 0.95 * ideal.table["expected"][0]
    assert np.isnan(ideal.table["ideal"]).all()
    target = realistic.planned[0].observation
    (flare,) = target.case.expect(target.case.flaring(1e-3))
    quiet = target.quiet
    light = (flare.source_electrons - quiet.source_electrons) * quiet.gain_dn_per_electron / 1e-3
    added = sum(process.variance_dn2(quiet) for process in target.case.study.processes.additive.values())
    variance = quiet.unsaturated_variance_dn2 + added
    covariance = np.diag(variance) + 0.05**2 / 12 * np.outer(quiet.recorded_light_dn, quiet.recorded_light_dn)
    used = ~quiet.saturated
    exact = np.sqrt(light[used] @ np.linalg.solve(covariance[np.ix_(used, used)], light[used]))
    assert target.signal_per_frame == pytest.approx(exact, rel=1e-6)
    assert target.signal_with(None) == pytest.approx(np.sqrt(np.sum((light**2 / variance)[used])))


@pytest.mark.long
def test_headline_has_the_numbers_of_the_table(engine: Engine) -> None:
    answer = detect(ASKED, engine)
    row = min(answer.table, key=lambda one: abs(one["probability"] - 0.5))
    assert f"a flare of {100 * row['amplitude']:g} % on M3V V = 9 in 50 s" in answer.headline
    shown = [float(text) for text in re.findall(r"([\d.]+) %", answer.headline)][1:5]
    wanted = [100 * row[name] for name in ("probability", "low", "high", "ideal")]
    assert shown == pytest.approx([min(value, 99.99) for value in wanted], abs=0.051)
    assert answer.headline.endswith("the least certain of 2 flares.")
    # Of several stars, the name is that of the flare.
    stars = detect(ASKED.with_settings(["sweep.axes=[{quantity='magnitude', values=[5, 9]}]"]), engine)
    row = min(stars.table, key=lambda one: abs(one["probability"] - 0.5))
    assert f"a flare of {100 * row['amplitude']:g} % on {row['star']} in" in stars.headline
    found = mauvecl.limit(ASKED, engine)
    numbers = [f"{found.table[name].value[0]:.2f}" for name in ("magnitude", "low", "high", "ideal")]
    assert re.findall(r"\d+\.\d\d", found.headline) == numbers
    assert "if everything but the noise were known" not in mauvecl.limit(ASKED.ideal(), engine).headline
    # It says what saturates.
    bright = detect(ASKED.with_settings(["star.0.magnitude=1"]), engine)
    saturated = int(bright.stars[0].detection.quiet.saturated.sum())
    assert f"without the {saturated} of 1643 pixels that saturate in a frame of more than " in bright.headline
    safe_s = float(re.findall(r"more than ([\d.]+) s", bright.headline)[0])
    at_end = ASKED.with_settings(["star.0.magnitude=1", f"observation.changes={{frame_s={0.99 * safe_s}}}"])
    assert "saturate" not in detect(at_end, engine).headline
    assert saturated > 50
    seen = mauvecl.simulate(ASKED.with_settings(["star.0.magnitude=1"]))
    assert seen.headline.endswith(f"; {saturated} of 1643 pixels saturate.")


OLD = "[[star]]\nlibrary = 'G2V'\nmagnitude = 7.4\n[run]\nfap = 0.01\n"


@pytest.mark.parametrize(
    ("text", "instrument"),
    [("", "mauvesim"), ("[observation]\ninstrument = 'mauve'\n", "mauvesim"),
     ("[observation]\ninstrument = 'mauve-electrons'\n", "mauve")],
)  # fmt: skip
def test_study_of_version_1_is_read_as_it_was(text: str, instrument: str, tmp_path: Path) -> None:
    (tmp_path / "old.toml").write_text(OLD + text)
    with pytest.warns(UserWarning, match=f"old.toml has no version .* now called {instrument} "):
        study = Study.read(tmp_path / "old.toml")
    assert study.observation.instrument == instrument
    assert not study.nuisances.usual
    assert study.run.statistics == ("chi2", "chi2_element", "matched")
    new = tomllib.loads(study.toml())
    assert new.keys() - tomllib.loads(Study().toml()).keys() == {"nuisances"}, "no section that says nothing"
    assert new["nuisances"] == {"usual": False, "own": {}}
    (tmp_path / "more.toml").write_text(OLD + "[plan]\nhours = 10\n[nuisances]\nusual = true\n")
    with pytest.warns(UserWarning, match="no version.*the usual unknowns drawn"):
        more = Study.read(tmp_path / "more.toml")
    assert (more.plan.completeness, more.nuisances.usual) == ("injections", True)


def test_files_of_version_2_need_no_note_and_instruments_of_version_1_one(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    (tmp_path / "study.toml").write_text("version = 2\n" + OLD)
    study = Study.read(tmp_path / "study.toml")
    assert (study.observation.instrument, study.nuisances.usual) == ("mauve", True)
    (tmp_path / "again.toml").write_text(study.toml())
    assert Study.read(tmp_path / "again.toml") == study
    assert study.toml().startswith("version = 2\n")
    (tmp_path / "old.toml").write_text("extends = 'mauve'\nname = 'old'\nlight_loss = 0.2\n")
    (tmp_path / "new.toml").write_text("version = 2\nextends = 'mauve'\nname = 'new'\nlight_loss = 0.2\n")
    assert Instrument.load(tmp_path / "new.toml") == Instrument.load("mauve").with_(light_loss=0.2)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="old.toml is read as in version 1"):
        assert Instrument.load(tmp_path / "old.toml") == Instrument.load("mauvesim").with_(light_loss=0.2)
    with pytest.warns(UserWarning, match="is called mauve since version 2"):
        assert Instrument.load("mauve-electrons") == Instrument.load("mauve")
    with pytest.warns(UserWarning, match="is called mauve since version 2"):
        # What is written, such as a calibrated instrument that extends it, has today's name.
        assert Study().with_settings(["observation.instrument=mauve-electrons"]).observation.instrument == "mauve"
