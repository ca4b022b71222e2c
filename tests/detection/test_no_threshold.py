"""Nulls in which a single value is more probable than the false-alarm probability: no threshold has it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from answers import expectations, of_kind
from scenes import instrument, star, study_of_g2v
from scipy import optimize

from mauvecl import Engine, Expectation, InputError, Study, detect
from mauvecl import map as detection_map

N = 20_000
PAYLOAD = instrument(part=True, output_min_nm=300.0, output_max_nm=310.0)


def nearly_saturated(seed: int) -> tuple[Expectation, Expectation]:
    """Return a star that leaves one pixel near saturation and saturates the others, and a weak flare."""
    rng = np.random.default_rng(seed)
    quiet, _ = star("G2V", 5.0, amplitudes=(0.05,), exposure=5.0 * float(rng.integers(1, 3)), payload=PAYLOAD)
    room = (quiet.ceiling_dn - quiet.bias_dn - quiet.dark_dn) / quiet.gain_dn_per_electron
    light = 2.0 * room
    at = int(rng.integers(room.size))
    light[at] = room[at] - float(rng.uniform(0.1, 3.0)) * math.sqrt(room[at])
    quiet = replace(quiet, source_electrons=light, sky_electrons=np.zeros(light.size), messages=())
    flare = replace(quiet, source_electrons=light + 0.02 * math.sqrt(room[at]), name="flare")
    return quiet, flare


def atom(values: np.ndarray, fap: float) -> tuple[float, float]:
    """Return the shares of values beyond, and at, the one where the share from the top passes `fap`."""
    _, counts = np.unique(-values, return_counts=True)
    total = np.cumsum(counts)
    place = int(np.argmax(total > math.floor(fap * values.size * (1 + 1e-12))))
    return (total[place] - counts[place]) / values.size, counts[place] / values.size


def test_threshold_exists_unless_a_value_is_too_probable(engine: Engine) -> None:
    """Compare 20 stars near saturation, with and without a threshold, with an independent count of raw values.

    Values of one pixel are whole DN, many to a bin of the histogram at most: compared where they are clearly apart.
    """
    kinds = set()
    for seed in range(20):
        quiet, flare = nearly_saturated(seed)
        found = engine.detect(quiet, [flare], realisations=N, seed=seed, statistics=("matched", "uv_excess"))
        assert not found.blinding
        raw = engine.realise(quiet, count=N, seed=seed)[:, found.scene.used][:, 0].astype(np.int64)
        kinds.add(atom(raw, 0.02)[1] > 0.02)
        for fap in (0.006, 0.02, 0.1, 0.3):
            beyond, at = atom(raw, fap)
            if 0.7 < at / fap < 1.5:
                continue
            for statistic in found.statistics:
                if at > fap:
                    with pytest.raises(InputError) as error:
                        found.threshold(fap, statistic)
                    assert error.value.key == "fap"
                    (seen,) = found.detection_probability(fap, statistic)
                    assert np.isnan([seen.value, seen.low, seen.high]).all()
                    # Those that exist hold what they promise.
                    held = found.threshold(beyond + at, statistic).value
                    assert found.false_alarm_probability(held, statistic).value == pytest.approx(beyond + at, rel=1e-9)
                else:
                    value = found.false_alarm_probability(found.threshold(fap, statistic).value, statistic).value
                    assert fap - max(at, 1.5 / N) - 0.01 * fap <= value <= fap
        sentences = found.without_threshold(0.006)
        assert len(sentences) == (2 if atom(raw, 0.006)[1] > 0.006 else 0)
        if sentences:
            table = found.table(0.006)
            assert np.isnan(table["threshold"]).all()
            assert np.isnan(table["probability"]).all()
    assert kinds == {True, False}


def test_sampled_threshold_raises_as_well(engine: Engine) -> None:
    """Sample a single frame, drawn as a stack, whose most probable value is the same."""
    quiet, flare = nearly_saturated(3)
    quiet, flare = (replace(x, n_frames=1) for x in (quiet, flare))
    light = quiet.source_electrons.copy()
    pixel = int(np.argmin(quiet.saturated))
    light[pixel] = (quiet.ceiling_dn - quiet.bias_dn[pixel] - quiet.dark_dn[pixel]) / quiet.gain_dn_per_electron[pixel]
    light[pixel] -= 0.5 * math.sqrt(light[pixel])
    quiet, flare = replace(quiet, source_electrons=light), replace(flare, source_electrons=light + 1.0)
    found = engine.detect(quiet, [flare], realisations=N, seed=1, statistics=("matched",), tails="sampled")
    with pytest.raises(InputError, match="no threshold"):
        found.threshold(1e-4, "matched")
    assert np.isnan(found.table(1e-4)["fap_error"]).all()


def study(magnitude: float, **sections: object) -> Study:
    observation = {"changes": {"output_min_nm": 300.0, "output_max_nm": 301.5}, "exposure_s": 5.0}
    given = {"star": [{"library": "G2V", "magnitude": magnitude}], "run": {"realisations": N, "seed": 3}}
    return study_of_g2v(**given, flare={"amplitudes": [1e-5]}, observation=observation, **sections).paper()


def at_the_rail() -> float:
    """Return the magnitude at which the faintest pixel of `study` reaches saturation on average."""

    def faintest(magnitude: float) -> float:
        x = expectations(study(magnitude))[0]
        return float((x.mean_raw_dn - x.ceiling_dn).min())

    return float(optimize.brentq(faintest, -5.0, 10.0))


def test_answers_report_missing_thresholds(engine: Engine) -> None:
    magnitude = at_the_rail() + 0.001
    answer = detect(study(magnitude), engine)
    assert np.isnan(answer.table["probability"]).all()
    assert of_kind(answer.messages, "no threshold")
    axes = {"x": {"quantity": "magnitude", "values": [magnitude, magnitude + 3.0]},
            "y": {"quantity": "amplitude", "values": [1e-5, 2e-5]}}  # fmt: skip
    found = detection_map(study(magnitude, map=axes), engine)
    np.testing.assert_array_equal(np.isnan(found.probability[0]), [[True, False], [True, False]])
    (message,) = of_kind(found.messages, "no threshold")
    assert "2 of 4" in message
