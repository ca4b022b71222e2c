"""Public functions with names that are unknown and arrays of a wrong shape: they answer, or raise InputError.

`tests/test_validation.py` tests what annotations refuse. The values of this test fit the annotations, so the function
itself has to refuse them. Parameters and their types are derived from the annotations; only names, whose meaning an
annotation does not state, are listed.
"""

import inspect
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import study_of_g2v
from test_validation import FUNCTIONS, PARAMETERS, accepted, annotation, anything, arguments, example, holds_arrays

import mauvecl
from mauvecl import InputError

#: Values of required parameters that are text, by name of the parameter.
WORDS = {
    "band": "Kepler", "kind": "band", "quantity": "magnitude", "statistic": "matched", "target": "290.0 -11.2",
    "time": "2027-01-01", "shape": "fiducial", "instrument": "mauvesim", "path": "no such file", "file": "x.fits",
}  # fmt: skip

#: What the package calls with arrays that it has made, which nothing checks again in a loop.
INNER = (
    "BalmerFlare.", "Blackbody.", "FlareWithLines.", "Frames.shifted", "Normal.quantile", "Nuisances.finite",
    "Nuisances.rows", "ObservedFlare.flux", "ObservedFlare.grid", "Pool.realise", "Stares.", "TableShape.",
    "TwoBlackbodies.", "Uniform.quantile", "bulk.unfinished",
)  # fmt: skip


@cache
def instances() -> dict[type, Any]:
    """Return an instance of each class that functions take or whose methods are called."""
    star = mauvecl.Source.from_library("G2V").at_magnitude(7.4)
    part = mauvecl.Instrument.load("mauvesim").with_(output_min_nm=300.0, output_max_nm=306.0)
    quiet, flare = (mauvecl.expect(one, part, exposure=5) for one in (star, star.flaring(0.5)))
    study = study_of_g2v(observation={"changes": {"output_min_nm": 300.0, "output_max_nm": 306.0}})
    time = 5.0 * np.arange(30)
    model = mauvecl.FlareModel.of(star, part, quiet)
    made = (
        star, part, quiet, study, model, mauvecl.Engine(), mauvecl.EnergyScale.of_blackbody(1.0, 5772.0),
        mauvecl.Engine().detect(quiet, [flare], realisations=500, seed=1), mauvecl.Cooling(1e4, 5000.0, 300.0),
        mauvecl.Event(0.0, 60.0, 0.1), mauvecl.Nuisances.of(quiet, {"dark": 0.1}), mauvecl.Pool(), mauvecl.Processes(),
        mauvecl.PixelMap.made_up(5, seed=1), mauvecl.Sky.of_brightness(22.0), mauvecl.Stare.of(60.0),
        mauvecl.Comparison(), mauvecl.BalmerFlare(9000.0), mauvecl.Normal(0.0, 1.0, -5.0, 5.0), mauvecl.Sinusoid(0.1),
        mauvecl.Blackbody(9000.0), mauvecl.TwoBlackbodies(9000.0, 5000.0, 1.0), mauvecl.Uniform(0.0, 1.0),
        mauvecl.FlareWithLines(mauvecl.Blackbody(9000.0), {"Mg II": 0.05}), mauvecl.Stares(),
        mauvecl.ObservedFlare.from_arrays(np.linspace(170, 1200, 1200), np.ones(1200)),
        mauvecl.TableShape(np.array([-1.0, 0.0, 1.0, 4.0]), np.array([0.0, 3.0, 1.0, 0.0])),
        mauvecl.Frames.of(time, np.ones(30)), mauvecl.SHAPES["fiducial"],
    )  # fmt: skip
    return {type(one): one for one in made}


def fitting(path: str, name: str) -> Any:
    """Return a value for a required parameter, by its annotation."""
    hint = annotation(path, name)
    for kind, one in instances().items():
        if accepted(hint, *(base for base in kind.__mro__ if base.__module__.startswith("mauvecl"))):
            return (one,) if accepted(hint, Sequence, tuple, list) else one
    if accepted(hint, str, Path):
        word = WORDS.get(name, "x")
        return (word,) if accepted(hint, tuple) else word
    if accepted(hint, dict, Mapping):
        return {}
    if holds_arrays(hint) or accepted(hint, float):
        value = example(hint)
        return (value,) if accepted(hint, tuple, Sequence) else value
    return 3 if accepted(hint, int) else None


def wrong_values(path: str, name: str) -> list[Any]:
    """Return values that fit the annotation of a parameter and cannot be right."""
    hint = annotation(path, name)
    if anything(hint):
        return []
    arrays = [np.ones((2, 3)), np.full(4, np.nan), np.empty(0)] if holds_arrays(hint) else []
    return arrays + (["no such thing"] if accepted(hint, str, Path) else [])


#: Names of functions with a parameter that is tried. Methods need an instance of their class.
TRIED = sorted(
    {
        path
        for path, name in PARAMETERS
        if hasattr(FUNCTIONS[path], "__validated__") and not path.startswith(INNER) and wrong_values(path, name)
    }
)


@pytest.mark.long
@pytest.mark.parametrize("path", TRIED)
def test_wrong_name_or_array_raises(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    owner, _, method = path.partition(".")
    thing = getattr(mauvecl, owner)
    call = thing
    if method:
        static = inspect.getattr_static(thing, method, None)
        bound = (
            thing
            if isinstance(static, classmethod | staticmethod) or not inspect.isclass(thing)
            else instances()[thing]
        )
        call = getattr(bound, method)
    required = [p.name for p in arguments(FUNCTIONS[path]) if p.default is p.empty]
    good = {name: fitting(path, name) for name in required}
    for name in (name for there, name in PARAMETERS if there == path):
        for value in wrong_values(path, name):
            try:
                call(**good | {name: value})
            except InputError:
                pass
            except RuntimeError as error:
                assert error.kind, "a device's failure states its kind"  # type: ignore[attr-defined]  # noqa: PT017
