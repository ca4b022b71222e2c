"""Messages of answers."""

from __future__ import annotations

import json

import pytest
from answers import of_kind
from marks import long_but

from mauvecl import Study, simulate
from mauvecl.host.files.json_text import json_text
from mauvecl.study.cases import Case
from mauvecl.study.messages import collect_messages


def test_rounding_that_invalidates_closed_forms_is_reported() -> None:
    quiet = {"observation.changes={read_noise_dn=0.1}", "observation.temperature_c=-40"}
    asked = Study().with_changes({}, [{"library": "G2V", "magnitude": 12.0}])
    for settings, is_told in ((quiet, True), ((), False)):
        x, *_ = Case(asked.with_settings(sorted(settings))).expectations
        assert bool(of_kind(collect_messages([x]), "rounding")) == is_told


def test_json_has_no_nan_and_no_infinity() -> None:
    assert json.loads(json_text({"a": [float("nan"), 1.5], "b": {"c": (float("inf"), "NaN")}})) == {
        "a": [None, 1.5],
        "b": {"c": [None, "NaN"]},
    }


@pytest.mark.parametrize(
    ("magnitude", "dark"),
    long_but([(7.4, False), (20.0, False), (24.0, True), (25.0, True)], (20.0, False), (24.0, True)),
)
def test_star_without_light_is_reported(magnitude: float, dark: bool) -> None:
    """Report a star that makes less than one electron in an exposure, since its S/N is 0."""
    study = Study().with_settings([f"star=[{{library = 'G2V', magnitude = {magnitude}}}]"])
    messages = simulate(study).messages
    assert bool(of_kind(messages, "no light")) == dark
