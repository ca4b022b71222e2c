"""Processes in stares are drawn as in exposures; what cannot be drawn is in the table of refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from answers import small
from refusals import refused

from mauvecl import Engine, Stares, Study, plan, simulate, stare

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
    star, stare = [{"library": "G2V", "magnitude": 6.0}], {"duration_s": 5.0}
    return small(star=star, sky=BRIGHT, observation={"exposure_s": 5.0}, stare=stare, **processes)


def frames(study: Study, count: int, **how: Any) -> Any:
    """Draw the total of the only frame of many stares."""
    staring = stare(study).stares[0].staring
    components = staring.components(np.ones((1, staring.quiet.wavelength_nm.size)))
    return Stares().frames(components, staring.stare, count=count, **how)[:, 0, 0]


def test_every_process_has_a_prior() -> None:
    assert {*PRIORS, "cosmic_rays"} == {name for name, _ in Study().processes}


@pytest.mark.parametrize("name", PRIORS)
def test_stare_draws_prior_as_exposure_does(engine: Engine, name: str) -> None:
    """Compare moments of a frame's total: five standard errors of twelve comparisons fail once in 1e5."""
    study = asked(name, PRIORS[name])
    quiet = simulate(study).observations[0][1]
    exposures = engine.realise(quiet, count=N, seed=3, processes=study.processes).sum(axis=1) - quiet.mean_raw_dn.sum()
    found = frames(study, N, seed=4)
    assert exposures.std() > 3 * np.sqrt(quiet.unsaturated_variance_dn2.sum())
    assert abs(found.mean() - exposures.mean()) < 5 * np.hypot(found.std(), exposures.std()) / np.sqrt(N)
    assert abs(np.log(found.std() / exposures.std())) < 5 / np.sqrt(N)


def test_stare_draws_cosmic_rays() -> None:
    rays = asked("cosmic_rays", {})
    drawn, plain = frames(asked(None), 50, seed=1, processes=rays.processes), frames(asked(None), 50, seed=1)
    assert (drawn != plain).any()
    assert (drawn >= plain - 1.0).all()
    flux, without = (
        stare(study.with_settings(["stare.duration_s=600"])).stares[0].light.flux for study in (rays, asked(None))
    )
    assert (flux != without).any()


def test_spreads_of_process_and_stare_add_in_quadrature() -> None:
    study = asked("qe_scale", PRIORS["qe_scale"]).with_settings(["stare.offsets={light=0.1}"])
    found = stare(study).stares[0].staring.stare
    (unknown,) = found.unknowns
    assert unknown.name == "light offset"
    assert unknown.sd == pytest.approx(np.hypot(0.1, 0.1 / 1.1))
    assert found.light == pytest.approx(1.1)


@pytest.mark.parametrize("name", PRIORS)
def test_closed_form_of_plan_refuses_priors(name: str) -> None:
    settings = ["plan.targets=[{name = 'eps Eri'}]", "orbit.days=10", "plan.completeness='closed form'"]
    with refused(f"processes.{name}", expected="'injections'"):
        plan(asked(name, PRIORS[name]).with_settings(settings))
