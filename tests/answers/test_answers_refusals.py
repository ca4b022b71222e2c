"""Questions without an answer raise an InputError that names the parameter or the key of the study."""

from __future__ import annotations

from typing import Any

import pytest
from refusals import refused

import mauvecl
from mauvecl import Engine, Stares, Study
from mauvecl.noise.unknowns import PROCESSES

FEW = ["star=[{library='G2V', magnitude=7.4}]", "run={realisations=10_000, fap=0.01, statistics=['matched']}"]
LIMIT = ["flare.amplitudes=[0.24]"]
SIZES = "injections.of=energy"
PLAN = ["orbit.days=1", "plan.completeness='closed form'"]

#: Verb, settings, and the key that the error names.
QUESTIONS: list[tuple[str, list[str], str]] = [
    ("exposure", ["signal.wavelength_nm=300"], "signal.snr"),
    ("exposure", ["signal.snr=10"], "signal.wavelength_nm"),
    ("exposure", ["signal={snr=10, wavelength_nm=900}"], "wavelength"),
    ("exposure", ["signal={snr=1e9, wavelength_nm=300}"], "signal.snr"),
    ("limit", [*LIMIT, "flare.amplitudes=[1e-6]"], "limit.of"),
    ("limit", [*LIMIT, "run.fap=1e-4"], "fap"),
    ("limit", [*LIMIT, "sweep.axes=[{quantity='magnitude', values=[6, 9]}]"], "sweep"),
    ("detect", ["processes.jitter={uniform=[0, 0.9]}"], "jitter"),
    ("detect", ["campaign={frames=100, alarms=100}"], "campaign.alarms"),
    ("inject", ["search.cycle=true"], "search.cycle"),
    ("inject", ["injections.low=1e40"], "injections.low"),
    ("measure", ["flare.geometry=replaces"], "flare.geometry"),
    ("measure", ["flare.amplitudes=[0.5, 0.0]"], "flare.amplitudes"),
    ("inject", [SIZES], "injections.of"),
    ("inject", ["sweep.axes=[{quantity='amplitude', values=[0.1]}]"], "sweep"),
    ("stare", ["stare.gaps=[[20, 10]]"], "gaps"),
    ("stare", ["stare={duration_s=100, gaps=[[0, 100]]}"], "gaps"),
    ("stare", ["stare.energies_erg=[1e33]"], "events.energy_erg"),
    ("stare", ["stare.bands_nm=[[10, 20]]"], "bands_nm"),
    ("stare", ["stare.jitters.star=0.1"], "jitters"),
    ("stare", ["events=[{peak_s=1e9, half_width_s=100}]"], "peak_s"),
    ("stare", ["stare.duration_s=2e7"], "stare.duration_s"),
    ("stare", ["stare.duration_s=1e12"], "duration_s"),
    ("stare", ["sweep.axes=[{quantity='exposure', values=[5, 50]}]"], "sweep"),
    (
        "stare",
        ["sweep.axes=[{quantity='flare_temperature', values=[6e3, 9e3]}]", "events=[{peak_s=1, temperature_k=9e3}]"],
        "sweep",
    ),
    ("visible", ["orbit.targets=['eps Eri', 'eps Eri']"], "orbit.targets"),
    ("visible", [], "orbit.targets"),
    ("visible", ["orbit.targets=['eps Eri']", "orbit.start=someday"], "time"),
    ("visible", ["orbit.targets=['eps Eri']", "orbit.step_s=0.001"], "step_s"),
    ("plan", PLAN, "plan.targets"),
    ("plan", [*PLAN, "plan.targets=[{name='eps Eri'}]", "orbit.targets=['eps Eri']"], "orbit.targets"),
    ("plan", [*PLAN, "plan.targets=[{name='new', coordinates='10 5'}]"], "plan.targets"),
    ("plan", [*PLAN, "plan.targets=[{name='eps Eri', mass_msun=9, age_myr=500}]"], "mass_msun"),
]
QUESTIONS += [
    (verb, [f"processes.{name}={{uniform=[0.9, 1.0]}}", *more], f"processes.{name}")
    for verb, more in (("stare", []), ("inject", []), ("plan", [*PLAN, "plan.targets=[{name='eps Eri'}]"]))
    for name in PROCESSES
]


@pytest.mark.parametrize(("verb", "settings", "key"), QUESTIONS)
def test_bad_input_raises(engine: Engine, verb: str, settings: list[str], key: str) -> None:
    drawing: Any = Stares(engine.open_device) if verb in ("stare", "inject") else engine
    study = Study().with_settings(FEW + settings)
    with refused(key):
        getattr(mauvecl, verb)(study, None if verb == "plan" else drawing)
