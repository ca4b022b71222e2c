"""Every public function that takes a wavelength, temperature, magnitude, time or count takes it in any fitting unit.

The public names are walked, so that a new function whose parameter's name says one of these fails here until it has a
case, or a reason not to have one.
"""

from __future__ import annotations

import inspect
import pickle
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mauvecl
from mauvecl import bulk
from mauvecl.schema.errors import InputError
from mauvecl.schema.quantities import unit_of

#: What each kind is measured in, and names of parameters that are of it.
UNITS = {
    "nm": ("nm", "Angstrom", "um", "m", "THz", "eV"),
    "K": ("K", "kK", "deg_C"),
    "deg_C": ("deg_C", "K"),
    "mag": ("mag", "mmag"),
    "mag / arcsec2": ("mag / arcsec2", "mag / arcmin2"),
    "s": ("s", "min", "h", "ms"),
    "count": ("",),
    "arcsec2": ("arcsec2", "arcmin2"),
    "pc": ("pc", "lyr"),
    "solRad": ("solRad", "km"),
    "erg": ("erg", "J"),
    "1 / (cm2 s)": ("1 / (cm2 s)", "1 / (m2 s)"),
}
NAMES = re.compile(
    r"wavelength|_nm$|temperature|_k$|_c$|magnitude$|^ebv$|brightness|exposure|_s$|seconds|duration|realisations|^count$"
    r"|^start$|seed|frames|pixels|^bins$|realisation|_arcsec2?$|_pc$|_rsun$|_erg$"
)
#: Made by other public functions, which have cases: arrays and numbers are already in the units of their names.
MADE = ("Expectation", "Source", "Detection", "Sky", "Instrument", "Stare", "TableShape", "EnergyScale", "FlareModel")
REASONS = {
    "Source.read.wavelength_unit": "a unit, no wavelength",
    "Processes.detector_temperature": "a prior, whose ends have cases",
    "Stare.along.start": "a date as text",
    "Stare.along.duration_s": "taken in as that of Stare.of, along an orbit that takes long",
    "Sinusoid.mean_over.start_s": "frames' own arrays",
    "Sinusoid.mean_over.frame_s": "frames' own arrays",
    "TableShape.mean_over.edges_s": "frames' own arrays",
    "TableShape.mean_over.peak_s": "frames' own arrays",
    "TableShape.mean_over.t_half_s": "frames' own arrays",
    "Stares.frames.seed": "as Engine's, on stares that take seconds: tests/device",
    "Stares.frames.count": "as Engine's, on stares that take seconds: tests/device",
    "Engine.statistic_values.seed": "one request with Engine.detect",
    "Engine.statistic_values.start": "one request with Engine.detect",
    "Engine.realise_and_count.seed": "what Engine.realise calls",
    "Engine.realise_and_count.start": "what Engine.realise calls",
    "Engine.realise_and_count.count": "what Engine.realise calls",
    "Detection.of.realisations": "made by Engine.detect",
    "Detection.of.seed": "made by Engine.detect",
    "bulk.draw.start": "hands on to Engine.realise, once whole",
    "bulk.draw.count": "hands on to Engine.realise, once whole",
    "measure_along.frames": "raw counts, as fit takes them",
    "fit_cooling.frames": "raw counts, as fit takes them",
    "FlareModel.of.bands_nm": "pairs of plain numbers, as a study has them",
    "fit.skipped_nm": "pairs of plain numbers, as FlareModel.of takes them",
    "ObservedFlare.wavelength_nm": "as ObservedFlare.from_arrays",
    "ObservedFlare.measured_nm": "made by ObservedFlare.from_arrays",
    "ObservedFlare.read.wavelength_unit": "a unit, no wavelength",
    "ObservedFlare.read.continue_at_k": "handed on to ObservedFlare.from_arrays",
    "fit.frames": "raw DN, as Engine.realise gives them",
    "fit_two_temperatures.frames": "as fit takes them",
    "fit_two_temperatures.skipped_nm": "as fit takes them",
} | {
    f"{name}.{method}.wavelength_nm": "grids of spectra, as Source has them"
    for name in ("BalmerFlare", "Blackbody", "FlareWithLines", "ObservedFlare", "TwoBlackbodies")
    for method in ("flux", "flux_at_telescope", "grid")
}


