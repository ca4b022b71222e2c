"""Every public constructor and function with a wrong argument: it answers, or raises one sentence, never anything else.

The public names are walked: a new parameter is tried as soon as it is there, and fails here until its name has a value
that fits.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest

import mauvecl
from mauvecl import bulk
from mauvecl.device.errors import DeviceError
from mauvecl.schema.errors import InputError

WRONG = {
    "a Quantity of another unit": 3 * u.kg,
    "NaN": np.nan,
    "a list of two kinds": [1, "a"],
    "text": "no such thing",
    "an object": object(),
    "an array": np.ones((2, 3)),
    "a truth": True,
    "nothing": None,
}
#: What nothing takes, but for free text: a list is as good a name as any.
NEVER = ("a Quantity of another unit", "a list of two kinds", "an object")
FREE = ("Any", "object", "dict[str, Any]", "str")
#: Made by functions that are tried, with fields of their own names; and what is a part of the engine's inner side.
MADE = (
    "Detection",
    "Expectation",
    "FlareModel",
    "Frames",
    "Instrument",
    "Measurement",
    "MeasuredBins",
    "Study",
    "Stare",
)
INNER = (
    "Detection.collect", "Detection.of", "DaskWorkers", "LocalWorkers.submit", "Engine.count", "Linear.", "TableShape.",
    "Nuisances.rows", "Nuisances.finite", "Processes.factors", "Normal.quantile", "Uniform.quantile",
    "Stares.", "Pool.stares", "Sinusoid.mean_over", "PixelMap.over", "Instrument.per_pixel", "Stare.along",
    "Engine.realise_and_count", "bulk.unfinished", "bulk.state", "bulk.draw",
)  # fmt: skip


@cache
def star() -> Any:
    return mauvecl.Source.from_library("G2V").at_magnitude(7.4)


@cache
def part() -> Any:
    return mauvecl.Instrument.load("mauve").with_(output_min_nm=300.0, output_max_nm=306.0)


@cache
def pair() -> Any:
    return tuple(mauvecl.expect(s, part(), exposure=5) for s in (star(), star().flaring(0.5)))


@cache
def found() -> Any:
    return mauvecl.Engine().detect(*pair(), realisations=500, seed=1)


@cache
def study() -> Any:
    part = {"output_min_nm": 300.0, "output_max_nm": 306.0}
    star = [{"library": "G2V", "magnitude": 7.4}]
    return mauvecl.Study.build({"star": star, "observation": {"changes": part}}, "t")


@cache
def things() -> dict[str, Any]:
    """One of each class, whose methods are called."""
    scale = mauvecl.EnergyScale.of_blackbody(1.0, 5772.0)
    return {
        "Cooling": mauvecl.Cooling(1e4, 5000.0, 300.0), "CosmicRays": mauvecl.CosmicRays(), "Detection": found(),
        "EnergyScale": scale, "Engine": mauvecl.Engine(), "Event": mauvecl.Event(0.0, 60.0, 0.1),
        "Expectation": pair()[0], "Instrument": mauvecl.Instrument.load("mauve"),
        "Nuisances": mauvecl.Nuisances.of(pair()[0], {"dark": 0.1}), "Pool": mauvecl.Pool(),
        "PixelMap": mauvecl.PixelMap.made_up(5, seed=1), "Sky": mauvecl.Sky.of_brightness(22.0), "Source": star(),
        "Stare": mauvecl.Stare.of(60.0), "Study": study(), "LocalWorkers": mauvecl.LocalWorkers(),
        "Processes": mauvecl.Processes(), "Comparison": mauvecl.Comparison(),
    }  # fmt: skip


@cache
def fitting() -> dict[str, Any]:
    """Return a value for each required parameter, by name."""
    quiet, flare = pair()
    pixels = np.ones(quiet.wavelength_nm.size)
    return {
        "amplitude": 0.1, "brightness": 22.0, "band": "Kepler", "changes": {}, "count": 2, "data": {}, "ebv": 0.1,
        "end_k": 5000.0, "energy_erg": 1e33, "engine": mauvecl.Engine(), "equivalent_duration_s": 10.0,
        "erg_per_s": 1e33, "expectation": quiet, "exposure": 5.0, "fap": 0.1, "field_of_view_arcsec2": 100.0,
        "file": "x.fits", "flares": [flare], "flux": np.ones(1200), "flux_flam": np.ones(1200), "fold_s": 300.0,
        "detection": found(), "half_width_s": 60.0, "high": 3.0, "how": "x", "instrument": "mauve", "kind": "band",
        "low": 0.0, "magnitude": 7.0, "mean": 0.0, "name": "mauve", "names": ("a",), "origin": "x",
        "path": "no such file", "peak": 0.1, "peak_k": 1e4, "peak_s": 0.0, "pixels": 5, "probability": 0.5,
        "quantity": "magnitude", "quiet": quiet, "radius_rsun": 1.0, "realisations": 50, "scale_of": None,
        "scale": things()["EnergyScale"], "sd": np.ones(1), "seconds": 5.0, "seed": 1, "settings": ["run.fap=0.1"],
        "rate_per_cm2_s": 1.0,
        "since_peak_s": 3.0, "source": star(), "sources": [star()], "spectra": pixels[None], "spectrum": None,
        "star": study().star[0], "stars": None, "statistic": "matched", "study": study(), "surface_brightness": 22.0,
        "target": "290.0 -11.2", "tau": np.linspace(-1, 5, 10), "temperature_k": 5700.0, "threshold": 3.0,
        "time": "2027-01-01", "value": 7.0, "values": np.r_[0, 1, np.linspace(1, 0, 8)], "wavelength": 7.0,
        "wavelength_nm": 303.0, "weights": pixels, "where": "x", "width_nm": 3.0, "stares": None, "shape": "fiducial",
        "duration_s": 60.0, "distance_pc": 10.0, "description": "x", "temperature": 1e4, "period_s": 5000.0,
        "device": None, "devices": (None,), "flare": 0, "time_s": 5.0 * np.arange(30),
        "Frames.of.flux": np.ones(30), "description_": "", "nuisances": None,
        "Detection.statistic.name": "chi2", "Expectation.per_element.values": pixels, "Source.wavelength_nm":
        np.linspace(170, 1200, 1200), "Source.from_arrays.wavelength": np.linspace(170, 1200, 1200),
        "Nuisances.of.sd": {"dark": 0.1}, "Normal.sd": 1.0, "Source.from_library.name": "G2V", "Linear.name": "mine",
        "Instrument.build.values": {}, "model": mauvecl.FlareModel.of(star(), part(), quiet), "kelvin": 9000.0,
        "amplitudes": (0.1,), "continuum": mauvecl.BalmerFlare(9000.0), "frames": flare.recorded_dn[None],
        "measure_along.frames": np.tile(flare.recorded_dn, (3, 1)),
        "fit_cooling.frames": np.tile(flare.recorded_dn, (3, 1)), "fit_cooling.peak_s": 5.0,
    }  # fmt: skip


def functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    for name in mauvecl.__all__:
        thing = getattr(mauvecl, name)
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing) and thing is not InputError:
            if name not in MADE:
                yield name, thing
            for method in (m for m in vars(thing) if not m.startswith("_")):
                plain = inspect.getattr_static(thing, method)
                if isinstance(plain, classmethod | staticmethod):
                    yield f"{name}.{method}", getattr(thing, method)
                elif inspect.isfunction(plain) and name in things():
                    yield f"{name}.{method}", getattr(things()[name], method)
    for name, thing in vars(bulk).items():
        if inspect.isfunction(thing) and thing.__module__ == bulk.__name__ and not name.startswith("_"):
            yield f"bulk.{name}", thing


def parameters() -> list[tuple[str, str]]:
    return [
        (path, p.name)
        for path, function in functions()
        if not path.startswith(INNER)
        for p in inspect.signature(function).parameters.values()
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]


def answer_to(call: Callable[[], Any]) -> str:
    """Return the message of an InputError, or an empty string."""
    try:
        call()
    except (InputError, DeviceError) as error:
        return str(error)
    return ""


@pytest.mark.long
@pytest.mark.parametrize("path", sorted({path for path, _ in parameters()}))
def test_wrong_arguments_raise_one_sentence(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    function = dict(functions())[path]
    known = inspect.signature(function).parameters
    good = {
        p.name: fitting().get(f"{path}.{p.name}", fitting().get(p.name))
        for p in known.values()
        if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }
    if any(p.kind == p.VAR_KEYWORD for p in known.values()) and path.startswith("Pool."):
        good |= {"seed": 1} | ({} if path == "Pool.realise" else {"realisations": 50})
    unknown = [name for name in good if name not in fitting()]
    assert not unknown, "parameters that nobody has a fitting value for"
    for parameter in (name for p, name in parameters() if p == path):
        free = str(known[parameter].annotation) in FREE
        for kind, value in WRONG.items():
            if value is None and (good.get(parameter, 0) is None or "None" in str(known[parameter].annotation)):
                # As if it were not given.
                continue
            told = answer_to(lambda value=value, parameter=parameter: function(**good | {parameter: value}))
            assert told or free or kind not in NEVER, f"{path} takes {kind} for {parameter}"
            assert "\n" not in told, (path, parameter, kind)
