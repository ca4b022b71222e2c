"""Statistics marginalised over what is unknown or drawn: drawn on the device, and compared with closed forms."""

import numpy as np
import pytest
from scenes import star

from mauvecl import Engine, Linear, Normal, Nuisances, Processes, Uniform

FREE = float("inf")


def _prior(centre: float, sd: float) -> Normal:
    return Normal(centre, sd, centre - 5 * sd, centre + 5 * sd)


#: Star, flares, marginalised and drawn unknowns, with Gaussian and other priors.
DRAWN = {
    "half a degree": (("G2V", 7.4, (0.1, 0.02)), {"dark": 0.5}, Processes(detector_temperature=_prior(21.0, 0.5))),
    "half a degree, projected out": (
        ("G2V", 7.4, (0.1, 0.02)), {"dark": FREE}, Processes(detector_temperature=_prior(21.0, 0.5))
    ),
    "light of a bright star": (
        ("K3V", 3.7, (0.003, 0.0003)),
        {"light": 0.02},
        # Together 2 %.
        Processes(qe_scale=_prior(1.0, 0.0173), light_loss=Uniform(0.3286, 0.3514)),
    ),
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

    Some 40 values in each of five cases, many of them tied: by chance less than one run in 1000 fails.
    """
    (name, magnitude, amplitudes), nuisances, processes = DRAWN[case]
    quiet, *flares = star(name, magnitude, amplitudes=amplitudes)
    n = 100_000
    n_pixel = quiet.wavelength_nm.size
    names = ("chi2", "chi2_element", "matched", "uv_excess", "own")
    statistics = (*names[:-1], Linear("own", 1.0 + np.arange(n_pixel) / n_pixel))
    how = {"nuisances": nuisances, "processes": processes, "statistics": statistics}
    found = engine.detect(quiet, flares, realisations=n, seed=3, **how)
    powers = []
    for statistic in names:
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


def test_light_of_unknowns_is_separated_from_a_flare() -> None:
    """Of data without noise all amplitudes with flat priors are found; with noise, none is biased by the flare."""
    rng = np.random.default_rng(8)
    spectra, flare, variance = rng.uniform(1, 2, (2, 50)), rng.uniform(0, 5, 50), rng.uniform(4, 9, 50)
    unknown = Nuisances(("dark", "light"), spectra, np.array([np.inf, np.inf]))
    variance[:5] = np.inf
    light = np.array([30.0, -7.0]) @ spectra
    np.testing.assert_allclose(unknown.fitted_dn(light + 3.0 * flare, variance, flare), light, rtol=1e-9)
    # A prior that excludes the level keeps it away.
    known = Nuisances(("dark", "light"), spectra, np.array([1e-9, 1e-9]))
    np.testing.assert_allclose(known.fitted_dn(light + 3.0 * flare, variance, flare), 0.0, atol=1e-9)
