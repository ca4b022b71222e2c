"""Processes in stares: each is drawn as in exposures, or refused with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from answers import small
from refusals import refused

from mauvecl.answers.campaigns.plan import plan
from mauvecl.device.engine import Engine
from mauvecl.device.stare_engine import Stares
from mauvecl.lightcurve.stares.frame_components import Components
from mauvecl.noise.unknowns import ADDITIVE, PROCESSES
from mauvecl.study.cases import cases
from mauvecl.study.study import Study

#: Normal priors whose effect exceeds the noise of a frame's total light; the cuts are five standard deviations away.
PRIORS = {
    "jitter": {"normal": [0.25, 0.05], "between": [0.0, 0.5]},
    "detector_temperature": {"normal": [20.0, 1.0], "between": [15.0, 25.0]},
    "light_loss": {"normal": [0.4, 0.06], "between": [0.1, 0.7]},
    "pointing_loss": {"normal": [0.3, 0.05], "between": [0.05, 0.55]},
    "qe_scale": {"normal": [1.1, 0.1], "between": [0.6, 1.6]},
    "sky_level": {"normal": [1.2, 0.15], "between": [0.45, 1.95]},
}
#: Sky that is bright enough for its level to be seen.
BRIGHT = {"surface_brightness": 12.0}
N = 4000


def asked(name: str | None, prior: object = None) -> Study:
    processes = {} if name is None else {"processes": {name: prior}}
    return small(
        star=[{"library": "G2V", "magnitude": 6.0}],
        sky=BRIGHT,
        observation={"exposure_s": 5.0},
        stare={"duration_s": 5.0},
        **processes,
    )


def test_every_process_has_a_prior() -> None:
    assert PRIORS.keys() == PROCESSES.keys()


@pytest.mark.parametrize("name", PRIORS)
def test_stare_draws_prior_as_exposure_does(engine: Engine, name: str) -> None:
    """Compare moments of a frame's total: five standard errors of twelve comparisons fail once in 1e5."""
    (case,) = cases(asked(name, PRIORS[name]))
    quiet = case.quiet
    exposures = engine.realise(quiet, count=N, seed=3, processes=case.processes).sum(axis=1) - quiet.mean_raw_dn.sum()
    components = Components.of(quiet, [], np.ones((1, quiet.wavelength_nm.size)))
    frames = Stares(engine.open_device).frames(components, case.stare, count=N, seed=4)[:, 0, 0]
    plain = np.sqrt(quiet.unsaturated_variance_dn2.sum())
    assert exposures.std() > 3 * plain
    assert abs(frames.mean() - exposures.mean()) < 5 * np.hypot(frames.std(), exposures.std()) / np.sqrt(N)
    assert abs(np.log(frames.std() / exposures.std())) < 5 / np.sqrt(N)


@pytest.mark.parametrize("name", ADDITIVE)
def test_stare_draws_additive_processes(engine: Engine, name: str) -> None:
    (with_charge,), (without,) = cases(asked(name, {})), cases(asked(None))
    components = Components.of(without.quiet, [], np.ones((1, without.quiet.wavelength_nm.size)))
    stares = Stares(engine.open_device)
    drawn, plain = (
        stares.frames(components, case.stare, count=50, seed=1, processes=case.processes.additive_only)
        for case in (with_charge, without)
    )
    assert (drawn != plain).any()
    assert (drawn >= plain - 1.0).all()


@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("prior", [{"uniform": [0.1, 0.4]}, {"normal": [0.25, 0.1], "between": [0.0, 0.5]}])
def test_prior_that_is_not_normal_is_refused(name: str, prior: dict[str, list[float]]) -> None:
    (case,) = cases(asked(name, prior))
    with refused(f"processes.{name}"):
        _ = case.stare


def test_spreads_of_process_and_stare_add_in_quadrature() -> None:
    (case,) = cases(asked("qe_scale", PRIORS["qe_scale"]).with_settings(["stare.offsets={light=0.1}"]))
    (unknown,) = case.stare.unknowns
    assert unknown.name == "light offset"
    assert unknown.sd == pytest.approx(np.hypot(0.1, 0.1 / 1.1))
    assert case.stare.light == pytest.approx(1.1)


@pytest.mark.parametrize("name", PRIORS)
def test_closed_form_of_plan_refuses_priors(name: str) -> None:
    settings = ["plan.targets=[{name = 'eps Eri'}]", "orbit.days=10", "plan.completeness='closed form'"]
    with refused(f"processes.{name}", expected="'injections'"):
        plan(asked(name, PRIORS[name]).with_settings(settings))