@dataclass(frozen=True)
class Case:
    """How a parameter is given, between which plain values it is tried, and what must be refused."""

    call: Callable[[Any], Any]
    unit: str
    low: float
    high: float
    refused: tuple[Any, ...] = ()


@cache
def star() -> Any:
    return mauvecl.Source.from_library("G2V").at_magnitude(7.4)


@cache
def payload() -> Any:
    return mauvecl.Instrument.load("mauve").with_(output_min_nm=300.0, output_max_nm=306.0)


@cache
def pair() -> Any:
    return tuple(mauvecl.expect(s, payload(), exposure=5) for s in (star(), star().flaring(0.5)))


@cache
def model(**how: Any) -> Any:
    return mauvecl.FlareModel.of(star(), payload(), pair()[0], **how)


def fitted(**changed: Any) -> Any:
    """Return a joint fit to the means of twenty frames with a flare in the middle."""
    quiet, lit = pair()
    rise = mauvecl.Event(40.0, 30.0, 2.0).form.mean_over(np.arange(21) * 5.0, 40.0, 30.0)
    frames = quiet.recorded_dn + rise[:, None] * (lit.recorded_dn - quiet.recorded_dn)
    how = {"peak_s": 38.0, "half_width_s": 30.0} | changed
    return mauvecl.fit_cooling(frames, quiet, model(), cooling=False, levels=(), **how).estimates


@cache
def engine() -> Any:
    return mauvecl.Engine()


@cache
def found() -> Any:
    return engine().detect(*pair(), realisations=1000, seed=1)


def values_of(answer: Any) -> Any:
    """Something to compare: the numbers behind an answer."""
    if isinstance(answer, mauvecl.Source):
        return answer.flux_flam
    if isinstance(answer, mauvecl.Expectation):
        return np.append(answer.mean_raw_dn, answer.n_frames)
    if isinstance(answer, mauvecl.Detection):
        return np.array([answer.distribution("chi2").mean, answer.realisations])
    if isinstance(answer, mauvecl.Pool):
        return answer.standing.total
    if isinstance(answer, mauvecl.PixelMap):
        return answer.dark
    if isinstance(answer, tuple):
        return np.concatenate([np.ravel(values_of(one)) for one in answer])
    if hasattr(answer, "element") and hasattr(answer, "counts"):
        return answer.element["mean"]
    if hasattr(answer, "exposures") and hasattr(answer, "study"):
        return answer.exposures[0].wavelength_nm
    if hasattr(answer, "observations"):
        return np.asarray(answer.observations[0][2]["raw"])
    return answer


def announced(realisations: Any) -> Any:
    pool = mauvecl.Pool()
    pool.expect(realisations)
    return pool


def few(**changes: Any) -> Any:
    part = {"output_min_nm": 300.0, "output_max_nm": 306.0}
    return mauvecl.Study.build(
        {"star": [{"library": "G2V", "magnitude": 7.4}], "observation": {"changes": part}} | changes, "t"
    )


