"""Cases: their values, and when and how often inputs are loaded."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mauvecl.host.expectation import expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.sky.zodiacal import Sky
from mauvecl.study.cases import Case, cases
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.sections import Star
from mauvecl.study.study import Study

# Two values of each quantity that a sweep may have.
SWEPT: dict[str, tuple[Any, Any]] = {
    "magnitude": (6.0, 7.0),
    "amplitude": (0.1, 0.2),
    "flare_temperature": (8000.0, 12_000.0),
    "balmer_jump": (2.0, 3.0),
    "second_temperature": (5000.0, 6000.0),
    "second_area": (2.0, 3.0),
    "line_scale": (0.5, 2.0),
    "exposure": (5.0, 50.0),
    "detector_temperature": (-10.0, 10.0),
    "sky": (21.0, 22.0),
    "star": ("G2V", "M3V"),
}
# Settings that some quantities need to have an effect.
NEEDED = {
    "second_temperature": ["flare.spectrum={second_temperature_k=4000.0, second_area=1.0}"],
    "second_area": ["flare.spectrum={second_temperature_k=4000.0, second_area=1.0}"],
    "line_scale": ["flare.spectrum={lines={'H alpha'=0.1}}"],
}


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Return the number of times that each kind of input was loaded since the test began."""
    counts = {"instrument": 0, "sky": 0, "source": 0}
    load, brightness, source = Instrument.load, Sky.of_brightness, Star.source

    def counted(kind: str, function: Any) -> Any:
        def call(*args: Any) -> Any:
            counts[kind] += 1
            return function(*args)

        return call

    monkeypatch.setattr(Instrument, "load", counted("instrument", load))
    monkeypatch.setattr(Sky, "of_brightness", counted("sky", brightness))
    monkeypatch.setattr(Star, "source", counted("source", source))
    return counts


def test_nothing_is_loaded_before_it_is_asked_for(loads: dict[str, int]) -> None:
    first, _ = cases(Study())
    assert (first.star.library, first.at, first.amplitudes) == ("K3V", {}, Study().flare.amplitudes)
    assert loads == {"instrument": 0, "sky": 0, "source": 0}
    assert first.source.name
    assert loads == {"instrument": 0, "sky": 0, "source": 1}
    assert first.quiet is first.quiet
    assert "flares" not in vars(first)
    assert loads == {"instrument": 1, "sky": 1, "source": 1}


def test_cases_of_one_observation_load_instrument_and_sky_once(loads: dict[str, int]) -> None:
    study = Study().with_settings(["sweep.axes=[{quantity='exposure', values=[5, 50, 600]}]"])
    for case in cases(study):
        assert len(case.expectations) == 1 + len(case.amplitudes)
        assert case.detect_options()["realisations"] == study.run.realisations
        assert case.one_frame.quiet.n_frames == 1
    assert loads == {"instrument": 1, "sky": 1, "source": 2}


def test_each_detector_temperature_has_its_instrument_of_one_file(loads: dict[str, int]) -> None:
    study = Study().with_settings(["sweep.axes=[{quantity='detector_temperature', values=[-10, 10]}]"])
    found = [case.instrument.temperature_c for case in cases(study)]
    assert found == [-10.0, -10.0, 10.0, 10.0]
    # Its file is read once.
    assert loads["instrument"] == 1


def test_every_quantity_is_swept() -> None:
    assert set(SWEPT) == set(QUANTITIES)


@pytest.mark.parametrize("quantity", SWEPT)
def test_sweep_gives_the_expectations_of_the_study_at_each_value(quantity: str) -> None:
    base = Study().with_settings(NEEDED.get(quantity, []))
    swept = base.with_changes({"sweep": {"axes": [{"quantity": quantity, "values": SWEPT[quantity]}]}}, None)
    found = cases(swept)
    assert [dict(case.at) for case in found] == [{quantity: value} for value in SWEPT[quantity] for _ in base.star]
    for value, pair in zip(SWEPT[quantity], zip(found[::2], found[1::2], strict=True), strict=True):
        study = base.at(quantity, value)
        for star, case in zip(study.star, pair, strict=True):
            assert case.study == study.model_copy(update={"star": (star,)})
            source = star.source()
            lit = [
                source.flaring(a, spectrum=study.flare.light(), band=study.flare.band, geometry=study.flare.geometry)
                for a in study.flare.amplitudes
            ]
            o = study.observation
            how = {"exposure": o.exposure_s, "sky": study.sky.sky(), "order": o.order, "signal": o.signal}
            expected = [expect(one, o.load_instrument(), **how) for one in (source, *lit)]
            for x, y in zip(case.expectations, expected, strict=True):
                np.testing.assert_array_equal(x.source_electrons, y.source_electrons)
                np.testing.assert_array_equal(x.recorded_dn, y.recorded_dn)
                assert (x.n_frames, x.conditions) == (y.n_frames, y.conditions)


def test_case_with_another_value_shares_what_is_loaded(loads: dict[str, int]) -> None:
    case = Case(Study().with_settings(["star=[{library='G2V', magnitude=7.0}]"]))
    other = case.with_value("exposure", 5.0).with_sections(nuisances=case.study.nuisances)
    assert (case.quiet.exposure_s, other.quiet.exposure_s) == (50.0, 5.0)
    assert loads == {"instrument": 1, "sky": 1, "source": 1}


def test_flares_can_have_another_temperature() -> None:
    case = Case(Study())
    hot = case.with_value("flare_temperature", 15_000.0)
    np.testing.assert_array_equal(case.flaring(0.1, 15_000.0).flux_flam, hot.flaring(0.1).flux_flam)


def test_documented_unknowns_follow_the_swept_detector_temperature() -> None:
    study = Study().with_settings(
        ["nuisances.usual=true", "sweep.axes=[{quantity='detector_temperature', values=[-10, 10]}]"]
    )
    for case in cases(study):
        prior = case.draw_options["processes"].detector_temperature
        low, high = prior.quantile(np.array([0.0, 1.0]))
        assert low < case.at["detector_temperature"] < high


def test_expectations_do_not_depend_on_what_is_unknown() -> None:
    """They are computed once for both choices; another payload has others."""
    case = Case(Study.build({"star": [{"library": "G2V", "magnitude": 8.0}], "flare": {"amplitudes": [0.02]}}, "test"))
    usual = NuisanceChoice(usual=True)
    other = case.with_sections(nuisances=usual)
    before = case.expectations
    assert case.with_sections(nuisances=usual).expectations == before
    for kept, anew in zip(before, other.expectations, strict=True):
        assert kept is not anew
        np.testing.assert_array_equal(kept.source_electrons, anew.source_electrons)
        np.testing.assert_array_equal(kept.variance_dn2, anew.variance_dn2)
    payload = case.study.observation.model_copy(update={"instrument": "mauve-electrons"})
    changed = case.with_sections(nuisances=usual, observation=payload)
    assert (changed.quiet.variance_dn2 != case.quiet.variance_dn2).all()
