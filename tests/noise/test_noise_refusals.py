"""Bad input of processes and priors: each row is a call, the key that its error names, and facts of its sentence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refusals import Row, check
from scenes import instrument, star

from mauvecl import CosmicRays, Normal, Processes, Stare, Uniform
from mauvecl.device.toy_exposure import toy
from mauvecl.noise.scene import prepare

PAYLOAD = instrument(part=True)


def prior(payload: Any = PAYLOAD, mode: Any = "auto", **how: Any) -> None:
    """Prepare the draws of a star with a prior."""
    observed = {name: how.pop(name) for name in ("magnitude", "exposure") if name in how}
    prepare(star(payload=payload, **observed), mode=mode, processes=Processes(**how))


def too_dark() -> None:
    """Prepare a detector with a pixel beyond the range of the tables."""
    dark = np.where(np.arange(64) == 7, 2e8, 5.0)
    x = replace(toy(64, 1, read=0.7), dark_dn=dark, source_electrons=np.zeros(64), sky_electrons=np.zeros(64))
    prepare([replace(x, adc_max_dn=2**31, saturation_dn=2.0**31)])


def jointly(low: float) -> None:
    """Prepare a joint draw whose dark current may reach that of a temperature."""
    x = toy(8, 1, dark=2225.0, read=2.0, light=0.0)
    prepare([x], processes=Processes(detector_temperature=Uniform(low, 23.0)))


ROWS: list[Row] = [
    (lambda: Uniform(2.0, 1.0), "low", "2"),
    (lambda: Normal(0.0, -1.0, 0.0, 1.0), "sd", "0"),
    (lambda: Normal(1.0, 1e-7, 1.99, 3.0), "low", "9.9e+06", "100000"),
    (lambda: CosmicRays(rate_per_cm2_s=-1.0), "rate_per_cm2_s", "-1"),
    (lambda: CosmicRays(electrons=(900.0, 100.0)), "electrons", "900", "100"),
    (lambda: CosmicRays(electrons=(1, 3), weights=(1.0,)), "weights", "1", "3"),
    (lambda: prior(jitter=Uniform(0.0, 0.9)), "jitter", "0", "0.9"),
    (lambda: prior(light_loss=Uniform(-0.1, 0.5)), "light_loss"),
    (
        lambda: prior(instrument(read_noise_dn=0.1), exposure=5.0, jitter=Uniform(0, 0.05)),
        "jitter",
        "G2V",
    ),
    (
        lambda: prior(mode="stacked", magnitude=3.0, exposure=80_000.0, qe_scale=Uniform(0.5, 1.5)),
        "priors",
        "G2V",
    ),
    (lambda: Stare.of(6000.0, jitters={"star": 0.01}), "jitters", "'star'", "one of light, sky, temperature"),
    (too_dark, "mode", "7", "2e+08"),
    (lambda: jointly(-60.0), "detector_temperature"),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[1])
def test_bad_input_raises(row: Row) -> None:
    check(row)


def test_prior_within_the_tested_region_is_drawn_jointly() -> None:
    jointly(19.0)
