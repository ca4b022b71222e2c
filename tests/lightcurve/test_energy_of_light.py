"""The stated energy of a flare is that of the light that is drawn: integrals over time and wavelength."""

from __future__ import annotations

from typing import Any

import astropy.units as u
import numpy as np
import pytest
from marks import long_but

from mauvecl import Cooling, EnergyScale, Event, Source, Study
from mauvecl.host.stars.bands import band
from mauvecl.lightcurve.flares.events import coefficients, temperatures_of
from mauvecl.study.cases import Case
from mauvecl.study.sections import Flare, SkyLight, Star
from mauvecl.study.stare_expectation import energy_of
from mauvecl.study.stare_section import EventChoice

STARS = ("A0V", "A7V", "F5V", "G2V", "K1V", "K5V", "M0V", "M3V", "M5V", "Sun")
BANDS = ("Kepler", "TESS", "V", "B", "Gaia G", "Gaia BP", "GALEX NUV")
SHAPES = ("davenport2014", "tovarmendoza2022")


def share_within(low_nm: float, high_nm: float, temperature_k: float) -> float:
    """Return the fraction of a blackbody's light between two wavelengths."""
    # 15 / pi^4 times the integral of x^3 / (e^x - 1) over x = h c / (wavelength k T), CODATA 2018.
    from scipy.integrate import quad

    ends = [1.438776877e7 / (nm * temperature_k) for nm in (high_nm, low_nm)]
    value = quad(lambda x: x**3 / np.expm1(x), ends[0], ends[1], epsabs=0.0, epsrel=1e-12, limit=200)[0]
    return float(15 / np.pi**4 * value)


