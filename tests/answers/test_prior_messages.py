"""Every verb that draws a prior reports one that excludes the value of the expectation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from answers import of_kind, small
from marks import long_but
from typer.testing import CliRunner

from mauvecl import Engine, InputError, Study, detect, detection_map, limiting_magnitude, simulate, snr
from mauvecl.cli.app import app
from mauvecl.noise.unknowns import PROCESSES

#: Priors that contain the expectation's own value, and that do not.
PRIORS = {
    "jitter": ([0.0, 0.05], [0.01, 0.05]),
    "detector_temperature": ([13.0, 22.0], [5.0, 20.0]),
    "light_loss": ([0.34, 0.5], [0.35, 0.5]),
    "pointing_loss": ([0.0, 0.05], [0.1, 0.2]),
    "qe_scale": ([0.9, 1.1], [1.05, 1.2]),
    "sky_level": ([0.5, 1.0], [1.1, 2.0]),
}
MAP = {"x": {"quantity": "amplitude", "values": [0.05, 0.24]}, "y": {"quantity": "exposure", "values": [50.0]}}
VERBS: dict[str, tuple[Callable[[Study, Engine], Any], dict[str, Any]]] = {
    "simulate": (lambda study, _: simulate(study), {}),
    "snr": (snr, {}),
    "detect": (detect, {}),
    "map": (detection_map, {"map": MAP}),
    "limit": (limiting_magnitude, {"limit": {"of": "magnitude", "power": 0.5}}),
}


def said(verb: str, engine: Engine, **sections: Any) -> list[str]:
    ask, needs = VERBS[verb]
    study = small(**({"star": [{"library": "G2V", "magnitude": 7.4}]} | needs | sections))
    return of_kind(ask(study, engine).messages, "outside the prior")


def test_every_prior_is_tested() -> None:
    assert PRIORS.keys() == PROCESSES.keys()


# Far from the expectation no limit settles, which is refused: one prior near it.
@pytest.mark.parametrize(
    ("verb", "name"),
    long_but(
        ((v, n) for v in VERBS for n in PRIORS if v != "limit" or n == "light_loss"),
        *(("detect", n) for n in PRIORS),
        *((v, "light_loss") for v in VERBS if v not in ("detect", "limit")),
    ),
)
def test_prior_that_excludes_the_expectation_is_reported(engine: Engine, verb: str, name: str) -> None:
    holds, misses = ({"processes": {name: {"uniform": ends}}} for ends in PRIORS[name])
    assert said(verb, engine, **holds) == []
    (sentence,) = said(verb, engine, **misses)
    assert name in sentence


def test_prior_that_excludes_a_swept_value_is_reported(engine: Engine) -> None:
    """Use a prior that contains the study's temperature and one of two swept ones."""
    sweep = {"axes": [{"quantity": "detector_temperature", "values": [20.0, 10.0]}]}
    prior = {"detector_temperature": {"uniform": [18.0, 22.0]}}
    (sentence,) = said("detect", engine, processes=prior, sweep=sweep)
    assert "has 10:" in sentence


@pytest.mark.parametrize("of", ["amplitude", "magnitude", "exposure"])
def test_unconverged_limit_names_the_prior(engine: Engine, of: str) -> None:
    study = small(
        star=[{"library": "G2V", "magnitude": 7.4}],
        flare={"amplitudes": [0.24]},
        run={"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["chi2"]},
        processes={"light_loss": {"uniform": [0.6, 0.7]}},
        limit={"of": of, "power": 0.5},
    )
    with pytest.raises(InputError) as error:
        limiting_magnitude(study, engine)
    for fact in ("light_loss", "0.6 to 0.7", "0.34"):
        assert fact in str(error.value)


def test_realise_prints_the_message(tmp_path: Path) -> None:
    for ends, there in zip(PRIORS["light_loss"], (False, True), strict=True):
        prior = f"processes.light_loss={{uniform = {ends}}}"
        given = ["--star", "G2V", "-m", "7.4", "-n", "10", "--set", prior, "--output", str(tmp_path / f"{there}.zarr")]
        done = CliRunner().invoke(app, ["realise", *given])
        assert done.exit_code == 0, done.output
        assert ("OUTSIDE THE PRIOR" in done.output) == there
