"""Every verb that answers a study states its assumptions in one line."""

from __future__ import annotations

import inspect
import json
from importlib import import_module
from pathlib import Path
from typing import get_args

import pytest
from commands import run

from mauvecl.answers.verbs import VERBS
from mauvecl.study.assumptions import Use, assumption_line
from mauvecl.study.study import Study

USUAL = "instrument mauve, detector at 21 deg C; sky of V = 22.1 mag/arcsec2; "
FLARE = "flares of 10000 K, added to the star, amplitudes in the Kepler band; "
ORBIT = "orbit of embedded elements; least angles: Earth's limb 25 deg, Sun 46 deg, Moon 25 deg"
REST = "everything known but the noise; seed 1"
#: What each verb states about the default study.
STATED = {
    "simulate": USUAL + REST,
    "snr": USUAL + REST,
    "exposure": USUAL[:-2],
    "change": USUAL + "everything known but the noise",
    "calibrate": USUAL[:-2],
    "analyse": "flares of the shape davenport2014; noise as measured; seed 1",
    "visible": ORBIT,
    "plan": f"instrument mauve, detector at 21 deg C; {FLARE}{ORBIT}; {REST}",
} | dict.fromkeys(("detect", "limit", "map", "gaussian", "stare", "inject", "measure"), USUAL + FLARE + REST)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_states_its_assumptions(verb: str) -> None:
    ask = VERBS[verb].ask
    answer = getattr(import_module(ask.__module__), inspect.signature(ask).return_annotation)
    assert assumption_line(Study(), answer.USES) == f"Assumed: {STATED[verb]}."


@pytest.mark.parametrize(
    ("verb", "flags"),
    [
        ("exposure", ("--snr", "10", "--at", "300", "--no-pictures")),
        pytest.param("realise", ("-n", "10", "--output", "r.zarr", "--restart"), marks=pytest.mark.long),
    ],
)
def test_assumptions_are_printed_and_part_of_json(verb: str, flags: tuple[str, ...], tmp_path: Path) -> None:
    words = (verb, "--star", "G2V", "-m", "7.4", *flags)
    (line,) = (x for x in run(*words, folder=tmp_path).stdout.splitlines() if x.startswith("Assumed: "))
    assert line.startswith(f"Assumed: {USUAL[:-2]}")
    assert json.loads(run(*words, "--json", folder=tmp_path).stdout)["assumed"] == line


ALL = get_args(Use)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("observation.instrument=mauve-electrons", "instrument mauve-electrons"),
        ("observation.temperature_c=13", "detector at 13 deg C"),
        ("observation.changes={light_loss=0.2}", "with another light_loss"),
        ("sky={surface_brightness=20.5}", "sky of V = 20.5 mag/arcsec2"),
        ("sky={none=true}", "no sky"),
        ("sky={target='53.2 -9.5', time='2027-01-01'}", "sky at 53.2 -9.5, 2027-01-01 UTC"),
        ("flare.temperature_k=9000", "flares of 9000 K"),
        ("flare.band=TESS", "amplitudes in the TESS band"),
        ("flare.geometry=replaces", "replacing photosphere"),
        ("run.seed=7", "seed 7"),
        ("nuisances.usual=true", "the usual unknowns drawn and marginalised"),
        ("nuisances.dark=0.1", "marginalised: dark"),
        ("processes.jitter.uniform=[0,0.05]", "drawn: jitter"),
        ("stare.thermal.amplitude=0.5", "drawn: thermal"),
        ("stare.jitters={light=0.01}", "drawn: jitters of light"),
        ("unknowns.draws=4", "4 draws of the instrument's unknowns"),
        ("sweep.axes=[{quantity='sky', values=[20, 21]}]", "sky as swept"),
        ("sweep.axes=[{quantity='detector_temperature', values=[13, 21]}]", "detector temperature as swept"),
        ("sweep.axes=[{quantity='flare_temperature', values=[9000, 8000]}]", "flares of swept temperature"),
        ("orbit.limits.sun_deg=50", "Sun 50 deg"),
    ],
)
def test_assumptions_follow_the_study(setting: str, words: str) -> None:
    usual, changed = assumption_line(Study(), ALL), assumption_line(Study().with_settings([setting]), ALL)
    assert words in changed
    assert words not in usual
    assert "\n" not in changed
