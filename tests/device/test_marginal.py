"""Marginalised statistics on the device, compared with closed forms."""

import numpy as np
import pytest
from scenes import star

from mauvecl import Engine, Normal, Processes, Uniform

FREE = float("inf")


def _prior(centre: float, sd: float) -> Normal:
    return Normal(centre, sd, centre - 5 * sd, centre + 5 * sd)


#: Star, flares, marginalised and drawn unknowns, with Gaussian and other priors.
DRAWN = {
    "half a degree": (("G2V", 7.4, (0.1, 0.02)), {"dark": 0.5}, Processes(detector_temperature=_prior(21.0, 0.5))),
    "half a degree, projected out": (
        ("G2V", 7.4, (0.1, 0.02)), {"dark": FREE}, Processes(detector_temperature=_prior(21.0, 0.5))
    ),
    "light of a bright star": (("K3V", 3.7, (0.003, 0.0003)), {"light": 0.02}, Processes(qe_scale=_prior(1.0, 0.02))),
    "all that is usual": (
        ("G2V", 7.4, (0.1, 0.02)),
        {"dark": FREE, "light": FREE, "sky": 0.1, "tilt": FREE},
        Processes(jitter=Uniform(0.0, 0.05), detector_temperature=_prior(21.0, 0.5), sky_level=_prior(1.0, 0.1)),
    ),
    "uniform light": (("K3V", 5.0, (0.01, 0.001)), {"light": 0.09}, Processes(light_loss=Uniform(0.24, 0.44))),
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("case", DRAWN)
def test_closed_forms_integrate_over_drawn_unknowns(engine: Engine, case: str) -> None:
    """Compare false alarms and detections at the closed forms' thresholds, within 4.5 standard errors and 1e-5.

    Some 30 values in each of five cases, many of them tied: by chance less than one run in 1000 fails.
    """
    (name, magnitude, amplitudes), nuisances, processes = DRAWN[case]
    quiet, *flares = star(name, magnitude, amplitudes=amplitudes)
    n = 100_000
    statistics = ("chi2", "chi2_element", "matched", "uv_excess")
    how = {"nuisances": nuisances, "processes": processes, "statistics": statistics}
    found = engine.detect(quiet, flares, realisations=n, seed=3, **how)
    powers = []
    for statistic in statistics:
        for flare in range(len(flares)):
            cut = found.closed_form(statistic, template=flare).isf(0.01)
            alarms = found.false_alarm_probability(cut, statistic, template=flare).value
            assert abs(alarms - 0.01) < 4.5 * np.sqrt(0.01 * 0.99 / n)
            power = found.closed_form(statistic, flare).sf(cut)
            seen = found.distribution(statistic, flare).above(cut) / n
            assert abs(seen - power) < 4.5 * np.sqrt(power * (1 - power) / n) + 1e-5
            powers.append(power)
    # Some of the closed forms are defined.
    assert sum(0.05 < power < 0.99 for power in powers) >= 2
