"""Bad input of the host's functions: each row is a call, the key that its error names, and facts of its sentence."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from refusals import Row, check

from mauvecl.host.expectation import expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.instrument.pixel_map import PixelMap
from mauvecl.host.orbit.conditions import Particles, Thermal
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.host.orbit.orbit import Orbit
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import TimeGrid
from mauvecl.host.response import electrons_per_second, response_matrix
from mauvecl.host.sky.zodiacal import Sky
from mauvecl.host.stars.flare_spectra import BalmerFlare, Blackbody, FlareWithLines, TwoBlackbodies
from mauvecl.host.stars.source import Source


@cache
def sun() -> Source:
    return Source.from_library("G2V").at_magnitude(7.4)


@cache
def mauve() -> Instrument:
    return Instrument.load("mauve")


def each(call: Callable[[Any], object], key: str, *values: Any, facts: tuple[str, ...] = ()) -> list[Row]:
    """Return a row for each value of an argument."""
    return [(lambda value=value: call(value), key, *facts) for value in values]


NAN = float("nan")
ICRS, UTC = "right ascension and declination", "a UTC time"
DAY = "2026-01-01"
PLACE = "290 -11"

STARS: list[Row] = [
    (lambda: Source.from_library("G3V"), "name", "'G3V'", "G5V"),
    (lambda: sun().at_magnitude(7.4, "V", "AB"), "system", "'AB'", "'catalogue', 'vega' or 'ab'"),  # type: ignore[arg-type]
    (lambda: sun().reddened(-1), "ebv", "-1"),
    (lambda: sun().reddened(0.1, law="X"), "law", "'X'"),  # type: ignore[arg-type]
    (lambda: sun().reddened(0.1, rv=99.0), "rv", "99"),
    (lambda: sun().flaring(-0.1), "amplitude", "-0.1"),
    (lambda: sun().flaring(NAN), "amplitude", "nan"),
    (lambda: sun().flaring(0.1, 10.0), "temperature", "10.0"),
    (lambda: sun().flaring(0.1, 1 * u.m), "temperature", "1.0 m"),
    (lambda: sun().flaring(0.1, band="Q"), "band", "'Q'"),
    (lambda: sun().flaring(0.1, geometry="sideways"), "geometry", "'sideways'"),  # type: ignore[arg-type]
    (lambda: sun().flaring(0.1, geometry="replaces", photosphere_temperature=2e4), "flare_temperature", "20000"),
    (lambda: sun().flaring(50.0, geometry="replaces", photosphere_temperature=5800), "flare_amplitude", "50"),
    *each(lambda value: sun().at_magnitude(value), "magnitude", "x", None, np.ones(2), np.inf),
    *each(lambda value: sun().flaring(value), "amplitude", "x", None, np.ones(2)),
    *each(lambda value: sun().flaring(0.1, value), "temperature", "x", None, np.ones(2)),
    *each(lambda value: sun().reddened(value), "ebv", "x", None, np.ones(2)),
    (lambda: Blackbody(10.0), "temperature_k"),
    (lambda: TwoBlackbodies(9e3, 1e7, 0.1), "second_temperature_k"),
    (lambda: TwoBlackbodies(9e3, 2e4, -1.0), "second_area"),
    (lambda: BalmerFlare(9e3, 0.5), "jump"),
    (lambda: FlareWithLines(Blackbody(), {"Fe XXI": 0.1}), "lines", "'Fe XXI'"),
    (lambda: FlareWithLines(Blackbody(), {"Mg II": -0.1}), "fractions", "['Mg II']"),
    (lambda: FlareWithLines(Blackbody(), {"Mg II": 0.1}, {"Mg II": 1e-13}), "lines", "'Mg II'"),
    (lambda: FlareWithLines(Blackbody(), {"2800": 0.1}), "wavelength_of_the_line_'2800'"),
]

INSTRUMENTS: list[Row] = [
    (lambda: Instrument.load("mauv"), "instrument", "'mauv'", "'mauve'"),
    (lambda: Instrument.load("no-such.toml"), "instrument", "no-such.toml"),
    (lambda: mauve().with_(temperature_c=100), "temperature_c", "-40 to 65 deg C"),
    (lambda: mauve().with_(temperature_c=NAN), "temperature_c", "-40 to 65 deg C"),
    (lambda: mauve().with_(temperature_c="13"), "temperature_c", "-40 to 65 deg C"),
    (lambda: mauve().with_(frame_s=0), "frame_s", "above 0"),
    (lambda: mauve().with_(light_loss=1.0), "light_loss", "below 1"),
    (lambda: mauve().with_(pixels=2048.5), "pixels", "a whole number"),
    (lambda: mauve().with_(dark_unit="e-"), "dark_unit", "'DN' or 'electrons'"),
    (lambda: mauve().with_(output_max_nm=150), "output_max_nm", "output_min_nm"),
    (lambda: mauve().with_(gaussian_fwhm_nm=0.01), "gaussian_fwhm_nm", "0 (none) or at least 0.1"),
    (lambda: mauve().with_(bias_dn=60_000), "bias_dn", "saturation"),
    (lambda: mauve().with_(temprature_c=13), "temprature_c", "'temperature_c'"),
    (lambda: mauve().with_(grating_efficiency=1.5), "grating_efficiency", "1.5"),
    (lambda: mauve().with_(quantum_efficiency_a_per_w=0.5), "quantum_efficiency_a_per_w", "at most 1"),
    (lambda: mauve().with_(output_max_nm=750), "grating_efficiency", "200-700", "200-750"),
    (lambda: mauve().with_(top_hat_width_nm=0, gaussian_fwhm_nm=0), "top_hat_width_nm", "gaussian_fwhm_nm"),
    (lambda: PixelMap(), "pixel_map"),
    (lambda: PixelMap(dark=np.array([1.0, -2.0])), "dark", "pixel 1", "-2", "0 or more"),
    (lambda: PixelMap(gain=np.array([1.0, 0.0])), "gain", "pixel 1", "above 0"),
    (lambda: PixelMap(bias_dn=np.array([NAN, 1.0])), "bias_dn", "pixel 0", "nan"),
    (lambda: PixelMap(dark=np.ones(1), gain=np.ones(2)), "pixel_map", "[1, 2]"),
    (lambda: PixelMap(dark=np.ones((1, 1))), "dark", "(1, 1)"),
]

EXPECTATIONS: list[Row] = [
    *each(
        lambda value: expect(sun(), mauve(), exposure=value),
        "exposure",
        *(0, -5, NAN, np.inf, 86_401, 2 * u.day, 3 * u.m, "50", True, None, [50, 60], [5, 6] * u.s),
        facts=("seconds above 0 and up to 86400",),
    ),
    (lambda: expect(sun(), mauve(), exposure=50, signal="all"), "signal", "'all'", "'paper'"),  # type: ignore[arg-type]
    (lambda: response_matrix(mauve(), [300.0, 400.0], "other"), "order", "'physical'"),  # type: ignore[arg-type]
    (lambda: electrons_per_second(mauve(), [300.0, 400.0], [1.0, 1.0, 1.0]), "flux", "3", "2"),
    *each(
        lambda nodes: response_matrix(mauve(), nodes),
        "wavelength_nm",
        *([300.0], [300.0, 300.0], [400.0, 300.0], [300.0, NAN], [[300.0, 400.0]]),
    ),
]

SKIES: list[Row] = [
    *each(Sky.of_brightness, "brightness", NAN, 100.0, "bright", True, 22.1 * u.mag, 3 * u.m, None),
    (lambda: Sky.at(PLACE, DAY, "cubic"), "lookup", "'bilinear' or 'nearest'"),  # type: ignore[arg-type]
    *each(
        lambda target: Sky.at(target, DAY),
        "target",
        *("18 Sko", "290 -95", "", "nan nan", SkyCoord(np.nan * u.deg, 4 * u.deg)),
        facts=(ICRS,),
    ),
    (lambda: Sky.at("700 10", DAY), "target", "0 to 360 degrees"),
    (lambda: Sky.at(SkyCoord([1, 2] * u.deg, [3, 4] * u.deg), DAY), "target", "2 positions"),
    *each(lambda time: Sky.at(PLACE, time), "time", "yesterday", "2026-13-01", facts=(UTC,)),
    (lambda: Sky.at(12.0, DAY), "target", "a SkyCoord or text"),  # type: ignore[arg-type]
    (lambda: Sky.at(PLACE, 2026), "time", "a Time or text"),  # type: ignore[arg-type]
    (lambda: Sky.at(PLACE, "1850-01-01"), "time", "1990", "2100"),
    (lambda: Sky.at(PLACE, Time([DAY, "2026-01-02"])), "time", "2 times"),
]

ORBITS: list[Row] = [
    *each(lambda days: TimeGrid(DAY, days), "days", 0.0, NAN),
    (lambda: TimeGrid(DAY, 365.0, 1e-3), "step_s"),
    (lambda: TimeGrid("yesterday", 365.0), "time", "'yesterday'"),
    (lambda: Orbit(Orbit.load().elements, "other"), "kind", "'other'"),  # type: ignore[arg-type]
    (lambda: Thermal(20.0, 10.0, 0.0), "time_constant_s"),
    (lambda: Thermal(99.0, 10.0, 600.0), "sunlit_c", "99"),
    (lambda: Thermal(20.0, -60.0, 600.0), "shadow_c", "-40 to 65"),
    (lambda: Particles(-1.0, 0.5), "cosmic_per_cm2_s"),
    (lambda: Particles(1.0, 1.5), "share"),
    (lambda: Target.of("epsilon Errr"), "target", "eps Eri"),
    (lambda: Target.of("700 10"), "target", "0 to 360"),
    (lambda: Target.of("zzz"), "target", "'zzz'"),
    (lambda: Limits(earth_limb_deg=91.0), "earth_limb_deg", "90"),
    (lambda: Limits(declination_deg=(10.0, -10.0)), "declination_deg", "-90 to 90"),
    (lambda: Limits(eclipse="sometimes"), "eclipse", "'sometimes'"),  # type: ignore[arg-type]
    (lambda: Limits(proton_flux=0.0), "proton_flux"),
    (lambda: Limits(anomaly=((0.0, 0.0), (1.0, 1.0))), "anomaly", "2 corners"),
    (lambda: Limits(duty_cycle=0.0), "duty_cycle"),
    (lambda: Limits(shortest_s=-1.0), "shortest_s", "-1"),
]


@pytest.mark.parametrize("row", [*STARS, *INSTRUMENTS, *EXPECTATIONS, *SKIES, *ORBITS], ids=lambda row: row[1])
def test_bad_input_raises(row: Row) -> None:
    check(row)
