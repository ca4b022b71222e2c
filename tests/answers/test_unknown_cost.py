"""What unknowns cost in detections, limits and maps, and how studies state them."""

import re
import tomllib
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from answers import expectations, of_kind
from commands import run
from scipy import stats

from mauvecl import Engine, Nuisances, Study, detect, unknown_table


def study(**nuisances: Any) -> Study:
    """Return the G2V star of METHODS section 7 with its 2 % flare, Vega at V = 0."""
    star = {"library": "G2V", "magnitude": 7.4, "magnitude_system": "vega"}
    run = {"realisations": 10_000, "fap": 0.02, "statistics": ["matched"]}
    sections = {"star": [star], "flare": {"amplitudes": [0.02]}, "run": run}
    sections |= {"observation": {"instrument": "mauvesim"}, "nuisances": {"usual": False} | nuisances}
    return Study.build(sections, "test")


@pytest.mark.parametrize(("nuisances", "plain", "marginal", "said"), [
    ({"dark": 0.1}, 0.23, 3.06, "the dark level (+-0.1 deg C)"),
    ({"dark": 0.003}, 5.65, 5.91, "the dark level (+-0.003 deg C)"),
    ({"light": 0.01}, 4.12, 5.67, "the light level (+-1 %)"),
    ({"dark": "free", "light": "free"}, 0.0, 3.05, "the dark level (free) and the light level (free)"),
])  # fmt: skip
def test_cost_equals_that_of_the_methods(engine: Engine, nuisances: Any, plain: Any, marginal: Any, said: str) -> None:
    answer = detect(study(**nuisances), engine)
    (sentence,) = of_kind(answer.messages, "cost of unknowns")
    assert said in sentence
    assert f"Statistics are marginalised over {said}." in answer.messages
    found = re.search(r"S/N of (\S+) with .* it is (\S+) by the plain statistic and (\S+) marginalised", sentence)
    # Two digits of the plain S/N are printed, three of the others.
    assert [float(one) for one in found.groups()] == pytest.approx([8.36, plain, marginal], rel=0.022, abs=1e-9)
    quiet, flare = expectations(study())
    own = {name: np.inf if sd == "free" else sd for name, sd in nuisances.items()}
    exact = Nuisances.of(quiet, own).spectra / np.sqrt(quiet.variance_dn2)
    delta = (flare.signal_dn - quiet.signal_dn) / np.sqrt(quiet.variance_dn2)
    gram = exact @ exact.T + np.diag([0.0 if np.isinf(sd) else sd**-2.0 for sd in own.values()])
    along = exact @ delta
    assert float(found[3]) == pytest.approx(np.sqrt(delta @ delta - along @ np.linalg.solve(gram, along)), rel=0.01)


def test_own_unknowns_are_read_from_files_points_and_flags(tmp_path: Path, engine: Engine) -> None:
    """Compare answers and studies of a file, of its points, of flags, and the values of the interface in Python."""
    (tmp_path / "stray.txt").write_text("200 1\n450 3\n700 1  # DN\n")
    flags = "--star G2V -m 7.4 -a 0.02 -n 20000 --fap 0.01 --statistic matched --ideal --nuisance dark=0.1"
    run("detect", *flags.split(), "--nuisance", "stray.txt=2", "--no-pictures", folder=tmp_path)
    of_flags = Study.read(tmp_path / "mauvecl-detect" / "detection.ecsv")
    own = "nuisances = {usual = false, dark = 0.1, own.stray = {file = 'stray.txt', sd = 2.0}}"
    (tmp_path / "study.toml").write_text(f"version = 2\n{own}\n")
    assert Study.read(tmp_path / "study.toml").nuisances == of_flags.nuisances
    points = {"points": [[200, 1], [450, 3], [700, 1]], "sd": 2.0}
    of_points = of_flags.with_changes({"nuisances": {"dark": 0.1, "own": {"stray": points}}}, None)
    assert Study.build(tomllib.loads(of_points.toml()), "text") == of_points
    quiet, flare = expectations(of_flags)
    stray = np.interp(quiet.wavelength_nm, [200, 450, 700], [1, 3, 1])
    unknown = Nuisances.of(quiet, {"dark": 0.1, "stray": 2.0}, {"stray": stray})
    how: Any = {"realisations": 20_000, "seed": of_flags.run.seed, "statistics": "matched", "nuisances": unknown}
    thresholds = [detect(one, engine).table["threshold"][0] for one in (of_flags, of_points)]
    assert thresholds == [engine.detect(quiet, [flare], **how).threshold(0.01, "matched").value] * 2


def test_usual_unknowns_follow_the_observation(engine: Engine) -> None:
    """Check that they are centred on the study's temperature, and that the study's own processes stay."""
    asked = study(usual=True).with_settings(
        ["observation.temperature_c=13", "processes.jitter={uniform=[0.0, 0.01]}", "nuisances.dark=0.3"]
    )
    with mock.patch.object(Engine, "detect", autospec=True, side_effect=Engine.detect) as draw:
        detect(asked, engine)
        detect(study(), engine)
    drawn, known = (call.kwargs["processes"] for call in draw.call_args_list)
    assert (drawn.detector_temperature.mean, drawn.jitter.high) == (13, 0.01)
    assert known.detector_temperature is None
    found = asked.nuisances.marginalised(expectations(asked)[0])
    assert dict(zip(found.names, found.sd, strict=True)) == {"dark": 0.3, "light": np.inf, "sky": 0.1}
    # A stated error takes the place of the drawn one, of half a degree, in the cost as well.
    (sentence,) = of_kind(detect(study(usual=True, dark=0.003), engine).messages, "cost of unknowns")
    assert float(re.search(r"it is (\S+) by the plain", sentence)[1]) > 1.0
    dark_sky = asked.with_changes({"sky": {"none": True}}, None)
    assert dark_sky.nuisances.marginalised(expectations(dark_sky)[0]).names == ("dark", "light")


def test_template_of_the_flare_itself_loses_nothing(engine: Engine) -> None:
    """Draw ten times the scatter that the statistic assumes; another template loses its angle to the flare's."""
    drawn = ["processes.detector_temperature={normal=[21, 0.5], between=[18, 24]}", "flare.amplitudes=[3]"]
    for nuisances, settings in (({}, ["flare.amplitudes=[0.005]"]), ({"dark": 0.05}, drawn)):
        asked = study(**nuisances).with_settings([*settings, "run.template_temperatures_k=[10000, 8000]"])
        answer = detect(asked, engine)
        kept = [float(found[1]) for text in answer.messages if (found := re.search(r"keeps (\S+) % of the", text))]
        assert kept[0] == 100.0
        assert 50.0 < kept[1] < 99.9
        p = dict(zip(answer.table["statistic"], answer.table["probability"], strict=True))
        assert p["matched 8000 K"] < p["matched"] == p["matched 10000 K"] or nuisances


def test_table_of_unknowns_holds_the_smallest_flare_with_the_power(tmp_path: Path) -> None:
    """Compare a row with METHODS section 7, and the power at the smallest amplitude with 90 %."""
    found = unknown_table(study())
    rows = {row["unknown"]: row for row in found.table}
    assert rows["the dark level (+-0.1 deg C)"]["marginalised"] == pytest.approx(3.06, rel=0.01)
    for row in rows.values():
        snr = row["marginalised"] * row["smallest"] / row["amplitude"]
        assert stats.norm.sf(stats.norm.isf(study().run.fap) - snr) == pytest.approx(0.9)
    assert found.plot(tmp_path / "unknowns.png") == tmp_path / "unknowns.png"