DRAW = (1, 300)
PHI = np.linspace(1.0, 2.0, 240)
CASES: dict[str, Case] = {
    **{
        f"Instrument.{name}.wavelength_nm": Case(
            lambda v, name=name: getattr(payload(), name)(v), "nm", 201.0, 699.0, (0.3, 5000, 5 * u.um, np.nan)
        )
        for name in ("throughput", "effective_area_cm2", "efficiency", "quantum_efficiency", "electrons_per_joule_cm2")
    },
    "Source.at_magnitude.magnitude": Case(lambda v: star().at_magnitude(v), "mag", -5, 30, (99, np.nan, 7 * u.ABmag)),
    "Source.magnitude": Case(lambda v: star().at_magnitude(v).magnitude(), "mag", -5, 30),
    "Source.binned.width_nm": Case(lambda v: star().binned(v).magnitude("B"), "nm", 0.5, 40, (0.0, 1 * u.um)),
    "Source.flaring.temperature": Case(lambda v: star().flaring(0.1, v), "K", 2000, 50_000, (10, 3 * u.K, -5.0)),
    "Source.flaring.photosphere_temperature": Case(
        lambda v: star().flaring(0.1, geometry="replaces", photosphere_temperature=v), "K", 2000, 9000, (10, 1e6)
    ),
    "Source.from_arrays.wavelength": Case(
        lambda v: mauvecl.Source.from_arrays(v, np.ones(1200)).wavelength_nm[5:8], "nm", np.linspace(170, 1200, 1200), 0
    ),
    "Source.reddened.ebv": Case(lambda v: star().reddened(v), "mag", 0, 3, (-1, 11)),
    "Sky.of_brightness.brightness": Case(
        lambda v: mauvecl.Sky.of_brightness(v).surface_brightness, "mag / arcsec2", 15, 25, (1, 99, 20 * u.mag)
    ),
    "Sky.spectrum.field_of_view_arcsec2": Case(
        lambda v: mauvecl.Sky.of_brightness(22).spectrum(v), "arcsec2", 10, 10_000, (-1, 0.0)
    ),
    "Sky.total_magnitude.field_of_view_arcsec2": Case(
        lambda v: mauvecl.Sky.of_brightness(22).total_magnitude(v), "arcsec2", 10, 10_000, (-1, 0.0)
    ),
    "expect.exposure": Case(lambda v: mauvecl.expect(star(), payload(), exposure=v), "s", 1, 80_000, (0, -1, 1e6)),
    "exposure_for.wavelength_nm": Case(
        lambda v: mauvecl.exposure_for(few(), 1.0, v), "nm", 301, 305, (0.3, 900, 5 * u.um)
    ),
    "simulate.realisation": Case(lambda v: mauvecl.simulate(few(), realisation=v), "count", 0, 10**6, (-1, 0.5)),
    "Comparison.exposures": Case(lambda v: mauvecl.Comparison(v), "count", 0, 1000, (-1, 1.5, 10**9)),
    "CosmicRays.rate_per_cm2_s": Case(
        lambda v: mauvecl.CosmicRays(rate_per_cm2_s=v).rate_per_cm2_s, "1 / (cm2 s)", 0.1, 100, (-1, 1e9)
    ),
    "CosmicRays.with_particles.rate_per_cm2_s": Case(
        lambda v: mauvecl.CosmicRays().with_particles(v).rate_per_cm2_s, "1 / (cm2 s)", 0.1, 100, (-1, 1e9)
    ),
    "Processes.with_particles.rate_per_cm2_s": Case(
        lambda v: mauvecl.Processes().with_particles(v).particles_per_cm2_s, "1 / (cm2 s)", 0.1, 100, (-1, 1e9)
    ),
    "CosmicRays.pixels": Case(lambda v: mauvecl.CosmicRays(pixels=v), "count", 1, 5000, (0, 1.5)),
    "CosmicRays.charge.seconds": Case(lambda v: mauvecl.CosmicRays().charge(v), "s", 1, 500, (-1,)),
    "CosmicRays.most_electrons.seconds": Case(lambda v: mauvecl.CosmicRays().most_electrons(v), "s", 1, 500, (-1,)),
    "Detection.histogram.bins": Case(lambda v: found().histogram("chi2", bins=v)[1], "count", 2, 300, (0, 2.5)),
    "Engine.detect.realisations": Case(
        lambda v: engine().detect(*pair(), realisations=v, seed=1), "count", *DRAW, (0, 1.5)
    ),
    "Engine.detect.seed": Case(
        lambda v: engine().detect(*pair(), realisations=50, seed=v), "count", 0, 10**9, (-1, 2**64)
    ),
    "Engine.detect.start": Case(
        lambda v: engine().detect(*pair(), realisations=50, seed=1, start=v), "count", 0, 10**12, (-1, 2**63)
    ),
    "Engine.snr.realisations": Case(
        lambda v: engine().snr(pair()[0], realisations=v, seed=1), "count", *DRAW, (0, 1.5)
    ),
    "Engine.snr.seed": Case(lambda v: engine().snr(pair()[0], realisations=50, seed=v), "count", 0, 10**9, (-1, 0.5)),
    "Engine.snr.start": Case(
        lambda v: engine().snr(pair()[0], realisations=50, seed=1, start=v), "count", 0, 10**12, (-1,)
    ),
    "Engine.realise.count": Case(lambda v: engine().realise(pair()[0], count=v, seed=1), "count", *DRAW, (0, 1.5)),
    "Engine.realise.seed": Case(lambda v: engine().realise(pair()[0], count=3, seed=v), "count", 0, 10**9, (-1, "a")),
    "Engine.realise.start": Case(
        lambda v: engine().realise(pair()[0], count=3, seed=1, start=v), "count", 0, 10**12, (-1,)
    ),
    "Engine.statistic_values.count": Case(
        lambda v: engine().statistic_values(*pair(), count=v, seed=1), "count", *DRAW, (0, 1.5)
    ),
    "Pool.expect.realisations": Case(announced, "count", 1, 10**9, (0.5, "many")),
    "Pool.realise.count": Case(lambda v: mauvecl.Pool().realise(pair()[0], count=v, seed=1), "count", *DRAW, (0, 1.5)),
    "PixelMap.made_up.pixels": Case(lambda v: mauvecl.PixelMap.made_up(v, seed=1), "count", 1, 5000, (0, 10**9, 1.5)),
    "PixelMap.made_up.seed": Case(lambda v: mauvecl.PixelMap.made_up(50, seed=v), "count", 0, 10**9, (-1, 0.5)),
    "Uniform.low": Case(lambda v: mauvecl.Uniform(v, 99.0).low, "deg_C", -20, 30, (np.nan, np.inf)),
    "Normal.mean": Case(lambda v: mauvecl.Normal(v, 1.0, -99.0, 99.0).mean, "deg_C", -20, 30, (np.nan, np.inf)),
    "Cooling.peak_k": Case(lambda v: mauvecl.Cooling(v, 5000.0, 300.0).peak_k, "K", 6000, 20_000),
    "Cooling.end_k": Case(lambda v: mauvecl.Cooling(20_000.0, v, 300.0).end_k, "K", 4000, 15_000),
    "Cooling.fold_s": Case(lambda v: mauvecl.Cooling(20_000.0, 5000.0, v).fold_s, "s", 10, 5000),
    "Cooling.at.since_peak_s": Case(lambda v: mauvecl.Cooling(20_000.0, 5000.0, 300.0).at(v), "s", 0, 5000),
    "fit_cooling.peak_s": Case(lambda v: fitted(peak_s=v), "s", 20, 60),
    "fit_cooling.half_width_s": Case(lambda v: fitted(half_width_s=v), "s", 20, 60),
    "Event.peak_s": Case(lambda v: mauvecl.Event(v, 60.0, 0.1).peak_s, "s", 0, 5000),
    "Event.half_width_s": Case(lambda v: mauvecl.Event(0.0, v, 0.1).half_width_s, "s", 10, 5000),
    "Event.temperature": Case(lambda v: mauvecl.Event(0.0, 60.0, 0.1, v).temperature, "K", 3000, 30_000),
    **{
        f"Event.{name}.{what}": Case(lambda v, name=name, what=what: _event(name, **{what: v}), unit, low, high)
        for name in ("of_peak", "of_equivalent_duration", "of_energy")
        for what, unit, low, high in (
            ("peak_s", "s", 1, 5000),
            ("half_width_s", "s", 10, 500),
            ("temperature", "K", 3000, 30_000),
        )
    },
    "Event.of_equivalent_duration.equivalent_duration_s": Case(
        lambda v: _event("of_equivalent_duration", first=v), "s", 1, 50
    ),
    "Event.of_energy.energy_erg": Case(lambda v: _event("of_energy", first=v), "erg", 1e32, 1e33),
    "EnergyScale.energy.equivalent_duration_s": Case(lambda v: _scale().energy(v), "s", 1, 500),
    "EnergyScale.equivalent_duration.energy_erg": Case(lambda v: _scale().equivalent_duration(v), "erg", 1e30, 1e33),
    "EnergyScale.of_blackbody.temperature_k": Case(
        lambda v: mauvecl.EnergyScale.of_blackbody(1.0, v).erg_per_s, "K", 3000, 9000
    ),
    "EnergyScale.of_blackbody.radius_rsun": Case(
        lambda v: mauvecl.EnergyScale.of_blackbody(v, 5700.0).erg_per_s, "solRad", 0.2, 3
    ),
    "EnergyScale.of_blackbody.flare_k": Case(
        lambda v: mauvecl.EnergyScale.of_blackbody(1.0, 5700.0, flare_k=v).erg_per_s, "K", 6000, 20_000
    ),
    "EnergyScale.of_star.flare_k": Case(
        lambda v: mauvecl.EnergyScale.of_star(star(), 10.0, flare_k=v).erg_per_s, "K", 6000, 20_000
    ),
    "EnergyScale.of_blackbody.photosphere_k": Case(
        lambda v: mauvecl.EnergyScale.of_blackbody(1.0, 5700.0, geometry="replaces", photosphere_k=v).erg_per_s,
        "K",
        3000,
        8000,
    ),
    "EnergyScale.of_star.photosphere_k": Case(
        lambda v: mauvecl.EnergyScale.of_star(star(), 10.0, geometry="replaces", photosphere_k=v).erg_per_s,
        "K",
        3000,
        8000,
    ),
    "EnergyScale.shibayama2013.radius_rsun": Case(
        lambda v: mauvecl.EnergyScale.shibayama2013(v, 5700.0).erg_per_s, "solRad", 0.2, 3
    ),
    "EnergyScale.shibayama2013.temperature_k": Case(
        lambda v: mauvecl.EnergyScale.shibayama2013(1.0, v).erg_per_s, "K", 3000, 9000
    ),
    "EnergyScale.shibayama2013.flare_k": Case(
        lambda v: mauvecl.EnergyScale.shibayama2013(1.0, 5700.0, flare_k=v).erg_per_s, "K", 6000, 20_000
    ),
    "EnergyScale.of_star.distance_pc": Case(lambda v: mauvecl.EnergyScale.of_star(star(), v).erg_per_s, "pc", 1, 100),
    "Blackbody.temperature_k": Case(lambda v: mauvecl.Blackbody(v).bolometric_flux(), "K", 6000, 20_000),
    "BalmerFlare.temperature_k": Case(lambda v: mauvecl.BalmerFlare(v).bolometric_flux(), "K", 6000, 20_000),
    "BalmerFlare.electron_temperature_k": Case(
        lambda v: mauvecl.BalmerFlare(9000.0, electron_temperature_k=v).bolometric_flux(), "K", 6000, 20_000
    ),
    "TwoBlackbodies.temperature_k": Case(lambda v: mauvecl.TwoBlackbodies(v).bolometric_flux(), "K", 6000, 20_000),
    "TwoBlackbodies.second_temperature_k": Case(
        lambda v: mauvecl.TwoBlackbodies(9000.0, v).bolometric_flux(), "K", 6000, 20_000
    ),
    "ObservedFlare.from_arrays.wavelength_nm": Case(
        lambda v: mauvecl.ObservedFlare.from_arrays(v, np.ones(5)).wavelength_nm,
        "nm",
        np.array([150.0, 300.0, 450.0, 600.0, 800.0]),
        0.0,
    ),
    "ObservedFlare.from_arrays.continue_at_k": Case(
        lambda v: mauvecl.ObservedFlare.from_arrays([150.0, 500.0], [1.0, 1.0], continue_at_k=v).bolometric_flux(),
        "K",
        6000,
        20_000,
    ),
    "FlareModel.of.distance_pc": Case(lambda v: model(distance_pc=v).values(9000.0, [0.1])["area"], "pc", 1, 100),
    "FlareModel.of.radius_rsun": Case(
        lambda v: model(distance_pc=10.0, radius_rsun=v).values(9000.0, [0.1])["filling factor"], "solRad", 0.2, 3
    ),
    "FlareModel.of.electron_temperature_k": Case(
        lambda v: model(jump=True, electron_temperature_k=v).fixed[0], "K", 6000, 20_000
    ),
    "FlareModel.counts.temperature_k": Case(lambda v: model().counts(v, [0.1]), "K", 6000, 20_000),
    "FlareModel.values.temperature_k": Case(lambda v: model().values(v, [0.1])["temperature"], "K", 6000, 20_000),
    "FlareModel.amplitudes.temperature_k": Case(
        lambda v: model(jump=True).amplitudes(v, 0.1, jump=2.0), "K", 6000, 20_000
    ),
    "forecast.temperature_k": Case(lambda v: mauvecl.forecast(pair()[0], model(), v, [0.1]).errors, "K", 6000, 20_000),
    "Sinusoid.period_s": Case(lambda v: mauvecl.Sinusoid(0.1, v).period_s, "s", 100, 9000),
    "Stare.of.duration_s": Case(lambda v: mauvecl.Stare.of(v).start_s[-1], "s", 10, 9000),
    "Stare.of.frame_s": Case(lambda v: mauvecl.Stare.of(600.0, frame_s=v).frame_s, "s", 1, 100),
    "Stare.of.temperature_c": Case(lambda v: mauvecl.Stare.of(600.0, temperature_c=v).temperature_c[0], "deg_C", 0, 25),
    "Stare.of.orbit_s": Case(lambda v: _when(mauvecl.Stare.of(600.0, orbit_s=v)), "s", 3000, 9000),
    **{
        f"Study.at.{quantity}": Case(
            lambda v, quantity=quantity, key=key: _reached(few().at(quantity, v), key), unit, low, high, (np.nan, "x")
        )
        for quantity, key, unit, low, high in (
            ("magnitude", "star.0.magnitude", "mag", 1, 20),
            ("exposure", "observation.exposure_s", "s", 1, 5000),
            ("detector_temperature", "observation.temperature_c", "deg_C", -20, 30),
            ("flare_temperature", "flare.temperature_k", "K", 3000, 30_000),
            ("sky", "sky.surface_brightness", "mag / arcsec2", 15, 25),
        )
    },
}


