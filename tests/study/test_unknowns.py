"""Averages over unknown instrument values, and their importance."""

from typing import Any

import pytest
from scenes import study_of_g2v

from mauvecl import Engine, Study, detect, limit

ALL = ("temperature_c", "light_loss", "pointing_loss", "qe_scale", "conversion_uv_per_electron", "read_noise_dn")


def study(unknowns: dict[str, Any], **changes: Any) -> Study:
    return study_of_g2v(run={"realisations": 40_000}, unknowns={"draws": 8} | unknowns, **changes)


def test_prior_of_zero_width_changes_nothing(engine: Engine) -> None:
    """A prior of zero width gives the limit of the nominal instrument, and no draw if all values are known."""
    sure = {"light_loss": {"uniform": [0.34, 0.34]}, "known": [name for name in ALL if name != "light_loss"]}
    first, second = (limit(study(given), engine) for given in (sure | {"draws": 2}, {"draws": 0}))
    (one,), (two,) = first.limits, second.limits
    assert first.table["matters_most"].tolist() == [""], "nothing moves the limit"
    assert one.closed_form == pytest.approx(two.closed_form, abs=1e-4)
    assert one.unknown.range == pytest.approx((two.closed_form, two.closed_form), abs=1e-4)
    assert abs(one.value.value - two.value.value) < 0.03


def test_values_of_the_study_are_not_drawn(engine: Engine) -> None:
    stated = study({"draws": 2}, observation={"temperature_c": 15.0, "changes": {"light_loss": 0.3}})
    unknown = limit(stated, engine).limits[0].unknown
    assert unknown.draws.names == ALL[2:]
    for one in unknown.draws.studies:
        instrument = one.observation.load_instrument()
        assert (instrument.temperature_c, instrument.light_loss) == (15.0, 0.3)


@pytest.mark.parametrize("of", ["magnitude", "amplitude", "exposure"])
@pytest.mark.parametrize("geometry", ["added", "replaces"])
def test_closed_form_of_a_detection_at_the_limit_is_the_power(of: str, geometry: str, engine: Engine) -> None:
    """The search scales expectations, the detection makes them anew; an exposure is the first frame that suffices."""
    asked = study({"draws": 0}, limit={"of": of}).with_settings(
        [f"flare.geometry={geometry}", "flare.photosphere_temperature_k=5800", "star.0.magnitude=12"]
    )
    (found,) = limit(asked, engine).limits

    def probability(value: float) -> float:
        one = asked.at(of, value).with_settings(["run.realisations=10000"])
        return float(detect(one, engine).table["closed_form_probability"][0])

    if of == "exposure":
        assert probability(found.closed_form) >= 0.9 > probability(found.closed_form - 5.0)
    else:
        assert probability(found.closed_form) == pytest.approx(0.9, abs=2e-4)
