"""What answers say: saturation, priors beside the expectation, flares that lower a statistic, stars without light."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import expectations, of_kind, small
from commands import ended
from marks import long_but
from scenes import paper
from tables import toml

import mauvecl
from mauvecl import Engine, InputError, Stares, Study, detect, limit, simulate
from mauvecl import map as detection_map

G2V = {"star": [{"library": "G2V", "magnitude": 7.4}]}
SATURATED, PRIORS, OF_PRIORS, KINDS = toml("studies/messages.toml").values()


def map_of(amplitudes: list[float], exposures: list[float]) -> dict[str, Any]:
    axes = {"x": {"quantity": "amplitude", "values": amplitudes}, "y": {"quantity": "exposure", "values": exposures}}
    return {"map": axes}


def said(verb: str, study: Study, engine: Engine, folder: Path) -> list[str]:
    """Return the messages of a verb, or the sentence of its refusal."""
    if verb == "realise":
        (folder / "study.toml").write_text(study.toml())
        code, out, reported = ended("realise", "study.toml", "-n", "10", "--output", "out.zarr", folder=folder)
        assert code in (0, 2), reported
        return (out + reported).splitlines()
    if verb == "simulate":
        return list(simulate(study, flaring=True).messages)
    try:
        return list(getattr(mauvecl, verb)(study, Stares() if verb in ("stare", "inject", "plan") else engine).messages)
    except InputError as refusal:
        return [str(refusal)]


def hot_star(magnitude: float, low_nm: float, **sections: Any) -> Study:
    data: dict[str, Any] = {
        "star": [{"library": "A0V", "magnitude": magnitude, "distance_pc": 7.7}], "flare": {"amplitudes": [0.01]},
        "observation": {"exposure_s": 5.0, "changes": {"output_min_nm": low_nm, "output_max_nm": 340.0}},
        "run": {"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["matched"]},
    }  # fmt: skip
    return Study.build(data | sections, "test").paper()


@pytest.mark.parametrize("name", SATURATED)
def test_star_or_flare_that_saturates_is_reported(engine: Engine, tmp_path: Path, name: str) -> None:
    """Include stars that leave some pixels, few pixels and none below saturation, and flares that alone saturate."""
    verb, sections = name.split()[0], SATURATED[name]
    studies = [hot_star(0.03, low_nm, **sections) for low_nm in (250.0, 300.0)]
    if verb in ("simulate", "detect", "map", "realise", "gaussian"):
        studies.append(hot_star(3.3, 300.0, **(sections | {"flare": {"amplitudes": [12.0]}})))
        quiet, flare = expectations(studies[-1])
        assert not of_kind(quiet.messages, "saturated")
        assert flare.saturated.any()
    for number, study in enumerate(studies):
        folder = tmp_path / str(number)
        folder.mkdir()
        found = [text for text in said(verb, study, engine, folder) if "saturate" in text.lower()]
        assert any("flare" in text or number < 2 for text in found), (number, found)


# Far from the expectation no limit settles, which is refused: one prior near it.
@pytest.mark.parametrize(
    ("verb", "name"),
    long_but(
        ((v, n) for v in OF_PRIORS for n in PRIORS if v not in ("limit", "realise") or n == "light_loss"),
        *(("detect", n) for n in PRIORS),
        *((v, "light_loss") for v in OF_PRIORS if v not in ("detect", "limit")),
    ),
)
def test_prior_that_excludes_the_expectation_is_reported(engine: Engine, tmp_path: Path, verb: str, name: str) -> None:
    for ends, is_told in zip(PRIORS[name], (False, True), strict=True):
        folder = tmp_path / str(is_told)
        folder.mkdir()
        study = small(**(G2V | OF_PRIORS[verb] | {"processes": {name: {"uniform": ends}}}))
        found = [text for text in said(verb, study, engine, folder) if "outside the prior" in text.lower()]
        assert len(found) == is_told
        assert all(name in text for text in found)


@pytest.mark.parametrize("name", [name for name in KINDS if name != "study"])
def test_messages_are_given_where_they_apply(engine: Engine, tmp_path: Path, name: str) -> None:
    row = {"less": [], "without": 0, "with": 1} | KINDS[name]
    study = paper(*KINDS["study"], *row["less"])
    for asked, count in ((study, row["without"]), (study.with_settings(row["more"]), row["with"])):
        found = of_kind(said(row["verb"], asked, engine, tmp_path), row["kind"])
        assert len(found) == count, found


UNKNOWN = {"known": {}, "light": {"light": "free"}, "both": {"light": "free", "dark": "free"}}


def cool_flare(temperature_k: float, unknown: str, **sections: Any) -> Study:
    """Return a study of a flare whose temperature decides whether it lowers `uv_excess`."""
    flare = {"amplitudes": [0.3], "temperature_k": temperature_k}
    run = {"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["uv_excess", "matched"]}
    return small(**G2V, flare=flare, observation={"exposure_s": 50.0}, run=run, nuisances=UNKNOWN[unknown], **sections)


@pytest.mark.parametrize("unknown", UNKNOWN)
@pytest.mark.parametrize("kelvin", [3000.0, 4000.0, 6000.0, 10_000.0, 20_000.0])
def test_lowered_statistic_is_reported_if_simulation_lowers_it(engine: Engine, unknown: str, kelvin: float) -> None:
    """Compare with simulated means that differ by more than five standard errors; fails once in 1e6 seeds."""
    answer = detect(cool_flare(kelvin, unknown), engine)
    (one,) = answer.stars
    named = {text.split(" falls by ")[0].split()[-1] for text in of_kind(answer.messages, "wrong sign")}
    for statistic in ("uv_excess", "matched"):
        null, flare = (one.detection.distribution(statistic, k) for k in (None, 0))
        gap, error = flare.mean - null.mean, np.hypot(flare.std, null.std) / 100
        if abs(gap) > 5 * error:
            assert (statistic in named) == (gap < 0), (statistic, gap)
    assert named <= {"uv_excess"}
    if unknown == "both" and kelvin in (4000.0, 10_000.0):
        # Both cases are among those above, and a lowered statistic detects nothing.
        assert bool(named) == (kelvin == 4000.0)
        assert not named or answer.table["probability"][0] < 0.01 < 0.9 < answer.table["probability"][1]


@pytest.mark.parametrize("temperature_k", [4000.0, 10_000.0])
def test_maps_and_limits_report_a_wrong_sign_as_detect_does(engine: Engine, temperature_k: float) -> None:
    """Compare the messages of all cells of a map with `detect`, and the stated cause of an impossible limit."""
    lowered = temperature_k == 4000.0
    asked = cool_flare(temperature_k, "both", **map_of([0.2, 0.3], [5.0, 50.0]))
    of_map = of_kind(detection_map(asked, engine).messages, "wrong sign")
    assert ["uv_excess falls with the flare in 4 of 4 cells" in text for text in of_map] == [True] * lowered
    # Of magnitudes, one so bright that most pixels saturate turns the sign.
    for of in ("amplitude", "exposure"):
        found = limit(cool_flare(temperature_k, "both", limit={"of": of, "power": 0.5}), engine)
        assert [one.statistic for one in found.limits] == ["uv_excess", "matched"][lowered:]
        assert ["WRONG SIGN" in text for text in found.failed] == [True] * lowered