@cache
def _scale() -> Any:
    return mauvecl.EnergyScale.of_blackbody(1.0, 5772.0)


def _when(stare: Any) -> Any:
    return np.asarray(stare.frame_s)


def _event(name: str, first: Any = None, **changed: Any) -> Any:
    usual = {"of_peak": (0.1,), "of_equivalent_duration": (20.0,), "of_energy": (1e33, _scale())}[name]
    args = usual if first is None else (first, *usual[1:])
    made = getattr(mauvecl.Event, name)(*args, **{"peak_s": 0.0, "half_width_s": 60.0} | changed)
    return np.array([made.peak_s, made.half_width_s, made.amplitude, made.temperature])


def _reached(study: Any, key: str) -> Any:
    for word in key.split("."):
        study = study[int(word)] if word.isdecimal() else getattr(study, word)
    return study


def parameters() -> Iterator[str]:
    """Every parameter of the public names whose own name says a kind."""
    for name in mauvecl.__all__:
        thing = getattr(mauvecl, name)
        functions: dict[str, Any] = {}
        if inspect.isclass(thing) and thing is not InputError:
            if name not in MADE:
                functions[name] = thing
            for method in (m for m in dir(thing) if not m.startswith("_")):
                found = inspect.getattr_static(thing, method)
                found = found.__func__ if isinstance(found, classmethod | staticmethod) else found
                if inspect.isfunction(found) and found.__module__.startswith("mauvecl"):
                    functions[f"{name}.{method}"] = found
        elif inspect.isfunction(thing):
            functions[name] = thing
        for path, function in functions.items():
            yield from (f"{path}.{p}" for p in inspect.signature(function).parameters if NAMES.search(p))
    for name, function in vars(bulk).items():
        if inspect.isfunction(function) and function.__module__ == bulk.__name__ and not name.startswith("_"):
            yield from (f"bulk.{name}.{p}" for p in inspect.signature(function).parameters if NAMES.search(p))


