"""Energies of flares: durations, peaks and energies from each other; published and independent values."""

from __future__ import annotations

import numpy as np
import pytest

from mauvecl import SHAPES, Blackbody, EnergyScale, Event, Source
from mauvecl.host.stars.bands import band

#: Planck's and Boltzmann's constants and the speed of light (CODATA 2018), and the radius of the Sun, cm.
H, C, K, SUN_CM = 6.62607015e-27, 2.99792458e10, 1.380649e-16, 6.957e10
#: erg/s of Shibayama et al. 2013's formula by other tables of the bands, for flares of 9000 and 10 000 K.
ELSEWHERE = [
    ("Kepler", 5778, 1.0, 1.1774e33, 1.3289e33),
    ("Kepler", 4830, 0.755, 2.9825e32, 3.3663e32),
    ("Kepler", 3200, 0.2, 1.9525e30, 2.2037e30),
    ("TESS", 5778, 1.0, 1.5365e33, 1.8197e33),
]


def through(name: str, kelvin: float, *, of: str) -> float:
    """Integrate Planck's law over a band by Gauss and Legendre: in units of response, photons or energy."""
    found = band(name)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    a, b = found.wavelength_nm[:-1, None], found.wavelength_nm[1:, None]
    nm, step = (a + b) / 2 + (b - a) / 2 * nodes, (b - a) / 2 * weights * 1e-7
    response = np.interp(nm, found.wavelength_nm, found.throughput)
    cm = nm * 1e-7
    light = 2 * np.pi * H * C**2 / cm**5 / np.expm1(H * C / (cm * K * kelvin))
    return float(
        np.sum(step * response * light * {"response": 1.0, "photons": nm, "energy": 1 / found.throughput.max()}[of])
    )


@pytest.mark.parametrize(("name", "star_k", "radius", "cool", "hot"), ELSEWHERE)
def test_energies_agree_with_direct_integration_and_other_band_tables(
    name: str, star_k: float, radius: float, cool: float, hot: float
) -> None:
    # The embedded bands are those of pyphot; with another table of Kepler's or TESS's energies differ by up to 1.4 %.
    sphere = 4 * np.pi * (radius * SUN_CM) ** 2
    for flare_k, elsewhere in ((9000.0, cool), (10_000.0, hot)):
        bolometric = sphere * 5.670374419e-5 * flare_k**4
        bodies, weighted = (
            through(name, star_k, of=of) / through(name, flare_k, of=of) for of in ("photons", "response")
        )
        published = EnergyScale.shibayama2013(radius, star_k, band=name, flare_k=flare_k).erg_per_s
        assert published == pytest.approx(bolometric / 4 * weighted, rel=2e-6)
        assert published == pytest.approx(elsewhere, rel=0.015)
        exact = {"bolometric": bolometric * bodies, "band": sphere * bodies * through(name, flare_k, of="energy")}
        for kind, value in exact.items():
            scale = EnergyScale.of_blackbody(radius, star_k, band=name, flare_k=flare_k, kind=kind)  # type: ignore[arg-type]
            assert scale.erg_per_s == pytest.approx(value, rel=2e-6)


def test_blackbody_star_agrees_with_the_blackbody_scale() -> None:
    nm = np.linspace(160, 1200, 20_801)
    # Of one solar radius seen from 10 pc.
    shrunk = (SUN_CM / (10 * 3.0856775814913674e18)) ** 2
    star = Source.from_arrays(nm, shrunk * Blackbody(5778.0).flux(nm))
    for how in ({"kind": "band"}, {"flare_k": 9e3}, {"geometry": "replaces", "photosphere_k": 5778.0}):
        seen, made = EnergyScale.of_star(star, 10.0, **how), EnergyScale.of_blackbody(1.0, 5778.0, **how)  # type: ignore[arg-type]
        assert seen.kind == made.kind == how.get("kind", "bolometric")
        assert seen.erg_per_s == pytest.approx(made.erg_per_s, rel=1e-5)


@pytest.mark.parametrize("name", list(SHAPES))
def test_duration_peak_and_energy_are_consistent(name: str) -> None:
    scale = EnergyScale.of_blackbody(1.0, 5778.0, flare_k=10_000.0)
    flare, where = Event(100.0, 33.0, 0.4, shape=name), {"peak_s": 100.0, "half_width_s": 33.0, "shape": name}
    duration = flare.equivalent_duration_s
    assert Event.of_energy(flare.energy(scale), scale, **where).amplitude == pytest.approx(0.4, rel=1e-14)
    assert Event.of_equivalent_duration(duration, **where).amplitude == pytest.approx(0.4, rel=1e-14)
    assert Event.of_peak(flare.peak, **where).amplitude == pytest.approx(0.4)
    assert flare.peak == pytest.approx(0.4 * SHAPES[name].peak)
    # And the duration is the integral of what frames are given.
    edges = np.arange(-100, 30_000) * 5.0
    assert 5.0 * 0.4 * SHAPES[name].mean_over(edges, 100.0, 33.0).sum() == pytest.approx(duration, rel=1e-12)
