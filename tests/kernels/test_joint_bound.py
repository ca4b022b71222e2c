"""The joint draw in the whole region that its condition allows; a search finds the worst corners."""

from __future__ import annotations

from dataclasses import dataclass, replace

import exact
import numpy as np
import pytest
from refusals import refused
from scenes import instrument, star
from scipy import optimize

from mauvecl.device.toy_exposure import toy
from mauvecl.noise import reference
from mauvecl.noise.cumulants import (
    DRAWS_TO_NOTICE,
    Cumulants,
    joint_is_exact,
    needs_fourth_power,
    polynomial,
    truncation_distance,
)
from mauvecl.noise.processes import Processes, Uniform
from mauvecl.noise.scene import prepare

#: By exact convolution no allowed draw can be distinguished with fewer draws. The estimate of the condition is right to
#: 4 % there.
SOONEST = 4e13
#: Nor is a tail between 5 and 6 sigma further from the exact one than this share of it (a longer search finds .0046).
TAIL = 5e-3


@dataclass(frozen=True)
class Noise:
    """Noise of a pixel: Gaussian noise (DN), Poisson dark and light with their steps, and the phase within a DN."""

    read: float
    dark: float
    dark_step: float
    light: float
    light_step: float
    phase: float

    @classmethod
    def at(cls, point: np.ndarray) -> Noise:
        """Return the noise at a point, in decades: Gaussian over Poisson step, step, dark, ratio of light, light."""
        over, step, dark, ratio, light = 10.0 ** point[:5]
        return cls(over * step * max(1.0, ratio), dark, step, light if point[4] > -4 else 0.0, step * ratio, point[5])

    @property
    def cumulants(self) -> Cumulants:
        one = np.ones(1)
        return Cumulants(
            mean=self.phase * one,
            gaussian=self.read**2 * one,
            photons=self.light * one,
            photon_step=self.light_step * one,
            dark_step=self.dark_step * one,
            dark_dn=self.dark * self.dark_step * one,
            light_dn=self.light * self.light_step * one,
            light_variance=self.light * self.light_step**2 * one,
        )

    def both(self, *, varying: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the exact probabilities of whole DN, and those of the polynomial that the kernels evaluate."""
        c = self.cumulants
        sd = float(np.sqrt(c.variance[0]))
        shape = [float(a[0]) / sd for a in polynomial(c)]
        if not needs_fourth_power(c, varying=varying):
            shape[4] = 0.0
            if varying:  # no third-order term at all
                g3 = float(c.shape()[0][0])
                shape[0], shape[2] = -g3 / 6, g3 / 6
        half = int(9 * sd) + 6
        poisson = [(self.dark, self.dark_step), (self.light, self.light_step)]
        p = exact.counts(self.read**2, poisson, self.phase, -half, 2 * half)
        return p, exact.of_polynomial(shape, sd, self.phase, -half, 2 * half)


BOUNDS = [(np.log10(1.5), 1.5), (-0.5, 0.5), (-2.5, 3.3), (-1.0, 1.0), (-4.5, 3.3), (0.0, 1.0)]


@pytest.mark.long
@pytest.mark.parametrize("varying", [False, True], ids=["steady", "factors on light and dark"])
@pytest.mark.parametrize("what", ["Pearson", "tails"])
def test_worst_draws_that_the_region_allows(what: str, varying: bool) -> None:
    """Search all jointly drawn cases for the smallest number of draws that shows a difference, and the worst tail."""
    tried = 0

    def merit(point: np.ndarray) -> float:
        nonlocal tried
        noise = Noise.at(point)
        if not joint_is_exact(noise.cumulants)[0]:
            return 30.0
        tried += 1
        p, q = noise.both(varying=varying)
        return float(np.log10(exact.draws_to_tell(p, q)) if what == "Pearson" else -exact.worst_tail(p, q))

    found = optimize.differential_evolution(merit, BOUNDS, rng=1, popsize=12, maxiter=25, polish=False)
    assert tried > 500
    if what == "Pearson":
        assert SOONEST < 10**found.fun < 1.2 * DRAWS_TO_NOTICE  # and the search did find the border
    else:
        assert TAIL / 4 < -found.fun < TAIL


@pytest.mark.parametrize("name", ["mauve", "mauve-electrons"])
def test_nominal_payload_at_all_settings(name: str) -> None:
    """Check nine temperatures and 1 to 100 frames: none is distinguishable before 5e13 draws by the estimate."""
    below = 0
    for temperature in (-40, -30, -20, -9, 0, 9, 15, 21, 25):
        (x,) = star(payload=instrument(name, temperature_c=float(temperature)), exposure=5.0)
        for frames in (1, 2, 10, 100):
            c = Cumulants.of(x, frames)
            assert joint_is_exact(c).all()
            distance = truncation_distance(c, fourth_power=needs_fourth_power(c))
            draws = (5 * np.sqrt(2 * 15.3 * np.sqrt(c.variance)) / distance).min()
            assert draws > 5e13
            below += draws < 1e14
    assert below == {"mauve": 2, "mauve-electrons": 3}[name]


def test_smallest_poisson_means() -> None:
    """Check 1.5 DN of noise with .14 counts, where gamma_3 is small but 2e9 draws show a tail off by a fifth."""
    noise = Noise(1.5, 0.14, 1.0, 0.0, 1.0, 0.37)
    p, q = noise.both(varying=False)
    assert noise.cumulants.shape()[0][0] < 0.04
    assert exact.draws_to_tell(p, q) < 5e9
    assert exact.worst_tail(p, q) > 0.1
    assert not joint_is_exact(noise.cumulants)[0]
    x = toy(8, 1, dark=0.14, read=1.5, light=0.0)
    assert not prepare([x]).joint
    with refused("recipe", "'joint'"):
        prepare([x], recipe="joint")
    with refused("qe_scale"):
        prepare([x], processes=Processes(qe_scale=Uniform(0.9, 1.1)))


@pytest.mark.parametrize("quartic", [False, True])
def test_factors_follow_the_cumulants(quartic: bool) -> None:
    """Compare the reference's draw under factors on light and dark with the polynomial of the scaled cumulants."""
    x = toy(8, 1, dark=288.0 if quartic else 2225.0, read=12.0, photon_noise="poisson")
    processes = Processes(qe_scale=Uniform(1.4, 1.4), detector_temperature=Uniform(12.0, 12.0))
    scene, index = prepare([x], processes=processes), np.arange(3000, dtype=np.uint64)
    assert scene.quartic == quartic
    factors = reference.factors(scene, index, 0, 5)
    warm = np.exp(x.conditions["dark_slope_per_c"] * (12.0 - x.conditions["temperature_c"]))
    c = Cumulants.of(x, 1).scaled(1.4, warm)
    drawn = reference.draws(scene, index, 0, 1, 5)
    for i in range(4):
        p, z = 4 + i, drawn.z[i].astype(float)
        shape = np.array([float(a[p]) for a in polynomial(c)])
        if not quartic:
            g3, sd = float(c.shape()[0][p]), float(np.sqrt(c.variance[p]))
            shape[0], shape[2], shape[4] = -sd * g3 / 6, sd * g3 / 6, 0.0
        ours = reference.analogue(scene, drawn, i, p, 0, *factors).astype(float) + scene.base_dn[0, p]
        # float32 of a draw of up to a thousand DN from its base.
        np.testing.assert_allclose(ours, c.mean[p] + np.polynomial.Polynomial(shape)(z), rtol=0, atol=3e-4)


def test_cumulants_at_factors() -> None:
    """Compare `scaled` with the cumulants of an expectation with other light and dark."""
    for noise in ("gaussian", "poisson"):
        x = toy(8, 3, photon_noise=noise)
        other = replace(
            x, source_electrons=2 * x.source_electrons, sky_electrons=2 * x.sky_electrons, dark_dn=0.3 * x.dark_dn
        )
        ours, wanted = Cumulants.of(x, 3).scaled(2.0, 0.3), Cumulants.of(other, 3)
        for name in Cumulants.__dataclass_fields__:
            np.testing.assert_allclose(getattr(ours, name), getattr(wanted, name), rtol=1e-12)
