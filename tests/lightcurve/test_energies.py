"""Energies of flares: durations, peaks and energies from each other; published and independent values."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy import constants
from astropy.modeling.models import BlackBody

from mauvecl import SHAPES, EnergyScale, Event, Source
from mauvecl.host.stars.bands import band
from mauvecl.lightcurve.flares import energies

#: erg/s of Shibayama et al. 2013's formula by other tables of the bands, for flares of 9000 and 10 000 K.
ELSEWHERE = [
    ("Kepler", 5778, 1.0, 1.1774e33, 1.3289e33),
    ("Kepler", 4830, 0.755, 2.9825e32, 3.3663e32),
    ("Kepler", 3200, 0.2, 1.9525e30, 2.2037e30),
    ("TESS", 5778, 1.0, 1.5365e33, 1.8197e33),
]


@pytest.mark.parametrize(("name", "kelvin", "radius", "cool", "hot"), ELSEWHERE)
def test_bolometric_energies_agree_with_astropy_and_other_band_tables(name, kelvin, radius, cool, hot):
    # The embedded bands are those of pyphot; with another table of Kepler's or TESS's energies differ by up to 1.4 %.
    used = band(name)
    nm = np.linspace(used.wavelength_nm[0], used.wavelength_nm[-1], 40_001)
    response = np.interp(nm, used.wavelength_nm, used.throughput)

    def through(temperature: float) -> float:
        flux = BlackBody(temperature * u.K, scale=1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr))(nm * u.nm).value
        return float(np.trapezoid(response * flux, nm))

    for flare, value in ((9000.0, cool), (10_000.0, hot)):
        scale = EnergyScale.shibayama2013(radius, kelvin, band=name, flare_k=flare)
        area = through(kelvin) / through(flare) * np.pi * (radius * constants.R_sun) ** 2
        exact = (area * constants.sigma_sb * (flare * u.K) ** 4).to_value(u.erg / u.s)
        assert scale.erg_per_s == pytest.approx(exact, rel=2e-6)
        assert scale.erg_per_s == pytest.approx(value, rel=0.015)


def test_energies_agree_with_direct_integration():
    # Planck's law written out, Gauss-Legendre between the band's points; CODATA 2018.
    h, c, k = 6.62607015e-27, 2.99792458e10, 1.380649e-16
    found = band("Kepler")
    nodes, weights = np.polynomial.legendre.leggauss(4)
    a, b = found.wavelength_nm[:-1, None], found.wavelength_nm[1:, None]
    nm, step = (a + b) / 2 + (b - a) / 2 * nodes, (b - a) / 2 * weights * 1e-7
    response = np.interp(nm, found.wavelength_nm, found.throughput)

    def through(kelvin: float, weight: float | np.ndarray) -> float:
        cm = nm * 1e-7
        light = 2 * np.pi * h * c**2 / cm**5 / np.expm1(h * c / (cm * k * kelvin))
        return float(np.sum(step * response * weight * light))

    area = 4 * np.pi * (0.755 * 6.957e10) ** 2
    bodies = through(4830, nm) / through(9000, nm)  # as many photons
    energies_per_s = {
        "bolometric": area * bodies * 5.670374419e-5 * 9000.0**4,
        "band": area * bodies * through(9000, 1 / found.throughput.max()),
    }
    for kind, exact in energies_per_s.items():
        scale = EnergyScale.of_blackbody(0.755, 4830, flare_k=9000.0, kind=kind)
        assert scale.erg_per_s == pytest.approx(exact, rel=2e-7)
    published = EnergyScale.shibayama2013(0.755, 4830, flare_k=9000.0).erg_per_s
    weighted = through(4830, 1.0) / through(9000, 1.0)
    assert published == pytest.approx(energies_per_s["bolometric"] / 4 * weighted / bodies, rel=2e-7)


def test_blackbody_star_agrees_with_the_blackbody_scale():
    from mauvecl.host.stars.blackbody import blackbody

    nm = np.linspace(160, 1200, 20_801)
    # Of one solar radius seen from 10 pc.
    shrunk = (energies.SUN_CM / (10 * energies.PARSEC_CM)) ** 2
    star = Source.from_arrays(nm, shrunk * blackbody(nm, 5778.0))
    for how in ({"kind": "band"}, {"flare_k": 9e3}, {"geometry": "replaces", "photosphere_k": 5778.0}):
        seen, made = EnergyScale.of_star(star, 10.0, **how), EnergyScale.of_blackbody(1.0, 5778.0, **how)
        assert seen.kind == made.kind == how.get("kind", "bolometric")
        assert seen.erg_per_s == pytest.approx(made.erg_per_s, rel=1e-5)
    luminosity = energies.quiescent_luminosity(star, 10.0)
    sun = 4 * np.pi * energies.SUN_CM**2 * energies.in_band("Kepler", 5778.0)
    assert luminosity == pytest.approx(sun, rel=1e-5)


@pytest.mark.parametrize("name", list(SHAPES))
def test_duration_peak_and_energy_are_consistent(name):
    scale = EnergyScale.of_blackbody(1.0, 5778.0, flare_k=10_000.0)
    flare = Event(100.0, 33.0, 0.4, shape=name)
    same = Event.of_energy(flare.energy(scale), scale, peak_s=100.0, half_width_s=33.0, shape=name)
    assert same.amplitude == pytest.approx(0.4, rel=1e-14)
    duration = flare.equivalent_duration_s
    assert energies.amplitude_of(duration, 33.0, name) == pytest.approx(0.4, rel=1e-14)
    assert Event.of_peak(flare.peak, peak_s=100.0, half_width_s=33.0, shape=name).amplitude == pytest.approx(0.4)
    assert flare.peak == pytest.approx(0.4 * SHAPES[name].peak)
    # And the duration is the integral of what frames are given.
    edges = np.arange(-100, 30_000) * 5.0
    assert 5.0 * 0.4 * SHAPES[name].mean_over(edges, 100.0, 33.0).sum() == pytest.approx(duration, rel=1e-12)
