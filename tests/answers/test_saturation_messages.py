"""Every verb with a star reports where the star or a flare saturates, in messages or refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from answers import of_kind

from mauvecl import (
    Engine,
    InputError,
    Stares,
    Study,
    detect,
    detection_map,
    exposure_for,
    gaussian_report,
    inject,
    limiting_magnitude,
    measure,
    plan,
    simulate,
    snr,
    stare,
)
from mauvecl.store.bulk import realise_file
from mauvecl.study.cases import Case
from mauvecl.study.messages import collect_messages

Messages = Callable[[Study, Engine, Path], list[str]]

FLARING = {"amplitudes": [12.0]}
MAP = {"x": {"quantity": "amplitude", "values": [1e-4, 12.0]}, "y": {"quantity": "exposure", "values": [5.0, 10.0]}}
INJECTIONS = {"count": 10, "sizes": 2, "widths": 2, "positions": 4}
SHORT = {"stare": {"duration_s": 600.0}, "injections": INJECTIONS, "search": {"nulls": 0}}


def limits(study: Study, engine: Engine, _: Path) -> list[str]:
    return list(limiting_magnitude(study, engine).messages)


#: Verb: how its messages are had, and what its study needs.
VERBS: dict[str, tuple[Messages, dict[str, Any]]] = {
    "simulate": (lambda study, *_: list(simulate(study, flaring=True).messages), {}),
    "snr": (lambda study, engine, _: list(snr(study, engine).messages), {}),
    "exposure": (lambda study, *_: list(exposure_for(study, 10.0, 320.0).messages), {}),
    "detect": (lambda study, engine, _: list(detect(study, engine).messages), {}),
    "limit of amplitude": (limits, {"limit": {"of": "amplitude"}}),
    "limit of exposure": (limits, {"limit": {"of": "exposure"}}),
    "limit of magnitude": (limits, {"limit": {"of": "magnitude"}}),
    "map": (lambda study, engine, _: list(detection_map(study, engine).messages), {"map": MAP}),
    "gaussian": (
        lambda study, engine, _: list(gaussian_report(study, engine).messages),
        {"sweep": {"axes": [{"quantity": "exposure", "values": [5.0]}]}},
    ),
    "measure": (lambda study, engine, _: list(measure(study, engine).messages), {"measure": {"fits": 10}}),
    "stare": (lambda study, *_: list(stare(study, Stares()).messages), SHORT),
    "inject": (lambda study, *_: list(inject(study, Stares()).messages), SHORT),
    "realise": (
        lambda study, engine, folder: collect_messages(
            [scene.expectation for scene in realise_file(study, folder / "frames.h5", engine).scenes]
        ),
        {},
    ),
}  # fmt: skip


def question(magnitude: float, changes: dict[str, float], **sections: Any) -> Study:
    """Return a study of a hot star on part of the pixels."""
    data: dict[str, Any] = {
        "star": [{"library": "A0V", "magnitude": magnitude, "distance_pc": 7.7}],
        "flare": {"amplitudes": [0.01]},
        "observation": {"exposure_s": 5.0, "changes": changes},
        "run": {"realisations": 10_000, "seed": 3, "fap": 0.01, "statistics": ["matched"]},
    }
    return Study.build(data | sections, "test")


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("low_nm", [250.0, 300.0])
def test_star_that_saturates_is_reported(engine: Engine, tmp_path: Path, verb: str, low_nm: float) -> None:
    """Include stars that leave some pixels, few pixels and none below saturation."""
    ask, needs = VERBS[verb]
    # A limit of magnitude searches its own star: one that no bright one satisfies.
    flare = {"flare": {"amplitudes": [1e-5]}} if verb == "limit of magnitude" else {}
    study = question(0.03, {"output_min_nm": low_nm, "output_max_nm": 340.0}, **(needs | flare))
    try:
        said = ask(study, engine, tmp_path)
    except InputError as refusal:
        said = [str(refusal)]
    assert any("saturate" in text.lower() for text in said), said


@pytest.mark.parametrize("verb", ["simulate", "detect", "map", "realise", "gaussian"])
def test_flare_that_saturates_alone_is_reported(engine: Engine, tmp_path: Path, verb: str) -> None:
    """Check that the message names the flare if the star alone does not saturate."""
    ask, needs = VERBS[verb]
    range_nm = {"output_min_nm": 300.0, "output_max_nm": 340.0}
    study = question(3.3, range_nm, **(needs | {"flare": FLARING}))
    quiet, flare = Case(study).expectations
    assert not of_kind(quiet.messages, "saturated")
    assert flare.saturated.any()
    said = ask(study, engine, tmp_path)
    assert any("flare" in text for text in of_kind(said, "saturated")), said


def test_many_messages_are_summarised(engine: Engine) -> None:
    """Summarise the saturating flares of 64 cells: a common message, a dozen single ones, and one for the rest."""
    axes = {"x": {"quantity": "amplitude", "values": [12.0 + 0.1 * n for n in range(32)]},
            "y": {"quantity": "exposure", "values": [5.0, 10.0]}}  # fmt: skip
    study = question(3.3, {"output_min_nm": 300.0, "output_max_nm": 340.0}, map=axes)
    said = of_kind(detection_map(study, engine).messages, "saturated")
    assert len(said) == 14


def test_plan_reports_saturation() -> None:
    study = Study().with_settings(
        ["plan.targets=[{name = 'Vega'}]", "orbit.days=31", "plan.hours=100", "plan.completeness='closed form'"]
    )
    assert of_kind(plan(study).messages, "saturated")