def test_every_public_parameter_has_a_case_or_a_reason() -> None:
    walked = set(parameters())
    assert len(walked) > 40
    ungiven = walked - CASES.keys() - REASONS.keys()
    assert not ungiven, "public parameters that nobody has tried with Quantities"
    stale = REASONS.keys() - walked
    assert not stale, "reasons for what is not there"


@pytest.mark.parametrize("name", CASES)
@settings(max_examples=4, deadline=None)
@given(st.data())
def test_any_fitting_unit_is_the_plain_number(name: str, data: st.DataObject) -> None:
    case = CASES[name]
    if isinstance(case.low, np.ndarray):
        plain: Any = case.low
    elif case.unit == "count":
        plain = data.draw(st.integers(int(case.low), int(case.high)))
    else:
        plain = data.draw(st.floats(case.low, case.high).map(lambda v: float(f"{v:.4g}")))
    wanted = np.asarray(values_of(case.call(plain)))
    assert wanted.dtype != object or wanted.shape == ()
    if case.unit == "count":
        forms = [float(plain), np.int64(plain), plain * u.one, float(plain) * u.dimensionless_unscaled]
    else:
        unit = u.Unit(data.draw(st.sampled_from(UNITS[case.unit])))
        equivalent: Any = u.spectral() if case.unit == "nm" and unit.physical_type != "length" else []
        equivalent = u.temperature() if case.unit in ("K", "deg_C") else equivalent
        if case.unit == "nm" and name == "Source.binned.width_nm":
            # A width has no frequency.
            unit, equivalent = u.um, []
        forms = [(plain * u.Unit(case.unit)).to(unit, equivalent)]
    for form in forms:
        got = np.asarray(values_of(case.call(form)))
        if wanted.dtype == object:
            assert got.item() == wanted.item()
        else:
            np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_what_is_no_such_thing_is_one_sentence(name: str) -> None:
    case = CASES[name]
    wrong = 3 * (u.kg if case.unit != "count" else u.s)
    middle = case.low if isinstance(case.low, np.ndarray) else np.ones(()) * case.low
    for value in (middle * wrong, *case.refused):
        with pytest.raises(InputError, match="expected") as refused:
            case.call(value)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "name", [n for n, f in mauvecl.Instrument.model_fields.items() if f.annotation in (float, int)]
)
def test_an_instrument_is_changed_in_any_unit(name: str) -> None:
    mauve = mauvecl.Instrument.load("mauve")
    value = getattr(mauve, name)
    quantity = value * u.Unit(unit_of(name)) if unit_of(name) else value * u.one
    assert getattr(mauve.with_(**{name: quantity}), name) == pytest.approx(value)
    with pytest.raises(InputError, match=f"{name} = .*, expected"):
        mauve.with_(**{name: 3 * u.kg})


def test_the_reproductions() -> None:
    mauve = mauvecl.Instrument.load("mauve")
    assert mauve.throughput(0.3 * u.um) == pytest.approx(float(mauve.throughput(300.0)))
    assert mauve.effective_area_cm2(0.3 * u.um) == pytest.approx(16.2, rel=0.1)
    assert mauve.with_(temperature_c=13 * u.deg_C) == mauve.with_(temperature_c=13.0)
    assert pickle.loads(pickle.dumps(mauve)) == mauve
