"""Photosphere and magnitude of each star of a study; the sky is the same under both hypotheses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mauvecl import Engine, Instrument, Source, Study, detect, expect, limit

PART = {"changes": {"output_min_nm": 300.0, "output_max_nm": 330.0}}


def study(*stars: dict[str, Any], **flare: Any) -> Study:
    given = [{"magnitude": 8.0} | star for star in stars]
    return Study.build({"star": given, "flare": {"amplitudes": [0.1]} | flare, "observation": PART}, "test")


def light(asked: Study) -> list[np.ndarray]:
    """Return the electrons of each star with its flare."""
    few = asked.with_settings(["run={realisations=500, fap=0.3, statistics=['matched']}"])
    return [one.detection.flares[0].source_electrons for one in detect(few).stars]


def test_each_star_has_its_own_photosphere() -> None:
    """The default is the library's temperature; a star's own temperature overrides it, as does that of the flare."""
    both = light(study({"library": "G2V"}, {"library": "M3V"}, geometry="replaces"))
    for found, name, kelvin in zip(both, ("G2V", "M3V"), (5636.0, 3295.0), strict=True):
        star = Source.from_library(name).at_magnitude(8.0)
        flaring = star.flaring(0.1, geometry="replaces", photosphere_temperature=kelvin)
        wanted = expect(flaring, Instrument.load("mauve").with_(**PART["changes"]), exposure=50)
        np.testing.assert_allclose(found, wanted.source_electrons, rtol=1e-12)
    own = study({"library": "G2V", "effective_temperature_k": 5000.0}, geometry="replaces")
    one = study({"library": "G2V"}, geometry="replaces", photosphere_temperature_k=5000.0)
    np.testing.assert_array_equal(light(own), light(one))
    assert not np.array_equal(light(own)[0], both[0])
    assert Study.build(own.model_dump(), "again") == own
    # Another star has its own temperature.
    assert own.at("star", "M3V").star[0].effective_temperature_k is None


def test_sky_is_common_to_both_hypotheses(engine: Engine) -> None:
    """The definition of the signal does not affect detection; a sky 1000 times brighter makes it harder."""
    settings = [
        "run.realisations=20000",
        "run.fap=0.01",
        "flare.amplitudes=[0.02]",
        "run.statistics=['chi2','matched']",
    ]
    asked = study({"library": "G2V"}).with_settings(settings)
    net, paper = (
        detect(asked.with_settings([f"observation.signal='{word}'"]), engine).stars[0].detection
        for word in ("net", "paper")
    )
    for statistic in ("chi2", "matched"):
        for flare in (None, 0):
            one, other = (found.distribution(statistic, flare) for found in (net, paper))
            np.testing.assert_array_equal(one.counts, other.counts)
    bright = detect(asked.with_settings(["sky.surface_brightness=14.6"]), engine).stars[0].detection
    seen, drowned = (found.detection_probability(0.01, "matched")[0].value for found in (net, bright))
    assert drowned < seen
    # The false-alarm probability is unchanged: within five standard errors of 200 alarms.
    assert bright.false_alarm_probability(net.threshold(0.01, "matched").value, "matched").value == pytest.approx(
        0.01, abs=5 * np.sqrt(2 * 0.01 / 20_000)
    )


def test_limiting_magnitude_needs_no_magnitude(engine: Engine) -> None:
    run = {"realisations": 20_000, "fap": 0.01, "statistics": ["matched"]}
    asked = Study.build({"star": [{"library": "G2V"}], "flare": {"amplitudes": [0.3]}, "run": run}, "test")
    (found,) = limit(asked, engine).limits
    assert found.value.low < found.value.value < found.value.high
