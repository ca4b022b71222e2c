"""Realistic answers by default, ideal ones next to them, and files of version 1."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import mauvecl
from mauvecl import Engine, Instrument, Study, detect, limit, plan

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
    found = limit(ASKED, engine)
    numbers = [f"{found.table[name].value[0]:.2f}" for name in ("magnitude", "low", "high", "ideal")]
    assert re.findall(r"\d+\.\d\d", found.headline) == numbers
    assert "if everything but the noise were known" not in limit(ASKED.ideal(), engine).headline
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
