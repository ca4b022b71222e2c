"""Every unknown at every verb: it changes the answer, is refused, or the answer names it as not used."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from answers import VERBS, small
from marks import long_but
from tables import DATA, toml

import mauvecl
from mauvecl import Engine, InputError, Stares, Study

ADDITIVE, NUISANCES, LEVELS = ["cosmic_rays"], ["dark", "light", "sky", "tilt"], ["light", "sky", "temperature"]
STARE_CHANGES = {"jitters": LEVELS} | {course: ["star", *LEVELS] for course in ("offsets", "drifts", "cycles")}
TABLES = toml("studies/unknowns.toml")
FEW, PRIORS, NEEDS = (TABLES[name] for name in ("few", "priors", "needs"))
NEEDS["analyse"]["data"] = {key: DATA / "flares" / name for key, name in NEEDS["analyse"]["data"].items()}
#: One study section for each unknown.
UNKNOWNS: dict[str, dict[str, Any]] = {
    **{f"processes.{name}": {"processes": {name: PRIORS[name]}} for name in PRIORS},
    **{f"processes.{name}": {"processes": {name: {"rate_per_cm2_s": 300.0}}} for name in ADDITIVE},
    **{f"nuisances.{name}": {"nuisances": {name: 0.1}} for name in NUISANCES},
    **{f"stare.{at}.{name}": {"stare": {at: {name: 0.01}}} for at, rows in STARE_CHANGES.items() for name in rows},
    **TABLES["unknowns"],
}
#: Verbs that leave the usual unknowns out, since they ask about the noise, the sky's geometry or observed frames.
WITHOUT_USUAL = {"simulate", "snr", "exposure", "gaussian", "visible", "analyse"}
#: Verbs that take another engine, or none.
ENGINES: dict[str, Any] = {"stare": Stares, "inject": Stares, "plan": Stares, "simulate": None, "visible": None}


def asked(verb: str, unknown: dict[str, Any]) -> Study:
    # The sky is bright, so that its level changes a map of few realisations.
    sections = {"star": [{"library": "G2V", "magnitude": 7.4}], "flare": {"amplitudes": [0.05]}, "run": FEW}
    sections["sky"] = {"surface_brightness": 15.0}
    sections |= NEEDS.get(verb, {})
    for name, section in unknown.items():
        sections[name] = sections.get(name, {}) | section
    return small(**sections)


@cache
def engine_of(verb: str) -> Any:
    kind = ENGINES.get(verb, Engine)
    return kind and kind()


def answer(verb: str, unknown: dict[str, Any]) -> Any:
    return getattr(mauvecl, verb)(asked(verb, unknown), engine_of(verb))


@cache
def plain(verb: str) -> Any:
    return answer(verb, {})


def differ(one: Any, other: Any, *, messages: bool) -> bool:
    """Return whether two answers have different numbers or, if `messages` count, messages."""
    for name, table in one.tables.items():
        there = other.tables.get(name)
        if there is None or table.colnames != there.colnames or len(table) != len(there):
            return True
        for column in table.colnames:
            if not np.array_equal(np.asarray(table[column]).astype(str), np.asarray(there[column]).astype(str)):
                return True
    return messages and set(one.messages) != set(other.messages)


#: Verbs that draw from a study or read one light curve; `calibrate` reads frames of several stars.
ASKED = [verb for verb in VERBS if verb != "calibrate"]
EACH = pytest.mark.parametrize("verb", long_but(ASKED, "exposure", "visible", "simulate", "plan"))


def test_every_unknown_of_a_study_is_tested() -> None:
    assert set(Study().processes.model_dump()) == {*PRIORS, *ADDITIVE}
    assert set(Study().nuisances.model_dump()) == {*NUISANCES, "usual", "own"}
    for course, names in STARE_CHANGES.items():
        with pytest.raises(InputError) as error:
            asked("stare", {"stare": {course: {"none": 0.1}}})
        assert all(name in str(error.value) for name in names)


@pytest.mark.parametrize("name", UNKNOWNS)
@EACH
def test_no_unknown_is_ignored_silently(verb: str, name: str) -> None:
    unknown, base = UNKNOWNS[name], plain(verb)
    if name == "nuisances.usual" and verb in WITHOUT_USUAL:
        # A question about the noise or the sky alone, whose answer says that everything else is known.
        assert "the usual unknowns" not in answer(verb, unknown).assumed
        return
    _, _, unused = replace(base, study=asked(verb, unknown)).assumed.partition("not used: ")
    if unused:
        assert any(name.startswith(key) for key in unused.rstrip(".").split(", "))
        return
    try:
        differs, refusal = differ(answer(verb, unknown), base, messages=verb == "plan"), ""
    except InputError as error:
        differs, refusal = False, f"{error.key} {error}"
    assert differs or name.split(".")[1] in refusal, refusal or f"{name} changes nothing that {verb} answers"


@EACH
def test_neighbours_change_every_verb(verb: str) -> None:
    """Answers change and list the neighbours; a verb that observes no star names them as not used."""
    star = "plan.targets.0" if verb == "plan" else "star.0"
    near = [f"{star}.neighbours='{DATA / 'studies' / 'neighbours.csv'}'", f"{star}.neighbour_share=0.5"]
    found = getattr(mauvecl, verb)(asked(verb, {}).with_settings(near), engine_of(verb))
    if verb == "visible":
        assert found.assumed.endswith("not used: star.neighbours.")
        assert found.neighbours is None
        return
    assert differ(found, plain(verb), messages=False)
    table = found.neighbours
    assert table["enters"].tolist() == [True, False]
    assert table.meta["assumed_share"] == 0.5
    assert table["share"][0] > 0.05
    assert table["share"][1] == 0
    assert any("assumption: 50 % of it enters" in text for text in found.messages)
    if verb in ("detect", "limit", "inject", "plan"):
        shares = next(iter(found.tables.values()))["target_share"]
        assert ((shares > 0) & (shares < 0.9)).all()