def spread(n: int, low: float, high: float, rng: np.random.Generator) -> Any:
    """Return random numbers, evenly spread in the logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high), n))


def through(name: str, nm: np.ndarray, flux: np.ndarray) -> float:
    """Integrate a spectrum through a band, weighted with energy: erg s-1 cm-2."""
    found = band(name)
    fine = np.linspace(found.wavelength_nm[0], found.wavelength_nm[-1], 60_001)
    response = np.interp(fine, found.wavelength_nm, found.throughput / found.throughput.max())
    return float(np.trapezoid(response * np.interp(fine, nm, flux, left=0, right=0), fine)) * 10


def events(rng: np.random.Generator, most: int) -> tuple[EventChoice, ...]:
    """Return random flares of energies, within a stare of a day."""
    texts = []
    for _ in range(rng.integers(1, most + 1)):
        hot = float(spread(1, 7000, 30_000, rng)[0])
        cooling = None
        if rng.random() < 0.4:
            cooling = {"end_k": float(rng.uniform(5500, hot)), "fold_s": float(spread(1, 2, 1000, rng)[0])}
        texts.append(
            EventChoice(
                peak_s=float(rng.uniform(5000, 20_000)),
                half_width_s=float(spread(1, 2, 600, rng)[0]),
                energy_erg=float(spread(1, 1e28, 1e31, rng)[0]),
                energy=rng.choice(["bolometric", "band"]),
                temperature_k=hot,
                cooling=cooling,
                shape=rng.choice(SHAPES),
            )
        )
    return tuple(texts)


@pytest.mark.parametrize("seed", long_but(range(12), 0, 1, 2))
def test_drawn_light_carries_the_stated_energy(seed: int) -> None:
    """Draw stars, distances, bands, shapes, temperatures and cooling at random.

    The light is that from which every frame is drawn: coefficients of the frames times spectra of one amplitude.
    """
    rng = np.random.default_rng(seed)
    # Several flares share the temperatures from which they are mixed.
    texts = events(rng, 3)
    name = str(rng.choice(BANDS))
    star = Star(
        library=str(rng.choice(STARS)),
        magnitude=float(rng.uniform(4, 10)),
        distance_pc=float(spread(1, 2, 100, rng)[0]),
    )
    study = Study(star=(star,), events=texts, flare=Flare(band=name), sky=SkyLight(none=True)).with_settings(
        ["stare.duration_s=120000"]
    )
    source = star.source()
    case = Case(study)
    staring, flares = case.stare_expectation, case.events
    kelvin = temperatures_of(flares)
    nm, sphere = source.wavelength_nm, 4 * np.pi * (star.distance_pc * u.pc).to_value(u.cm) ** 2
    spectra = [source.flaring(1.0, k, band=name).flux_flam - source.flux_flam for k in kelvin]
    mixed = coefficients(flares, staring.stare.start_s, staring.stare.frame_s, kelvin)
    np.testing.assert_array_equal(staring.flare, mixed)
    for text, flare in zip(texts, flares, strict=True):
        seconds = coefficients([flare], staring.stare.start_s, staring.stare.frame_s, kelvin).sum(axis=0)
        seconds *= staring.stare.frame_s
        # A spectrum ends somewhere: beyond, the blackbody's light is known.
        shares = [share_within(nm[0], nm[-1], k) for k in kelvin]
        drawn = {
            "band": sphere * through(name, nm, seconds @ spectra),
            "bolometric": sphere
            * sum(10 * np.trapezoid(s * x, nm) / w for s, x, w in zip(seconds, spectra, shares, strict=True)),
        }
        assert drawn[text.energy] == pytest.approx(text.energy_erg, rel=5e-4)
        for kind in ("band", "bolometric"):
            stated = energy_of(case.study, case.source, flare, kind, kelvin)  # type: ignore[arg-type]
            assert stated == pytest.approx(drawn[kind], rel=5e-4)


@pytest.mark.parametrize("seed", range(10))
def test_replacing_flare_carries_the_energy_it_adds(seed: int) -> None:
    """Integrate the light of the hot patch less that of the photosphere, for stars that are blackbodies."""
    from mauvecl.host.stars.blackbody import blackbody

    rng = np.random.default_rng(100 + seed)
    name, star_k, flare_k = str(rng.choice(BANDS)), float(rng.uniform(3000, 9000)), float(rng.uniform(9500, 30_000))
    nm = np.geomspace(20, 300_000, 60_001)
    source = Source.from_arrays(nm, 1e-19 * blackbody(nm, star_k))
    how: Any = {"band": name, "geometry": "replaces"}
    small = 1e-4
    light = source.flaring(small, flare_k, photosphere_temperature=star_k, **how).flux_flam - source.flux_flam
    light /= small
    sphere = 4 * np.pi * (10 * u.pc).to_value(u.cm) ** 2
    for kind, drawn in (("band", through(name, nm, light)), ("bolometric", 10 * np.trapezoid(light, nm))):
        scale = EnergyScale.of_star(source, 10.0, flare_k=flare_k, photosphere_k=star_k, kind=kind, **how)
        assert scale.erg_per_s == pytest.approx(sphere * drawn, rel=5e-4)


@pytest.mark.long
def test_fast_cooling_flare_keeps_its_energy() -> None:
    """Include cooling within a frame and flares shorter than a frame."""
    for half, fold in ((0.5, 0.5), (1.0, 20.0), (60.0, 0.5), (300.0, 3000.0)):
        flare = Event(20_001.3, half, 0.4, Cooling(20_000.0, 6_000.0, fold))
        kelvin = temperatures_of([flare])

        def scale_of(k: float) -> EnergyScale:
            return EnergyScale.of_blackbody(0.5, 3500.0, flare_k=k)

        start = np.arange(20_000) * 5.0
        seconds = 5.0 * coefficients([flare], start, 5.0, kelvin).sum(axis=0)
        drawn = sum(s * scale_of(float(k)).erg_per_s for s, k in zip(seconds, kelvin, strict=True))
        assert flare.total_energy(scale_of) == pytest.approx(drawn, rel=5e-4)
