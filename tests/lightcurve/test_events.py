"""Contributions of a stare's flares to frames, with one temperature or cooling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from mauvecl import SHAPES, Cooling, Event
from mauvecl.host.stars.blackbody import blackbody
from mauvecl.lightcurve.flares.events import check_contributions, coefficients, temperatures_of

START = np.arange(400) * 5.0


def test_peaks_add_up_per_temperature():
    assert temperatures_of([]).size == 0
    one, two = Event(300.0, 20.0, 0.2), Event(420.0, 60.0, 0.1, 15_000.0, "tovarmendoza2022")
    three = Event(500.0, 10.0, 0.3)
    kelvin = temperatures_of([one, two, three])
    np.testing.assert_array_equal(kelvin, [10_000.0, 15_000.0])
    found = coefficients([one, two, three], START, 5.0, kelvin)
    edges = np.arange(401) * 5.0
    davenport, mendoza = SHAPES["davenport2014"], SHAPES["tovarmendoza2022"]
    both = 0.2 * davenport.mean_over(edges, 300.0, 20.0) + 0.3 * davenport.mean_over(edges, 500.0, 10.0)
    np.testing.assert_allclose(found[:, 0], both, rtol=1e-13)
    np.testing.assert_allclose(found[:, 1], 0.1 * mendoza.mean_over(edges, 420.0, 60.0), rtol=1e-13)


def test_frames_in_gaps_are_absent_and_others_unchanged():
    flare = Event(500.0, 60.0, 0.5)
    whole = coefficients([flare], START, 5.0, np.array([10_000.0]))
    kept = np.r_[0:90, 130:400]
    np.testing.assert_array_equal(coefficients([flare], START[kept], 5.0, np.array([10_000.0])), whole[kept])


def test_cooling_flare_keeps_its_light_curve_and_spectrum():
    flare = Event(500.0, 60.0, 0.5, Cooling(14_000.0, 6_000.0, 120.0))
    kelvin = temperatures_of([flare])
    found = coefficients([flare], START, 5.0, kelvin)
    alone = coefficients([Event(500.0, 60.0, 0.5)], START, 5.0, np.array([10_000.0]))[:, 0]
    # In the band in which amplitudes are measured every spectrum has an amplitude of one.
    np.testing.assert_allclose(found.sum(axis=1), alone, rtol=1e-9, atol=1e-15)
    # Spectra of one amplitude at 600 nm, mixed from the nodes, compared with the blackbody at the middle of the frame.
    nm = np.linspace(200.0, 700.0, 101)
    unit = np.array([blackbody(nm, k) / blackbody(np.array([600.0]), k) for k in kelvin])
    for k in (95, 110, 130, 200):
        temperature = float(flare.temperature.at(np.array(START[k] + 2.5 - 500.0)))
        exact = alone[k] * blackbody(nm, temperature) / blackbody(np.array([600.0]), temperature)
        mixed = found[k] @ unit
        # Linear mixing is too bright by 5 % at most, and that where the flare is at its faintest.
        np.testing.assert_allclose(mixed, exact, rtol=0.06)
        np.testing.assert_allclose(mixed[nm > 300], exact[nm > 300], rtol=0.02)


def test_flare_without_cooling_has_one_temperature():
    steady = Event(500.0, 60.0, 0.5, Cooling(9_000.0, 9_000.0, 100.0))
    assert temperatures_of([steady]).tolist() == [9_000.0]
    plain = Event(500.0, 60.0, 0.5, 9_000.0)
    kelvin = np.array([6_000.0, 9_000.0, 12_000.0])
    np.testing.assert_array_equal(coefficients([steady], START, 5.0, kelvin), coefficients([plain], START, 5.0, kelvin))


@pytest.mark.parametrize("shape", SHAPES)
def test_flares_outside_of_the_frames_raise_or_are_reported(shape):
    rng = np.random.Generator(np.random.Philox(81))
    start = np.concatenate([np.arange(100, 400), np.arange(700, 1000)]) * 5.0
    count = {"refused": 0, "named": 0, "inside": 0}
    for _ in range(300):
        # Of an amplitude of zero, too: it is where it is.
        event = Event(rng.uniform(-3000, 9000), 10 ** rng.uniform(-1, 3), rng.choice([0.0, 0.5]), shape=shape)
        mean = coefficients([replace(event, amplitude=1.0)], start, 5.0, np.array([10_000.0]))
        whole = event.half_width_s * event.form.equivalent_duration
        if mean.max() < 1e-9 * event.form.peak and 5.0 * mean.sum() < 1e-9 * whole:
            with refused("peak_s", value=event.peak_s):
                check_contributions([event], start, 5.0)
            count["refused"] += 1
            continue
        sentences = check_contributions([event], start, 5.0)
        best = start[np.argmax(mean)]
        if sentences:
            # The largest light is then at an edge of the frames.
            assert mean[[0, 299, 300, 599]].max() >= (1 - 1e-9) * mean.max()
            count["named"] += 1
        else:
            # What peaks in a frame is largest there or next to it, but for a boxcar, whose top is flat.
            assert abs(best + 2.5 - event.peak_s) <= 7.5 + event.half_width_s * (shape == "fiducial")
            count["inside"] += 1
    assert min(count.values()) > 20, count
