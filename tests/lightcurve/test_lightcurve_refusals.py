"""Bad input to flares, stares and searches raises an InputError that names the parameter and its value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from scenes import instrument, star
from searches import DAVENPORT, KNOWN, ONE

from mauvecl import Study
from mauvecl.device.engine import Engine
from mauvecl.device.stare_engine import Stares
from mauvecl.host.orbit.orbit import Orbit
from mauvecl.host.stars.source import Source
from mauvecl.lightcurve.defaults import per_day
from mauvecl.lightcurve.flares.energies import EnergyScale
from mauvecl.lightcurve.flares.events import Cooling, Event, coefficients, temperatures_of
from mauvecl.lightcurve.flares.rates import PowerLaw, RateTable, davenport2019, fiducial2018, preset
from mauvecl.lightcurve.flares.shapes import Fiducial, TableShape, shape_of
from mauvecl.lightcurve.search.bank import Bank, Baseline
from mauvecl.lightcurve.search.completeness import Completeness, DurationLaw, frame_signal, search_threshold
from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.yields import fit_power_law
from mauvecl.lightcurve.stares.curves import Curve, Sinusoid
from mauvecl.lightcurve.stares.frame_components import Components
from mauvecl.lightcurve.stares.orbit_stare import stare_along
from mauvecl.lightcurve.stares.stare import Stare, StareUnknown
from mauvecl.study.cases import cases

BANK = Bank((20.0,), ONE, DAVENPORT, 5.0, KNOWN)
START = np.arange(20) * 5.0
TWO = np.array([0.0, 1.0])


def step(*probability: float, energy: tuple[float, ...] = (1e31, 1e33)) -> Completeness:
    return Completeness(np.array(energy), np.array(probability), "Kepler", "a test")


def along(target: str, duration_s: float = 7200.0, **changed: Any) -> Any:
    return stare_along(Orbit.load(), target, "2026-09-20T03:00:00", duration_s, **changed)


CALLS: dict[str, tuple[Callable[[], Any], str]] = {
    "shape": (lambda: shape_of("gauss"), "shape"),
    "shape of an event": (lambda: Event(0.0, 60.0, 0.1, shape="box"), "shape"),
    "times of a shape": (lambda: TableShape(np.zeros(2), np.ones(2)), "tau"),
    "values of a shape": (lambda: TableShape(TWO, np.array([-1.0, 1.0])), "values"),
    "one point of a shape": (lambda: TableShape(np.zeros(1), np.ones(1)), "values"),
    "zeros of a shape": (lambda: TableShape(TWO, np.zeros(2)), "values"),
    "equivalent duration": (lambda: Fiducial.of(-1.0), "equivalent_duration_s"),
    "peak": (lambda: Event(np.nan, 60.0, 0.1), "peak_s"),
    "half width": (lambda: Event(0.0, 0.0, 0.1), "half_width_s"),
    "half width of a duration": (
        lambda: Event.of_equivalent_duration(3.0, peak_s=0.0, half_width_s=0.0), "half_width_s"
    ),
    "amplitude": (lambda: Event(0.0, 60.0, -0.1), "amplitude"),
    "flare temperature": (lambda: Event(0.0, 60.0, 0.1, 10.0), "temperature"),
    "temperatures": (lambda: temperatures_of([Event(0.0, 60.0, 0.1, 5e3 + k) for k in range(9)]), "events"),
    "cooling": (lambda: Cooling(6000.0, 9000.0, 60.0), "end_k"),
    "temperature nodes": (
        lambda: coefficients([Event(0.0, 60.0, 0.1)], START, 5.0, np.array([6000.0])), "temperature"
    ),
    "radius": (lambda: EnergyScale.of_blackbody(0.0, 5778.0), "radius_rsun"),
    "photosphere": (lambda: EnergyScale.of_blackbody(1.0, 10.0), "temperature_k"),
    "flare_k": (lambda: EnergyScale.of_blackbody(1.0, 5778.0, flare_k=10.0), "flare_k"),
    "band": (lambda: EnergyScale.of_blackbody(1.0, 5778.0, band="Q"), "band"),
    "distance": (lambda: EnergyScale.of_star(Source.from_library("G2V"), -1.0), "distance_pc"),
    "energy": (lambda: EnergyScale.of_blackbody(1.0, 5778.0).equivalent_duration(0.0), "energy_erg"),
    "exponent of rates": (lambda: PowerLaw(alpha=0.5, log10_beta=30.0), "alpha"),
    "undefined rates": (lambda: PowerLaw(alpha=2.0, log10_beta=np.nan), "log10_beta"),
    "largest energy": (lambda: PowerLaw(alpha=2.0, log10_beta=30.0, largest_erg=0.0), "largest_erg"),
    "measured energies": (lambda: PowerLaw(alpha=2.0, log10_beta=30.0, measured_erg=(2.0, 1.0)), "measured_erg"),
    "scatter of rates": (lambda: PowerLaw(alpha=2.0, log10_beta=30.0, scatter_dex=9.0), "scatter_dex"),
    "rate at an energy": (lambda: PowerLaw.through(2.0, 1e32, 0.0), "per_day"),
    "exponent through a rate": (lambda: PowerLaw.through(0.5, 1e32, 1.0), "alpha"),
    "rising rates": (lambda: davenport2019(mass_msun=2.0, age_myr=10.0), "mass_msun"),
    "Si IV light": (lambda: fiducial2018(0.0), "quiescent_si_iv_erg_s"),
    "preset": (lambda: preset("B"), "preset"),
    "no false alarms": (lambda: per_day(0.0, "day"), "false_alarms"),
    "undefined false alarms": (lambda: per_day(float("nan"), "year"), "false_alarms"),
    "false alarms per week": (lambda: per_day(1.0, "week"), "per"),
    "exponent of durations": (lambda: DurationLaw(exponent=2.0), "exponent"),
    "scatter of durations": (lambda: DurationLaw(scatter_dex=9.0), "scatter_dex"),
    "half width of durations": (lambda: DurationLaw(half_width_s=0.0), "half_width_s"),
    "slope of a baseline": (lambda: Baseline(offset=False, slope=True), "slope"),
    "window of a baseline": (lambda: Baseline(window_s=-1.0), "window_s"),
    "half widths of a bank": (lambda: Bank((2.0, 1.0), ONE, DAVENPORT, 5.0, KNOWN), "half_widths_s"),
    "frames of a bank": (lambda: Bank((20.0,), ONE, DAVENPORT, 0.0, KNOWN), "frame_s"),
    "directions of a bank": (lambda: Bank((20.0,), 0 * ONE, DAVENPORT, 5.0, KNOWN), "directions"),
    "bank of other frames": (lambda: Search(Bank((20.0,), ONE, DAVENPORT, 4.0, KNOWN), Stare.of(500.0)), "frame_s"),
    "curves without a cycle": (lambda: Search(BANK, Stare.of(500.0), np.ones((1, 100))), "curves"),
    "shape of sums": (lambda: Search(BANK, Stare.of(500.0)).largest(np.zeros((1, 3, 1))), "sums"),
    "no rate": (lambda: search_threshold(0.0), "false_alarms_per_day"),
    "high rate": (lambda: search_threshold(1e6), "false_alarms_per_day"),
    "low rate": (lambda: search_threshold(1e-99), "false_alarms_per_day"),
    "probabilities": (lambda: step(0.0, 1.5), "probability"),
    "number of probabilities": (lambda: step(0.0, 0.5, 1.0), "probability"),
    "energies of a completeness": (lambda: step(0.0, 1.0, energy=(1e33, 1e31)), "energy_erg"),
    "two flares": (lambda: fit_power_law(np.array([1e33, 1e34]), step(0.0, 1.0), 10.0), "energy_erg"),
    "no days": (lambda: fit_power_law(np.array([1e33, 1e34, 1e35]), step(0.0, 1.0), 0.0), "days"),
    "frames of a signal": (lambda: frame_signal(*cases(Study(), swept=False)[1].expectations[:2]), "n_frames"),
    "duration": (lambda: Stare.of(-5), "duration_s"),
    "many frames": (lambda: Stare.of(1e12), "duration_s"),
    "gaps without frames": (lambda: Stare.of(100, gaps=[(0, 100)]), "gaps"),
    "gap backwards": (lambda: Stare.of(100, gaps=[(50, 40)]), "gaps"),
    "jitter of": (lambda: Stare.of(100, jitters={"star": 0.1}), "jitters"),
    "large jitter": (lambda: Stare.of(100, jitters={"light": 0.5}), "light_jitter"),
    "large drift": (lambda: Stare.of(86_400, drifts={"light": 0.05}), "light_drift"),
    "offset of": (lambda: Stare.of(100, offsets={"dark": 0.1}), "offsets"),
    "orbit": (lambda: Stare.of(100, orbit_s=0.0), "orbit_s"),
    "period": (lambda: Sinusoid(1.0, -3.0), "period_s"),
    "times of a curve": (lambda: Curve(points=((1.0, 0.0), (1.0, 0.0))), "points"),
    "number of points": (lambda: Curve(points=((0.0, 1.0),)), "points"),
    "undefined value": (lambda: Curve(points=((0.0, 1.0), (1.0, np.nan))), "points.1.1"),
    "standard deviation": (lambda: StareUnknown("x", "light", 0.0, np.ones(2)), "x"),
    "start of frames": (lambda: Stare(np.array([0.0, 7.0]), 5.0, *[np.ones(2)] * 4), "start_s"),
    "number of frames": (lambda: Stare(np.array([0.0, 5.0]), 5.0, *[np.ones(3)] * 4), "star"),
    "unseen target": (lambda: along("Vega"), "target"),
    "gaps along the orbit": (lambda: along("eps Eri", gaps=[(0, 10)]), "gaps"),
    "duration along the orbit": (lambda: along("eps Eri", -1.0), "duration_s"),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_bad_input_raises(name: str) -> None:
    call, key = CALLS[name]
    with refused(key):
        call()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("energy,rate\n1e31,1\n1e32,2\n", "per_day"),
        ("energy,rate\n1e32,2\n1e31,1\n", "energy_erg"),
        ("energy,number\n1e32,2\n", "columns"),
        ("energy,rate\n1e32,a\n1e33,b\n", "rate"),
        ("energy,rate\n1e32,1\n", "per_day"),
    ],
)
def test_bad_tables_of_rates_raise(tmp_path: Path, text: str, key: str) -> None:
    (tmp_path / "own.csv").write_text(text)
    with refused(key):
        RateTable.read(tmp_path / "own.csv")


def test_bad_requests_for_frames_raise(engine: Engine) -> None:
    stares = Stares(engine.open_device)
    payload = instrument(part=True)
    quiet, flare = star(amplitudes=(1.0,), exposure=5.0, payload=payload)
    n = quiet.wavelength_nm.size
    one, ones = np.ones((1, n)), np.ones((10, 1))
    stare, components = Stare.of(50.0), Components.of(quiet, [flare], one)
    twice, many = (Components.of(quiet, [flare], rows) for rows in (np.vstack([one, 2 * one]), np.eye(n)[:9]))
    cases: list[tuple[str, Components, Stare, Any, dict[str, Any]]] = [
        ("seed", components, stare, None, {"seed": -1}),
        ("count", components, stare, None, {"count": 0}),
        ("method", components, stare, None, {"method": "frames"}),
        ("flare", components, stare, ones[1:], {}),
        ("flare_coefficients", components, stare, -ones, {}),
        ("amplitudes", components, stare, ones, {"amplitudes": np.ones(3)}),
        ("frame_s", components, Stare.of(40.0, frame_s=4.0), None, {}),
        ("light", components, Stare.of(50.0, jitters={"light": 0.15}), None, {}),
        ("flare", components, stare, 1e9 * ones, {}),
        ("method", components, stare, 4000 * ones, {"method": "cumulants"}),
        ("weights", twice, stare, None, {"method": "cumulants"}),
        ("weights", many, stare, None, {}),
    ]
    for key, *given, how in cases:
        with refused(key):
            stares.frames(*given, **({"seed": 1} | how))
    with refused("n_frames", value=10):
        Components.of(replace(quiet, n_frames=10), [], one)
    with refused("weights", value=(1, 3)):
        Components.of(quiet, [], np.ones((1, 3)))
